"""States of vehicles, simulated along with a filter that does not estimate them.

The vehicles, their weights, trajectories and the profile are given; they are driven by the
estimated motion of the beam, so that no sensor in a vehicle is needed. (Filters that estimate
weights estimate vehicles, too.)
"""

import dataclasses
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import AbstractContinuousFilter, AbstractSampledFilter, Estimate
from jaxbeam.estimation.sampled_plant import SampleTiming, Transition, in_blocks
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array, take, xp


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
