"""Regulators over the crossing of a quarter car on a rough surface, against scipy.

The plant is assembled here from the equations of `tests.oracles.quarter_car`: its states are modal
coordinates and rates, heights of body and axle with their rates, the weight, and one for the
profile. The optimum is that of the Riccati equation of this plant, by scipy.
"""

import dataclasses

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import simpson, solve_ivp
from scipy.linalg import solve_continuous_are

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.estimator import Estimate
from jaxbeam.case.validation import check_case
from jaxbeam.control.optimal.crossing_gains import crossing_events, with_crossing_load
from jaxbeam.control.state_controller import TrueState
from jaxbeam.estimation.sampled_plant import SampleTiming
from jaxbeam.estimation.simulated_vehicles import SampledWithVehicles
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.finite_horizon import finite_horizon
from tests.differences import central
from tests.oracles.loads import GRAVITY
from tests.oracles.modal_equations import Span
from tests.oracles.quarter_car import Car, cross

SPAN = Span(2.0, 6.0, 1.0, 2, 0.01)
CAR = Car(0.3, 0.1, 100.0, 1.0, 800.0, 1.0)
SPEED, AMPLITUDE, WAVELENGTH, PLACE = 2.0, 2e-3, 0.7, 0.8
END, MODES = SPAN.length / SPEED, SPAN.modes
WEIGHTS = {
    "state_weight": [50.0, 20.0, 1.0, 0.5],
    "command_weight": [1e-2],
    "positions": [1.0],
    "position_weight": [4e3],
}
DEFLECTION = np.zeros((2 * MODES + 6,) * 2)
DEFLECTION[:MODES, :MODES] = 4e3 * np.outer(SPAN.shapes(1.0), SPAN.shapes(1.0))
Q = DEFLECTION + np.diag(WEIGHTS["state_weight"] + [0.0] * 6)


def profile(x):
    """Height and slope of the surface."""
    k = 2 * np.pi / WAVELENGTH
    return AMPLITUDE * np.sin(k * x), AMPLITUDE * k * np.cos(k * x)


def beam_case(load=None, controller=None, **parts) -> jb.Case:
    car = jb.QuarterCar(**dataclasses.asdict(CAR), speed=SPEED)
    parts = {"profile": jb.profiles.SineProfile(AMPLITUDE, WAVELENGTH)} | parts
    return jb.Case(
        jb.Beam(SPAN.length, SPAN.flexural_rigidity, SPAN.mass_per_length, 0.01, modes=MODES),
        loads=[car if load is None else load],
        sensors=[jb.Sensor(1.0)],
        actuators=[jb.PointForce(PLACE)],
        controller=controller,
        run=jb.Run(END, 2000.0, gravity=GRAVITY),
        **parts,
    )


START = np.array([0.0] * 8 + [(CAR.body_mass + CAR.axle_mass) * GRAVITY, 1.0])


def plant(t):
    """A and B of the coupled plant at t (s) during the"""
    x = min(max(SPEED * t, 0.0), SPAN.length)
    shape, slope, (r, r_slope) = SPAN.shapes(x), SPAN.shapes(x, 1), profile(x)
    n, size = MODES, 2 * MODES + 6
    q, rate = np.eye(size)[:n], np.eye(size)[n : 2 * n]
    b, a, b_rate, a_rate, weight, one = np.eye(size)[2 * n :]
    surface = shape @ q + r * one
    surface_rate = shape @ rate + SPEED * (slope @ q + r_slope * one)
    tyre = CAR.tyre_stiffness * (surface - a) + CAR.tyre_damping * (surface_rate - a_rate)
    lift = CAR.suspension_stiffness * (a - b) + CAR.suspension_damping * (a_rate - b_rate)
    modal = -np.outer(shape, weight + tyre) - SPAN.damping @ rate
    modal = modal - SPAN.frequencies[:, None] ** 2 * q
    heights = [b_rate, a_rate, lift / CAR.body_mass, (tyre - lift) / CAR.axle_mass]
    A = np.vstack([rate, modal, heights, np.zeros((2, size))])
    B = np.concatenate([np.zeros(n), SPAN.shapes(PLACE), np.zeros(6)])[:, None]
    return A, B


def riccati(Q):
    """P of the Riccati equation with F = Q as a function of time (s), by scipy."""
    size = len(START)

    def rate(t, flat):
        P, (A, B) = flat.reshape(size, size), plant(t)
        return -(A.T @ P + P @ A - P @ B @ B.T @ P / 1e-2 + Q).ravel()

    solution = solve_ivp(
        rate, (END, 0.0), Q.ravel(), method="DOP853", dense_output=True, rtol=1e-10, atol=1e-10
    )
    return lambda t: solution.sol(t).reshape(size, size)


@pytest.fixture(scope="module")
def optimum():
    return riccati(Q)


def test_the_augmented_plant_is_the_vehicle_on_its_profile():
    times = np.linspace(0.0, 0.999 * END, 41)
    augmented = jb.state_space(beam_case()).augmented
    for t in times:
        A, B = plant(t)
        found = augmented(t)
        assert_allclose(found.A, A, atol=1e-9 * np.max(np.abs(A)))
        assert_allclose(found.B, B, atol=1e-12)
    solution = solve_ivp(
        lambda t, z: plant(t)[0] @ z, (0.0, END), START, t_eval=times, rtol=1e-10, atol=1e-13
    )
    states, _ = cross(SPAN, CAR, lambda t: (SPEED * t, SPEED), profile, [END], times)
    assert_allclose(solution.y.T[:, :8], states, atol=1e-7 * np.max(np.abs(states)))


def test_gains_are_those_of_the_riccati_equation(optimum):
    law, times = (
        jb.LQR(**WEIGHTS, points=200, horizon="crossing", augmented="loads"),
        np.linspace(0.01, END - 0.01, 23),
    )
    gains = np.array(jax.vmap(law.gain_table(jb.state_space(beam_case())))(times / END)[:, 0])
    expected = np.array([plant(t)[1][:, 0] @ optimum(t) / 1e-2 for t in times])
    size = np.max(np.abs(expected), axis=0)
    assert np.all(size > 0)  # of vehicle, weight and profile too
    assert_allclose(gains / size, expected / size, atol=1e-6)


def test_gains_by_the_coupled_and_the_general_method():
    law, plant = jb.LQR(**WEIGHTS, points=200, horizon="crossing"), jb.state_space(beam_case())
    tables = law.gain_table(plant), _table_of_the_general_method(law, plant)
    shares = np.linspace(0.02, 0.98, 13)
    found, expected = (np.array(jax.vmap(table)(shares)) for table in tables)
    assert found.shape[-1] == 2 * MODES + 4
    assert_allclose(found, expected, atol=1e-6 * np.max(np.abs(expected)))


def _table_of_the_general_method(law, plant):
    weights = law.weights(plant)
    Q = np.pad(np.asarray(weights[0]), (0, plant.vehicle_states))
    return finite_horizon(
        lambda t: (plant.at(t).A, plant.B(t)),
        crossing_events(plant),
        law.points,
        Q,
        np.asarray(weights[1]),
        Q,
    )[0]


def test_the_simulated_cost_is_the_optimal_one():
    weights = WEIGHTS | {"state_weight": [0.0] * 4}
    expected = START @ riccati(DEFLECTION)(0.0) @ START
    law = jb.LQR(**weights, points=200, horizon="crossing", augmented="loads")
    P = law.crossing_gains(jb.state_space(beam_case()))[1][0]
    assert_allclose(START @ np.asarray(P) @ START, expected, rtol=1e-7)
    assert_allclose(simulated_cost(law), expected, rtol=1e-5)
    # That of the vehicle's weight alone, as if it were a force, costs more.
    force = jb.MovingForce(mass=CAR.body_mass + CAR.axle_mass, speed=SPEED)
    design = jb.state_space(beam_case(force, profile=None))
    worse = jb.LQR(
        **weights, points=200, nominal_plant=design, horizon="crossing", augmented="loads"
    )
    assert simulated_cost(worse) > 1.001 * expected


def simulated_cost(law) -> float:
    """Cost of a run, with the deflection at 1 m and the command."""
    record = jb.simulate(beam_case(controller=law), tolerance=1e-8)
    deflection, command = np.asarray(record.deflection[:, 0]), np.asarray(record.command[:, 0])
    running = 4e3 * deflection**2 + 1e-2 * command**2
    return simpson(running, x=record.times) + 4e3 * deflection[-1] ** 2


@pytest.mark.parametrize(
    ("stiffness", "damping", "limit"), [(2e5, 40.0, jb.MovingMass), (1e-4, 0.0, jb.MovingForce)]
)
def test_stiff_vehicles_are_masses_and_soft_ones_forces(stiffness, damping, limit):
    law = jb.LQR(**WEIGHTS, points=200, horizon="crossing", augmented="loads")
    loads = [
        jb.Oscillator(mass=0.3, stiffness=stiffness, damping=damping, speed=SPEED),
        limit(mass=0.3, speed=SPEED),
    ]
    runs = [jb.simulate(beam_case(load, law, profile=None)) for load in loads]
    commands = [np.asarray(run.command)[:, 0] for run in runs]
    assert_allclose(commands[0], commands[1], atol=5e-3 * np.max(np.abs(commands[1])))


def test_a_sampled_law_with_an_estimator_has_the_vehicle():
    law = jb.LQR(**WEIGHTS, points=200, period=0.005, horizon="crossing", augmented="loads")
    case = beam_case(controller=law)
    kalman = jb.Kalman(process_noise=[1e-6] * 2, measurement_noise=1e-6, loads="known")
    observed = dataclasses.replace(law, estimator=kalman)
    sensors = [jb.Sensor(0.5), jb.Sensor(1.0)]
    case = dataclasses.replace(case, sensors=tuple(sensors))
    runs = [
        jb.simulate(dataclasses.replace(case, controller=controller))
        for controller in (law, observed)
    ]
    commands = [np.asarray(run.command)[:, 0] for run in runs]
    assert_allclose(commands[0], commands[1], atol=1e-3 * np.max(np.abs(commands[0])))


def test_simulated_vehicles_follow_the_true_beam():
    """Driven by the beam of the oracle, at samples, without a sensor in the vehicle."""
    period, plant = 0.005, jb.state_space(beam_case())
    times = np.arange(0.0, END + 1e-9, period)
    states, _ = cross(SPAN, CAR, lambda t: (SPEED * t, SPEED), profile, [END], times)
    timing = SampleTiming(np.asarray(period), None)
    filter = SampledWithVehicles(TrueState(np.eye(2 * MODES)), plant, timing)
    memory, found = filter.initial_state(), []
    for t, state in zip(times, states, strict=True):
        measurement = Measurement(np.zeros(1), state[: 2 * MODES], np.zeros(1))
        estimate, memory = filter.update(memory, measurement, t)
        found.append(estimate.vehicles)
    for column, expected in zip(np.array(found).T, states.T[2 * MODES :], strict=True):
        assert_allclose(column, expected, atol=1e-4 * np.max(np.abs(expected)))


def test_gradient_of_the_cost_by_the_suspension():
    law, layout = (
        jb.LQR(**WEIGHTS, points=60, horizon="crossing", augmented="loads"),
        mesh_layout(beam_case()),
    )

    def cost(logs):
        car = jb.QuarterCar(
            body_mass=0.3,
            axle_mass=0.1,
            suspension_stiffness=100.0 * jax.numpy.exp(logs[0]),
            suspension_damping=jax.numpy.exp(logs[1]),
            tyre_stiffness=800.0,
            tyre_damping=1.0,
            speed=SPEED,
        )
        plant = jb.state_space(beam_case(car), layout=layout)
        P = law.crossing_gains(plant)[1][0]
        return START @ P @ START

    found = jax.jit(jax.grad(cost))(jax.numpy.zeros(2))
    expected = central(jax.jit(cost), np.zeros(2), 1e-2)
    assert np.all(np.abs(expected) > 0)
    assert_allclose(found, expected, rtol=1e-5)


# Step-by-step and scheduled regulators with the states of a vehicle, against scipy.

STATES = 2 * MODES + 4
SETTINGS = {"state_weight": [50.0, 20.0, 1.0, 0.5], "command_weight": [1e-2]}
POINTS = 40


def test_step_by_step_gains_feed_back_the_vehicle():
    law = jb.LQR(**WEIGHTS, points=POINTS, horizon="frozen")
    shares = np.array([0.13, 0.5, 0.77])
    found = np.asarray(jax.jit(jax.vmap(law.gain_table(jb.state_space(beam_case()))))(shares))[:, 0]
    for gain, share in zip(found, shares, strict=True):
        A, B = (part[:STATES] for part in plant(share * END))
        A = A[:, :STATES]
        P = solve_continuous_are(A, B, Q[:STATES, :STATES], np.array([[1e-2]]))
        expected = B[:, 0] @ P / 1e-2
        assert np.all(expected[2 * MODES :] != 0)
        assert_allclose(gain, expected, atol=1e-5 * np.abs(expected).max())


def test_vehicles_without_damping_are_refused():
    bouncing = jb.Oscillator(mass=0.3, stiffness=100.0, damping=0.0, speed=2.0)
    case = beam_case(bouncing, jb.LQR(**SETTINGS, horizon="frozen"), profile=None)
    with pytest.raises(ValueError, match="horizon needs vehicles with damping: loads.0 has"):
        check_case(case)


def test_a_scheduled_vehicle_is_similar():
    """Twice the mass with twice the stiffness and damping, as a vehicle of its own."""
    car, factor, speed = dataclasses.asdict(CAR), 2.0, 3.0
    heavy = jb.QuarterCar(**{name: factor * value for name, value in car.items()}, speed=speed)
    expected = jb.state_space(beam_case(heavy))
    mass = factor * (CAR.body_mass + CAR.axle_mass)
    found = with_crossing_load(jb.state_space(beam_case()), mass, speed)
    for system, other in (
        (found.at(0.2), expected.at(0.2)),
        (found.augmented(0.3), expected.augmented(0.3)),
    ):
        assert_allclose(system.A, other.A, atol=1e-12 * np.abs(other.A).max())
    assert_allclose(found.augmented_start, expected.augmented_start, rtol=1e-12)


@pytest.mark.parametrize("augmented", ["none", "loads"])
def test_a_scheduled_design_at_the_mass_of_the_load_is_that_of_the_crossing(augmented):
    mass = CAR.body_mass + CAR.axle_mass
    scheduled = jb.LQR(
        **WEIGHTS,
        masses=[mass, 2 * mass],
        points=POINTS,
        augmented=augmented,
        period=0.01,
        horizon="crossing",
        schedule="load",
    )
    options = {"horizon": "crossing", "augmented": augmented}
    single = jb.LQR(**WEIGHTS, points=POINTS, period=0.01, **options)
    plant = jb.state_space(beam_case())
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
