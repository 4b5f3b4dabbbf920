"""Cases that several experiments share: beams of chapter 2, a shaker, and changes of a case.

Rigs B and C under displacement feedback through a low-pass filter, and runs of variants.
"""

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import jaxbeam as jb
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import (
    IntegrationPlan,
    integration_plan,
    sample_times,
    static_shapes,
)
from jaxbeam.simulation.simulate import ContactLossWarning

PEAK_TOLERANCE = 1e-4  # relative, of peaks


def one_span(load_rig) -> jb.Case:
    """Rig A without its shaker."""
    return dataclasses.replace(load_rig("A"), actuators=())


def two_spans(load_rig, modes: int = 8) -> jb.Case:
    """Two spans of the beam of rig A, whose rigidity and density "stay unchanged"."""
    one = one_span(load_rig)
    return dataclasses.replace(
        one,
        beam=dataclasses.replace(one.beam, length=2 * one.beam.length, modes=modes),
        supports=(jb.Support(one.beam.length),),
    )


def data_physics_v4() -> jb.Electrodynamic:
    """The electrodynamic shaker of Table 2.3, at 0.5 m."""
    return jb.Electrodynamic(
        0.5, 0.82, 5e-5, 4.2, back_emf=4.2, mass=0.02, stiffness=9700.0, damping=0.55
    )


def as_moving_force(case: jb.Case) -> jb.Case:
    """The case with moving forces of the same weights instead of masses."""
    loads = [jb.MovingForce(mass=load.mass, speed=load.speed) for load in case.loads]
    return dataclasses.replace(case, loads=tuple(loads))


def with_modes(case: jb.Case, modes: int) -> jb.Case:
    """The case with another number of modes."""
    return dataclasses.replace(case, beam=dataclasses.replace(case.beam, modes=modes))


def with_duration(case: jb.Case, duration, sample_rate: float | None = None) -> jb.Case:
    """The case with another duration (s) and, if given, another sample rate (Hz)."""
    rate = case.run.sample_rate if sample_rate is None else np.asarray(sample_rate)
    run = dataclasses.replace(case.run, duration=np.asarray(duration), sample_rate=rate)
    return dataclasses.replace(case, run=run)


def with_sensors(case: jb.Case, *positions: float, duration: float) -> jb.Case:
    """The case with deflection sensors at positions (m), for a duration (s)."""
    sensors = tuple(jb.Sensor(position) for position in positions)
    return with_duration(dataclasses.replace(case, sensors=sensors), duration)


def plan_with_steps(case: jb.Case, steps: int) -> IntegrationPlan:
    """Plan of a controlled run with a number of steps from event to event, known to suffice.

    Its error, PEAK_TOLERANCE, is that of peaks too, which no run then estimates. That of a run
    without control is searched for. A search in a loop that is compiled compiles it once more, and
    numbers of steps that differ do.
    """
    if case.controller is None:
        return integration_plan(case, None, PEAK_TOLERANCE)
    schedule = loop_schedule(case, sample_times(case), float(case.run.duration))
    parts = static_shapes(case), steps, 0, False, PEAK_TOLERANCE, schedule, True
    return IntegrationPlan(*parts, of_peaks=True)


def critical_speed(case: jb.Case) -> float:
    """L omega_1 / pi in m/s, eq. (2.38)."""
    return 2 * float(case.beam.length) * float(jb.modes(case).frequencies[0])


def reduction(uncontrolled, controlled) -> np.ndarray:
    """Reduction of a peak by control, in percent of the uncontrolled peak."""
    return 100 * (1 - np.asarray(controlled) / np.asarray(uncontrolled))


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
    """Records of a case with several changes of its numbers, as `simulate_cases`."""
    return simulate_cases([jb.replace(case, change) for change in changes])


def simulate_cases(cases: Sequence[jb.Case]) -> list[jb.Record]:
    """Records of cases that differ in their numbers, by one integration plan.

    A sampled loop takes one step in each of its periods: that meets the tolerance, as its search
    finds.
    """
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
