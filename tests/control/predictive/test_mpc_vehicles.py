"""Predictive control of a beam under a vehicle on a rough surface, against an explicit program.

Plant by scipy's integration of the matrices in `test_crossing_vehicles`; moves by least squares.
"""

import functools

import numpy as np
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.case.estimator import Estimate
from tests.control.optimal import test_crossing_vehicles as crossing
from tests.oracles.held_period import over_period

PERIOD, HORIZON, MOVES, MOVE_WEIGHT = 0.02, 9, 4, 3e-7
SETTINGS = {"horizon": HORIZON, "moves": MOVES, "move_weight": MOVE_WEIGHT, "period": PERIOD}
STATES, SAMPLE = 8, 12


@functools.cache
def sampled(period):
    """A, B and known inputs over a period, counted from t = 0."""
    start = period * PERIOD
    A, B = over_period(crossing.plant, start, start + PERIOD)
    return A[:STATES, :STATES], B[:STATES], A[:STATES, STATES:]


def explicit_move(state, previous_state, previous_command):
    """First move of the minimum of the sum of w^2 at 1 m and of the weighted moves squared."""
    constants = crossing.START[STATES:]
    row = np.pad(crossing.SPAN.shapes(1.0), (0, STATES - crossing.MODES))
    A, B, E = sampled(SAMPLE - 1)
    unexplained = state - (A @ previous_state + B[:, 0] * previous_command + E @ constants)

    def residuals(moves):
        x, command, found = state, previous_command, []
        for i in range(HORIZON):
            A, B, E = sampled(SAMPLE + i)
            command = command + (moves[i] if i < MOVES else 0.0)
            x = A @ x + B[:, 0] * command + E @ constants + unexplained
            found.append(row @ x)
        return np.append(found, np.sqrt(MOVE_WEIGHT) * moves)

    free = residuals(np.zeros(MOVES))
    columns = np.array([residuals(unit) - free for unit in np.eye(MOVES)]).T
    return np.linalg.lstsq(columns, -free, rcond=None)[0][0]


def test_moves_foresee_the_vehicle_and_the_profile():
    law = jb.MPC(**SETTINGS, loads="known", prediction="time-varying", solver="unconstrained")
    plant = jb.state_space(crossing.beam_case(controller=law))
    design = law.design_state_law(plant, plant)
    draws = np.random.default_rng(4).normal(size=(2, STATES))
    scale = np.array([1e-2, 1e-3, 0.2, 0.1, 2e-3, 2e-3, 0.05, 0.05])
    state, previous = draws * scale
    estimate = Estimate(state[:4], vehicles=state[4:])
    measurement = Measurement(np.zeros(1), state[:4], np.array([0.7]))
    step = design.step(previous, estimate, measurement, np.asarray(SAMPLE * PERIOD))
    expected = 0.7 + explicit_move(state, previous, 0.7)
    assert_allclose(step.command, [expected], rtol=1e-7)


def test_foresight_of_the_vehicle_beats_that_of_its_weight():
    """On a rough surface the static load is a poor prediction of the contact force."""
    foresight = jb.MPC(**SETTINGS, loads="known", prediction="time-varying")
    force = jb.MovingForce(mass=0.4, speed=crossing.SPEED)
    design = jb.state_space(crossing.beam_case(force, profile=None))
    weight = jb.MPC(**SETTINGS, loads="known", prediction="time-varying", nominal_plant=design)
    peaks = [
        float(jb.simulate(crossing.beam_case(controller=law)).peak_deflection[0])
        for law in (foresight, weight)
    ]
    assert peaks[0] < 0.8 * peaks[1]
