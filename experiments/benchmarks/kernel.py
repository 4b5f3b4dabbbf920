"""The practical limit: the integrator's method by hand in C, compiled when run, on one core.

    python -m experiments.benchmarks.kernel [--modes 3 6 12]

The sweep of the speed benchmark by `kernel.c` (gcc -O3 -march=native, 64 masses side by side), with
the time steps and propagators that jaxbeam chooses, whose computation is not in its time, and with
the closed form of the mode shapes. The time of jaxbeam includes all of that, and is on all cores.
Without a C compiler the benchmark ends with a message.
"""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np

from experiments.benchmarks.common import (
    interleaved_best,
    one_span_case,
    parser,
    print_row,
    print_table,
)
from experiments.benchmarks.rivals.pinned_beam import GRAVITY, PinnedBeam
from experiments.benchmarks.sweep import MASSES, SPEEDS, TOLERANCE, sweep_peaks
from jaxbeam.integrator.propagators import GAUSS_NODES, PEAK_NODES
from jaxbeam.numerics.peak_search import interpolation_matrix, newton_step_limit
from jaxbeam.runtime.cache_folder import write_file
from jaxbeam.runtime.trusted_code import loaded_library
from jaxbeam.sweeps import programs
from jaxbeam.sweeps.specification import sweep_specification

FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-shared", "-fPIC", "-lm")
Library = Callable[..., None]


def compiler() -> str | None:
    """Path of a C compiler, or None."""
    return shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")


def build(modes: int, folder: Path) -> Library:
    """The kernel for a number of modes, compiled into a folder."""
    source, target = Path(__file__).with_name("kernel.c"), folder / f"kernel{modes}.so"
    command = [compiler(), str(source), f"-DMODES={modes}", *FLAGS, "-o", str(target)]
    subprocess.run(command, check=True)  # type: ignore[arg-type]
    stored = write_file(target.stem, target.read_bytes())
    try:
        return loaded_library(stored.name).crossing
    finally:
        stored.unlink()


def kernel_arguments(modes: int) -> tuple[np.ndarray, list]:
    """Arguments of `crossing` in kernel.c.

    Returns the numbers of the beam as one array, and for each speed (m/s) the step matrices on the
    beam and after the exit, the speed, the length (s) of a step, and the two numbers of steps.
    """
    case = one_span_case(modes)
    over = {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS}
    runner = sweep_specification(case, over, False, False, TOLERANCE, "double").runner(native=False)
    steps, _ = runner.choose_step_sizes()
    mask = np.ones(SPEEDS.size, bool)
    models = jax.tree.map(
        lambda leaf: np.repeat(leaf[:1], SPEEDS.size, axis=0), runner.compiled.models
    )
    step_size = steps, np.zeros(steps.size, int)
    batched_models = programs.discrete_models(
        runner.program, mask, models, runner.batches.shared_values, step_size
    )
    discrete_models = jax.tree.map(np.asarray, batched_models)
    pinned_beam = PinnedBeam(modes)
    rates = discrete_models.model.state_matrix[0, :, 1, :]
    peak_search_points = (
        np.array(PEAK_NODES),
        interpolation_matrix(PEAK_NODES)[: len(PEAK_NODES)],
        newton_step_limit(PEAK_NODES),
    )
    # Signs of modes are arbitrary: those of jaxbeam follow from its rows of the sensors.
    sensor_rows = discrete_models.monitored_transition[0, 0, :3, :, 0]
    sines = np.sin(np.outer(pinned_beam.sensors, pinned_beam.wavenumbers))
    signs = np.where(np.sum(sensor_rows * sines, axis=0) < 0, -1.0, 1.0)
    numbers = (
        [pinned_beam.length, GRAVITY],
        pinned_beam.mode_amplitudes * signs,
        GAUSS_NODES,
        *peak_search_points,
        rates,
    )
    flexibility = np.sum(discrete_models.energy_bounds[0] ** 2, axis=-1)  # of all modes together
    parts = [*numbers, pinned_beam.frequencies**2, flexibility]
    beam = np.concatenate([np.ravel(part) for part in parts])
    crossings = []
    for i, speed in enumerate(runner.batches.shared_values[:, 0]):
        model = jax.tree.map(lambda leaf, i=i: leaf[i], discrete_models)
        panels = np.flatnonzero(model.grid.counts)  # the crossing, and the time after the exit
        length_indices = [int(model.grid.length_index[panel]) for panel in panels]
        counts = [int(model.grid.counts[panel]) for panel in panels]
        step_length = float(model.grid.lengths[length_indices[0]])
        matrices = [_step_matrices(model, index) for index in length_indices]
        crossings.append((*matrices, float(speed), step_length, *counts))
    return beam, crossings


def _step_matrices(model, length_index: int) -> np.ndarray:
    """Step matrices of one step length as `StepMatrices` of kernel.c."""
    step = model.propagators
    parts = (
        step.transition_nodes[length_index],
        step.input_nodes[length_index][..., 0],
        step.transition_end[length_index],
        step.input_end[length_index][..., 0],
        model.monitored_transition[length_index],
        model.monitored_input[length_index][..., 0],
    )
    return np.concatenate([np.ravel(part) for part in parts])


def kernel_peaks(library: Library, beam: np.ndarray, crossings: list) -> np.ndarray:
    """Peaks (mass, speed, sensor) in m by the kernel."""

    def pointer(array):
        return array.ctypes.data_as(ctypes.c_void_p)

    peaks = np.empty((len(crossings), MASSES.size, 3))
    for of_speed, crossing in zip(peaks, crossings, strict=True):
        during, after, speed, step_length, on, off = crossing
        numbers = ctypes.c_double(speed), ctypes.c_double(step_length)
        counts = ctypes.c_int(on), ctypes.c_int(off)
        matrices = pointer(beam), pointer(during), pointer(after)
        library(*matrices, *numbers, *counts, pointer(MASSES), pointer(of_speed))
    return peaks.swapaxes(0, 1)


def main() -> None:
    """Compile the kernel, time it beside jaxbeam, and print the table."""
    options = parser(__doc__, modes=[3, 6, 12]).parse_args()
    if compiler() is None:
        print("no C compiler here (cc, gcc, clang): nothing to compare with")
        return
    columns = "jaxbeam, all cores", "C kernel, one core", "ratio", "difference"
    print_table(("4096 crossings", *columns))
    with tempfile.TemporaryDirectory() as folder:
        for modes in options.modes:
            library, (beam, crossings) = build(modes, Path(folder)), kernel_arguments(modes)
            by_jaxbeam, by_kernel = sweep_peaks(modes), kernel_peaks(library, beam, crossings)
            difference = np.max(np.abs(by_kernel / by_jaxbeam - 1))
            functions = [
                lambda _, m=modes: sweep_peaks(m),
                lambda _, arguments=(library, beam, crossings): kernel_peaks(*arguments),
            ]
            first, second = interleaved_best(functions, None)
            times = f"{first:.3f} s", f"{second:.3f} s", f"{first / second:.2f}"
            print_row((f"{modes} modes", *times, f"{difference:.0e}"))


if __name__ == "__main__":
    main()
