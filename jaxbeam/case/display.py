"""How parts of a case are shown: numbers with units, addresses in words."""

import dataclasses
import re
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxbeam.case.fields import ExplainsArguments
from jaxbeam.runtime.arrays import Module
from jaxbeam.runtime.printer import html_table

# Least largest value, factor and prefix.
PREFIXES = (
    (1e9, 1e9, "G"),
    (1e6, 1e6, "M"),
    (1e3, 1e3, "k"),
    (0.1, 1.0, ""),
    (1e-4, 1e-3, "m"),
    (1e-7, 1e-6, "µ"),
)
# Units that take no prefix: those that have one, and powers, as k(m^2) is not (km)^2.
UNPREFIXED = re.compile(r"kg\b|\w+\^")


class UnitScale(NamedTuple):
    """Unit with a prefix: values in the SI unit divided by `factor` are in `unit`."""

    factor: float
    unit: str


def unit_scale(values, unit: str) -> UnitScale:
    """Prefixed unit for the largest of some values in an SI unit: mm for 0.0014 m.

    Values without unit ("1"), or in 1/m, get a power of ten instead; kg and powers stay.
    """
    sizes = np.abs(np.asarray(values, float))
    largest = np.max(sizes[np.isfinite(sizes)], initial=0.0)
    fitting = ((factor, prefix) for least, factor, prefix in PREFIXES if largest >= least)
    factor, prefix = next(fitting, (1e-9, "n")) if largest else (1.0, "")
    if unit == "" or unit.startswith("1"):
        power = "" if factor == 1 else f"$10^{{{np.log10(factor):.0f}}}$"
        return UnitScale(factor, f"{power or '1'}{unit[1:]}" if unit[1:] else power)
    if UNPREFIXED.match(unit):
        factor, prefix = 1.0, ""
    return UnitScale(factor, prefix + unit.replace("^2", "²").replace("^3", "³"))


def text_scale(values, unit: str) -> UnitScale:
    """The scale of `unit_scale` for texts: values without unit ("1"), or in 1/m, stay."""
    if unit == "" or unit.startswith("1"):
        return UnitScale(1.0, "" if unit == "1" else unit)
    return unit_scale(values, unit)


def with_prefix(value: float, unit: str, digits: int = 4) -> str:
    """A number with its unit, prefixed where it has one: "1.4 mm"; "0.0002" without unit."""
    scale = text_scale(value, unit)
    return f"{value / scale.factor:.{digits}g} {scale.unit}".rstrip()


MAX_VALUES = 6  # of a list that are written out
MAX_PARTS = 8  # in a row under one key that are written out


class ReprWithUnits(Module, metaclass=ExplainsArguments):
    """Base of parts of a case whose `repr` shows numbers with units: "Beam(length=0.6 m, ...)".

    Entries that equal their defaults are left out.
    """

    def __repr__(self) -> str:
        entries = [f"{name}={value}" for name, value in part_entries(self)]
        return f"{type(self).__name__}({', '.join(entries)})"


def part_entries(part: Any) -> list[tuple[str, str]]:
    """Names of the entries of a part that are not left out, and their values with units."""
    return [
        (field.name, _entry(value, field.metadata.get("unit", "")))
        for field in dataclasses.fields(part)
        if not _is_default(value := getattr(part, field.name), field)
    ]


def case_text(case: Any) -> str:
    """Text of a case: its title, and each part in a line with its address."""
    head = f"Case {case.title!r}" if case.title else "Case"
    lines = [address if part is None else f"{address}: {part!r}" for address, part in _parts(case)]
    return "\n  ".join([head, *lines])


def case_html(case: Any) -> str:
    """A case as a table in HTML: address, class and entries of each part, as in `case_text`."""
    rows = []
    for address, part in _parts(case):
        if part is None:
            rows.append((address, "", ""))
        elif isinstance(part, ReprWithUnits):
            entries = ", ".join(f"{name} = {value}" for name, value in part_entries(part))
            rows.append((address, type(part).__name__, entries))
        else:
            rows.append((address, type(part).__name__, repr(part)))
    return html_table(("address", "part", "entries"), rows, case.title or "Case")


def _parts(case: Any) -> list[tuple[str, Any]]:
    """Addresses and parts of a case; of a long row of loads, say, the number left out and None."""
    found = []
    for field in dataclasses.fields(case):
        value = getattr(case, field.name)
        if isinstance(value, tuple):
            listed = [(f"{field.name}.{i}", part) for i, part in enumerate(value)]
            if len(listed) > MAX_PARTS:
                left_out = f"... {len(listed) - 4} more {field.name} ..."
                listed = [*listed[:3], (left_out, None), listed[-1]]
            found += listed
        elif field.name != "title" and value is not None:
            found.append((field.name, value))
    return found


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
