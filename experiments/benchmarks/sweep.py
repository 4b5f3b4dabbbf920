"""Speed of a sweep against scipy, diffrax and numba, and of derivatives against plain runs.

    python -m experiments.benchmarks.sweep [--modes 3 12]

4096 crossings of the one-span rig, 64 masses by 64 speeds, peaks at three sensors with free
vibration, to one part in a million; everything timed in one run, compiling apart. Each call of
another solver is timed between two of ours and compared with these: machines are faster at one
moment than at another. Runs and ratios are medians; beside them is the ratio of the shortest times
of both, which other work on the machine disturbs least: it slows down what runs on all cores more
than what runs on one. Derivatives are the best of calls in turn, as they take milliseconds. scipy
is timed on twelve runs and scaled; the accuracy of all is checked against a reference. Where
there is a C compiler, sweeps are timed again with the steps that `jaxbeam native` compiles.
"""

import argparse
import os
import tempfile
import time
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import xarray

import jaxbeam as jb
from experiments.benchmarks.rivals import baselines, numba_peaks
from experiments.benchmarks.rivals.pinned_beam import PinnedBeam
from experiments.benchmarks.timing import Timing, interleaved_best, time_call
from jaxbeam.integrator import native_peaks
from jaxbeam.runtime import native_library
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.simulate import simulate_readings

MASSES = np.linspace(0.1, 1.0, 64)
SPEEDS = np.linspace(0.3, 10.0, 64)
TOLERANCE = 9e-7  # of every peak; checked below against a reference
REPEATS = 15  # runs of which the median is taken, where they take little time
CHECKED_SPEEDS = slice(0, 64, 9)  # speeds at which peaks are compared with the reference
FREE = (
    "beam.flexural_rigidity",
    "beam.mass_per_length",
    "beam.damping_ratio",
    "loads.0.mass",
    "loads.0.speed",
    "loads.0.entry_time",
)


def one_span_case(modes: int) -> jb.Case:
    """The one-span rig with its three sensors, long enough for the slowest crossing."""
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
        run=jb.Run(duration=0.6 / SPEEDS.min() + 0.5),
    )


def sweep_peaks(modes: int) -> np.ndarray:
    """Peaks of the grid by `jaxbeam.sweep`, choice of time steps included."""
    over = {"loads.0.mass": MASSES, "loads.0.speed": SPEEDS}
    found = jb.sweep(one_span_case(modes), over, progress=False, tolerance=TOLERANCE)
    return found.peak_deflection.values


def compare(modes: int) -> list[tuple[str, Timing, float]]:
    """Name, times (and how many of jaxbeam's) and largest relative error of each solver."""
    reference, found = (
        baselines.reference_peaks(PinnedBeam(modes), MASSES, SPEEDS[CHECKED_SPEEDS]),
        [],
    )

    def plain():
        return sweep_peaks(modes)

    def timed(name, solve, repeat=3 if modes < 6 else 1):
        """A row of the table; the last run is the one that is checked."""
        kept = []
        took = time_call(
            lambda: kept.append(jax.block_until_ready(solve())), repeat=repeat, reference=plain
        )
        error = np.max(np.abs(np.asarray(kept[-1])[:, CHECKED_SPEEDS] / reference - 1))
        found.append((name, took, float(error)))

    timed("jaxbeam", plain, REPEATS)
    if native_library.find_compiler() is None:
        print("steps in C are left out: there is no C compiler here")
    else:
        with tempfile.TemporaryDirectory() as folder:
            with with_cache_folder(folder):
                native_peaks.build()

            def sweep_in_c():
                with with_cache_folder(folder):
                    return sweep_peaks(modes)

            timed("jaxbeam native", sweep_in_c, REPEATS)
    for name, shared in (("diffrax, vmapped", False), ("diffrax, shared steps", True)):

        def others(shared=shared):
            return baselines.diffrax_peaks(PinnedBeam(modes), MASSES, SPEEDS, shared_steps=shared)

        timed(name, others)
    package = numba_peaks.import_numba()
    if package is None:
        print("numba is left out: it is not installed (uv sync --extra benchmarks)")
    else:
        fill = numba_peaks.compile_peaks(package)
        timed(
            "numba, parallel over runs",
            lambda: numba_peaks.numba_peaks(fill, PinnedBeam(modes), MASSES, SPEEDS),
        )
    scaled = baselines.scipy_time(
        baselines.scipy_peaks, PinnedBeam(modes), MASSES, SPEEDS, reference=plain
    )
    some = baselines.scipy_peaks(PinnedBeam(modes), MASSES[::21], SPEEDS[CHECKED_SPEEDS])
    error = float(np.max(np.abs(some / reference[::21] - 1)))
    return [*found, ("scipy DOP853, scaled", scaled, error)]


def with_cache_folder(folder: str):
    """A context in which steps in C are looked for in another folder."""
    return mock.patch.dict(os.environ, XDG_CACHE_HOME=folder)


def derivatives() -> list[tuple[str, float]]:
    """Time of a misfit's jvp, Jacobian over six numbers and gradient in reverse, in plain runs."""
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

    def along(values):
        return jax.jvp(misfit, (values,), (jnp.ones_like(values),))

    derived = {
        "jvp of a misfit": along,
        "Jacobian over six numbers": jax.jacfwd(residual),
        "gradient in reverse mode": jax.grad(misfit),
    }
    functions = [compiled(function) for function in (misfit, *derived.values())]
    plain, *times = interleaved_best(functions, start)
    return [(name, took / plain) for name, took in zip(derived, times, strict=True)]


def main() -> None:
    """Run the benchmark and print its tables."""
    with tempfile.TemporaryDirectory() as folder, with_cache_folder(folder):  # without steps in C
        _compare_all()


def _compare_all() -> None:
    # They load and start what they need now, not while compiling is timed.
    xarray.Dataset({"a": ("x", [0.0])})
    jnp.zeros(1).block_until_ready()
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--modes", type=int, nargs="+", default=[3, 12])
    began = time.perf_counter()
    for modes in parser.parse_args().modes:
        print(f"\n| {modes} modes, 4096 crossings | seconds | times jaxbeam | shortest | error |")
        print("| --- | ---: | ---: | ---: | ---: |")
        rows = compare(modes)
        for name, took, error in rows:
            ratios = f"{took.ratio:.3g} | {took.ratio_of_shortest:.3g}"
            print(f"| {name} | {took.run:.3g} | {ratios} | {error:.1e} |")
        compiling = [f"{name} {took.compile:.1f} s" for name, took, _ in rows if "jaxbeam" in name]
        print(f"\n{modes} modes, compiling: {', '.join(compiling)}", flush=True)
    print("\n| derivatives | plain runs |\n| --- | ---: |")
    for name, ratio in derivatives():
        print(f"| {name} | {ratio:.2g} |")
    print(f"\ntook {time.perf_counter() - began:.0f} s in all")


if __name__ == "__main__":
    main()
