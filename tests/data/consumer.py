"""What a user's typed program sees of jaxbeam; `tests/test_types.py` has it checked, not run."""

from typing import assert_type

import jax
import xarray

import jaxbeam as jb
import tuning
from jaxbeam.model.modes import Modes

masses = [jb.MovingMass(mass=0.4, speed=1.5), jb.MovingMass(mass=0.2, speed="2 m/s")]
beam = jb.Beam(0.6, 12.0, 0.5, damping_ratio=[0.02, 0.03], segments=[jb.Segment(0.6)])
case = jb.Case(beam, sensors=[jb.Sensor(0.3)], loads=masses, run=jb.Run(1))
heavier = jb.replace(case, {"loads.0.mass": 0.5})
assert_type(heavier, jb.Case)
length: float = float(case.beam.length) + 1.0
assert_type(case.beam.modes, int)

record = jb.simulate(heavier)
assert_type(record, jb.Record)
assert_type(record.deflection, jax.Array)
assert_type(record.verdict, str)
assert_type(jb.modes(case), Modes)
assert_type(jb.sweep(case, {"loads.0.mass": [0.1, 0.2]}), xarray.Dataset)

log = tuning.read_log("log.csv")
assert_type(log, tuning.Log)
fit = tuning.identify(case, log, ["beam.damping_ratio"])
assert_type(fit, tuning.Fit)
assert_type(fit.verdict, str)
assert_type(tuning.identify_modes(log), tuning.ModalFit)
loads = tuning.LoadCases(({"loads.0.mass": 0.25},), ({"loads.0.mass": 0.4},))
tuned = tuning.tune(case, {"controller.gains.0": (5e2, 5e4)}, loads)
assert_type(tuned, tuning.TuningResult)
assert_type(tuned.case, jb.Case)
