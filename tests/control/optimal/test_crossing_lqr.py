"""Regulators for several loads at once against explicit equations of motion and scipy.

The beam is pinned at both ends; its coordinates are the amplitudes a of sines, and the masses on
it take part in M a'' + C a' + K a = S(x_c) u - sum of S(x) W, eqs (2.3) to (2.16) of the thesis.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.interpolate import BarycentricInterpolator
from scipy.linalg import block_diag, solve_continuous_are

import jaxbeam as jb
from jaxbeam.case.controller import Estimate, Measurement
from jaxbeam.case.validation import check_case
from jaxbeam.control.crossing_gains import crossing_events, with_crossing_load
from jaxbeam.control.estimation.crossing_filter import SampledWithVehicles
from jaxbeam.control.estimation.sampled_plant import SampleTiming
from jaxbeam.control.lqr import LQR
from jaxbeam.control.state_controller import TrueState
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.finite_horizon import finite_horizon
from jaxbeam.simulation.closed_loop import loop_schedule
from tests.differences import central, plan_of
from tests.oracles.crossing import GRAVITY as VEHICLE_GRAVITY
from tests.oracles.modal_equations import Span
from tests.oracles.vehicle_elements import Car, quarter_cross as cross

LENGTH, RIGIDITY, DENSITY, DAMPING, MODES = 0.6, 11.68, 0.535, 0.03, 2
POSITION, GRAVITY = 0.22, 9.81
MASSES, SPEEDS, ENTRIES = (0.3, 0.2), (1.5, 2.0), (0.0, 0.12)  # both are on the beam for a while
EXITS = [entry + LENGTH / speed for entry, speed in zip(ENTRIES, SPEEDS, strict=True)]
EVENTS = sorted([*ENTRIES, *EXITS])
TIMES = np.linspace(0.003, EVENTS[-1] - 0.003, 22)  # no event among them
WEIGHTS = {
    "state_weight": [4e5, 1e5, 10.0, 1.0],
    "command_weight": [1e-3],
    "coordinates": "sine",
}
Q, R = np.diag(WEIGHTS["state_weight"]), np.diag(WEIGHTS["command_weight"])


def beam_case(controller=None):
    return jb.Case(
        jb.Beam(LENGTH, RIGIDITY, DENSITY, DAMPING, modes=MODES),
        actuators=[jb.PointForce(POSITION)],
        sensors=[jb.Sensor(0.25)],
        loads=[
            jb.MovingMass(mass=mass, speed=speed, entry_time=entry)
            for mass, speed, entry in zip(MASSES, SPEEDS, ENTRIES, strict=True)
        ],
        controller=controller,
        run=jb.Run(EVENTS[-1], gravity=GRAVITY),
    )


def plant(time, masses=MASSES, speeds=SPEEDS, entries=ENTRIES):
    """A, B and B_f at a time (s) other than the events."""
    n = np.arange(1, MODES + 1) * np.pi / LENGTH
    rate = n**2 * np.sqrt(RIGIDITY / DENSITY)
    modal_mass = DENSITY * LENGTH / 2
    M, C, K = (
        modal_mass * np.eye(MODES),
        2 * DAMPING * modal_mass * np.diag(rate),
        modal_mass * np.diag(rate**2),
    )
    force_shapes = []
    for mass, speed, entry in zip(masses, speeds, entries, strict=True):
        on = float(entry < time < entry + LENGTH / speed)
        S, slope = np.sin(n * speed * (time - entry)), n * np.cos(n * speed * (time - entry))
        M = M + on * mass * np.outer(S, S)
        C = C + on * mass * 2 * speed * np.outer(S, slope)
        K = K - on * mass * speed**2 * np.outer(S, n**2 * S)
        force_shapes.append(-on * S)
    accelerations = np.linalg.solve(M, np.column_stack([np.sin(n * POSITION), *force_shapes]))
    stiffness, damping = np.linalg.solve(M, K), np.linalg.solve(M, C)
    A = np.block([[np.zeros((MODES, MODES)), np.eye(MODES)], [-stiffness, -damping]])
    inputs = np.vstack([np.zeros_like(accelerations), accelerations])
    return A, inputs[:, :1], inputs[:, 1:]


def integrate_between_events(rate, start, tolerance, backward=False, events=EVENTS):
    """States (time, state) at `TIMES` of an ODE that changes at the events, forward or backward."""
    found, state = {}, start
    stops = np.unique([*TIMES, *events])
    intervals = list(zip(stops[:-1], stops[1:], strict=True))
    for early, late in reversed(intervals) if backward else intervals:
        inside = early + 1e-12, late - 1e-12
        found[late if backward else early] = state
        settings = {"method": "LSODA", "rtol": tolerance, "atol": tolerance * 1e-3}
        state = solve_ivp(rate, inside[::-1] if backward else inside, state, **settings).y[:, -1]
    return np.array([found[t] for t in TIMES])


@pytest.fixture(scope="module")
def optimum():
    """Optimal gains (time, column) at `TIMES` of states and weights, by the Riccati equation."""
    size = 2 * MODES + len(MASSES)
    Q_all = block_diag(Q, np.zeros((len(MASSES),) * 2))

    def augmented(time):
        A, B, B_f = plant(time)
        weight_rates = np.zeros((len(MASSES), size))
        return np.vstack([np.hstack([A, B_f]), weight_rates]), np.vstack(
            [B, np.zeros((len(MASSES), 1))]
        )

    def rate(time, flat):
        P, (A, B) = flat.reshape(size, size), augmented(time)
        return -(A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q_all).ravel()

    costs = integrate_between_events(rate, Q_all.ravel(), 1e-10, backward=True).reshape(
        -1, size, size
    )
    return [np.linalg.solve(R, augmented(t)[1].T @ P)[0] for t, P in zip(TIMES, costs, strict=True)]


def test_optimal_gains_for_overlapping_masses(optimum):
    law = LQR(**WEIGHTS, points=300, horizon="crossing", augmented="loads")
    model = jb.state_space(beam_case(), "sine")
    gains = jax.jit(lambda shares: jax.vmap(law.gain_table(model))(shares))(TIMES / EVENTS[-1])[
        :, 0
    ]
    size = np.max(np.abs(optimum), axis=0)
    assert np.all(size > 0)
    assert_allclose(gains / size, optimum / size, atol=1e-6)


def frozen_gains(count=60):
    """Function of time (s): gain by scipy's Riccati equation at Chebyshev nodes between events."""
    intervals, nodes = [], np.cos(np.pi * (np.arange(count) + 0.5) / count)
    for early, late in zip(EVENTS[:-1], EVENTS[1:], strict=True):
        times, gains = (early + late) / 2 + (late - early) / 2 * nodes, []
        for time in times:
            A, B, _ = plant(time)
            gains.append(np.linalg.solve(R, B.T @ solve_continuous_are(A, B, Q, R)))
        intervals.append(BarycentricInterpolator(times, gains))
    return lambda time: intervals[np.searchsorted(EVENTS, time) - 1](time)


def test_loop_with_gains_of_the_frozen_plant():
    gain = frozen_gains()

    def rate(time, state):
        A, B, B_f = plant(time)
        return (A - B @ gain(time)) @ state + B_f @ (GRAVITY * np.array(MASSES))

    def uncontrolled(time, state):
        A, _, B_f = plant(time)
        return A @ state + B_f @ (GRAVITY * np.array(MASSES))

    shape = np.sin(np.arange(1, MODES + 1) * np.pi * 0.25 / LENGTH)
    deflection = integrate_between_events(rate, np.zeros(2 * MODES), 1e-8)[:, :MODES] @ shape
    uncontrolled_deflection = (
        integrate_between_events(uncontrolled, np.zeros(2 * MODES), 1e-8)[:, :MODES] @ shape
    )
    record = jb.simulate(beam_case(LQR(**WEIGHTS, points=60, horizon="frozen")), jnp.asarray(TIMES))
    peak = np.max(np.abs(deflection))
    assert_allclose(record.deflection[:, 0] / peak, deflection / peak, atol=1e-6)
    assert peak < 0.8 * np.max(np.abs(uncontrolled_deflection))


@pytest.mark.parametrize(
    "options", [{"horizon": "frozen"}, {"horizon": "crossing", "augmented": "loads"}]
)
def test_derivatives_of_a_loop_through_the_design_of_its_gains(options):
    sizes = {
        "controller.state_weight.0": 4e5,
        "controller.command_weight.0": 1e-3,
        "beam.flexural_rigidity": RIGIDITY,
        "loads.1.mass": MASSES[1],
    }
    case = beam_case(LQR(**WEIGHTS, **options, points=70))
    times = jnp.asarray(TIMES)
    schedule = loop_schedule(case, TIMES)
    plan = dataclasses.replace(plan_of(case, substeps=2, even=False), schedule=schedule)

    def outputs(point):
        values = {name: size * x for (name, size), x in zip(sizes.items(), point, strict=True)}
        record = jb.simulate(jb.replace(case, values), times, plan)
        found = jnp.stack([jnp.sum((1e3 * record.deflection) ** 2), record.effort[0]])
        return found, found

    both = jax.jit(jax.jacfwd(outputs, has_aux=True))  # one program for derivatives and differences
    at = jnp.ones(len(sizes))
    expected = central(lambda point: both(point)[1], at, step=2e-3, order=4)
    assert_allclose(both(at)[0], expected, rtol=1e-6)


# Regulators over the crossing of a quarter car on a rough surface, against scipy.
#
# The plant is assembled here from the equations of `tests.oracles.vehicle_elements`: its states
# are modal coordinates and rates, heights of body and axle with their rates, the weight, and one
# for the profile. The optimum is that of the Riccati equation of this plant, by scipy.

SPAN = Span(2.0, 6.0, 1.0, 2, 0.01)
CAR = Car(0.3, 0.1, 100.0, 1.0, 800.0, 1.0)
SPEED, AMPLITUDE, WAVELENGTH, PLACE = 2.0, 2e-3, 0.7, 0.8
END, VEHICLE_MODES = SPAN.length / SPEED, SPAN.modes
VEHICLE_WEIGHTS = {
    "state_weight": [50.0, 20.0, 1.0, 0.5],
    "command_weight": [1e-2],
    "positions": [1.0],
    "position_weight": [4e3],
}
DEFLECTION = np.zeros((2 * VEHICLE_MODES + 6,) * 2)
DEFLECTION[:VEHICLE_MODES, :VEHICLE_MODES] = 4e3 * np.outer(SPAN.shapes(1.0), SPAN.shapes(1.0))
VEHICLE_Q = DEFLECTION + np.diag(VEHICLE_WEIGHTS["state_weight"] + [0.0] * 6)


def profile(x):
    """Height and slope of the surface."""
    k = 2 * np.pi / WAVELENGTH
    return AMPLITUDE * np.sin(k * x), AMPLITUDE * k * np.cos(k * x)


def vehicle_beam_case(load=None, controller=None, **parts) -> jb.Case:
    car = jb.QuarterCar(**dataclasses.asdict(CAR), speed=SPEED)
    parts = {"profile": jb.profiles.SineProfile(AMPLITUDE, WAVELENGTH)} | parts
    return jb.Case(
        jb.Beam(
            SPAN.length, SPAN.flexural_rigidity, SPAN.mass_per_length, 0.01, modes=VEHICLE_MODES
        ),
        loads=[car if load is None else load],
        sensors=[jb.Sensor(1.0)],
        actuators=[jb.PointForce(PLACE)],
        controller=controller,
        run=jb.Run(END, 2000.0, gravity=VEHICLE_GRAVITY),
        **parts,
    )


START = np.array([0.0] * 8 + [(CAR.body_mass + CAR.axle_mass) * VEHICLE_GRAVITY, 1.0])


def vehicle_plant(t):
    """A and B of the coupled plant at t (s) during the"""
    x = min(max(SPEED * t, 0.0), SPAN.length)
    shape, slope, (r, r_slope) = SPAN.shapes(x), SPAN.shapes(x, 1), profile(x)
    n, size = VEHICLE_MODES, 2 * VEHICLE_MODES + 6
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
        P, (A, B) = flat.reshape(size, size), vehicle_plant(t)
        return -(A.T @ P + P @ A - P @ B @ B.T @ P / 1e-2 + Q).ravel()

    solution = solve_ivp(
        rate, (END, 0.0), Q.ravel(), method="DOP853", dense_output=True, rtol=1e-10, atol=1e-10
    )
    return lambda t: solution.sol(t).reshape(size, size)


@pytest.fixture(scope="module")
def vehicle_optimum():
    return riccati(VEHICLE_Q)


def test_the_augmented_plant_is_the_vehicle_on_its_profile():
    times = np.linspace(0.0, 0.999 * END, 41)
    augmented = jb.state_space(vehicle_beam_case()).augmented
    for t in times:
        A, B = vehicle_plant(t)
        found = augmented(t)
        assert_allclose(found.A, A, atol=1e-9 * np.max(np.abs(A)))
        assert_allclose(found.B, B, atol=1e-12)
    solution = solve_ivp(
        lambda t, z: vehicle_plant(t)[0] @ z,
        (0.0, END),
        START,
        t_eval=times,
        rtol=1e-10,
        atol=1e-13,
    )
    states, _ = cross(SPAN, CAR, lambda t: (SPEED * t, SPEED), profile, [END], times)
    assert_allclose(solution.y.T[:, :8], states, atol=1e-7 * np.max(np.abs(states)))


def test_gains_are_those_of_the_riccati_equation(vehicle_optimum):
    law, times = (
        jb.LQR(**VEHICLE_WEIGHTS, points=200, horizon="crossing", augmented="loads"),
        np.linspace(0.01, END - 0.01, 23),
    )
    gains = np.array(
        jax.vmap(law.gain_table(jb.state_space(vehicle_beam_case())))(times / END)[:, 0]
    )
    expected = np.array([vehicle_plant(t)[1][:, 0] @ vehicle_optimum(t) / 1e-2 for t in times])
    size = np.max(np.abs(expected), axis=0)
    assert np.all(size > 0)  # of vehicle, weight and profile too
    assert_allclose(gains / size, expected / size, atol=1e-6)


def test_gains_by_the_coupled_and_the_general_method():
    law, plant = (
        jb.LQR(**VEHICLE_WEIGHTS, points=200, horizon="crossing"),
        jb.state_space(vehicle_beam_case()),
    )
    tables = law.gain_table(plant), _table_of_the_general_method(law, plant)
    shares = np.linspace(0.02, 0.98, 13)
    found, expected = (np.array(jax.vmap(table)(shares)) for table in tables)
    assert found.shape[-1] == 2 * VEHICLE_MODES + 4
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


def test_a_sampled_law_with_an_estimator_has_the_vehicle():
    law = jb.LQR(**VEHICLE_WEIGHTS, points=200, period=0.005, horizon="crossing", augmented="loads")
    case = vehicle_beam_case(controller=law)
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
    period, plant = 0.005, jb.state_space(vehicle_beam_case())
    times = np.arange(0.0, END + 1e-9, period)
    states, _ = cross(SPAN, CAR, lambda t: (SPEED * t, SPEED), profile, [END], times)
    timing = SampleTiming(np.asarray(period), None)
    filter = SampledWithVehicles(TrueState(np.eye(2 * VEHICLE_MODES)), plant, timing)
    memory, found = filter.initial_state(), []
    for t, state in zip(times, states, strict=True):
        measurement = Measurement(np.zeros(1), state[: 2 * VEHICLE_MODES], np.zeros(1))
        estimate, memory = filter.update(memory, measurement, t)
        found.append(estimate.vehicles)
    for column, expected in zip(np.array(found).T, states.T[2 * VEHICLE_MODES :], strict=True):
        assert_allclose(column, expected, atol=1e-4 * np.max(np.abs(expected)))


def test_gradient_of_the_cost_by_the_suspension():
    law, layout = (
        jb.LQR(**VEHICLE_WEIGHTS, points=60, horizon="crossing", augmented="loads"),
        mesh_layout(vehicle_beam_case()),
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
        plant = jb.state_space(vehicle_beam_case(car), layout=layout)
        P = law.crossing_gains(plant)[1][0]
        return START @ P @ START

    found = jax.jit(jax.grad(cost))(jax.numpy.zeros(2))
    expected = central(jax.jit(cost), np.zeros(2), 1e-2)
    assert np.all(np.abs(expected) > 0)
    assert_allclose(found, expected, rtol=1e-5)


# Step-by-step and scheduled regulators with the states of a vehicle, against scipy.

STATES = 2 * VEHICLE_MODES + 4
SETTINGS = {"state_weight": [50.0, 20.0, 1.0, 0.5], "command_weight": [1e-2]}
POINTS = 40


def test_step_by_step_gains_feed_back_the_vehicle():
    law = jb.LQR(**VEHICLE_WEIGHTS, points=POINTS, horizon="frozen")
    shares = np.array([0.13, 0.5, 0.77])
    found = np.asarray(
        jax.jit(jax.vmap(law.gain_table(jb.state_space(vehicle_beam_case()))))(shares)
    )[:, 0]
    for gain, share in zip(found, shares, strict=True):
        A, B = (part[:STATES] for part in vehicle_plant(share * END))
        A = A[:, :STATES]
        P = solve_continuous_are(A, B, VEHICLE_Q[:STATES, :STATES], np.array([[1e-2]]))
        expected = B[:, 0] @ P / 1e-2
        assert np.all(expected[2 * VEHICLE_MODES :] != 0)
        assert_allclose(gain, expected, atol=1e-5 * np.abs(expected).max())


def test_vehicles_without_damping_are_refused():
    bouncing = jb.Oscillator(mass=0.3, stiffness=100.0, damping=0.0, speed=2.0)
    case = vehicle_beam_case(bouncing, jb.LQR(**SETTINGS, horizon="frozen"), profile=None)
    with pytest.raises(ValueError, match="horizon needs vehicles with damping: loads.0 has"):
        check_case(case)


def test_a_scheduled_vehicle_is_similar():
    """Twice the mass with twice the stiffness and damping, as a vehicle of its own."""
    car, factor, speed = dataclasses.asdict(CAR), 2.0, 3.0
    heavy = jb.QuarterCar(**{name: factor * value for name, value in car.items()}, speed=speed)
    expected = jb.state_space(vehicle_beam_case(heavy))
    mass = factor * (CAR.body_mass + CAR.axle_mass)
    found = with_crossing_load(jb.state_space(vehicle_beam_case()), mass, speed)
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
        **VEHICLE_WEIGHTS,
        masses=[mass, 2 * mass],
        points=POINTS,
        augmented=augmented,
        period=0.01,
        horizon="crossing",
        schedule="load",
    )
    options = {"horizon": "crossing", "augmented": augmented}
    single = jb.LQR(**VEHICLE_WEIGHTS, points=POINTS, period=0.01, **options)
    plant = jb.state_space(vehicle_beam_case())
    laws = [law.design_state_law(plant, plant) for law in (scheduled, single)]
    assert laws[0].needs_vehicles
    state = np.random.default_rng(3).normal(size=STATES) * 1e-3
    estimate = Estimate(state[: 2 * VEHICLE_MODES], vehicles=state[2 * VEHICLE_MODES :])
    measurement = Measurement(np.zeros(1), state[: 2 * VEHICLE_MODES], np.zeros(1))
    found, expected = (
        jax.jit(
            lambda law=law: (
                law.step(law.initial_state(), estimate, measurement, np.asarray(0.4)).command
            )
        )()
        for law in laws
    )
    assert_allclose(found, expected, rtol=1e-6)
