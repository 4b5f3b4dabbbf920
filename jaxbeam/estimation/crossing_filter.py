"""Kalman filter at samples for a plant with its moving loads."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
from jaxtyping import Float

from jaxbeam.case.estimator import AbstractSampledFilter, Estimate
from jaxbeam.estimation.constant_gain import sensor_offsets
from jaxbeam.estimation.gains import filter_gain
from jaxbeam.estimation.sampled_plant import Transition, in_blocks
from jaxbeam.estimation.sensor_chain import FilteredPlant, SensorChain
from jaxbeam.estimation.simulated_vehicles import with_loads
from jaxbeam.numerics.matrices import symmetric_part
from jaxbeam.runtime.arrays import Array, take, xp

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
    that they are known before a run.

    The first `plant_states` states x are those of the plant; those of analogue filters follow, of
    the vehicles, the weights of the loads, and those of the sensors (see `sensor_chain`). `scale`
    is the size of the states before those of the sensors, `noise_intensity` that of the white noise
    in their rates. A `table` has what `model_at` returns at all samples.
    """

    filtered: FilteredPlant
    sensor_chain: SensorChain
    scale: Float[Array, " loaded"]
    noise_intensity: Float[Array, "loaded loaded"]
    initial: Float[Array, " state"]
    initial_covariance: Square
    plant_states: int = eqx.field(static=True)
    estimates_weights: bool = eqx.field(static=True)
    table: SampleModel | None = None

    def initial_state(self):
        commands = self.filtered.plant.commands
        return FilterState(self.initial, self.initial_covariance, xp.zeros(commands))

    def tabulated(self, times):
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
        noise = self.sensor_chain.noise_covariance
        gain, covariance = corrected(prediction.covariance, prediction.C, noise)
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
    """Gain for a prediction of this covariance, and the covariance after its correction.

    By readings C x with noise of a covariance.
    """
    gain = filter_gain(covariance, C, noise_covariance)
    # Joseph's form: symmetric and positive semidefinite in spite of rounding.
    error_matrix = xp.eye(covariance.shape[0]) - gain @ C
    after = error_matrix @ covariance @ error_matrix.T + gain @ noise_covariance @ gain.T
    return gain, symmetric_part(after)
