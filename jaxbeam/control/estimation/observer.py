"""Observers of constant gain, by poles or stationary Kalman filters; filters in continuous time.

Filters in continuous time are integrated together with the plant:

    x' = A(t) x + B u + L(t) (y - C x - D u - offset).
"""

import abc
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import (
    AbstractContinuousFilter,
    AbstractEstimator,
    AbstractSampledFilter,
    Estimate,
)
from jaxbeam.case.fields import POSITIVE, concrete, number
from jaxbeam.control.estimation.observability import mode_count, observability_error
from jaxbeam.control.estimation.sampled_plant import FilteredPlant, SampleTiming, Transition
from jaxbeam.model.state_space import Plant, StateSpace
from jaxbeam.numerics.finite_horizon import GainTable
from jaxbeam.numerics.riccati import care, dare
from jaxbeam.numerics.stages import balance, c2d, differentiable_balance
from jaxbeam.runtime.arrays import Array, Number, set_at, solve, xp


class AbstractLinearFilter(AbstractContinuousFilter):
    """Linear filter x' = A(t) x + B u + L(t) (y - C x - D u - offset), from x = `initial`.

    The states that are integrated are x - `initial`. The first `plant_states` states x are those of
    the plant; states of analogue filters may follow.
    """

    offset: Float[Array, " sensor"]
    initial: Float[Array, " state"]
    plant_states: int = eqx.field(static=True)

    @property
    def state_count(self):
        return self.initial.shape[0]

    @abc.abstractmethod
    def system_at(self, t: Float[Array, ""]) -> StateSpace:
        """A, B, C and D at t (s); the outputs are the inputs of the sensors."""

    @abc.abstractmethod
    def gain_at(self, t: Float[Array, ""]) -> Float[Array, "state sensor"]:
        """Gain L at t (s)."""

    def estimate(self, state, measurement, t):
        return Estimate((self.initial + state)[: self.plant_states])

    def rates(self, state, measurement, command, t):
        system, x = self.system_at(t), self.initial + state
        innovation = measurement.readings - self.offset - system.C @ x - system.D @ command
        return system.A @ x + system.B @ command + self.gain_at(t) @ innovation


class TimeInvariantFilter(AbstractLinearFilter):
    """Filter for a plant without loads, with a constant gain."""

    system: StateSpace
    gain: Float[Array, "state sensor"]

    def system_at(self, t):
        return self.system

    def gain_at(self, t):
        return self.gain


class ContinuousCrossingFilter(AbstractLinearFilter):
    """Filter for a plant with its moving loads, with a gain that varies over the run.

    States of vehicles and weights of the loads are the last states x; the estimate includes the
    weights if `estimates_weights`. `dual_gain` is the transposed gain over the time back from the
    end of the run, of `duration` (s).
    """

    filtered: FilteredPlant
    dual_gain: GainTable
    duration: Float[Array, ""]
    estimates_weights: bool = eqx.field(static=True)

    def system_at(self, t):
        return self.filtered.with_filtered_outputs(self.filtered.plant.augmented(t))

    def gain_at(self, t):
        return self.dual_gain(1 - t / self.duration).T

    def estimate(self, state, measurement, t):
        estimate = super().estimate(state, measurement, t)
        x = (self.initial + state)[self.filtered.plant.modal_model.state_count :]
        return with_loads(self.filtered.plant, estimate.state, x, t, self.estimates_weights)


class ConstantGainFilter(AbstractSampledFilter):
    """Filter x = prediction + gain (y - C prediction - D u - offset) of constant gain.

    The prediction is by the `transition` of a period.

    A missing reading corrects nothing.

    The first `plant_states` states x are those of the plant; states of the sensors may follow. The
    state of the filter is x and the command of the last sample.
    """

    without_reading: ClassVar[str] = (
        "The estimate is predicted by the model, and not corrected by it."
    )

    transition: Transition
    C: Float[Array, "sensor state"]
    D: Float[Array, "sensor actuator"]
    offset: Float[Array, " sensor"]
    gain: Float[Array, "state sensor"]
    plant_states: int = eqx.field(static=True)

    def initial_state(self):
        return xp.zeros(self.C.shape[1]), xp.zeros(self.D.shape[1])

    def update(self, state, measurement, t):
        x, command = state[0], measurement.command
        x = self.transition.predict(x, state[1], command)
        innovation = measurement.innovation(self.offset + self.C @ x + self.D @ command)
        x = x + self.gain @ innovation
        return Estimate(x[: self.plant_states]), (x, command)


def sensor_offsets(plant: Plant) -> Float[Array, " sensor"]:
    """Offsets of the sensors, in the units of their quantities."""
    return xp.array([sensor.offset for sensor in plant.case.sensors]).reshape(-1)


Square = Float[Array, "state state"]
Rows = Float[Array, "output state"]
Outputs = Float[Array, "output output"]
Gain = tuple[Float[Array, "state output"], Square]


def kalman_gain(A: Square, C: Rows, Q: Square, R: Outputs) -> Gain:
    """Gain L of the filter x' = A x + B u + L (y - C x) in continuous time, and its covariance P.

    Q and R are the intensities of the white noise of x' and of y. Eqs (4.5) and (4.6) of the
    thesis, corrected: L = P C' R^-1, A P + P A' - P C' R^-1 C P + Q = 0. Differentiable. Raises
    ValueError as `riccati.care` does.
    """
    covariance = care(A.T, C.T, Q, R)
    return solve(R, C @ covariance).T, covariance


def sampled_kalman_gain(A: Square, C: Rows, Q: Square, R: Outputs) -> Gain:
    """Gain K of the sampled filter, which adds K (y - C x) to a prediction x, and its covariance.

    x_(k+1) = A x_k + B u_k + w, y = C x + v with covariances Q of w and R of v. The covariance is
    that of the prediction. Differentiable. Raises ValueError as `riccati.dare` does.
    """
    covariance = dare(A.T, C.T, Q, R)
    return filter_gain(covariance, C, R), covariance


def filter_gain(covariance: Square, C: Rows, R: Outputs) -> Float[Array, "state output"]:
    """Gain K = P C' (C P C' + R)^-1 for a prediction of covariance P."""
    return solve(C @ covariance @ C.T + R, C @ covariance).T


def placed_gain(A: Square, C: Rows, desired: Square) -> Float[Array, "state output"]:
    """Gain L by which A - L C has the eigenvalues of the matrix `desired`; differentiable.

    From A'X - X desired = C'C and L' = C X^-1 (Bhattacharyya and de Souza, Systems & Control
    Letters 1, 1982). A and `desired` must have no common eigenvalue, and both be observable through
    C; otherwise the result is NaN or meaningless.
    """
    scale = differentiable_balance(A)  # the weight of each of several outputs depends on it
    A, desired = A * scale / scale[:, None], desired * scale / scale[:, None]
    rows = C * scale
    row_norms = xp.sqrt(xp.sum(rows**2, axis=1))
    rows = rows / row_norms[:, None]
    identity = xp.eye(A.shape[0])
    sylvester = xp.kron(A.T, identity) - xp.kron(identity, desired.T)
    X = solve(sylvester, (rows.T @ rows).reshape(-1)).reshape(A.shape)
    return scale[:, None] * solve(X.T, rows.T) / row_norms


class Observer(AbstractEstimator):
    """Luenberger observer of the plant without loads: prediction plus gain times innovation.

    The error in the states of the beam decays with the given `poles`, or with those of the beam
    times `speed` (eq. 4.4 of the thesis; sampled, a pole p becomes exp(p period)). States of
    actuators follow from the commands, uncorrected. Loads are not modelled and bias the estimate;
    nor are filters and delays of the sensors. A missing reading corrects nothing.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.LQR(
    ...         state_weight=[1e6, 1.0],
    ...         command_weight=[1e-2],
    ...         period=0.005,
    ...         estimator=jb.Observer(speed=3.0),
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.690 mm
    """

    kind: ClassVar[str] = "observer"
    continuous_time: ClassVar[bool] = True

    poles: Float[Number, "mode 2"] | None = number(
        "1/s", "real and imaginary part of a pair of poles for each mode", default=None
    )
    speed: Float[Number, ""] | None = number(
        "1", "ratio of the poles to those of the beam", POSITIVE, default=None
    )

    def sampled_filter(self, plant, timing):
        system = plant.unloaded
        no_noise = xp.zeros_like(system.A)
        transition = timing.transition(lambda t: (system.A, system.B), no_noise, balance(system.A))
        gain = self.gain(system, transition.matrix, timing)
        return ConstantGainFilter(
            transition, system.C, system.D, sensor_offsets(plant), gain, system.A.shape[0]
        )

    def continuous_filter(self, plant):
        system = plant.unloaded
        gain = _modal_placed_gain(system.A, system.C, self.desired_matrix(system))
        initial = xp.zeros(system.A.shape[0])
        return TimeInvariantFilter(sensor_offsets(plant), initial, initial.size, system, gain)

    def gain(
        self,
        system: StateSpace,
        transition_matrix: Float[Array, "state state"],
        timing: SampleTiming,
    ) -> Float[Array, "state sensor"]:
        """Gain for a plant with this transition matrix of its states over a period."""
        desired, _ = c2d(
            self.desired_matrix(system), xp.zeros((2 * mode_count(system), 1)), timing.period
        )
        return _modal_placed_gain(transition_matrix, system.C @ transition_matrix, desired)

    def desired_matrix(self, system: StateSpace) -> Float[Array, "modal modal"]:
        """State matrix (1/s) with the desired poles of the error."""
        modes = mode_count(system)
        if self.poles is None:
            return self.speed * system.A[: 2 * modes, : 2 * modes]
        stiffness, real_parts = xp.diag(xp.sum(self.poles**2, axis=1)), xp.diag(self.poles[:, 0])
        return xp.block([[xp.zeros((modes, modes)), xp.eye(modes)], [-stiffness, 2 * real_parts]])

    def validate(self, case, system):
        if (self.poles is None) == (self.speed is None):
            return "poles or speed must be given, and not both"
        if system is None:
            return None
        modes = mode_count(system)
        if self.poles is not None and self.poles.shape[0] != modes:
            return f"poles must list a pair for each of {modes} modes, not {self.poles.shape[0]}"
        if self.poles is not None and np.any(concrete(self.poles)[:, 0] >= 0):
            return "poles must have negative real parts, for the error to decay"
        if self.speed is not None and concrete(self.speed) <= 1:
            return "speed must be above 1"
        if self.speed is not None:
            poles = np.linalg.eigvals(concrete(system.A)[: 2 * modes, : 2 * modes])
            if np.max(poles.real) > -1e-9 * np.max(np.abs(poles)):
                return "speed must not be used on a beam without damping; give poles instead"
        return observability_error(system)


def _modal_placed_gain(A, C, desired) -> Float[Array, "state sensor"]:
    """Gain by which the error of the first states, those of the beam, has the matrix `desired`."""
    modal = desired.shape[0]
    gain = placed_gain(A[:modal, :modal], C[:, :modal], desired)
    return set_at(xp.zeros((A.shape[0], C.shape[0])), np.s_[:modal], gain)


def with_loads(plant: Plant, state, added, t, with_weights: bool) -> Estimate:
    """Estimate of a plant from the states that `Plant.augmented` adds, at t (s).

    It has the weights only `with_weights`; they are zero for wheels off the beam.
    """
    count = plant.vehicle_states
    vehicles = added[:count] if count else None
    if not with_weights:
        return Estimate(state, vehicles=vehicles)
    weights = added[count : count + plant.weights.shape[0]]
    return Estimate(state, xp.where(plant.loads.on_beam(t), weights, 0.0), vehicles)
