"""Frequency responses of beam, absorbers and actuators, with stationary masses on the beam.

With the states z of the modal model and s = 2 pi i f,

    (s E - A) z = B u + shapes(y) . force,    y = (C + s C') z + D u.

E is the identity plus the stationary masses, eq. (2.30) of the thesis; C' acts on the rates z'.
Heights and rates of the absorbers' bodies follow the states of the model.

Channels are given by name.

Inputs:
    actuators.I                    command of actuator I, in V or N
    actuators.I.active_force       force that its command generates, such as that of a coil
    force@X                        force on the beam at X m
Outputs:
    sensors.I                      reading of sensor I without noise, filter and delay
    deflection@X, velocity@X, ...  quantity at X m (`case.sensors`, but those at a fibre)
    actuators.I.current            current in the coil of an electrodynamic shaker
    actuators.I.voltage            voltage across it, which an inner loop sets
    actuators.I.active_force       as above
    actuators.I.transmitted_force  force on the beam: active force less that of mass and suspension

The forces of an actuator that acts on slopes, such as a patch, are moments.
"""

import os
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from jaxbeam.case.actuators.base import AbstractActuator
from jaxbeam.case.actuators.electrodynamic import Electrodynamic
from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case
from jaxbeam.case.fields import (
    check_on_beam,
    concrete,
    is_concrete,
    real_numbers,
    refuses_traced,
    suggestion,
)
from jaxbeam.case.sensors import QUANTITIES, Sensor
from jaxbeam.case.validation import check_case
from jaxbeam.model.elements import held_positions
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.model.output_rows import row_on_states, sensor_rows
from jaxbeam.runtime.arrays import Array, Module, add_at, set_at, solve, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.runtime.printer import TableViews, counted, labelled_dataset

POINT_QUANTITIES = tuple(
    name for name, entry in QUANTITIES.items() if not (entry.at_fibre or entry.over_modulus)
)
COIL_UNITS = {"current": "A", "voltage": "V"}
ACTUATOR_QUANTITIES = (*COIL_UNITS, "active_force", "transmitted_force")


class ChannelPair(NamedTuple):
    """An input, an output, and the unit of the output per input."""

    input: str
    output: str
    unit: str

    def __str__(self) -> str:
        return f"{self.input} -> {self.output}"

    @property
    def excitation(self) -> str:
        """Input of the model: for an active force, the command that generates it."""
        return self.input.removesuffix(".active_force")


def shaker_channels(index: int) -> tuple[tuple[str, str], ...]:
    """Pairs (input, output) along an electrodynamic shaker, eqs (2.26) to (2.34) of the thesis.

    Voltage to current, voltage to coil force, coil force to transmitted force, and voltage to
    transmitted force, of the actuator with this index.
    """
    command = f"actuators.{index}"
    coil_force, transmitted_force = f"{command}.active_force", f"{command}.transmitted_force"
    return (
        (command, f"{command}.current"),
        (command, coil_force),
        (coil_force, transmitted_force),
        (command, transmitted_force),
    )


def common_pairs(case: Case) -> tuple[tuple[str, str], ...]:
    """Default pairs (input, output): each command with each sensor, and `shaker_channels`.

    Without commands, a force at each sensor and that sensor; the force stands at the middle of the
    longest span for a sensor on a rigid support. Raises ValueError if a case has neither.
    """
    pairs = []
    for i, actuator in enumerate(case.actuators):
        if actuator.accepts_commands:
            pairs += [(f"actuators.{i}", f"sensors.{j}") for j in range(len(case.sensors))]
        if isinstance(actuator, Electrodynamic):
            pairs += shaker_channels(i)
    if not pairs:
        positions = [_force_position(case, float(sensor.position)) for sensor in case.sensors]
        pairs = [(f"force@{x:g}", f"sensors.{j}") for j, x in enumerate(positions)]
    if not pairs:
        raise ValueError(
            "the case has neither sensors nor actuators; name an input and an output, such as"
            " force@0.3 and deflection@0.3"
        )
    return tuple(pairs)


def _force_position(case: Case, x: float) -> float:
    """Position (m) of the force for a sensor at x m: the same, but on no rigid support."""
    length, held = float(concrete(case.beam.length)), held_positions(case)
    elastic = [float(concrete(s.position)) for s in case.supports if s.stiffness is not None]
    rigid = np.setdiff1d(held, elastic)
    if not np.any(np.abs(rigid - x) < 1e-9 * length):
        return x
    marks = np.unique([0.0, *held, length])
    longest = np.argmax(np.diff(marks))
    return float(np.mean(marks[longest : longest + 2]))


def check_pairs(case: Case, pairs: Iterable[Sequence[str]]) -> tuple[ChannelPair, ...]:
    """Pairs (input, output) of a case with their units.

    Raises ValueError for channels that the case does not have.
    """
    checked = []
    for source, output in pairs:
        output_unit, input_unit = _output_unit(case, output), _input_unit(case, source)
        output_unit = f"({output_unit})" if set(output_unit) & set("/ ") else output_unit
        input_unit = f"({input_unit})" if " " in input_unit else input_unit
        unit = "1" if output_unit == input_unit else f"{output_unit}/{input_unit}"
        checked.append(ChannelPair(source, output, unit))
    if not checked:
        raise ValueError("name at least one pair of an input and an output")
    return tuple(checked)


def input_column(case: Case, model: ModalModel, input: str):
    """Input vector (state,) on the rates of the states, and commands (actuator,), of an input."""
    commands = xp.zeros(len(case.actuators))
    if "@" in input:
        position = float(input.partition("@")[2])
        return row_on_states(model, model.shapes(position, (0,))[0], 1), commands
    index = int(input.split(".")[1])
    return model.command_matrix[:, index], set_at(commands, index, 1.0)


def output_row(case: Case, model: ModalModel, output: str):
    """Rows of an output on the states, on their rates (both (state,)) and on the commands."""
    zero_row, feedthrough = xp.zeros(model.state_count), xp.zeros(len(case.actuators))
    name, at_point, position = output.partition("@")
    if at_point or name.startswith("sensors."):
        sensor = (
            Sensor(float(position), name) if at_point else case.sensors[int(name.split(".")[1])]
        )
        rows = sensor_rows(model, case, [sensor])
        on_states, on_rates = rows.on_states(model)
        return on_states[0], on_rates[0], rows.on_commands[0]
    _, index, actuator_output = name.split(".")
    index = int(index)
    attachments = [actuator.attachment() for actuator in case.actuators]
    sizes = [device.state_matrix.shape[0] for device in attachments]
    start = 2 * model.mode_count + sum(sizes[:index])
    attachment, device_states = attachments[index], np.arange(start, start + sizes[index])
    displacement, actuator = model.displacement_map[index], case.actuators[index]
    if isinstance(actuator, Electrodynamic) and actuator_output != "transmitted_force":
        port = actuator.coil_port()
        signal = port.voltage if actuator_output == "voltage" else port.current
        factor = actuator.force_constant if actuator_output == "active_force" else 1.0
        on_states = set_at(zero_row, device_states, signal.states)
        for order in (0, 1):
            on_states = on_states + signal.port[order] * row_on_states(model, displacement, order)
        on_rates = signal.port[2] * row_on_states(model, displacement, 1)
        feedthrough = set_at(feedthrough, index, factor * signal.command)
        return factor * on_states, factor * on_rates, feedthrough
    active_force = set_at(zero_row, device_states, attachment.output_matrix)
    feedthrough = set_at(feedthrough, index, attachment.feedthrough)
    if actuator_output == "active_force":
        return active_force, zero_row, feedthrough
    suspension_force = attachment.stiffness * row_on_states(
        model, displacement, 0
    ) + attachment.damping * row_on_states(model, displacement, 1)
    mass = 0.0 if attachment.mass is None else attachment.mass
    return (
        active_force - suspension_force,
        -mass * row_on_states(model, displacement, 1),
        feedthrough,
    )


def _input_unit(case: Case, channel: str) -> str:
    name, at_point, position = channel.partition("@")
    if at_point:
        if name != "force":
            raise ValueError(f"the input {channel!r} must be a force, as force@0.3")
        _check_position(case, channel, position)
        return "N"
    actuator, actuator_input = _parse_actuator(case, channel, "input")
    if not actuator.accepts_commands:
        raise ValueError(f"the input {channel!r} takes no command")
    if actuator_input not in ("", "active_force"):
        raise ValueError(
            f"the input {channel!r} does not exist; an actuator is driven by its command, its"
            " address alone, or by its active_force"
        )
    return _force_unit(actuator) if actuator_input else actuator.command_unit


def _output_unit(case: Case, channel: str) -> str:
    name, at_point, position = channel.partition("@")
    if at_point:
        if name not in POINT_QUANTITIES:
            hint = suggestion(name, POINT_QUANTITIES)
            raise ValueError(f"the output {channel!r} does not exist; {hint}, as deflection@0.3")
        _check_position(case, channel, position)
        return QUANTITIES[name].unit
    if name.startswith("sensors."):
        return case.sensors[_parse_index(channel, "sensors", len(case.sensors))].unit
    actuator, actuator_output = _parse_actuator(case, channel, "output")
    if actuator_output not in ACTUATOR_QUANTITIES:
        raise ValueError(
            f"the output {channel!r} does not exist;"
            f" {suggestion(actuator_output, ACTUATOR_QUANTITIES)}"
        )
    if actuator_output in COIL_UNITS and not isinstance(actuator, Electrodynamic):
        kind = type(actuator).__name__
        raise ValueError(f"the output {channel!r} does not exist: a {kind} has no coil")
    return COIL_UNITS.get(actuator_output) or _force_unit(actuator)


def _parse_actuator(case: Case, channel: str, role: str) -> tuple[AbstractActuator, str]:
    """Actuator that a channel names, and its quantity ("" for the command).

    Raises ValueError for a channel of another kind, or of an actuator that the case does not have.
    """
    if not channel.startswith("actuators."):
        examples = "actuators.0 or force@0.3" if role == "input" else "sensors.0 or deflection@0.3"
        raise ValueError(f"the {role} {channel!r} does not exist; write, for example, {examples}")
    _, _, *quantity = channel.split(".", 2)
    return case.actuators[_parse_index(channel, "actuators", len(case.actuators))], "".join(
        quantity
    )


def _parse_index(channel: str, family: str, count: int) -> int:
    number = channel.split(".")[1]
    if not number.isdigit() or int(number) >= count:
        raise ValueError(f"{channel!r} does not exist; the case has {count} {family}, from 0")
    return int(number)


def _check_position(case: Case, channel: str, position: str) -> None:
    try:
        x = float(position)
    except ValueError:
        raise ValueError(f"{channel!r}: {position!r} is not a number in m") from None
    check_on_beam(repr(channel), x, case.beam.length)


def _force_unit(actuator: AbstractActuator) -> str:
    return "N m" if any(order == 1 for _, order, _ in actuator.displacement_map()) else "N"


if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX
    from matplotlib.figure import Figure, SubFigure

__all__ = [
    "accelerance",
    "frequency_response",
    "mobility",
    "receptance",
]

StationaryMasses = Sequence[tuple[Any, Any]]  # position (m) and mass (kg) of each


class FrequencyResponse(TableViews, Module):
    """Frequency responses at `frequencies` (Hz), one column for each pair of input and output.

    `values` are complex amplitudes of the output per input, in the `unit` of the pair; their phase
    is that by which the output leads.
    """

    frequencies: Float[Array, " frequency"]
    values: Complex[Array, "frequency pair"]
    pairs: tuple[ChannelPair, ...] = eqx.field(static=True)
    title: str = eqx.field(static=True, default="")

    def __repr__(self) -> str:
        pairs = "".join(f"\n  {p}" + f", in {p.unit}" * (p.unit != "1") for p in self.pairs)
        if not is_concrete(self.frequencies) or self.frequencies.ndim != 1:  # of jit or vmap
            return f"FrequencyResponse{pairs}"
        first, last = concrete(self.frequencies)[[0, -1]]
        count = self.frequencies.size
        return (
            f"FrequencyResponse at {counted(count, 'frequency', 'frequencies')}, {first:.4g}"
            f" to {last:.4g} Hz{pairs}"
        )

    @property
    def magnitude(self) -> Float[Array, "frequency pair"]:
        """Amplitude of the output per amplitude of the input, in the unit of the pair."""
        return xp.abs(self.values)

    @property
    def phase(self) -> Float[Array, "frequency pair"]:
        """Phase by which the output leads the input in degrees, without jumps of a full turn."""
        return xp.degrees(xp.unwrap(xp.angle(self.values), axis=0))

    def of(self, input: str, output: str) -> Complex[Array, " frequency"]:
        """Response of one pair. Raises ValueError if there is none of it."""
        for i, pair in enumerate(self.pairs):
            if (pair.input, pair.output) == (input, output):
                return self.values[:, i]
        available = ", ".join(map(str, self.pairs))
        raise ValueError(f"there is no response of {output} to {input}; there are {available}")

    def plot(self, **options: Any) -> "Figure | SubFigure":
        """Magnitude and phase; see `jaxbeam.plot.plot_frequency_response` and its options."""
        from jaxbeam.plot import plot_frequency_response

        return plot_frequency_response(self, **options)

    @property
    @refuses_traced("a table")
    def columns(self) -> dict[str, np.ndarray]:
        """Frequency (Hz), and magnitude and phase (degrees) of each pair, by head."""
        columns = {"frequency (Hz)": np.asarray(self.frequencies)}
        magnitude, phase = np.asarray(self.magnitude), np.asarray(self.phase)
        for i, pair in enumerate(self.pairs):
            unit = "" if pair.unit == "1" else f" ({pair.unit})"
            columns[f"{pair} magnitude{unit}"] = magnitude[:, i]
            columns[f"{pair} phase (degree)"] = phase[:, i]
        return columns

    @refuses_traced("a dataset")
    def to_xarray(self) -> "xarray.Dataset":
        """Labelled dataset with units, of real variables that every file format can hold."""
        dims = ("frequency", "pair")
        values = np.asarray(self.values)
        return labelled_dataset(
            {
                "magnitude": (dims, np.asarray(self.magnitude), {"units": "that of the pair"}),
                "phase": (dims, np.asarray(self.phase), {"units": "degree"}),
                "real": (dims, values.real, {"units": "that of the pair"}),
                "imaginary": (dims, values.imag, {"units": "that of the pair"}),
            },
            {
                "frequency": ("frequency", np.asarray(self.frequencies), {"units": "Hz"}),
                "pair": ("pair", [str(pair) for pair in self.pairs]),
                "input": ("pair", [pair.input for pair in self.pairs]),
                "output": ("pair", [pair.output for pair in self.pairs]),
                "unit": ("pair", [pair.unit for pair in self.pairs]),
            },
            {"title": self.title},
        )

    @checks_classes
    def to_netcdf(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the labelled dataset to a netCDF file.

        Raises FileExistsError if the file exists and `overwrite` is not set.
        """
        with whole_file(path, overwrite) as partial:
            self.to_xarray().to_netcdf(partial, engine="scipy")


@checks_classes
def frequency_response(
    case: Case,
    frequencies,
    pairs: Sequence[tuple[str, str]] | None = None,
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> FrequencyResponse:
    """Frequency responses of a case at `frequencies` (Hz), without its loads.

    `pairs` are (input, output) by the names of `channels`, by default those of `common_pairs`.
    `stationary_masses` are pairs of position (m) and mass (kg) that vibrate with the beam. Exact
    for the modes that the case keeps. Differentiable in every number of the case and in the
    frequencies. Inside `jit`, pass the `layout` found outside by `model.modes.mesh_layout(case)`.

    Raises ValueError for an invalid case, negative frequencies, an unknown input or output, or a
    stationary mass that is negative or off the beam.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(
    ...         length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03
    ...     ),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 1.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ... )
    >>> responses = jb.frequency_response(case, [5.0, 20.0])
    >>> print(responses.values.shape)  # frequency, pair
    (2, 1)
    """
    check_case(case)
    frequencies, masses = (
        _checked_frequencies(frequencies),
        checked_masses(case, stationary_masses),
    )
    checked_pairs = check_pairs(case, common_pairs(case) if pairs is None else pairs)
    layout = mesh_layout(case) if layout is None else layout
    values = _responses(case, layout, frequencies, masses, checked_pairs)
    return FrequencyResponse(frequencies, values, checked_pairs, case.title)


@compiled_if_traced
def _responses(case: Case, layout: Layout, frequencies, stationary, pairs: tuple[ChannelPair, ...]):
    model = modal_model(case, layout)
    inputs = [input_column(case, model, pair.excitation) for pair in pairs]
    input_matrix = xp.stack([input_vector for input_vector, _ in inputs], axis=-1)
    states = _state_responses(case, model, stationary, frequencies, input_matrix)
    s = 2j * xp.pi * frequencies
    responses = []
    for i, (pair, (_, command)) in enumerate(zip(pairs, inputs, strict=True)):
        response = _evaluate_output(
            output_row(case, model, pair.output), states[:, :, i], s, command
        )
        if pair.excitation != pair.input:  # an active force is itself an output: take the ratio
            response = response / _evaluate_output(
                output_row(case, model, pair.input), states[:, :, i], s, command
            )
        responses.append(response)
    return xp.stack(responses, axis=-1)


def _evaluate_output(row, states, s, command):
    state_row, rate_row, feedthrough = row
    return states @ state_row + s * (states @ rate_row) + feedthrough @ command


def _state_responses(
    case: Case, model: ModalModel, stationary, frequencies, input_matrix
) -> Complex[Array, "frequency state input"]:
    """States per unit of each input (column of the input matrix), at every frequency (Hz)."""
    A, E = descriptor_matrices(case, model, stationary)
    s = 2j * xp.pi * frequencies[:, None, None]
    added = A.shape[0] - model.state_count
    states = solve(s * E - A, xp.pad(input_matrix, ((0, added), (0, 0))) + 0j)
    return states[:, : model.state_count]


def descriptor_matrices(case: Case, model: ModalModel, stationary):
    """A and E of the model with absorbers and stationary masses: (positions in m, masses in kg).

    Heights and rates of the absorbers' bodies follow the states of the model, as oscillators
    equivalent to them (see `jaxbeam.case.absorbers`).
    """
    positions, kilograms = stationary
    shapes = model.shapes(positions, (0,))[0]
    added_mass = (shapes.T * kilograms) @ shapes
    rates, coordinates = model.rate_index, model.coordinate_index
    A, E = model.A, add_at(xp.eye(model.state_count), (rates, rates), added_mass)
    for absorber in case.absorbers:
        oscillator, body = absorber.vehicle(case.run.gravity), A.shape[0]
        shape = model.shapes(xp.reshape(absorber.position, 1), (0,))[0]
        A, E = (xp.pad(matrix, (0, 2)) for matrix in (A, E))
        A = set_at(A, (body, body + 1), 1.0)
        identity = np.eye(2)
        E = set_at(E, np.s_[body:, body:], identity)
        # The pull of spring and damper over the mass of the body, and on the modes.
        for columns, own, factor in (
            (coordinates, body, oscillator.contact_stiffness),
            (rates, body + 1, oscillator.contact_damping),
        ):
            on_body = factor / oscillator.mass[0, 0]
            A = add_at(A, (rates, columns), -factor * shape.T @ shape)
            A = add_at(A, (rates, own), factor * shape[0])
            A = add_at(A, (body + 1, columns), on_body * shape[0])
            A = add_at(A, (body + 1, own), -on_body[0])
        E = add_at(E, (rates, rates), oscillator.wheel_masses * shape.T @ shape)
    return A, E


@checks_classes
def receptance(
    case: Case,
    frequencies,
    x,
    y,
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> Complex[Array, "..."]:
    """Receptance: deflection at x per force at y, in m/N, (frequency, x..., y...).

    Positions x and y (m) may have any shapes; differentiable in them too. Other arguments and
    errors are those of `frequency_response`.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> static = jb.frequency_responses.receptance(jb.Case(beam), [0.0], 0.3, 0.3)
    >>> print(f"{abs(static[0]) * 48 * 11.68 / 0.6**3:.3f}")  # of three modes; over L^3 / (48 E I)
    0.998
    """
    check_case(case)
    frequencies, masses = (
        _checked_frequencies(frequencies),
        checked_masses(case, stationary_masses),
    )
    layout = mesh_layout(case) if layout is None else layout
    x, y = _checked_position(case, "x", x), _checked_position(case, "y", y)
    return _receptance(case, layout, frequencies, masses, x, y)


@compiled_if_traced
def _receptance(case: Case, layout: Layout, frequencies, stationary, x, y):
    model = modal_model(case, layout)
    input_matrix = xp.zeros((model.state_count, y.size))
    input_matrix = set_at(input_matrix, model.rate_index, model.shapes(y.reshape(-1), (0,))[0].T)
    states = _state_responses(case, model, stationary, frequencies, input_matrix)
    amplitudes = states[:, model.coordinate_index]
    response = model.shapes(x.reshape(-1), (0,))[0] @ amplitudes
    return response.reshape(frequencies.size, *x.shape, *y.shape)


@checks_classes
def mobility(
    case: Case,
    frequencies,
    x,
    y,
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> Complex[Array, "..."]:
    """Mobility: velocity at x per force at y, in m/(N s); s x receptance, eq. (2.29).

    Positions are those of `receptance`, other arguments those of `frequency_response`.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> print(jb.frequency_responses.mobility(jb.Case(beam), [10.0, 20.0], 0.3, 0.3).shape)
    (2,)
    """
    response = receptance(case, frequencies, x, y, stationary_masses, layout)
    return _differentiated(frequencies, response)


@checks_classes
def accelerance(
    case: Case,
    frequencies,
    x,
    y,
    stationary_masses: StationaryMasses = (),
    layout: Layout | None = None,
) -> Complex[Array, "..."]:
    """Accelerance: acceleration at x per force at y, in 1/kg, s^2 x receptance.

    Positions are those of `receptance`, other arguments those of `frequency_response`.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> print(jb.frequency_responses.accelerance(jb.Case(beam), [10.0], 0.3, 0.3).shape)
    (1,)
    """
    return _differentiated(
        frequencies, mobility(case, frequencies, x, y, stationary_masses, layout)
    )


def _differentiated(frequencies, response):
    s = 2j * xp.pi * xp.asarray(frequencies, float)
    return s.reshape(-1, *(1,) * (response.ndim - 1)) * response


def resonances_and_antiresonances(
    response: FrequencyResponse, index: int
) -> list[tuple[str, float, float]]:
    """Features of the response of pair `index`: (kind, frequency in Hz, magnitude).

    "first" is that at the first frequency; each "peak" and "dip" is the vertex of the parabola
    through three neighbouring frequencies.
    """
    f, magnitude = np.asarray(response.frequencies), np.asarray(response.magnitude)[:, index]
    extrema = [("first", float(f[0]), float(magnitude[0]))]
    for i in range(1, f.size - 1):
        left, right = magnitude[i - 1] - magnitude[i], magnitude[i + 1] - magnitude[i]
        if left * right <= 0:
            continue
        curve = np.polyfit(f[i - 1 : i + 2] - f[i], magnitude[i - 1 : i + 2], 2)
        offset = -curve[1] / (2 * curve[0])
        kind = "dip" if right > 0 else "peak"
        extrema.append((kind, float(f[i] + offset), float(np.polyval(curve, offset))))
    return extrema


def _checked_frequencies(frequencies):
    frequencies = xp.atleast_1d(real_numbers("frequencies", frequencies, "Hz"))
    if frequencies.ndim != 1 or not frequencies.size:
        raise ValueError(f"frequencies must be a list of numbers, not of shape {frequencies.shape}")
    if is_concrete(frequencies):
        values = concrete(frequencies)
        invalid = ~(np.isfinite(values) & (values >= 0))
        if invalid.any():
            raise ValueError(
                f"frequencies must be finite and not negative, in Hz; found {values[invalid][0]:g}"
            )
    return frequencies


def checked_masses(case: Case, stationary_masses: StationaryMasses):
    """Positions (mass,) in m and masses (mass,) in kg, after checks.

    Raises ValueError for a negative mass and a position off the beam.
    """
    positions = xp.array([position for position, _ in stationary_masses], float).reshape(-1)
    masses = xp.array([mass for _, mass in stationary_masses], float).reshape(-1)
    if is_concrete(masses):
        for mass in concrete(masses):
            if not 0 <= mass < np.inf:
                raise ValueError(f"a stationary mass must not be negative; it is {mass:g} kg")
    return _checked_position(case, "the position of a stationary mass", positions), masses


def _checked_position(case: Case, name: str, x):
    x = real_numbers(name, x, "m", "positions")
    check_on_beam(name, x, case.beam.length)
    return x
