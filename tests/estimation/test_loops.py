"""Kalman filters in closed loops on beams with more modes than the design, against numpy."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.linearised_loop import linearised_loop
from jaxbeam.control.design_model import DesignModel
from jaxbeam.estimation.kalman import Kalman
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from tests.differences import central
from tests.loop_as_oracle import expected, parts_of
from tests.oracles.sampled_plant import SampledPlant

MODES, PERIOD, DELAY = 2, 2e-3, 5e-4
WEIGHTS = [3e4, 3e4, 1.0, 1.0, 0.0]
FORCE, NOISE = 0.02, 1e-5
TIMES = np.linspace(0.0, 0.05, 26)


def loop(estimator, command_weight=0.01, delay: float | None = DELAY, loads=True, modes=4):
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.01, modes=modes),
        actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
        sensors=[jb.Sensor(0.17), jb.Sensor(0.25)],
        loads=[jb.MovingMass(mass=0.4, speed=2.0, entry_time=0.0)] if loads else [],
        controller=jb.LQR(
            WEIGHTS,
            [command_weight],
            period=PERIOD,
            delay=delay,
            design=DesignModel(modes=MODES),
            estimator=estimator,
        ),
        run=jb.Run(0.05),
    )


def design_plant(case, loaded=False):
    """Design plant of the estimator, by the oracle."""
    span, loads, *parts = parts_of(case)
    span = type(span)(span.length, span.flexural_rigidity, span.mass_per_length, MODES, 0.01)
    return SampledPlant(span, loads if loaded else [], *parts)


def regulator(case):
    A, B, _, _ = design_plant(case).matrices(0.0)
    return control.lqr(A, B, np.diag(WEIGHTS), case.controller.command_weight[0] * np.eye(1))[0]


class NumpyKalman:
    """Law and filter in numpy; the covariance starts from rest without error, or is steady."""

    def __init__(self, case, loaded):
        self.gain, self.loaded = regulator(case), loaded
        self.plant = design_plant(case, loaded)
        size = self.plant.size
        self.intensity = np.diag([0, 0, FORCE, FORCE, 0.0] + [0.0] * loaded)
        self.state, self.covariance = np.zeros(size), np.zeros((size, size))
        self.previous, self.command = np.zeros(1), np.zeros(1)
        if loaded:
            self.state[-1], self.covariance[-1, -1] = 0.4 * 9.81, 4.0
            return
        self.step = self.plant.step(0.0, PERIOD, DELAY, self.intensity)
        self.C = self.plant.matrices(0.0)[2]
        self.covariance = scipy.linalg.solve_discrete_are(
            self.step.transition.T, self.C.T, self.step.noise, NOISE**2 * np.eye(2)
        )

    def __call__(self, readings, state, t):
        command = self.command
        step = self.step if not self.loaded else self.plant.step(t, PERIOD, DELAY, self.intensity)
        C = self.plant.matrices(t)[2]
        prior = step.transition @ self.state + step.before @ self.previous + step.after @ command
        P = self.covariance
        if self.loaded:
            P = step.transition @ P @ step.transition.T + step.noise
        gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + NOISE**2 * np.eye(2))
        if self.loaded:
            self.covariance = P - gain @ C @ P
        self.state, self.previous = prior + gain @ (readings - C @ prior), command
        self.command = -self.gain @ self.state[:5]
        return self.command


def run(case):
    plan = IntegrationPlan(static_shapes(case), 2, 0, False, 0.0, loop_schedule(case, TIMES))
    return jb.simulate(case, jnp.asarray(TIMES), plan)


@pytest.mark.parametrize(
    ("kalman", "tolerance"),
    [
        (Kalman(FORCE, NOISE), 1e-9),
        (Kalman(FORCE, NOISE, loads="estimated", weight_deviation=2.0), 1e-4),
    ],
)
def test_feedback_of_estimates(kalman, tolerance):
    """Crossing of a beam with two modes more than the design."""
    case = loop(kalman)
    record = run(case)
    truth = expected(case, TIMES, NumpyKalman(case, kalman.loads == "estimated"))
    for found, true in ((record.deflection, truth.deflection), (record.command, truth.command)):
        assert_allclose(found, true, rtol=0, atol=tolerance * np.max(np.abs(true)))


def sampled_loop(case, modes):
    """Transition of the closed loop over a period on a beam with some modes: plant and estimate."""
    span, _, *parts = parts_of(case)
    span = type(span)(span.length, span.flexural_rigidity, span.mass_per_length, modes, 0.01)
    plant, design = SampledPlant(span, [], *parts), design_plant(case)
    zero = np.zeros((plant.size, plant.size))
    step, C = plant.step(0.0, PERIOD, 0.0, zero), plant.matrices(0.0)[2]
    design_step = design.step(0.0, PERIOD, 0.0, np.diag([0, 0, FORCE, FORCE, 0.0]))
    rows = design.matrices(0.0)[2]
    covariance = scipy.linalg.solve_discrete_are(
        design_step.transition.T, rows.T, design_step.noise, NOISE**2 * np.eye(2)
    )
    gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T + NOISE**2 * np.eye(2))
    K = regulator(case)
    correction = np.eye(design.size) - gain @ rows
    estimate_matrix = correction @ (design_step.transition - design_step.after @ K)
    return np.block(
        [
            [step.transition, -step.after @ K],
            [gain @ C @ step.transition, estimate_matrix - gain @ C @ step.after @ K],
        ]
    )


def test_spillover():
    """A loop of high gain is stable on the beam of the design, unstable on that of more modes."""
    radius = {}  # spectral radius on both beams, for two weights of the command
    for weight in (0.3, 1e-4):
        case = loop(Kalman(FORCE, NOISE), weight, None, loads=False)
        found = np.linalg.eigvals(linearised_loop(case, 0.0).closed_matrix)
        expected = np.linalg.eigvals(sampled_loop(case, 4))
        largest = -np.sort(-np.abs(expected))[:6]
        assert_allclose(-np.sort(-np.abs(found))[:6], largest, rtol=1e-6)
        design = np.max(np.abs(np.linalg.eigvals(sampled_loop(case, MODES))))
        radius[weight] = design, largest[0]
    assert max(radius[0.3]) < 1
    assert radius[1e-4][0] < 1 < radius[1e-4][1]


def test_gradients_through_loop_and_estimator():
    case = loop(Kalman(FORCE, NOISE), modes=2)
    names = ("controller.estimator.process_noise", "controller.command_weight.0", "loads.0.mass")
    sizes = jnp.array([FORCE, 0.01, 0.4])
    plan = IntegrationPlan(static_shapes(case), 1, 0, False, 0.0, loop_schedule(case, TIMES))

    @jax.jit
    @jax.value_and_grad
    def cost(point):
        changed = jb.replace(case, dict(zip(names, point * sizes, strict=True)))
        record = jb.simulate(changed, jnp.asarray(TIMES), plan)
        return jnp.sum((record.deflection * 1e3) ** 2) + record.effort[0]

    at = jnp.ones(3)
    differences = central(lambda point: cost(point)[0], at, 1e-2)
    assert_allclose(cost(at)[1], differences, rtol=1e-6)
