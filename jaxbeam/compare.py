"""Several controllers on the same case, beside no control and the best that is possible.

To add a figure of merit, give `Merits` a field, `_merits` its value and `printing` a column.
"""

import dataclasses
import time
import warnings
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case import Case
from jaxbeam.compiling import compiled
from jaxbeam.control.bound import HELD, Bound, bound
from jaxbeam.controller import AbstractController, Measurement
from jaxbeam.loads import motion
from jaxbeam.record import Record
from jaxbeam.simulate import ContactLossWarning, simulate
from jaxbeam.statespace import state_space

REPEATS = 5  # of timing a controller


class Merits(NamedTuple):
    """How a controller does on a case; deflections are those of the sensor where they are largest.

    Peak (m), at samples and in between; root mean square (m) over the run; largest deflection (m)
    after the last load has left, NaN if the run ends before; effort of each actuator (the integral
    of its squared command); share of the run that each spends at a limit; median time (s) a step
    takes to compute, NaN without steps; share of the attainable reduction of the peak.
    """

    peak: float
    rms: float
    after_exit: float
    effort: Float[np.ndarray, " actuator"]
    saturated: Float[np.ndarray, " actuator"]
    step_time: float
    share: float


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
    )


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
