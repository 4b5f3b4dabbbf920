"""The case: everything that decides a run, as one immutable tree whose numbers have addresses."""

import dataclasses
import difflib
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.actuators import AbstractActuator
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, concrete, count, number
from jaxbeam.case.loads import AbstractLoad, trajectory
from jaxbeam.case.sensors import QUANTITIES, Sensor


class Run(eqx.Module):
    """How long to simulate, and how often to save a sample."""

    duration: Float[Array, ""] = number("s", "simulated time, from 0", POSITIVE)
    sample_rate: Float[Array, ""] = number(
        "Hz", "saved samples per second", POSITIVE, default=1000.0
    )
    gravity: Float[Array, ""] = number(
        "m/s^2", "acceleration of gravity", NOT_NEGATIVE, default=9.81
    )
    seed: int = count("which noise the sensors draw", minimum=0, default=0)


class Case(eqx.Module):
    """Beam, supports, actuators, sensors, loads, controller and run settings.

    A plain tree: make a changed copy with `replace(case, {"loads.0.mass": 0.3})` or
    `equinox.tree_at`. Every number has an address, its dotted path.
    """

    beam: Beam
    supports: tuple[Support, ...] = ()
    actuators: tuple[AbstractActuator, ...] = ()
    sensors: tuple[Sensor, ...] = ()
    loads: tuple[AbstractLoad, ...] = ()
    controller: AbstractController | None = None
    run: Run | None = None
    title: str = choice("free text", default="")

    def __init__(
        self,
        beam: Beam,
        supports=(),
        actuators=(),
        sensors=(),
        loads=(),
        controller=None,
        run: Run | None = None,
        title: str = "",
    ):
        self.beam = beam
        self.supports = tuple(supports)
        self.actuators = tuple(actuators)
        self.sensors = tuple(sensors)
        self.loads = tuple(loads)
        self.controller = controller
        self.run = Run(duration=1.0) if run is None else run
        self.title = title

    @property
    def sensor_positions(self) -> Float[Array, " sensor"]:
        """Where the sensors are along the beam (m)."""
        return jnp.array([sensor.position for sensor in self.sensors]).reshape(-1)


def _key_name(key) -> str:
    """The word or number in one step of a tree path."""
    return str(getattr(key, "name", getattr(key, "idx", getattr(key, "key", key))))


def _leaves_by_address(case: Case) -> dict[str, Any]:
    paths, _ = jax.tree_util.tree_flatten_with_path(case)
    return {".".join(_key_name(key) for key in path): leaf for path, leaf in paths}


def addresses(case: Case) -> dict[str, Float[Array, "..."]]:
    """All numbers of a case by address; each entry of a list has its own address too.

    `beam.damping_ratio` given as a list is addressed as a whole and as `beam.damping_ratio.0`, ...;
    an entry of a matrix by row and column, `controller.gain.0.2`.
    Values are in the SI unit of the field.
    """
    numbers = {}
    for address, leaf in _leaves_by_address(case).items():
        numbers[address] = leaf
        if jnp.ndim(leaf):
            entries = np.ndindex(jnp.shape(leaf))
            numbers |= {".".join([address, *map(str, entry)]): leaf[entry] for entry in entries}
    return numbers


def unknown_address_error(case: Case, address: str) -> ValueError:
    """The error for an address that the case does not have, with the nearest one it has."""
    names = list(addresses(case))
    nearest = difflib.get_close_matches(address, names, n=1, cutoff=0.5)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else f"; it has {', '.join(names)}"
    return ValueError(f"the case has no number at address {address!r}{hint}")


def value_at(case: Case, address: str) -> Float[Array, "..."]:
    """Return the number at an address.

    Raises ValueError, with the nearest known address, if there is none there.
    """
    leaves = _leaves_by_address(case)
    parent, entry = _parent_and_entry(address, leaves)
    if parent is None or (entry and not _has_entry(leaves[parent], entry)):
        raise unknown_address_error(case, address)
    return leaves[parent][entry] if entry else leaves[parent]


def unit_at(case: Case, address: str) -> str:
    """SI unit of the number at an address; "" or "1" if it has none."""
    unit, part = "", case
    for name in address.split("."):
        if isinstance(part, tuple):
            part = part[int(name)]
        elif dataclasses.is_dataclass(part):
            unit = type(part).__dataclass_fields__[name].metadata.get("unit", "")
            if isinstance(part, Sensor) and unit == "unit of quantity":
                unit = QUANTITIES[part.quantity]
            part = getattr(part, name)
    return unit


def replace(case: Case, values: dict[str, Any]) -> Case:
    """Return a copy of the case with other numbers at some addresses (SI units).

    Differentiable in the values. Raises ValueError for an unknown address or a wrong shape.
    """
    paths, structure = jax.tree_util.tree_flatten_with_path(case)
    leaves = [leaf for _, leaf in paths]
    index = {".".join(_key_name(key) for key in path): i for i, (path, _) in enumerate(paths)}
    for address, value in values.items():
        value = jnp.asarray(value, float)
        parent, entry = _parent_and_entry(address, index)
        if address in index:
            current = leaves[index[address]]
            if jnp.shape(value) != jnp.shape(current):
                raise ValueError(
                    f"{address} takes a value of shape {jnp.shape(current)}, not {jnp.shape(value)}"
                )
            leaves[index[address]] = value
        elif parent is not None and _has_entry(leaves[index[parent]], entry):
            if value.shape:
                raise ValueError(f"{address} takes one number, not {value.shape}")
            leaves[index[parent]] = leaves[index[parent]].at[entry].set(value)
        else:
            raise unknown_address_error(case, address)
    return jax.tree_util.tree_unflatten(structure, leaves)


def _parent_and_entry(address: str, leaves: dict[str, Any]) -> tuple[str | None, tuple[int, ...]]:
    """The address of the list or matrix in which an entry is, and its place there."""
    parent, entry = address, ()
    while parent not in leaves:
        parent, _, last = parent.rpartition(".")
        if not last.isdigit():
            return None, ()
        entry = (int(last), *entry)
    return parent, entry


def _has_entry(leaf, entry: tuple[int, ...]) -> bool:
    """Tell whether a list or matrix has an entry at a place."""
    shape = jnp.shape(leaf)
    return len(entry) == len(shape) and all(i < n for i, n in zip(entry, shape, strict=True))


def concrete_case(case: Case) -> Case:
    """The same case with plain numbers, also while it is being differentiated.

    Raises `jax.errors.ConcretizationTypeError` inside `jit` or `vmap`.
    """
    return jax.tree.map(lambda leaf: jnp.asarray(concrete(leaf)), case)


def stack_cases(cases: Sequence[Case]) -> Case:
    """One case with the numbers of several along a first axis; all must be alike in structure."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *cases)


def crossing_times(case: Case) -> Float[np.ndarray, "load 2"]:
    """Times (s) at which each load enters and leaves the beam; `NEVER` for one that stays on it.

    The numbers of the case must be concrete.
    """
    windows = [trajectory(load, case.beam.length).entry_exit_times() for load in case.loads]
    return np.array([[float(concrete(time)) for time in window] for window in windows]).reshape(
        -1, 2
    )
