"""Times of steps: what takes longer is seen to, and only what a step changes counts."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.analysis.computing_time import MAX_STEPS, _changing_leaves, _sample_indices, time_steps
from jaxbeam.case.controller import AbstractController


class Laborious(AbstractController):
    """Turns a matrix as often as its reading says; it remembers the last command, and a design."""

    def init(self, model):
        return {"design": jnp.eye(6) + 0.1, "last": jnp.zeros(1)}

    def step(self, memory, measurement, t):
        rounds = measurement.readings[0].astype(int)
        end = jax.lax.fori_loop(
            0, rounds, lambda _, x: jnp.tanh(memory["design"] @ x), jnp.ones(6) + t
        )
        return end[:1] + memory["last"], memory | {"last": end[:1]}


def test_the_worst_step_is_told_from_the_median():
    """Forty steps of twenty rounds, and one of six hundred."""
    readings = np.full((41, 1), 20.0)
    readings[20] = 600.0
    law = Laborious(period=0.01)
    memory, none = law.init(None), np.zeros((41, 0))
    seen = jnp.asarray(readings), jnp.asarray(none), jnp.zeros((41, 1))
    found = time_steps(law, memory, seen, jnp.arange(41) * 0.01)
    assert 8 * found.median < found.worst < 100 * found.median
    assert 1e-8 < found.median < 1e-4
    # In a batch all wait for the slowest, but many share the call.
    assert found.median < found.batched <= found.batched_worst


def test_only_what_a_step_changes_is_carried():
    law = Laborious(period=0.01)
    seen = jnp.ones(1), jnp.zeros(0), jnp.zeros(1)
    assert _changing_leaves(law, law.init(None), seen, jnp.zeros(())) == (False, True)


def test_ticks_are_the_samples_at_multiples_of_the_period():
    times = np.arange(0, 1001) / 1000
    assert _sample_indices(times, jnp.asarray(0.01)).tolist() == list(range(0, 1001, 10))
    assert _sample_indices(times, None).tolist() == list(range(MAX_STEPS))
