"""Kalman filters against brute-force Gaussian conditioning; loads that are followed; observers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.linearised_loop import linearised_loop
from jaxbeam.case.controller import Estimate, EstimatedLoads, Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.estimation.kalman import Kalman
from jaxbeam.control.estimation.observer import Observer
from jaxbeam.control.estimation.sampled_plant import sample_timing
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.model.modes import mesh_layout
from tests.control.optimal.test_scheduled_lqr import LENGTH, REST, expected_command, polynomial_law
from tests.differences import central
from tests.loop_as_oracle import expected, parts_of, span_of
from tests.oracles.sampled_plant import SampledPlant, conditioned, over_period

PERIOD = 1e-3
NOISE = np.array([1e-5, 2e-4, 0.05, 5e-7])
CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.03, modes=2),
    actuators=[jb.Shaker(0.4, stiffness=500.0, damping=8.0, bandwidth=400.0)],
    sensors=[
        jb.Sensor(0.15, noise=1e-5, offset=1e-4),
        jb.Sensor(0.25, "velocity", noise=2e-4),
        jb.Sensor(0.35, "acceleration", noise=0.05),
        jb.Sensor(0.45, "strain", fibre_distance=1.65e-3, noise=5e-7),
    ],
    loads=[jb.MovingMass(mass=0.4, speed=0.5, entry_time=-0.4)],
    controller=jb.Prescribed([0.0], period=PERIOD),
)
DIRECT = dataclasses.replace(CASE, actuators=(jb.PointForce(0.4),))  # whose force is the command
OFFSET = np.array([1e-4, 0.0, 0.0, 0.0])
FORCES = np.array([1e-2, 2e-2])
DEVIATION = 2.0
ESTIMATED = Kalman(FORCES, loads="estimated", weight_deviation=DEVIATION)
LAYOUT = mesh_layout(CASE)


def with_delay(case, delay):
    return dataclasses.replace(case, controller=jb.Prescribed([0.0], period=PERIOD, delay=delay))


@jax.jit
def filter_readings(kalman, case, commands, readings):
    """State of the filter after the last sample; estimates and squared innovations (sample, ...).

    Innovations are squared over their covariance.
    """
    plant = jb.state_space(case, layout=LAYOUT)
    filter = kalman.sampled_filter(plant, sample_timing(case.controller))

    def update(state, sample):
        t, command, reading = sample
        square = jnp.zeros(())
        if kalman.loads != "ignored":
            prediction = filter.predict(state, command, t)
            innovation = reading - prediction.readings
            square = innovation @ jnp.linalg.solve(prediction.innovation_covariance, innovation)
        measurement = Measurement(reading, jnp.zeros(5), command)
        estimate, state = filter.update(state, measurement, t)
        return state, (estimate, square)

    samples = PERIOD * jnp.arange(len(readings)), commands, readings
    return jax.lax.scan(update, filter.initial_state(), samples)


def oracle(case, samples, delay=0.0, loaded=True):
    """Transitions and rows (C, D) of the readings at the samples, by the oracle."""
    span, loads, actuators, sensors = parts_of(case)
    plant = SampledPlant(span, loads if loaded else [], actuators, sensors)
    lags = [0.0 for actuator in actuators if actuator.lag is not None]
    intensity = np.diag([0.0, 0.0, *FORCES, *lags, *([0.0] * loaded)])
    times = PERIOD * np.arange(samples if loaded else 1)
    steps = [plant.step(t, PERIOD, delay, intensity) for t in times]
    rows = [plant.matrices(t)[2:] for t in times]
    return (steps, rows) if loaded else (steps * samples, rows * samples)


def signals(samples):
    """Random commands and readings."""
    random = np.random.default_rng(1)
    return random.normal(size=(samples, 1)), NOISE * random.normal(size=(samples, 4)) * 10


@pytest.mark.parametrize("case", [CASE, DIRECT], ids=["shaker", "force"])
@pytest.mark.parametrize(
    ("kalman", "delay", "samples"),
    [
        (Kalman(FORCES), 0.0022, 240),
        (Kalman(FORCES, loads="known"), None, 8),
        (ESTIMATED, 0.0013, 8),
    ],
    ids=lambda x: getattr(x, "loads", None),
)
def test_estimates_by_gaussian_conditioning(kalman, delay, samples, case):
    """The time-invariant filter has forgotten its initial state by the last sample."""
    loaded = kalman.loads != "ignored"
    commands, readings = signals(samples)
    filter_state, (estimate, _) = filter_readings(
        kalman, with_delay(case, delay), commands, readings
    )
    remainder = 0.0 if delay is None else delay % PERIOD
    steps, rows = oracle(case, samples, remainder, loaded)
    size = steps[0].transition.shape[0]
    mean, covariance = np.zeros(size), np.zeros((size, size))
    if loaded:
        mean[-1] = 0.4 * 9.81
        covariance[-1, -1] = DEVIATION**2 if kalman.loads == "estimated" else 0.0
    state, covariance = conditioned(
        (mean, covariance), steps, rows, np.diag(NOISE**2), commands, readings - OFFSET
    )
    scale = np.sqrt(np.diag(covariance)) + 1e-6 * np.abs(state)
    assert_allclose(filter_state[0] / scale, state / scale, rtol=0, atol=1e-4)
    if loaded:
        outer = scale * scale[:, None]
        assert_allclose(filter_state.covariance / outer, covariance / outer, rtol=0, atol=1e-4)
    if kalman.loads == "estimated":
        assert_allclose(estimate.weights[-1, 0], state[-1], rtol=1e-4)
    else:
        assert estimate.weights is None


# Extended Kalman filters: planted masses and speeds from scipy's motion of the beam.

EXTENDED_PERIOD, EXTENDED_NOISE = 4e-3, 2e-6
FOLLOWS = jb.ExtendedKalman(1e-3, 1e-5, mass_deviation=0.15, speed_deviation=0.3)


def crossing(*loads, modes=2, duration=0.35) -> jb.Case:
    return jb.Case(
        jb.Beam(LENGTH, 11.68, 0.535, damping_ratio=0.03, modes=modes),
        actuators=[jb.PointForce(0.4)],
        sensors=[jb.Sensor(0.17, offset=1e-4), jb.Sensor(0.35)],
        loads=loads,
        controller=jb.Prescribed([0.3], period=EXTENDED_PERIOD),
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
        estimate, state = filter.update(state, measurement, np.asarray(k * EXTENDED_PERIOD))
        estimates.append(estimate)
    return estimates, state


def test_an_acceleration_that_is_that_of_the_command_tells_nothing():
    """Before the load comes: q'' = phi u - 2 zeta w q' - w^2 q of each mode."""
    sensors = [jb.Sensor(0.17), jb.Sensor(0.35, "acceleration")]
    case = dataclasses.replace(
        crossing(jb.MovingMass(mass=0.4, speed=2.0, entry_time=0.02)), sensors=sensors
    )
    plant, command = jb.state_space(case), np.array([0.3])
    filter = FOLLOWS.sampled_filter(plant, sample_timing(case.controller))
    predicted, _ = filter.predict(filter.initial_state(), command, np.asarray(0.0))
    q, rates = predicted[:2], predicted[2:4]
    w = (np.arange(1, 3) * np.pi / LENGTH) ** 2 * (11.68 / 0.535) ** 0.5
    shapes = plant.modal_model.modes.shapes(np.array([0.17, 0.35, 0.4]))
    accelerations = 0.3 * shapes[2] - 0.06 * w * rates - w**2 * q
    readings = np.array([shapes[0] @ q, shapes[1] @ accelerations])
    measurement = Measurement(readings, np.zeros(4), command)
    estimate, _ = filter.update(filter.initial_state(), measurement, np.asarray(0.0))
    assert_allclose(estimate.state, predicted[:4], rtol=1e-6, atol=1e-15)


def test_accelerations_under_a_followed_mass():
    """One update with (1 + m phi phi^T) q'' of each mode, differenced by the load's numbers."""
    sensors = [jb.Sensor(0.17), jb.Sensor(0.35, "acceleration")]
    case = dataclasses.replace(
        crossing(jb.MovingMass(mass=0.4, speed=2.0, entry_time=-0.1)), sensors=sensors
    )
    plant, command, t = jb.state_space(case), np.array([30.0]), np.asarray(0.0)
    filter = FOLLOWS.sampled_filter(plant, sample_timing(case.controller))
    start = filter.initial_state()
    x, covariance = (np.asarray(part) for part in filter.predict(start, command, t))
    n, w = np.arange(1, 3) * np.pi / LENGTH, (np.arange(1, 3) * np.pi / LENGTH) ** 2
    w = w * (11.68 / 0.535) ** 0.5

    def fields(position):
        sine, cosine = np.sin(n * position), np.cos(n * position)
        return (2 / (0.535 * LENGTH)) ** 0.5 * np.array([sine, n * cosine, -(n**2) * sine])

    def read(x):
        (shape, slope, bend), speed, mass = fields(x[4]), x[5], x[6]
        forces = 30.0 * fields(0.4)[0] - 0.06 * w * x[2:4] - w**2 * x[:2]
        forces -= shape * mass * (9.81 + 2 * speed * slope @ x[2:4] + speed**2 * bend @ x[:2])
        accelerations = np.linalg.solve(np.eye(2) + mass * np.outer(shape, shape), forces)
        return np.array([fields(0.17)[0] @ x[:2], fields(0.35)[0] @ accelerations])

    rows, innovation = central(read, x, 1e-6), np.array([2e-5, 0.3])
    noise = np.diag(np.full(2, FOLLOWS.measurement_noise) ** 2)
    gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T + noise)
    _, found = filter.update(start, Measurement(read(x) + innovation, np.zeros(4), command), t)
    assert_allclose(found.x - x, gain @ innovation, rtol=1e-5, atol=1e-12)


def deflections_by_scipy(case):
    return expected(case, np.arange(0.0, float(case.run.duration), EXTENDED_PERIOD)).deflection


@pytest.mark.parametrize(("period", "rtol"), [(2e-3, 2e-5), (5e-3, 5e-4)])
def test_a_period_of_fast_modes_under_a_mass_by_scipy(period, rtol):
    """In one step of Magnus' method it was 4 and 64 % off, at up to 4 and 10 rad in a period."""
    mass, speed, t = 0.4, 4.0, 0.08
    case = crossing(jb.MovingMass(mass=mass, speed=speed), modes=4)
    case = dataclasses.replace(case, controller=jb.Prescribed([0.0], period=period))
    plant, span = jb.state_space(case), span_of(case)
    timing = sample_timing(case.controller)

    def matrices_at(time):
        x = speed * time
        under, slope, curvature = (span.shapes(x, order) for order in range(3))
        stiffness = np.diag(span.frequencies**2) + mass * speed**2 * np.outer(under, curvature)
        damping = span.damping + 2 * mass * speed * np.outer(under, slope)
        forces = np.stack([span.shapes(0.4), -under], axis=1)
        rates = np.hstack([-stiffness, -damping, forces])
        rates = np.linalg.solve(np.eye(span.modes) + mass * np.outer(under, under), rates)
        A = np.vstack([np.eye(span.modes, 2 * span.modes, k=span.modes), rates[:, :-2]])
        return A, np.vstack([np.zeros((span.modes, 2)), rates[:, -2:]])

    (A, B), at = over_period(matrices_at, t - period, t), np.asarray(t)
    known = Kalman(1e-2, 1e-5, loads="known").sampled_filter(plant, timing)
    found, states, size = known.model_at(at)[0], 2 * span.modes, np.abs(A).max(axis=0)
    assert_allclose(found.matrix[:states, :states] / size, A / size, atol=rtol)
    assert_allclose(found.matrix[:states, states], B[:, 1], atol=rtol * np.abs(B[:, 1]).max())
    assert_allclose(found.input_matrix[:states, 0], B[:, 0], atol=rtol * np.abs(B[:, 0]).max())
    following = FOLLOWS.sampled_filter(plant, timing)
    memory = following.initial_state()
    numbers = np.array([speed * (t - period), speed, mass])
    for i, column in enumerate(A.T):
        state = np.append(np.eye(states)[i] * 1e-3 / size[i], numbers)
        command = np.ones(1)
        found, _ = following.predict(memory._replace(x=state, command=command), command, at)
        expected = 1e-3 * column / size[i] + B[:, 0] + 9.81 * mass * B[:, 1]
        assert_allclose(found[:states], expected, atol=rtol * np.abs(expected).max())


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
    loads, t = estimates[-1].loads, EXTENDED_PERIOD * 68  # at 84 % of the crossing
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
    numbers = {"mass_deviation": 0.1, "speed_deviation": 0.1, "measurement_noise": EXTENDED_NOISE}
    law = jb.LQR(
        [1.0] * 4,
        [1.0],
        period=EXTENDED_PERIOD,
        estimator=jb.ExtendedKalman(1e-6, **numbers | settings),
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


# Poles of the Luenberger observer, alone and in closed loops.


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
