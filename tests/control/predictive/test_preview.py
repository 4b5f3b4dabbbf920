"""Maps of a plant over periods against scipy's integration of its equations."""

import equinox as eqx
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.control.predictive.prediction import preview
from tests.control.optimal import test_crossing_vehicles as crossing
from tests.control.predictive import test_mpc_exact as exact
from tests.loop_as_oracle import span_of
from tests.oracles.held_period import over_period

PERIOD, DELAY, FIRST, COUNT = exact.PERIOD, 0.0037, 0, 3


def found_plants(case, period, delay, first, traced):
    def plants(plant):
        return preview(plant, np.asarray(period), delay).sampled_plants(
            np.asarray(first * period), 0, COUNT
        )

    return (eqx.filter_jit(plants) if traced else plants)(jb.state_space(case))


@pytest.mark.parametrize(("speed", "traced"), [(1.0, False), (10.0, False), (10.0, True)])
def test_a_mass_that_enters_within_a_period_and_a_delayed_command(speed, traced):
    case = exact.beam_case(speed=speed)
    span = span_of(case)
    events = exact.ENTRY, exact.ENTRY + span.length / speed
    found = found_plants(case, PERIOD, np.asarray(DELAY), FIRST, traced)

    def matrices_at(t):
        return exact.matrices(span, t, exact.MASS, speed)

    for i in range(COUNT):
        start = (FIRST + i) * PERIOD
        begin, end = start + DELAY, start + PERIOD
        A_before, B_before = over_period(matrices_at, start, begin, events)
        A_after, B_after = over_period(matrices_at, begin, end, events)
        B_before = A_after @ B_before
        weight = (B_before + B_after)[:, 2]
        expected = np.hstack([A_after @ A_before, B_before[:, :2]])
        assert_allclose(found.A[i, :4], expected, atol=1e-8 * np.abs(expected).max())
        assert_allclose(found.A[i, 4:], 0.0)
        expected = np.vstack([B_after[:, :2], np.eye(2)])
        assert_allclose(found.B[i], expected, atol=1e-8 * np.abs(B_after).max())
        assert_allclose(found.E[i, :4, 0], weight, atol=1e-8 * np.abs(weight).max())


@pytest.mark.parametrize("traced", [False, True])
def test_a_vehicle_on_a_rough_surface(traced):
    period, first = 0.02, 11
    found = found_plants(crossing.beam_case(), period, None, first, traced)
    for i in range(COUNT):
        start = (first + i) * period
        A, B = over_period(crossing.plant, start, start + period)
        scale = np.abs(A[:8]).max(axis=0)
        assert_allclose(found.A[i] / scale[:8], A[:8, :8] / scale[:8], atol=1e-8)
        assert_allclose(found.B[i], B[:8], atol=1e-8 * np.abs(B).max())
        assert_allclose(found.E[i] / scale[8:], A[:8, 8:] / scale[8:], atol=1e-8)
