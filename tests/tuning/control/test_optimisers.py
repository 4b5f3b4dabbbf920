"""Optimisers on functions whose minimum is known, also undefined at some points."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize

import jaxbeam as jb
import tuning
from tests.tuning.small_rig import rig
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


# States to feed back: selection by relaxed shares, against every choice.

FREE = {"controller.command_weight.0": (1e-5, 1e-1)}
CASES = tuning.LoadCases(({"loads.0.mass": 0.3}, {"loads.0.mass": 0.5}))
OPTIONS = {"steps": 30, "least_peaks": False, "progress": False}
FED_BACK_COUNT, STATE_COUNT = 1, 4


@pytest.fixture(scope="module")
def regulated():
    """Two modes under a regulator with weights set by hand."""
    law = jb.LQR(state_weight=[1e4, 1e4, 1.0, 1.0], command_weight=[1e-3], period=0.01)
    case = rig(law)
    return dataclasses.replace(case, beam=dataclasses.replace(case.beam, modes=2))


def test_the_states_selected_are_the_best_of_all_choices(regulated):
    reduced = tuning.control.tune_reduced(regulated, FED_BACK_COUNT, FREE, CASES, **OPTIONS)
    objectives = {}
    for fed_back in itertools.combinations(range(STATE_COUNT), FED_BACK_COUNT):
        shares = np.isin(np.arange(STATE_COUNT), fed_back).astype(float)
        law = dataclasses.replace(regulated.controller, feedback=shares)
        one = tuning.tune(dataclasses.replace(regulated, controller=law), FREE, CASES, **OPTIONS)
        objectives[fed_back] = one.run_sets[0].objective[1]
    assert reduced.fed_back == min(objectives, key=objectives.get)
    rounded, end = reduced.tuned.run_sets[0].objective
    assert end <= rounded and end < 1.002 * objectives[reduced.fed_back]
    # The choice matters, and the sum of the shares is as required.
    assert max(objectives.values()) > 1.05 * end
    assert reduced.shares.sum() == pytest.approx(FED_BACK_COUNT, abs=0.05)
    np.testing.assert_array_equal(
        np.asarray(reduced.tuned.case.controller.feedback),
        np.isin(range(STATE_COUNT), reduced.fed_back),
    )
    assert "when the other parameters are tuned again" in str(reduced)


def test_wrong_controllers_and_numbers_of_states_are_refused(regulated):
    with pytest.raises(ValueError, match="only regulators, such as kind 'lqr'"):
        tuning.control.tune_reduced(rig(), 1, FREE, CASES)
    with pytest.raises(ValueError, match="keep must be 1 to 3 of the 4 states; it is 4"):
        tuning.control.tune_reduced(regulated, 4, FREE, CASES)
    with pytest.raises(ValueError, match="leave controller.feedback out of what is free"):
        tuning.control.tune_reduced(regulated, 2, {"controller.feedback.0": None}, CASES)
