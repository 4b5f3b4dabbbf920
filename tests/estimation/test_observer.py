"""The observer's poles are where they were asked for, also in the closed loop."""

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
    """Of the plant by the oracle: sampled state and command matrix, rows of the sensors."""
    plant = SampledPlant(*parts_of(case))
    step = plant.step(0.0, PERIOD, 0.0, np.zeros((5, 5)))
    A, _, C, D = plant.matrices(0.0)
    return A, step.transition, step.after, C, D


@pytest.mark.parametrize("observer", [Observer(speed=2.5), Observer(poles=POLES)])
def test_poles(observer):
    """exp(p period) for every pole p asked for, and the shaker's own, which stays."""
    case = loop(observer)
    layout = mesh_layout(case)
    memory = jax.jit(lambda c: observer.init(jb.state_space(c, layout=layout)))(case)
    A, drift, _, C, _ = matrices(case)
    if observer.poles is None:
        wanted = 2.5 * np.linalg.eigvals(A[:4, :4])
    else:
        wanted = np.array([[a + 1j * b, a - 1j * b] for a, b in POLES]).ravel()
    error = (np.eye(5) - np.asarray(memory.gain) @ C) @ drift
    expected = np.exp(PERIOD * np.append(wanted, -400.0))
    assert_allclose(sorted_poles(np.linalg.eigvals(error)), sorted_poles(expected), atol=1e-8)


def test_an_observer_does_not_shift_the_poles_of_the_regulator():
    """The loop has the poles of state feedback and those of the observer: separation."""
    case = loop(Observer(poles=POLES))
    _, drift, push, _, _ = matrices(case)
    law = np.linalg.eigvals(drift - push @ np.array(GAIN))
    wanted = np.array([[a + 1j * b, a - 1j * b] for a, b in POLES]).ravel()
    expected = np.concatenate([law, np.exp(PERIOD * np.append(wanted, -400.0))])
    found = np.linalg.eigvals(linearised_loop(case, 0.0).closed_matrix)
    found = found[np.abs(found) > 1e-6]  # what the loop remembers beside them is forgotten at once
    assert_allclose(sorted_poles(found), sorted_poles(expected), atol=1e-7)


def test_the_error_dies_away_as_the_poles_say():
    case = loop(Observer(poles=POLES), delay=4e-4)
    observer, layout = case.controller.estimator, mesh_layout(case)
    plant = SampledPlant(*parts_of(case))
    step = plant.step(0.0, PERIOD, 4e-4, np.zeros((5, 5)))
    _, _, C, D = plant.matrices(0.0)
    commands = np.random.default_rng(0).normal(size=(60, 1))
    state, before, readings, states = np.array([1e-3, -1e-3, 0.1, 0.2, 0.0]), np.zeros(1), [], []
    for now in commands:
        state = step.transition @ state + step.before @ before + step.after @ now
        readings.append(C @ state + D @ now)
        states.append(state)
        before = now

    @jax.jit
    def estimates(case):
        model = jb.state_space(case, layout=layout)

        def tick(memory, at):
            estimate, memory = observer.step(
                memory, Measurement(at[0], jnp.zeros(5), at[1]), jnp.zeros(())
            )
            return memory, estimate.state

        signals = jnp.asarray(readings), jnp.asarray(commands)
        return jax.lax.scan(tick, observer.init(model), signals)[1]

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
        (Observer(speed=0.5), "speed must be above 1"),
    ],
)
def test_faults_are_named(observer, message):
    with pytest.raises(ValueError, match=f"controller.estimator.{message}"):
        check_case(loop(observer))


def test_beams_without_damping_need_poles():
    case = jb.replace(
        loop(Observer(speed=2.0)), {"beam.damping_ratio": 0.0, "actuators.0.damping": 0.0}
    )
    with pytest.raises(ValueError, match="speed must not be used on a beam without damping"):
        check_case(case)
