"""Optimisers on functions whose minimum is known, also undefined at some points."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from tuning.control.optimisation import METHODS, optimiser

STARTS = jnp.array([[-1.2, 1.0], [0.5, -0.5], [1.3, 1.9]])


def valley(point):
    """Rosenbrock's function, undefined beyond x = 1.4."""
    x, y = point
    return jnp.where(x > 1.4, jnp.nan, 100 * (y - x**2) ** 2 + (1 - x) ** 2)


def bowl(point):
    return 3 * (point[0] - 0.3) ** 2 + point[0] * point[1] + (point[1] + 0.2) ** 2


def minimise(name, function, steps, stages=1):
    """Least values from all starts, and the number of points where the function is undefined."""
    method = optimiser(name, steps)
    evaluate = jax.jit(jax.vmap(jax.value_and_grad(function)))
    advance = jax.jit(jax.vmap(method.step, (0, 0, 0, 0, None)))
    points, states = STARTS, jax.vmap(method.init)(STARTS)
    best, undefined = np.full(len(STARTS), np.inf), 0
    for step in range(steps):
        value, gradient = evaluate(points)
        finite = np.isfinite(value)
        undefined += int((~finite).sum())
        best = np.fmin(best, np.where(finite, value, np.inf))
        gradient = jnp.where(finite[:, None], gradient, 0.0)
        changed = jnp.asarray(step % (steps // stages) == 0)
        value = jnp.where(finite, value, jnp.inf)
        points, states = advance(states, points, value, gradient, changed)
    return best, undefined


@pytest.mark.parametrize("name", METHODS)
def test_every_start_reaches_the_minimum(name):
    expected = scipy.optimize.minimize(bowl, [0.0, 0.0]).fun
    # Adam oscillates about the minimum with decreasing amplitude.
    steps, tolerance = (200, 1e-4) if name == "adam" else (60, 1e-9)
    best, _ = minimise(name, bowl, steps)
    np.testing.assert_allclose(best, expected, atol=tolerance)


@pytest.mark.parametrize("name", ["lbfgs", "bfgs"])
def test_quasi_newton_methods_follow_a_valley_and_return_from_undefined_points(name):
    best, undefined = minimise(name, valley, 120, stages=3)
    np.testing.assert_allclose(best, 0.0, atol=1e-9)
    assert name != "lbfgs" or undefined > 0


def test_adam_reverts_a_step_to_an_undefined_point_and_shortens_the_next():
    method = optimiser("adam", 10)
    start = jnp.zeros(1)
    first, state = method.step(method.init(start), start, jnp.ones(()), -jnp.ones(1), True)
    back, state = method.step(state, first, jnp.inf * jnp.ones(()), jnp.zeros(1), False)
    assert first[0] > 0 and back[0] == 0.0 and state.step_scale == 0.5
    again, _ = method.step(state, back, jnp.ones(()), -jnp.ones(1), False)
    assert 0 < again[0] < first[0]


def test_unknown_methods_are_refused():
    with pytest.raises(ValueError, match="one of adam, lbfgs, bfgs, not 'newton'"):
        optimiser("newton", 10)
