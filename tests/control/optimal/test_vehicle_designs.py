"""Step-by-step and scheduled regulators with the states of a vehicle, against scipy."""

import dataclasses

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import solve_continuous_are

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.estimator import Estimate
from jaxbeam.case.validation import check_case
from jaxbeam.control.optimal.load_tables import with_crossing_load
from tests.control.optimal import test_crossing_vehicles as crossing

MODES, STATES = crossing.MODES, 2 * crossing.MODES + 4
SETTINGS = {"state_weight": [50.0, 20.0, 1.0, 0.5], "command_weight": [1e-2]}
POINTS = 40


def test_step_by_step_gains_feed_back_the_vehicle():
    law = jb.LQR(**crossing.WEIGHTS, points=POINTS, horizon="frozen")
    plant = jb.state_space(crossing.beam_case())
    shares = np.array([0.13, 0.5, 0.77])
    found = np.asarray(jax.jit(jax.vmap(law.gain_table(plant)))(shares))[:, 0]
    for gain, share in zip(found, shares, strict=True):
        A, B = (part[:STATES] for part in crossing.plant(share * crossing.END))
        A, Q = A[:, :STATES], crossing.Q[:STATES, :STATES]
        P = solve_continuous_are(A, B, Q, np.array([[1e-2]]))
        expected = B[:, 0] @ P / 1e-2
        assert np.all(expected[2 * MODES :] != 0)
        assert_allclose(gain, expected, atol=1e-5 * np.abs(expected).max())


def test_vehicles_without_damping_are_refused():
    bouncing = jb.Oscillator(mass=0.3, stiffness=100.0, damping=0.0, speed=2.0)
    case = crossing.beam_case(bouncing, jb.LQR(**SETTINGS, horizon="frozen"), profile=None)
    with pytest.raises(ValueError, match="horizon needs vehicles with damping: loads.0 has"):
        check_case(case)


def test_a_scheduled_vehicle_is_similar():
    """Twice the mass with twice the stiffness and damping, as a vehicle of its own."""
    car, factor, speed = dataclasses.asdict(crossing.CAR), 2.0, 3.0
    heavy = jb.QuarterCar(**{name: factor * value for name, value in car.items()}, speed=speed)
    expected = jb.state_space(crossing.beam_case(heavy))
    mass = factor * (crossing.CAR.body_mass + crossing.CAR.axle_mass)
    found = with_crossing_load(jb.state_space(crossing.beam_case()), mass, speed)
    for system, other in (
        (found.at(0.2), expected.at(0.2)),
        (found.augmented(0.3), expected.augmented(0.3)),
    ):
        assert_allclose(system.A, other.A, atol=1e-12 * np.abs(other.A).max())
    assert_allclose(found.augmented_start, expected.augmented_start, rtol=1e-12)


@pytest.mark.parametrize("augmented", ["none", "loads"])
def test_a_scheduled_design_at_the_mass_of_the_load_is_that_of_the_crossing(augmented):
    mass = crossing.CAR.body_mass + crossing.CAR.axle_mass
    scheduled = jb.LQR(
        **crossing.WEIGHTS,
        masses=[mass, 2 * mass],
        points=POINTS,
        augmented=augmented,
        period=0.01,
        horizon="crossing",
        schedule="load",
    )
    options = {"horizon": "crossing", "augmented": augmented}
    single = jb.LQR(**crossing.WEIGHTS, points=POINTS, period=0.01, **options)
    plant = jb.state_space(crossing.beam_case())
    laws = [law.design_state_law(plant, plant) for law in (scheduled, single)]
    assert laws[0].needs_vehicles
    state = np.random.default_rng(3).normal(size=STATES) * 1e-3
    estimate = Estimate(state[: 2 * MODES], vehicles=state[2 * MODES :])
    measurement = Measurement(np.zeros(1), state[: 2 * MODES], np.zeros(1))
    found, expected = (
        jax.jit(
            lambda law=law: (
                law.step(law.initial_state(), estimate, measurement, np.asarray(0.4)).command
            )
        )()
        for law in laws
    )
    assert_allclose(found, expected, rtol=1e-6)
