"""Checks of control: sampled loops, gains of regulators and filters, and the least peak.

The event-by-event loop of `tests/oracles`, scipy's equations and Clarabel's linear program share no
code with jaxbeam.
"""

import dataclasses
from collections.abc import Iterator

import clarabel
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.signal
import scipy.sparse

import jaxbeam as jb
from experiments.validation.check import Check, max_entrywise_error, max_relative_error
from jaxbeam import rigs
from jaxbeam.analysis.bound.bound import Bound
from jaxbeam.analysis.bound.input_influence import input_influence
from jaxbeam.case.filters import filter_history, second_order_sections, steady_filter_state
from jaxbeam.estimation.observer import kalman_gain, sampled_kalman_gain
from tests import loop_as_oracle


def loops() -> Iterator[Check]:
    """Sampled closed loops, their gains and filters."""
    case = rigs.load("B")
    feedback = jb.Feedback(gains=[1e10], power=3, period=0.002, delay=0.001)
    case = dataclasses.replace(case, controller=feedback)
    case = jb.replace(case, {"loads.0.speed": 1.5, "run.duration": 0.5})
    times = np.linspace(0, 0.5, 126)[:-1] + 1e-4  # between the sampling instants
    deflection = jb.simulate(case, jnp.asarray(times)).deflection
    yield Check(
        "cubic feedback, sampled, delayed, saturated: deflection",
        "event by event with scipy DOP853",
        max_relative_error(deflection, loop_as_oracle.expected(case, times).deflection),
        1e-5,
    )
    plant = jb.state_space(dataclasses.replace(case, controller=None))
    A, B = np.asarray(plant.unloaded.A), np.asarray(plant.unloaded.B)
    Q, R = np.diag([1e6] * 3 + [1.0] * 3), np.array([[1e-4]])
    P = scipy.linalg.solve_continuous_are(A, B, Q, R)
    gain = jb.LQR(state_weight=np.diag(Q), command_weight=np.diag(R)).time_invariant_gain(plant)
    yield Check(
        "gain of the regulator",
        "scipy, algebraic Riccati equation",
        max_relative_error(gain, np.linalg.solve(R, B.T @ P)),
        1e-6,
    )
    noise, C = np.diag([0.0] * 3 + [0.01, 0.02, 0.03]), np.eye(1, 6) * 1e3
    P = scipy.linalg.solve_continuous_are(A.T, C.T, noise, R)
    filter_gain = kalman_gain(*map(jnp.asarray, (A, C, noise, R)))[0]
    yield Check(
        "gain of the Kalman filter",
        "scipy, algebraic Riccati equation",
        max_relative_error(filter_gain, P @ C.T / R),
        1e-6,
    )
    sampled_A = scipy.signal.cont2discrete((A, B, C, np.zeros((1, 1))), 0.002)[0]
    yield Check(
        "plant sampled at 500 Hz",
        "scipy cont2discrete",
        max_relative_error(plant.unloaded.discretize(0.002).A, sampled_A),
        1e-9,
    )
    P = scipy.linalg.solve_discrete_are(sampled_A.T, C.T, noise, R)
    filter_gain = sampled_kalman_gain(*map(jnp.asarray, (sampled_A, C, noise, R)))[0]
    yield Check(
        "gain of the sampled Kalman filter",
        "scipy, discrete Riccati equation",
        max_relative_error(filter_gain, P @ C.T / (C @ P @ C.T + R)),
        1e-6,
    )
    signal = np.random.default_rng(7).normal(size=(2000, 1)).cumsum(axis=0)
    sections = second_order_sections(jb.Filter(40.0, 5), 1e-3)
    start = steady_filter_state(sections, np.zeros(1))
    butter = scipy.signal.butter(5, 40.0, fs=1000.0, output="sos")
    yield Check(
        "Butterworth filter of order 5, output",
        "scipy butter and sosfilt",
        max_relative_error(
            filter_history(sections, start, jnp.asarray(signal)),
            scipy.signal.sosfilt(butter, signal, axis=0),
        ),
        1e-9,
    )


def bounds() -> Iterator[Check]:
    """The least achievable peak."""
    case = jb.replace(rigs.load("B"), {"loads.0.speed": 1.0, "run.duration": 0.8})
    best = jb.bound(case)
    yield Check(
        "least peak of rig B",
        "the whole linear program, by Clarabel",
        max_entrywise_error(best.peak, least_peak_by_clarabel(case, best)),
        1e-6,
    )
    record = jb.simulate(dataclasses.replace(case, controller=best.controller()))
    yield Check(
        "least peak of rig B",
        "a run with the optimal commands",
        max_entrywise_error(np.max(np.abs(record.deflection)), best.peak),
        1e-4,
    )


def least_peak_by_clarabel(case: jb.Case, best: Bound) -> float:
    """The least peak (m): minimise p subject to |w(t)| <= p at all times, and command limits."""
    influence = input_influence(case, best.positions, best.period, best.spacing)
    row = influence.deflection_rows[0]
    uncontrolled = influence.unforced @ row
    response = np.einsum("m,tmk->tk", row, influence.response[..., 0])
    count, scale = response.shape[1], 1e3  # scale: deflections in mm
    ones = np.ones((uncontrolled.size, 1))
    peaks = np.block([[scale * response, -ones], [-scale * response, -ones]])
    zeros = np.zeros((count, 1))
    box = np.block([[np.eye(count), zeros], [-np.eye(count), zeros]])
    low, high = map(float, case.actuators[0].limits)
    limits = np.full(count, high), np.full(count, -low)
    right = np.concatenate([-scale * uncontrolled, scale * uncontrolled, *limits])
    options = clarabel.DefaultSettings()
    options.verbose = False
    solver = clarabel.DefaultSolver(
        scipy.sparse.csc_matrix((count + 1, count + 1)),
        np.append(np.zeros(count), 1.0),
        scipy.sparse.csc_matrix(np.concatenate([peaks, box])),
        right,
        [clarabel.NonnegativeConeT(right.size)],
        options,
    )
    return solver.solve().x[-1] / scale
