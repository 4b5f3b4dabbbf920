"""Units against their definitions."""

import math

import pytest

from jaxbeam.case.quantities import QUANTITIES
from tuning.logs.units import UNITS, unit


@pytest.mark.parametrize(
    ("text", "si", "factor", "quantity"),
    [
        ("mm", "m", 1e-3, "deflection"),
        ("µm", "m", 1e-6, "deflection"),
        ("in", "m", 0.0254, "deflection"),
        ("g", "m/s^2", 9.80665, "acceleration"),
        ("mg", "m/s^2", 9.80665e-3, "acceleration"),
        ("m/s²", "m/s^2", 1.0, "acceleration"),
        ("m/s2", "m/s^2", 1.0, "acceleration"),
        ("deg", "rad", math.pi / 180, "slope"),
        ("°", "rad", math.pi / 180, "slope"),
        ("µε", "1", 1e-6, "strain"),
        ("kN", "N", 1e3, "force"),
        (" ms ", "s", 1e-3, "time"),
    ],
)
def test_unit(text, si, factor, quantity):
    assert unit(text) == (si, pytest.approx(factor, rel=1e-15), quantity)


def test_quantities_are_those_of_sensors():
    """The SI unit of each quantity in a log is that of the sensor."""
    for entry in UNITS.values():
        if entry.quantity in QUANTITIES:
            assert entry.si == QUANTITIES[entry.quantity].unit
    assert {entry.si for entry in UNITS.values()} >= {entry.unit for entry in QUANTITIES.values()}


@pytest.mark.parametrize("text", ["milimeter", "G", "kn", "furlong", ""])
def test_unknown_unit(text):
    with pytest.raises(ValueError, match="unknown unit"):
        unit(text)
