"""The practical limit: the integrator's method by hand in C, compiled on the spot, on one core.

    python -m experiments.benchmarks.kernel [--modes 3 6 12]

The sweep of the speed benchmark by `kernel.c` (gcc -O3 -march=native, 64 masses side by side), with
the time steps and the propagators that jaxbeam has chosen; making these is left out of its time,
and it is told the closed form of the mode shapes. jaxbeam does all of that in its time, on all
cores. Without a C compiler the benchmark says so and ends.
"""

import argparse
import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from experiments.benchmarks.rivals.pinned_beam import GRAVITY, PinnedBeam
from experiments.benchmarks.sweep import MASSES, SPEEDS, TOLERANCE, one_span_case, sweep_peaks
from experiments.benchmarks.timing import interleaved_best
from jaxbeam.integrator.propagators import GAUSS, LOOKED
from jaxbeam.numerics.peak_search import interpolation_matrix, newton_step_limit
from jaxbeam.sweeps import programs
from jaxbeam.sweeps.specification import sweep_specification

FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC", "-lm")
Library = Callable[..., None]


def compiler() -> str | None:
    """The C compiler of this machine, if it has one."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def build(modes: int, folder: Path) -> Library:
    """The kernel for so many modes, compiled into a folder."""
    source, target = Path(__file__).with_name("kernel.c"), folder / f"kernel{modes}.so"
    command = [compiler(), str(source), f"-DMODES={modes}", *FLAGS, "-o", str(target)]
    subprocess.run(command, check=True)  # type: ignore[arg-type]
    return ctypes.CDLL(str(target)).crossing


def kernel_arguments(modes: int) -> tuple[np.ndarray, list]:
    """The beam as one array, and for each speed what a crossing takes: all as kernel.c has it."""
    case = one_span_case(modes)
    over = {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS}
    runner = sweep_specification(case, over, False, False, TOLERANCE, "double").runner()
    steps, _ = runner.choose_step_sizes()
    mask = np.ones(SPEEDS.size, bool)
    models = jax.tree.map(lambda leaf: np.repeat(leaf[:1], SPEEDS.size, axis=0), runner.models)
    step_size = steps, np.zeros(steps.size, int)
    found = programs.discrete_models(
        runner.program(), mask, models, runner.batches.shared_values, step_size
    )
    discrete_models = jax.tree.map(np.asarray, found)
    pinned_beam = PinnedBeam(modes)
    rates = discrete_models.rig.state_matrix[0, :, 1, :]
    peak_search_points = (
        np.array(LOOKED),
        interpolation_matrix(LOOKED)[: len(LOOKED)],
        newton_step_limit(LOOKED),
    )
    # Signs of modes are free: those of jaxbeam are seen in its rows for the sensors at rest.
    seen, angles = (
        discrete_models.watch[0, 0, :3, :, 0],
        np.outer(pinned_beam.sensors, pinned_beam.wavenumbers),
    )
    signs = np.where(np.sum(seen * np.sin(angles), axis=0) < 0, -1.0, 1.0)
    numbers = (
        [pinned_beam.length, GRAVITY],
        pinned_beam.mode_amplitudes * signs,
        GAUSS,
        *peak_search_points,
        rates,
    )
    parts = [*numbers, pinned_beam.frequencies**2, discrete_models.flexibility[0]]
    beam = np.concatenate([np.ravel(part) for part in parts])
    crossings = []
    for i, speed in enumerate(runner.batches.shared_values[:, 0]):
        task = jax.tree.map(lambda leaf, i=i: leaf[i], discrete_models)
        on, last = np.flatnonzero(task.grid.counts)  # the crossing, and what comes after it
        kinds = [int(task.grid.kind[panel]) for panel in (on, last)]
        span = float(task.grid.lengths[kinds[0]])
        counts = int(task.grid.counts[on]), int(task.grid.counts[last])
        crossings.append(
            (*(_step_matrices(task, kind) for kind in kinds), float(speed), span, *counts)
        )
    return beam, crossings


def _step_matrices(task, kind: int) -> np.ndarray:
    step = task.step
    parts = (
        step.drift_nodes[kind],
        step.push_nodes[kind][..., 0],
        step.drift_end[kind],
        step.push_end[kind][..., 0],
        task.watch[kind],
        task.watch_push[kind][..., 0],
    )
    return np.concatenate([np.ravel(part) for part in parts])


def kernel_peaks(library: Library, beam: np.ndarray, crossings: list) -> np.ndarray:
    """Peaks (mass, speed, sensor) by the kernel."""

    def at(array):
        return array.ctypes.data_as(ctypes.c_void_p)

    found = np.empty((len(crossings), MASSES.size, 3))
    for one, (during, after, speed, span, on, off) in zip(found, crossings, strict=True):
        numbers = ctypes.c_double(speed), ctypes.c_double(span), ctypes.c_int(on), ctypes.c_int(off)
        library(at(beam), at(during), at(after), *numbers, at(MASSES), at(one))
    return found.swapaxes(0, 1)


def main() -> None:
    """Compile the kernel, time it beside jaxbeam, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--modes", type=int, nargs="+", default=[3, 6, 12])
    given = parser.parse_args()
    if compiler() is None:
        print("no C compiler here (cc, gcc, clang): nothing to compare with")
        return
    print("| 4096 crossings | jaxbeam, all cores | C kernel, one core | ratio | difference |")
    print("| --- | ---: | ---: | ---: | ---: |")
    with tempfile.TemporaryDirectory() as folder:
        for modes in given.modes:
            library, (beam, crossings) = build(modes, Path(folder)), kernel_arguments(modes)
            ours, kernel_result = sweep_peaks(modes), kernel_peaks(library, beam, crossings)
            apart = np.max(np.abs(kernel_result / ours - 1))
            functions = [
                lambda _, m=modes: sweep_peaks(m),
                lambda _, part=(library, beam, crossings): kernel_peaks(*part),
            ]
            first, second = interleaved_best(functions, None)
            row = f"{first:.3f} s | {second:.3f} s | {first / second:.2f} | {apart:.0e}"
            print(f"| {modes} modes | {row} |", flush=True)


if __name__ == "__main__":
    main()
