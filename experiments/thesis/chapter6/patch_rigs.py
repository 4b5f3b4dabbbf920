"""Rigs B and C under displacement feedback through a low-pass filter, and runs of variants."""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import jaxbeam as jb
from experiments.thesis.cases import plan_with_steps
from jaxbeam.simulation.simulate import ContactLossWarning

MASSES = (0.261, 0.322, 0.371, 0.509)  # kg
GAIN, PERIOD = 2.0, 0.002  # V per mm or mm^3; s, not printed
ONE_SPAN_CUTOFF, TWO_SPAN_CUTOFF = 10.0, 20.0  # Hz


def with_feedback(
    case: jb.Case, power: int, cutoff: float, gain: float = GAIN, delay: float | None = None
) -> jb.Case:
    """A patch rig under u = -gain w^power, w in mm, behind filters with a cutoff (Hz).

    Power 0 is no control. `delay` is in s.
    """
    if not power:
        return case
    sensor_filter = jb.Filter(cutoff, order=10, realisation="analogue")
    sensors = tuple(dataclasses.replace(one, filter=sensor_filter) for one in case.sensors)
    gains = [gain * 1e3**power] * len(case.actuators)
    law = jb.Feedback(gains=gains, power=power, period=PERIOD, delay=delay)
    return dataclasses.replace(case, sensors=sensors, controller=law)


def simulate_changes(case: jb.Case, changes: Sequence[Mapping[str, Any]]) -> list[jb.Record]:
    """Records of a case with several changes of its numbers, by one integration plan.

    A sampled loop takes one step in each of its periods: that meets the tolerance, as its search
    finds.
    """
    cases = [jb.replace(case, change) for change in changes]
    plan = plan_with_steps(cases[-1], 1)
    with warnings.catch_warnings():
        # With too high gains the contact force becomes negative; the peaks show it.
        warnings.simplefilter("ignore", ContactLossWarning)
        return [jb.simulate(one, plan=plan) for one in cases]


def static_extremes(case: jb.Case) -> tuple[np.ndarray, np.ndarray]:
    """Largest static deflections down and up (m/kg), (sensor,), as a weight crosses the beam."""
    model = jb.modes(case)
    shapes_at_sensors, shapes = (
        np.asarray(model.shapes(positions, 0))
        for positions in (
            np.array([float(sensor.position) for sensor in case.sensors]),
            np.linspace(0.0, float(case.beam.length), 601),
        )
    )
    lines = float(case.run.gravity) * shapes_at_sensors / np.asarray(model.stiffness) @ shapes.T
    return lines.max(axis=1), -lines.min(axis=1)
