"""Tables of files that people write, checked against declarations of their entries.

Cases declare their entries in the fields of their classes (`parts`); other files, such as load
cases and descriptions of logs, declare a kind of entry for each key.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from jaxbeam.case.declared_checks import describe_value, suggestion

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
