"""Draw docs/figures/vehicle.png, a coach on an uneven bridge: `python -m docs.draw_vehicle`."""

from pathlib import Path

import jaxbeam as jb
from jaxbeam.plot import plot_record

CASE = jb.Case(
    jb.Beam(length=40.0, flexural_rigidity=1.2e11, mass_per_length=15000.0, damping_ratio=0.01),
    sensors=[jb.Sensor(20.0)],
    loads=[jb.VehicleLoad(model="manchester-wagon", speed=50.0, start_position=-20.0)],
    profile=jb.SineProfile(amplitude=0.002, wavelength=10.0),
    run=jb.Run(duration=2.0),
    title="A passenger wagon on a corrugated bridge at 180 km/h",
)

if __name__ == "__main__":
    path = Path(__file__).with_name("figures") / "vehicle.png"
    plot_record(jb.simulate(CASE)).savefig(path, dpi=100)
