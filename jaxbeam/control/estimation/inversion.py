"""Modal coordinates from deflections by inverting the mode shapes, rates by differences."""

import warnings
from typing import ClassVar, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import AbstractEstimator, AbstractSampledFilter, Estimate
from jaxbeam.case.fields import POSITIVE, concrete, number
from jaxbeam.control.estimation.observability import (
    UNOBSERVABLE,
    ConditioningWarning,
    conditioning,
    deflection_mode_shapes,
    deflection_outputs,
)
from jaxbeam.control.estimation.observer import sensor_offsets
from jaxbeam.control.estimation.sampled_plant import Transition
from jaxbeam.numerics.stages import balance
from jaxbeam.runtime.arrays import Array, Number, set_at, xp

MAX_CONDITION_NUMBER = 100.0  # of the mode shapes at the sensors; beyond, there is a warning


class Inversion(AbstractEstimator):
    """Modal coordinates q that fit the deflection readings best, eq. (4.8) of the thesis.

    By least squares where there are more sensors of deflection than modes; the least-norm solution
    where there are fewer. Other sensors are not used. Rates are differences between samples,
    smoothed by a first-order lag of `time_constant`. States of actuators follow from the commands.
    Loads are not modelled. While a deflection is missing coordinates and rates stay; the next
    difference is over the time since the last complete readings.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.LQR(
    ...         state_weight=[1e5, 1.0],
    ...         command_weight=[1e-2],
    ...         estimator=jb.Inversion(time_constant=0.005),
    ...         period=0.005,
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.531 mm
    """

    kind: ClassVar[str] = "inversion"

    time_constant: Float[Number, ""] | None = number(
        "s", "time constant of the lag that smooths the rates", POSITIVE, default=None
    )

    def sampled_filter(self, plant, timing):
        system = plant.unloaded
        rows = deflection_mode_shapes(system)
        modes, modal_states = rows.shape[1], 2 * rows.shape[1]
        inverse = xp.zeros((modes, system.C.shape[0]))
        inverse = set_at(inverse, np.s_[:, deflection_outputs(system)], xp.linalg.pinv(rows))
        actuator_transition = None
        if system.A.shape[0] > modal_states:
            # Inputs of the states of actuators are the states of the beam, held, then the commands.
            inputs = xp.concatenate(
                [system.A[modal_states:, :modal_states], system.B[modal_states:]], axis=1
            )
            actuator_matrix = system.A[modal_states:, modal_states:]
            no_noise, scale = xp.zeros_like(actuator_matrix), balance(actuator_matrix)
            actuator_transition = timing.transition(
                lambda t: (actuator_matrix, inputs), no_noise, scale
            )
        smoothing = (
            0.0 if self.time_constant is None else xp.exp(-timing.period / self.time_constant)
        )
        difference_gain = (1 - xp.asarray(smoothing, float)) / timing.period
        plant_states, commands = system.B.shape
        return InversionFilter(
            inverse,
            difference_gain,
            timing.period,
            actuator_transition,
            sensor_offsets(plant),
            plant_states,
            commands,
            tuple(int(i) for i in deflection_outputs(system)),
        )

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
                f"kind needs sensors of deflection that distinguish all {column_norms.size} modes;"
                " move one off the nodes of the modes, or design for fewer modes"
            )
        condition_number = float(concrete(conditioning(system)))
        if condition_number > MAX_CONDITION_NUMBER:
            warnings.warn(
                f"the modes are ill-conditioned at the sensors of deflection: errors of readings"
                f" grow {condition_number:.3g} times; move sensors, or design for fewer modes",
                ConditioningWarning,
                stacklevel=2,
            )
        return None


class InversionState(NamedTuple):
    """Estimate x, last command, and periods to the next sample since the readings that x has."""

    x: Float[Array, " state"]
    command: Float[Array, " actuator"]
    periods: Float[Array, ""]


class InversionFilter(AbstractSampledFilter):
    """Inverse of the mode shapes, and lagged differences.

    `difference_gain` (1/s) is the weight of a difference of coordinates in the rates, `period` (s)
    the time between samples; `actuator_transition` is that of the states of actuators over a
    period, None if there are none.
    """

    without_reading: ClassVar[str] = "The estimate stays while a deflection is missing."

    mode_shape_inverse: Float[Array, "mode sensor"]
    difference_gain: Float[Array, ""]
    period: Float[Array, ""]
    actuator_transition: Transition | None
    offset: Float[Array, " sensor"]
    plant_states: int = eqx.field(static=True)
    commands: int = eqx.field(static=True)
    sensors: tuple[int, ...] = eqx.field(static=True)

    def initial_state(self):
        return InversionState(xp.zeros(self.plant_states), xp.zeros(self.commands), xp.ones(()))

    def update(self, state, measurement, t):
        x, previous_command, periods = state
        modes, command = self.mode_shape_inverse.shape[0], measurement.command
        previous, rates = x[:modes], x[modes : 2 * modes]
        coordinates = self.mode_shape_inverse @ (measurement.readings - self.offset)
        smoothing = 1 - self.difference_gain * self.period
        change = coordinates - previous
        if measurement.present is None:
            periods = xp.ones(())
        else:
            complete, change = measurement.complete(self.sensors), change / periods
            periods = xp.where(complete, 1.0, periods + 1)
        parts = [coordinates, smoothing * rates + self.difference_gain * change]
        if measurement.present is not None:
            pairs = zip(parts, (previous, rates), strict=True)
            parts = [xp.where(complete, *pair) for pair in pairs]
        if self.actuator_transition is not None:
            beam, actuator_states = x[: 2 * modes], x[2 * modes :]
            inputs = (xp.concatenate([beam, each]) for each in (previous_command, command))
            parts.append(self.actuator_transition.predict(actuator_states, *inputs))
        x = xp.concatenate(parts)
        return Estimate(x), InversionState(x, command, periods)
