"""Laboratory rig: peaks at the sensors, and how the contact force differs from the weight."""

from pathlib import Path

import jaxbeam as jb
from jaxbeam.plot import plot_record


def main(out: Path = Path("out/examples")) -> float:
    """Largest share by which the contact force exceeds the weight; printed and drawn."""
    case = jb.load_case(Path(__file__).parent / "case.toml")
    record = jb.simulate(case)
    print("peaks (mm):", *(f"{1e3 * peak:.3f}" for peak in record.peak_deflection))
    excess = float(record.contact_force.max()) / (0.5 * 9.81) - 1
    print(f"contact force up to {excess:.1%} above the weight; {record.verdict}")
    out.mkdir(parents=True, exist_ok=True)
    plot_record(record).savefig(out / "laboratory_rig.png", dpi=150)
    return excess


if __name__ == "__main__":
    main()
