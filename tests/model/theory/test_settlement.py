"""Settlement of supports: closed forms, and equal settlements, which do not bend the beam."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb

TWO_SPANS = jb.Case(jb.Beam(4.0, 6.0, 1.0), [jb.Support(2.0)])


def test_middle_support():
    """Simply supported over both spans, lowered midway: w = -s, M = 3 E I s / l^2, w' = 0."""
    found = [jb.settlement_response(TWO_SPANS, [0.1], 2.0, order) for order in range(3)]
    assert_allclose(found, [-0.1, 0.0, 3 * 0.1 / 4], atol=1e-12)
    x = 0.8  # of a cubic: w = -s (3 z - z^3) / 2, z = x / l
    assert_allclose(jb.settlement_response(TWO_SPANS, [0.1], x), -0.1 * (1.2 - 0.4**3) / 2)
    third = -0.1 * -6 / 2 / 8
    assert_allclose(jb.settlement_response(TWO_SPANS, [0.1], x, 3), third)


def test_elastic_support():
    """A spring k whose foot settles by s pulls with a stiffness in series with 48 E I / L^3."""
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0), [jb.Support(2.0, stiffness=5.0)])
    beam = 48 * 6.0 / 4.0**3
    expected = -0.1 * 5.0 / (5.0 + beam)
    assert_allclose(jb.settlement_response(case, [0.1], 2.0), expected, rtol=1e-11)


def test_middle_support_of_a_beam_that_is_soft_in_shear():
    """It is pulled down with R = s / (L^3 / 48 E I + L / 4 kGA), so that M = R L / 4."""
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0, shear_stiffness=9.0), [jb.Support(2.0)])
    force = 0.1 / (4.0**3 / (48 * 6.0) + 4.0 / (4 * 9.0))
    assert_allclose(6.0 * jb.settlement_response(case, [0.1], 2.0, 2), force, rtol=1e-11)
    x = np.array([1.0, 3.0])
    assert_allclose(6.0 * jb.settlement_response(case, [0.1], x, 3), [force / 2, -force / 2])


def test_a_clamped_end_settles_with_a_support_on_it():
    """M = 6 E I s / L^2 at both ends, V = 12 E I s / L^3, and -s/2 midway."""
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0, ends="clamped-clamped"), [jb.Support(4.0)])
    moment = 6 * 6.0 * 0.1 / 4.0**2
    x = np.array([0.0, 4.0])
    assert_allclose(6.0 * jb.settlement_response(case, [0.1], x, 2), [-moment, moment], rtol=1e-11)
    assert_allclose(6.0 * jb.settlement_response(case, [0.1], 1.0, 3), 2 * moment / 4.0)
    assert_allclose(jb.settlement_response(case, [0.1], 2.0), -0.05, rtol=1e-11)


@pytest.mark.parametrize("beam", [{}, {"shear_stiffness": 9.0, "axial_force": 4.0}])
def test_rigid_motion(beam):
    """Supports that settle by the same amount do not bend the beam."""
    supports = [jb.Support(0.0), jb.Support(1.5), jb.Support(4.0, stiffness=1e3)]
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0, ends="free-free", **beam), supports)
    x = np.linspace(0.1, 3.9, 7)
    found = jb.settlement_response(case, [0.2, 0.2, 0.2], x)
    assert_allclose(found, -0.2, rtol=1e-10)


def test_bad_settlements():
    with pytest.raises(ValueError, match="one for each of the 1 supports"):
        jb.settlement_response(TWO_SPANS, [0.1, 0.2], 1.0)
