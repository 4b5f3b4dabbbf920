"""Damping by material, hysteretic and Rayleigh damping."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.beam import rayleigh_coefficients
from jaxbeam.model.modes import mesh_layout, modes
from jaxbeam.model.theory.damping import safe_sqrt
from tests.differences import central

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


def test_loss_factors_of_segments():
    """Of a uniform pinned beam the part up to a has the share a/L - sin(2 n pi a/L) / (2 n pi)."""
    n, share = np.arange(1, 5), 0.3
    energy = share - np.sin(2 * n * np.pi * share) / (2 * n * np.pi)
    segments = jb.Segment(6.0, loss_factor=0.1), jb.Segment(loss_factor=0.02)
    found = ratios(length=20.0, segments=segments)
    assert_allclose(found, (0.1 * energy + 0.02 * (1 - energy)) / 2, rtol=1e-9)
    found = ratios(length=20.0, segments=[segments[0], jb.Segment()], loss_factor=0.02)
    assert_allclose(found, (0.1 * energy + 0.02 * (1 - energy)) / 2, rtol=1e-9)
    found = ratios(length=20.0, segments=[jb.Segment(6.0), jb.Segment(loss_factor=0.02)])
    assert_allclose(found, 0.01 * (1 - energy), rtol=1e-9)


def test_loss_of_soft_shear_and_springs():
    """Equal loss in bending and shear is that of the whole; a spring without loss takes its share.

    A stiff beam on two equal springs moves as a rigid body: its strain energy is nearly none.
    """
    segments = [jb.Segment(6.0, loss_factor=0.04), jb.Segment(loss_factor=0.04)]
    found = ratios(length=20.0, segments=segments, shear_stiffness=1e8, rotary_inertia=3e3)
    assert_allclose(found, 0.02, rtol=1e-9)
    springs = [jb.Support(x, stiffness=1e4) for x in (0.0, 20.0)]
    found = ratios(springs, length=20.0, segments=segments, ends="free-free")
    assert found[0] < 1e-5 and found[1] < 1e-5 and 0.0199 < found[2] < 0.02


def test_gradient_of_a_loss():
    def ratio(values):
        segments = jb.Segment(values[0], loss_factor=values[1]), jb.Segment()
        beam = jb.Beam(length=20.0, **BRIDGE, segments=segments, loss_factor=0.01)
        return modes(jb.Case(beam), layout).damping_ratios

    values = jnp.array([6.0, 0.1])
    given = [jb.Segment(6.0, loss_factor=0.1), jb.Segment()]
    layout = mesh_layout(jb.Case(jb.Beam(length=20.0, **BRIDGE, segments=given, loss_factor=0.01)))
    assert_allclose(
        jax.jit(jax.jacfwd(ratio))(values), central(ratio, values), rtol=1e-6, atol=1e-9
    )


def test_rayleigh_coefficients():
    """The coefficients give the ratios at the first and the third frequency of a bridge."""
    first, _, third, _ = jb.modes(jb.Case(jb.Beam(20.0, **BRIDGE))).frequencies
    coefficients = rayleigh_coefficients([first, third], [0.01, 0.02])
    found = ratios(length=20.0, rayleigh_damping=np.asarray(coefficients))
    assert_allclose(found[[0, 2]], [0.01, 0.02], rtol=1e-10)
    with pytest.raises(ValueError, match="must differ"):
        rayleigh_coefficients([2.0, 2.0], [0.01, 0.02])


def test_bad_damping():
    for beam, message in (
        ({"material": "wood"}, "beam.material cannot be 'wood'"),
        ({"material": "steel", "damping_ratio": 0.01}, "both damping_ratio and material"),
        ({"loss_factor": 0.1, "rayleigh_damping": [0.1, 0.1]}, "both rayleigh_damping and loss"),
        (
            {"material": "steel", "segments": [jb.Segment(loss_factor=0.1)]},
            "both material and segments.0.loss_factor",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            jb.simulate(jb.Case(jb.Beam(20.0, **BRIDGE, **beam)))


# Settlement of supports: closed forms, and equal settlements, which do not bend the beam.

TWO_SPANS = jb.Case(jb.Beam(4.0, 6.0, 1.0), [jb.Support(2.0)])


def test_middle_support():
    """Simply supported over both spans, lowered midway: w = -s, M = 3 E I s / l^2, w' = 0."""
    found = [jb.statics.settlement_response(TWO_SPANS, [0.1], 2.0, order) for order in range(3)]
    assert_allclose(found, [-0.1, 0.0, 3 * 0.1 / 4], atol=1e-12)
    x = 0.8  # of a cubic: w = -s (3 z - z^3) / 2, z = x / l
    assert_allclose(jb.statics.settlement_response(TWO_SPANS, [0.1], x), -0.1 * (1.2 - 0.4**3) / 2)
    third = -0.1 * -6 / 2 / 8
    assert_allclose(jb.statics.settlement_response(TWO_SPANS, [0.1], x, 3), third)


def test_elastic_support():
    """A spring k whose foot settles by s pulls with a stiffness in series with 48 E I / L^3."""
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0), [jb.Support(2.0, stiffness=5.0)])
    beam = 48 * 6.0 / 4.0**3
    expected = -0.1 * 5.0 / (5.0 + beam)
    assert_allclose(jb.statics.settlement_response(case, [0.1], 2.0), expected, rtol=1e-11)


def test_middle_support_of_a_beam_that_is_soft_in_shear():
    """It is pulled down with R = s / (L^3 / 48 E I + L / 4 kGA), so that M = R L / 4."""
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0, shear_stiffness=9.0), [jb.Support(2.0)])
    force = 0.1 / (4.0**3 / (48 * 6.0) + 4.0 / (4 * 9.0))
    assert_allclose(6.0 * jb.statics.settlement_response(case, [0.1], 2.0, 2), force, rtol=1e-11)
    x = np.array([1.0, 3.0])
    assert_allclose(
        6.0 * jb.statics.settlement_response(case, [0.1], x, 3), [force / 2, -force / 2]
    )


def test_a_clamped_end_settles_with_a_support_on_it():
    """M = 6 E I s / L^2 at both ends, V = 12 E I s / L^3, and -s/2 midway."""
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0, ends="clamped-clamped"), [jb.Support(4.0)])
    moment = 6 * 6.0 * 0.1 / 4.0**2
    x = np.array([0.0, 4.0])
    assert_allclose(
        6.0 * jb.statics.settlement_response(case, [0.1], x, 2), [-moment, moment], rtol=1e-11
    )
    assert_allclose(6.0 * jb.statics.settlement_response(case, [0.1], 1.0, 3), 2 * moment / 4.0)
    assert_allclose(jb.statics.settlement_response(case, [0.1], 2.0), -0.05, rtol=1e-11)


@pytest.mark.parametrize("beam", [{}, {"shear_stiffness": 9.0, "axial_force": 4.0}])
def test_rigid_motion(beam):
    """Supports that settle by the same amount do not bend the beam."""
    supports = [jb.Support(0.0), jb.Support(1.5), jb.Support(4.0, stiffness=1e3)]
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0, ends="free-free", **beam), supports)
    x = np.linspace(0.1, 3.9, 7)
    found = jb.statics.settlement_response(case, [0.2, 0.2, 0.2], x)
    assert_allclose(found, -0.2, rtol=1e-10)


def test_bad_settlements():
    with pytest.raises(ValueError, match="one for each of the 1 supports"):
        jb.statics.settlement_response(TWO_SPANS, [0.1, 0.2], 1.0)


def test_a_rigid_mode_has_derivatives():
    """The square root of a frequency of zero had none."""
    slopes = jax.vmap(jax.grad(safe_sqrt))(jnp.array([-1e-9, 0.0, 4.0]))
    assert_allclose(slopes, [0.0, 0.0, 0.25], rtol=1e-15)
