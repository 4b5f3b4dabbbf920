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
from jaxbeam.case.fields import concrete
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.record import Record

TIMED_STEPS = 60  # steps of a run that are timed, evenly spread over it
MAX_STEPS = 1000  # steps of a run at most
MIN_TIMED_DURATION = (
    1e-3  # s: a step is repeated until it takes so long, so that the clock resolves it
)
MAX_REPETITIONS = 20000  # repetitions
ATTEMPTS = 3  # the least counts: what else a machine does is no part of a step
BATCH_SIZE = 256


class ComputingTimes(NamedTuple):
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


def computing_times(record: Record) -> ComputingTimes:
    """The times of the steps that the controller of a run made in it; they are made again."""
    controller = record.case.controller
    if controller is None:
        return ComputingTimes(np.nan, np.nan, np.nan, np.nan)
    readings = (
        record.deflection if record.controller_readings is None else record.controller_readings
    )
    modal_states = jnp.concatenate([record.coordinates, record.rates], axis=1)
    plant = state_space(record.case)
    states = (
        jnp.zeros((modal_states.shape[0], plant.modal_model.state_count))
        .at[:, : modal_states.shape[1]]
        .set(modal_states)
    )
    ticks = _sample_indices(np.asarray(record.times), controller.period)
    measurements = tuple(jnp.nan_to_num(part)[ticks] for part in (readings, states, record.command))
    return time_steps(controller, controller.init(plant), measurements, record.times[ticks])


def time_steps(
    controller: AbstractController,
    memory: Any,
    measurements: tuple[Array, Array, Array],
    times: Float[Array, " tick"],
) -> ComputingTimes:
    """Time the steps that a controller makes from a memory on, one measurement after the other.

    `measurements` are readings, states and commands (tick, ...) of the measurements at `times` (s).
    """
    changing_leaves = _changing_leaves(
        controller, memory, tuple(part[0] for part in measurements), times[0]
    )
    timed_steps = set(np.linspace(0, times.shape[0] - 1, TIMED_STEPS).astype(int).tolist())
    found, zero = [], jnp.zeros(())
    for k in range(times.shape[0]):
        now = tuple(part[k] for part in measurements)

        def repeat(count, now=now, t=times[k], memory=memory):
            return _repeat_step(
                controller, memory, now, t, zero, jnp.asarray(count), changing_leaves
            )

        moved = repeat(1)[1]
        if k in timed_steps:
            found.append(_time_per_step(repeat))
        memory = _memory_with_state(memory, moved, changing_leaves)
    batch_indices = np.resize(np.arange(times.shape[0]), BATCH_SIZE)
    batch = tuple(part[batch_indices] for part in measurements)

    def all_at_once():
        return _step_batch(controller, memory, batch, times[batch_indices], changing_leaves)

    all_at_once()  # which compiles
    batched = [_seconds(all_at_once) / BATCH_SIZE for _ in range(2 * ATTEMPTS + 1)]
    return ComputingTimes(
        *(float(x) for x in (np.median(found), max(found), np.median(batched), max(batched)))
    )


def _sample_indices(times: np.ndarray, period) -> np.ndarray:
    """The samples that are nearest to the ticks of a controller, or all; at most so many."""
    if period is None:
        return np.arange(min(times.size, MAX_STEPS))
    ticks = np.arange(0.0, times[-1] * (1 + 1e-9), float(concrete(period)))[:MAX_STEPS]
    return np.clip(np.searchsorted(times, ticks - 1e-9), 0, times.size - 1)


def _changing_leaves(controller, memory, measurement, t) -> tuple[bool, ...]:
    """Which leaves of a memory a step changes; the others are a design, which is not copied."""
    leaves, structure = jax.tree.flatten(memory)

    def after(leaves):
        memory = jax.tree.unflatten(structure, leaves)
        return jax.tree.leaves(controller.step(memory, Measurement(*measurement), t)[1])

    traced = jax.make_jaxpr(after)(leaves).jaxpr
    return tuple(a is not b for a, b in zip(traced.invars, traced.outvars, strict=True))


def _state_of_memory(memory, changing_leaves) -> list[Array]:
    return [
        leaf for leaf, moves in zip(jax.tree.leaves(memory), changing_leaves, strict=True) if moves
    ]


def _memory_with_state(memory, state, changing_leaves):
    """A memory with these leaves in place of those that change."""
    leaves, structure = jax.tree.flatten(memory)
    fresh = iter(state)
    pairs = zip(leaves, changing_leaves, strict=True)
    return jax.tree.unflatten(structure, [next(fresh) if c else leaf for leaf, c in pairs])


@compiled
def _repeat_step(
    controller: AbstractController,
    memory,
    measurement,
    t,
    zero,
    count,
    changing_leaves: tuple[bool, ...],
):
    """The command and what the memory becomes by a step that is made `count` times over."""

    def once(_, before):
        # Each takes part in the next, by a share that only the caller knows to be zero.
        link = zero * jnp.sum(before[0])
        linked = Measurement(*(part + link for part in measurement))
        command, after = controller.step(memory, linked, t + link)
        return command, _state_of_memory(after, changing_leaves)

    start = jnp.zeros_like(measurement[2]), _state_of_memory(memory, changing_leaves)
    return jax.lax.fori_loop(0, count, once, start)


@compiled
def _step_batch(
    controller: AbstractController, memory, measurements, times, changing_leaves: tuple[bool, ...]
):
    """Commands and changed memories of many steps from one memory."""

    def one(seen, t):
        command, after = controller.step(memory, Measurement(*seen), t)
        return command, _state_of_memory(after, changing_leaves)

    return jax.vmap(one)(measurements, times)


def _time_per_step(repeat: Callable[[int], Any]) -> float:
    """The time (s) for one of many repetitions; what a call costs cancels."""
    once = min(_seconds(lambda: repeat(1)) for _ in range(ATTEMPTS))
    few = min(_seconds(lambda: repeat(9)) for _ in range(ATTEMPTS))
    one = max((few - once) / 8, 1e-8)
    count = int(np.clip(MIN_TIMED_DURATION / one, 8, MAX_REPETITIONS))
    many = min(_seconds(lambda: repeat(1 + count)) for _ in range(ATTEMPTS))
    return max(many - once, 0.0) / count


def _seconds(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start
