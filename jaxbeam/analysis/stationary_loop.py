"""Loop with loads at rest as a linear system, its filters settled.

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

from jaxbeam.analysis.frozen_loop import (
    FrozenTrajectory,
    LoopDynamics,
    frozen_loads,
    loop_dynamics,
)
from jaxbeam.analysis.linearised_loop import LinearisedLoop, linearise, loop_timing
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.controller import AbstractSampledFilter, LawOfCommanded
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.point import MovingMass
from jaxbeam.case.trajectory import NEVER
from jaxbeam.control.state_controller import SampledStateLaw
from jaxbeam.estimation.crossing_filter import CrossingFilter, FilterState, SampleModel
from jaxbeam.estimation.observer import sampled_kalman_gain
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.arrays import Array, xp


class SettledFilter(AbstractSampledFilter):
    """Filter of crossing loads, settled at t (s): a constant `gain`, the `model` of one sample."""

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
    """The law with its filter of crossing loads settled, under loads that stay as at t (s).

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


ROUNDING = 1e-14  # of the entries of a constant state in a matrix of a loop


def stationary_loops(case: Case, times) -> list[LinearisedLoop]:
    """Loops of a case with its loads stationary at their positions of some times (s).

    They are linearised about the equilibrium under the loads. Raises ValueError as
    `linearised_loop`.
    """
    timing = loop_timing(case)
    loop = loop_dynamics(case, mesh_layout(concrete_case(case)))
    return [
        without_constant_states(linearise(_with_stationary_loads(loop, t), timing, xp.asarray(t)))
        for t in times
    ]


def loop_with_mass_at(case: Case, position: float, mass: float) -> LinearisedLoop:
    """Loop of a case with one stationary mass (kg) at a position (m), and without its loads.

    The law is that of the case, at the time at which the first load of the case is there: a
    schedule has the gains of that time. It is linearised about the equilibrium under the mass.
    Raises ValueError for a position off the beam, a negative mass, and as `linearised_loop`.
    """
    loads = standing_mass(case, position, mass)
    timing = loop_timing(case)
    loop = loop_dynamics(case, mesh_layout(concrete_case(case)))
    loop = eqx.tree_at(lambda loop: loop.augmented_plant.loads, loop, loads)
    t = xp.asarray(_passage_time(case, position))
    return without_constant_states(linearise(loop, timing, t))


def standing_mass(case: Case, position: float, mass: float) -> LoadSet:
    """Load set of a stationary mass (kg) at a position (m) in place of the loads of a case.

    Raises ValueError for a position off the beam, and a mass that is negative or not finite.
    """
    length = float(concrete(case.beam.length))
    if not 0 <= position <= length:
        raise ValueError(f"the mass at {position:g} m is off the beam, 0 to {length:g} m")
    if not 0 <= mass < np.inf:
        raise ValueError(f"the mass at {position:g} m must be positive, in kg; it is {mass:g}")
    alone = dataclasses.replace(case, loads=(MovingMass(mass=mass, speed=1.0),), profile=None)
    zero, one = xp.zeros(()), xp.ones(())
    path = FrozenTrajectory(
        xp.asarray(position), zero, zero, one, xp.ones(1, bool), case.beam.length
    )
    loads = load_set(alone)
    paths = path, *loads.trajectories[1:]  # of absorbers
    return dataclasses.replace(loads, trajectories=paths, profile=None)


def without_constant_states(loop: LinearisedLoop) -> LinearisedLoop:
    """Sampled loop without constant states, such as those of a completed load identification."""
    if loop.period is None:
        return loop
    size = loop.A.shape[0]
    unchanged = np.abs(np.asarray(loop.A) - np.eye(size)) <= ROUNDING
    constant = np.all(unchanged, axis=1) & ~np.any(loop.B, axis=1)
    kept = ~constant
    return LinearisedLoop(
        loop.A[kept][:, kept], loop.B[kept], loop.K[:, kept], loop.period, loop.modal_states
    )


def _with_stationary_loads(loop: LoopDynamics, t: float) -> LoopDynamics:
    """Loop with stationary loads at their positions of t (s), and a filter settled under them.

    Raises ValueError for a filter that does not settle.
    """
    length, zero = loop.plant.case.beam.length, xp.zeros(())

    def stationary(loads: LoadSet) -> LoadSet:
        frozen = frozen_loads(loads, length, xp.asarray(t))
        paths = tuple(
            dataclasses.replace(path, speed=zero, acceleration=zero) for path in frozen.trajectories
        )
        return eqx.tree_at(lambda loads: loads.trajectories, frozen, paths)

    law = settled_law(loop.law, np.float64(t), stationary)
    loads = stationary(loop.augmented_plant.loads)
    return eqx.tree_at(lambda loop: (loop.law, loop.augmented_plant.loads), loop, (law, loads))


def _passage_time(case: Case, position: float) -> float:
    """Time (s) at which the first wheel of the first load is at a position (m); 0 if never."""
    trajectories = load_set(case).trajectories
    if not trajectories:
        return 0.0
    passage, *_ = concrete(trajectories[0].passage_times(xp.asarray([position])))
    return float(passage) if abs(passage) < NEVER else 0.0
