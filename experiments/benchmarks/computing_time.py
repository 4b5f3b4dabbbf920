"""Computing time per step of a sampled control law: median, worst, and in a batch of 256.

A step is the computation from a measurement to a command: estimator, load identification and law;
the design of the law is excluded.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.controller import AbstractSampledLaw, ControlStep, Measurement
from jaxbeam.case.fields import concrete
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.record import Record

TIMED_STEPS = 60  # timed steps of a run, evenly spread
MAX_STEPS = 1000  # steps of a run that are repeated
MIN_TIMED_DURATION = 1e-3  # s, of the repetitions of a step: the clock resolves it
MAX_REPETITIONS = 20000
ATTEMPTS = 3  # measurements of one time; the shortest is disturbed least by other processes
BATCH_SIZE = 256


class ComputingTimes(NamedTuple):
    """Computing times (s) of the compiled steps of a law.

    `median` and `worst` are those of the steps of a run, each the shortest of several measurements,
    without what the operating system adds. `batched` is the time per step of 256 steps at once, the
    median of several measurements, `batched_worst` the longest of these.
    """

    median: float
    worst: float
    batched: float
    batched_worst: float


def computing_times(record: Record) -> ComputingTimes:
    """Computing times of the steps of a run, repeated with its measurements.

    Raises ValueError for a run without a sampled controller.
    """
    controller = record.case.controller
    if controller is None or controller.period is None:
        raise ValueError("computing times are those of a controller with a period; give it one")
    modal_states = jnp.concatenate([record.coordinates, record.rates], axis=1)
    plant = state_space(record.case)
    states = jnp.zeros((modal_states.shape[0], plant.modal_model.state_count))
    states = states.at[:, : modal_states.shape[1]].set(modal_states)
    samples = sample_indices(np.asarray(record.times), float(concrete(controller.period)))
    histories = record.controller_readings, states, record.command
    measurements = tuple(jnp.nan_to_num(part)[samples] for part in histories)
    return time_steps(controller.law(plant), measurements, record.times[samples])


def time_steps(
    law: AbstractSampledLaw, measurements: tuple[Array, ...], times: Float[Array, " sample"]
) -> ComputingTimes:
    """Computing times of the steps of a law from its initial state.

    `measurements` are the readings, states and commands (sample, ...) at `times` (s).
    """
    timed_steps = set(np.linspace(0, times.shape[0] - 1, TIMED_STEPS).astype(int).tolist())
    state, step_times, zero = law.initial_state(), [], jnp.zeros(())
    for k in range(times.shape[0]):
        measurement = tuple(part[k] for part in measurements)

        def repeat(count, state=state, measurement=measurement, t=times[k]):
            return _repeat_step(law, state, measurement, t, zero, jnp.asarray(count))

        next_state = repeat(1).state
        if k in timed_steps:
            step_times.append(_time_per_step(repeat))
        state = next_state
    batch_indices = np.resize(np.arange(times.shape[0]), BATCH_SIZE)
    batch = tuple(part[batch_indices] for part in measurements)

    def all_at_once():
        return _step_batch(law, state, batch, times[batch_indices])

    all_at_once()  # compiles
    batched = [_seconds(all_at_once) / BATCH_SIZE for _ in range(2 * ATTEMPTS + 1)]
    return ComputingTimes(
        *(
            float(x)
            for x in (np.median(step_times), max(step_times), np.median(batched), max(batched))
        )
    )


def sample_indices(times: Float[np.ndarray, " time"], period: float) -> Int[np.ndarray, " sample"]:
    """Indices of the times (s) next to multiples of a period (s), at most MAX_STEPS."""
    samples = np.arange(0.0, times[-1] * (1 + 1e-9), period)[:MAX_STEPS]
    return np.clip(np.searchsorted(times, samples - 1e-9), 0, times.size - 1)


@compiled
def _repeat_step(law: AbstractSampledLaw, state, measurement, t, zero, count) -> ControlStep:
    """Result of one step, computed `count` times."""

    def once(_, before):
        # Each repetition depends on the one before through a term that only the caller knows to be
        # zero; otherwise the compiler would keep one.
        link = zero * jnp.sum(before[0])
        linked = Measurement(*(part + link for part in measurement))
        step = law.step(state, linked, t + link)
        return step.command, step.state

    command, after = jax.lax.fori_loop(0, count, once, (jnp.zeros_like(measurement[2]), state))
    return ControlStep(command, after)


@compiled
def _step_batch(law: AbstractSampledLaw, state, measurements, times) -> ControlStep:
    """Results of steps from one state, each with its own measurement."""
    return jax.vmap(lambda parts, t: law.step(state, Measurement(*parts), t))(measurements, times)


def _time_per_step(repeat: Callable[[int], Any]) -> float:
    """Time (s) of one repetition, without that of the call."""
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
