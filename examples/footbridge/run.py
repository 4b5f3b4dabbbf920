"""Footbridge: largest acceleration over the pace of a pedestrian."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb


def main(out: Path = Path("out/examples"), count: int = 17) -> dict[float, float]:
    """Peak accelerations (m/s^2) at midspan by pace (Hz), printed and drawn."""
    case = jb.load_case(Path(__file__).parent / "case.toml")
    peaks = {}
    for pace in np.linspace(1.6, 2.4, count):
        record = jb.simulate(jb.replace(case, {"loads.0.pace": pace}))
        peaks[round(float(pace), 3)] = float(abs(record.sensor_values[:, 0]).max())
    worst = max(peaks, key=lambda pace: peaks[pace])
    print(f"first natural frequency {jb.modes(case).frequencies[0]:.2f} Hz")
    print(f"largest acceleration {peaks[worst]:.2f} m/s^2, at {worst:.2f} steps a second")
    figure = Figure(figsize=(6, 3), layout="constrained")
    axes = figure.subplots()
    axes.plot(list(peaks), list(peaks.values()), "o-")
    axes.set(xlabel="pace (Hz)", ylabel="peak acceleration (m/s²)", title=case.title)
    out.mkdir(parents=True, exist_ok=True)
    figure.savefig(out / "footbridge.png", dpi=150)
    return peaks


if __name__ == "__main__":
    main()
