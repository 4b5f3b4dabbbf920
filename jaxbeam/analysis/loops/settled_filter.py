"""Kalman filters of crossing loads once they have settled under stationary loads.

The gain of a filter that follows its loads varies as they cross. With loads at rest it tends to a
constant one, and the loop is then time-invariant. Estimates of weights have settled, too: they no
longer change.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import LawOfCommanded
from jaxbeam.case.estimator import AbstractSampledFilter
from jaxbeam.control.state_law import SampledStateLaw
from jaxbeam.estimation.crossing_filter import CrossingFilter, FilterState, SampleModel
from jaxbeam.estimation.gains import sampled_kalman_gain
from jaxbeam.runtime.arrays import Array, xp


class SettledFilter(AbstractSampledFilter):
    """A filter of crossing loads with a constant `gain` and the `model` of one sample, at t (s)."""

    filter: CrossingFilter
    model: SampleModel
    gain: Float[Array, "state sensor"]
    t: Float[Array, ""]

    def initial_state(self):
        start = self.filter.initial_state()
        return start.x, start.command

    def update(self, state, measurement, t):
        x, command = state
        no_covariance = xp.zeros((len(x), len(x)))
        predicted = self.filter.predict(
            FilterState(x, no_covariance, command), measurement.command, self.t, self.model
        )
        x = predicted.x + self.gain @ measurement.innovation(predicted.readings)
        return self.filter.estimate(x, self.t), (x, measurement.command)


def settled_law(law: Any, t: Any, stationary: Any) -> Any:
    """The law whose filter of crossing loads has settled with its loads stationary as at t (s).

    `stationary` maps a set of loads to one that rests at its positions of t. A law without such a
    filter is returned as it is. Raises ValueError if the filter does not settle.
    """
    if isinstance(law, LawOfCommanded):
        return dataclasses.replace(law, law=settled_law(law.law, t, stationary))
    if not (isinstance(law, SampledStateLaw) and isinstance(law.filter, CrossingFilter)):
        parts = jax.tree.leaves(law, is_leaf=lambda part: isinstance(part, CrossingFilter))
        if any(isinstance(part, CrossingFilter) for part in parts):
            raise ValueError("the gain of the Kalman filter varies as the loads cross")
        return law
    filter = eqx.tree_at(lambda x: x.filtered.plant.loads, law.filter, replace_fn=stationary)
    transition, C, D = filter.model_at(t)
    gain = _settled_gain(transition, C, filter.sensor_chain.noise_covariance)
    return dataclasses.replace(law, filter=SettledFilter(filter, (transition, C, D), gain, t))


def _settled_gain(transition, C, noise_covariance) -> Float[np.ndarray, "state sensor"]:
    """Constant gain of a model; zero for constant states, such as weights.

    Raises ValueError if there is none.
    """
    matrix, noise = np.asarray(transition.matrix), np.asarray(transition.noise_covariance)
    constant = np.all(matrix == np.eye(len(matrix)), axis=1) & ~np.any(noise, axis=1)
    kept = ~constant
    gain = np.zeros((len(matrix), len(C)))
    gain[kept], _ = sampled_kalman_gain(
        matrix[np.ix_(kept, kept)], C[:, kept], noise[np.ix_(kept, kept)], noise_covariance
    )
    if not np.all(np.isfinite(gain)):
        raise ValueError("the Kalman filter has no constant gain under stationary loads")
    return gain
