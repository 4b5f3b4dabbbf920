"""Estimators in closed loops, on beams with more modes than they know of, against numpy's."""

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


def known_plant(case, loaded=False):
    """What the estimator knows of the plant, by the oracle."""
    span, loads, *parts = parts_of(case)
    span = type(span)(span.length, span.flexural_rigidity, span.mass_per_length, MODES, 0.01)
    return SampledPlant(span, loads if loaded else [], *parts)


def regulator(case):
    A, B, _, _ = known_plant(case).matrices(0.0)
    return control.lqr(A, B, np.diag(WEIGHTS), case.controller.command_weight[0] * np.eye(1))[0]


class NumpyKalman:
    """The law as numpy would have it; its covariance starts from certain rest, or is steady."""

    def __init__(self, case, loaded):
        self.gain, self.loaded = regulator(case), loaded
        self.plant = known_plant(case, loaded)
        size = self.plant.size
        self.intensity = np.diag([0, 0, FORCE, FORCE, 0.0] + [0.0] * loaded)
        self.state, self.covariance = np.zeros(size), np.zeros((size, size))
        self.acting, self.next = np.zeros(1), np.zeros(1)
        if loaded:
            self.state[-1], self.covariance[-1, -1] = 0.4 * 9.81, 4.0
            return
        self.step = self.plant.step(0.0, PERIOD, DELAY, self.intensity)
        self.C = self.plant.matrices(0.0)[2]
        self.covariance = scipy.linalg.solve_discrete_are(
            self.step.transition.T, self.C.T, self.step.noise, NOISE**2 * np.eye(2)
        )

    def __call__(self, readings, state, t):
        now = self.next
        step = self.step if not self.loaded else self.plant.step(t, PERIOD, DELAY, self.intensity)
        C = self.plant.matrices(t)[2]
        prior = step.transition @ self.state + step.before @ self.acting + step.after @ now
        spread = self.covariance
        if self.loaded:
            spread = step.transition @ spread @ step.transition.T + step.noise
        gain = spread @ C.T @ np.linalg.inv(C @ spread @ C.T + NOISE**2 * np.eye(2))
        if self.loaded:
            self.covariance = spread - gain @ C @ spread
        self.state, self.acting = prior + gain @ (readings - C @ prior), now
        self.next = -self.gain @ self.state[:5]
        return self.next


def run(case):
    plan = IntegrationPlan(static_shapes(case), 2, 0, False, 0.0, loop_schedule(case, TIMES))
    return jb.simulate(case, jnp.asarray(TIMES), plan)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kalman", "tolerance"),
    [
        (Kalman(FORCE, NOISE), 1e-9),
        (Kalman(FORCE, NOISE, loads="estimated", weight_deviation=2.0), 1e-4),
    ],
)
def test_estimates_fed_back(kalman, tolerance):
    """A crossing of a beam with two modes more than the design has."""
    case = loop(kalman)
    record = run(case)
    truth = expected(case, TIMES, NumpyKalman(case, kalman.loads == "estimated"))
    for found, true in ((record.deflection, truth.deflection), (record.command, truth.command)):
        assert_allclose(found, true, rtol=0, atol=tolerance * np.max(np.abs(true)))


def sampled_loop(case, modes):
    """The closed loop on a beam with some modes, from tick to tick: plant and estimate."""
    span, _, *parts = parts_of(case)
    span = type(span)(span.length, span.flexural_rigidity, span.mass_per_length, modes, 0.01)
    plant, inner = SampledPlant(span, [], *parts), known_plant(case)
    zero = np.zeros((plant.size, plant.size))
    step, C = plant.step(0.0, PERIOD, 0.0, zero), plant.matrices(0.0)[2]
    believed = inner.step(0.0, PERIOD, 0.0, np.diag([0, 0, FORCE, FORCE, 0.0]))
    seen = inner.matrices(0.0)[2]
    covariance = scipy.linalg.solve_discrete_are(
        believed.transition.T, seen.T, believed.noise, NOISE**2 * np.eye(2)
    )
    gain = covariance @ seen.T @ np.linalg.inv(seen @ covariance @ seen.T + NOISE**2 * np.eye(2))
    law = regulator(case)
    left = (np.eye(inner.size) - gain @ seen) @ (believed.transition - believed.after @ law)
    return np.block(
        [
            [step.transition, -step.after @ law],
            [gain @ C @ step.transition, left - gain @ C @ step.after @ law],
        ]
    )


@pytest.mark.slow
def test_modes_that_are_not_modelled_spill_over():
    """A hasty loop, stable on the beam of the design, is unstable on the richer one."""
    radius = {}  # of the loops on both beams, for two weights of the command
    for weight in (0.3, 1e-4):
        case = loop(Kalman(FORCE, NOISE), weight, None, loads=False)
        found = np.linalg.eigvals(linearised_loop(case, 0.0).closed_matrix)
        expected = np.linalg.eigvals(sampled_loop(case, 4))
        largest = -np.sort(-np.abs(expected))[:6]
        assert_allclose(-np.sort(-np.abs(found))[:6], largest, rtol=1e-6)
        alone = np.max(np.abs(np.linalg.eigvals(sampled_loop(case, MODES))))
        radius[weight] = alone, largest[0]
    assert max(radius[0.3]) < 1
    assert radius[1e-4][0] < 1 < radius[1e-4][1]


@pytest.mark.slow
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
