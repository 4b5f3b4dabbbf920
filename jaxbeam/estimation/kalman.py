"""Kalman filters at the ticks of a controller: time-invariant, or along a crossing."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.controller import Measurement
from jaxbeam.estimation.fixed import at_rest, offsets
from jaxbeam.estimation.gains import filter_gain, sampled_kalman_gain
from jaxbeam.estimation.observability import modes_of, unseen_fault
from jaxbeam.estimation.sampled import Ticks, ticks
from jaxbeam.estimator import AbstractEstimator, Estimate
from jaxbeam.fields import POSITIVE, choice, is_known, known, number
from jaxbeam.holds import balance
from jaxbeam.statespace import LoadedBeam
from jaxbeam.stretches import symmetric

Square = Float[Array, "state state"]


class Kalman(AbstractEstimator):
    """The estimate of least variance, if noise and model are as stated.

    White forces of intensity `process_noise` act on the (mass-normalised) modes; each reading has
    white noise of standard deviation `measurement_noise`. The `loads` are "ignored", and the
    filter is time-invariant; or "known": model and gain follow them along the beam; or their
    weights are "estimated" too, starting from what the design believes of them with standard
    deviation `weight_deviation`. When and how fast they cross, and their inertia, are known.

    The beam is at rest one period before the first tick. Filters, delays and clocks of sensors are
    not modelled, nor is what the white forces do to an accelerometer at once.
    """

    process_noise: Float[Array, " *mode"] = number(
        "N^2 s/kg", "intensity of the white force on each mode", POSITIVE
    )
    measurement_noise: Float[Array, " *sensor"] | None = number(
        "unit of quantity",
        "standard deviation of readings; that of the sensors if left out",
        POSITIVE,
        default=None,
    )
    loads: str = choice("what of the loads", "ignored", "known", "estimated", default="ignored")
    weight_deviation: Float[Array, " *load"] | None = number(
        "N", "standard deviation of the weights as believed", POSITIVE, default=None
    )

    def init(self, model):
        intensity, covariance = self.intensity(model), self.reading_covariance(model)
        clock = ticks(model.case.controller)
        if self.loads == "ignored":
            plant = model.unloaded
            transition = clock.transition(lambda t: (plant.A, plant.B), intensity, balance(plant.A))
            gain, _ = sampled_kalman_gain(transition.drift, plant.C, transition.noise, covariance)
            return at_rest(model, plant, transition, gain)
        states, loads = intensity.shape[0], len(model.case.loads)
        spread = jnp.zeros(loads)
        if self.weight_deviation is not None:
            spread = jnp.broadcast_to(self.weight_deviation**2, (loads,))
        return Crossing(
            model,
            clock,
            jnp.append(balance(model.unloaded.A), jnp.ones(loads)),
            jnp.pad(intensity, (0, loads)),
            covariance,
            jnp.concatenate([jnp.zeros(states), model.weights]),
            jnp.diag(jnp.concatenate([jnp.zeros(states), spread])),
            jnp.zeros(len(model.case.actuators)),
        )

    def step(self, memory, measurement, t):
        if self.loads == "ignored":
            memory = memory.corrected(measurement)
            return Estimate(memory.state), memory
        memory = memory.corrected(measurement, t)
        state, weights = jnp.split(memory.state, [memory.model.rig.states])
        if self.loads == "known":
            return Estimate(state), memory
        return Estimate(state, jnp.where(memory.model.traffic.on_beam(t), weights, 0.0)), memory

    def intensity(self, model: LoadedBeam) -> Square:
        """Intensity of the white noise in the rates of the states."""
        modes = model.scale.shape[0]
        force = self.process_noise * model.scale**2
        own = jnp.zeros(model.rig.states - 2 * modes)
        return jnp.diag(jnp.concatenate([jnp.zeros(modes), force, own]))

    def reading_covariance(self, model: LoadedBeam) -> Float[Array, "sensor sensor"]:
        """Covariance of the noise of the readings."""
        sensors = model.case.sensors
        if self.measurement_noise is None:
            return jnp.diag(jnp.stack([sensor.noise_covariance for sensor in sensors]))
        return jnp.diag(jnp.broadcast_to(self.measurement_noise**2, (len(sensors),)))

    def fault(self, case, plant):
        if not case.sensors:
            return "kind needs sensors; add one"
        if self.measurement_noise is None:
            for i, sensor in enumerate(case.sensors):
                if sensor.noise is None or (is_known(sensor.noise) and known(sensor.noise) == 0):
                    return f"measurement_noise must be given, as sensors.{i} has no noise"
        if self.loads != "ignored" and not case.loads:
            return "loads must be 'ignored': there are none"
        if (self.loads == "estimated") != (self.weight_deviation is not None):
            return "weight_deviation and loads = 'estimated' belong together; give both or neither"
        sizes = {"measurement_noise": len(case.sensors), "weight_deviation": len(case.loads)}
        if plant is not None:
            sizes["process_noise"] = modes_of(plant)
        for name, size in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape not in ((), (size,)):
                return f"{name} must be one number or {size}, not {value.shape[0]}"
        return None if plant is None else unseen_fault(plant)


class Prediction(NamedTuple):
    """What is expected at a tick, before its readings are looked at, each with its covariance."""

    state: Float[Array, " state"]
    covariance: Square
    readings: Float[Array, " sensor"]
    spread: Float[Array, "sensor sensor"]
    C: Float[Array, "sensor state"]


class Crossing(eqx.Module):
    """Memory of a filter along a crossing; the weights of the loads are its last states.

    `scale` is the size of the states, `intensity` that of the white noise in their rates, `noise`
    the covariance of that in the readings.
    """

    model: LoadedBeam
    clock: Ticks
    scale: Float[Array, " state"]
    intensity: Square
    noise: Float[Array, "sensor sensor"]
    state: Float[Array, " state"]
    covariance: Square
    command: Float[Array, " actuator"]

    def predicted(self, command: Float[Array, " actuator"], t: Float[Array, ""]) -> Prediction:
        """What is expected at the tick at t (s), the given command having acted until then."""

        def plant(time):
            system = self.model.augmented(time)
            return system.A, system.B

        transition = self.clock.transition(plant, self.intensity, self.scale, t)
        state = transition.mean(self.state, self.command, command)
        covariance = transition.covariance(self.covariance)
        now = self.model.augmented(t)
        readings = now.C @ state + now.D @ command + offsets(self.model)
        spread = now.C @ covariance @ now.C.T + self.noise
        return Prediction(state, covariance, readings, spread, now.C)

    def corrected(self, measurement: Measurement, t: Float[Array, ""]) -> "Crossing":
        """The memory after the tick at t (s)."""
        expected = self.predicted(measurement.command, t)
        gain = filter_gain(expected.covariance, expected.C, self.noise)
        state = expected.state + gain @ (measurement.readings - expected.readings)
        # Joseph's form: symmetric and not negative, whatever the rounding.
        left = jnp.eye(state.shape[0]) - gain @ expected.C
        covariance = left @ expected.covariance @ left.T + gain @ self.noise @ gain.T
        return dataclasses.replace(
            self, state=state, covariance=symmetric(covariance), command=measurement.command
        )
