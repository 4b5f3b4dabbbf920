"""How long steps of a controller take to compute: one by one, typical and worst, and batched.

A step is all that happens between a measurement and a command: estimator, recognition of loads and
law. What a controller designs beforehand is left out.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.controller import AbstractController, Measurement
from jaxbeam.case.fields import known
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.record import Record

TIMED = 60  # steps of a run that are timed, evenly spread over it
WALKED = 1000  # steps of a run at most
LASTING = 1e-3  # s: a step is repeated until it takes so long, so that the clock resolves it
MOST = 20000  # repetitions
TRIES = 3  # the least counts: what else a machine does is no part of a step
BATCH = 256


class StepTimes(NamedTuple):
    """Times (s) of steps, compiled; NaN without a controller.

    `median` and `worst` are over the steps of a run, each repeated on its own in a compiled loop;
    of some tries the least counts, so that they are times of the computation, without what the
    operating system adds. `batched` is the time for each of 256 steps at once, the median of some
    tries, and `batched_worst` the longest of these.
    """

    median: float
    worst: float
    batched: float
    batched_worst: float


def step_times(record: Record) -> StepTimes:
    """The times of the steps that the controller of a run made in it; they are made again."""
    controller = record.case.controller
    if controller is None:
        return StepTimes(np.nan, np.nan, np.nan, np.nan)
    shown = record.deflection if record.shown is None else record.shown
    moving = jnp.concatenate([record.coordinates, record.rates], axis=1)
    model = state_space(record.case)
    states = jnp.zeros((moving.shape[0], model.rig.states)).at[:, : moving.shape[1]].set(moving)
    ticks = _ticks(np.asarray(record.times), controller.period)
    seen = tuple(jnp.nan_to_num(part)[ticks] for part in (shown, states, record.command))
    return timed(controller, controller.init(model), seen, record.times[ticks])


def timed(
    controller: AbstractController,
    memory: Any,
    seen: tuple[Array, Array, Array],
    times: Float[Array, " tick"],
) -> StepTimes:
    """Time the steps that a controller makes from a memory on, one measurement after the other.

    `seen` are readings, states and commands (tick, ...) of the measurements at `times` (s).
    """
    changes = _changes(controller, memory, tuple(part[0] for part in seen), times[0])
    chosen = set(np.linspace(0, times.shape[0] - 1, TIMED).astype(int).tolist())
    found, nothing = [], jnp.zeros(())
    for k in range(times.shape[0]):
        now = tuple(part[k] for part in seen)

        def repeat(count, now=now, t=times[k], memory=memory):
            return _repeated(controller, memory, now, t, nothing, jnp.asarray(count), changes)

        moved = repeat(1)[1]
        if k in chosen:
            found.append(_each(repeat))
        memory = _moved(memory, moved, changes)
    many = np.resize(np.arange(times.shape[0]), BATCH)
    batch = tuple(part[many] for part in seen)

    def all_at_once():
        return _batched(controller, memory, batch, times[many], changes)

    all_at_once()  # which compiles
    batched = [_seconds(all_at_once) / BATCH for _ in range(2 * TRIES + 1)]
    return StepTimes(
        *(float(x) for x in (np.median(found), max(found), np.median(batched), max(batched)))
    )


def _ticks(times: np.ndarray, period) -> np.ndarray:
    """The samples that are nearest to the ticks of a controller, or all; at most so many."""
    if period is None:
        return np.arange(min(times.size, WALKED))
    ticks = np.arange(0.0, times[-1] * (1 + 1e-9), float(known(period)))[:WALKED]
    return np.clip(np.searchsorted(times, ticks - 1e-9), 0, times.size - 1)


def _changes(controller, memory, seen, t) -> tuple[bool, ...]:
    """Which leaves of a memory a step changes; the others are a design, which is not copied."""
    leaves, structure = jax.tree.flatten(memory)

    def after(leaves):
        memory = jax.tree.unflatten(structure, leaves)
        return jax.tree.leaves(controller.step(memory, Measurement(*seen), t)[1])

    traced = jax.make_jaxpr(after)(leaves).jaxpr
    return tuple(a is not b for a, b in zip(traced.invars, traced.outvars, strict=True))


def _changed(memory, changes) -> list[Array]:
    return [leaf for leaf, moves in zip(jax.tree.leaves(memory), changes, strict=True) if moves]


def _moved(memory, moved, changes):
    """A memory with these leaves in place of those that change."""
    leaves, structure = jax.tree.flatten(memory)
    fresh = iter(moved)
    pairs = zip(leaves, changes, strict=True)
    return jax.tree.unflatten(structure, [next(fresh) if c else leaf for leaf, c in pairs])


@compiled
def _repeated(
    controller: AbstractController, memory, seen, t, nothing, count, changes: tuple[bool, ...]
):
    """The command and what the memory becomes by a step that is made `count` times over."""

    def once(_, before):
        # Each takes part in the next, by a share that only the caller knows to be zero.
        link = nothing * jnp.sum(before[0])
        linked = Measurement(*(part + link for part in seen))
        command, after = controller.step(memory, linked, t + link)
        return command, _changed(after, changes)

    start = jnp.zeros_like(seen[2]), _changed(memory, changes)
    return jax.lax.fori_loop(0, count, once, start)


@compiled
def _batched(controller: AbstractController, memory, seen, times, changes: tuple[bool, ...]):
    """Commands and changed memories of many steps from one memory."""

    def one(seen, t):
        command, after = controller.step(memory, Measurement(*seen), t)
        return command, _changed(after, changes)

    return jax.vmap(one)(seen, times)


def _each(repeat: Callable[[int], Any]) -> float:
    """The time (s) for one of many repetitions; what a call costs cancels."""
    once = min(_seconds(lambda: repeat(1)) for _ in range(TRIES))
    few = min(_seconds(lambda: repeat(9)) for _ in range(TRIES))
    one = max((few - once) / 8, 1e-8)
    count = int(np.clip(LASTING / one, 8, MOST))
    many = min(_seconds(lambda: repeat(1 + count)) for _ in range(TRIES))
    return max(many - once, 0.0) / count


def _seconds(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start
