"""Checks that loads with suspensions share; each returns an error message, or None."""

from typing import Any

import jax
import numpy as np

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.loads.vehicle_model import VehicleModel

_LOAD_TOLERANCE = 1e-9  # of the mean wheel load: a smaller one carries nothing


def known_numbers(part: Any) -> bool:
    """Whether no number of a part is traced by `jit` or `vmap`."""
    return all(is_concrete(leaf) for leaf in jax.tree.leaves(part))


def positive_error(address: str, part: Any, names: tuple[str, ...], reason: str) -> str | None:
    """Error of the first number among some fields of a part that is not positive."""
    for name in names:
        value = getattr(part, name)
        if value is None or not is_concrete(value):
            continue
        numbers = np.atleast_1d(concrete(value))
        wrong = np.flatnonzero(numbers <= 0)
        if wrong.size:
            entry = f".{wrong[0]}" if np.ndim(value) else ""
            return f"{address}.{name}{entry} must be positive: {reason}"
    return None


def length_error(address: str, part: Any, first: str, names: tuple[str, ...]) -> str | None:
    """Error of the first list among some fields that is not as long as that of the field first."""
    expected = np.shape(getattr(part, first))[0]
    for name in names:
        value = getattr(part, name)
        if value is None or not np.ndim(value) or np.shape(value)[0] == expected:
            continue
        return (
            f"{address}.{name} has {np.shape(value)[0]} entries and {first} has {expected};"
            " give one for each axle, front first"
        )
    return None


def static_load_error(address: str, vehicle: VehicleModel) -> str | None:
    """Error of a vehicle without static equilibrium, or with a wheel that presses on nothing.

    `vehicle` is that of any gravity.
    """
    if not is_concrete(vehicle.static_loads):
        return None
    stiffness = concrete(vehicle.full_stiffness)
    scale = np.sqrt(np.abs(np.diag(stiffness)))
    held = np.all(scale > 0) and np.linalg.matrix_rank(stiffness / np.outer(scale, scale)) == len(
        scale
    )
    if not held:
        return (
            f"{address} has no static equilibrium: its springs hold {_loose(vehicle)} in no"
            " place; add a spring or an axle"
        )
    loads = concrete(vehicle.static_loads)
    for i, load in enumerate(loads):
        if load <= _LOAD_TOLERANCE * np.mean(np.abs(loads)):
            sign = "a negative static load" if load < 0 else "no static load"
            return (
                f"axle {i + 1} of {address} would carry {sign}; move it, or the centres of mass,"
                " so that every axle is pressed down"
            )
    return None


def _loose(vehicle: VehicleModel) -> str:
    """Degrees of freedom that move most where no spring resists."""
    values, vectors = np.linalg.eigh(concrete(vehicle.full_stiffness))
    return repr(vehicle.names[int(np.argmax(np.abs(vectors[:, 0])))])
