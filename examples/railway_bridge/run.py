"""Railway bridge: peak deflection over the speed of a train, and its resonance speeds."""

from pathlib import Path

import numpy as np

import jaxbeam as jb
from jaxbeam.plot import plot_sweep


def main(out: Path = Path("out/examples"), count: int = 61) -> float:
    """Speed (m/s) of the largest deflection; printed and drawn."""
    case = jb.load_case(Path(__file__).parent / "case.toml")
    runs = jb.sweep(case, {"loads.0.speed": np.linspace(40.0, 90.0, count)}, progress=False)
    peak = runs.peak_deflection.max("sensor")
    worst = float(peak.idxmax())
    print(f"largest deflection {1e3 * float(peak.max()):.2f} mm at {worst:.1f} m/s")
    first, coach = jb.modes(case).frequencies[0], 18.0  # m, length of a coach of HSLM-A1
    print(f"resonance of coaches of {coach:g} m: {coach * first:.1f} m/s")
    out.mkdir(parents=True, exist_ok=True)
    plot_sweep(runs).savefig(out / "railway_bridge.png", dpi=150)
    return worst


if __name__ == "__main__":
    main()
