"""Time of designing many optimal regulators at once: finite-horizon and time-invariant ones.

    python -m experiments.benchmarks.regulator_designs

One span with a point force, crossed by a mass. A finite-horizon design is the table of gains along
the whole crossing; its error, between the breakpoints too, was found for 7 modes by scipy's DOP853
(`tests/numerics/test_finite_horizon.py`). Designs form a grid of masses, speeds and weights of the
force, so that they share what depends on speed or mass alone; or all numbers of each design differ.
They are computed in batches, by one thread for each core. A share of them is timed and scaled to
4096; compiling is timed apart.
"""

import math
import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from experiments.benchmarks.common import parser, print_row, print_table
from jaxbeam.control.optimal.crossing_lqr import finite_horizon_gains
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.riccati import lqr
from jaxbeam.runtime.compiling import xla_options

DESIGNS, REPEATS, BATCH_SIZE = 4096, 3, 16  # each axis of the grid has BATCH_SIZE values
THREADS = os.cpu_count() or 1
# Phase (rad) by which the fastest mode advances in an interval, and the error of the gains.
PHASE_STEPS = {3.0: 3e-4, 2.0: 3e-5}
MODE_COUNTS = (3, 7)
MASSES, SPEEDS, COMMAND_WEIGHTS = (0.26, 0.51), (2.0, 3.0), (1e-4, 1e-2)  # kg, m/s, -
ADDRESSES = ("loads.0.mass", "loads.0.speed", "controller.command_weight.0")


class DesignTimes(NamedTuple):
    """Wall times (s) of compiling and of all designs."""

    compiling: float
    run: float


def time_designs(function, batches, share: float = 1.0, threads: int = THREADS) -> DesignTimes:
    """Time a function of batches, distributed over threads; the shortest of REPEATS runs.

    A `share` of all batches is timed, the same number in each thread, and the time is scaled.
    """
    batches_per_thread = max(1, round(len(batches) * share / threads))
    program = jax.jit(lambda some: jax.lax.map(function, some), compiler_options=xla_options())
    start = time.perf_counter()
    parts = [
        jnp.asarray(batches[i * batches_per_thread : (i + 1) * batches_per_thread])
        for i in range(threads)
    ]
    program = program.lower(parts[0]).compile()
    compiled, runs = time.perf_counter() - start, []
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(REPEATS):
            start = time.perf_counter()
            list(pool.map(lambda part: jax.block_until_ready(program(part)), parts))
            runs.append(time.perf_counter() - start)
    return DesignTimes(compiled, min(runs) * len(batches) / (batches_per_thread * threads))


def regulator_case(modes: int, points: int) -> jb.Case:
    """One span with a finite-horizon regulator, of a number of modes and of intervals."""
    weights = [1e6] * modes + [10.0] * modes
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=modes),
        actuators=[jb.PointForce(0.25)],
        loads=[jb.MovingMass(mass=0.4, speed=SPEEDS[0])],
        controller=jb.FiniteLQR(weights, [1e-3], points=points),
    )


def grid() -> np.ndarray:
    """Masses, speeds and weights, (pair, number, weight); a batch shares mass and speed."""
    axes = (
        np.linspace(*MASSES, BATCH_SIZE),
        np.linspace(*SPEEDS, BATCH_SIZE),
        np.geomspace(*COMMAND_WEIGHTS, BATCH_SIZE),
    )
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=2).reshape(-1, 3, BATCH_SIZE)


def scattered_grid() -> np.ndarray:
    """Masses, speeds and weights, (batch, number, design), all numbers different."""
    values = grid()
    low, high = values.min(axis=(0, 2)), values.max(axis=(0, 2))
    shares = np.random.default_rng(0).uniform(size=(DESIGNS // BATCH_SIZE, 3, BATCH_SIZE))
    return low[:, None] + (high - low)[:, None] * shares


def interval_count(modes: int, phase_step: float) -> int:
    """Intervals in which the fastest mode advances by a phase (rad), at the lowest speed."""
    beam = regulator_case(modes, 1).beam
    length, rigidity, density = 0.6, float(beam.bending_stiffness), float(beam.linear_density)
    fastest = (modes * math.pi / length) ** 2 * math.sqrt(rigidity / density)
    return math.ceil(fastest * length / SPEEDS[0] / phase_step)


def time_finite_horizon(modes: int, points: int, shared: bool, share: float) -> DesignTimes:
    """Time finite-horizon designs: those of the grid (`shared`), or with all numbers different."""
    case = regulator_case(modes, points)
    layout = mesh_layout(case)

    def design(mass, speed, command_weight):
        changed = jb.replace(case, dict(zip(ADDRESSES, (mass, speed, command_weight), strict=True)))
        table = finite_horizon_gains(changed.controller, jb.state_space(changed, layout=layout))[0]
        return jnp.sum(table.coefficients)  # a sum needs every gain, and takes no memory

    def batch(values):
        if shared:
            return jax.vmap(design, (None, None, 0))(values[0, 0], values[1, 0], values[2])
        return jax.vmap(design)(*values)

    return time_designs(batch, grid() if shared else scattered_grid(), share)


def time_invariant(modes: int) -> DesignTimes:
    """Time the time-invariant designs."""
    case = regulator_case(modes, 1000)
    plant = jb.state_space(case).unloaded
    Q = case.controller.weights(jb.state_space(case))[0]

    def design(command_weight):
        return lqr(plant.A, plant.B, Q, command_weight * jnp.eye(1))[0]

    # One thread: several threads that call LAPACK for batches of inverses may deadlock.
    return time_designs(jax.vmap(design), np.geomspace(*COMMAND_WEIGHTS, DESIGNS)[None], threads=1)


def print_times(name: str, times: DesignTimes) -> None:
    """Print a row of the table."""
    print_row((name, f"{times.compiling:.2f}", f"{times.run:.2f}"))


def main() -> None:
    """Print the table."""
    parser(__doc__).parse_args()
    print_table(("regulators", "compiling (s)", f"{DESIGNS} designs (s)"))
    for modes in MODE_COUNTS:
        print_times(f"time-invariant, {2 * modes} states", time_invariant(modes))
        for phase, error in PHASE_STEPS.items():
            name = f"finite-horizon, {2 * modes} states, to {error:.0e}"
            points = interval_count(modes, phase)
            print_times(f"{name}, grid", time_finite_horizon(modes, points, True, 1 / 4))
            different = time_finite_horizon(modes, points, False, 1 / 16)
            print_times(f"{name}, all different", different)


if __name__ == "__main__":
    main()
