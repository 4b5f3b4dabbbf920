"""Where a rig is driven and where it is read, in words: inputs and outputs of responses.

Inputs:
    actuators.I                    command of actuator I, in V or N
    actuators.I.active_force       what it makes of its command, such as the force of a coil
    force@X                        force on the beam at X m
Outputs:
    sensors.I                      what sensor I would read without noise, filter and delay
    deflection@X, velocity@X, acceleration@X, slope@X
    actuators.I.current            current in the coil of an electrodynamic shaker
    actuators.I.active_force       as above
    actuators.I.transmitted_force  what reaches the beam, after its own mass and suspension

For an actuator that acts on slopes, as a patch does, forces are moments.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxbeam.case.actuators import AbstractActuator, Electrodynamic
from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam, suggestion
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.model.modal_model import Rig

AT_A_POINT = ("deflection", "velocity", "acceleration", "slope")  # strain also needs a fibre
OF_ACTUATOR = ("current", "active_force", "transmitted_force")


class Pair(NamedTuple):
    """An input, an output, and the unit of the output per input."""

    input: str
    output: str
    unit: str

    def __str__(self) -> str:
        return f"{self.input} -> {self.output}"

    @property
    def source(self) -> str:
        """The input that drives the rig: the command behind an active force."""
        return self.input.removesuffix(".active_force")


def shaker_chain(index: int) -> tuple[tuple[str, str], ...]:
    """The chain of an electrodynamic shaker, eqs (2.26) to (2.34) of the thesis, as pairs.

    Voltage to current, voltage to coil force, coil force to transmitted force, and voltage to
    transmitted force, of the actuator of this number.
    """
    volts = f"actuators.{index}"
    coil, passed = f"{volts}.active_force", f"{volts}.transmitted_force"
    return (volts, f"{volts}.current"), (volts, coil), (coil, passed), (volts, passed)


def common_pairs(case: Case) -> tuple[tuple[str, str], ...]:
    """Every command to every sensor, and the chains of electrodynamic shakers.

    Without commands: a force at each sensor to that sensor. Raises ValueError if a case has
    neither.
    """
    pairs = []
    for i, actuator in enumerate(case.actuators):
        if takes_commands(actuator):
            pairs += [(f"actuators.{i}", f"sensors.{j}") for j in range(len(case.sensors))]
        if isinstance(actuator, Electrodynamic):
            pairs += shaker_chain(i)
    if not pairs:
        places = [float(sensor.position) for sensor in case.sensors]
        pairs = [(f"force@{place:g}", f"sensors.{j}") for j, place in enumerate(places)]
    if not pairs:
        raise ValueError(
            "the case has neither sensors nor actuators; name an input and an output, such as"
            " force@0.3 and deflection@0.3"
        )
    return tuple(pairs)


def check_pairs(case: Case, pairs: Iterable[Sequence[str]]) -> tuple[Pair, ...]:
    """The pairs with their units. Raises ValueError for words that mean nothing in the case."""
    checked = []
    for source, output in pairs:
        above, below = _output_unit(case, output), _input_unit(case, source)
        above = f"({above})" if set(above) & set("/ ") else above
        below = f"({below})" if " " in below else below
        unit = "1" if above == below else f"{above}/{below}"
        checked.append(Pair(source, output, unit))
    if not checked:
        raise ValueError("name at least one pair of an input and an output")
    return tuple(checked)


def column(case: Case, model: Rig, source: str):
    """What an input does to the rates of the states, (state,), and to the commands (actuator,)."""
    commands = jnp.zeros(len(case.actuators))
    if "@" in source:
        place = float(source.partition("@")[2])
        return _spread(model, model.shapes(place, (0,))[0], 1), commands
    index = int(source.split(".")[1])
    return model.command_matrix[:, index], commands.at[index].set(1.0)


def row(case: Case, model: Rig, output: str):
    """Rows that take the states, their rates (both (state,)) and the commands to an output."""
    nothing, direct = jnp.zeros(model.states), jnp.zeros(len(case.actuators))
    name, at, place = output.partition("@")
    if at or name.startswith("sensors."):
        if at:
            quantity, place, fibre = name, float(place), None
        else:
            sensor = case.sensors[int(name.split(".")[1])]
            quantity, place, fibre = sensor.quantity, sensor.position, sensor.fibre_distance
        derivative = {"slope": 1, "strain": 2}.get(quantity, 0)
        shape = model.shapes(place, (derivative,))[0]
        shape = -fibre * shape if quantity == "strain" else shape
        if quantity == "acceleration":
            return nothing, _spread(model, shape, 1), direct
        return _spread(model, shape, int(quantity == "velocity")), nothing, direct
    _, index, what = name.split(".")
    index = int(index)
    devices = [actuator.attachment() for actuator in case.actuators]
    sizes = [device.state_matrix.shape[0] for device in devices]
    start = 2 * model.modes.stiffness.shape[0] + sum(sizes[:index])
    device, own = devices[index], np.arange(start, start + sizes[index])
    if what == "current":
        return nothing.at[own].set(1.0), nothing, direct
    active = nothing.at[own].set(device.output_matrix)
    direct = direct.at[index].set(device.feedthrough)
    if what == "active_force":
        return active, nothing, direct
    stroke = model.strokes[index]
    held = device.stiffness * _spread(model, stroke, 0) + device.damping * _spread(model, stroke, 1)
    mass = 0.0 if device.mass is None else device.mass
    return active - held, -mass * _spread(model, stroke, 1), direct


def _spread(model: Rig, shape, first: int):
    """A row over the coordinates as one over the states: on q (first = 0) or on q' (1)."""
    places = np.arange(first, 2 * model.modes.stiffness.shape[0], 2)
    return jnp.zeros(model.states).at[places].set(shape)


def _input_unit(case: Case, word: str) -> str:
    name, at, place = word.partition("@")
    if at:
        if name != "force":
            raise ValueError(f"the input {word!r} must be a force, as force@0.3")
        _check_place(case, word, place)
        return "N"
    actuator, what = _actuator(case, word, "input")
    if not takes_commands(actuator):
        raise ValueError(f"the input {word!r} takes no command")
    if what not in ("", "active_force"):
        raise ValueError(
            f"the input {word!r} does not exist; an actuator is driven by its command, its address"
            " alone, or by its active_force"
        )
    return _force_unit(actuator) if what else _command_unit(actuator)


def _output_unit(case: Case, word: str) -> str:
    name, at, place = word.partition("@")
    if at:
        if name not in AT_A_POINT:
            hint = suggestion(name, AT_A_POINT)
            raise ValueError(f"the output {word!r} does not exist; {hint}, as deflection@0.3")
        _check_place(case, word, place)
        return QUANTITIES[name]
    if name.startswith("sensors."):
        return QUANTITIES[case.sensors[_index(word, "sensors", len(case.sensors))].quantity]
    actuator, what = _actuator(case, word, "output")
    if what not in OF_ACTUATOR:
        raise ValueError(f"the output {word!r} does not exist; {suggestion(what, OF_ACTUATOR)}")
    if what == "current" and not isinstance(actuator, Electrodynamic):
        kind = type(actuator).__name__
        raise ValueError(f"the output {word!r} does not exist: a {kind} has no coil")
    return "A" if what == "current" else _force_unit(actuator)


def _actuator(case: Case, word: str, role: str) -> tuple[AbstractActuator, str]:
    """The actuator that a word names, and what of it."""
    if not word.startswith("actuators."):
        known = "actuators.0 or force@0.3" if role == "input" else "sensors.0 or deflection@0.3"
        raise ValueError(f"the {role} {word!r} does not exist; write, for example, {known}")
    _, _, *what = word.split(".", 2)
    return case.actuators[_index(word, "actuators", len(case.actuators))], "".join(what)


def _index(word: str, family: str, count: int) -> int:
    number = word.split(".")[1]
    if not number.isdigit() or int(number) >= count:
        raise ValueError(f"{word!r} does not exist; the case has {count} {family}, from 0")
    return int(number)


def _check_place(case: Case, word: str, place: str) -> None:
    try:
        x = float(place)
    except ValueError:
        raise ValueError(f"{word!r}: {place!r} is not a number in m") from None
    check_on_beam(repr(word), x, case.beam.length)


def takes_commands(actuator: AbstractActuator) -> bool:
    """Whether an actuator does something with a command, as a passive one does not."""
    return _command_unit(actuator) != "1"


def _command_unit(actuator: AbstractActuator) -> str:
    """The unit of the limits is that of the command; "1" if there is none."""
    return type(actuator).__dataclass_fields__["limits"].metadata["unit"]


def _force_unit(actuator: AbstractActuator) -> str:
    return "N m" if any(order == 1 for _, order, _ in actuator.stroke()) else "N"
