"""Road bridge: dynamic increment of deflection and moment under a truck, by roughness."""

import dataclasses
from pathlib import Path

import jaxbeam as jb
from jaxbeam.plot import plot_record


def main(out: Path = Path("out/examples")) -> dict[str, tuple[float, float]]:
    """Increments over a slow crossing of deflection and moment, by class of the road."""
    case = jb.load_case(Path(__file__).parent / "case.toml")
    smooth = dataclasses.replace(case, profile=None)
    slow = jb.replace(smooth, {"loads.0.speed": 2.0, "run.duration": 50.0, "run.sample_rate": 20})
    static = [abs(smallest) for smallest in jb.simulate(slow).extremes.smallest]
    increments = {}
    for road in ("smooth", "A", "B", "C"):
        one = smooth
        if road != "smooth":
            one = dataclasses.replace(case, profile=jb.profiles.ISO8608Profile(road, seed=3))
        record = jb.simulate(one)
        peaks = [abs(smallest) for smallest in record.extremes.smallest]
        increments[road] = tuple(float(p / s - 1) for p, s in zip(peaks, static, strict=True))
        deflection, moment = increments[road]
        print(f"road {road:6s}: deflection {deflection:+.1%}, moment over the pier {moment:+.1%}")
    out.mkdir(parents=True, exist_ok=True)
    plot_record(record).savefig(out / "road_bridge.png", dpi=150)
    return increments


if __name__ == "__main__":
    main()
