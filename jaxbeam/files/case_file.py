"""Cases as TOML files and as plain dictionaries, both ways.

Keys follow from the fields of the classes, kinds from the classes that declare one in a module of
`jaxbeam.case`, `jaxbeam.control` or `jaxbeam.estimation`: nothing is registered here.
"""

import dataclasses
import inspect
import os
from typing import Any

import tomli_w

from jaxbeam.case.aliases import current_address, current_keys, current_kind
from jaxbeam.case.case import Case, part_classes, unknown_address_error
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.declared_checks import check_field, describe_value, missing_error, suggestion
from jaxbeam.case.fields import concrete, describe_shape, fits_shape
from jaxbeam.case.kinds import import_modules, kind_of, kinds
from jaxbeam.case.validation import check_case
from jaxbeam.files.profile_file import with_profile_file
from jaxbeam.files.toml_file import read_toml

for package in ("jaxbeam.case", "jaxbeam.control", "jaxbeam.estimation"):
    import_modules(package)


def load_case(path: str | os.PathLike) -> Case:
    """The validated case of a TOML file.

    A profile of kind "table" may have its points in a file of their own, `file = "profile.csv"`,
    relative to the folder of the case file (see `profile_from_file`).

    Raises ValueError, with the file and the address or line, for invalid TOML, unknown keys or
    kinds, wrong types and the errors of `check_case`; OSError if the file cannot be read.
    """
    content = read_toml(path)
    try:
        case = case_from_dict(with_profile_file(content, path))
        check_case(case)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return case


def load_controller(path: str | os.PathLike) -> AbstractController:
    """The controller of a TOML file: a case file, or one with the table [controller] alone.

    It is not validated against a case. Raises ValueError, with the file and the address or line,
    for invalid TOML and unknown keys or kinds; OSError if the file cannot be read.
    """
    content = read_toml(path)
    try:
        if "controller" not in content:
            raise ValueError("has no controller; write a table [controller]")
        if set(content) - {"title", "controller"}:
            case_from_dict(with_profile_file(content, path))  # to validate the other tables
        return _read_key("controller", content["controller"])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def save_case(case: Case, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a case to a TOML file, with the unit of each number in a comment.

    `load_case` returns the same numbers to the last bit. Raises FileExistsError if the file exists
    and `overwrite` is not set, ValueError if a part of the case has no kind.
    """
    text = _as_toml(case)
    try:
        with open(path, "w" if overwrite else "x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError:
        raise FileExistsError(
            f"{path} exists already; choose another name, or ask to overwrite it"
        ) from None


def case_from_dict(content: dict[str, Any]) -> Case:
    """The case that the tables of a case file describe: numbers in SI units, lists and words.

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
    """The part, or the tuple of parts, at a key of a case file."""
    part_class, listed = part_classes()[key]
    if not listed:
        if not isinstance(value, dict):
            raise ValueError(f"{key} must be one table; write [{key}]")
        return read_part(key, value, part_class)
    if not isinstance(value, list) or not all(isinstance(table, dict) for table in value):
        raise ValueError(f"{key} must be a list of tables; write [[{key}]]")
    return tuple(read_part(f"{key}.{i}", table, part_class) for i, table in enumerate(value))


def case_to_dict(case: Case) -> dict[str, Any]:
    """Tables of a case file for a case; optional numbers that are None are left out.

    Raises ValueError if a part has no kind, though its table needs one.
    """
    content: dict[str, Any] = {"title": case.title} if case.title else {}
    for key, (part_class, listed) in part_classes().items():
        value = getattr(case, key)
        if listed and value:
            content[key] = [
                _write_part(f"{key}.{i}", part, part_class) for i, part in enumerate(value)
            ]
        elif not listed and value is not None:
            content[key] = _write_part(key, value, part_class)
    return content


def with_settings(case: Case, settings: dict[str, Any]) -> Case:
    """A validated copy of a case with other entries at some addresses, as in its case file.

    Unlike `case.replace` it also sets words, counts and optional numbers that were left out; values
    are concrete (SI units), not traced. Raises ValueError for an address that no case file could
    have, and for the errors of `check_case`.
    """
    content = case_to_dict(case)
    for address, value in settings.items():
        *path, last = current_address(address).split(".")
        node: Any = content
        for key in path:
            node = _child(node, key)
        if isinstance(node, dict):
            node[last] = value
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


def read_part(address: str, table: dict[str, Any], part_class: type) -> Any:
    """The part of a case that a table describes.

    `part_class` is its class, or an abstract class of which the table's `kind` names a subclass.
    Raises ValueError, with the address, as `case_from_dict` does.
    """
    values = dict(table)
    if inspect.isabstract(part_class):
        part_class = _class_of_kind(address, values.pop("kind", None), part_class)
    fields = {field.name: field for field in dataclasses.fields(part_class) if field.metadata}
    values = current_keys(address, values, fields)
    for key, value in values.items():
        if key not in fields:
            raise ValueError(
                f"{address} has no key {describe_value(key)}; {suggestion(key, fields)}"
            )
        inner_class = fields[key].metadata.get("part")
        if inner_class is not None and isinstance(value, dict):
            values[key] = read_part(f"{address}.{key}", value, inner_class)
        else:
            _check_type(f"{address}.{key}", value, fields[key])
    for name, field in fields.items():
        if field.default is dataclasses.MISSING and name not in values:
            raise missing_error(f"{address}.{name}", field)
    return part_class(**values)


def _class_of_kind(address: str, kind: Any, family: type) -> type:
    classes = kinds(family)
    if kind is None:
        raise ValueError(f"{address}.kind is missing; it may be {', '.join(classes)}")
    if isinstance(kind, str) and kind not in classes:
        kind = current_kind(address, kind)
    if not isinstance(kind, str) or kind not in classes:
        hint = suggestion(str(kind), classes)
        raise ValueError(f"{address}.kind cannot be {describe_value(kind)}; {hint}")
    return classes[kind]


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


def _write_part(address: str, part: Any, part_class: type) -> dict[str, Any]:
    table = {}
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
        if value is None:
            continue
        if not field.metadata:
            raise ValueError(f"{address}.{field.name} is no key of a case file; leave it out")
        if "unit" in field.metadata:
            value = concrete(value).tolist()
        elif "part" in field.metadata:
            value = _write_part(f"{address}.{field.name}", value, field.metadata["part"])
        table[field.name] = value
    return table


def _as_toml(case: Case) -> str:
    content = case_to_dict(case)
    blocks = [_toml_line("title", content.pop("title"))] if "title" in content else []
    for key, value in content.items():
        if isinstance(value, list):
            for part, table in zip(getattr(case, key), value, strict=True):
                blocks.append(_toml_block(f"[[{key}]]", part, table))
        else:
            blocks.append(_toml_block(f"[{key}]", getattr(case, key), value))
    return "\n".join(blocks)


def _toml_block(header: str, part: Any, table: dict[str, Any]) -> str:
    units = {field.name: field.metadata.get("unit", "") for field in dataclasses.fields(part)}
    return header + "\n" + "".join(_toml_line(key, table[key], units.get(key, "")) for key in table)


def _toml_line(key: str, value: Any, unit: str = "") -> str:
    if isinstance(value, dict):  # a part within a part, as an inline table
        text = f"{key} = {{{', '.join(_toml_line(k, v).rstrip() for k, v in value.items())}}}"
    elif isinstance(value, list):
        text = f"{key} = [{', '.join(map(repr, value))}]"
    else:
        text = tomli_w.dumps({key: value}).rstrip("\n")
    return f"{text}  # {unit}\n" if unit not in ("", "1") else f"{text}\n"
