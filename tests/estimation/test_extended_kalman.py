"""Extended Kalman filters: planted masses and speeds from scipy's motion of the beam."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.estimator import Estimate, EstimatedLoads
from jaxbeam.case.validation import check_case
from jaxbeam.control.design_model import DesignModel
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.arrays import xp
from tests.control.optimal.test_position_lqr import LENGTH, REST, expected_command, polynomial_law
from tests.differences import central
from tests.loop_as_oracle import expected

PERIOD, NOISE = 4e-3, 2e-6
FOLLOWS = jb.ExtendedKalman(1e-3, 1e-5, mass_deviation=0.15, speed_deviation=0.3)


def crossing(*loads, modes=2, duration=0.35) -> jb.Case:
    return jb.Case(
        jb.Beam(LENGTH, 11.68, 0.535, damping_ratio=0.03, modes=modes),
        actuators=[jb.PointForce(0.4)],
        sensors=[jb.Sensor(0.17, offset=1e-4), jb.Sensor(0.35)],
        loads=loads,
        controller=jb.Prescribed([0.3], period=PERIOD),
        run=jb.Run(duration),
    )


def designed(case, **numbers) -> jb.Case:
    """The case with other numbers of its loads in the design."""
    return dataclasses.replace(case, loads=DesignModel(**numbers).design_loads(case))


def followed(estimator, case, readings, layout=None):
    """Estimates after all readings, and the last state of the filter."""
    plant = jb.state_space(case, layout=layout)
    filter = estimator.sampled_filter(plant, sample_timing(case.controller))
    state, estimates = filter.initial_state(), []
    for k, reading in enumerate(readings):
        command = np.array([0.3 if k else 0.0])
        measurement = Measurement(reading, np.zeros(4), command)
        estimate, state = filter.update(state, measurement, np.asarray(k * PERIOD))
        estimates.append(estimate)
    return estimates, state


def deflections_by_scipy(case):
    return expected(case, np.arange(0.0, float(case.run.duration), PERIOD)).deflection


@pytest.mark.parametrize(
    ("mass", "noise", "entry_time", "tolerance"),
    [(0.4, (1e-6, 2e-6), 0.02, 1e-3), (0.2, (1e-3, 1e-5), 0.025, 1e-2)],
    ids=["entry known", "entry 5 ms off"],
)
def test_planted_mass_and_speed_are_found(mass, noise, entry_time, tolerance):
    """The log is that of scipy; the design has another mass and speed, and time of entry."""
    truth = crossing(jb.MovingMass(mass=mass, speed=2.0, entry_time=0.02))
    design = designed(truth, mass=0.3, speed=1.8, entry_time=entry_time)
    readings = deflections_by_scipy(truth)[:69] + np.array([1e-4, 0.0])
    late = 0.0 if entry_time == 0.02 else 0.02
    process_noise, reading_noise = (np.asarray(part) for part in noise)
    estimator = jb.ExtendedKalman(
        process_noise,
        reading_noise,
        mass_deviation=0.15,
        speed_deviation=0.3,
        position_deviation=late,
    )
    estimates, _ = followed(estimator, design, readings)
    loads, t = estimates[-1].loads, PERIOD * 68  # at 84 % of the crossing
    assert_allclose(loads.masses, mass, rtol=tolerance)
    assert_allclose(loads.speeds, 2.0, rtol=tolerance)
    assert_allclose(loads.positions, 2.0 * (t - 0.02), rtol=tolerance)
    assert_allclose(estimates[-1].weights, 9.81 * loads.masses)


def test_states_and_weight_are_those_of_the_linear_filter():
    """A force on a known way is linear in its weight: both filters are the same."""
    case = crossing(jb.MovingForce(mass=0.4, speed=2.0), duration=0.1)
    readings = 1e-4 * np.random.default_rng(1).normal(size=(13, 2))
    known = {"mass_deviation": 0.1, "speed_deviation": 0.0}
    extended = jb.ExtendedKalman([1e-2, 2e-2], 1e-5, **known)
    linear = jb.Kalman([1e-2, 2e-2], 1e-5, loads="estimated", weight_deviation=0.981)
    found, expected = (followed(one, case, readings)[0][-1] for one in (extended, linear))
    assert_allclose(found.state, expected.state, rtol=1e-7)
    assert_allclose(found.weights, expected.weights, rtol=1e-9)


def test_position_laws_read_the_followed_loads():
    """Tables are read at the estimated positions, speeds and masses."""
    loads = jb.MovingMass(mass=0.3, speed=2.0, entry_time=0.1), jb.MovingMass(mass=0.2, speed=2.5)
    x, t = np.array([0.7, -0.4]), 0.23
    law = polynomial_law((jb.MovingMass(mass=0.15, speed=1.0),) * 2)
    since = t - np.array([0.1, 0.0])
    speeds, masses = np.array([2.0, 2.5]), np.array([0.3, 0.2])
    followed_loads = EstimatedLoads(masses, speeds * since, speeds)
    command = law.step((), Estimate(x, loads=followed_loads), REST, jnp.asarray(t)).command
    assert_allclose(command, expected_command(loads, x, t), rtol=1e-9)


def test_derivatives_by_settings_and_readings():
    case = crossing(jb.MovingMass(mass=0.3, speed=2.0, entry_time=-0.003), modes=1, duration=0.1)
    readings = deflections_by_scipy(case)[:4]
    layout = mesh_layout(case)

    def result(point):
        estimator = dataclasses.replace(FOLLOWS, mass_deviation=0.15 * point[0])
        design = designed(case, mass=0.3 * point[1], speed=2.0 * point[2])
        loads = followed(estimator, design, readings * point[3], layout)[0][-1].loads
        return xp.concatenate(loads)

    point = np.ones(4)
    differences = central(result, point, 1e-2)
    assert_allclose(
        jax.jit(jax.jacfwd(result))(jnp.asarray(point)), differences, rtol=1e-5, atol=1e-7
    )


@pytest.mark.parametrize(
    ("settings", "loads", "message"),
    [
        ({}, (), "estimator.kind needs loads to follow"),
        ({}, (jb.MovingForce(force=0.0, speed=1.0),), "loads with a weight; loads.0 has none"),
        ({"speed_deviation": [0.1, 0.1]}, None, "speed_deviation must be one number or 1, not 2"),
        ({"measurement_noise": None}, None, "measurement_noise must be given, as sensors.0"),
    ],
)
def test_errors(settings, loads, message):
    numbers = {"mass_deviation": 0.1, "speed_deviation": 0.1, "measurement_noise": NOISE}
    law = jb.LQR(
        [1.0] * 4, [1.0], period=PERIOD, estimator=jb.ExtendedKalman(1e-6, **numbers | settings)
    )
    loads = (jb.MovingMass(mass=0.3, speed=2.0),) if loads is None else loads
    case = dataclasses.replace(crossing(*loads), controller=law)
    with pytest.raises(ValueError, match=message):
        check_case(case)


@pytest.mark.parametrize("start", [0.02, 0.05, 0.3])
def test_initial_covariance_of_a_load_on_its_way(start):
    """Of x = x_0 + v (t - t_0): variance s_x^2 + (t - t_0)^2 s_v^2, covariance (t - t_0) s_v^2."""
    case = crossing(jb.MovingMass(mass=0.4, speed=2.0, entry_time=0.02))
    law = dataclasses.replace(FOLLOWS, position_deviation=np.array(0.01))
    found = law._covariance(jb.state_space(case), np.asarray(start))
    since = start - 0.02
    expected = [
        [0.01**2 + since**2 * 0.3**2, since * 0.3**2, 0.0],
        [since * 0.3**2, 0.3**2, 0.0],
        [0.0, 0.0, 0.15**2],
    ]
    assert_allclose(found, expected, rtol=1e-12, atol=1e-18)


def test_loads_lighter_than_a_newton_are_followed():
    case = crossing(jb.MovingForce(force=0.4, speed=2.0))
    assert FOLLOWS.validate(case, None) is None
