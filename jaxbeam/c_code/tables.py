"""Numbers of a law at all samples of a run, computed one by one or, if they are many, compiled."""

from collections.abc import Callable

import jax
import numpy as np

from jaxbeam.c_code.recorded_loop import MIN_COMPILED
from jaxbeam.c_code.source import CSource


def at_samples(function: Callable, code: CSource, varies: bool = True) -> tuple[np.ndarray, ...]:
    """Arrays that a function gives at each sample time (s), stacked along a first axis.

    A function that does not vary is evaluated once.
    """
    times = code.period * np.arange(code.samples if varies else 1)
    if len(times) > 1 and (code.compiles or len(times) >= MIN_COMPILED):
        return tuple(np.asarray(part) for part in jax.jit(jax.vmap(function))(times))
    rows = [function(t) for t in times]
    return tuple(
        np.stack([np.asarray(part) for part in column]) for column in zip(*rows, strict=True)
    )
