"""Speed of a sweep against scipy, diffrax and numba, and of derivatives against plain runs.

    python -m experiments.benchmarks.sweep [--modes 3 12]

4096 crossings of one span, 64 masses by 64 speeds, peaks at three sensors with free vibration, to
one part in a million; everything is timed in one run, compiling apart. Each call of another solver
is timed between two of jaxbeam, since the speed of a machine varies. Runs and ratios are medians;
beside them is the ratio of the shortest times of both, which other processes disturb least: they
slow down what runs on all cores more than what runs on one. Derivatives, which take milliseconds,
are the best of interleaved calls. scipy is timed on twelve runs and scaled; the accuracy of all
solvers is checked against a reference. With a C compiler, sweeps are timed again with the steps
that `jaxbeam native` compiles.
"""

import os
import tempfile
import time
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import xarray

import jaxbeam as jb
from experiments.benchmarks.common import (
    FASTEST,
    SLOWEST,
    Timing,
    import_optional,
    interleaved_best,
    one_span_case,
    parser,
    print_row,
    print_table,
    time_call,
    without_native,
)
from experiments.benchmarks.rivals import baselines, numba_peaks
from experiments.benchmarks.rivals.baselines import PinnedBeam
from jaxbeam.runtime import native_library
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.simulate import simulate_readings

MASSES = np.linspace(0.1, 1.0, 64)
SPEEDS = np.linspace(SLOWEST, FASTEST, 64)
TOLERANCE = 9e-7  # of every peak; checked below against a reference
REPEATS = 15  # calls of jaxbeam, of which the median is taken
CHECKED_SPEEDS = slice(0, 64, 9)  # speeds at which peaks are compared with the reference
FREE = (
    "beam.flexural_rigidity",
    "beam.mass_per_length",
    "beam.damping_ratio",
    "loads.0.mass",
    "loads.0.speed",
    "loads.0.entry_time",
)


def sweep_peaks(modes: int) -> np.ndarray:
    """Peaks (mass, speed, sensor) in m by `jaxbeam.sweep`, choice of time steps included."""
    over = {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS}
    results = jb.sweep(one_span_case(modes), over, progress=False, tolerance=TOLERANCE)
    return results.peak_deflection.values


def compare(modes: int) -> list[tuple[str, Timing, float]]:
    """Name, times (with ratios to jaxbeam) and largest relative error of each solver."""
    beam, rows = PinnedBeam(modes), []
    reference = baselines.reference_peaks(beam, MASSES, SPEEDS[CHECKED_SPEEDS])

    def by_jaxbeam():
        """By XLA, as on a machine without a C compiler."""
        with without_native():
            return sweep_peaks(modes)

    def add_row(name, solve, repeat=3 if modes < 6 else 1):
        """Time a solver, and compare the peaks of its last call with the reference."""
        peaks = []
        timing = time_call(
            lambda: peaks.append(jax.block_until_ready(solve())),
            repeat=repeat,
            reference=by_jaxbeam,
        )
        error = np.max(np.abs(np.asarray(peaks[-1])[:, CHECKED_SPEEDS] / reference - 1))
        rows.append((name, timing, float(error)))

    add_row("jaxbeam", by_jaxbeam, REPEATS)
    if native_library.find_compiler() is None:
        print("jaxbeam native is left out: there is no C compiler")
    else:
        with tempfile.TemporaryDirectory() as folder:
            with with_cache_folder(folder):
                native_peaks.LIBRARY.build()

            def by_native_steps():
                with with_cache_folder(folder):
                    return sweep_peaks(modes)

            add_row("jaxbeam native", by_native_steps, REPEATS)
    for name, shared in (("diffrax, vmapped", False), ("diffrax, shared steps", True)):

        def by_diffrax(shared=shared):
            return baselines.diffrax_peaks(beam, MASSES, SPEEDS, shared_steps=shared)

        add_row(name, by_diffrax)
    package = import_optional("numba")
    if package is None:
        print("numba is left out: it is not installed (uv sync --extra benchmarks)")
    else:
        peak_function = numba_peaks.compile_peaks(package)
        add_row(
            "numba, parallel over runs",
            lambda: numba_peaks.numba_peaks(peak_function, beam, MASSES, SPEEDS),
        )
    scaled = baselines.scipy_time(baselines.scipy_peaks, beam, MASSES, SPEEDS, reference=by_jaxbeam)
    checked_peaks = baselines.scipy_peaks(beam, MASSES[::21], SPEEDS[CHECKED_SPEEDS])
    error = float(np.max(np.abs(checked_peaks / reference[::21] - 1)))
    return [*rows, ("scipy DOP853, scaled", scaled, error)]


def with_cache_folder(folder: str):
    """A context with another folder for the compiled C library."""
    return mock.patch.dict(os.environ, XDG_CACHE_HOME=folder)


def derivatives() -> list[tuple[str, float]]:
    """Times of a misfit's derivatives (jvp, Jacobian by six numbers, gradient), in plain runs."""
    case = jb.replace(one_span_case(3), {"run.duration": 1.2})
    times = jnp.arange(1200) / 1000.0
    plan = integration_plan(case, times)
    start = jnp.array([float(jb.addresses(case)[address]) for address in FREE])
    measured = simulate_readings(case, times, plan)

    def residual(values):
        varied = jb.replace(case, dict(zip(FREE, values, strict=True)))
        return simulate_readings(varied, times, plan) - measured

    def misfit(values):
        return jnp.sum(residual(values) ** 2)

    derivatives_by_name = {
        "jvp of a misfit": lambda values: jax.jvp(misfit, (values,), (jnp.ones_like(values),)),
        "Jacobian over six numbers": jax.jacfwd(residual),
        "gradient in reverse mode": jax.grad(misfit),
    }
    functions = [compiled(function) for function in (misfit, *derivatives_by_name.values())]
    plain, *times = interleaved_best(functions, start)
    return [(name, took / plain) for name, took in zip(derivatives_by_name, times, strict=True)]


def main() -> None:
    """Run the benchmark and print its tables."""
    arguments = parser(__doc__, modes=[3, 12]).parse_args()
    # An empty folder, so that a library compiled earlier is not used.
    with tempfile.TemporaryDirectory() as folder, with_cache_folder(folder):
        # xarray and JAX import modules at first use, which is not compiling.
        xarray.Dataset({"a": ("x", [0.0])})
        jnp.zeros(1).block_until_ready()
        _print_tables(arguments.modes)


def _print_tables(mode_counts: list[int]) -> None:
    began = time.perf_counter()
    for modes in mode_counts:
        print()
        header = f"{modes} modes, 4096 crossings", "seconds", "times jaxbeam", "shortest", "error"
        print_table(header)
        rows = compare(modes)
        for name, timing, error in rows:
            ratios = f"{timing.ratio:.3g}", f"{timing.ratio_of_shortest:.3g}"
            print_row((name, f"{timing.run:.3g}", *ratios, f"{error:.1e}"))
        compiling = [f"{name} {one.compile:.1f} s" for name, one, _ in rows if "jaxbeam" in name]
        print(f"\n{modes} modes, compiling: {', '.join(compiling)}\n", flush=True)
    print_table(("derivatives", "plain runs"))
    for name, ratio in derivatives():
        print_row((name, f"{ratio:.2g}"))
    print(f"\ntook {time.perf_counter() - began:.0f} s in all")


if __name__ == "__main__":
    main()
