"""Poles of the Luenberger observer, alone and in closed loops."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.linearised_loop import linearised_loop
from jaxbeam.case.controller import Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.estimation.observer import Observer
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.model.modes import mesh_layout
from tests.loop_as_oracle import parts_of
from tests.oracles.sampled_plant import SampledPlant

PERIOD = 1e-3
POLES = [[-100.0, 100.0], [-150.0, 400.0]]
GAIN = [[120.0, 90.0, 6.0, -2.0, 0.1]]


def loop(observer, **options):
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2),
        actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
        sensors=[jb.Sensor(0.15), jb.Sensor(0.25, "acceleration")],
        controller=jb.StateFeedback(GAIN, period=PERIOD, estimator=observer, **options),
    )


def sorted_poles(values):
    return np.sort_complex(np.round(values, 9))


def matrices(case):
    """A, sampled A and B, C and D of the plant by the oracle."""
    plant = SampledPlant(*parts_of(case))
    step = plant.step(0.0, PERIOD, 0.0, np.zeros((5, 5)))
    A, _, C, D = plant.matrices(0.0)
    return A, step.transition, step.after, C, D


@pytest.mark.parametrize("observer", [Observer(speed=2.5), Observer(poles=POLES)])
def test_poles(observer):
    """exp(p period) for every desired pole p, and that of the shaker, which is not corrected."""
    case = loop(observer)
    layout = mesh_layout(case)
    timing = sample_timing(case.controller)

    @jax.jit
    def design(case):
        return observer.sampled_filter(jb.state_space(case, layout=layout), timing)

    A, transition, _, C, _ = matrices(case)
    if observer.poles is None:
        desired = 2.5 * np.linalg.eigvals(A[:4, :4])
    else:
        desired = np.array([[a + 1j * b, a - 1j * b] for a, b in POLES]).ravel()
    error = (np.eye(5) - np.asarray(design(case).gain) @ C) @ transition
    expected = np.exp(PERIOD * np.append(desired, -400.0))
    assert_allclose(sorted_poles(np.linalg.eigvals(error)), sorted_poles(expected), atol=1e-8)


def test_separation():
    """The loop has the poles of state feedback and those of the observer."""
    case = loop(Observer(poles=POLES))
    _, transition, input_matrix, _, _ = matrices(case)
    regulator_poles = np.linalg.eigvals(transition - input_matrix @ np.array(GAIN))
    desired = np.array([[a + 1j * b, a - 1j * b] for a, b in POLES]).ravel()
    expected = np.concatenate([regulator_poles, np.exp(PERIOD * np.append(desired, -400.0))])
    found = np.linalg.eigvals(linearised_loop(case, 0.0).closed_matrix)
    found = found[np.abs(found) > 1e-6]  # the last command among the states has poles at zero
    assert_allclose(sorted_poles(found), sorted_poles(expected), atol=1e-7)


def test_decay_of_the_error():
    case = loop(Observer(poles=POLES), delay=4e-4)
    controller, layout = case.controller, mesh_layout(case)
    plant = SampledPlant(*parts_of(case))
    step = plant.step(0.0, PERIOD, 4e-4, np.zeros((5, 5)))
    _, _, C, D = plant.matrices(0.0)
    commands = np.random.default_rng(0).normal(size=(60, 1))
    state, previous, readings, states = np.array([1e-3, -1e-3, 0.1, 0.2, 0.0]), np.zeros(1), [], []
    for command in commands:
        state = step.transition @ state + step.before @ previous + step.after @ command
        readings.append(C @ state + D @ command)
        states.append(state)
        previous = command

    @jax.jit
    def estimates(case):
        plant = jb.state_space(case, layout=layout)
        filter = controller.estimator.sampled_filter(plant, sample_timing(controller))

        def update(state, sample):
            measurement = Measurement(sample[0], jnp.zeros(5), sample[1])
            estimate, state = filter.update(state, measurement, jnp.zeros(()))
            return state, estimate.state

        samples = jnp.asarray(readings), jnp.asarray(commands)
        return jax.lax.scan(update, filter.initial_state(), samples)[1]

    error = np.abs(estimates(case) - np.array(states)) / np.max(np.abs(states), 0)
    decay = np.exp(-100 * PERIOD * np.arange(60))[:, None]
    assert np.all(error < 30 * decay + 1e-12)
    assert np.all(error[0, :4] > 1e-2)


@pytest.mark.parametrize(
    ("observer", "message"),
    [
        (Observer(), "poles or speed must be given, and not both"),
        (Observer(poles=POLES, speed=2.0), "poles or speed must be given, and not both"),
        (Observer(poles=POLES[:1]), "poles must list a pair for each of 2 modes, not 1"),
        (Observer(poles=[[1.0, 2.0], [-1.0, 3.0]]), "poles must have negative real parts"),
        (Observer(poles=[[0.0, 2.0], [-1.0, 3.0]]), "poles must have negative real parts"),
        (Observer(speed=0.5), "speed must be above 1"),
    ],
)
def test_errors_of_settings(observer, message):
    with pytest.raises(ValueError, match=f"controller.estimator.{message}"):
        check_case(loop(observer))


def test_speed_is_refused_without_damping():
    case = jb.replace(
        loop(Observer(speed=2.0)), {"beam.damping_ratio": 0.0, "actuators.0.damping": 0.0}
    )
    with pytest.raises(ValueError, match="speed must not be used on a beam without damping"):
        check_case(case)
