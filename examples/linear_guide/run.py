"""Linear guide: how long the tool rings after the carriage has stopped."""

from pathlib import Path

import numpy as np

import jaxbeam as jb
from jaxbeam.plot import plot_record

TOLERANCE = 1e-5  # m, within which the tool must stay
STOP = 3.0 / 4.5  # s


def main(out: Path = Path("out/examples")) -> float:
    """Time (s) from the stop until the tool stays within the tolerance; printed and drawn."""
    case = jb.load_case(Path(__file__).parent / "case.toml")
    record = jb.simulate(case)
    times, deflection = np.asarray(record.times), np.asarray(record.deflection[:, 0])
    final = float(deflection[times > times[-1] - 0.5].mean())
    outside = times[(abs(deflection - final) > TOLERANCE) & (times > STOP)]
    settling = float(outside.max()) - STOP if outside.size else 0.0
    print(f"deflection at rest {1e6 * final:.1f} um")
    print(f"within {1e6 * TOLERANCE:g} um {settling:.2f} s after the stop")
    out.mkdir(parents=True, exist_ok=True)
    plot_record(record).savefig(out / "linear_guide.png", dpi=150)
    return settling


if __name__ == "__main__":
    main()
