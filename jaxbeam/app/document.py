"""The text of a case file under changes: comments, order and units of what stays are kept."""

from collections.abc import Iterable, Mapping
from typing import Any

import tomlkit
from tomlkit.exceptions import ParseError
from tomlkit.items import AoT, Array, Table

from jaxbeam.case.case import Case, part_classes, unit_at
from jaxbeam.case.reading.units import is_quantity, number_and_unit, number_in_si


def changed(text: str, changes: Iterable[Mapping[str, Any]], case: Case | None = None) -> str:
    """The text of a case file after changes, one after the other.

    A change is {"set": address, "to": value} or {"remove": address}. Addresses are the words of
    the file, as loads.0.speed; the one after the last of a list, with a table, adds to it. A number
    that takes the place of a text with a unit is in SI units and keeps that unit, as far as the
    `case` of the text is known. Raises ValueError for text that is not TOML and for addresses that
    it does not have.

    >>> print(changed("[beam]\\nlength = 2.0  # m, all\\n", [{"set": "beam.length", "to": 3}]))
    [beam]
    length = 3  # m, all
    <BLANKLINE>
    """
    try:
        document = tomlkit.parse(text)
    except ParseError as error:
        raise ValueError(f"not valid TOML: {error}") from None
    for change in changes:
        if "remove" in change:
            _remove(document, change["remove"].split("."))
        else:
            _set(document, change["set"], change["to"], case)
    return tomlkit.dumps(document)


def _set(document: Any, address: str, value: Any, case: Case | None) -> None:
    *parents, last = address.split(".")
    node = document
    for depth, key in enumerate(parents):
        if isinstance(node, dict) and key not in node:
            listed = depth == 0 and key in part_classes() and part_classes()[key].listed
            in_table = (*parents, last)[depth + 1].isdigit()
            node[key] = tomlkit.aot() if listed or in_table else tomlkit.table()
        node = _child(node, key, address)
    if isinstance(node, list):
        _set_entry(node, last, value, address)
    elif isinstance(node, dict):
        node[last] = _as_before(node.get(last), value, address, case)
    else:
        raise ValueError(f"there is no place {address} in the file")


def _set_entry(node: Any, last: str, value: Any, address: str) -> None:
    index = int(last) if last.isdigit() else -1
    if not 0 <= index <= len(node):
        raise ValueError(f"there is no place {address} in the file")
    if isinstance(value, dict) and isinstance(node, AoT):
        value = _table(value)
    if index == len(node):
        node.append(value)
    elif isinstance(node, AoT):
        node[index].clear()
        for key, entry in value.items():
            node[index][key] = entry
    else:
        node[index] = value


def _table(content: Mapping[str, Any]) -> Table:
    table = tomlkit.table()
    for key, value in content.items():
        table[key] = value
    table.add(tomlkit.nl())
    return table


def _as_before(old: Any, value: Any, address: str, case: Case | None) -> Any:
    """A number in SI units as a text in the unit of the one before, if that had a unit."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if case is None or not is_number or not is_quantity(old):
        return value
    unit = number_and_unit(str(old))[1]
    try:
        factor = number_in_si(f"1 {unit}", unit_at(case, address), address)
    except ValueError:
        return value
    return f"{value / factor:.12g} {unit}"


def _remove(document: Any, path: list[str]) -> None:
    *parents, last = path
    address = ".".join(path)
    node = document
    for key in parents:
        node = _child(node, key, address)
    if isinstance(node, list) and last.isdigit() and int(last) < len(node):
        del node[int(last)]
        if not len(node) and isinstance(node, AoT | Array) and len(parents) == 1:
            del document[parents[0]]
    elif isinstance(node, dict) and last in node:
        del node[last]
    else:
        raise ValueError(f"there is no {address} in the file")


def _child(node: Any, key: str, address: str) -> Any:
    if isinstance(node, dict) and key in node:
        return node[key]
    if isinstance(node, list) and key.isdigit() and int(key) < len(node):
        return node[int(key)]
    raise ValueError(f"there is no place {address} in the file")
