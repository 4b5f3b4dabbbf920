"""Validation by declarations of fields: type, shape, unit and range of each.

Numbers traced by `jit` or `vmap` are skipped. Rules that concern several fields of a part are in
its method `validate(address)`; those that several parts share are here.
"""

import dataclasses
import difflib
import inspect
import reprlib
from collections.abc import Iterable
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    PROBABILITY,
    concrete,
    describe_shape,
    fits_shape,
    is_concrete,
    kinds,
)
from jaxbeam.case.former_words import KINDS, WORDS
from jaxbeam.case.limits import check_count, check_entries, check_length
from jaxbeam.case.quantities import OF_QUANTITY
from jaxbeam.runtime.arrays import Array

SHORT_REPR = reprlib.Repr()  # shortens wrong values, which error messages quote
SHORT_REPR.maxstring, SHORT_REPR.maxlist, SHORT_REPR.maxdict = 80, 10, 10

# Sizes of numbers: products and quotients of three do not overflow. What must be positive divides.
SMALLEST, LARGEST = 1e-100, 1e100
POSITION_TOLERANCE = 1e-9  # of the length: 3 * 0.2 is still on a beam of 0.6 m


def check_on_beam(name: str, positions: Any, length: Float[Array, ""]) -> None:
    """Validate positions on a beam of a length (all in m); traced numbers are skipped.

    Raises ValueError with the name.
    """
    if not (is_concrete(positions) and is_concrete(length)):
        return
    end, numbers = float(concrete(length)), concrete(positions)
    outside = ~(
        (numbers >= -POSITION_TOLERANCE * end) & (numbers <= (1 + POSITION_TOLERANCE) * end)
    )
    if outside.any():
        given = float(numbers[outside].flat[0])
        unit = ": is it in m, not in mm?" if 0 < given / 1000 <= end else ""
        raise ValueError(f"{name} must {ON_BEAM}, between 0 and {end:g} m; it is {given:g} m{unit}")


def suggestion(word: str, allowed: Iterable[str]) -> str:
    """End of an error message about an unknown word: the nearest allowed one, or all of them."""
    allowed = list(allowed)
    if WORDS.get(word) in allowed:
        return f"it is called {WORDS[word]!r} now"
    kind, options = KINDS.get(word, (None, ""))
    if kind in allowed:
        return f"it is kind {kind!r} with {options} now"
    nearest = difflib.get_close_matches(word, allowed, n=1)
    return f"did you mean {nearest[0]!r}?" if nearest else f"it may be {', '.join(allowed)}"


def missing_error(address: str, field: dataclasses.Field) -> ValueError:
    """Error for a field that is left out and has no default."""
    return ValueError(f"{address} is missing; give the {field.metadata['meaning']}{in_unit(field)}")


def check_fields(address: str, part: Any) -> None:
    """Validate the fields of a part by their declarations; raises ValueError with the address."""
    values = vars(part)  # attributes of a module take many times as long to get
    for field in dataclasses.fields(part):
        check_field(f"{address}.{field.name}", values[field.name], field)


def check_field(address: str, value: Any, field: dataclasses.Field) -> None:
    """Validate a value by the declaration of its field; raises ValueError with the address."""
    if "unit" in field.metadata:
        _check_number(address, value, field)
    elif "minimum" in field.metadata:
        minimum = field.metadata["minimum"]
        if value is None and field.default is None:
            return
        if not isinstance(value, int) or isinstance(value, bool) or value < minimum:
            raise ValueError(
                f"{address} must be a whole number, {minimum} or more; it is"
                f" {describe_value(value)}"
            )
        check_count(address, value)
    elif "part" in field.metadata:
        part_class = field.metadata["part"]
        if value is not None and not isinstance(value, part_class):
            members = kinds(part_class).values() if inspect.isabstract(part_class) else [part_class]
            names = " or ".join(member.__name__ for member in members)
            raise ValueError(
                f"{address} holds {describe_value(value)}; it takes a table of its own, in Python a"
                f" {names}"
            )
        if value is not None:
            check_fields(address, value)
    elif "parts" in field.metadata:
        check_length(address, len(value))
        for i, one in enumerate(value):
            if not isinstance(one, field.metadata["parts"]):
                name = field.metadata["parts"].__name__
                raise ValueError(
                    f"{address}.{i} holds {describe_value(one)}; it takes a table of its own, in"
                    f" Python a {name}"
                )
            check_fields(f"{address}.{i}", one)
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
    """Error of a property that is not given by exactly one of two ways, or None.

    The property is given by the field `direct`, or derived from all of the sources.
    `shared_sources` serve other properties too, so they may be given together with `direct`.
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
    verb = "is" if len(absent) == 1 else "are"
    which = "" if len(absent) == len(sources) else f" (of which {', '.join(absent)} {verb} missing)"
    return (
        f"{address}.{direct} is missing; give it, or all of {', '.join(sources[:-1])} and"
        f" {sources[-1]}{which}"
    )


def validate_exactly_one(address: str, part: Any, first: str, second: str) -> str | None:
    """Error of two fields of which both or none are given, or None."""
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
    check_entries(address, value)
    if not is_concrete(value):
        return
    numbers = np.atleast_1d(concrete(value))
    if _all_allowed(numbers, field.metadata["constraint"]):
        return
    names = [f"{address}.{i}" for i in range(numbers.size)] if np.ndim(value) else [address]
    constraint, unit = field.metadata["constraint"], _unit_suffix(field)
    for name, x in zip(names, numbers.flat, strict=True):
        if not np.isfinite(x):
            raise ValueError(f"{name} must be a finite number; it is {x}")
        if (
            (constraint == POSITIVE and x <= 0)
            or (constraint == NOT_NEGATIVE and x < 0)
            or (constraint == PROBABILITY and not 0 <= x < 1)
        ):
            raise ValueError(f"{name} must {constraint}; it is {x:g}{unit}")
        if abs(x) > LARGEST or (constraint == POSITIVE and x < SMALLEST):
            bound = f"at most {LARGEST:g}" if abs(x) > LARGEST else f"at least {SMALLEST:g}"
            raise ValueError(f"the size of {name} must be {bound}{unit}; it is {x:g}{unit}")
    if constraint == INCREASING:
        _check_increasing(names, numbers, unit)


def _all_allowed(numbers: np.ndarray, constraint: str) -> bool:
    """Whether all numbers of a list satisfy a constraint and are not too large."""
    if not np.all(np.abs(numbers) <= LARGEST):  # also not if one is NaN
        return False
    if constraint == POSITIVE:
        return bool(np.all(numbers >= SMALLEST))
    if constraint == PROBABILITY:
        return bool(np.all((numbers >= 0) & (numbers < 1)))
    if constraint == NOT_NEGATIVE:
        return bool(np.all(numbers >= 0))
    return constraint != INCREASING or not np.any(numbers[1:] <= numbers[:-1])


def _check_increasing(names: list[str], numbers: np.ndarray, unit: str) -> None:
    not_increasing = np.flatnonzero(numbers[1:] <= numbers[:-1])  # differences may overflow
    if not_increasing.size:
        i = not_increasing[0] + 1
        raise ValueError(
            f"{names[i]} must be above the entry before it;"
            f" {numbers[i]:g}{unit} follows {numbers[i - 1]:g}{unit}"
        )


def _unit_suffix(field: dataclasses.Field) -> str:
    """Unit of a field as it follows a number, with a space before it."""
    unit = field.metadata.get("unit", "1")
    return "" if unit in ("1", OF_QUANTITY) else f" {unit}"


def in_unit(field: dataclasses.Field) -> str:
    """Unit of a field in words, such as " in N/m"; empty where it has none."""
    return f" in{_unit_suffix(field)}" if _unit_suffix(field) else ""


def describe_value(value: Any) -> str:
    """A wrong value as error messages quote it."""
    if isinstance(value, str | bool | int | float | list | dict):
        return SHORT_REPR.repr(value)
    return f"a {type(value).__name__}"
