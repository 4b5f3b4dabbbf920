"""Case: all that one simulation needs, and the addresses of its numbers."""

import dataclasses
import difflib
import functools
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.actuators.base import AbstractActuator
from jaxbeam.case.arguments import checks_classes, describe_value, wrong_class
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.contact import AbstractContact
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.display import ReprWithUnits, case_html, case_text
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    OF_QUANTITY,
    POSITIVE,
    check_fields,
    choice,
    concrete,
    count,
    is_concrete,
    is_real,
    number,
)
from jaxbeam.case.former_words import present_address
from jaxbeam.case.loads.base import AbstractLoad, wheel_distances
from jaxbeam.case.loads.vehicle_parts import VehicleSensor
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.sensors import Sensor
from jaxbeam.case.toml_file import attribute_address, in_si
from jaxbeam.case.track import Track, windows
from jaxbeam.case.trajectory import AbstractPiecewiseTrajectory
from jaxbeam.runtime.arrays import Array, Module, Number, set_at, xp

ALL = "*"


def each_address(address: str, counts: Mapping[str, int]) -> list[str]:
    """Addresses that an address stands for: itself, or with `*` that of each part of the list.

    `counts` has the number of parts at the keys of a case that hold lists.

    Raises ValueError if `*` stands elsewhere than for the parts of such a list, or for none.
    """
    key, *rest = address.split(".")
    if ALL not in address:
        return [address]
    if len(rest) < 2 or rest[0] != ALL or ALL in "".join(rest[1:]) or key not in counts:
        lists = ", ".join(f"{name}.*" for name in counts)
        raise ValueError(
            f"{address}: * stands for all parts of a list and is followed by a name, as in"
            f" loads.*.speed; lists are {lists}"
        )
    if not counts[key]:
        raise ValueError(f"{address} stands for no number: the case has no {key}")
    return [".".join([key, str(i), *rest[1:]]) for i in range(counts[key])]


def check_distinct(numbers: Mapping[str, Iterable[str]]) -> None:
    """Check that no two addresses give one number, as loads.*.speed and loads.0.speed do.

    Nor a list and an entry of it, as beam.damping_ratio and beam.damping_ratio.0. `numbers` has the
    addresses of those that each stands for. Raises ValueError that names both.
    """
    owners: dict[str, str] = {}
    for address, each in numbers.items():
        for one in each:
            if one in owners:
                raise _given_twice(owners[one], address, one)
            owners[one] = address
    for one, address in owners.items():
        whole = one.rpartition(".")[0]
        while whole:
            if whole in owners:
                raise _given_twice(owners[whole], address, one)
            whole = whole.rpartition(".")[0]


def _given_twice(first: str, second: str, number: str) -> ValueError:
    return ValueError(f"{first} and {second} both give the number {number}: leave one of them out")


class Run(ReprWithUnits):
    """Duration of a run, sampling rate of its record, gravity, and seed of what is random.

    Noise, lost readings and commands, and their random delays have random numbers of their own.

    >>> import jaxbeam as jb
    >>> run = jb.Run(duration=1.5, sample_rate=200.0)
    >>> case = jb.Case(jb.Beam(0.6, 12.0, 0.5), run=run)
    >>> print(jb.simulate(case).times.size)
    301
    """

    duration: Float[Number, ""] = number("s", "simulated time, from 0", POSITIVE)
    sample_rate: Float[Number, ""] = number(
        "Hz", "saved samples per second", POSITIVE, default=1000.0
    )
    gravity: Float[Number, ""] = number(
        "m/s^2", "acceleration of gravity", NOT_NEGATIVE, default=9.81
    )
    seed: int = count("seed of noise, dropout and jitter", minimum=0, default=0)


class Case(Module):
    """Beam, supports, absorbers, actuators, sensors, loads, track, profile, controller, run.

    Sensors are on the beam; `vehicle_sensors` are on bodies and axles of the loads.

    An immutable tree: `replace(case, {"loads.0.mass": 0.3})` or `equinox.tree_at` return a changed
    copy. Every number has an address, its dotted path. Its fields are the keys of a case file.

    >>> import jaxbeam as jb
    >>> case = jb.Case(jb.Beam(0.6, 12.0, 0.5), sensors=[jb.Sensor(0.3)], run=jb.Run(1.0))
    >>> print(jb.replace(case, {"sensors.0.position": 0.2}).sensors[0].position)
    0.2
    """

    beam: Beam
    supports: tuple[Support, ...] = ()
    absorbers: tuple[Absorber, ...] = ()
    actuators: tuple[AbstractActuator, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    loads: tuple[AbstractLoad, ...] = ()
    vehicle_sensors: tuple[VehicleSensor, ...] = ()
    track: Track | None = None
    profile: AbstractProfile | None = None
    contact: AbstractContact | None = None
    controller: AbstractController | None = None
    run: Run | None = None
    title: str = choice("title of the case", default="")

    def __init__(
        self,
        beam: Beam,
        supports: Iterable = (),
        actuators: Iterable = (),
        sensors: Iterable = (),
        loads: Iterable = (),
        controller=None,
        run: Run | None = None,
        title: str = "",
        profile=None,
        vehicle_sensors: Iterable = (),
        absorbers: Iterable = (),
        contact=None,
        track: Track | None = None,
    ):
        self.beam = beam
        self.supports = _listed("supports", supports)
        self.absorbers = _listed("absorbers", absorbers)
        self.actuators = _listed("actuators", actuators)
        self.sensors = _listed("sensors", sensors)
        self.loads = _listed("loads", loads)
        self.vehicle_sensors = _listed("vehicle_sensors", vehicle_sensors)
        self.track = track
        self.profile = profile
        self.contact = contact
        self.controller = controller
        self.run = Run(duration=1.0) if run is None else run
        self.title = title

    def __repr__(self) -> str:
        return case_text(self)

    def _repr_html_(self) -> str:  # in notebooks
        return case_html(self)

    @property
    def sensor_positions(self) -> Float[Array, " sensor"]:
        """Positions of the sensors, distances from the left end (m)."""
        return xp.array([sensor.position for sensor in self.sensors]).reshape(-1)

    @property
    def driven(self) -> tuple[AbstractActuator, ...]:
        """Actuators that take commands: all but springs and dampers."""
        return tuple(actuator for actuator in self.actuators if actuator.command_unit != "1")

    @property
    def carried(self) -> tuple[AbstractLoad | Absorber, ...]:
        """Loads, then absorbers: the parts with wheels, in the order of the wheels."""
        return (*self.loads, *self.absorbers)

    @checks_classes
    def trajectory(self, load: AbstractLoad | Absorber) -> AbstractPiecewiseTrajectory:
        """Trajectory of the first wheel of a load of the case."""
        travels = isinstance(load, AbstractLoad) and load.speed is not None
        if self.track is not None and travels and load.start_position is None:
            start = self.track.start(load.speed, self.beam.length)
            load = dataclasses.replace(load, start_position=start)
        return load.trajectory(self.beam.length)

    @property
    def on_rail(self) -> bool:
        """Whether wheels run on a rail, that of a track of layers."""
        return self.track is not None and self.track.layered

    @property
    def lifts(self) -> bool:
        """Whether the wheels of loads leave the beam where they would have to pull."""
        return self.contact is not None and self.contact.lifts and bool(self.loads)

    @property
    def all_sensors(self) -> tuple[Sensor | VehicleSensor, ...]:
        """Sensors on the beam, then those on vehicles: the channels of a log."""
        return (*self.sensors, *self.vehicle_sensors)


def _listed(key: str, listed: Any) -> tuple:
    """Parts at a key that holds any number of them. Raises ValueError where they are no list."""
    if not isinstance(listed, Iterable) or isinstance(listed, type):
        raise ValueError(f"{key} takes a list of parts, not {describe_value(listed)}")
    return tuple(listed)


class PartClass(typing.NamedTuple):
    """Class of the parts at a key of a case; `listed` if the key holds any number of them."""

    part_class: type
    listed: bool


@functools.cache
def part_classes() -> dict[str, PartClass]:
    """Classes of the parts of a case by their keys, in the order of a case file.

    They follow from the annotations of `Case`; an abstract class has its kinds in `kinds`.
    """
    classes = {}
    for key, annotation in typing.get_type_hints(Case).items():
        arguments = typing.get_args(annotation)  # of tuple[X, ...] or X | None
        part_class = arguments[0] if arguments else annotation
        if dataclasses.is_dataclass(part_class):
            listed = typing.get_origin(annotation) is tuple
            classes[key] = PartClass(typing.cast(type, part_class), listed)
    return classes


def parts(case: Case) -> Iterator[tuple[str, Any, type]]:
    """Parts of a case: address, part, and the class that it must have."""
    for key, (part_class, listed) in part_classes().items():
        value = getattr(case, key)
        if listed:
            for i, part in enumerate(value):
                yield f"{key}.{i}", part, part_class
        elif value is not None:
            yield key, value, part_class


def _key_name(key) -> str:
    """Name or index in one step of a tree path."""
    return str(getattr(key, "name", getattr(key, "idx", getattr(key, "key", key))))


def leaves_by_address(case: Case) -> dict[str, Any]:
    """Arrays of a case by address, in the order of its leaves."""
    leaves, structure = jax.tree.flatten(case)
    return dict(zip(_addresses_of(structure), leaves, strict=True))


@functools.lru_cache(maxsize=64)  # `replace` takes 0.03 ms, 0.05 without
def _addresses_of(structure) -> list[str]:
    """Addresses of the leaves of all cases of a structure."""
    numbered = jax.tree.unflatten(structure, range(structure.num_leaves))
    paths = jax.tree_util.tree_leaves_with_path(numbered)
    return [".".join(map(_key_name, path)) for path, _ in paths]


@checks_classes
def addresses(case: Case) -> dict[str, Float[Array, "..."]]:
    """All numbers of a case by address, in SI units.

    A list has an address as a whole, `beam.damping_ratio`, and one for each entry,
    `beam.damping_ratio.0`; an entry of a matrix has row and column, `controller.gain.0.2`. Where an
    address is taken, `loads.*.speed` stands for the speed of all loads, and so for other lists.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(jb.addresses(case)["loads.0.speed"])
    2.0
    """
    numbers = {}
    for address, leaf in leaves_by_address(case).items():
        numbers[address] = leaf
        if xp.ndim(leaf):
            entries = np.ndindex(xp.shape(leaf))
            numbers |= {".".join([address, *map(str, entry)]): leaf[entry] for entry in entries}
    return numbers


def unknown_address_error(case: Case, address: str) -> ValueError:
    """Error for an address that a case does not have, with the nearest one that it has."""
    if _is_left_out(case, address):
        return ValueError(
            f"the case has no number at address {address!r}, as it is left out there: give it a"
            " value first"
        )
    key = address.partition(".")[0]
    if getattr(case, key, case) in (None, ()):
        return ValueError(
            f"the case has no number at address {address!r}, as it has no {key}: add one first"
        )
    names = list(addresses(case))
    nearest = difflib.get_close_matches(present_address(address), names, n=1, cutoff=0.5)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else f"; it has {', '.join(names)}"
    return ValueError(f"the case has no number at address {address!r}{hint}")


def _is_left_out(case: Case, address: str) -> bool:
    """Whether the optional number at the address is None."""
    part: Any = case
    *parents, name = address.split(".")
    for key in parents:
        listed = isinstance(part, tuple) and key.isdecimal() and int(key) < len(part)
        part = part[int(key)] if listed else getattr(part, key, None)
    return part is not None and getattr(part, name, part) is None


def check_is_case(case: Any) -> None:
    """Check that what a function is given is a case, of parts of the right classes.

    Raises TypeError for anything else, ValueError for a part of another class.
    """
    if not isinstance(case, Case):
        raise TypeError(wrong_class("case", case, Case))
    for address, part, part_class in parts(case):
        if not isinstance(part, part_class):
            raise ValueError(
                f"{address} holds {describe_value(part)}; it takes objects of type"
                f" {part_class.__name__}"
            )


def list_sizes(case: Case) -> dict[str, int]:
    """Numbers of parts at the keys of a case that hold lists of parts."""
    return {key: len(getattr(case, key)) for key, found in part_classes().items() if found.listed}


def own_addresses(case: Case, address: str) -> list[str]:
    """Addresses of the numbers that an address stands for, in present words.

    One number, or for `loads.*.speed`, say, that of every load.

    Raises ValueError, with the nearest address of the case, if one of them has no number.
    """
    return _own_addresses(case, address, leaves_by_address(case))


def _own_addresses(case: Case, address: str, leaves: dict[str, Any]) -> list[str]:
    current = attribute_address(address)
    found = each_address(current, list_sizes(case))
    for one in found:
        parent, entry = _parent_and_entry(one, leaves)
        if parent is None or (entry and not _has_entry(leaves[parent], entry)):
            if one == current:
                raise unknown_address_error(case, address)
            key, index, name = one.split(".", 2)
            raise ValueError(
                f"{address} stands for a number of all {key}, and {key}.{index} has no {name}:"
                " name those that have it, one by one"
            )
    return found


def value_at(case: Case, address: str) -> Float[Array, "..."]:
    """The number at an address, in SI units; at `loads.*.speed` the one that all loads have.

    Raises ValueError, with the nearest address of the case, if there is none, and if the numbers
    for which the address stands differ.
    """
    leaves, values = leaves_by_address(case), []
    for one in _own_addresses(case, address, leaves):
        parent, entry = _parent_and_entry(one, leaves)
        values.append(leaves[parent][entry] if entry else leaves[parent])
    if len(values) > 1 and all(map(is_concrete, values)):
        numbers = [concrete(value) for value in values]
        if not all(np.array_equal(number, numbers[0]) for number in numbers):
            raise ValueError(
                f"{address} stands for numbers that differ, {', '.join(map(str, numbers))}: set"
                " them to one value first, or name one of them"
            )
    return values[0]


def unit_at(case: Case, address: str) -> str:
    """SI unit of the number at an address; "" or "1" if it has none."""
    unit, part = "", case
    each = own_addresses(case, address) if ALL in address else [attribute_address(address)]
    for name in each[0].split("."):
        if isinstance(part, tuple):
            part = part[int(name)]
        elif dataclasses.is_dataclass(part):
            unit = type(part).__dataclass_fields__[name].metadata.get("unit", "")
            if isinstance(part, Sensor | VehicleSensor) and unit == OF_QUANTITY:
                unit = part.unit
            part = getattr(part, name)
        elif ", " in unit:  # an entry of a list of several units
            unit = unit.split(", ")[int(name)]
    return unit


@checks_classes
def replace(case: Case, values: dict[str, Any]) -> Case:
    """A copy of a case with other numbers at some addresses (SI units, or as text with a unit).

    `loads.*.speed` sets the speed of all loads. It is differentiable by the values. Raises
    ValueError for an unknown address, one that some load lacks, two that stand for one number, or
    a wrong shape.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(jb.replace(case, {"loads.0.mass": 0.2}).loads[0].mass)
    0.2
    """
    leaves, structure = jax.tree.flatten(case)
    index = {address: i for i, address in enumerate(_addresses_of(structure))}
    numbers = dict(zip(index, leaves, strict=True))
    owned = {key: _own_addresses(case, key, numbers) for key in values}
    check_distinct(owned)
    each = [(one, values[key]) for key, own in owned.items() for one in own]
    for address, value in each:
        if isinstance(value, str | list | tuple):
            value = in_si(value, unit_at(case, address), address)
        if not is_real(value):
            raise ValueError(f"{address} takes real numbers, not {describe_value(value)}")
        value = xp.asarray(value, float)
        parent, entry = _parent_and_entry(address, index)
        if address in index:
            current = leaves[index[address]]
            if xp.shape(value) != xp.shape(current):
                raise ValueError(
                    f"{address} takes a value of shape {xp.shape(current)}, not {xp.shape(value)}"
                )
            leaves[index[address]] = value
        else:
            if value.shape:
                shape = "x".join(map(str, value.shape))
                raise ValueError(f"{address} takes one number, not a list of {shape}")
            leaves[index[parent]] = set_at(leaves[index[parent]], entry, value)
    return jax.tree_util.tree_unflatten(structure, leaves)


def _parent_and_entry(address: str, leaves: dict[str, Any]) -> tuple[str | None, tuple[int, ...]]:
    """Address of the list or matrix that has an entry, and the indices of the entry in it.

    An address of a whole number or list has no indices; (None, ()) if there is none.
    """
    parent, entry = address, ()
    while parent not in leaves:
        parent, _, last = parent.rpartition(".")
        if not last.isdigit():
            return None, ()
        entry = (int(last), *entry)
    return parent, entry


def _has_entry(leaf, entry: tuple[int, ...]) -> bool:
    """Whether a list or matrix has an entry of these indices."""
    shape = xp.shape(leaf)
    return len(entry) == len(shape) and all(i < n for i, n in zip(entry, shape, strict=True))


def concrete_case(case: Case) -> Case:
    """The case with concrete numbers, also while it is differentiated.

    Raises `jaxbeam.case.fields.TracedNumberError` if it is traced by `jit` or `vmap`, ValueError
    for what is no number or no part.
    """
    leaves = leaves_by_address(case)
    if not all(map(is_real, leaves.values())):
        for address, part, _ in parts(case):
            check_fields(address, part)
    found = [concrete(leaf, address) for address, leaf in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(case), found)


def structure_of(case: Case) -> Case:
    """The case without its loads, profile, contact, controller and run."""
    parts = case.beam, case.supports, case.actuators, case.sensors
    return Case(*parts, absorbers=case.absorbers, track=case.track)


def stack_cases(cases: Sequence[Case]) -> Case:
    """Cases of the same structure as one, whose numbers have the cases as their first axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *cases)


def crossing_times(case: Case) -> Float[np.ndarray, "load 2"]:
    """Times (s) at which each load enters, with its first wheel, and leaves, with its last.

    It leaves at `NEVER` if it stays.

    Raises `jax.errors.ConcretizationTypeError` if the case is traced.
    """
    found = []
    for load in case.loads:
        behind = wheel_distances(load, load.vehicle(case.run.gravity))
        entry, leave = windows(case.track, case.trajectory(load), behind)
        found.append((np.min(concrete(entry)), np.max(concrete(leave))))
    return np.array(found).reshape(-1, 2)


SINGULARS = {"bodies": "body", "masses": "mass"}


def address_words(case: Case, address: str) -> str:
    """Words for a number or word of a case: "speed of the load", "stiffness of support 1".

    A part that is the only one of its list has no number; a sensor with a name has its name. A
    train of the library is called so.
    """
    *keys, field = address.split(".")
    entry = ""
    while field.isdigit() and keys:
        entry, field = f" {field}{entry}", keys.pop()
    owners, part = [], case
    for key in keys:
        if key.isdigit() or key == ALL:
            owners[-1] = _of_list(part, owners[-1], key)
            part = part[0 if key == ALL else int(key)] if isinstance(part, tuple) else None
        else:
            owners.append(key)
            part = getattr(part, key, None)
    owners = [one if " " in one else f"the {_spaced(one)}" for one in owners if one != "run"]
    if owners and owners[-1] == f"the {field}":  # a train of the library
        return field
    return " of ".join([f"{_spaced(field)}{entry}", *reversed(owners)])


def value_words(case: Case, address: str, value: float | str) -> str:
    """A value at an address with its SI unit: "speed of the load: 2 m/s"."""
    words = address_words(case, address)
    if isinstance(value, str):
        return f"{words}: {value}"
    unit = unit_at(case, address)
    return f"{words}: {value:.6g} {'' if unit == '1' else unit}".rstrip()


def _of_list(parts, key: str, index: str) -> str:
    """Words for one part of a list, or all of them: "load 1", "the load", "all loads"."""
    count = len(parts) if isinstance(parts, tuple) else 2
    one = SINGULARS.get(key, key.removesuffix("s"))
    part = parts[0 if index == ALL else int(index)] if isinstance(parts, tuple) else None
    if key == "loads" and getattr(part, "train", ""):
        one = "train"
    name = getattr(part, "name", "") if key == "sensors" and index != ALL else ""
    if name:
        return f"sensor {name}"
    if count == 1:
        return f"the {_spaced(one)}"
    return f"all {_spaced(key)}" if index == ALL else f"{_spaced(one)} {index}"


def _spaced(name: str) -> str:
    return name.replace("_", " ").replace("youngs", "Young's")
