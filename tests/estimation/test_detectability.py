"""Kalman filter of a damped mode that no sensor observes, against scipy."""

import numpy as np
import pytest
import scipy.linalg
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.validation import check_case
from jaxbeam.estimation.kalman import Kalman
from jaxbeam.estimation.observability import DetectabilityWarning
from jaxbeam.estimation.sampled_plant import sample_timing

PERIOD, FORCE, NOISE, SPAN, MODES = 2e-3, 0.05, 1e-6, 0.6, 4


def two_spans(damping=0.03) -> jb.Case:
    """Two equal spans, a sensor in the middle of one: a node of each span's second mode."""
    return jb.Case(
        jb.Beam(2 * SPAN, 11.68, 0.535, damping, modes=MODES),
        supports=[jb.Support(SPAN)],
        actuators=[jb.PointForce(0.2)],
        sensors=[jb.Sensor(SPAN / 2)],
        controller=jb.StateFeedback(
            np.zeros((1, 2 * MODES)), period=PERIOD, estimator=Kalman(FORCE, NOISE)
        ),
    )


def test_a_mode_that_decays_by_itself_may_be_unseen():
    case, second = two_spans(), np.pi / 2 * (2 / SPAN) ** 2 * np.sqrt(11.68 / 0.535)
    with pytest.warns(
        DetectabilityWarning, match=f"no sensor observes the mode at {second:.4g} Hz"
    ):
        check_case(case)
    plant = jb.state_space(case)
    filter = case.controller.estimator.sampled_filter(plant, sample_timing(case.controller))
    system = plant.unloaded
    A, C = np.asarray(system.A), np.asarray(system.C)
    white = np.diag([0.0] * MODES + [FORCE] * MODES)
    block = scipy.linalg.expm(PERIOD * np.block([[-A, white], [np.zeros_like(A), A.T]]))
    transition = block[2 * MODES :, 2 * MODES :].T
    covariance = transition @ block[: 2 * MODES, 2 * MODES :]
    P = scipy.linalg.solve_discrete_are(transition.T, C.T, covariance, NOISE**2 * np.eye(1))
    expected = P @ C.T / (C @ P @ C.T + NOISE**2)
    found = np.asarray(filter.gain)[: 2 * MODES]
    assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    frequencies = np.sqrt(-np.diag(A[MODES:, :MODES])) / (2 * np.pi)
    unseen = int(np.argmin(np.abs(frequencies - second)))
    assert_allclose(found[[unseen, unseen + MODES]], 0.0, atol=1e-8 * np.abs(expected).max())


def test_an_undamped_one_is_refused():
    with pytest.raises(ValueError, match="observe every mode without damping: none of 1 observes"):
        check_case(two_spans(0.0))
