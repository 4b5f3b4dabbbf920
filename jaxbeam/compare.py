"""Several controllers on the same case, beside no control and the best that is possible.

To add a figure of merit, give `Merits` a field, `merits_of` its value and the table of
`jaxbeam compare` (in `cli.comparing`) a column.
"""

import dataclasses
import time
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case import Case, known_case
from jaxbeam.compiling import compiled
from jaxbeam.control import MPC
from jaxbeam.control.bound import HELD, Bound, bound
from jaxbeam.controller import AbstractController, Measurement
from jaxbeam.fields import known
from jaxbeam.linear_loop import LinearLoop, linear, prepared
from jaxbeam.loads import motion
from jaxbeam.margins import margins
from jaxbeam.modes import lay_out
from jaxbeam.open_loop import OpenLoop, open_loop
from jaxbeam.record import Record
from jaxbeam.simulate import ContactLossWarning, simulate
from jaxbeam.statespace import state_space

REPEATS = 5  # of timing a controller
PLACES = 13  # of the loads along a crossing, at which margins are looked for
STILL = 1e-6  # 1/s: what moves at a smaller rate neither grows nor dies out


class Merits(NamedTuple):
    """How a controller does on a case; deflections are those of the sensor where they are largest.

    Peak (m), at samples and in between; root mean square (m) over the run; largest deflection (m)
    after the last load has left, NaN if the run ends before; effort of each actuator (the integral
    of its squared command); share of the run that each spends at a limit; median time (s) a step
    takes to compute, NaN without steps; share of the attainable reduction of the peak; stability
    margins as `Reserve` has them.
    """

    peak: float
    rms: float
    after_exit: float
    effort: Float[np.ndarray, " actuator"]
    saturated: Float[np.ndarray, " actuator"]
    step_time: float
    share: float
    reserve: "Reserve"


class Reserve(NamedTuple):
    """How much more gain (a factor) and delay (s) a loop bears at any one of its commands.

    The loads are parked, in several places along the crossing, of which the worst counts; limits
    of the actuators are left out. Both are zero where the loop is unstable as it is, and NaN
    where `obstacle` says why there are none.
    """

    gain: float
    delay: float
    obstacle: str = ""


class Comparison(eqx.Module):
    """What `compare` returns: the bound, and by name records and merits of the controllers.

    `free` is the run without control, `best` that with the commands of the `bound`.
    """

    case: Case
    free: Record
    best: Record
    records: dict[str, Record]
    merits: dict[str, Merits]
    bound: Bound


def compare(
    case: Case, controllers: dict[str, AbstractController], period: float | None = None
) -> Comparison:
    """Run several controllers on the same case, and the commands that attain its bound.

    The bound is for commands held over `period` (s), by default the shortest of the controllers'
    own, or 0.01 s; it holds for those that begin at its multiples. The case's own controller is
    left out unless it is among those given. Loads that would have to pull are named by the verdicts
    of the records, not by warnings.

    Raises ValueError for a case that is faulty, with one of the controllers (named) or for a bound.
    """
    if not controllers:
        raise ValueError("there is nothing to compare: give at least one controller")
    free_case = dataclasses.replace(case, controller=None)
    own = [float(c.period) for c in controllers.values() if c.period is not None]
    period = min(own, default=HELD) if period is None else period
    limit = bound(free_case, period=period)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        free = simulate(free_case)
        records = {name: _run(case, name, one) for name, one in controllers.items()}
        best = _run(case, "the bound", limit.controller())
    merits = {name: merits_of(record, limit) for name, record in records.items()}
    return Comparison(free_case, free, best, records, merits, limit)


class Standing(NamedTuple):
    """How a controller does over several load cases.

    Its largest peak (m); the least and the mean share of the attainable reduction; the largest
    deflection (m) after the last exit, NaN if a run ends before; the largest share of a run that an
    actuator spends at a limit.
    """

    peak: float
    worst_share: float
    mean_share: float
    after_exit: float
    saturated: float


def standings(found: Sequence[Comparison]) -> dict[str, Standing]:
    """By controller, how it does over comparisons of the same controllers on several load cases."""
    table = {}
    for name in found[0].merits:
        each = [one.merits[name] for one in found]
        shares = [merits.share for merits in each]
        table[name] = Standing(
            peak=float(np.max([merits.peak for merits in each])),
            worst_share=float(np.min(shares)),
            mean_share=float(np.mean(shares)),
            after_exit=float(np.max([merits.after_exit for merits in each])),
            saturated=float(np.max([merits.saturated for merits in each])),
        )
    return table


def _run(case: Case, name: str, controller: AbstractController) -> Record:
    try:
        return simulate(dataclasses.replace(case, controller=controller))
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def merits_of(record: Record, limit: Bound) -> Merits:
    """The merits of a run, held against the bound of its case."""
    deflection, times = np.asarray(record.deflection), np.asarray(record.times)
    leaves = [motion(load, record.case.beam.length).window()[1] for load in record.case.loads]
    after = np.abs(deflection[times > max(float(end) for end in leaves)])
    return Merits(
        peak=float(np.max(record.peak_deflection)),
        rms=float(np.sqrt(np.mean(deflection**2, axis=0)).max()),
        after_exit=float(after.max()) if after.size else np.nan,
        effort=np.asarray(record.effort),
        saturated=np.asarray(record.saturated).mean(axis=0),
        step_time=step_time(record),
        share=limit.share(record),
        reserve=reserve(record.case),
    )


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
    least = Reserve(np.inf, np.inf)
    for t in _along(case):
        parked = _changing(linear(_parked(loop, t), clock, jnp.asarray(t)))
        if not np.all(np.isfinite(parked.closed)):
            return _without("the law finds no rest under loads that are parked")
        rightmost = float(parked.poles().real[0])
        if abs(rightmost) < STILL:
            return _without("a part of the loop, as a mode without damping, never comes to rest")
        if rightmost > 0:
            return Reserve(0.0, 0.0)
        with np.errstate(divide="ignore"):  # a loop without gain bears any
            each = [margins(parked, i) for i in range(len(case.actuators))]
        gain, delay = min(one.gain for one in each), min(one.delay for one in each)
        least = Reserve(min(least.gain, gain), min(least.delay, delay))
    return least


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


def step_time(record: Record) -> float:
    """Median time (s) in which the controller of a run computes one command, compiled; or NaN.

    It is given what it saw in the run, at most a thousand samples one after another in one compiled
    loop; the time of the whole loop is divided by their number. NaN without a controller.
    """
    if record.case.controller is None:
        return np.nan
    shown = record.deflection if record.shown is None else record.shown
    moving = jnp.concatenate([record.coordinates, record.rates], axis=1)
    model = state_space(record.case)
    states = jnp.zeros((moving.shape[0], model.rig.states)).at[:, : moving.shape[1]].set(moving)
    seen = jnp.nan_to_num(shown), jnp.nan_to_num(states), jnp.nan_to_num(record.command)
    few = [part[:1000] for part in (*seen, record.times)]
    memory = record.case.controller.init(model)
    durations = []
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        jax.block_until_ready(_steps(record.case.controller, memory, *few))
        durations.append(time.perf_counter() - start)
    return float(np.median(durations[1:])) / few[0].shape[0]


@compiled
def _steps(
    controller: AbstractController, memory, readings, states, commands, times
) -> Float[Array, "time actuator"]:
    """Commands of a controller that sees these readings, states and commands one by one."""

    def step(memory, now):
        *seen, instant = now
        command, memory = controller.step(memory, Measurement(*seen), instant)
        return memory, command

    return jax.lax.scan(step, memory, (readings, states, commands, times))[1]
