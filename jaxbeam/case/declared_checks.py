"""Faults of the parts of a case: what their fields declare, and what several parts have in common.

Numbers that are not known yet (a case inside `jit` or `vmap`) are passed over. What belongs
together within one part, that part says itself: its method `fault(address)` gives the sentence.
"""

import dataclasses
import difflib
import reprlib
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    concrete,
    describe_shape,
    fits_shape,
    is_concrete,
)

SHORT_REPR = reprlib.Repr()  # what is wrong is quoted, but not without end
SHORT_REPR.maxstring, SHORT_REPR.maxlist, SHORT_REPR.maxdict = 80, 10, 10

POSITION_TOLERANCE = 1e-9  # of the length: 3 * 0.2 is still on a beam of 0.6 m


def check_on_beam(name: str, positions: Any, length: Float[Array, ""]) -> None:
    """Check that positions lie on a beam of a length, all in m, as far as they are known.

    Raises ValueError with the name of the positions.
    """
    if not (is_concrete(positions) and is_concrete(length)):
        return
    end, numbers = float(concrete(length)), concrete(positions)
    outside = ~(
        (numbers >= -POSITION_TOLERANCE * end) & (numbers <= (1 + POSITION_TOLERANCE) * end)
    )
    if outside.any():
        raise ValueError(
            f"{name} must {ON_BEAM}, between 0 and {end:g} m; it is {numbers[outside].flat[0]:g} m"
        )


def suggestion(word: str, allowed: Iterable[str]) -> str:
    """The end of a sentence about an unknown word: the nearest known one, or all of them."""
    allowed = list(allowed)
    nearest = difflib.get_close_matches(word, allowed, n=1)
    return f"did you mean {nearest[0]!r}?" if nearest else f"it may be {', '.join(allowed)}"


def missing_error(address: str, field: dataclasses.Field) -> ValueError:
    """The error for a field that was not given and has no default."""
    return ValueError(
        f"{address} is missing; give the {field.metadata['meaning']}{_in_unit(field)}"
    )


def check_fields(address: str, part: Any) -> None:
    """Check every field of a part of a case by what its declaration says.

    Raises ValueError naming the address.
    """
    values = vars(part)  # attributes of a module take many times as long to get
    for field in dataclasses.fields(part):
        check_field(f"{address}.{field.name}", values[field.name], field)


def check_field(address: str, value: Any, field: dataclasses.Field) -> None:
    """Check one field of a part of a case by what its declaration says.

    Raises ValueError naming the address.
    """
    if "unit" in field.metadata:
        _check_number(address, value, field)
    elif "least" in field.metadata:
        minimum = field.metadata["least"]
        if value is None and field.default is None:
            return
        if not isinstance(value, int) or isinstance(value, bool) or value < minimum:
            raise ValueError(
                f"{address} must be a whole number, {minimum} or more; it is {describe_value(value)}"
            )
    elif "part" in field.metadata:
        kind = field.metadata["part"]
        kinds = tuple(kind.values()) if isinstance(kind, dict) else (kind,)
        if value is not None and not isinstance(value, kinds):
            names = " or ".join(made.__name__ for made in kinds)
            raise ValueError(
                f"{address} holds {describe_value(value)}; it takes a table of its own, in Python a"
                f" {names}"
            )
        if value is not None:
            check_fields(address, value)
    elif "meaning" in field.metadata:
        if not isinstance(value, str):
            raise ValueError(f"{address} must be a word in quotes, not {describe_value(value)}")
        allowed = field.metadata["allowed"]
        if allowed and value not in allowed:
            raise ValueError(
                f"{address} cannot be {describe_value(value)}; {suggestion(value, allowed)}"
            )


def validate_direct_or_derived(
    address: str,
    part: Any,
    direct: str,
    exclusive_sources: tuple[str, ...],
    shared_sources: tuple[str, ...] = (),
) -> str | None:
    """The fault of a property given neither directly nor by all that it follows from, or by both.

    What is `shared_sources` serves other properties too, so it may stand beside the direct number.
    """
    if getattr(part, direct) is not None:
        for name in exclusive_sources:
            if getattr(part, name) is not None:
                return (
                    f"{address}.{direct} and {address}.{name} contradict each other; leave one out"
                )
        return None
    sources = (*shared_sources, *exclusive_sources)
    absent = [name for name in sources if getattr(part, name) is None]
    if not absent:
        return None
    return (
        f"{address}.{direct} is missing; give it, or all of {', '.join(sources[:-1])} and"
        f" {sources[-1]} (of which {', '.join(absent)} is missing)"
    )


def validate_exactly_one(address: str, part: Any, first: str, second: str) -> str | None:
    """The fault of two fields of which both are given, or none."""
    given = [name for name in (first, second) if getattr(part, name) is not None]
    if len(given) == 1:
        return None
    if given:
        return f"{address} has both {first} and {second}; leave one out"
    return f"{address} has neither {first} nor {second}; give one of them"


def _check_number(address: str, value: Any, field: dataclasses.Field) -> None:
    if value is None:
        if field.default is not None:
            raise missing_error(address, field)
        return
    if not isinstance(value, jax.Array | np.ndarray | np.generic | float | int):
        raise ValueError(f"{address} must be {describe_shape(field)}, not {describe_value(value)}")
    if not fits_shape(field, np.shape(value)):
        shape = np.shape(value)
        given = f"an array of shape {shape}" if shape else "one number"
        raise ValueError(f"{address} must be {describe_shape(field)}, not {given}")
    if not is_concrete(value):
        return
    numbers = np.atleast_1d(concrete(value))
    names = [f"{address}.{i}" for i in range(numbers.size)] if np.ndim(value) else [address]
    constraint, unit = field.metadata["must"], _unit_suffix(field)
    for name, x in zip(names, numbers.flat, strict=True):
        if not np.isfinite(x):
            raise ValueError(f"{name} must be a finite number; it is {x}")
        if (constraint == POSITIVE and x <= 0) or (constraint == NOT_NEGATIVE and x < 0):
            raise ValueError(f"{name} must {constraint}; it is {x:g}{unit}")
    if constraint == INCREASING:
        _check_increasing(names, numbers, unit)


def _check_increasing(names: list[str], numbers: np.ndarray, unit: str) -> None:
    not_increasing = np.flatnonzero(np.diff(numbers) <= 0)
    if not_increasing.size:
        i = not_increasing[0] + 1
        raise ValueError(
            f"{names[i]} must be above the entry before it;"
            f" {numbers[i]:g}{unit} follows {numbers[i - 1]:g}{unit}"
        )


def _unit_suffix(field: dataclasses.Field) -> str:
    """The unit to put after a number."""
    unit = field.metadata.get("unit", "1")
    return "" if unit in ("1", "unit of quantity") else f" {unit}"


def _in_unit(field: dataclasses.Field) -> str:
    return f" in{_unit_suffix(field)}" if _unit_suffix(field) else ""


def describe_value(value: Any) -> str:
    """A wrong value in the words of an error message."""
    if isinstance(value, str | bool | int | float | list | dict):
        return SHORT_REPR.repr(value)
    return f"a {type(value).__name__}"
