"""Settings of the design of regulators: weighted deflections, design model, after the crossing.

Gains are compared by the poles of the loop, with those of explicit plants and scipy's gains.
"""

import dataclasses
import json
import os
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, solve_continuous_are

import jaxbeam as jb
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.case.validation import check_case
from jaxbeam.control.lqr import LQR
from jaxbeam.control.state_controller import DesignModel
from jaxbeam.simulation.closed_loop import loop_schedule
from tests.analysis import test_stability as oracle
from tests.analysis.test_stability import LENGTH, MASS, SPEED, shaker_case, state_matrices
from tests.control.optimal.test_crossing_lqr import (
    ENTRIES,
    EVENTS,
    GRAVITY,
    LENGTH as PREDICTED_LENGTH,
    MASSES,
    MODES,
    SPEEDS,
    TIMES as PREDICTED_TIMES,
    WEIGHTS,
    Q,
    R,
    beam_case,
    integrate_between_events,
    plant,
)
from tests.differences import plan_of

STATES = [1000.0, 100.0, 10.0, 0.1, 0.01, 0.01, 0.0]
TIMES = np.array([0.2, 0.4]) / SPEED


def sines(x):
    return np.sin(np.arange(1, 4) * np.pi * x / LENGTH)


def gain(A, B, Q=None, R=9e-5):
    """Gain of the time-invariant regulator of a plant, by scipy."""
    Q = np.diag(STATES) if Q is None else Q
    return B.T @ scipy.linalg.solve_continuous_are(A, B, Q, [[R]]) / R


def assert_poles(case, times, matrices, rtol=1e-7):
    """Check that the poles at some times (s) are the eigenvalues of the matrices."""
    found = frozen_poles(case, np.asarray(times)).poles
    for poles, matrix in zip(found, matrices, strict=True):
        expected = np.sort_complex(np.linalg.eigvals(matrix))
        assert_allclose(np.sort_complex(poles), expected, rtol=rtol)


def test_weighted_deflections():
    """Eq. (3.2) of the thesis, y'Qy with the deflections y at some positions."""
    positions, weights = [0.15, 0.4], [2e5, 7e5]
    law = jb.LQR(STATES, [9e-5], positions=positions, position_weight=weights, coordinates="sine")
    rows = np.zeros((2, 7))
    rows[:, :3] = [sines(x) for x in positions]
    A, B = state_matrices(0.0, 0.0, 0.0, 4.6)
    K = gain(A, B, np.diag(STATES) + rows.T @ np.diag(weights) @ rows)
    assert np.max(np.abs(K / gain(A, B) - 1)) > 0.5  # the weights matter
    loops = [state_matrices(SPEED * t, SPEED, MASS, 4.6)[0] - B @ K for t in TIMES]
    assert_poles(shaker_case(law), TIMES, loops)


def test_design_without_suspension(monkeypatch):
    law = jb.LQR(STATES, [9e-5], coordinates="sine", design=DesignModel(stiffness=0.0, damping=0.0))
    case, plants = shaker_case(law), [state_matrices(SPEED * t, SPEED, MASS, 4.6) for t in TIMES]
    monkeypatch.setattr(oracle, "SPRING", 0.0)
    monkeypatch.setattr(oracle, "DAMPER", 0.0)
    K = gain(*state_matrices(0.0, 0.0, 0.0, 4.6))
    assert_poles(case, TIMES, [A - B @ K for A, B in plants])


def test_design_with_another_mass_and_speed():
    """The gain is that for the position of the load, with mass and speed of the design."""
    law = jb.LQR(
        STATES,
        [9e-5],
        coordinates="sine",
        points=300,
        design=DesignModel(mass=0.3, speed=0.8),
        horizon="frozen",
    )
    loops = []
    for x in SPEED * TIMES:
        A, B = state_matrices(x, SPEED, MASS, 4.6)
        loops.append(A - B @ gain(*state_matrices(x, 0.8, 0.3, 4.6)))
    assert_poles(shaker_case(law), TIMES, loops, rtol=1e-5)


def test_time_invariant_regulator_after_the_crossing():
    law = jb.LQR(
        STATES, [9e-5], coordinates="sine", points=100, after="time-invariant", horizon="frozen"
    )
    A, B = state_matrices(0.0, 0.0, 0.0, 4.6)
    assert_poles(shaker_case(law), [1.2], [A - B @ gain(A, B)])  # the load leaves at 1.09 s
    without_regulator = jb.LQR(STATES, [9e-5], coordinates="sine", points=100, horizon="frozen")
    assert_poles(shaker_case(without_regulator), [1.2], [A])


# A table of default size, designed in a process with two threads: it must end.

SHARE = 0.4375  # of the crossing
TIME_LIMIT = 240  # s, of which an idle machine needs ten
LOOP_STATES, LOOP_COMMANDS = [1e6] * 3 + [10.0] * 3, [1e-3]
DESIGN = """
import json
import equinox as eqx
import jaxbeam as jb
from tests.control.optimal.test_design_settings import SHARE, loop
case = loop()
jb.simulate(case)
gains = eqx.filter_jit(lambda plant: case.controller.gain_table(plant)(SHARE))
print(json.dumps(gains(jb.state_space(case, "modal")).tolist()))
"""


def loop():
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=3),
        actuators=[jb.PointForce(0.25)],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.5, speed=1.0)],
        controller=jb.LQR(LOOP_STATES, LOOP_COMMANDS, horizon="frozen"),
        run=jb.Run(0.7),
    )


def test_a_run_with_the_default_number_of_points_ends():
    environment = os.environ | {"PJRT_NPROC": "2"}
    line = [sys.executable, "-c", DESIGN]
    found = subprocess.run(
        line, capture_output=True, text=True, env=environment, timeout=TIME_LIMIT
    )
    assert found.returncode == 0, found.stderr
    plant = jb.state_space(loop(), "modal")
    time = SHARE * 0.6
    A, B = np.asarray(plant.A(time)), np.asarray(plant.B(time))
    P = solve_continuous_are(A, B, np.diag(LOOP_STATES), np.diag(LOOP_COMMANDS))
    expected = B.T @ P / LOOP_COMMANDS[0]
    assert_allclose(
        json.loads(found.stdout), expected, rtol=1e-7, atol=1e-7 * np.abs(expected).max()
    )


# Masses that differ in entry time, speed and mass from those predicted by the regulator.
#
# Reference: the regulator of the prediction by scipy, on explicit equations of motion of the
# masses.

# First late and heavier; second early and lighter, so that both overlap.
PREDICTED = {"masses": (0.36, 0.15), "speeds": (1.6, 1.9), "entries": (0.013, 0.095)}
TRUE = {"masses": MASSES, "speeds": SPEEDS, "entries": ENTRIES}
FINE_TIMES = np.union1d(PREDICTED_TIMES, np.linspace(0.0, EVENTS[-1], 801))
PREDICTION = DesignModel(
    mass=PREDICTED["masses"], speed=PREDICTED["speeds"], entry_time=PREDICTED["entries"]
)
LAW = LQR(
    **WEIGHTS,
    points=300,
    design=PREDICTION,
    entries="predicted",
    horizon="crossing",
    augmented="loads",
)


def events(speeds, entries):
    pairs = zip(speeds, entries, strict=True)
    return np.sort([*entries, *(entry + PREDICTED_LENGTH / speed for speed, entry in pairs)])


def optimal_gain(masses, speeds, entries):
    """Function of time (s): optimal gain of states and weights, zero outside the crossing."""
    count = len(masses)
    size, times, intervals = 2 * MODES + count, events(speeds, entries), []
    Q_all = block_diag(Q, np.zeros((count, count)))

    def augmented(time):
        A, B, B_f = plant(time, masses, speeds, entries)
        weight_rates = np.zeros((count, size))
        return np.vstack([np.hstack([A, B_f]), weight_rates]), np.vstack([B, np.zeros((count, 1))])

    def rate(time, flat):
        P, (A, B) = flat.reshape(size, size), augmented(time)
        return -(A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q_all).ravel()

    P = Q_all.ravel()
    for early, late in reversed(list(zip(times[:-1], times[1:], strict=True))):
        span = late - 1e-12, early + 1e-12
        interval = solve_ivp(rate, span, P, "DOP853", rtol=1e-9, atol=1e-12, dense_output=True)
        intervals.insert(0, interval.sol)
        P = interval.y[:, -1]

    def gain(time):
        if not times[0] < time < times[-1]:
            return np.zeros((1, size))
        P = intervals[np.searchsorted(times, time) - 1](time).reshape(size, size)
        return np.linalg.solve(R, augmented(time)[1].T @ P)

    return gain


def deflections(predicted):
    """Deflections (m) at `TIMES` under the true masses and the regulator of the prediction."""
    gain = optimal_gain(**predicted)
    weights = GRAVITY * np.array(predicted["masses"])

    def rate(time, state):
        A, B, B_f = plant(time)
        command = -gain(time) @ np.append(state, weights)
        return A @ state + B @ command + B_f @ (GRAVITY * np.array(MASSES))

    times = [*EVENTS, *events(predicted["speeds"], predicted["entries"])]
    states = integrate_between_events(rate, np.zeros(2 * MODES), 1e-8, events=times)
    return states[:, :MODES] @ np.sin(np.arange(1, MODES + 1) * np.pi * 0.25 / PREDICTED_LENGTH)


def simulated(predicted):
    """Run on `FINE_TIMES` under the regulator of a prediction, in single steps between them."""
    numbers = {"mass": "masses", "speed": "speeds", "entry_time": "entries"}
    design = DesignModel(**{name: predicted[key] for name, key in numbers.items()})
    case = beam_case(dataclasses.replace(LAW, design=design))
    plan = plan_of(case, substeps=1, even=False)
    plan = dataclasses.replace(plan, schedule=loop_schedule(case, FINE_TIMES))
    return jb.simulate(case, jnp.asarray(FINE_TIMES), plan)


def test_deflections_under_a_wrong_prediction():
    expected, exact = deflections(PREDICTED), deflections(TRUE)
    found = np.asarray(simulated(PREDICTED).deflection)[np.isin(FINE_TIMES, PREDICTED_TIMES), 0]
    peak = np.max(np.abs(expected))
    assert_allclose(found / peak, expected / peak, atol=1e-6)
    assert np.max(np.abs(exact - expected)) > 0.1 * peak  # the prediction matters


def test_errors_of_predicted_entries():
    table = jb.MovingMass(mass=0.2, times=[0.0, 0.3], positions=[0.0, 0.6])
    case = dataclasses.replace(beam_case(LAW), loads=(table,))
    late = dataclasses.replace(LAW, design=DesignModel(entry_time=0.1))
    with pytest.raises(ValueError, match=r"design\.entry_time has no effect"):
        check_case(dataclasses.replace(case, controller=late))
    single_load = dataclasses.replace(beam_case(), loads=beam_case().loads[:1])
    law = LQR(
        **WEIGHTS,
        masses=[0.3],
        points=300,
        entries="predicted",
        horizon="crossing",
        schedule="load",
    )
    with pytest.raises(ValueError, match="entries must be 'measured'"):
        check_case(dataclasses.replace(single_load, controller=law))
