"""Time of designing optimal regulators, many at once: finite-time ones, and time-invariant ones.

    python -m experiments.benchmarks.regulator_designs

The one-span rig with a point force, crossed by a mass. A design is the table of gains along the
whole crossing; how right it is, between the edges of the table too, was found for 7 modes by
scipy's DOP853 (`tests/numerics/test_finite_horizon.py`). Designs are those of a grid, as many masses as speeds
as weights of the force, so that they share what depends on the speed or the mass alone; or all
numbers of each are its own. They are worked out in batches, by a thread for each core. Some are
timed, and scaled to 4096; compiling is told apart.
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
from jaxbeam.control.optimal.lqr import finite_horizon_gains
from jaxbeam.model.modes import lay_out
from jaxbeam.numerics.riccati import lqr
from jaxbeam.runtime.compiling import xla_options

DESIGNS, REPEATS, BATCH_SIZE = 4096, 3, 16  # BATCH also is how many values a number has in the grid
THREADS = os.cpu_count() or 1
PHASE_STEPS = {3.0: 3e-4, 2.0: 3e-5}  # rad the fastest mode turns in a stretch: error of the gains
MODE_COUNTS = (3, 7)  # modes
MASSES, SPEEDS, COMMAND_WEIGHTS = (
    (0.26, 0.51),
    (2.0, 3.0),
    (1e-4, 1e-2),
)  # kg, m/s, weight of the force
ADDRESSES = ("loads.0.mass", "loads.0.speed", "controller.command_weight.0")


class DesignTimes(NamedTuple):
    """Seconds: of compiling, and of all designs."""

    compiling: float
    run: float


def time_designs(function, batches, share: float = 1.0, threads: int = THREADS) -> DesignTimes:
    """Time a function of batches, a part of which each thread works out; the fastest of some runs.

    `share` of all batches is timed, so many that each thread has the same number.
    """
    each = max(1, round(len(batches) * share / threads))
    program = jax.jit(lambda some: jax.lax.map(function, some), compiler_options=xla_options())
    start = time.perf_counter()
    parts = [jnp.asarray(batches[i * each : (i + 1) * each]) for i in range(threads)]
    program = program.lower(parts[0]).compile()
    compiled, runs = time.perf_counter() - start, []
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(REPEATS):
            start = time.perf_counter()
            list(pool.map(lambda part: jax.block_until_ready(program(part)), parts))
            runs.append(time.perf_counter() - start)
    return DesignTimes(compiled, min(runs) * len(batches) / (each * threads))


def regulator_case(modes: int, points: int) -> jb.Case:
    """The rig with a regulator to be designed."""
    weights = [1e6] * modes + [10.0] * modes
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=modes),
        actuators=[jb.PointForce(0.25)],
        loads=[jb.MovingMass(mass=0.4, speed=SPEEDS[0])],
        controller=jb.FiniteLQR(weights, [1e-3], points=points),
    )


def grid() -> np.ndarray:
    """Masses, speeds and weights (pair, number, weight), a batch sharing mass and speed."""
    axes = (
        np.linspace(*MASSES, BATCH_SIZE),
        np.linspace(*SPEEDS, BATCH_SIZE),
        np.geomspace(*COMMAND_WEIGHTS, BATCH_SIZE),
    )
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=2).reshape(-1, 3, BATCH_SIZE)


def scattered_grid() -> np.ndarray:
    """The same (batch, number, design), all numbers different."""
    values = grid()
    low, high = values.min(axis=(0, 2)), values.max(axis=(0, 2))
    shares = np.random.default_rng(0).uniform(size=(DESIGNS // BATCH_SIZE, 3, BATCH_SIZE))
    return low[:, None] + (high - low)[:, None] * shares


def interval_count(modes: int, phase_step: float) -> int:
    """Stretches in which the fastest mode turns by so many rad, at the lowest speed."""
    beam = regulator_case(modes, 1).beam
    length, rigidity, density = 0.6, float(beam.rigidity), float(beam.linear_density)
    fastest = (modes * math.pi / length) ** 2 * math.sqrt(rigidity / density)
    return math.ceil(fastest * length / SPEEDS[0] / phase_step)


def time_finite_horizon(modes: int, points: int, shared: bool, share: float) -> DesignTimes:
    """Time finite-time designs: those of the grid, which share much, or others."""
    case = regulator_case(modes, points)
    layout = lay_out(case)

    def one(mass, speed, effort):
        changed = jb.replace(case, dict(zip(ADDRESSES, (mass, speed, effort), strict=True)))
        table = finite_horizon_gains(changed.controller, jb.state_space(changed, layout=layout))[0]
        return jnp.sum(table.coefficients)  # all of each design is needed, but not kept

    def batch(values):
        if shared:
            return jax.vmap(one, (None, None, 0))(values[0, 0], values[1, 0], values[2])
        return jax.vmap(one)(*values)

    return time_designs(batch, grid() if shared else scattered_grid(), share)


def time_invariant(modes: int) -> DesignTimes:
    """Time the time-invariant designs."""
    case = regulator_case(modes, 1000)
    plant = jb.state_space(case).unloaded
    Q = case.controller.weights(jb.state_space(case))[0]

    def one(effort):
        return lqr(plant.A, plant.B, Q, effort * jnp.eye(1))[0]

    # By one thread: several that have a library invert batches may wait for each other for ever.
    return time_designs(jax.vmap(one), np.geomspace(*COMMAND_WEIGHTS, DESIGNS)[None], threads=1)


def print_row(name: str, found: DesignTimes) -> None:
    """Print a line of the table."""
    print(f"{name:64} {found.compiling:13.2f} {found.run:12.2f}", flush=True)


def main() -> None:
    """Print the table."""
    print(f"{'':64} compiling (s)   {DESIGNS} take (s)")
    for modes in MODE_COUNTS:
        print_row(f"time-invariant, {2 * modes} states", time_invariant(modes))
        for turn, error in PHASE_STEPS.items():
            name = f"finite-time, {2 * modes} states, to {error:.0e}"
            points = interval_count(modes, turn)
            print_row(f"{name}, grid", time_finite_horizon(modes, points, True, 1 / 4))
            print_row(f"{name}, all different", time_finite_horizon(modes, points, False, 1 / 16))


if __name__ == "__main__":
    main()
