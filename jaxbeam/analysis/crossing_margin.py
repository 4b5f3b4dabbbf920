"""How far a closed loop is from instability along a crossing, in one pair of numbers; or beyond."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxbeam.analysis.frozen_loop import LoopDynamics, loop_dynamics
from jaxbeam.analysis.linearised_loop import LinearisedLoop, linearise, loop_timing
from jaxbeam.analysis.margins import margins
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads import trajectory
from jaxbeam.control import MPC
from jaxbeam.model.modes import mesh_layout

LOAD_POSITIONS = 13  # of the loads along a crossing, at which margins are looked for
MIN_RATE = 1e-6  # 1/s: what moves at a smaller rate neither grows nor dies out


class UnstableInterval(NamedTuple):
    """Where a loop is unstable with its loads parked: at their places from `start` to `end` (s).

    `rate` (1/s) is the fastest growth of small deviations, at a `frequency` (Hz).
    """

    start: float
    end: float
    rate: float
    frequency: float


class StabilityMargin(NamedTuple):
    """How much more gain (a factor) and delay (s) a loop bears at any one of its commands.

    The loads are parked, in several places along the crossing, of which the worst counts; a law
    that is not linear is taken as it answers small deviations from the rest under these loads, and
    limits of the actuators are left out. Both are zero where the loop is `unstable` as it is, and
    NaN where `obstacle` says why there are none.
    """

    gain: float
    delay: float
    obstacle: str = ""
    unstable: UnstableInterval | None = None


def stability_margin(case: Case) -> StabilityMargin:
    """The stability margins of the loop of a case, the worst along the crossing.

    Parked loads lack the terms of their motion, which act as damping of either sign: what those do
    within a crossing is for `stability.growth` to tell, a margin belongs to a loop that stays.
    """
    controller = case.controller
    if controller is None or controller.open_loop:
        return _no_margin("commands that do not depend on readings close no loop")
    if isinstance(controller, MPC) and controller.solver != "unconstrained":
        return _no_margin("a law that heeds limits bends at them: no linear loop stands for it")
    try:
        timing = loop_timing(case)
    except ValueError as error:
        return _no_margin(str(error))
    loop = loop_dynamics(case, mesh_layout(concrete_case(case)))
    loops, unstable = [], []
    for t in _crossing_times(case):
        stationary = _without_constant_states(
            linearise(_with_stationary_loads(loop, t), timing, jnp.asarray(t))
        )
        if not np.all(np.isfinite(stationary.closed_matrix)):
            return _no_margin("the law finds no rest under loads that are parked")
        rightmost = complex(stationary.poles()[0])
        if abs(rightmost.real) < MIN_RATE:
            return _no_margin("a part of the loop, as a mode without damping, never comes to rest")
        if rightmost.real > 0:
            unstable.append((float(t), rightmost.real, abs(rightmost.imag) / (2 * np.pi)))
        loops.append(stationary)
    if unstable:
        _, rate, frequency = max(unstable, key=lambda one: one[1])
        return StabilityMargin(
            0.0, 0.0, "", UnstableInterval(unstable[0][0], unstable[-1][0], rate, frequency)
        )
    with np.errstate(divide="ignore"):  # a loop without gain bears any
        margins_found = [margins(one, i) for one in loops for i in range(len(case.actuators))]
    return StabilityMargin(
        min(one.gain for one in margins_found), min(one.delay for one in margins_found)
    )


def _no_margin(obstacle: str) -> StabilityMargin:
    return StabilityMargin(np.nan, np.nan, obstacle)


def _with_stationary_loads(loop: LoopDynamics, t: float) -> LoopDynamics:
    """The loop with its loads at rest where they are at t (s)."""
    loop, zero = loop.freeze_loads(jnp.asarray(t)), jnp.zeros(())
    stationary = tuple(
        dataclasses.replace(load, speed=zero, acceleration=zero)
        for load in loop.augmented_plant.loads.trajectories
    )
    return eqx.tree_at(lambda loop: loop.augmented_plant.loads.trajectories, loop, stationary)


def _without_constant_states(loop: LinearisedLoop) -> LinearisedLoop:
    """A sampled loop without what stays as it is from tick to tick, such as a law's counters."""
    if loop.period is None:
        return loop
    size = loop.A.shape[0]
    constant = np.all(np.asarray(loop.A) == np.eye(size), axis=1) & ~np.any(loop.B, axis=1)
    kept = ~constant
    return LinearisedLoop(
        loop.A[kept][:, kept], loop.B[kept], loop.K[:, kept], loop.period, loop.modal_states
    )


def _crossing_times(case: Case) -> np.ndarray:
    """Instants (s) from the first entry to the last exit, or the end of the run."""
    if not case.loads:
        return np.zeros(1)
    windows = [trajectory(load, case.beam.length).entry_exit_times() for load in case.loads]
    entries, exits = concrete(jnp.array(windows)).T
    return np.linspace(entries.min(), min(exits.max(), concrete(case.run.duration)), LOAD_POSITIONS)
