"""Prefixes of units that keep numbers short: 1.4 mm for 0.0014 m."""

import re
from typing import NamedTuple

import numpy as np

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
    """Values divided by `factor` are in `unit`."""

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


def with_prefix(value: float, unit: str, digits: int = 4) -> str:
    """A number with its unit, prefixed where it has one: "1.4 mm"; "0.0002" without unit."""
    scale = UnitScale(1.0, "") if unit in ("", "1") else unit_scale(value, unit)
    if scale.unit.startswith("$"):
        scale = UnitScale(1.0, unit)
    return f"{value / scale.factor:.{digits}g} {scale.unit}".rstrip()
