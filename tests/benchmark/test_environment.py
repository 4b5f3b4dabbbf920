"""The environment against `simulate`, under the transformations of JAX, and gymnasium's checker."""

import dataclasses
import functools
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.benchmark.environment import Environment
from jaxbeam.benchmark.problem import BenchmarkProblem, load
from jaxbeam.case.controller import Measurement
from jaxbeam.model.state_space import state_space

SEED = 3
# With the laws of their baselines: analogue filter and late readings between the samples of
# the law, noise, rounding; an absorber and a row of axles; vehicles on a rough road.
NAMES = ("late_sensor", "railway", "truck")


@functools.cache
def environment_of(name: str) -> Environment:
    return Environment(load(name))


@pytest.fixture(scope="module")
def short() -> Environment:
    """The problem of the patch, of which no more than a tenth of the run is left."""
    problem = load("patch")
    run = dataclasses.replace(problem.case.run, duration=0.15)
    return Environment(
        dataclasses.replace(problem, case=dataclasses.replace(problem.case, run=run))
    )


def under_law(environment: Environment, law, numbers):
    """Readings and commands (period, ...) of a run under a law, and the last state and reward."""
    problem, case = environment.problem, environment.prepared.case
    sensors, plant = len(case.sensors), environment.prepared.loop.plant
    count = plant.modal_model.state_count

    def period(carry, k):
        state, observation, law_state = carry
        measured = Measurement(
            observation[:sensors],
            plant.from_modal(state.plant[:count]),
            state.memory.commands.command[:, 0],
        )
        control = law.step(law_state, measured, k * problem.period)
        action = control.command[np.array(problem.driven)]
        state, after, reward, done = environment.step(state, action)
        sent = state.memory.commands.queue[0, :, 0]
        return (state, after, control.state), (observation[:sensors], sent, reward, done)

    def run(numbers):
        state, observation = environment.reset(SEED, numbers)
        start = state, observation, jax.tree.map(jnp.asarray, law.initial_state())
        (state, *_), history = jax.lax.scan(period, start, jnp.arange(environment.steps))
        return state, history

    return jax.jit(run)(numbers)


@pytest.mark.parametrize("name", NAMES)
def test_a_law_runs_as_in_simulate(name):
    environment, problem = environment_of(name), load(name)
    numbers = problem.test_load(SEED)
    case = problem.run_case(numbers, SEED)
    record = jb.simulate(case, tolerance=1e-10)
    state, (readings, commands, rewards, done) = under_law(
        environment, case.controller.law(state_space(case)), numbers
    )
    every = round(problem.period * float(case.run.sample_rate))
    ours = np.asarray(record.controller_readings)[:-1:every], np.asarray(record.command)[:-1:every]
    for own, other in zip(ours, (readings, commands), strict=True):
        assert_allclose(other, own, rtol=0, atol=1e-9 * np.abs(own).max())
    peak = np.abs(record.at(np.array(problem.positions))).max()
    assert_allclose(state.peak, peak, rtol=1e-9)
    alone = jb.simulate(dataclasses.replace(case, controller=None), tolerance=1e-10)
    uncontrolled = np.abs(alone.at(np.array(problem.positions))).max()
    assert_allclose(state.uncontrolled, uncontrolled, rtol=1e-9)
    assert_allclose(rewards.sum(), -peak / uncontrolled, rtol=1e-9)
    assert done[-1] and not done[:-1].any()


def returns(environment: Environment, state, actions):
    """Sum of the rewards of a run from a state under given actions, by scan."""

    def period(state, action):
        state, _, reward, _ = environment.step(state, action)
        return state, reward

    return jax.lax.scan(period, state, actions)[1].sum()


def test_pure_under_jit_vmap_grad_and_scan(short):
    seeds = np.array([1, 2, 3])
    actions = np.random.default_rng(0).uniform(0.0, 6.0, (short.steps, 1))
    batch, observations = jax.jit(jax.vmap(short.reset))(seeds)
    assert observations.shape == (3, 2 + 1 + 2)
    of_state = functools.partial(returns, short)
    of_batch = jax.jit(jax.vmap(of_state, in_axes=(0, None)))(batch, actions)
    reset, one = jax.jit(short.reset), jax.jit(of_state)
    assert_allclose(of_batch, [one(reset(seed)[0], actions) for seed in seeds], rtol=1e-11)
    assert len(set(np.asarray(of_batch))) == 3  # each seed has a load of its own
    # The derivative is that of the command before rounding.
    smooth = Environment(_without_rounding(short.problem))
    value = functools.partial(returns, smooth, reset(1)[0])
    slope = np.asarray(jax.jit(jax.grad(value))(actions))
    direction, value = np.random.default_rng(1).normal(size=actions.shape), jax.jit(value)
    step = 1e-5
    difference = (value(actions + step * direction) - value(actions - step * direction)) / step / 2
    assert_allclose(np.sum(slope * direction), difference, rtol=1e-6)
    assert np.abs(slope).max() > 0


def _without_rounding(problem):
    controller = dataclasses.replace(problem.case.controller, resolution=None)
    case = dataclasses.replace(problem.case, controller=controller)
    return dataclasses.replace(problem, case=case)


def test_an_environment_may_be_an_argument_and_a_key_of_either_form(short):
    """Its numbers were traced, and `jax.random.key` refused keys of the older form."""
    reset = eqx.filter_jit(lambda environment, key: environment.reset(key))
    expected, _ = jax.jit(short.reset)(SEED)
    for key in (SEED, jax.random.key(SEED), jax.random.PRNGKey(SEED)):
        assert_allclose(reset(short, key)[0].load, expected.load, rtol=1e-15)
    static = jax.jit(lambda environment: environment.reset(SEED)[0].load, static_argnums=0)
    assert_allclose(static(short), expected.load, rtol=1e-15)


def test_wrong_actions_keys_and_loads_are_said(short):
    state, _ = jax.jit(short.reset)(SEED)
    for action in (1.0, [1.0, 2.0]):
        with pytest.raises(ValueError, match="an action is a list of 1 commands"):
            short.step(state, action)
    for key in (1.5, [1, 2, 3]):
        with pytest.raises(ValueError, match="reset takes a seed, an integer, or one key of JAX"):
            short.reset(key)
    with pytest.raises(ValueError, match=r"a load has 2 numbers, .*; its shape is \(1,\)"):
        short.reset(SEED, [0.3])


def test_noise_and_load_are_those_of_the_seed(short):
    problem = short.problem
    reset = jax.jit(short.reset)
    (state, observation), (other, _) = reset(SEED), reset(SEED + 1)
    assert_allclose(state.load, problem.test_load(SEED), rtol=1e-15)
    assert not np.allclose(state.noise, other.noise)
    case = problem.run_case(problem.test_load(SEED), SEED)
    record = jb.simulate(dataclasses.replace(case, controller=short.prepared.case.controller))
    sensors = len(case.sensors)
    assert_allclose(observation[:sensors], record.controller_readings[0], rtol=1e-9)
    assert observation[sensors] == 0
    assert_allclose(problem.numbers(observation[sensors + 1 :]), state.load, rtol=1e-12)
    assert state.peak == 0 and state.step == 0


def test_limits_rounding_and_the_end(short):
    state, _ = jax.jit(short.reset)(SEED)
    step = jax.jit(short.step)
    for wanted, expected in ((100.0, 7.5), (-100.0, -2.5), (1.2345, 1.23)):
        state, _, _, _ = step(state, [wanted])
        assert_allclose(state.memory.commands.command[0, 0], expected, rtol=1e-12)
    for _ in range(short.steps - 3):
        state, _, _, done = step(state, [0.0])
    assert done
    after, _, reward, done = step(state, [5.0])
    assert done and reward == 0
    assert_allclose(after.plant, state.plant)


def changed(**sensor) -> BenchmarkProblem:
    problem = load("patch")
    sensors = [dataclasses.replace(one, **sensor) for one in problem.case.sensors]
    case = dataclasses.replace(problem.case, sensors=tuple(sensors))
    return dataclasses.replace(problem, case=case)


def test_what_it_refuses():
    for problem in (changed(dropout=0.1), changed(jitter=0.001), changed(quantity="acceleration")):
        with pytest.raises(ValueError, match=r"sensors.0 does not fit"):
            Environment(problem)
    problem = load("patch")
    case = dataclasses.replace(problem.case, controller=None)
    with pytest.raises(ValueError, match="controller does not fit"):
        Environment(dataclasses.replace(problem, case=case))


def test_gymnasium_accepts_it(short):
    """Its checker, with warnings as errors; the rewards are those of the pytree form."""
    checker = pytest.importorskip("gymnasium.utils.env_checker")
    environment = jb.benchmark.GymnasiumEnvironment(short.problem)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(environment, skip_render_check=True)
    environment.reset(seed=SEED)
    state, _ = jax.jit(short.reset)(SEED)
    step = jax.jit(short.step)
    for action, command in ((1.0, 7.5), (-0.5, -1.25), (0.0, 0.0)):
        observation, reward, _, truncated, info = environment.step(np.array([action]))
        state, expected, own, _ = step(state, [command])
        assert_allclose(observation, expected, rtol=1e-12)
        assert_allclose(reward, own, rtol=1e-12)
        assert not truncated
        assert_allclose(info["peak"], state.peak, rtol=1e-12)
    _, info = environment.reset(options={"load": load("patch").training[0]})
    assert_allclose(info["load"], load("patch").training[0])
