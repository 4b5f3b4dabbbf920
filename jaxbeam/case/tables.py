"""Tables of files as parts of a case, by the declarations of their fields.

Cases declare their entries in the fields of their classes (`parts`); other files, such as load
cases and descriptions of logs, declare a kind of entry for each key.
"""

import dataclasses
import inspect
import math
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxbeam.case.fields import (
    OF_QUANTITY,
    check_field,
    describe_shape,
    describe_value,
    find_kind,
    fits_shape,
    kinds,
    missing_error,
    suggestion,
)
from jaxbeam.case.sensors import unit_of
from jaxbeam.case.toml_file import check_entries, check_length, in_si, with_attribute_names

# Words of what is not in the model of a beam; the nearest key would be another thing.
OUTSIDE = re.compile(r"skew|torsion|twist|eccentric|frame|grillage")
MAX_NUMBER = 2.0**1023  # above, whole numbers do not fit into a float


class Entry(NamedTuple):
    """Kind of an entry: how an error describes it, and whether a value is of it."""

    description: str
    fits: Callable[[Any], bool]


def is_number(value: Any) -> bool:
    """Whether a value of a TOML file is a finite number that fits into a float."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return abs(value) < MAX_NUMBER and math.isfinite(value)


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def _is_numbers(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(map(is_number, value))


def _is_tables(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, dict) for one in value)


WORD = Entry("a word in quotes", lambda value: isinstance(value, str))
NUMBER = Entry("a number", is_number)
COUNT = Entry("a whole number, 0 or more", _is_count)
NUMBERS = Entry("a list of numbers, such as [0.2, 0.5]", _is_numbers)
TABLE = Entry("a table", lambda value: isinstance(value, dict))
TABLES = Entry("a list of tables", _is_tables)


def check_entry(address: str, value: Any, entry: Entry) -> None:
    """Validate the kind of an entry. Raises ValueError with the address."""
    if not entry.fits(value):
        raise ValueError(f"{address} must be {entry.description}, not {describe_value(value)}")


def check_table(address: str, table: dict[str, Any], declared: Mapping[str, Entry]) -> None:
    """Validate keys and kinds of entries of a table by their declarations.

    `address` is that of the table, empty for the whole file. Raises ValueError with the address of
    the entry; for an unknown key with the nearest that is declared.
    """
    prefix = f"{address}." if address else ""
    for key, value in table.items():
        if key not in declared:
            raise ValueError(f"unknown key {prefix}{key}; {suggestion(key, declared)}")
        check_entry(f"{prefix}{key}", value, declared[key])


def read_part(address: str, table: dict[str, Any], part_class: type) -> Any:
    """The part of a case that a table describes.

    `part_class` is its class, or an abstract class of which the table's `kind` names a subclass.
    Raises ValueError, with the address, for keys and kinds that are unknown or missing and for
    values of the wrong type or shape.
    """
    values = dict(table)
    if inspect.isabstract(part_class):
        part_class = _class_of_kind(address, values.pop("kind", None), part_class)
    fields = {field.name: field for field in dataclasses.fields(part_class) if field.metadata}
    values = with_attribute_names(address, values, fields)
    default_quantity = fields["quantity"].default if "quantity" in fields else None
    for key, value in values.items():
        if key not in fields:
            hint = suggestion(key, fields)
            if OUTSIDE.search(str(key)):
                hint = (
                    "a beam has no skew, torsion or frame: give one girder its share of the loads,"
                    " by the distribution factors of a code, or take a program for grillages"
                )
            raise ValueError(f"{address} has no key {describe_value(key)}; {hint}")
        inner_class = fields[key].metadata.get("part")
        if inner_class is not None and isinstance(value, dict):
            values[key] = read_part(f"{address}.{key}", value, inner_class)
        elif "parts" in fields[key].metadata:
            values[key] = read_parts(f"{address}.{key}", value, fields[key].metadata["parts"])
        else:
            if isinstance(value, list):
                check_entries(f"{address}.{key}", value)
            values[key] = _in_si(
                f"{address}.{key}", value, _unit(fields[key], values, default_quantity)
            )
            _check_type(f"{address}.{key}", values[key], fields[key])
    for name, field in fields.items():
        if field.default is dataclasses.MISSING and name not in values:
            raise missing_error(f"{address}.{name}", field)
    return part_class(**values)


def read_parts(address: str, tables: Any, part_class: type) -> tuple[Any, ...]:
    """The parts that a list of tables describes.

    Raises ValueError, with the address, if it is no such list or too long, and as `read_part` does.
    """
    if not isinstance(tables, list) or not all(isinstance(table, dict) for table in tables):
        listed = re.sub(r"\.\d+", "", address).removeprefix(".")
        raise ValueError(f"{address} must be a list of tables; write [[{listed}]]")
    check_length(address, len(tables))
    return tuple(read_part(f"{address}.{i}", one, part_class) for i, one in enumerate(tables))


def _class_of_kind(address: str, kind: Any, family: type) -> type:
    if isinstance(kind, str):
        found = find_kind(family, kind)
        if found is not None:
            return found
    classes = kinds(family)
    if kind is None:
        raise ValueError(f"{address}.kind is missing; it may be {', '.join(classes)}")
    hint = suggestion(str(kind), classes)
    raise ValueError(f"{address}.kind cannot be {describe_value(kind)}; {hint}")


def _in_si(address: str, value: Any, unit: str) -> Any:
    """An entry with its quantities in SI units; words and counts stay."""
    return in_si(value, unit, address) if unit and isinstance(value, str | list) else value


def _unit(field: dataclasses.Field, values: dict[str, Any], default_quantity: Any) -> str:
    """SI unit of an entry of a table, "" for a word or a count."""
    unit = field.metadata.get("unit", "")
    if unit == OF_QUANTITY:
        quantity = values.get("quantity", default_quantity)
        return (unit_of(quantity) if isinstance(quantity, str) else None) or unit
    return unit


def _check_type(address: str, value: Any, field: dataclasses.Field) -> None:
    """Validate the entry of a field in a file, before it becomes an array."""
    if "unit" not in field.metadata:
        check_field(address, value, field)
        return
    shape = _shape(value)
    if shape is None or not fits_shape(field, shape):
        raise ValueError(f"{address} must be {describe_shape(field)}, not {describe_value(value)}")


def _shape(value: Any) -> tuple[int, ...] | None:
    """Shape of a number or of nested lists of numbers; None for anything else.

    A whole number that is too large for a float is not a number here.
    """
    if not isinstance(value, list):
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return () if is_number and (isinstance(value, float) or abs(value) < 2**1023) else None
    shapes = {_shape(entry) for entry in value} or {()}
    entry_shape = shapes.pop()
    return None if shapes or entry_shape is None else (len(value), *entry_shape)
