"""Modal coordinates from deflections by the mode shapes, rates by differences."""

import dataclasses
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.controller import Measurement
from jaxbeam.case.estimator import AbstractEstimator, Estimate
from jaxbeam.case.fields import POSITIVE, concrete, number
from jaxbeam.estimation.constant_gain import sensor_offsets
from jaxbeam.estimation.observability import (
    UNOBSERVABLE,
    ConditioningWarning,
    conditioning,
    deflection_mode_shapes,
    deflection_outputs,
)
from jaxbeam.estimation.sampled_plant import Transition, sample_timing
from jaxbeam.numerics.discretisation import balance

MAX_CONDITION_NUMBER = 100.0  # conditioning beyond which there is a warning


class Inversion(AbstractEstimator):
    """The coordinates q of the modes with which the deflections read fit best, eq. (4.8).

    By least squares where there are more sensors of deflection than modes; of all that fit, the
    ones with the least sum of squares where there are fewer. Other sensors are not used. Rates are
    differences between ticks, smoothed by a first-order lag of `time_constant`. States of
    actuators follow from the commands. It knows nothing of the loads, and needs not to.
    """

    time_constant: Float[Array, ""] | None = number(
        "s", "of the lag that smooths the rates", POSITIVE, default=None
    )

    def init(self, plant):
        system = plant.unloaded
        rows = deflection_mode_shapes(system)
        modes, modal_states = rows.shape[1], 2 * rows.shape[1]
        inverse = jnp.zeros((modes, system.C.shape[0]))
        inverse = inverse.at[:, deflection_outputs(system)].set(jnp.linalg.pinv(rows))
        timing, actuator_transition = sample_timing(plant.case.controller), None
        if system.A.shape[0] > modal_states:
            # The states of actuators see the beam's, held, and then the commands, as inputs.
            inputs = jnp.concatenate(
                [system.A[modal_states:, :modal_states], system.B[modal_states:]], axis=1
            )
            inner = system.A[modal_states:, modal_states:]
            no_noise, scale = jnp.zeros_like(inner), balance(inner)
            actuator_transition = timing.transition(lambda t: (inner, inputs), no_noise, scale)
        smoothing = (
            0.0 if self.time_constant is None else jnp.exp(-timing.period / self.time_constant)
        )
        difference_gain = (1 - jnp.asarray(smoothing, float)) / timing.period
        state, command = jnp.zeros(system.A.shape[0]), jnp.zeros(system.B.shape[1])
        return InversionState(
            inverse,
            difference_gain,
            timing.period,
            actuator_transition,
            sensor_offsets(plant),
            state,
            command,
        )

    def step(self, memory, measurement, t):
        memory = memory.fitted(measurement)
        return Estimate(memory.state), memory

    def validate(self, case, system):
        if not any(sensor.quantity == "deflection" for sensor in case.sensors):
            return "kind needs sensors of deflection; add one, or take kind 'kalman'"
        if system is None:
            return None
        rows = concrete(deflection_mode_shapes(system))
        column_norms = np.linalg.norm(rows, axis=0)
        if (
            np.any(column_norms < UNOBSERVABLE * column_norms.max())
            or concrete(conditioning(system)) > 1 / UNOBSERVABLE
        ):
            return (
                f"kind needs sensors of deflection that tell all {column_norms.size} modes apart; move"
                " one off the nodes of the modes, or design for fewer modes"
            )
        condition_number = float(concrete(conditioning(system)))
        if condition_number > MAX_CONDITION_NUMBER:
            warnings.warn(
                f"the sensors of deflection hardly tell some modes apart: errors of readings grow"
                f" {condition_number:.3g} times; move sensors, or design for fewer modes",
                ConditioningWarning,
                stacklevel=2,
            )
        return None


class InversionState(eqx.Module):
    """Memory of the inversion: its design, the state it found last, the command before.

    `difference_gain` (1/s) is the weight of a difference in the rates, `period` (s) that between ticks;
    `actuator_transition` takes the states of the actuators on, None if they have none.
    """

    mode_shape_inverse: Float[Array, "mode sensor"]
    difference_gain: Float[Array, ""]
    period: Float[Array, ""]
    actuator_transition: Transition | None
    offset: Float[Array, " sensor"]
    state: Float[Array, " state"]
    command: Float[Array, " actuator"]

    def update(self, measurement: Measurement) -> "InversionState":
        """The memory after the next tick."""
        modes, current_command = self.mode_shape_inverse.shape[0], measurement.command
        before, rates = self.state[:modes], self.state[modes : 2 * modes]
        coordinates = self.mode_shape_inverse @ (measurement.readings - self.offset)
        smoothing = 1 - self.difference_gain * self.period
        parts = [coordinates, smoothing * rates + self.difference_gain * (coordinates - before)]
        if self.actuator_transition is not None:
            beam, actuator_states = self.state[: 2 * modes], self.state[2 * modes :]
            inputs = (
                jnp.concatenate([beam, command]) for command in (self.command, current_command)
            )
            parts.append(self.actuator_transition.predict(actuator_states, *inputs))
        return dataclasses.replace(self, state=jnp.concatenate(parts), command=current_command)
