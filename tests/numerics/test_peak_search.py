"""Peaks of a curve from a few samples, against the curve itself on a fine grid."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import jaxbeam.numerics.polynomials
from jaxbeam.simulation.integrator.discrete_model import PEAK_NODES

EQUAL = tuple(float(share) for share in np.linspace(0.0, 1.0, 7))
both_point_sets = pytest.mark.parametrize("points", [EQUAL, PEAK_NODES], ids=["equal", "of a step"])
refine, estimate = (
    jax.jit(function, static_argnames="points")
    for function in (
        jaxbeam.numerics.polynomials.refine_peak,
        jaxbeam.numerics.polynomials.estimate_peak,
    )
)


def samples(curve, points):
    return jnp.asarray(curve(np.array(points)))[:, None]


def largest_magnitude(curve):
    """Largest absolute value on [0, 1], and where: scipy, from the best of a fine grid."""
    fine = np.linspace(0.0, 1.0, 2001)
    best = fine[np.argmax(np.abs(curve(fine)))]
    found = minimize_scalar(
        lambda c: -abs(curve(c)),
        bounds=(max(0.0, best - 1e-3), min(1.0, best + 1e-3)),
        method="bounded",
        options={"xatol": 1e-12},
    )
    ends = max(abs(curve(0.0)), abs(curve(1.0)))
    return max(-found.fun, ends), found.x


@both_point_sets
@hypothesis.given(coefficients=st.lists(st.floats(-1.0, 1.0), min_size=8, max_size=8))
# Two peaks of equal height; three peaks that differ by 6e-9.
@hypothesis.example(coefficients=[0.0, 0.25, 0.0, -0.75, 0.0, 0.0, 0.0, 0.0])
@hypothesis.example(coefficients=[-1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 5e-05, 0.0])
def test_peak_of_a_polynomial_is_exact(points, coefficients):
    # Coefficients decay as those of a smooth curve; as many as points, which determine them.
    leading = np.array(coefficients[: len(points)])
    polynomial = np.polynomial.Chebyshev(leading * 0.2 ** np.arange(leading.size), domain=[0, 1])
    peak, _ = largest_magnitude(polynomial)
    hypothesis.assume(peak > 1e-3)
    value, position = refine(samples(polynomial, points), points)
    assert value[0] == pytest.approx(peak, rel=1e-10)
    assert abs(polynomial(float(position[0]))) == pytest.approx(peak, rel=1e-10)


@both_point_sets
@hypothesis.given(
    waves=st.floats(0.02, 0.1),
    phase=st.floats(0.0, 2 * np.pi),
    share=st.floats(-0.5, 0.5),
    other=st.floats(0.0, 2 * np.pi),
)
def test_estimate_is_accurate_enough_to_choose_a_step(points, waves, phase, share, other):
    """The step with the peak is chosen by the estimate: its error is below differences of peaks."""

    def curve(c):
        both = waves * 2 * np.pi * c
        return np.cos(both + phase) + share * np.cos(2 * both + other)

    peak, _ = largest_magnitude(curve)
    hypothesis.assume(peak > 0.1)
    # Remainder of the polynomial through the samples, near an end.
    count = len(points)
    remainder = 1e-6 * (2 * np.pi * waves) ** count * (1 + abs(share) * 2**count) / peak
    found = samples(curve, points)
    assert refine(found, points)[0][0] == pytest.approx(peak, rel=remainder + 1e-14)
    assert estimate(found, points)[0] == pytest.approx(peak, rel=10 * remainder + 1e-14)


@both_point_sets
def test_peak_just_after_a_kink_is_that_of_the_step_after_it(points):
    """A peak just after the start of a step exceeds the end of the step before by little."""

    def after(c):
        return 1.0 - (c - 0.004) ** 2

    before = samples(lambda c: 0.5 + (after(0.0) - 0.5) * c, points)
    found = estimate(samples(after, points), points)[0]
    assert found > estimate(before, points)[0]
    assert found == pytest.approx(1.0, rel=1e-14)


@both_point_sets
def test_straight_and_flat_curves(points):
    flat = jnp.zeros((len(points), 1))
    assert estimate(flat, points)[0] == refine(flat, points)[0][0] == 0
    line = samples(lambda c: 4 * c - 3.0, points)
    assert estimate(line, points)[0] == pytest.approx(3.0)
    value, position = refine(line, points)
    assert value[0] == pytest.approx(3.0) and position[0] == 0


@both_point_sets
def test_derivatives_of_a_peak_in_the_middle_of_its_samples(points):
    """That of s (1 - u^2) + t u over u in [-1, 1] is s + t^2 / 4 s."""
    u = 2 * np.array(points) - 1

    def peak(numbers):
        scale, tilt = numbers
        return refine((scale * (1 - u**2) + tilt * u)[:, None], points)[0][0]

    at = jnp.array([2.0, 0.0])
    np.testing.assert_allclose(jax.grad(peak)(at), [1.0, 0.0], atol=1e-14)
    np.testing.assert_allclose(jax.hessian(peak)(at), [[0.0, 0.0], [0.0, 0.25]], atol=1e-13)


@pytest.mark.parametrize("short", [0.0, 1e-9])
@pytest.mark.parametrize("peak", [0.99, 1.01, 2.0])
def test_steps_of_no_length_hide_no_peak(short, peak):
    """Of the parabola 4 - (t - peak)^2, beside steps between events at (nearly) one time."""
    lengths = jnp.array([1.0, short, short, short, 2.0])
    start = jnp.cumsum(lengths) - lengths
    times = start[:, None] + lengths[:, None] * np.array(PEAK_NODES)
    curves = 4.0 - (times - peak) ** 2
    steps = jaxbeam.numerics.polynomials.steps_near_peak(
        curves[..., None], lengths, PEAK_NODES, jnp.abs
    )
    positions, heights = jaxbeam.numerics.polynomials.locate_peak(curves[steps[:, 0]].T, PEAK_NODES)
    best = jnp.argmax(heights)
    assert float(heights[best]) == pytest.approx(4.0, rel=1e-13)
    found = start[steps[best, 0]] + (positions[best] + 1) / 2 * lengths[steps[best, 0]]
    assert float(found) == pytest.approx(peak, abs=1e-7)
