"""How far a closed loop is from instability along a crossing, in one pair of numbers; or beyond."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxbeam.analysis.frozen_loop import OpenLoop, open_loop
from jaxbeam.analysis.linearised_loop import LinearLoop, linear, prepared
from jaxbeam.analysis.margins import margins
from jaxbeam.case.case import Case, known_case
from jaxbeam.case.fields import known
from jaxbeam.case.loads import motion
from jaxbeam.control import MPC
from jaxbeam.model.modes import lay_out

PLACES = 13  # of the loads along a crossing, at which margins are looked for
STILL = 1e-6  # 1/s: what moves at a smaller rate neither grows nor dies out


class Unstable(NamedTuple):
    """Where a loop is unstable with its loads parked: at their places from `start` to `end` (s).

    `rate` (1/s) is the fastest growth of small deviations, at a `frequency` (Hz).
    """

    start: float
    end: float
    rate: float
    frequency: float


class Reserve(NamedTuple):
    """How much more gain (a factor) and delay (s) a loop bears at any one of its commands.

    The loads are parked, in several places along the crossing, of which the worst counts; a law
    that is not linear is taken as it answers small deviations from the rest under these loads, and
    limits of the actuators are left out. Both are zero where the loop is `unstable` as it is, and
    NaN where `obstacle` says why there are none.
    """

    gain: float
    delay: float
    obstacle: str = ""
    unstable: Unstable | None = None


def reserve(case: Case) -> Reserve:
    """The stability margins of the loop of a case, the worst along the crossing.

    Parked loads lack the terms of their motion, which act as damping of either sign: what those do
    within a crossing is for `stability.growth` to tell, a margin belongs to a loop that stays.
    """
    controller = case.controller
    if controller is None or controller.blind:
        return _without("commands that do not depend on readings close no loop")
    if isinstance(controller, MPC) and controller.solver != "unconstrained":
        return _without("a law that heeds limits bends at them: no linear loop stands for it")
    try:
        clock = prepared(case)
    except ValueError as error:
        return _without(str(error))
    loop = open_loop(case, lay_out(known_case(case)))
    loops, lost = [], []
    for t in _along(case):
        parked = _changing(linear(_parked(loop, t), clock, jnp.asarray(t)))
        if not np.all(np.isfinite(parked.closed)):
            return _without("the law finds no rest under loads that are parked")
        rightmost = complex(parked.poles()[0])
        if abs(rightmost.real) < STILL:
            return _without("a part of the loop, as a mode without damping, never comes to rest")
        if rightmost.real > 0:
            lost.append((float(t), rightmost.real, abs(rightmost.imag) / (2 * np.pi)))
        loops.append(parked)
    if lost:
        _, rate, frequency = max(lost, key=lambda one: one[1])
        return Reserve(0.0, 0.0, "", Unstable(lost[0][0], lost[-1][0], rate, frequency))
    with np.errstate(divide="ignore"):  # a loop without gain bears any
        each = [margins(one, i) for one in loops for i in range(len(case.actuators))]
    return Reserve(min(one.gain for one in each), min(one.delay for one in each))


def _without(obstacle: str) -> Reserve:
    return Reserve(np.nan, np.nan, obstacle)


def _parked(loop: OpenLoop, t: float) -> OpenLoop:
    """The loop with its loads at rest where they are at t (s)."""
    loop, none = loop.frozen(jnp.asarray(t)), jnp.zeros(())
    still = tuple(
        dataclasses.replace(load, speed=none, acceleration=none)
        for load in loop.wide.traffic.motions
    )
    return eqx.tree_at(lambda loop: loop.wide.traffic.motions, loop, still)


def _changing(loop: LinearLoop) -> LinearLoop:
    """A sampled loop without what stays as it is from tick to tick, such as a law's counters."""
    if loop.period is None:
        return loop
    size = loop.A.shape[0]
    stays = np.all(np.asarray(loop.A) == np.eye(size), axis=1) & ~np.any(loop.B, axis=1)
    kept = ~stays
    return LinearLoop(loop.A[kept][:, kept], loop.B[kept], loop.K[:, kept], loop.period, loop.modal)


def _along(case: Case) -> np.ndarray:
    """Instants (s) from the first entry to the last exit, or the end of the run."""
    if not case.loads:
        return np.zeros(1)
    windows = [motion(load, case.beam.length).window() for load in case.loads]
    entries, exits = known(jnp.array(windows)).T
    return np.linspace(entries.min(), min(exits.max(), known(case.run.duration)), PLACES)
