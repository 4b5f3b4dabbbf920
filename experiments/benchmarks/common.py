"""How long calls take: compiling apart, several in turn, and what the operating system knows."""

import resource
import statistics
import time
from typing import NamedTuple

import jax
import numpy as np


class Timing(NamedTuple):
    """Seconds of wall time: the median of warm calls, and what the first took beyond that.

    And the median of how many times as long as another function they took; the shortest times of
    both, which the machine disturbed least.
    """

    run: float
    compile: float = 0.0
    ratio: float = float("nan")
    shortest: float = float("nan")
    reference_shortest: float = float("nan")

    @property
    def ratio_of_shortest(self) -> float:
        """How many times as long as the other function it takes, both undisturbed."""
        return self.shortest / self.reference_shortest


def time_call(function, *args, repeat=5, reference=None):
    """Time `function(*args)` until its results are ready: once cold, then `repeat` times warm.

    With a function `reference` it is compared with that, which is called before and after each: a
    machine that is faster at one moment than at another is so for both.
    """

    def seconds(function, *args):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        return time.perf_counter() - start

    cold, times = seconds(function, *args), []
    others = [seconds(reference or _no_operation)]
    for _ in range(repeat):
        times.append(seconds(function, *args))
        others.append(seconds(reference or _no_operation))
    run = statistics.median(times)
    around = np.add(others[:-1], others[1:]) / 2
    compiling, ratio, other = max(cold - run, 0.0), float("nan"), float("nan")
    if reference is not None:
        ratio, other = float(np.median(np.divide(times, around))), min(others)
    return Timing(run, compiling, ratio, min(times), other)


def _no_operation() -> None:
    pass


def interleaved_best(functions, *args, rounds=40):
    """Shortest times of several functions, called in turn: disturbances meet them all alike."""
    times = []
    for function in functions:
        jax.block_until_ready(function(*args))
    for _ in range(rounds):
        for function in functions:
            start = time.perf_counter()
            jax.block_until_ready(function(*args))
            times.append(time.perf_counter() - start)
    return np.min(np.reshape(times, (rounds, -1)), axis=0)


def peak_memory() -> float:
    """The most memory (MiB) that this process has held until now."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
