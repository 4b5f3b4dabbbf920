"""Time per step of every kind of controller: alone, and a thousand at once.

    python -m experiments.benchmarks.steps

The one-span rig with a patch and five modes, its sensors read every 10 ms. A step is all that a
controller does between a measurement and a command; what it designs beforehand is left out. Timed
on one core, compiled: steps that follow each other inside one compiled loop, as many as there are
states (typical and worst of the repeats), one step called from Python, and a thousand steps
at once (per step). States are random, large enough for the limits to be felt in most steps.
"""

import os

if __name__ == "__main__":  # one core: before JAX looks
    os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false"
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})

import time
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import jaxbeam as jb
from jaxbeam.controller import AbstractController, Measurement

PERIOD, MODES, STEPS, BATCH, REPEATS = 0.01, 5, 200, 1000, 30
WEIGHTS = {"state_weight": [1e6] * (2 * MODES), "command_weight": [1.0], "period": PERIOD}
PREDICTIVE = {"move_weight": 1e-11, "period": PERIOD}
CONTROLLERS = {
    "feedback, linear": jb.Feedback(gains=[2000.0], period=PERIOD),
    "feedback, cubic": jb.Feedback(gains=[2e9], power=3, period=PERIOD),
    "state": jb.StateFeedback(gain=[[1e3] * (2 * MODES)], period=PERIOD),
    "lqr": jb.LQR(**WEIGHTS),
    "lqr-step": jb.StepLQR(**WEIGHTS, points=100),
    "mpc, unconstrained": jb.MPC(horizon=6, moves=4, solver="unconstrained", **PREDICTIVE),
    "mpc, 4 variables": jb.MPC(horizon=6, moves=4, **PREDICTIVE),
    "mpc, 6 variables": jb.MPC(horizon=8, moves=6, **PREDICTIVE),
    "mpc, 8 variables": jb.MPC(horizon=10, moves=8, **PREDICTIVE),
    "mpc, 4 variables, Hildreth": jb.MPC(horizon=6, moves=4, solver="hildreth", **PREDICTIVE),
    "mpc, 8 variables, Hildreth": jb.MPC(horizon=10, moves=8, solver="hildreth", **PREDICTIVE),
    "mpc, 4 variables, soft limit": jb.MPC(horizon=6, moves=4, soft_limit=1e-3, **PREDICTIVE),
    "mpc, 4 variables, loads known": jb.MPC(horizon=6, moves=4, loads="known", **PREDICTIVE),
    "mpc, 4 variables, time-varying": jb.MPC(
        horizon=6, moves=4, prediction="time-varying", **PREDICTIVE
    ),
}


class Times(NamedTuple):
    """Microseconds per step: in a compiled loop, called alone, in a batch; median and worst."""

    loop: float
    worst: float
    alone: float
    alone_worst: float
    batch: float
    batch_worst: float


def rig(controller: AbstractController) -> jb.Case:
    """The one-span rig with a patch, under a controller."""
    return jb.Case(
        jb.Beam(0.6, 13.211, 0.812, 0.03, modes=MODES),
        actuators=[
            jb.Patch(
                start=0.2575,
                end=0.3425,
                moment_per_volt=8.292e-4,
                correction=0.32,
                amplifier_gain=200.0,
                limits=[-2.5, 7.5],
            )
        ],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.509, speed=1.0)],
        controller=controller,
    )


def seconds(function, *given) -> np.ndarray:
    """Durations (s) of repeated calls, after a first one that compiles."""
    jax.block_until_ready(function(*given))
    found = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        jax.block_until_ready(function(*given))
        found.append(time.perf_counter() - start)
    return np.array(found)


def measure(controller: AbstractController, steps: int = STEPS, batch: int = BATCH) -> Times:
    """Time the steps of a controller."""
    model = jb.state_space(rig(controller))
    memory = eqx.filter_jit(controller.init)(model)
    draws = np.random.default_rng(0).normal(size=(max(steps, batch), 2 * MODES))
    states = jnp.asarray(draws * ([3e-4] * MODES + [6e-3] * MODES))
    shape = model.unloaded.C

    def step(memory, state, command, t):
        return controller.step(memory, Measurement(shape @ state, state, command), t)

    @jax.jit
    def loop(memory, states):
        def one(carry, state):
            memory, command, t = carry
            command, memory = step(memory, state, command, t)
            return (memory, command, t + PERIOD), command

        start = memory, jnp.zeros(1), jnp.zeros(())
        return jax.lax.scan(one, start, states)[1]

    # What was designed beforehand is the same for all: only what a step changes is batched.
    alone, many = jax.jit(step), jax.jit(jax.vmap(step, in_axes=(None, 0, None, None)))
    rest = jnp.zeros(1), jnp.array(0.2)
    looped = 1e6 * seconds(loop, memory, states[:steps]) / steps
    called = 1e6 * seconds(alone, memory, states[0], *rest)
    batched = 1e6 * seconds(many, memory, states[:batch], *rest) / batch
    return Times(*(pick(x) for x in (looped, called, batched) for pick in (np.median, np.max)))


def main() -> None:
    """Print the table."""
    print(
        f"{'microseconds per step':32}  in a loop    worst    called    worst  of {BATCH} at once"
        "    worst"
    )
    for name, controller in CONTROLLERS.items():
        found = measure(controller)
        print(
            f"{name:32} {found.loop:10.2f} {found.worst:8.2f} {found.alone:9.1f}"
            f" {found.alone_worst:8.1f} {found.batch:12.2f}"
            f" {found.batch_worst:8.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
