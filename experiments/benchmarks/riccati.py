"""Time of designing optimal regulators, many at once: finite-time ones, and time-invariant ones.

    python -m experiments.benchmarks.riccati

The one-span rig with a point force, crossed by a mass; designs differ in mass, speed and weight. A
design is the gain along the whole crossing, right to 1e-8, P carried backward one stretch after the
other or in parallel in time. As many stretches as the fastest mode demands. A few designs are
timed, and scaled to 4096; compiling is told apart. How P is carried is also timed by itself: that
is all in which the two forms differ.
"""

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from jaxbeam.control.lqr import optimal
from jaxbeam.modes import lay_out
from jaxbeam.riccati import lqr
from jaxbeam.stretches import NODES, costs_to_go, stretches

MANY, REPEATS = 4096, 3
FORMS = ("sequential", "parallel")
SIZES = {3: (16, 160), 7: (2, 820)}  # modes: designs that are timed, stretches of each
MASSES, SPEEDS, EFFORTS = (0.26, 0.51), (2.0, 3.0), (1e-4, 1e-2)  # kg, m/s, weight of the force


class Times(NamedTuple):
    """Seconds: of compiling, and of a run."""

    compiling: float
    run: float


def timed(function, *given) -> Times:
    """Time a function that is compiled when it is called first; the fastest of some runs."""
    program = jax.jit(function)
    start = time.perf_counter()
    program = program.lower(*given).compile()
    compiled = time.perf_counter() - start
    runs = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(program(*given))
        runs.append(time.perf_counter() - start)
    return Times(compiled, min(runs))


def rig(modes: int, points: int, form: str = FORMS[0]) -> jb.Case:
    """The rig with a regulator to be designed."""
    weights = [1e6] * modes + [10.0] * modes
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=modes),
        actuators=[jb.PointForce(0.25)],
        loads=[jb.MovingMass(mass=0.4, speed=SPEEDS[0])],
        controller=jb.FiniteLQR(weights, [1e-3], points=points, in_time=form),
    )


def problems(count: int):
    """Masses, speeds and weights of so many designs."""
    shares = np.random.default_rng(0).uniform(size=(3, count))
    mass, speed = (low + (high - low) * u for (low, high), u in zip(
        (MASSES, SPEEDS), shares[:2], strict=True))  # fmt: skip
    return tuple(
        map(jnp.asarray, (mass, speed, EFFORTS[0] * (EFFORTS[1] / EFFORTS[0]) ** shares[2]))
    )


def designs(modes: int, count: int, points: int, form: str = FORMS[0]) -> Times:
    """Time so many finite-time designs at once."""
    case = rig(modes, points, form)
    layout = lay_out(case)
    addresses = ("loads.0.mass", "loads.0.speed", "controller.command_weight.0")

    def one(*values):
        changed = jb.replace(case, dict(zip(addresses, values, strict=True)))
        return optimal(changed.controller, jb.state_space(changed, layout=layout))[0].pieces

    return timed(jax.vmap(one), *problems(count))


def carried(modes: int, points: int, form: str) -> Times:
    """Time how P is carried along the stretches of one design."""
    model = jb.state_space(rig(modes, points))
    Q, R = model.case.controller.weights(model)
    lengths = jnp.full(points, float(0.6 / SPEEDS[0]) / points)
    times = lengths[0] * (jnp.arange(points)[:, None] + NODES)
    parts = jax.jit(
        lambda times: stretches(
            *jax.vmap(jax.vmap(lambda t: (model.A(t), model.B(t))))(times), Q, R, lengths
        )
    )(times)
    return timed(lambda parts: costs_to_go(parts, Q, form == "parallel"), parts)


def invariant(modes: int, count: int) -> Times:
    """Time so many time-invariant designs at once."""
    case = rig(modes, 1000)
    plant = jb.state_space(case).unloaded
    Q = case.controller.weights(jb.state_space(case))[0]

    def one(effort):
        return lqr(plant.A, plant.B, Q, effort * jnp.eye(1))[0]

    return timed(jax.vmap(one), problems(count)[2])


def main() -> None:
    """Print the table."""
    print(f"{'':44} compiling (s)   run (s)   {MANY} would take (s)")
    for modes, (count, points) in SIZES.items():
        found = invariant(modes, MANY)
        name = f"{MANY} time-invariant, {2 * modes} states"
        print(f"{name:44} {found.compiling:13.2f} {found.run:9.3f} {found.run:12.2f}", flush=True)
        for form in FORMS:
            found = designs(modes, count, points, form)
            name = f"{count} finite-time, {2 * modes} states, {form}"
            scaled = found.run * MANY / count
            print(f"{name:44} {found.compiling:13.2f} {found.run:9.3f} {scaled:12.0f}", flush=True)
        for form in FORMS:
            found = carried(modes, points, form)
            name = f"P alone, {2 * modes} states, {points} stretches, {form}"
            print(f"{name:44} {found.compiling:13.2f} {found.run:9.3f}", flush=True)


if __name__ == "__main__":
    main()
