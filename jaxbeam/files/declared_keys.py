"""Keys of the tables of a case file by the declarations of their fields, for what lists them."""

import dataclasses
import inspect
from typing import Any, NamedTuple

from jaxbeam.case.case import part_classes
from jaxbeam.case.fields import describe_shape
from jaxbeam.case.former_words import FILE_KEYS
from jaxbeam.case.kinds import kinds


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
        """Phrase for the values that it takes."""
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
        """Words that it takes; () for any."""
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
