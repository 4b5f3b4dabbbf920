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
from jaxbeam.case.fields import POSITIVE, choice, count, is_known, known, number
from jaxbeam.estimation.constant_gain import at_rest, offsets
from jaxbeam.estimation.continuous import Flowing
from jaxbeam.estimation.gains import filter_gain, kalman_gain, sampled_kalman_gain
from jaxbeam.estimation.observability import modes_of, unseen_fault
from jaxbeam.estimation.sampled_plant import ROUNDING, ticks
from jaxbeam.estimation.sensor_chain import Chain, Sight, chain, sight
from jaxbeam.model.state_space import LoadedBeam
from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.finite_horizon import finite_time
from jaxbeam.numerics.intervals import symmetric

TURN = 3.0  # rad by which the fastest mode may turn within a stretch of a table

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
    def flows(self) -> bool:
        return True

    def init(self, model):
        if model.case.controller.period is None:
            return self._flowing(model)
        view, clock = sight(model), ticks(model.case.controller)
        wide, intensity = view.model, self.intensity(view.model)
        states, loads = intensity.shape[0], len(model.case.loads)
        variance, scale = self.reading_variance(model), balance(wide.unloaded.A)
        if self.loads == "ignored":
            plant = view.behind(wide.unloaded)
            behind = chain(model, variance, clock, states, self.reach)
            transition = behind.onward(lambda t: plant, intensity, scale)
            C, D = behind.rows(plant.C, plant.D)
            gain, _ = sampled_kalman_gain(transition.drift, C, transition.noise, behind.noise)
            return at_rest(model, transition, C, D, gain)
        behind = chain(model, variance, clock, states + loads, self.reach)
        spread = jnp.zeros(loads)
        if self.weight_deviation is not None:
            spread = jnp.broadcast_to(self.weight_deviation**2, (loads,))
        weights = jnp.zeros(behind.size).at[states : states + loads]
        return Crossing(
            view,
            behind,
            model.rig.states,
            jnp.append(scale, jnp.ones(loads)),
            jnp.pad(intensity, (0, loads)),
            weights.set(model.weights),
            jnp.diag(weights.set(spread)),
            jnp.zeros(len(model.case.actuators)),
        )

    def _flowing(self, model: LoadedBeam) -> Flowing:
        """The filter at every instant."""
        view, count = sight(model), len(model.case.sensors)
        wide, intensity = view.model, self.intensity(view.model)
        noise = jnp.diag(jnp.broadcast_to(self.measurement_intensity, (count,)))
        states, loads = intensity.shape[0], len(model.case.loads)
        offset, own = offsets(model), model.rig.states
        if self.loads == "ignored":
            plant = view.behind(wide.unloaded)
            gain, _ = kalman_gain(plant.A, plant.C, intensity, noise)
            return Flowing(offset, jnp.zeros(states), own, still=plant, gain=gain)
        spread, none = jnp.zeros(loads), jnp.zeros(states)
        if self.weight_deviation is not None:
            spread = jnp.broadcast_to(self.weight_deviation**2, (loads,))
        end = model.case.run.duration

        def dual(back):
            """The plant a time (s) before the end, as that of a regulator with the same gain."""
            plant = view.behind(wide.augmented(end - back))
            return plant.A.T, plant.C.T

        windows = jnp.array([path.window() for path in wide.traffic.motions]).reshape(-1)
        events = jnp.concatenate([jnp.zeros(1), jnp.clip(windows, 0.0, end), end[None]])
        first, Q = jnp.diag(jnp.append(none, spread)), jnp.pad(intensity, (0, loads))
        table = finite_time(dual, jnp.sort(end - events), self.points, Q, noise, first)[0]
        return Flowing(
            offset,
            jnp.append(none, model.weights),
            own,
            view=view,
            table=table,
            duration=end,
            sought=self.loads == "estimated",
        )

    def step(self, memory, measurement, t):
        if self.loads == "ignored":
            memory = memory.corrected(measurement)
            return Estimate(memory.plant_state), memory
        memory = memory.corrected(measurement, t)
        if self.loads == "known":
            return Estimate(memory.plant_state), memory
        on_beam = memory.view.model.traffic.on_beam(t)
        return Estimate(memory.plant_state, jnp.where(on_beam, memory.weights, 0.0)), memory

    def intensity(self, model: LoadedBeam) -> Square:
        """Intensity of the white noise in the rates of the states."""
        modes = model.scale.shape[0]
        force = self.process_noise * model.scale**2
        own = jnp.zeros(model.rig.states - 2 * modes)
        return jnp.diag(jnp.concatenate([jnp.zeros(modes), force, own]))

    def reading_variance(self, model: LoadedBeam) -> Float[Array, " sensor"]:
        """Variance of the noise of each reading."""
        sensors = model.case.sensors
        if self.measurement_noise is None:
            return jnp.stack([sensor.noise_covariance for sensor in sensors])
        return jnp.broadcast_to(self.measurement_noise**2, (len(sensors),))

    def fault(self, case, plant):
        if not case.sensors:
            return "kind needs sensors; add one"
        period = case.controller.period
        if (period is None) != (self.measurement_intensity is not None):
            return "measurement_intensity must be given without a controller.period, and only then"
        if period is None and self.measurement_noise is not None:
            return "measurement_noise is that of samples; without a period leave it out"
        if period is not None and self.measurement_noise is None:
            for i, sensor in enumerate(case.sensors):
                if sensor.noise is None or (is_known(sensor.noise) and known(sensor.noise) == 0):
                    return f"measurement_noise must be given, as sensors.{i} has no noise"
        for i, sensor in enumerate(case.sensors):
            sampled = period is not None and sensor.delay is not None
            if sampled and is_known(sensor.delay) and is_known(period):
                back = math.ceil(known(sensor.delay) / known(period) - ROUNDING)
                if back > self.reach:
                    return f"reach must be at least {back}, the periods of sensors.{i}.delay"
        if self.loads != "ignored" and not case.loads:
            return "loads must be 'ignored': there are none"
        if (self.loads == "estimated") != (self.weight_deviation is not None):
            return "weight_deviation and loads = 'estimated' belong together; give both or neither"
        sizes = {"measurement_noise": len(case.sensors), "weight_deviation": len(case.loads)}
        sizes["measurement_intensity"] = len(case.sensors)
        if plant is not None:
            sizes["process_noise"] = modes_of(plant)
        for name, size in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape not in ((), (size,)):
                return f"{name} must be one number or {size}, not {value.shape[0]}"
        if plant is None:
            return None
        return unseen_fault(plant) or self._too_coarse(case, plant)

    def _too_coarse(self, case, plant) -> str | None:
        """Whether the fastest mode turns too far within a stretch of the gain's table."""
        if case.controller.period is not None or self.loads == "ignored":
            return None
        modes = modes_of(plant)
        fastest = np.max(np.abs(np.linalg.eigvals(known(plant.A)[: 2 * modes, : 2 * modes])))
        needed = math.ceil(fastest * known(case.run.duration) / TURN)
        if self.points >= needed:
            return None
        return f"points must be at least {needed} for {modes} modes and a run so long"


class Prediction(NamedTuple):
    """What is expected at a tick, before its readings are looked at, each with its covariance."""

    state: Float[Array, " state"]
    covariance: Square
    readings: Float[Array, " sensor"]
    spread: Float[Array, "sensor sensor"]
    C: Float[Array, "sensor state"]


class Crossing(eqx.Module):
    """Memory of a filter along a crossing.

    The first `own` states are those of the plant; those of analogue filters follow, the weights of
    the loads, and what else the sensors add (see `chain`). `scale` is the size of the states of the
    plant with filters and weights, `intensity` that of the white noise in their rates.
    """

    view: Sight
    behind: Chain
    own: int = eqx.field(static=True)
    scale: Float[Array, " loaded"]
    intensity: Float[Array, "loaded loaded"]
    state: Float[Array, " state"]
    covariance: Square
    command: Float[Array, " actuator"]

    @property
    def plant_state(self) -> Float[Array, " own"]:
        """The states of the plant."""
        return self.state[: self.own]

    @property
    def weights(self) -> Float[Array, " load"]:
        """The weights of the loads (N)."""
        return self.state[self.view.model.rig.states : self.behind.plant]

    def predicted(self, command: Float[Array, " actuator"], t: Float[Array, ""]) -> Prediction:
        """What is expected at the tick at t (s), the given command having acted until then."""

        def plant(time):
            return self.view.behind(self.view.model.augmented(time))

        transition = self.behind.onward(plant, self.intensity, self.scale, t)
        state = transition.mean(self.state, self.command, command)
        covariance = transition.covariance(self.covariance)
        now = plant(t)
        C, D = self.behind.rows(now.C, now.D)
        readings = C @ state + D @ command + offsets(self.view.model)
        return Prediction(state, covariance, readings, C @ covariance @ C.T + self.behind.noise, C)

    def corrected(self, measurement: Measurement, t: Float[Array, ""]) -> "Crossing":
        """The memory after the tick at t (s)."""
        expected, noise = self.predicted(measurement.command, t), self.behind.noise
        gain = filter_gain(expected.covariance, expected.C, noise)
        state = expected.state + gain @ (measurement.readings - expected.readings)
        # Joseph's form: symmetric and not negative, whatever the rounding.
        left = jnp.eye(state.shape[0]) - gain @ expected.C
        covariance = left @ expected.covariance @ left.T + gain @ noise @ gain.T
        return dataclasses.replace(
            self, state=state, covariance=symmetric(covariance), command=measurement.command
        )
