"""Parts of several benchmarks: timing, memory, subprocesses, and command lines."""

import argparse
import contextlib
import importlib
import json
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import NamedTuple
from unittest import mock

import jax
import numpy as np

import jaxbeam as jb
from jaxbeam.runtime.printer import markdown_table
from jaxbeam.simulation.integrator import native_peaks

SLOWEST, FASTEST = 0.3, 10.0  # m/s, of the crossings of sweeps
COMPILED_RUNS = 4096  # runs of the sweep by which everything is compiled


class Timing(NamedTuple):
    """Wall times (s) of a call, and its ratio to a reference call.

    `run` is the median of warm calls, `compile` the excess of the first call over that, `ratio` the
    median of warm calls over the reference calls next to them. `shortest` and `reference_shortest`
    are the shortest times of either, which other processes disturb least.
    """

    run: float
    compile: float = 0.0
    ratio: float = float("nan")
    shortest: float = float("nan")
    reference_shortest: float = float("nan")

    @property
    def ratio_of_shortest(self) -> float:
        """Shortest time over the shortest time of the reference."""
        return self.shortest / self.reference_shortest


def time_call(function, *args, repeat=5, reference=None) -> Timing:
    """Time `function(*args)` until its results are ready: once cold, then `repeat` times warm.

    A function `reference` is called before and after each warm call, so that changes of the
    machine's speed cancel in the ratio.
    """
    cold, times = seconds_of(function, *args), []
    reference_times = [seconds_of(reference or _no_operation)]
    for _ in range(repeat):
        times.append(seconds_of(function, *args))
        reference_times.append(seconds_of(reference or _no_operation))
    run = statistics.median(times)
    around = np.add(reference_times[:-1], reference_times[1:]) / 2
    ratio = reference_shortest = float("nan")
    if reference is not None:
        ratio = float(np.median(np.divide(times, around)))
        reference_shortest = min(reference_times)
    return Timing(run, max(cold - run, 0.0), ratio, min(times), reference_shortest)


def seconds_of(function, *args) -> float:
    """Wall time (s) of `function(*args)` until its results are ready."""
    start = time.perf_counter()
    jax.block_until_ready(function(*args))
    return time.perf_counter() - start


def _no_operation() -> None:
    pass


def interleaved_best(functions, *args) -> np.ndarray:
    """Shortest wall times (s) of several functions, (function,), called in turn.

    Disturbances by other processes then affect all functions alike.
    """
    for function in functions:
        jax.block_until_ready(function(*args))
    times = [[seconds_of(function, *args) for function in functions] for _ in range(40)]
    return np.min(times, axis=0)


def without_native() -> contextlib.AbstractContextManager:
    """A context in which sweeps of peaks are computed by XLA, as where there is no C compiler."""
    return mock.patch.object(native_peaks, "chosen_for", lambda case, runs: False)


def peak_memory() -> float:
    """Peak memory (MiB) of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def import_optional(name: str) -> ModuleType | None:
    """A package of the extra `benchmarks`, or None if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def parser(module_doc: str | None, modes: Sequence[int] = ()) -> argparse.ArgumentParser:
    """Command line of a benchmark, described by the first line of its module's docstring.

    With `modes` there is an option --modes, whose default they are.
    """
    options = argparse.ArgumentParser(description=(module_doc or "").splitlines()[0])
    if modes:
        options.add_argument(
            "--modes", type=int, nargs="+", default=list(modes), help="numbers of modes"
        )
    return options


def measure_in_subprocess(
    module: str, *arguments, environment: Mapping[str, str] | None = None
) -> dict[str, float]:
    """The JSON that `python -m MODULE --measure ARGUMENTS` prints last, in its own process."""
    command = [sys.executable, "-m", module, "--measure", *map(str, arguments)]
    variables = os.environ | dict(environment or {})
    process = subprocess.run(command, env=variables, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(process.stdout.splitlines()[-1])


def print_table(header: Sequence[str], right_from: int = 1) -> None:
    """Print header and ruler of a Markdown table; columns from `right_from` on are flush right."""
    print("\n".join(markdown_table(header, (), right_from)), end="", flush=True)


def print_row(cells: Sequence[str]) -> None:
    """Print a row of a Markdown table."""
    print(f"| {' | '.join(cells)} |", flush=True)


def sweep_grid(runs: int) -> dict[str, np.ndarray]:
    """A square grid of about so many runs over mass (kg) and speed (m/s)."""
    side = round(runs**0.5)
    return {
        "loads.0.mass": np.linspace(0.1, 1.0, side),
        "loads.0.speed": np.linspace(SLOWEST, FASTEST, side),
    }


def one_span_case(modes: int) -> jb.Case:
    """One span with three sensors, crossed by a mass, with a duration for the slowest crossing."""
    beam = jb.Beam(
        length=0.6,
        flexural_rigidity=11.68,
        mass_per_length=0.535,
        damping_ratio=0.03,
        modes=modes,
    )
    return jb.Case(
        beam,
        sensors=[jb.Sensor(x) for x in (0.15, 0.3, 0.45)],
        loads=[jb.MovingMass(mass=0.5, speed=1.0)],
        run=jb.Run(duration=0.6 / SLOWEST + 0.5),
    )
