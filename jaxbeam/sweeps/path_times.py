"""Times of the paths of batches, all at once."""

from typing import NamedTuple

import jax
import numpy as np

from jaxbeam.case.case import concrete_case, replace
from jaxbeam.integrator.integrate import longest_force_step
from jaxbeam.integrator.time_grid import LoadEvents
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled
from jaxbeam.runtime.vectorised import NotVectorisedError, vectorised


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
