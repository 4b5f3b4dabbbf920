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
from jaxbeam.control.optimal.lqr import LQR
from jaxbeam.simulation.closed_loop import loop_schedule
from tests.differences import central
from tests.runs import plan_of

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
