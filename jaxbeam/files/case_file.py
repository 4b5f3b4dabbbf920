"""Cases as TOML files and as plain dictionaries, both ways; measured profiles in files of values.

Keys follow from the fields of the classes, kinds from the classes that declare one in a module of
`jaxbeam.case`, `jaxbeam.control` or `jaxbeam.control.estimation`: nothing is registered here.
"""

import copy
import dataclasses
import inspect
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import tomli_w

from jaxbeam.case.arguments import describe_value
from jaxbeam.case.case import (
    Case,
    check_distinct,
    check_is_case,
    each_address,
    list_sizes,
    part_classes,
    unknown_address_error,
)
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete, kind_of, kinds, refuses_traced, suggestion
from jaxbeam.case.loads.vehicles import IMPLIED, is_path
from jaxbeam.case.profiles.shapes import TableProfile
from jaxbeam.case.tables import read_part, read_parts
from jaxbeam.case.toml_file import attribute_address, read_toml
from jaxbeam.case.validation import check_case
from jaxbeam.model.plausibility.check import warn_if_implausible
from jaxbeam.runtime.input_file import read_text_input
from jaxbeam.runtime.output_file import whole_file

POINTS = ("positions", "heights", "point_heights")  # keys of a profile in the case file itself


def profile_from_file(path: str | os.PathLike) -> TableProfile:
    """Profile of a file with a position and a height (both in m) in each line.

    They are separated by a comma, semicolon, tab or spaces; further columns are left out. Empty
    lines and lines that begin with # are comments, and the first other line may name the columns.

    Raises ValueError, with the file and the line, for anything else, and for a file that is too
    large; OSError if the file cannot be read, or is a device or a pipe.

    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "road.csv"
    >>> _ = path.write_text(chr(10).join(["x, height", "0, 0", "5, 0.01", "10, 0"]))
    >>> print(profile_from_file(path).positions)
    [ 0.  5. 10.]
    """
    positions, heights = _read_points(Path(path))
    return TableProfile(positions, heights)


def with_profile_file(content: dict[str, Any], folder: Path, named: Any = None) -> dict[str, Any]:
    """Tables of a case file with the points of the profile in place of the file that has them.

    The file must be below the `folder` of the case; one that the user has `named` beside the case
    takes its place, and may be anywhere. Raises ValueError and OSError
    as `profile_from_file` does, and ValueError for a table with both points and a file.
    """
    profile = content.get("profile", {} if named is not None else None)
    if not isinstance(profile, dict):
        return content
    if named is not None:
        table = {"kind": "table"} | {k: v for k, v in profile.items() if k not in (*POINTS, "file")}
        table["positions"], table["point_heights"] = _read_points(Path(str(named)))
        return content | {"profile": table}
    if profile.get("kind") != "table" or "file" not in profile:
        return content
    table = dict(profile)
    name = table.pop("file")
    if not isinstance(name, str):
        raise ValueError(f"profile.file must be the name of a file in quotes, not {name!r}")
    for key in POINTS:
        if key in table:
            raise ValueError(f"profile has both a file and {key}; leave one out")
    table["positions"], table["point_heights"] = _read_points(folder / name, folder)
    return content | {"profile": table}


def _read_points(path: Path, below: Path | None = None) -> tuple[list[float], list[float]]:
    """Positions and heights (m) of a file."""
    text = read_text_input(path, "profile", below, "profile.file")
    points: list[tuple[float, float]] = []
    has_names = False
    for number, line in enumerate(text.splitlines(), 1):
        cells = _cells(line)
        if not cells or cells[0].startswith("#"):
            continue
        try:
            points.append((float(cells[0]), float(cells[1])))
        except (ValueError, IndexError):
            if points or has_names or len(cells) < 2:
                # The line is not quoted: the file may hold secrets.
                raise ValueError(
                    f"{path}, line {number}: a line of a profile is a position and a height in m,"
                    " such as 12.5, 0.003, which this is not"
                ) from None
            has_names = True
    if len(points) < 2:
        raise ValueError(f"{path}: a profile needs at least two points; it has {len(points)}")
    positions, heights = map(list, zip(*points, strict=True))
    return positions, heights


def _cells(line: str) -> list[str]:
    """Cells of a line, separated by the first of tab, semicolon and comma in it, or by spaces."""
    separator = next((mark for mark in "\t;," if mark in line), None)
    return [cell.strip() for cell in line.split(separator)] if line.strip() else []


class KindChangeWarning(UserWarning):
    """Warning that the kind of a part was changed, and entries of the former kind are left out."""


def change_kind(path: Sequence[str], table: dict[str, Any], kind: Any) -> None:
    """Remove the entries of a table that its new `kind` lacks, or has in another unit.

    A `KindChangeWarning` says what stays. Nothing is changed if one of the kinds is unknown.
    """
    family = _family(path)
    classes, former = ({} if family is None else kinds(family)), table.get("kind")
    if kind == former or kind not in classes or former not in classes:
        return
    units = [
        {field.name: field.metadata.get("unit") for field in dataclasses.fields(classes[one])}
        for one in (former, kind)
    ]
    kept, lost = [], []
    for key in [key for key in table if key != "kind"]:
        same = key in units[1] and units[0].get(key) == units[1][key]
        (kept if same else lost).append(key)
        if not same:
            del table[key]
    parts = [f"{'.'.join(path)} is of kind {kind!r} now, in place of {former!r}"]
    parts += [f"it keeps {', '.join(kept)}"] if kept else []
    parts += [f"{', '.join(lost)} of {former!r} are left out"] if lost else []
    text = "; ".join([*parts, "other keys have their defaults"])
    warnings.warn(text, KindChangeWarning, stacklevel=3)


def _family(path: Sequence[str]) -> type | None:
    """Class of the part at a path of a case file, an abstract one if it has a kind; or None."""
    part_class: Any = part_classes().get(path[0], (None, False))[0]
    for key in path[1:]:
        if key.isdigit() or part_class is None:
            continue
        classes = [part_class, *kinds(part_class).values()]
        declared = (f for one in classes for f in dataclasses.fields(one) if f.name == key)
        found = next(declared, None)
        part_class = found and found.metadata.get("part", found.metadata.get("parts"))
    return part_class


def load_case(path: str | os.PathLike) -> Case:
    """Validated case of a TOML file.

    A profile of kind "table" may have its points in a file of their own, `file = "profile.csv"`,
    below the folder of the case file (see `profile_from_file`), and so may vehicles.

    Raises ValueError, with the file and the address or line, for invalid TOML, unknown keys or
    kinds, wrong types and the errors of `check_case`; OSError if the file cannot be read. Warns
    (PlausibilityWarning) of what looks wrong, such as units: see `jaxbeam.check`.

    >>> import jaxbeam as jb
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "case.toml"
    >>> _ = path.write_text('''[beam]
    ... length = "25 m"
    ... flexural_rigidity = 3e10
    ... mass_per_length = 15e3
    ... ''')
    >>> print(jb.load_case(path).beam.length)
    25.0
    """
    case = load_case_with(path, {})
    warn_if_implausible(case)
    return case


def load_case_with(path: str | os.PathLike, settings: Mapping[str, Any]) -> Case:
    """Validated case of a file with other entries at some addresses.

    Raises ValueError as `case_from_tables`, with the file; OSError if the file cannot be read.
    """
    content = read_toml(path)
    try:
        case = _from_tables(content, Path(path).parent, settings)
        if not settings:
            check_case(case)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return _with_further_settings(case, settings)


def case_from_tables(content: Mapping[str, Any], folder: Path, settings: Mapping[str, Any]) -> Case:
    """Validated case of the tables of a case file with other entries at some addresses.

    Files that the tables name are below the `folder`. `settings` are those of `with_settings`, and
    may name files in the place of those, at profile.file or loads.0.model, which may be anywhere.
    Raises as `case_from_dict` and `with_settings`.
    """
    case = _from_tables(copy.deepcopy(dict(content)), folder, settings)
    if not settings:
        check_case(case)
    return _with_further_settings(case, settings)


def _from_tables(content: dict[str, Any], folder: Path, named: Mapping[str, Any]) -> Case:
    """Case of tables, not validated yet, with `named` files in place of those in the tables."""
    find_vehicle_files(content.get("loads"), folder, named=named)
    return case_from_dict(with_profile_file(content, folder, named.get("profile.file")))


def _with_further_settings(case: Case, settings: Mapping[str, Any]) -> Case:
    others = {address: value for address, value in settings.items() if address != "profile.file"}
    return with_settings(case, others) if settings else case


def find_vehicle_files(
    loads: Any,
    folder: Path,
    address: str = "loads",
    named: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Join the paths of vehicle files in tables of loads, relative to a folder, with it in place.

    Those that the user has `named` by address take their place. Raises as `check_input` for
    another file that is not below the folder.
    """
    for i, load in enumerate(loads if isinstance(loads, list) else ()):
        coaches = load.get("coaches") if isinstance(load, dict) else None
        tables = {f"{address}.{i}.model": load}
        for j, coach in enumerate(coaches if isinstance(coaches, list) else ()):
            tables[f"{address}.{i}.coaches.{j}.model"] = coach
        for own, table in tables.items():
            model = table.get("model") if isinstance(table, dict) else None
            if own in named and isinstance(table, dict):
                table["model"] = named[own]
            elif isinstance(model, str) and is_path(model):
                read_toml(folder / model, "vehicle file", folder, own)
                table["model"] = str(folder / model)


def load_controller(path: str | os.PathLike) -> AbstractController:
    """Controller of a TOML file: a case file, or one with the table [controller] alone.

    It is not validated against a case. Raises ValueError, with the file and the address or line,
    for invalid TOML and unknown keys or kinds; OSError if the file cannot be read.
    """
    content = read_toml(path)
    try:
        if "controller" not in content:
            raise ValueError("has no controller; write a table [controller]")
        if set(content) - {"title", "controller"}:
            _from_tables(content, Path(path).parent, {})  # to validate the other tables
        return _read_key("controller", content["controller"])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


@refuses_traced("a file")
def save_case(case: Case, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a case to a TOML file, with the unit of each number in a comment.

    `load_case` returns the same numbers to the last bit. Raises FileExistsError if the file exists
    and `overwrite` is not set, ValueError if a part of the case has no kind.

    >>> import jaxbeam as jb
    >>> import pathlib, tempfile
    >>> path = pathlib.Path(tempfile.mkdtemp()) / "case.toml"
    >>> jb.save_case(jb.Case(jb.Beam(25.0, 3e10, 15e3)), path)
    >>> print(path.read_text().splitlines()[1])
    length = 25.0  # m
    """
    text = _as_toml(case)
    with whole_file(path, overwrite) as partial:
        partial.write_text(text, encoding="utf-8")


def case_from_dict(content: dict[str, Any]) -> Case:
    """Case that the tables of a case file describe: numbers in SI units, lists and words.

    Raises ValueError, with the address, for keys and kinds that are unknown or missing and for
    values of the wrong type or shape. `check_case` validates the values.
    """
    known_keys = [field.name for field in dataclasses.fields(Case)]
    parts = {}
    for key, value in content.items():
        if key in part_classes():
            parts[key] = _read_key(key, value)
        elif key == "title":
            if not isinstance(value, str):
                raise ValueError(f"title must be text in quotes, not {describe_value(value)}")
            parts[key] = value
        else:
            raise ValueError(f"a case has no {describe_value(key)}; {suggestion(key, known_keys)}")
    if "beam" not in parts:
        raise ValueError("a case needs a beam; write a table [beam]")
    return Case(**parts)


def _read_key(key: str, value: Any) -> Any:
    """Part, or tuple of parts, at a key of a case file."""
    part_class, listed = part_classes()[key]
    if not listed:
        if not isinstance(value, dict):
            raise ValueError(f"{key} must be one table; write [{key}]")
        return read_part(key, value, part_class)
    return read_parts(key, value, part_class)


def case_to_dict(case: Case, whole: bool = False) -> dict[str, Any]:
    """Tables of a case file for a case; optional numbers that are None are left out.

    So is what a word implies, as the numbers of a vehicle of the library, unless the `whole` case
    is asked for. Raises ValueError if a part has no kind, though its table needs one.
    """
    check_is_case(case)
    content: dict[str, Any] = {"title": case.title} if case.title else {}
    for key, (part_class, listed) in part_classes().items():
        value = getattr(case, key)
        if listed and value:
            content[key] = [
                _write_part(f"{key}.{i}", part, part_class, whole) for i, part in enumerate(value)
            ]
        elif not listed and value is not None:
            content[key] = _write_part(key, value, part_class, whole)
    return content


def with_settings(case: Case, settings: dict[str, Any]) -> Case:
    """Validated copy of a case with other entries at some addresses, as in its case file.

    Unlike `case.replace` it also sets words, counts and optional numbers that were left out, those
    of all loads at `loads.*.train`, say; values are concrete (SI units), not traced. Raises
    ValueError for an address that no case file could have, and for the errors of `check_case`.
    """
    content, whole = case_to_dict(case), case_to_dict(case, whole=True)
    sizes = list_sizes(case)
    numbers = {one: each_address(attribute_address(one), sizes) for one in settings}
    check_distinct(numbers)
    each = [(one, settings[address]) for address, own in numbers.items() for one in own]
    each.sort(key=lambda setting: not setting[0].endswith(".kind"))  # kinds first
    for address, value in each:
        *path, last = address.split(".")
        if last == "kind" and len(path) == 1:
            content.setdefault(path[0], {})
        node: Any = content
        implied: Any = whole
        for key in path:
            implied = _child(implied, key)
            if isinstance(node, dict) and key not in node and implied is not None:
                node[key] = implied  # an entry of what a word implies
            node = _child(node, key)
        if isinstance(node, dict):
            if last == "kind":
                change_kind(path, node, value)
            node[last] = value
            for name in IMPLIED.get(last, ()) if path[:1] == ["loads"] else ():
                node.pop(name, None)
        elif _child(node, last) is not None:
            node[int(last)] = value
        else:
            raise unknown_address_error(case, address)
    changed = case_from_dict(content)
    check_case(changed)
    return changed


def _child(node: Any, key: str) -> Any:
    """Entry of a table or list at one step of an address; None if there is none."""
    if isinstance(node, dict):
        return node.get(key)
    if isinstance(node, list) and key.isdigit() and int(key) < len(node):
        return node[int(key)]
    return None


def _write_part(address: str, part: Any, part_class: type, whole: bool = False) -> dict[str, Any]:
    """Table of a part; if `whole`, with the entries that follow from others, too."""
    table = {}
    implied = () if whole else getattr(part, "implied_fields", tuple)()
    if inspect.isabstract(part_class):
        kind = kind_of(type(part))
        if kind is None:
            raise ValueError(
                f"{address} is a {type(part).__name__}, which has no kind in case files;"
                ' declare one in its class: kind: ClassVar[str] = "..."'
            )
        table["kind"] = kind
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if value is None or field.name in implied or (isinstance(value, str | tuple) and not value):
            continue
        if not field.metadata:
            raise ValueError(f"{address}.{field.name} is no key of a case file; leave it out")
        if "unit" in field.metadata:
            value = concrete(value).tolist()
        elif "part" in field.metadata:
            value = _write_part(f"{address}.{field.name}", value, field.metadata["part"])
        elif "parts" in field.metadata:
            inner_class = field.metadata["parts"]
            value = [
                _write_part(f"{address}.{field.name}.{i}", one, inner_class)
                for i, one in enumerate(value)
            ]
        table[field.name] = value
    return table


def _as_toml(case: Case) -> str:
    content = case_to_dict(case)
    blocks = [_toml_line("title", content.pop("title"))] if "title" in content else []
    for key, value in content.items():
        if isinstance(value, list):
            for part, table in zip(getattr(case, key), value, strict=True):
                blocks.append(_toml_block(key, part, table, listed=True))
        else:
            blocks.append(_toml_block(key, getattr(case, key), value))
    return "\n".join(blocks)


def _toml_block(key: str, part: Any, table: dict[str, Any], listed: bool = False) -> str:
    """Table of a part, followed by those of the parts in it."""
    fields = {field.name: field.metadata for field in dataclasses.fields(part)}
    inner = [name for name in table if "parts" in fields.get(name, {})]
    text = f"[[{key}]]\n" if listed else f"[{key}]\n"
    for name in table:
        if name not in inner:
            text += _toml_line(name, table[name], fields.get(name, {}).get("unit", ""))
    for name in inner:
        for one, inner_table in zip(getattr(part, name), table[name], strict=True):
            text += _toml_block(f"{key}.{name}", one, inner_table, listed=True)
    return text


def _toml_line(key: str, value: Any, unit: str = "") -> str:
    if isinstance(value, dict):  # a part within a part, as an inline table
        text = f"{key} = {{{', '.join(_toml_line(k, v).rstrip() for k, v in value.items())}}}"
    elif isinstance(value, list):
        text = f"{key} = [{', '.join(map(repr, value))}]"
    else:
        text = tomli_w.dumps({key: value}).rstrip("\n")
    return f"{text}  # {unit}\n" if unit not in ("", "1") else f"{text}\n"
