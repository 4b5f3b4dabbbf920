"""Quantities written with a unit, "25 m" or "30 GN m^2", in SI units.

The units are those of pint, which is imported (0.3 s) when the first such text is met.
"""

import functools
import re
from typing import Any

# A number and a unit: "m", "kN m^2", "%", and after a space "1/s".
QUANTITY = re.compile(
    r"\s*((?>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?))"
    r"\s*((?:(?<=\s)1\s*/\s*)?[^\W\d_][\w\s*/^().-]*|[%°])\s*"
)
SIGNS = str.maketrans({"·": "*", "×": "*", "⋅": "*", "−": "-"})
SI_WORDS = {"1": "dimensionless"}
RATES = ("Hz", "1/s", "rad/s")  # cycles or radians: the one is 2 pi times the other


def is_quantity(text: Any) -> bool:
    """Whether a value is a text of a number and a unit, such as "25 m"."""
    return isinstance(text, str) and QUANTITY.fullmatch(text.translate(SIGNS)) is not None


def number_and_unit(text: str) -> tuple[float, str]:
    """Number and unit of a quantity, as written. Raises ValueError if it is none."""
    found = QUANTITY.fullmatch(text.translate(SIGNS))
    if found is None:
        raise ValueError(f"{text!r} is no number with a unit, such as '25 m'")
    return float(found.group(1)), found.group(2).strip()


def in_si(value: Any, unit: str, name: str) -> Any:
    """A value with quantities, in itself or in nested lists, replaced by numbers in SI units.

    `unit` is the SI unit of the entry called `name`; "1/s, s" those of the entries of a list. What
    is no quantity stays as it is. Raises ValueError, with name, text and wanted unit, for a unit
    that does not exist or measures something else.
    """
    if isinstance(value, list | tuple):
        units = unit.split(", ") if ", " in unit else [unit] * len(value)
        if len(units) != len(value):
            units = [unit] * len(value)
        entries = enumerate(zip(value, units, strict=True))
        return [in_si(one, one_unit, f"{name}.{i}") for i, (one, one_unit) in entries]
    return _number_in_si(value, unit, name) if is_quantity(value) else value


def number_in_si(value: Any, unit: str, name: str) -> float:
    """A number, or a text with a number and perhaps a unit, as a number in a SI unit.

    Raises ValueError, with `name` and text, for anything else.
    """
    converted = in_si(value, unit, name)
    try:
        return float(converted)
    except (TypeError, ValueError):
        raise ValueError(
            f"{name} takes a number in {unit}, or one with a unit, not {value!r}"
        ) from None


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry()


def _number_in_si(text: str, unit: str, name: str) -> float:
    number, given = number_and_unit(text)
    if re.search(r"\btons?\b", given):
        raise ValueError(
            f"{name}: a ton may be metric or not; write 't' or 'short_ton', not {text!r}"
        )
    wanted = "a plain number" if unit == "1" else f"in {unit}"
    units = _registry()
    try:
        target = units.Unit(SI_WORDS.get(unit, unit.replace("^", "**")))
    except Exception:  # the unit of a command, of a state
        raise ValueError(
            f"{name} takes plain numbers, as its unit depends on other entries ({unit}); it is"
            f" {text!r}"
        ) from None
    try:
        quantity = units.Quantity(1.0, given)
    except Exception:  # whatever a parser may raise
        raise ValueError(
            f"{name} must be {wanted}; {text!r} has an unknown unit: write powers and"
            " products as in 'kN m^2'"
        ) from None
    if not quantity.is_compatible_with(target):
        raise ValueError(f"{name} must be {wanted}, or a unit of the same kind, not {text!r}")
    if unit in RATES and _is_rotation(quantity, unit):
        raise ValueError(
            f"{name} must be {wanted}, not {text!r}: cycles and radians differ by 2 pi, so give the"
            " number itself"
        )
    return number * float(quantity.to(target).magnitude)


def _is_rotation(quantity: Any, unit: str) -> bool:
    """Whether a rate is in cycles where radians are wanted, or the other way round."""
    in_radians = "radian" in str(quantity.to_root_units().units)
    in_cycles = "hertz" in str(quantity.units)
    return in_radians != (unit == "rad/s") or (in_cycles and unit != "Hz")
