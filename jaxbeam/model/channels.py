"""Channels of a frequency response: its inputs and outputs by name.

Inputs:
    actuators.I                    command of actuator I, in V or N
    actuators.I.active_force       force that its command generates, such as that of a coil
    force@X                        force on the beam at X m
Outputs:
    sensors.I                      reading of sensor I without noise, filter and delay
    deflection@X, velocity@X, ...  quantity at X m (`case.quantities`, but those at a fibre)
    actuators.I.current            current in the coil of an electrodynamic shaker
    actuators.I.voltage            voltage across it, which an inner loop sets
    actuators.I.active_force       as above
    actuators.I.transmitted_force  force on the beam: active force less that of mass and suspension

The forces of an actuator that acts on slopes, such as a patch, are moments.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from jaxbeam.case.actuators.base import AbstractActuator
from jaxbeam.case.actuators.electrodynamic import Electrodynamic
from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam, suggestion
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.output_rows import row_on_states, sensor_rows
from jaxbeam.runtime.arrays import set_at, xp

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

    Without commands, a force at each sensor and that sensor. Raises ValueError if a case has
    neither.
    """
    pairs = []
    for i, actuator in enumerate(case.actuators):
        if accepts_commands(actuator):
            pairs += [(f"actuators.{i}", f"sensors.{j}") for j in range(len(case.sensors))]
        if isinstance(actuator, Electrodynamic):
            pairs += shaker_channels(i)
    if not pairs:
        positions = [float(sensor.position) for sensor in case.sensors]
        pairs = [(f"force@{x:g}", f"sensors.{j}") for j, x in enumerate(positions)]
    if not pairs:
        raise ValueError(
            "the case has neither sensors nor actuators; name an input and an output, such as"
            " force@0.3 and deflection@0.3"
        )
    return tuple(pairs)


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
    if not accepts_commands(actuator):
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


def accepts_commands(actuator: AbstractActuator) -> bool:
    """Whether an actuator accepts commands; a passive one does not."""
    return actuator.command_unit != "1"


def _force_unit(actuator: AbstractActuator) -> str:
    return "N m" if any(order == 1 for _, order, _ in actuator.displacement_map()) else "N"
