"""C code of filters: those of constant gain, inversion, along the crossing, vehicles beside them."""

from typing import Any

import equinox as eqx
import jax
import numpy as np

from jaxbeam.c_code.source import CSource
from jaxbeam.c_code.writers import EstimateCode, write_filter
from jaxbeam.case.controller import Measurement
from jaxbeam.control.state_law import TrueState
from jaxbeam.estimation.constant_gain import ConstantGainFilter
from jaxbeam.estimation.crossing_filter import CrossingFilter
from jaxbeam.estimation.gains import filter_gain
from jaxbeam.estimation.inversion import InversionFilter
from jaxbeam.estimation.sampled_plant import Transition
from jaxbeam.estimation.simulated_vehicles import SampledWithVehicles
from jaxbeam.runtime.arrays import xp


@write_filter.register
def _(filter: TrueState, code: CSource) -> EstimateCode:
    code.given_states = np.shape(filter.state_map)[0]
    return EstimateCode(code.true_state, code.given_states)


@write_filter.register
def _(filter: ConstantGainFilter, code: CSource) -> EstimateCode:
    sensors, states = np.shape(filter.C)
    x = code.state("estimate", np.zeros(states), "estimated states, then those of the sensors")
    code.add("/* Estimate: prediction over a period, then correction by the readings */")
    _predict(code, filter.transition, "filter", x, code.command)
    innovation = code.work("innovation", sensors, "readings less predicted ones")
    offset = code.constant("reading_offset", filter.offset)
    C, D = code.constant("filter_C", filter.C), code.constant("filter_D", filter.D)
    code.add(
        f"for (i = 0; i < {sensors}; i++)"
        f" {innovation}[i] = {code.readings}[i] - {offset}[i];",
        sensors,
    )
    code.multiply_add(innovation, C, x, sensors, states, -1)
    if np.any(filter.D):
        code.multiply_add(innovation, D, code.command, sensors, code.actuators, -1)
    else:
        del code.constants["filter_D"]
    code.multiply_add(x, code.constant("filter_gain", filter.gain), innovation, states, sensors)
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
        code.add("/* Estimate: states of the actuators from beam and commands of the last period */")
        _write_actuator_states(code, filter, x, modes)
    gain = float(filter.difference_gain)
    smoothing = 1 - gain * float(filter.period)
    code.add(
        f"/* Estimate: coordinates from the deflections, rates from their differences */\n"
        f"for (i = 0; i < {sensors}; i++) {reading}[i] = {code.readings}[i] - {offset}[i];",
        sensors,
    )
    code.multiply(coordinate, inverse, reading, modes, sensors)
    code.add(
        f"""
for (i = 0; i < {modes}; i++) {{
    {x}[{modes} + i] = (real){smoothing!r} * {x}[{modes} + i]
                       + (real){gain!r} * ({coordinate}[i] - {x}[i]);
    {x}[i] = {coordinate}[i];
}}""",
        4 * modes,
    )
    return EstimateCode(x, filter.plant_states)


def _write_actuator_states(code: CSource, filter: InversionFilter, x: str, modes: int) -> None:
    """States of the actuators over a period, driven by the held beam and the commands."""
    transition: Any = filter.actuator_transition
    count, beam = np.shape(transition.matrix)[0], 2 * modes
    # The beam is held over the whole period: its columns of both inputs add.
    previous, present = (
        np.asarray(part) for part in (transition.previous_input_matrix, transition.input_matrix)
    )
    lumped = Transition(
        np.concatenate([previous[:, :beam] + present[:, :beam], transition.matrix], axis=1),
        previous[:, beam:],
        present[:, beam:],
        transition.noise_covariance,
    )
    _predict(code, lumped, "actuator", x, code.command, beam, count)


def _predict(
    code: CSource,
    transition: Transition,
    name: str,
    x: str,
    command: str,
    first: int = 0,
    rows: int | None = None,
) -> None:
    """Prediction of the states x, or of some `rows` of them from the `first`, over a period.

    The command that acted until the previous sample is kept for a transition that has it.
    """
    A, previous, present = (
        np.asarray(part)
        for part in (
            transition.matrix,
            transition.previous_input_matrix,
            transition.input_matrix,
        )
    )
    rows, columns = A.shape if rows is None else (rows, A.shape[1])
    predicted = code.work(f"{name}_prediction", rows, "predicted states")
    code.multiply(predicted, code.constant(f"{name}_A", A), x, rows, columns)
    if np.any(previous):
        last = code.state(f"{name}_last", np.zeros(code.actuators), "commands before")
        matrix = code.constant(f"{name}_B_last", previous)
        code.multiply_add(predicted, matrix, last, rows, code.actuators)
        code.add(f"copy({last}, {command}, {code.actuators});")
    if np.any(present):
        matrix = code.constant(f"{name}_B", present)
        code.multiply_add(predicted, matrix, command, rows, code.actuators)
    code.add(f"copy({x} + {first}, {predicted}, {rows});")
