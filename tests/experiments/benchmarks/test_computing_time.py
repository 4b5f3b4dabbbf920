"""Computing times of steps: the worst step among others, times at which steps are taken."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxbeam as jb
from experiments.benchmarks.computing_time import (
    MAX_STEPS,
    computing_times,
    sample_indices,
    time_steps,
)
from experiments.benchmarks.controller_steps import patch_case
from jaxbeam.case.controller import AbstractSampledLaw, ControlStep


class RepeatedProductLaw(AbstractSampledLaw):
    """Law that multiplies by a matrix as often as its reading says; its state is its command."""

    matrix: Any

    def initial_state(self):
        return jnp.zeros(1)

    def step(self, state, measurement, t):
        rounds = measurement.readings[0].astype(int)
        end = jax.lax.fori_loop(0, rounds, lambda _, x: jnp.tanh(self.matrix @ x), jnp.ones(6) + t)
        return ControlStep(end[:1] + state, end[:1])


def test_worst_step_differs_from_the_median():
    """Forty steps of twenty rounds, and one of six hundred."""
    readings = np.full((41, 1), 20.0)
    readings[20] = 600.0
    measurements = jnp.asarray(readings), jnp.zeros((41, 0)), jnp.zeros((41, 1))
    times = time_steps(RepeatedProductLaw(jnp.eye(6) + 0.1), measurements, jnp.arange(41) * 0.01)
    assert 8 * times.median < times.worst < 100 * times.median
    assert 1e-8 < times.median < 1e-4
    # In a batch every step takes as long as the slowest, but 256 share the call.
    assert times.median < times.batched <= times.batched_worst


def test_steps_of_a_run_are_timed():
    record = jb.simulate(patch_case(jb.Feedback(gains=[2e3], period=0.01)), tolerance=1e-4)
    times = computing_times(record)
    assert 1e-9 < times.median <= times.worst < 1e-2
    assert 1e-9 < times.batched <= times.batched_worst < 1e-2


def test_runs_without_a_sampled_controller_have_no_computing_times():
    record = jb.simulate(patch_case(jb.Prescribed(offsets=[1.0])), tolerance=1e-4)
    with pytest.raises(ValueError, match="a controller with a period"):
        computing_times(record)


def test_steps_are_the_samples_at_multiples_of_the_period():
    times = np.arange(0, 1001) / 1000
    assert sample_indices(times, 0.01).tolist() == list(range(0, 1001, 10))
    assert sample_indices(times, 1e-4).size == MAX_STEPS
