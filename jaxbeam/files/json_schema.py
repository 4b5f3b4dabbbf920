"""Keys of case files, from the declarations of fields, and their JSON Schema."""

import dataclasses
import inspect
from typing import Any, NamedTuple

from jaxbeam.case.case import part_classes
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    OF_QUANTITY,
    POSITIVE,
    PROBABILITY,
    axis_names,
    describe_shape,
    kinds,
)
from jaxbeam.case.profiles.shapes import TableProfile
from jaxbeam.case.toml_file import FILE_KEYS, MAX_COUNTS


class Key(NamedTuple):
    """Key of a table: its name in the file, the field behind it, and what the field declares.

    `part_class` is the class of the table that it holds, `listed` whether it holds any number of
    them; `default` is `dataclasses.MISSING` if the key must be there.
    """

    name: str
    field: dataclasses.Field
    unit: str
    meaning: str
    constraint: str
    default: Any
    part_class: type | None
    listed: bool

    @property
    def is_number(self) -> bool:
        """Whether it takes numbers, which may be texts with a unit."""
        return "unit" in self.field.metadata

    @property
    def is_count(self) -> bool:
        """Whether it takes a whole number."""
        return "minimum" in self.field.metadata

    @property
    def values(self) -> str:
        """Phrase that describes the values of the key."""
        metadata = self.field.metadata
        if self.is_number:
            return describe_shape(self.field)
        if self.is_count:
            return f"a whole number, {metadata['minimum']} or more"
        if self.part_class is not None:
            return "any number of tables" if self.listed else "a table"
        return "one of " + ", ".join(map(repr, metadata["allowed"])) if self.words else "a word"

    @property
    def words(self) -> tuple[str, ...]:
        """Words that the key allows; () for any."""
        return tuple(word for word in self.field.metadata.get("allowed", ()) if word)


NAMES_IN_FILES = {attribute: key for key, attribute in FILE_KEYS.items()}


def table_keys(part_class: type) -> list[Key]:
    """Keys of the table of a part, without its `kind`, in the order of the declarations."""
    found = []
    for field in dataclasses.fields(part_class):
        metadata = field.metadata
        if "meaning" not in metadata:
            continue
        found.append(
            Key(
                NAMES_IN_FILES.get(field.name, field.name),
                field,
                metadata.get("unit", ""),
                metadata["meaning"],
                metadata.get("constraint", ""),
                field.default,
                metadata.get("part") or metadata.get("parts"),
                "parts" in metadata,
            )
        )
    return found


def table_classes(part_class: type) -> dict[str, type]:
    """Classes of a table by the words of its `kind`; by "" if it has no kinds."""
    return kinds(part_class) if inspect.isabstract(part_class) else {"": part_class}


def tables() -> dict[str, tuple[type, bool]]:
    """Tables of a case file, and whether each is listed, `[[...]]`, by their names."""
    return {key: (found.part_class, found.listed) for key, found in part_classes().items()}


DIALECT = "https://json-schema.org/draft/2020-12/schema"


def json_schema() -> dict[str, Any]:
    """JSON Schema (2020-12) of a case file, from the declarations of its fields.

    Numbers may be texts with units, as "25 m". What relates several keys, as that loads need a
    speed or a table of times, is left to `load_case`.

    >>> schema = json_schema()
    >>> schema["properties"]["beam"]["properties"]["length"]["description"]
    'total length (m)'
    """
    definitions: dict[str, Any] = {}
    properties: dict[str, Any] = {"title": {"type": "string", "description": "title of the case"}}
    for name, (part_class, listed) in tables().items():
        table = _table(part_class, definitions)
        properties[name] = _list_of(name, table) if listed else table
    return {
        "$schema": DIALECT,
        "title": "Case file of jaxbeam",
        "type": "object",
        "additionalProperties": False,
        "required": ["beam"],
        "properties": properties,
        "$defs": definitions,
    }


def _table(part_class: type, definitions: dict[str, Any]) -> dict[str, Any]:
    """Schema of a table: one of those of its kinds, which are definitions."""
    classes = table_classes(part_class)
    if "" in classes:
        return _of_class(classes[""], "", definitions)
    choices = []
    for kind, each in classes.items():
        name = f"{part_class.__name__.removeprefix('Abstract').lower()}-{kind}"
        if name not in definitions:
            definitions[name] = {}  # of a table within itself
            definitions[name] = _of_class(each, kind, definitions)
        condition = {"properties": {"kind": {"const": kind}}, "required": ["kind"]}
        choices.append({"if": condition, "then": {"$ref": f"#/$defs/{name}"}})
    return {
        "type": "object",
        "required": ["kind"],
        "properties": {"kind": {"enum": list(classes)}},
        "allOf": choices,
    }


def _of_class(part_class: type, kind: str, definitions: dict[str, Any]) -> dict[str, Any]:
    keys = table_keys(part_class)
    properties: dict[str, Any] = {"kind": {"const": kind}} if kind else {}
    properties |= {key.name: _value(key, definitions) for key in keys}
    needed = [key for key in keys if key.default is dataclasses.MISSING]
    required = [key.name for key in needed if key.name == key.field.name]
    # A key whose word no attribute can have may have that of the attribute, as in saved cases.
    properties |= {key.field.name: properties[key.name] for key in keys}
    either = [
        {"anyOf": [{"required": [word]} for word in (key.name, key.field.name)]}
        for key in needed
        if key.name != key.field.name
    ]
    if part_class is TableProfile:  # the points may be in a file of their own
        properties["file"] = {"type": "string", "description": "file of positions and heights"}
        required, either = [], []
    return {
        "type": "object",
        "description": (part_class.__doc__ or "").strip().split("\n\n")[0],
        "additionalProperties": False,
        "properties": properties,
        "required": ["kind"] * bool(kind) + required,
    } | ({"allOf": either} if either else {})


def _value(key: Key, definitions: dict[str, Any]) -> dict[str, Any]:
    """Schema of the value of a key."""
    if key.part_class is not None:
        table = _table(key.part_class, definitions)
        return _list_of(key.name, table) if key.listed else table
    unit = "" if key.unit in ("", "1") else f" ({key.unit})"
    value: dict[str, Any] = {"description": key.meaning + unit.replace(OF_QUANTITY, "its unit")}
    if key.is_number:
        value |= _number(key)
        value |= {"x-unit": key.unit} if unit else {}
    elif key.is_count:
        value |= {"type": "integer", "minimum": key.field.metadata["minimum"]}
        value |= {"maximum": MAX_COUNTS[key.name]} if key.name in MAX_COUNTS else {}
    else:
        value |= {"enum": [*key.words]} if key.words else {"type": "string"}
    if not (key.default is dataclasses.MISSING or key.default in (None, "")):
        value["default"] = key.default
    return value


def _list_of(name: str, table: dict[str, Any]) -> dict[str, Any]:
    return {"type": "array", "items": table, "maxItems": MAX_COUNTS[name]}


def _number(key: Key) -> dict[str, Any]:
    """Schema of one number, of a list or of a list of lists, by the axes of the declaration."""
    one: dict[str, Any] = {"type": ["number", "string"]}
    if key.constraint == POSITIVE:
        one["exclusiveMinimum"] = 0
    elif key.constraint == NOT_NEGATIVE:
        one["minimum"] = 0
    elif key.constraint == PROBABILITY:
        one |= {"minimum": 0, "exclusiveMaximum": 1}
    axes = axis_names(key.field).split()
    if axes and axes[0].startswith("*"):
        return {"anyOf": [one, {"type": "array", "items": one}]}
    for axis in reversed(axes):
        one = {"type": "array", "items": one}
        if axis.isdigit():
            one |= {"minItems": int(axis), "maxItems": int(axis)}
    return one
