"""Heights of profiles: closed forms, derivatives, jumps, contact patch, known and traced."""

import equinox as eqx
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad
from scipy.interpolate import CubicSpline

import jaxbeam as jb
from jaxbeam.case.fields import kinds
from jaxbeam.case.profiles.shapes import AbstractProfile
from tests.case.profiles.examples import AVERAGED, HEIGHTS, PLAIN, POSITIONS, PROFILES
from tests.differences import central

X = np.linspace(-5.0, 9.0, 57) + 0.0123  # away from all jumps and edges of a patch
EVERY = pytest.mark.parametrize("name", PROFILES)


def test_examples_have_every_kind():
    assert set(PLAIN) == set(AVERAGED) == set(kinds(AbstractProfile))


@EVERY
def test_derivatives_are_those_of_the_height(name):
    profile = PROFILES[name]
    _, slope, curvature = profile.heights(X)
    step = 1e-3
    for order, derivative in ((0, slope), (1, curvature)):
        offsets, weights = [-3, -2, -1, 1, 2, 3], [-1 / 60, 3 / 20, -3 / 4, 3 / 4, -3 / 20, 1 / 60]
        values = [profile.heights(X + n * step)[order] for n in offsets]
        difference = np.tensordot(weights, values, 1) / step
        assert_allclose(derivative, difference, atol=1e-8 * np.abs(derivative).max() + 1e-12)


@EVERY
def test_known_and_traced_numbers_give_the_same(name):
    profile = PROFILES[name]
    known = np.stack(profile.heights(X))
    assert isinstance(known, np.ndarray)
    assert isinstance(profile.kinks(), np.ndarray)
    traced = eqx.filter_jit(lambda profile, x: (profile.heights(x), profile.kinks()))
    moved = jax.tree.map(jax.numpy.asarray, profile)
    heights, kinks = traced(moved, X)
    assert_allclose(heights, known, rtol=1e-11, atol=1e-13)
    assert_array_equal(kinks, profile.kinks())
    assert_allclose(traced(profile, jax.numpy.asarray(X))[0], known, rtol=1e-11, atol=1e-13)


@EVERY
def test_positions_of_any_shape(name):
    profile = PROFILES[name]
    flat = profile.heights(X[:12])
    for got, expected in zip(profile.heights(X[:12].reshape(2, 3, 2)), flat, strict=True):
        assert_allclose(got, expected.reshape(2, 3, 2), rtol=1e-13, atol=1e-16)
    for got, expected in zip(profile.heights(float(X[4])), flat, strict=True):
        assert np.shape(got) == ()
        assert_allclose(got, expected[4], rtol=1e-13, atol=1e-16)


@EVERY
def test_slope_and_curvature_jump_at_kinks_only(name):
    """At kinks the slope jumps, or else the curvature; nowhere else, and the height never."""
    profile, side = PROFILES[name], 1e-8
    edges = [0.0, *POSITIONS, 1.0, 3.0, 6.0, -2.0]
    edges = np.unique([e + d for e in edges for d in (-0.35, 0.0, 0.35)])
    kinks = np.asarray(profile.kinks())
    scales = [np.abs(part).max() or 1.0 for part in profile.heights(np.linspace(-5, 9, 999))]

    def jumps(x):
        pairs = zip(profile.heights(x + side), profile.heights(x - side), scales, strict=True)
        return np.array([np.abs(a - b) / scale for a, b, scale in pairs])

    smooth = np.array([x for x in edges if not np.isclose(x, kinks).any()])
    assert jumps(smooth).max() < 1e-6
    if kinks.size:
        height, slope, curvature = jumps(kinks)
        assert height.max() < 1e-6
        assert (np.maximum(slope, curvature) > 1e-2).all()
    places, sizes = profile.slope_kinks()
    assert places.size == (np.sum(slope > 1e-2) if kinks.size else 0)
    for x, size in zip(places, sizes, strict=True):
        right, left = (profile.heights(x + s)[1] for s in (side, -side))
        assert_allclose(size, right - left, rtol=1e-6)


def test_only_a_ramp_without_a_contact_patch_has_jumps_of_slope():
    assert [name for name, profile in PROFILES.items() if profile.slope_kinks()[0].size] == ["ramp"]
    assert_allclose(PROFILES["ramp"].kinks(), [1.0, 3.0])
    assert_allclose(np.sort(AVERAGED["ramp"].kinks()), [0.65, 1.35, 2.65, 3.35])
    assert_allclose(PROFILES["bump"].kinks(), [1.0, 3.0])
    assert_allclose(PROFILES["table"].kinks(), [-3.0, 7.0])
    assert not AVERAGED["bump"].kinks().size and not AVERAGED["table"].kinks().size


@pytest.mark.parametrize("kind", PLAIN)
def test_a_contact_patch_feels_the_mean_of_the_surface(kind):
    """Against numerical integration; where a profile is switched on, the switch is a factor."""
    plain, averaged = PLAIN[kind], AVERAGED[kind]
    x = np.array([-2.9, -0.4, 0.8, 1.1, 2.0, 2.9, 3.3, 6.9])
    if kind in ("iso8608", "rail"):
        plain = eqx.tree_at(lambda p: p.switch_on, plain, np.array([-99.0, -98.0]))
        averaged = eqx.tree_at(lambda p: p.switch_on, averaged, np.array([-99.0, -98.0]))
    breaks = [*POSITIONS, 1.0, 3.0]
    mean = [
        quad(
            lambda s: float(plain.heights(s)[0]),
            centre - 0.35,
            centre + 0.35,
            points=[b for b in breaks if abs(b - centre) < 0.35],
            epsabs=1e-14,
        )[0]
        / 0.7
        for centre in x
    ]
    scale = np.abs(mean).max()
    assert_allclose(averaged.heights(x)[0], mean, rtol=1e-9, atol=1e-11 * scale)


def test_sine():
    profile = jb.profiles.SineProfile(amplitude=0.005, wavelength=5.0)
    height, slope, curvature = profile.heights(np.array([0.0, 1.25, 2.5, -1.25]))
    assert_allclose(height, [0.0, 0.005, 0.0, -0.005], atol=1e-17)
    assert_allclose(slope, 0.002 * np.pi * np.array([1.0, 0.0, -1.0, 0.0]), atol=1e-17)
    assert_allclose(curvature, 0.005 * (0.4 * np.pi) ** 2 * np.array([0, -1, 0, 1]), atol=1e-16)


def test_ramp():
    profile = jb.profiles.RampProfile(5.0, 7.0, 0.01)
    height, slope, curvature = profile.heights(np.array([4.0, 5.0, 5.5, 7.0, 90.0]))
    assert_allclose(height, [0.0, 0.0, 0.0025, 0.01, 0.01])
    assert_allclose(slope, [0.0, 0.005, 0.005, 0.0, 0.0])
    assert_allclose(curvature, 0.0)


def test_step_is_the_quintic_with_level_ends():
    """Of six conditions: height, slope and curvature at both ends."""
    rows = [[1, a, a**2, a**3, a**4, a**5] for a in (2.0, 6.0)]
    rows += [[0, 1, 2 * a, 3 * a**2, 4 * a**3, 5 * a**4] for a in (2.0, 6.0)]
    rows += [[0, 0, 2, 6 * a, 12 * a**2, 20 * a**3] for a in (2.0, 6.0)]
    quintic = np.polynomial.Polynomial(np.linalg.solve(rows, [0, 0.3, 0, 0, 0, 0]))
    x = np.linspace(2.0, 6.0, 9)
    profile = jb.profiles.StepProfile(2.0, 6.0, 0.3)
    for order, part in enumerate(profile.heights(x)):
        assert_allclose(part, quintic.deriv(order)(x), atol=1e-12)
    assert_allclose(np.stack(profile.heights(np.array([-1.0, 8.0]))), [[0, 0.3], [0, 0], [0, 0]])


def test_bump():
    profile = jb.profiles.BumpProfile(-8.0, -6.0, 0.02)
    height, slope, curvature = profile.heights(np.array([-9.0, -8.0, -7.5, -7.0, -6.0, 0.0]))
    assert_allclose(height, [0.0, 0.0, 0.01, 0.02, 0.0, 0.0], atol=1e-17)
    assert_allclose(slope, [0.0, 0.0, 0.01 * np.pi, 0.0, 0.0, 0.0], atol=1e-17)
    assert_allclose(curvature, 0.01 * np.pi**2 * np.array([0, 1, 0, -1, 0, 0]), atol=1e-16)


def test_table_is_the_spline_with_level_ends():
    spline = CubicSpline(POSITIONS, HEIGHTS, bc_type="clamped")
    x = np.linspace(-3.0, 7.0, 101)[:-1]
    for order, part in enumerate(PLAIN["table"].heights(x)):
        assert_allclose(part, spline(x, order), rtol=1e-12, atol=1e-16)
    beyond = np.stack(PLAIN["table"].heights(np.array([-40.0, 7.0, 50.0])))
    assert_allclose(beyond, [[0.0, 5e-3, 5e-3], [0, 0, 0], [0, 0, 0]], atol=1e-17)
    height, slope, curvature = jb.profiles.TableProfile([0.0, 2.0], [0.0, 1.0]).heights(1.0)
    assert_allclose([height, slope, curvature], [0.5, 0.75, 0.0])  # level at both ends


def test_a_long_table_converges_to_the_surface():
    """At most 5/384 h^4 times the largest fourth derivative (Hall and Meyer, 1976) is missing."""

    def error(count):
        points = np.linspace(0.0, 6.0, count)  # level at both ends
        table = jb.profiles.TableProfile(points, np.cos(np.pi * points))
        x = np.linspace(0.0, 6.0, 4001)
        return np.abs(table.heights(x)[0] - np.cos(np.pi * x)).max()

    for count in (101, 201, 2001):
        assert error(count) < 5 / 384 * (6 / (count - 1)) ** 4 * np.pi**4
    assert 14 < error(101) / error(201) < 18


NUMBERS = [
    (name, field)
    for name, profile in PROFILES.items()
    for field, value in vars(profile).items()
    if isinstance(value, np.ndarray)
]


@pytest.mark.parametrize(("name", "field"), NUMBERS)
def test_gradients_are_those_of_differences(name, field):
    """With respect to every number of every kind."""
    profile = PROFILES[name]
    value = np.asarray(getattr(profile, field), float)
    if field == "positions":  # the end of a table is where a wheel of these positions has passed
        x = np.array([-2.1, 0.2, 0.9, 3.3])
    else:
        x = np.array([-2.7, 1.2, 2.1, 2.8, 5.4])

    def heights(number):
        changed = eqx.tree_at(lambda p: getattr(p, field), profile, number)
        return changed.heights(x)

    derivative = jax.jit(jax.jacfwd(lambda number: jax.numpy.stack(heights(number))))(value)
    backward = jax.jit(jax.jacrev(lambda number: jax.numpy.stack(heights(number))))(value)
    step = 1e-4 * max(1e-2, np.abs(value).max())
    differences = central(lambda p: np.stack(heights(p.reshape(value.shape))), value.ravel(), step)
    differences = differences.reshape(np.shape(derivative))
    scale = np.abs(differences).reshape(3, -1).max(axis=1).reshape(3, *[1] * (differences.ndim - 1))
    assert (np.abs(derivative - differences) <= 1e-7 * scale + 1e-12).all()
    assert_allclose(backward, derivative, rtol=1e-9, atol=1e-12 * scale.max())


def test_gradient_of_the_position_of_a_wheel():
    """Of a wheel that moves over the surface: what the integrator differentiates."""
    for profile in PROFILES.values():
        x = np.array([-1.7, 1.2, 2.1, 4.4])
        height, slope, curvature = profile.heights(x)
        for i, expected in ((0, slope), (1, curvature)):
            got = jax.jacfwd(lambda x, i=i, p=profile: p.heights(x)[i])(x)
            scale = np.abs(expected).max()
            assert_allclose(np.diag(got), expected, rtol=1e-9, atol=1e-12 * scale)
