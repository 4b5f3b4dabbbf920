"""Parts of a case as text: numbers with their units, what is left out omitted."""

import dataclasses
from typing import Any

import jax
import numpy as np

MAX_VALUES = 6  # of a list that are written out
MAX_PARTS = 8  # in a row under one key that are written out


class ReprWithUnits:
    """Base of parts of a case whose `repr` shows numbers with units: "Beam(length=0.6 m, ...)".

    Entries that equal their defaults are left out.
    """

    def __repr__(self) -> str:
        entries = [
            f"{field.name}={_entry(value, field.metadata.get('unit', ''))}"
            for field in dataclasses.fields(self)  # type: ignore[arg-type]
            if not _is_default(value := getattr(self, field.name), field)
        ]
        return f"{type(self).__name__}({', '.join(entries)})"


def case_text(case: Any) -> str:
    """Text of a case: its title, and each part in a line with its address."""
    lines = []
    for field in dataclasses.fields(case):
        value = getattr(case, field.name)
        if isinstance(value, tuple):
            lines += _part_lines(field.name, value)
        elif field.name != "title" and value is not None:
            lines.append(f"{field.name}: {value!r}")
    head = f"Case {case.title!r}" if case.title else "Case"
    return "\n  ".join([head, *lines])


def _part_lines(key: str, values: tuple) -> list[str]:
    lines = [f"{key}.{i}: {value!r}" for i, value in enumerate(values)]
    if len(lines) <= MAX_PARTS:
        return lines
    return [*lines[:3], f"... {len(lines) - 4} more {key} ...", lines[-1]]


def _is_default(value: Any, field: dataclasses.Field) -> bool:
    if field.default is dataclasses.MISSING:
        return False
    if isinstance(value, jax.core.Tracer):
        return False
    if isinstance(value, np.ndarray | jax.Array):
        return isinstance(field.default, int | float) and np.all(value == field.default).item()
    return value is field.default or (
        isinstance(value, str | int | tuple) and value == field.default
    )


def _entry(value: Any, unit: str) -> str:
    """A number or list with its unit, another value as its `repr`; shapes of traced numbers."""
    if isinstance(value, jax.core.Tracer):
        return f"traced {value.dtype}{list(value.shape)}"
    if not isinstance(value, np.ndarray | jax.Array):
        if isinstance(value, tuple) and len(value) > MAX_PARTS:
            return f"({value[0]!r}, ... {len(value)} in all)"
        return repr(value)
    unit = "" if unit == "1" else f" {unit}"
    return f"{_numbers(np.asarray(value))}{unit}"


def _numbers(values) -> str:
    if np.ndim(values) == 0:
        return f"{values:.6g}"
    if values.size > MAX_VALUES:
        shape = " x ".join(map(str, values.shape))
        first = ", ".join(f"{one:.6g}" for one in values.ravel()[:3])
        return f"[{first}, ... {shape} values]"
    return f"[{', '.join(map(_numbers, values))}]"
