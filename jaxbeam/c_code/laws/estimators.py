"""C code of estimators: at rest, and of plants that vary while loads cross.

Transition, outputs and gain depend on the known crossing, not on the readings, so that they are
computed beforehand for each sample.
"""

from typing import Any, NamedTuple

import numpy as np

from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.texts import at_samples
from jaxbeam.c_code.writers import EstimateCode, write_filter
from jaxbeam.control.state_controller import TrueState
from jaxbeam.estimation.crossing_filter import CrossingFilter, corrected
from jaxbeam.estimation.inversion import InversionFilter
from jaxbeam.estimation.observer import ConstantGainFilter, sensor_offsets
from jaxbeam.estimation.sampled_plant import Transition
from jaxbeam.estimation.simulated_vehicles import SampledWithVehicles
from jaxbeam.model.sensing.sensor_signals import MAX_READING
from jaxbeam.runtime.arrays import xp


@write_filter.register
def _(filter: TrueState, code: CSource) -> EstimateCode:
    states = code.given_states = np.shape(filter.state_map)[0]
    given = code.state("given", np.zeros(states), "last given states")
    lowest, highest = (
        code.constant(f"given_{name}", np.full(states, end))
        for name, end in (("lowest", -MAX_READING), ("highest", MAX_READING))
    )
    present = code.work("given_present", states, "which of them are present")
    measured = f"measurements + {code.sensors}"
    code.add(f"receive({given}, {present}, {measured}, {lowest}, {highest}, {states});", 3 * states)
    return EstimateCode(given, states)


@write_filter.register
def _(filter: ConstantGainFilter, code: CSource) -> EstimateCode:
    x = code.state("estimate", np.zeros(np.shape(filter.C)[1]), "estimated states")
    model = FilterModel(*transition_matrices(filter.transition), filter.C, filter.D, filter.gain)
    write_filter_step(
        code, FilterModel(*(np.asarray(part)[None] for part in model)), filter.offset, x
    )
    return EstimateCode(x, filter.plant_states)


@write_filter.register
def _(filter: InversionFilter, code: CSource) -> EstimateCode:
    modes, sensors = np.shape(filter.mode_shape_inverse)
    x = code.state("estimate", np.zeros(filter.plant_states), "estimated states")
    reading = code.work("deflection", sensors, "readings less offsets")
    coordinate = code.work("coordinate", modes, "coordinates that fit the readings")
    offset = code.constant("reading_offset", filter.offset)
    inverse = code.constant("mode_shape_inverse", filter.mode_shape_inverse)
    if filter.actuator_transition is not None:
        code.add(
            "/* Estimate: states of the actuators from beam and commands of the last period */"
        )
        _write_actuator_states(code, filter, x, modes)
    gain = float(filter.difference_gain)
    smoothing = 1 - gain * float(filter.period)
    periods = code.state("periods", [1.0], "periods since the last complete deflections, and one")
    own, count = code.constant("deflection_sensors", filter.sensors), len(filter.sensors)
    code.missing.append("The estimate stays while a deflection is missing.")
    code.add(
        f"/* Estimate: coordinates from the deflections, rates from their differences */\n"
        f"for (i = 0; i < {sensors}; i++) {reading}[i] = {code.readings}[i] - {offset}[i];",
        sensors,
    )
    code.multiply(coordinate, inverse, reading, modes, sensors)
    code.add(
        f"""
for (i = 0; i < {count}; i++)
    if (!({code.present}[{own}[i]] > 0)) break;
if (i < {count}) {periods}[0] += 1;
else {{
    for (i = 0; i < {modes}; i++) {{
        {x}[{modes} + i] = (real){smoothing!r} * {x}[{modes} + i]
                           + (real){gain!r} * ({coordinate}[i] - {x}[i]) / {periods}[0];
        {x}[i] = {coordinate}[i];
    }}
    {periods}[0] = 1;
}}""",
        5 * modes + count + 1,
    )
    return EstimateCode(x, filter.plant_states)


def _write_actuator_states(code: CSource, filter: InversionFilter, x: str, modes: int) -> None:
    """States of the actuators over a period, driven by the held beam and the commands."""
    transition: Any = filter.actuator_transition
    beam = 2 * modes
    A, previous, present = (np.asarray(part) for part in transition_matrices(transition))
    # The beam is held over the whole period: its columns of both inputs add.
    by_state = np.concatenate([previous[:, :beam] + present[:, :beam], A], axis=1)
    matrices = by_state, previous[:, beam:], present[:, beam:]
    matrices = tuple(matrix[None] for matrix in matrices)
    write_prediction(code, matrices, "actuator", x, f"{x} + {beam}")


class FilterModel(NamedTuple):
    """Matrices of a filter: those of x, of u until the previous sample and u since; C, D, gain."""

    A: Any
    previous: Any
    present: Any
    C: Any
    D: Any
    gain: Any


def transition_matrices(transition: Transition) -> tuple[Any, Any, Any]:
    """Matrices of the states, of the command until the previous sample, and of that since."""
    return transition.matrix, transition.previous_input_matrix, transition.input_matrix


def write_filter_step(code: CSource, model: FilterModel, offset, x: str) -> None:
    """Prediction of the states x over a period, and correction by the readings.

    The matrices of the model have a first axis of samples.
    """
    sensors, states = np.shape(model.C)[1:]
    code.add("/* Estimate: prediction over a period, then correction by the readings */")
    write_prediction(code, model[:3], "filter", x, x)
    innovation = code.work("innovation", sensors, "readings less predicted ones")
    offset = code.constant("reading_offset", offset)
    code.add(
        f"for (i = 0; i < {sensors}; i++) {innovation}[i] = {code.readings}[i] - {offset}[i];",
        sensors,
    )
    C = code.per_sample("filter_C", model.C)
    code.multiply_add(innovation, C, x, sensors, states, -1)
    if np.any(model.D):
        D = code.per_sample("filter_D", model.D)
        code.multiply_add(innovation, D, code.command, sensors, code.actuators, -1)
    code.add(f"drop_missing({innovation}, {code.present}, {sensors});", sensors)
    code.missing.append("The estimate is predicted by the model, and not corrected by it.")
    gain = code.per_sample("filter_gain", model.gain)
    code.multiply_add(x, gain, innovation, states, sensors)


def write_prediction(code: CSource, matrices, name: str, x: str, place: str) -> None:
    """Prediction over a period from the states x, put in a place among them.

    The command that acted until the previous sample is kept for a model that needs it. The matrices
    have a first axis of samples.
    """
    A, previous, present = matrices
    _, rows, columns = np.shape(A)
    predicted = code.work(f"{name}_prediction", rows, "predicted states")
    code.multiply(predicted, code.per_sample(f"{name}_A", A), x, rows, columns)
    if np.any(previous):
        last = code.state(f"{name}_last", np.zeros(code.actuators), "commands before")
        matrix = code.per_sample(f"{name}_B_last", previous)
        code.multiply_add(predicted, matrix, last, rows, code.actuators)
        code.add(f"copy({last}, {code.command}, {code.actuators});")
    if np.any(present):
        matrix = code.per_sample(f"{name}_B", present)
        code.multiply_add(predicted, matrix, code.command, rows, code.actuators)
    code.add(f"copy({place}, {predicted}, {rows});")


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
    matrices = [np.array(part) for part in at_samples(model, code)]
    # A run starts at rest: there is no period before it.
    matrices[0][0] = np.eye(vehicles, size, k=beam)
    matrices[1][0] = matrices[2][0] = 0.0
    write_prediction(code, matrices, "vehicle", x, f"{x} + {beam}")
    code.add(f"copy({x}, {inner.state}, {beam});")
    return inner._replace(vehicles=f"{x} + {beam}")
