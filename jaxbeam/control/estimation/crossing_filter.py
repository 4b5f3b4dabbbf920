"""Kalman filters of plants that vary while loads cross, of given and of estimated loads.

Vehicles that a filter does not estimate are simulated along with it. They, their weights,
trajectories and the profile are given; they are driven by the estimated motion of the beam, so that
no sensor in a vehicle is needed.
"""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import (
    AbstractContinuousFilter,
    AbstractSampledFilter,
    Estimate,
    EstimatedLoads,
)
from jaxbeam.control.estimation.observer import filter_gain, sensor_offsets, with_loads
from jaxbeam.control.estimation.sampled_plant import (
    FilteredPlant,
    SampleTiming,
    SensorChain,
    Transition,
    in_blocks,
)
from jaxbeam.model.contact import mass_contact_rows
from jaxbeam.model.output_rows import OutputRows
from jaxbeam.model.state_space import Plant, Signal, StateSpace
from jaxbeam.numerics.matrices import symmetric_part
from jaxbeam.runtime.arrays import Array, add_at, scan, take, xp


class VehicleMemory(NamedTuple):
    """State of the filter, and state of beam and vehicles and the command at the last sample."""

    filter_state: Any
    state: Float[Array, " all"]
    command: Float[Array, " actuator"]


class SampledWithVehicles(AbstractSampledFilter):
    """A sampled filter with the states of the vehicles of a plant.

    From sample to sample they are those of the coupled plant that starts from the estimated state
    of the beam, by `SampleTiming.transition`.
    """

    filter: AbstractSampledFilter
    plant: Plant
    timing: SampleTiming
    table: Transition | None = None  # at all samples

    def tabulated(self, times):
        def block(first, number):
            return self.transition_at(times[first : first + number])

        table = in_blocks(block, len(times))
        return dataclasses.replace(self, filter=self.filter.tabulated(times), table=table)

    def transition_at(self, t: Float[Array, "*sample"]) -> Transition:
        """Transition of the coupled plant to the sample at t (s), or to several."""
        if self.table is not None:
            sample = self.timing.sample_at(t)
            return jax.tree.map(lambda part: take(part, sample), self.table)

        def matrices_at(times):
            system = self.plant.augmented(times)
            return system.A, system.B

        size = self.plant.modal_model.state_count + self.plant.augmented_start.shape[0]
        return self.timing.transition(matrices_at, np.zeros((size, size)), xp.ones(size), t)

    def initial_state(self):
        commands = xp.zeros(self.plant.commands)
        beam = xp.zeros(self.plant.modal_model.state_count)
        vehicles = self.plant.augmented_start[: self.plant.vehicle_states]
        state = xp.concatenate([beam, vehicles])
        return VehicleMemory(self.filter.initial_state(), state, commands)

    def update(self, state: VehicleMemory, measurement, t):
        plant = self.plant
        estimate, filter_state = self.filter.update(state.filter_state, measurement, t)
        beam = plant.modal_model.state_count
        constants = plant.augmented_start[plant.vehicle_states :]
        x = xp.concatenate([state.state, constants])
        predicted = self.transition_at(t).predict(x, state.command, measurement.command)
        vehicles = predicted[beam : beam + plant.vehicle_states]
        # A run starts at rest: there is no period before it.
        vehicles = xp.where(t > 0, vehicles, state.state[beam:])
        estimate = estimate._replace(vehicles=vehicles)
        present = xp.concatenate([estimate.state, vehicles])
        return estimate, VehicleMemory(filter_state, present, measurement.command)


class ContinuousWithVehicles(AbstractContinuousFilter):
    """A filter in continuous time with the states of the vehicles of a plant.

    They are integrated, as differences from those at the start, after the states of the filter.
    """

    filter: AbstractContinuousFilter
    plant: Plant

    @property
    def state_count(self):
        return self.filter.state_count + self.plant.vehicle_states

    def estimate(self, state, measurement, t):
        own = self.filter.state_count
        estimate = self.filter.estimate(state[:own], measurement, t)
        vehicles = self.plant.augmented_start[: self.plant.vehicle_states] + state[own:]
        return estimate._replace(vehicles=vehicles)

    def rates(self, state, measurement, command, t):
        estimate, own = self.estimate(state, measurement, t), self.filter.state_count
        system, beam = self.plant.augmented(t), self.plant.modal_model.state_count
        constants = self.plant.augmented_start[self.plant.vehicle_states :]
        x = xp.concatenate([estimate.state, estimate.vehicles, constants])
        rates = system.A @ x + system.B @ command
        of_filter = self.filter.rates(state[:own], measurement, command, t)
        return xp.concatenate([of_filter, rates[beam : beam + self.plant.vehicle_states]])


Square = Float[Array, "state state"]


# Transition from the sample before, C and D of the readings; of one sample, or of several.
SampleModel = tuple[
    Transition, Float[Array, "*sample sensor state"], Float[Array, "*sample sensor actuator"]
]


class FilterState(NamedTuple):
    """Estimate x after a sample, its covariance, and the command of that sample."""

    x: Float[Array, " state"]
    covariance: Square
    command: Float[Array, " actuator"]


class OneStepPrediction(NamedTuple):
    """Prediction of states and readings at a sample with covariances, and output matrix C."""

    x: Float[Array, " state"]
    covariance: Square
    readings: Float[Array, " sensor"]
    innovation_covariance: Float[Array, "sensor sensor"]
    C: Float[Array, "sensor state"]


class CrossingFilter(AbstractSampledFilter):
    """Time-varying Kalman filter; its covariance is propagated during the run.

    A missing reading corrects nothing; covariance and gains stay those of complete readings, so
    that they can be computed before a run.

    The first `plant_states` states x are those of the plant; those of analogue filters follow, of
    the vehicles, the weights of the loads, and those of the sensors (see `sensor_chain`). `scale`
    is the size of the states before those of the sensors, `noise_intensity` that of the white noise
    in their rates. A `table` has what `model_at` returns at all samples, `gains` those at all
    samples, with which the covariance of a state stays what it was.
    """

    without_reading: ClassVar[str] = (
        "The estimate is predicted by the model, and not corrected by it."
    )

    filtered: FilteredPlant
    sensor_chain: SensorChain
    scale: Float[Array, " loaded"]
    noise_intensity: Float[Array, "loaded loaded"]
    initial: Float[Array, " state"]
    initial_covariance: Square
    plant_states: int = eqx.field(static=True)
    estimates_weights: bool = eqx.field(static=True)
    table: SampleModel | None = None
    gains: Float[Array, "sample state sensor"] | None = None

    def initial_state(self):
        commands = self.filtered.plant.commands
        return FilterState(self.initial, self.initial_covariance, xp.zeros(commands))

    def tabulated(self, times):
        filter, noise = self.with_models(times), self.sensor_chain.noise_covariance

        def step(covariance, model):
            transition, C, _ = model
            gain, after = corrected(transition.predict_covariance(covariance), C, noise)
            return after, gain

        gains = scan(step, self.initial_covariance, filter.table)[1]
        return dataclasses.replace(filter, gains=gains)

    def with_models(self, times: Float[Array, " sample"]) -> "CrossingFilter":
        """The filter with a table of its models at all samples (s)."""

        def block(first, number):
            return self.model_at(times[first : first + number])

        return dataclasses.replace(self, table=in_blocks(block, len(times)))

    def model_at(self, t: Float[Array, "*sample"]) -> SampleModel:
        """Transition to the sample at t (s), or to several, and C and D of its readings."""
        if self.table is not None:
            sample = self.sensor_chain.timing.sample_at(t)
            return jax.tree.map(lambda part: take(part, sample), self.table)

        def system_at(time):
            return self.filtered.with_filtered_outputs(self.filtered.plant.augmented(time))

        transition = self.sensor_chain.transition(system_at, self.noise_intensity, self.scale, t)
        system = system_at(t)
        return transition, *self.sensor_chain.output_matrices(system.C, system.D)

    def predict(
        self, state: FilterState, command, t: Float[Array, ""], model: SampleModel | None = None
    ) -> OneStepPrediction:
        """Prediction for the sample at t (s) under the command since the last sample.

        The `model` is that of the sample if it is left out.
        """
        transition, C, D = self.model_at(t) if model is None else model
        x = transition.predict(state.x, state.command, command)
        covariance = transition.predict_covariance(state.covariance)
        readings = C @ x + D @ command + sensor_offsets(self.filtered.plant)
        innovation_covariance = C @ covariance @ C.T + self.sensor_chain.noise_covariance
        return OneStepPrediction(x, covariance, readings, innovation_covariance, C)

    def update(self, state, measurement, t):
        prediction = self.predict(state, measurement.command, t)
        noise, covariance = self.sensor_chain.noise_covariance, state.covariance
        if self.gains is None:
            gain, covariance = corrected(prediction.covariance, prediction.C, noise)
        else:
            gain = take(self.gains, self.sensor_chain.timing.sample_at(t))
        x = prediction.x + gain @ measurement.innovation(prediction.readings)
        return self.estimate(x, t), FilterState(x, covariance, measurement.command)

    def estimate(self, x: Float[Array, " state"], t: Float[Array, ""]) -> Estimate:
        """Estimate for states x at t (s)."""
        plant = self.filtered.plant
        added = x[plant.modal_model.state_count : self.sensor_chain.plant_states]
        return with_loads(plant, x[: self.plant_states], added, t, self.estimates_weights)


def corrected(
    covariance: Square,
    C: Float[Array, "sensor state"],
    noise_covariance: Float[Array, "sensor sensor"],
) -> tuple[Float[Array, "state sensor"], Square]:
    """Gain for a prediction of a covariance, and the covariance after correction by readings.

    Readings are C x with noise of `noise_covariance`.
    """
    gain = filter_gain(covariance, C, noise_covariance)
    # Joseph's form: symmetric and positive semidefinite in spite of rounding.
    error_matrix = xp.eye(covariance.shape[0]) - gain @ C
    after = error_matrix @ covariance @ error_matrix.T + gain @ noise_covariance @ gain.T
    return gain, symmetric_part(after)


NUMBERS = 3  # of each load: position (m), speed (m/s), mass (kg)
LoadNumbers = Float[Array, "*variant load"]


class LoadFollowingFilter(AbstractSampledFilter):
    """Kalman filter of a plant linearised about the estimated positions, speeds and masses.

    The first `plant_states` states x are those of the plant; those of analogue filters follow, the
    positions (m), speeds (m/s) and masses (kg) of the loads, and the states of the sensors. Given
    the numbers of the loads the plant is linear, and its transition that of `SampleTiming`: loads
    travel at their speeds through a period. Derivatives by these numbers are central differences
    over `steps`. `output_rows` are those of the plant; a fraction `inertia_fraction` of each mass
    follows the beam: 1, or 0 for a force. `scale` and `noise_intensity` are those of the states
    before the sensors.
    """

    without_reading: ClassVar[str] = (
        "The estimate is predicted by the model, and not corrected by it."
    )
    difference_step: ClassVar[float] = 1e-4  # of its derivatives, relative

    filtered: FilteredPlant
    output_rows: OutputRows
    sensor_chain: SensorChain
    scale: Float[Array, " loaded"]
    noise_intensity: Float[Array, "loaded loaded"]
    initial: Float[Array, " state"]
    initial_covariance: Square
    steps: Float[Array, " number"]
    inertia_fraction: Float[Array, " load"]
    plant_states: int = eqx.field(static=True)

    def initial_state(self):
        commands = self.filtered.plant.commands
        return FilterState(self.initial, self.initial_covariance, xp.zeros(commands))

    def update(self, state, measurement, t):
        command = measurement.command
        x, covariance = self.predict(state, command, t)
        C, D, slopes = self._readings(x, command)
        readings = C @ x + D @ command + sensor_offsets(self.filtered.plant)
        rows = add_at(C, np.s_[:, self._numbers], slopes)
        if measurement.present is not None:  # a missing reading corrects neither x nor covariance
            rows = xp.where(measurement.present[:, None], rows, 0.0)
        gain, covariance = corrected(covariance, rows, self.sensor_chain.noise_covariance)
        x = x + gain @ measurement.innovation(readings)
        return self._estimate(x), FilterState(x, covariance, command)

    def predict(
        self, state: FilterState, command: Float[Array, " actuator"], t: Float[Array, ""]
    ) -> tuple[Float[Array, " state"], Square]:
        """State at the sample at t (s), before its readings, and its covariance."""
        variants = self._variants(state.x)
        start = t - self.sensor_chain.timing.period

        def system_at(times):
            elapsed = (times - start)[..., None]
            # Times of a variant may be split into parts along a last axis.
            position, speed, mass = (
                part[:, None] if elapsed.ndim > 2 else part for part in variants
            )
            return self._system(position + speed * elapsed, speed + 0.0 * elapsed, mass)

        times = xp.full(variants[0].shape[:1], t)
        transition = self.sensor_chain.transition(
            system_at, self.noise_intensity, self.scale, times
        )
        states = transition.predict(state.x, state.command, command)
        jacobian = add_at(transition.matrix[0], np.s_[:, self._numbers], self._slopes(states))
        covariance = jacobian @ state.covariance @ jacobian.T + transition.noise_covariance[0]
        return states[0], symmetric_part(covariance)

    def _readings(self, x, command):
        """C and D of the readings, and their derivatives by the numbers of the loads."""
        position, speed, mass = self._variants(x)
        system = self._system(position, speed, mass)
        C, D = self.sensor_chain.output_matrices(system.C, system.D)
        return C[0], D[0], self._slopes(C @ x + D @ command)

    @property
    def _numbers(self) -> slice:
        """Index of the positions, speeds and masses among the states."""
        end = self.sensor_chain.plant_states
        return slice(end - self.steps.shape[0], end)

    def _variants(self, x) -> tuple[LoadNumbers, LoadNumbers, LoadNumbers]:
        """Positions, speeds and masses as estimated, then each larger, then each smaller."""
        steps = xp.diag(self.steps)
        changes = xp.concatenate([xp.zeros((1, steps.shape[0])), steps, -steps])
        parts = (x[self._numbers] + changes).reshape(changes.shape[0], NUMBERS, -1)
        return parts[:, 0], parts[:, 1], parts[:, 2]

    def _slopes(self, values: Float[Array, "variant row"]) -> Float[Array, "row number"]:
        """Derivatives of values by the numbers of the loads."""
        larger, smaller = xp.split(values[1:], 2)
        return ((larger - smaller) / (2 * self.steps[:, None])).T

    def _system(self, position, speed, mass) -> StateSpace:
        """Plant under loads of some positions, speeds and masses, which are its last states."""
        plant = self.filtered.plant
        speed, mass = (xp.broadcast_to(part, position.shape) for part in (speed, mass))
        on_beam = (position >= 0) & (position <= plant.case.beam.length)
        inertia = self.inertia_fraction * xp.maximum(mass, 0.0)
        contact = mass_contact_rows(plant.modal_model, position, speed, on_beam, inertia)
        system, commands = plant.with_contact(contact, self.output_rows), plant.commands
        times, loads, gravity = position.shape[:-1], position.shape[-1], plant.case.run.gravity

        def of_numbers(inputs):
            """Columns of positions, speeds and masses."""
            zeros = xp.zeros((*inputs.shape[:-1], 2 * loads))
            return xp.concatenate([zeros, inputs[..., commands:] * gravity], axis=-1)

        # The rates of the positions are the speeds; speeds and masses stay.
        size, states = NUMBERS * loads, system.A.shape[-1]
        motion = np.eye(loads, states + size, k=states + loads)
        below = xp.pad(motion, ((0, size - loads), (0, 0)))
        below = xp.broadcast_to(below, (*times, *below.shape))
        upper = xp.concatenate([system.A, of_numbers(system.B)], axis=-1)
        A = xp.concatenate([upper, below], axis=-2)
        rows = [*[(0, 0)] * len(times), (0, size), (0, 0)]
        C = xp.concatenate([system.C, of_numbers(system.D)], axis=-1)
        names = ("position", "m"), ("speed", "m/s"), ("mass", "kg")
        signals = tuple(
            Signal(f"load_{i}_{name}", unit) for name, unit in names for i in range(loads)
        )
        system = StateSpace(
            A=A,
            B=xp.pad(system.B[..., :commands], rows),
            C=C,
            D=system.D[..., :commands],
            states=system.states + signals,
            inputs=system.inputs[:commands],
            outputs=system.outputs,
        )
        return self.filtered.with_filtered_outputs(system)

    def _estimate(self, x) -> Estimate:
        plant = self.filtered.plant
        positions, speeds, masses = x[self._numbers].reshape(NUMBERS, -1)
        on_beam = (positions >= 0) & (positions <= plant.case.beam.length)
        weights = xp.where(on_beam, masses * plant.case.run.gravity, 0.0)
        loads = EstimatedLoads(masses, positions, speeds)
        return Estimate(x[: self.plant_states], weights, loads=loads)
