"""Crane runway: deflection against a limit, moment, and the reactions of the columns."""

from pathlib import Path

import jaxbeam as jb
from jaxbeam.plot import plot_record

LIMIT = 600  # span over deflection


def main(out: Path = Path("out/examples")) -> float:
    """Span over largest deflection; printed, and the record drawn."""
    case = jb.load_case(Path(__file__).parent / "case.toml")
    record = jb.simulate(case)
    ratio = 6.0 / float(record.peak_deflection[0])
    print(f"span / deflection {ratio:.0f} (to be above {LIMIT})")
    print(f"moment in the first span {float(record.extremes.largest[1]) / 1e3:.1f} kN m")
    largest = record.reactions.max(axis=0) / 1e3
    print("largest reactions (kN):", *(f"{reaction:.1f}" for reaction in largest))
    out.mkdir(parents=True, exist_ok=True)
    plot_record(record).savefig(out / "crane_runway.png", dpi=150)
    return ratio


if __name__ == "__main__":
    main()
