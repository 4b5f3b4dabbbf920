"""C code of filters of the plant with its moving loads: their numbers are tables over time.

Transition, outputs and gain depend on the known crossing, not on the readings, so that they are
computed beforehand for each sample.
"""

import numpy as np

from jaxbeam.c_code.laws.estimators import (
    FilterModel,
    transition_matrices,
    write_filter_step,
    write_prediction,
)
from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.tables import at_samples
from jaxbeam.c_code.writers import EstimateCode, write_filter
from jaxbeam.estimation.constant_gain import sensor_offsets
from jaxbeam.estimation.crossing_filter import CrossingFilter, corrected
from jaxbeam.estimation.simulated_vehicles import SampledWithVehicles
from jaxbeam.runtime.arrays import xp


@write_filter.register
def _(filter: CrossingFilter, code: CSource) -> EstimateCode:
    plant, states = filter.filtered.plant, filter.initial.shape[0]

    def model(t):
        transition, C, D = filter.model_at(t)
        on_beam = xp.where(plant.loads.on_beam(t), 1.0, 0.0)
        matrices = transition_matrices(transition)
        return *matrices, C, D, transition.noise_covariance, on_beam

    A, previous, present, C, D, noise, on_beam = at_samples(model, code)
    gains, covariance = [], np.asarray(filter.initial_covariance)
    of_readings = filter.sensor_chain.noise_covariance
    for k in range(len(A)):
        covariance = A[k] @ covariance @ A[k].T + noise[k]
        gain, covariance = (np.asarray(part) for part in corrected(covariance, C[k], of_readings))
        gains.append(gain)
    x = code.state("estimate", filter.initial, "estimated states, of beam, loads and sensors")
    model_at_samples = FilterModel(A, previous, present, C, D, np.stack(gains))
    write_filter_step(code, model_at_samples, sensor_offsets(plant), x)
    added, vehicles = plant.modal_model.state_count, plant.vehicle_states
    assert added + vehicles <= states
    weights, wheels = None, 0
    if filter.estimates_weights:
        wheels = np.shape(plant.weights)[0]
        weights = code.work("weights", wheels, "estimated weights, zero off the beam (N)")
        mask = code.per_sample("on_beam", on_beam.reshape(len(A), -1))
        first = added + vehicles
        code.add(
            f"for (i = 0; i < {wheels}; i++) {weights}[i] = {mask}[i] * {x}[{first} + i];", wheels
        )
    return EstimateCode(
        x, filter.plant_states, weights, wheels, f"{x} + {added}" if vehicles else None
    )


@write_filter.register
def _(filter: SampledWithVehicles, code: CSource) -> EstimateCode:
    plant = filter.plant
    inner = write_filter(filter.filter, code)
    beam, vehicles = plant.modal_model.state_count, plant.vehicle_states
    constants = np.asarray(plant.augmented_start)[vehicles:]
    size = beam + vehicles + len(constants)

    def model(t):
        transition = filter.timing.transition(
            lambda time: (plant.augmented(time).A, plant.augmented(time).B),
            np.zeros((size, size)),
            xp.ones(size),
            t,
        )
        return tuple(part[beam : beam + vehicles] for part in transition_matrices(transition))

    start = np.concatenate([np.zeros(beam), np.asarray(plant.augmented_start)])
    x = code.state("coupled", start, "states of beam and vehicles, weights of the loads")
    code.add("/* States of the vehicles, driven by the estimated motion of the beam */")
    if inner.weights is not None:
        code.add(f"copy({x} + {beam + vehicles}, {inner.weights}, {inner.wheels});")
    matrices = [np.array(part) for part in at_samples(model, code)]
    # A run starts at rest: there is no period before it.
    matrices[0][0] = np.eye(vehicles, size, k=beam)
    matrices[1][0] = matrices[2][0] = 0.0
    write_prediction(code, matrices, "vehicle", x, f"{x} + {beam}")
    code.add(f"copy({x}, {inner.state}, {beam});")
    return inner._replace(vehicles=f"{x} + {beam}")
