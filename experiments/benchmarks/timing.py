"""How long calls take: compiling apart, several in turn, and what the operating system knows."""

import resource
import statistics
import time
from typing import NamedTuple

import jax
import numpy as np


class Timing(NamedTuple):
    """Seconds of wall time: the median of warm calls, and what the first took beyond that."""

    run: float
    compile: float


def time_call(function, *args, repeat=5):
    """Time `function(*args)` until its results are ready: once cold, then `repeat` times warm."""

    def seconds():
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        return time.perf_counter() - start

    cold = seconds()
    run = statistics.median(seconds() for _ in range(repeat))
    return Timing(run, max(cold - run, 0.0))


def best_in_turn(functions, *args, rounds=40):
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
