"""Damping by material, hysteretic and Rayleigh damping."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb

BRIDGE = {"flexural_rigidity": 1e10, "mass_per_length": 1e4, "modes": 4}


def ratios(supports=(), **beam):
    return jb.modes(jb.Case(jb.Beam(**BRIDGE, **beam), supports)).damping_ratios


@pytest.mark.parametrize(
    ("material", "span", "expected"),
    [
        ("steel", 30.0, 0.005),
        ("steel", 12.0, 0.005 + 0.00125 * 8),
        ("composite", 20.0, 0.005),
        ("prestressed-concrete", 10.0, 0.017),
        ("reinforced-concrete", 15.0, 0.0185),
        ("filler-beam", 40.0, 0.015),
    ],
)
def test_material(material, span, expected):
    """Table 6.6 of EN 1991-2, in per cent: 0.5 + 0.125 (20 - L), 1 or 1.5 + 0.07 (20 - L)."""
    assert_allclose(ratios(length=span, material=material), expected, rtol=1e-12)


def test_the_longest_span_counts():
    found = ratios(
        [jb.Support(18.0), jb.Support(6.0, stiffness=1e9)], length=22.0, material="steel"
    )
    assert_allclose(found, 0.005 + 0.00125 * 8, rtol=1e-12)


def test_loss_factor():
    assert_allclose(ratios(length=20.0, loss_factor=0.03), 0.015, rtol=1e-12)


def test_rayleigh_coefficients():
    """The coefficients give the ratios at the first and the third frequency of a bridge."""
    first, _, third, _ = jb.modes(jb.Case(jb.Beam(20.0, **BRIDGE))).frequencies
    coefficients = jb.rayleigh_coefficients([first, third], [0.01, 0.02])
    found = ratios(length=20.0, rayleigh_damping=np.asarray(coefficients))
    assert_allclose(found[[0, 2]], [0.01, 0.02], rtol=1e-10)
    with pytest.raises(ValueError, match="must differ"):
        jb.rayleigh_coefficients([2.0, 2.0], [0.01, 0.02])


def test_bad_damping():
    for beam, message in (
        ({"material": "wood"}, "beam.material cannot be 'wood'"),
        ({"material": "steel", "damping_ratio": 0.01}, "both damping_ratio and material"),
        ({"loss_factor": 0.1, "rayleigh_damping": [0.1, 0.1]}, "both rayleigh_damping and loss"),
    ):
        with pytest.raises(ValueError, match=message):
            jb.simulate(jb.Case(jb.Beam(20.0, **BRIDGE, **beam)))
