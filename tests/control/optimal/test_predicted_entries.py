"""Masses that differ in entry time, speed and mass from those predicted by the regulator.

Reference: the regulator of the prediction by scipy, on explicit equations of motion of the masses.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.control.design_model import DesignModel
from jaxbeam.control.optimal.lqr import LQR
from jaxbeam.simulation.closed_loop import loop_schedule
from tests.control.optimal.test_crossing_lqr import (
    ENTRIES,
    EVENTS,
    GRAVITY,
    LENGTH,
    MASSES,
    MODES,
    SPEEDS,
    TIMES,
    WEIGHTS,
    Q,
    R,
    beam_case,
    integrate_between_events,
    plant,
)
from tests.runs import plan_of

# First late and heavier; second early and lighter, so that both overlap.
PREDICTED = {"masses": (0.36, 0.15), "speeds": (1.6, 1.9), "entries": (0.013, 0.095)}
TRUE = {"masses": MASSES, "speeds": SPEEDS, "entries": ENTRIES}
FINE_TIMES = np.union1d(TIMES, np.linspace(0.0, EVENTS[-1], 801))
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
    return np.sort([*entries, *(entry + LENGTH / speed for speed, entry in pairs)])


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
    return states[:, :MODES] @ np.sin(np.arange(1, MODES + 1) * np.pi * 0.25 / LENGTH)


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
    found = np.asarray(simulated(PREDICTED).deflection)[np.isin(FINE_TIMES, TIMES), 0]
    peak = np.max(np.abs(expected))
    assert_allclose(found / peak, expected / peak, atol=1e-6)
    assert np.max(np.abs(exact - expected)) > 0.1 * peak  # the prediction matters


def test_exact_prediction_has_the_least_cost():
    """The cost is x'Fx + integral of x'Qx + u'Ru."""
    scale = jb.state_space(beam_case(), "sine").coordinate_scale

    def cost(**errors):
        record = simulated(TRUE | errors)
        states = np.hstack([record.coordinates * scale, record.rates * scale])
        cost_rate = (
            np.einsum("ti,ij,tj->t", states, Q, states) + R[0, 0] * record.command[:, 0] ** 2
        )
        return np.trapezoid(cost_rate, FINE_TIMES) + states[-1] @ Q @ states[-1]

    exact, masses = cost(), np.array(MASSES)
    late_entries, large_masses = cost(entries=np.add(ENTRIES, 0.02)), cost(masses=1.3 * masses)
    assert exact < late_entries and exact < large_masses
    # At its minimum the cost is flat: half the error costs a quarter.
    half = cost(masses=1.15 * masses)
    assert (large_masses - exact) / (half - exact) == pytest.approx(4.0, rel=0.02)


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
