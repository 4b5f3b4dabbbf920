"""Ways downhill on functions whose least is known, and with loops that diverge on the way."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

from tuning.control.optimisers import METHODS, optimiser

STARTS = jnp.array([[-1.2, 1.0], [0.5, -0.5], [1.3, 1.9]])


def valley(point):
    """Rosenbrock's function; beyond x = 1.4 it is not defined."""
    x, y = point
    return jnp.where(x > 1.4, jnp.nan, 100 * (y - x**2) ** 2 + (1 - x) ** 2)


def bowl(point):
    return 3 * (point[0] - 0.3) ** 2 + point[0] * point[1] + (point[1] + 0.2) ** 2


def descend(name, function, steps, stages=1):
    """Least values that searches from all starts have met, and how many points were unsound."""
    method = optimiser(name, steps)
    ask = jax.jit(jax.vmap(jax.value_and_grad(function)))
    onward = jax.jit(jax.vmap(method.step, (0, 0, 0, 0, None)))
    points, memory = STARTS, jax.vmap(method.init)(STARTS)
    best, unsound = np.full(len(STARTS), np.inf), 0
    for step in range(steps):
        value, slope = ask(points)
        sound = np.isfinite(value)
        unsound += int((~sound).sum())
        best = np.fmin(best, np.where(sound, value, np.inf))
        slope = jnp.where(sound[:, None], slope, 0.0)
        fresh = jnp.asarray(step % (steps // stages) == 0)
        points, memory = onward(memory, points, jnp.where(sound, value, jnp.inf), slope, fresh)
    return best, unsound


@pytest.mark.parametrize("name", METHODS)
def test_every_start_comes_to_the_least(name):
    expected = scipy.optimize.minimize(bowl, [0.0, 0.0]).fun
    # Adam does not stop at the least, but circles it ever closer.
    steps, tolerance = (200, 1e-4) if name == "adam" else (60, 1e-9)
    best, _ = descend(name, bowl, steps)
    np.testing.assert_allclose(best, expected, atol=tolerance)


@pytest.mark.parametrize("name", ["lbfgs", "bfgs"])
def test_curvatures_lead_through_a_valley_and_back_from_where_nothing_is_defined(name):
    best, unsound = descend(name, valley, 120, stages=3)
    np.testing.assert_allclose(best, 0.0, atol=1e-9)
    assert name != "lbfgs" or unsound > 0


def test_adam_steps_back_and_goes_slower():
    method = optimiser("adam", 10)
    start = jnp.zeros(1)
    first, memory = method.step(method.init(start), start, jnp.ones(()), -jnp.ones(1), True)
    back, memory = method.step(memory, first, jnp.inf * jnp.ones(()), jnp.zeros(1), False)
    assert first[0] > 0 and back[0] == 0.0 and memory.scale == 0.5
    again, _ = method.step(memory, back, jnp.ones(()), -jnp.ones(1), False)
    assert 0 < again[0] < first[0]


def test_unknown_methods_are_refused():
    with pytest.raises(ValueError, match="one of adam, lbfgs, bfgs, not 'newton'"):
        optimiser("newton", 10)
