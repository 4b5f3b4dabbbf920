"""Units of logged columns, with their factors to SI.

A log is converted once, on reading, and is in SI units from then on.
"""

import difflib
import math
import re
from typing import NamedTuple

from jaxbeam.case.sensors import QUANTITIES


class Unit(NamedTuple):
    """A unit of a logged column: value in SI = factor x value as read."""

    si: str
    factor: float
    quantity: str


STANDARD_GRAVITY = 9.80665  # m/s^2, exact by definition

# Each word has one meaning: mg is a thousandth of g, not a milligram.
UNITS = {
    "s": Unit("s", 1.0, "time"),
    "ms": Unit("s", 1e-3, "time"),
    "us": Unit("s", 1e-6, "time"),
    "ns": Unit("s", 1e-9, "time"),
    "min": Unit("s", 60.0, "time"),
    "h": Unit("s", 3600.0, "time"),
    "d": Unit("s", 86400.0, "time"),
    "m": Unit("m", 1.0, "deflection"),
    "cm": Unit("m", 1e-2, "deflection"),
    "mm": Unit("m", 1e-3, "deflection"),
    "um": Unit("m", 1e-6, "deflection"),
    "in": Unit("m", 0.0254, "deflection"),
    "mil": Unit("m", 2.54e-5, "deflection"),
    "ft": Unit("m", 0.3048, "deflection"),
    "m/s": Unit("m/s", 1.0, "velocity"),
    "cm/s": Unit("m/s", 1e-2, "velocity"),
    "mm/s": Unit("m/s", 1e-3, "velocity"),
    "um/s": Unit("m/s", 1e-6, "velocity"),
    "in/s": Unit("m/s", 0.0254, "velocity"),
    "ft/s": Unit("m/s", 0.3048, "velocity"),
    "m/s^2": Unit("m/s^2", 1.0, "acceleration"),
    "cm/s^2": Unit("m/s^2", 1e-2, "acceleration"),
    "mm/s^2": Unit("m/s^2", 1e-3, "acceleration"),
    "in/s^2": Unit("m/s^2", 0.0254, "acceleration"),
    "ft/s^2": Unit("m/s^2", 0.3048, "acceleration"),
    "g": Unit("m/s^2", STANDARD_GRAVITY, "acceleration"),
    "mg": Unit("m/s^2", 1e-3 * STANDARD_GRAVITY, "acceleration"),
    "rad": Unit("rad", 1.0, "slope"),
    "mrad": Unit("rad", 1e-3, "slope"),
    "deg": Unit("rad", math.pi / 180, "slope"),
    "strain": Unit("1", 1.0, "strain"),
    "m/m": Unit("1", 1.0, "strain"),
    "ue": Unit("1", 1e-6, "strain"),
    "um/m": Unit("1", 1e-6, "strain"),
    "N": Unit("N", 1.0, "force"),
    "kN": Unit("N", 1e3, "force"),
    "MN": Unit("N", 1e6, "force"),
    "lbf": Unit("N", 4.4482216152605, "force"),  # exact by definition
    "kip": Unit("N", 4448.2216152605, "force"),
    "V": Unit("V", 1.0, "voltage"),
    "mV": Unit("V", 1e-3, "voltage"),
    "mV/V": Unit("1", 1e-3, "voltage ratio"),  # of bridges of strain gauges, over their supply
    "V/V": Unit("1", 1.0, "voltage ratio"),
    "counts": Unit("1", 1.0, "counts"),  # of a converter
}
for _name, _quantity in QUANTITIES.items():
    UNITS.setdefault(_quantity.unit, Unit(_quantity.unit, 1.0, _name))

# Other spellings of units in the table.
_SPELLINGS = {
    **dict.fromkeys(("sec", "seconds", "second", "Sekunden", "Sek"), "s"),
    **dict.fromkeys(("msec", "milliseconds", "Millisekunden"), "ms"),
    **dict.fromkeys(("usec", "microseconds", "Mikrosekunden"), "us"),
    **dict.fromkeys(("mins", "minutes", "minute", "Minuten"), "min"),
    **dict.fromkeys(("hr", "hrs", "hours", "hour", "Stunden"), "h"),
    **dict.fromkeys(("days", "day", "Tage"), "d"),
    **dict.fromkeys(("count", "Counts", "cts", "LSB", "digits", "digit"), "counts"),
    "inch": "in",
    "mils": "mil",
    "kips": "kip",
    **dict.fromkeys(("Gal", "gal"), "cm/s^2"),  # of recorders of earthquakes
    "g_n": "g",
    "°": "deg",
    **dict.fromkeys(("m/s/s", "m/sec^2", "m/sec2"), "m/s^2"),
    **dict.fromkeys(("ustrain", "uStrain"), "ue"),
    "microstrain": "ue",
    "uε": "ue",
    "ε": "strain",
}


def unit(text: str) -> Unit:
    """Unit by the name in a log, such as `mm`, `µm`, `m/s²` or `g`.

    Raises ValueError, with the nearest known units, for an unknown one.
    """
    name = text.strip().replace("µ", "u").replace("μ", "u")
    for square in ("²", "**2", "s2"):
        name = name.replace(square, "s^2" if square == "s2" else "^2")
    name = _SPELLINGS.get(name, name)
    if name not in UNITS:
        near = difflib.get_close_matches(name, UNITS, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}" if near else f"known are {', '.join(UNITS)}"
        raise ValueError(f"unknown unit {text!r}; {hint}")
    return UNITS[name]


# Of columns that are no channels: temperature, humidity, pressure, light, wind, speed, current.
UNITS_OF_CONDITIONS = frozenset(
    ["°C", "ºC", "℃", "degC", "DegC", "Deg C", "deg C", "C", "Celsius", "°F", "degF", "Deg F"]
    + ["K", "%", "%RH", "hPa", "mbar", "bar", "kPa", "lx", "lux", "W/m^2", "W/m²", "km/h", "mph"]
    + ["rpm", "1/min", "A", "mA", "Hz", "°"]
)


def is_unit(text: str) -> bool:
    """Whether a text is the name of a known unit."""
    try:
        unit(text)
    except ValueError:
        return False
    return True


def is_of_time(text: str | None) -> bool:
    """Whether a text is a unit of time.

    >>> from tuning.logs.units import is_of_time
    >>> is_of_time("sec"), is_of_time("mm"), is_of_time(None)
    (True, False, False)
    """
    return text is not None and is_unit(text) and unit(text).quantity == "time"


_SENSITIVITY = re.compile(
    r"\s*(?P<size>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*"
    r"(?:\((?P<inside>[^()]+)\)|(?P<out>mV/V|V/V|[^\s/()]+))\s*/(?P<of>.+)"
)


def transducer_unit(text: str, output_unit: Unit) -> Unit:
    """Unit of the quantity that a transducer measures, from its sensitivity, such as `100 mV/g`.

    `output_unit` is that of its output, the unit of the column (volts, say). What a sensitivity is
    divided by may also be the output: `0.01 g/mV`.

    Raises ValueError for a text that is no sensitivity, for zero, and for another output quantity.
    """
    found = _SENSITIVITY.fullmatch(text)
    if found is None or float(found["size"]) == 0.0:
        raise ValueError(f"the sensitivity {text!r} should be like '100 mV/g': number, unit/unit")
    out, measured = unit(found["out"] or found["inside"]), unit(found["of"].strip().strip("()"))
    if measured.quantity == output_unit.quantity != out.quantity:
        factor = float(found["size"]) * out.factor / measured.factor
        return Unit(out.si, output_unit.factor * factor, out.quantity)
    if out.quantity != output_unit.quantity:
        raise ValueError(
            f"the sensitivity {text!r} is for {out.quantity}, but the column is "
            f"{output_unit.quantity}"
        )
    per_unit = float(found["size"]) * out.factor / measured.factor
    return Unit(measured.si, output_unit.factor / per_unit, measured.quantity)
