"""Crossing rates of batches, and the steps with which a search for their step sizes begins."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.sweeps.batches import Batches, values_at
from jaxbeam.sweeps.path_times import PathTimes
from jaxbeam.sweeps.step_size import initial_share, initial_step_sizes


class StepLimits(NamedTuple):
    """Crossing rates (1/s), initial steps and longest steps (s) of batches."""

    crossing_rates: Float[np.ndarray, " path"]
    initial_steps: Float[np.ndarray, " path"]
    max_steps: Float[np.ndarray, " path"]


def step_limits(
    case: Case,
    batches: Batches,
    times: PathTimes,
    stable_steps: Float[np.ndarray, " path"],
    longest: float | None,
    tolerance: float,
) -> StepLimits:
    """Limits of batches, from their longest stable steps (s), infinite where there is none.

    No step is longer than `longest` (s), if it is given.
    """
    entries, exits = np.moveaxis(np.asarray(times.load_events[0]), 2, 0)
    duration = values_at(case, batches, "run.duration")
    times_on_beam = np.minimum(exits, duration[:, None]) - entries
    times_on_beam = np.where(times_on_beam > 0, times_on_beam, duration[:, None])
    crossing_time = np.min(times_on_beam, axis=1, initial=np.inf)
    crossing_time = np.where(np.isfinite(crossing_time), crossing_time, duration)
    limits = np.minimum(stable_steps, times.force_steps)
    max_steps = np.minimum(limits, duration)
    if longest is not None:
        max_steps = np.minimum(max_steps, longest)
    initial = initial_step_sizes(crossing_time, limits, case.beam.modes, tolerance)
    share = initial_share(sensor.quantity for sensor in case.sensors)
    return StepLimits(1 / crossing_time, initial * share, max_steps)
