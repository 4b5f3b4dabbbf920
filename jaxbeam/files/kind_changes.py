"""A part of a case takes another kind: what its table keeps."""

import dataclasses
import warnings
from collections.abc import Sequence
from typing import Any

from jaxbeam.case.case import part_classes
from jaxbeam.case.kinds import kinds


class KindChangeWarning(UserWarning):
    """A part of a case has another kind, and entries of the former one are left out."""


def change_kind(path: Sequence[str], table: dict[str, Any], kind: Any) -> None:
    """Remove the entries of a table that another kind has not, or has in another unit.

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
