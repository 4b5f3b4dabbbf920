"""Kalman filters at the ticks of a controller: time-invariant, or along a crossing."""

import dataclasses
import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.controller import Measurement
from jaxbeam.case.estimator import AbstractEstimator, Estimate
from jaxbeam.case.fields import POSITIVE, choice, concrete, count, is_concrete, number
from jaxbeam.estimation.constant_gain import constant_gain_filter, sensor_offsets
from jaxbeam.estimation.continuous import ContinuousEstimator
from jaxbeam.estimation.gains import filter_gain, kalman_gain, sampled_kalman_gain
from jaxbeam.estimation.observability import mode_count, observability_error
from jaxbeam.estimation.sampled_plant import PERIOD_ROUNDING, sample_timing
from jaxbeam.estimation.sensor_chain import FilteredPlant, SensorChain, filtered_plant, sensor_chain
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.finite_horizon import finite_horizon
from jaxbeam.numerics.intervals import symmetric_part

MAX_PHASE_PER_INTERVAL = 3.0  # rad by which the fastest mode may turn within a stretch of a table

Square = Float[Array, "state state"]


class Kalman(AbstractEstimator):
    """The estimate of least variance, if noise and model are as stated.

    White forces of intensity `process_noise` act on the (mass-normalised) modes; each reading has
    white noise of standard deviation `measurement_noise`. The `loads` are "ignored", and the
    filter is time-invariant; or "known": model and gain follow them along the beam; or their
    weights are "estimated" too, starting from what the design believes of them with standard
    deviation `weight_deviation`. When and how fast they cross, and their inertia, are known.

    Filters of the sensors and their delays are part of the model, so that its surprises are white;
    delays may `reach` over so many periods. Noise is that of the samples: behind a digital filter
    it is coloured. The beam is at rest one period before the first tick. Not modelled are clocks
    of the sensors' own, nor what the white forces do to an accelerometer at once.

    Without a period it acts at every instant (Kalman and Bucy): the noise of readings then has the
    `measurement_intensity`, which samples a period apart have with variance intensity / period; the
    beam is at rest at first. Along the crossing its gain is tabulated, with so many `points` from
    each entry or exit to the next, to 1e-8.
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
    reach: int = count("periods that delays of sensors reach back", default=1)
    measurement_intensity: Float[Array, " *sensor"] | None = number(
        "unit of quantity^2 s", "intensity of the noise of readings", POSITIVE, default=None
    )
    points: int = count("stretches of the gain from event to event", default=400)

    @property
    def continuous_time(self) -> bool:
        return True

    def init(self, plant):
        if plant.case.controller.period is None:
            return self._continuous(plant)
        filtered, timing = filtered_plant(plant), sample_timing(plant.case.controller)
        filtered_model, intensity = filtered.plant, self.noise_intensity(filtered.plant)
        states, loads = intensity.shape[0], len(plant.case.loads)
        variance, scale = self.reading_variance(plant), balance(filtered_model.unloaded.A)
        if self.loads == "ignored":
            system = filtered.with_filtered_outputs(filtered_model.unloaded)
            sensors = sensor_chain(plant, variance, timing, states, self.reach)
            transition = sensors.transition(lambda t: system, intensity, scale)
            C, D = sensors.output_matrices(system.C, system.D)
            gain, _ = sampled_kalman_gain(
                transition.matrix, C, transition.noise_covariance, sensors.noise_covariance
            )
            return constant_gain_filter(plant, transition, C, D, gain)
        sensors = sensor_chain(plant, variance, timing, states + loads, self.reach)
        weight_variance = jnp.zeros(loads)
        if self.weight_deviation is not None:
            weight_variance = jnp.broadcast_to(self.weight_deviation**2, (loads,))
        weight_states = jnp.zeros(sensors.state_count).at[states : states + loads]
        return CrossingFilter(
            filtered,
            sensors,
            plant.modal_model.states,
            jnp.append(scale, jnp.ones(loads)),
            jnp.pad(intensity, (0, loads)),
            weight_states.set(plant.weights),
            jnp.diag(weight_states.set(weight_variance)),
            jnp.zeros(len(plant.case.actuators)),
        )

    def _continuous(self, plant: Plant) -> ContinuousEstimator:
        """The filter at every instant."""
        filtered, count = filtered_plant(plant), len(plant.case.sensors)
        filtered_model, intensity = filtered.plant, self.noise_intensity(filtered.plant)
        noise = jnp.diag(jnp.broadcast_to(self.measurement_intensity, (count,)))
        states, loads = intensity.shape[0], len(plant.case.loads)
        offset, plant_states = sensor_offsets(plant), plant.modal_model.state_count
        if self.loads == "ignored":
            system = filtered.with_filtered_outputs(filtered_model.unloaded)
            gain, _ = kalman_gain(system.A, system.C, intensity, noise)
            return ContinuousEstimator(
                offset, jnp.zeros(states), plant_states, unloaded=system, gain=gain
            )
        weight_variance, zero_state = jnp.zeros(loads), jnp.zeros(states)
        if self.weight_deviation is not None:
            weight_variance = jnp.broadcast_to(self.weight_deviation**2, (loads,))
        end = plant.case.run.duration

        def dual_system(back):
            """The plant a time (s) before the end, as that of a regulator with the same gain."""
            plant = filtered.with_filtered_outputs(filtered_model.augmented(end - back))
            return plant.A.T, plant.C.T

        crossing_times = jnp.array(
            [path.entry_exit_times() for path in filtered_model.loads.trajectories]
        ).reshape(-1)
        events = jnp.concatenate([jnp.zeros(1), jnp.clip(crossing_times, 0.0, end), end[None]])
        initial_covariance, Q = (
            jnp.diag(jnp.append(zero_state, weight_variance)),
            jnp.pad(intensity, (0, loads)),
        )
        table = finite_horizon(
            dual_system, jnp.sort(end - events), self.points, Q, noise, initial_covariance
        )[0]
        return ContinuousEstimator(
            offset,
            jnp.append(zero_state, plant.weights),
            plant_states,
            filtered_plant=filtered,
            gain_table=table,
            duration=end,
            estimates_weights=self.loads == "estimated",
        )

    def step(self, memory, measurement, t):
        if self.loads == "ignored":
            memory = memory.corrected(measurement)
            return Estimate(memory.plant_state), memory
        memory = memory.corrected(measurement, t)
        if self.loads == "known":
            return Estimate(memory.plant_state), memory
        on_beam = memory.view.model.loads.on_beam(t)
        return Estimate(memory.plant_state, jnp.where(on_beam, memory.weights, 0.0)), memory

    def noise_intensity(self, plant: Plant) -> Square:
        """Intensity of the white noise in the rates of the states."""
        modes = plant.coordinate_scale.shape[0]
        force = self.process_noise * plant.coordinate_scale**2
        actuator_intensity = jnp.zeros(plant.modal_model.state_count - 2 * modes)
        return jnp.diag(jnp.concatenate([jnp.zeros(modes), force, actuator_intensity]))

    def reading_variance(self, plant: Plant) -> Float[Array, " sensor"]:
        """Variance of the noise of each reading."""
        sensors = plant.case.sensors
        if self.measurement_noise is None:
            return jnp.stack([sensor.noise_variance for sensor in sensors])
        return jnp.broadcast_to(self.measurement_noise**2, (len(sensors),))

    def validate(self, case, system):
        if not case.sensors:
            return "kind needs sensors; add one"
        period = case.controller.period
        if (period is None) != (self.measurement_intensity is not None):
            return "measurement_intensity must be given without a controller.period, and only then"
        if period is None and self.measurement_noise is not None:
            return "measurement_noise is that of samples; without a period leave it out"
        if period is not None and self.measurement_noise is None:
            for i, sensor in enumerate(case.sensors):
                if sensor.noise is None or (
                    is_concrete(sensor.noise) and concrete(sensor.noise) == 0
                ):
                    return f"measurement_noise must be given, as sensors.{i} has no noise"
        for i, sensor in enumerate(case.sensors):
            sampled = period is not None and sensor.delay is not None
            if sampled and is_concrete(sensor.delay) and is_concrete(period):
                delay_periods = math.ceil(
                    concrete(sensor.delay) / concrete(period) - PERIOD_ROUNDING
                )
                if delay_periods > self.reach:
                    return (
                        f"reach must be at least {delay_periods}, the periods of sensors.{i}.delay"
                    )
        if self.loads != "ignored" and not case.loads:
            return "loads must be 'ignored': there are none"
        if (self.loads == "estimated") != (self.weight_deviation is not None):
            return "weight_deviation and loads = 'estimated' belong together; give both or neither"
        sizes = {"measurement_noise": len(case.sensors), "weight_deviation": len(case.loads)}
        sizes["measurement_intensity"] = len(case.sensors)
        if system is not None:
            sizes["process_noise"] = mode_count(system)
        for name, size in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape not in ((), (size,)):
                return f"{name} must be one number or {size}, not {value.shape[0]}"
        if system is None:
            return None
        return observability_error(system) or self._points_error(case, system)

    def _points_error(self, case, system) -> str | None:
        """Whether the fastest mode turns too far within a stretch of the gain's table."""
        if case.controller.period is not None or self.loads == "ignored":
            return None
        modes = mode_count(system)
        fastest_frequency = np.max(
            np.abs(np.linalg.eigvals(concrete(system.A)[: 2 * modes, : 2 * modes]))
        )
        min_points = math.ceil(
            fastest_frequency * concrete(case.run.duration) / MAX_PHASE_PER_INTERVAL
        )
        if self.points >= min_points:
            return None
        return f"points must be at least {min_points} for {modes} modes and a run so long"


class OneStepPrediction(NamedTuple):
    """What is expected at a tick, before its readings are looked at, each with its covariance."""

    state: Float[Array, " state"]
    covariance: Square
    readings: Float[Array, " sensor"]
    innovation_covariance: Float[Array, "sensor sensor"]
    C: Float[Array, "sensor state"]


class CrossingFilter(eqx.Module):
    """Memory of a filter along a crossing.

    The first `plant_states` states are those of the plant; those of analogue filters follow, the weights of
    the loads, and what else the sensors add (see `sensor_chain`). `scale` is the size of the states of the
    plant with filters and weights, `noise_intensity` that of the white noise in their rates.
    """

    filtered: FilteredPlant
    sensor_chain: SensorChain
    plant_states: int = eqx.field(static=True)
    scale: Float[Array, " loaded"]
    noise_intensity: Float[Array, "loaded loaded"]
    state: Float[Array, " state"]
    covariance: Square
    command: Float[Array, " actuator"]

    @property
    def plant_state(self) -> Float[Array, " plant_states"]:
        """The states of the plant."""
        return self.state[: self.plant_states]

    @property
    def weights(self) -> Float[Array, " load"]:
        """The weights of the loads (N)."""
        return self.state[
            self.filtered.plant.modal_model.state_count : self.sensor_chain.plant_states
        ]

    def predict(self, command: Float[Array, " actuator"], t: Float[Array, ""]) -> OneStepPrediction:
        """What is expected at the tick at t (s), the given command having acted until then."""

        def system_at(time):
            return self.filtered.with_filtered_outputs(self.filtered.plant.augmented(time))

        transition = self.sensor_chain.transition(system_at, self.noise_intensity, self.scale, t)
        state = transition.predict(self.state, self.command, command)
        covariance = transition.predict_covariance(self.covariance)
        system = system_at(t)
        C, D = self.sensor_chain.output_matrices(system.C, system.D)
        readings = C @ state + D @ command + sensor_offsets(self.filtered.plant)
        return OneStepPrediction(
            state,
            covariance,
            readings,
            C @ covariance @ C.T + self.sensor_chain.noise_covariance,
            C,
        )

    def update(self, measurement: Measurement, t: Float[Array, ""]) -> "CrossingFilter":
        """The memory after the tick at t (s)."""
        prediction, noise = self.predict(measurement.command, t), self.sensor_chain.noise_covariance
        gain = filter_gain(prediction.covariance, prediction.C, noise)
        state = prediction.state + gain @ (measurement.readings - prediction.readings)
        # Joseph's form: symmetric and not negative, whatever the rounding.
        error_matrix = jnp.eye(state.shape[0]) - gain @ prediction.C
        covariance = error_matrix @ prediction.covariance @ error_matrix.T + gain @ noise @ gain.T
        return dataclasses.replace(
            self, state=state, covariance=symmetric_part(covariance), command=measurement.command
        )
