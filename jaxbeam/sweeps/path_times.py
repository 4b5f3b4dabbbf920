"""Times of the paths of all batches, and the steps with which a search for their sizes begins."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case, replace
from jaxbeam.integrator.integrate import longest_force_step
from jaxbeam.integrator.time_grid import LoadEvents
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled
from jaxbeam.runtime.vectorised import NotVectorisedError, vectorised
from jaxbeam.sweeps.batches import Batches, values_at
from jaxbeam.sweeps.step_size import initial_share, initial_step_sizes

# `LoadEvents` of all paths, of known numbers.
PathEvents = tuple[Float[np.ndarray, "path wheel 2"], Float[np.ndarray, "path event"]]


class PathTimes(NamedTuple):
    """Times of paths: of load events (s), and the longest steps of forces (s)."""

    load_events: LoadEvents
    force_steps: Array


def path_times(case, addresses, shared_values, places) -> PathTimes:
    """Times of all paths, those at which wheels pass some places (m) included.

    Compiled only where they cannot be vectorised, as with values of tables of positions.
    """
    known = concrete_case(case)
    try:
        with np.errstate(all="ignore"):  # as in compiled code
            return vectorised(lambda values: _times(known, addresses, values, places))(
                shared_values
            )
    except NotVectorisedError:
        return _compiled_times(case, addresses, shared_values, places)


def _times(case, addresses, values, places) -> PathTimes:
    varied = replace(case, dict(zip(addresses, values, strict=True)))
    loads = load_set(varied)
    return PathTimes(loads.events(places), longest_force_step(varied, loads))


@compiled
def _compiled_times(case, addresses, shared_values, places) -> PathTimes:
    return jax.vmap(lambda values: _times(case, addresses, values, places))(shared_values)


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
