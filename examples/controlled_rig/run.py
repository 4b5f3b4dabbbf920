"""Controlled rig: feedback to a patch beside no control and the least achievable peak."""

import dataclasses
from pathlib import Path

import jaxbeam as jb
from jaxbeam.plot import plot_record


def main(out: Path = Path("out/examples")) -> float:
    """Share of the attainable reduction that feedback achieves; printed and drawn."""
    case = jb.load_case(Path(__file__).parent / "case.toml")
    free = jb.simulate(dataclasses.replace(case, controller=None)).peak_deflection[0]
    record = jb.simulate(case)
    best = jb.bound(case)
    share = float((free - record.peak_deflection[0]) / (free - best.peak))
    print(f"without control {1e3 * free:.3f} mm, with {1e3 * record.peak_deflection[0]:.3f} mm")
    print(f"least achievable {1e3 * best.peak:.3f} mm: {share:.1%} of the attainable reduction")
    out.mkdir(parents=True, exist_ok=True)
    plot_record(record).savefig(out / "controlled_rig.png", dpi=150)
    return share


if __name__ == "__main__":
    main()
