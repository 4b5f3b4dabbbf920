"""Peaks of a curve from a few samples, against the curve itself on a fine grid."""

import hypothesis
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import jaxbeam.peaks

POINTS = 7
refine, vertex = (jax.jit(f) for f in (jaxbeam.peaks.refine, jaxbeam.peaks.vertex))


def samples(curve):
    return jnp.asarray(curve(np.linspace(0.0, 1.0, POINTS)))[:, None]


def highest(curve):
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


@hypothesis.given(st.lists(st.floats(-1.0, 1.0), min_size=POINTS, max_size=POINTS))
@hypothesis.example([0.0, 0.25, 0.0, -0.75, 0.0, 0.0, 0.0])  # equally high at both sides
@hypothesis.example([-1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 5e-05])  # three peaks that differ by 6e-9
def test_peak_of_a_polynomial_is_exact(coefficients):
    # Falling as in a smooth curve; the last are what the estimate leaves out.
    polynomial = np.polynomial.Chebyshev(
        np.array(coefficients) * 0.2 ** np.arange(POINTS), domain=[0, 1]
    )
    top, _ = highest(polynomial)
    hypothesis.assume(top > 1e-3)
    value, place = refine(samples(polynomial))
    assert value[0] == pytest.approx(top, rel=1e-10)
    assert abs(polynomial(float(place[0]))) == pytest.approx(top, rel=1e-10)


@hypothesis.given(
    st.floats(0.02, 0.1), st.floats(0.0, 2 * np.pi), st.floats(-0.5, 0.5), st.floats(0.0, 2 * np.pi)
)
def test_estimate_tells_steps_apart(waves, phase, share, other):
    """The estimate picks the step with the peak: it must be right to less than peaks differ."""

    def curve(c):
        both = waves * 2 * np.pi * c
        return np.cos(both + phase) + share * np.cos(2 * both + other)

    top, _ = highest(curve)
    hypothesis.assume(top > 0.1)
    # What the polynomial through the samples cannot follow: its remainder near an end.
    remainder = 1e-6 * (2 * np.pi * waves) ** POINTS * (1 + abs(share) * 2**POINTS) / top
    assert refine(samples(curve))[0][0] == pytest.approx(top, rel=remainder + 1e-14)
    assert vertex(samples(curve))[0] == pytest.approx(top, rel=10 * remainder + 1e-14)


def test_peak_at_a_kink_belongs_to_the_step_that_rises():
    """A peak just after a step's start is above the end of the step before, however little."""

    def after(c):
        return 1.0 - (c - 0.004) ** 2

    before = jnp.linspace(0.5, after(0.0), POINTS)[:, None]
    assert vertex(samples(after))[0] > vertex(before)[0]
    assert vertex(samples(after))[0] == pytest.approx(1.0, rel=1e-14)


def test_straight_and_flat_curves():
    assert vertex(jnp.zeros((POINTS, 1)))[0] == 0
    assert refine(jnp.zeros((POINTS, 1)))[0][0] == 0
    line = jnp.linspace(-3.0, 1.0, POINTS)[:, None]
    assert vertex(line)[0] == pytest.approx(3.0)
    value, place = refine(line)
    assert value[0] == pytest.approx(3.0) and place[0] == 0
