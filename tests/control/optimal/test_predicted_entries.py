"""A stream of masses that enter at other times, and weigh other, than the regulator predicts.

The regulator of what is predicted, by scipy, on equations of motion written out for what comes.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag

import jaxbeam as jb
from jaxbeam.case.validation import check
from jaxbeam.control import AugmentedLQR, ScheduledLQR
from jaxbeam.control.design_model import DesignModel
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.simulation.closed_loop import loop_schedule
from tests.control.optimal.test_regulators import (
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
    by_pieces,
    plant,
    rig,
)
from tests.runs import plan_of

# Both late to be noticed, the second as early as it overlaps the first; heavier, lighter.
PREDICTED = {"masses": (0.36, 0.15), "speeds": (1.6, 1.9), "entries": (0.013, 0.095)}
TRUE = {"masses": MASSES, "speeds": SPEEDS, "entries": ENTRIES}
EVERY = np.union1d(TIMES, np.linspace(0.0, EVENTS[-1], 801))
BELIEFS = DesignModel(
    mass=PREDICTED["masses"], speed=PREDICTED["speeds"], entry_time=PREDICTED["entries"]
)
LAW = AugmentedLQR(**WEIGHTS, points=300, design=BELIEFS, entries="predicted")


def events(speeds, entries):
    pairs = zip(speeds, entries, strict=True)
    return np.sort([*entries, *(entry + LENGTH / speed for speed, entry in pairs)])


def optimal_gain(masses, speeds, entries):
    """The optimal gain of states and weights at a time, zero before and after the crossing."""
    count = len(masses)
    size, marks, legs = 2 * MODES + count, events(speeds, entries), []
    Q_all = block_diag(Q, np.zeros((count, count)))

    def joint(time):
        A, B, B_f = plant(time, masses, speeds, entries)
        below = np.zeros((count, size))
        return np.vstack([np.hstack([A, B_f]), below]), np.vstack([B, np.zeros((count, 1))])

    def rate(time, flat):
        P, (A, B) = flat.reshape(size, size), joint(time)
        return -(A.T @ P + P @ A - P @ B @ np.linalg.solve(R, B.T @ P) + Q_all).ravel()

    P = Q_all.ravel()
    for early, late in reversed(list(zip(marks[:-1], marks[1:], strict=True))):
        span = late - 1e-12, early + 1e-12
        leg = solve_ivp(rate, span, P, "DOP853", rtol=1e-9, atol=1e-12, dense_output=True)
        legs.insert(0, leg.sol)
        P = leg.y[:, -1]

    def gain(time):
        if not marks[0] < time < marks[-1]:
            return np.zeros((1, size))
        P = legs[np.searchsorted(marks, time) - 1](time).reshape(size, size)
        return np.linalg.solve(R, joint(time)[1].T @ P)

    return gain


def deflections(predicted):
    """Deflections (m) at `TIMES` of what comes, under the regulator of what is predicted."""
    gain = optimal_gain(**predicted)
    weights = GRAVITY * np.array(predicted["masses"])

    def rate(time, state):
        A, B, B_f = plant(time)
        command = -gain(time) @ np.append(state, weights)
        return A @ state + B @ command + B_f @ (GRAVITY * np.array(MASSES))

    marks = [*EVENTS, *events(predicted["speeds"], predicted["entries"])]
    states = by_pieces(rate, np.zeros(2 * MODES), 1e-8, events=marks)
    return states[:, :MODES] @ np.sin(np.arange(1, MODES + 1) * np.pi * 0.25 / LENGTH)


def simulated(predicted):
    """The run on `EVERY` under the law for what is predicted, in single steps between them."""
    numbers = {"mass": "masses", "speed": "speeds", "entry_time": "entries"}
    beliefs = DesignModel(**{name: predicted[key] for name, key in numbers.items()})
    case = rig(dataclasses.replace(LAW, design=beliefs))
    plan = plan_of(case, substeps=1, even=False)
    plan = dataclasses.replace(plan, schedule=loop_schedule(case, EVERY))
    return jb.simulate(case, jnp.asarray(EVERY), plan)


def test_what_is_predicted_runs_by_the_clock():
    expected, right = deflections(PREDICTED), deflections(TRUE)
    found = np.asarray(simulated(PREDICTED).deflection)[np.isin(EVERY, TIMES), 0]
    peak = np.max(np.abs(expected))
    assert_allclose(found / peak, expected / peak, atol=1e-6)
    assert np.max(np.abs(right - expected)) > 0.1 * peak  # it matters


def test_no_prediction_costs_less_than_the_right_one():
    """The cost x'Fx + integral of x'Qx + u'Ru, of which the right one attains the minimum."""
    scale = jb.state_space(rig(), "sine").scale

    def cost(**wrong):
        record = simulated(TRUE | wrong)
        states = np.hstack([record.coordinates * scale, record.rates * scale])
        spent = np.einsum("ti,ij,tj->t", states, Q, states) + R[0, 0] * record.command[:, 0] ** 2
        return np.trapezoid(spent, EVERY) + states[-1] @ Q @ states[-1]

    right, masses = cost(), np.array(MASSES)
    late, heavy = cost(entries=np.add(ENTRIES, 0.02)), cost(masses=1.3 * masses)
    assert right < late and right < heavy
    # At its minimum the cost is flat: half the error costs a quarter.
    half = cost(masses=1.15 * masses)
    assert (heavy - right) / (half - right) == pytest.approx(4.0, rel=0.02)


def test_case_files_hold_predictions():
    case = rig(LAW)
    check(case)
    assert case_from_dict(case_to_dict(case)).controller.entries == "predicted"


def test_what_is_no_prediction_is_refused():
    table = jb.MovingMass(mass=0.2, times=[0.0, 0.3], positions=[0.0, 0.6])
    case = dataclasses.replace(rig(LAW), loads=(table,))
    late = dataclasses.replace(LAW, design=DesignModel(entry_time=0.1))
    with pytest.raises(ValueError, match=r"design\.entry_time has no effect"):
        check(dataclasses.replace(case, controller=late))
    one = dataclasses.replace(rig(), loads=rig().loads[:1])
    law = ScheduledLQR(**WEIGHTS, masses=[0.3], points=300, entries="predicted")
    with pytest.raises(ValueError, match="entries must be 'measured'"):
        check(dataclasses.replace(one, controller=law))
