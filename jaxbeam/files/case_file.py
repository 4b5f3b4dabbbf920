"""Cases as TOML files and as plain dictionaries, both ways.

Everything follows from the declared fields: a new actuator or load needs a name in its `KINDS`
and nothing here.
"""

import dataclasses
import os
from typing import Any

import tomli_w

from jaxbeam import control
from jaxbeam.case import actuators, loads
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Case, Run, unknown_address_error
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.declared_checks import check_field, describe_value, missing_error, suggestion
from jaxbeam.case.fields import concrete, describe_shape, fits_shape
from jaxbeam.case.sensors import Sensor
from jaxbeam.case.validation import check_case
from jaxbeam.files.toml_file import read_toml

ClassOrRegistry = (
    type | dict[str, type]
)  # one class, or the registry in which a `kind` is looked up

TABLES: dict[str, ClassOrRegistry] = {"beam": Beam, "controller": control.KINDS, "run": Run}
ARRAYS_OF_TABLES: dict[str, ClassOrRegistry] = {
    "supports": Support,
    "actuators": actuators.KINDS,
    "sensors": Sensor,
    "loads": loads.KINDS,
}
KEY_ORDER = ("beam", "supports", "actuators", "sensors", "loads", "controller", "run")


def load_case(path: str | os.PathLike) -> Case:
    """Read a case from a TOML file and check it.

    Raises ValueError, naming the file and the address or line, for invalid TOML, unknown keys or
    kinds, wrong types and whatever `check_case` refuses; OSError if the file cannot be read.
    """
    content = read_toml(path)
    try:
        case = case_from_dict(content)
        check_case(case)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return case


def load_controller(path: str | os.PathLike) -> AbstractController:
    """Read a controller from a TOML file: a case file that has one, or its [controller] alone.

    Whether it suits a case is not asked. Raises ValueError, naming the file and the address or
    line, for invalid TOML and unknown keys or kinds; OSError if the file cannot be read.
    """
    content = read_toml(path)
    try:
        if "controller" not in content:
            raise ValueError("has no controller; write a table [controller]")
        if set(content) - {"title", "controller"}:
            controller = case_from_dict(content).controller
            assert controller is not None  # the table is there
            return controller
        if not isinstance(content["controller"], dict):
            raise ValueError("controller must be one table; write [controller]")
        return read_part("controller", content["controller"], control.KINDS)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def save_case(case: Case, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a case to a TOML file, with the unit of every number beside it.

    Reading the file back gives the same numbers, to the last bit. Raises FileExistsError if the
    file exists and `overwrite` is not set, ValueError if the case holds a part of no known kind.
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
    """Build a case from the tables of a case file: numbers in SI units, lists and words.

    Raises ValueError, naming the address, for keys and kinds that are unknown or missing and for
    values of the wrong type or shape. The values themselves are the business of `check_case`.
    """
    known_keys = [field.name for field in dataclasses.fields(Case)]
    parts = {}
    for key, value in content.items():
        if key in TABLES:
            if not isinstance(value, dict):
                raise ValueError(f"{key} must be one table; write [{key}]")
            parts[key] = read_part(key, value, TABLES[key])
        elif key in ARRAYS_OF_TABLES:
            if not isinstance(value, list) or not all(isinstance(v, dict) for v in value):
                raise ValueError(f"{key} must be a list of tables; write [[{key}]]")
            parts[key] = tuple(
                read_part(f"{key}.{i}", table, ARRAYS_OF_TABLES[key])
                for i, table in enumerate(value)
            )
        elif key == "title":
            if not isinstance(value, str):
                raise ValueError(f"title must be text in quotes, not {describe_value(value)}")
            parts[key] = value
        else:
            raise ValueError(f"a case has no {describe_value(key)}; {suggestion(key, known_keys)}")
    if "beam" not in parts:
        raise ValueError("a case needs a beam; write a table [beam]")
    return Case(**parts)


def case_to_dict(case: Case) -> dict[str, Any]:
    """Return the tables of a case file for a case, without what was left out.

    Raises ValueError if the case holds a part whose class has no kind in its registry.
    """
    content: dict[str, Any] = {"title": case.title} if case.title else {}
    for key in KEY_ORDER:
        value = getattr(case, key)
        if key in TABLES and value is not None:
            content[key] = _write_part(key, value, TABLES[key])
        elif key in ARRAYS_OF_TABLES and value:
            content[key] = [
                _write_part(f"{key}.{i}", part, ARRAYS_OF_TABLES[key])
                for i, part in enumerate(value)
            ]
    return content


def with_settings(case: Case, settings: dict[str, Any]) -> Case:
    """Return a copy of a case with other entries at addresses, as if the file had said so.

    Unlike `case.replace` this also sets words, counts and numbers that were left out, and it
    checks the result; it takes plain values (SI units), not traced ones. Raises ValueError for
    an address that no case file could have, and for whatever `check_case` refuses.
    """
    content = case_to_dict(case)
    for address, value in settings.items():
        *path, last = address.split(".")
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
    """What a table or list holds at one step of an address; None if nothing."""
    if isinstance(node, dict):
        return node.get(key)
    if isinstance(node, list) and key.isdigit() and int(key) < len(node):
        return node[int(key)]
    return None


def read_part(address: str, table: dict[str, Any], class_or_registry: ClassOrRegistry) -> Any:
    """Build one part of a case from its table; `class_or_registry` is its class, or the registry of its kind.

    Raises ValueError, naming the address, for what `case_from_dict` refuses.
    """
    values = dict(table)
    if isinstance(class_or_registry, dict):
        class_or_registry = _class_of_kind(address, values.pop("kind", None), class_or_registry)
    fields = {field.name: field for field in dataclasses.fields(class_or_registry)}
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
    return class_or_registry(**values)


def _class_of_kind(address: str, kind: Any, registry: dict[str, type]) -> type:
    if kind is None:
        raise ValueError(f"{address}.kind is missing; it may be {', '.join(registry)}")
    if not isinstance(kind, str) or kind not in registry:
        hint = suggestion(str(kind), registry)
        raise ValueError(f"{address}.kind cannot be {describe_value(kind)}; {hint}")
    return registry[kind]


def _check_type(address: str, value: Any, field: dataclasses.Field) -> None:
    """Check what a file says for a field before it becomes an array."""
    if "unit" not in field.metadata:
        check_field(address, value, field)
        return
    shape = _shape(value)
    if shape is None or not fits_shape(field, shape):
        raise ValueError(f"{address} must be {describe_shape(field)}, not {describe_value(value)}")


def _shape(value: Any) -> tuple[int, ...] | None:
    """Shape of a number or of nested lists of numbers; None for anything else.

    No number is a whole one that is too large for a float.
    """
    if not isinstance(value, list):
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        return () if is_number and (isinstance(value, float) or abs(value) < 2**1023) else None
    shapes = {_shape(entry) for entry in value} or {()}
    entry_shape = shapes.pop()
    return None if shapes or entry_shape is None else (len(value), *entry_shape)


def _write_part(address: str, part: Any, class_or_registry: ClassOrRegistry) -> dict[str, Any]:
    table = {}
    if isinstance(class_or_registry, dict):
        names = [name for name, made in class_or_registry.items() if type(part) is made]
        if not names:
            raise ValueError(
                f"{address} is a {type(part).__name__}, which has no kind in case files;"
                " add it to the registry of its family"
            )
        table["kind"] = names[0]
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if value is None:
            continue
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
