"""Modal coordinates from deflections by the mode shapes, rates by differences."""

import dataclasses
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.controller import Measurement
from jaxbeam.case.estimator import AbstractEstimator, Estimate
from jaxbeam.case.fields import POSITIVE, known, number
from jaxbeam.estimation.constant_gain import offsets
from jaxbeam.estimation.observability import (
    UNSEEN,
    ConditioningWarning,
    conditioning,
    deflection_rows,
    deflections,
)
from jaxbeam.estimation.sampled_plant import Transition, ticks
from jaxbeam.numerics.discretisation import balance

WORST = 100.0  # conditioning beyond which there is a warning


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

    def init(self, model):
        plant = model.unloaded
        rows = deflection_rows(plant)
        modes, size = rows.shape[1], 2 * rows.shape[1]
        inverse = jnp.zeros((modes, plant.C.shape[0]))
        inverse = inverse.at[:, deflections(plant)].set(jnp.linalg.pinv(rows))
        clock, own = ticks(model.case.controller), None
        if plant.A.shape[0] > size:
            # The states of actuators see the beam's, held, and then the commands, as inputs.
            inputs = jnp.concatenate([plant.A[size:, :size], plant.B[size:]], axis=1)
            inner = plant.A[size:, size:]
            still, scale = jnp.zeros_like(inner), balance(inner)
            own = clock.transition(lambda t: (inner, inputs), still, scale)
        lag = 0.0 if self.time_constant is None else jnp.exp(-clock.period / self.time_constant)
        share = (1 - jnp.asarray(lag, float)) / clock.period
        state, command = jnp.zeros(plant.A.shape[0]), jnp.zeros(plant.B.shape[1])
        return Inverted(inverse, share, clock.period, own, offsets(model), state, command)

    def step(self, memory, measurement, t):
        memory = memory.fitted(measurement)
        return Estimate(memory.state), memory

    def fault(self, case, plant):
        if not any(sensor.quantity == "deflection" for sensor in case.sensors):
            return "kind needs sensors of deflection; add one, or take kind 'kalman'"
        if plant is None:
            return None
        rows = known(deflection_rows(plant))
        size = np.linalg.norm(rows, axis=0)
        if np.any(size < UNSEEN * size.max()) or known(conditioning(plant)) > 1 / UNSEEN:
            return (
                f"kind needs sensors of deflection that tell all {size.size} modes apart; move"
                " one off the nodes of the modes, or design for fewer modes"
            )
        worst = float(known(conditioning(plant)))
        if worst > WORST:
            warnings.warn(
                f"the sensors of deflection hardly tell some modes apart: errors of readings grow"
                f" {worst:.3g} times; move sensors, or design for fewer modes",
                ConditioningWarning,
                stacklevel=2,
            )
        return None


class Inverted(eqx.Module):
    """Memory of the inversion: its design, the state it found last, the command before.

    `share` (1/s) is the weight of a difference in the rates, `period` (s) that between ticks;
    `own` takes the states of the actuators on, None if they have none.
    """

    inverse: Float[Array, "mode sensor"]
    share: Float[Array, ""]
    period: Float[Array, ""]
    own: Transition | None
    offset: Float[Array, " sensor"]
    state: Float[Array, " state"]
    command: Float[Array, " actuator"]

    def fitted(self, measurement: Measurement) -> "Inverted":
        """The memory after the next tick."""
        modes, now = self.inverse.shape[0], measurement.command
        before, rates = self.state[:modes], self.state[modes : 2 * modes]
        places = self.inverse @ (measurement.readings - self.offset)
        kept = 1 - self.share * self.period
        parts = [places, kept * rates + self.share * (places - before)]
        if self.own is not None:
            beam, own = self.state[: 2 * modes], self.state[2 * modes :]
            inputs = (jnp.concatenate([beam, command]) for command in (self.command, now))
            parts.append(self.own.mean(own, *inputs))
        return dataclasses.replace(self, state=jnp.concatenate(parts), command=now)
