"""Least integral of the squared deflection against scipy, runs, and other laws."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear

import jaxbeam as jb
from jaxbeam.analysis.bound.bound import input_influence
from jaxbeam.analysis.bound.least_integral import least_integral

LIMITS, PERIOD = [-1.0, 1.5], 0.015


def beam_case(controller=None, limits=LIMITS) -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.PointForce(0.2, limits=limits), jb.PointForce(0.4, limits=limits)],
        sensors=[jb.Sensor(0.25), jb.Sensor(0.4)],
        loads=[jb.MovingForce(mass=0.4, speed=2.5)],
        controller=controller,
        run=jb.Run(0.3, 1000.0),
    )


@pytest.fixture(scope="module")
def least():
    return least_integral(beam_case(), weights=[1.0, 3.0], period=PERIOD)


def problem(case):
    """Matrix and right side of the least squares, rows weighted by the trapezoidal rule."""
    influence = input_influence(case, np.array([0.25, 0.4]), PERIOD, 1e-3)
    weight = np.convolve(np.diff(influence.times), [0.5, 0.5])
    rows, right = [], []
    for row, share in zip(influence.deflection_rows, [1.0, 3.0], strict=True):
        scale = np.sqrt(share * weight)
        response = np.tensordot(influence.response, row, axes=(1, 0)).reshape(scale.size, -1)
        rows.append(scale[:, None] * response)
        right.append(-scale * (influence.unforced @ row))
    return np.concatenate(rows), np.concatenate(right)


def test_against_scipy(least):
    matrix, right = problem(beam_case())
    low, high = (np.full(matrix.shape[1], limit) for limit in LIMITS)
    scale = 1 / np.linalg.norm(matrix, axis=0).max()
    solved = lsq_linear(
        matrix * scale, right, (low / scale, high / scale), method="bvls", tol=1e-14
    )
    expected = np.sum((matrix @ (solved.x * scale) - right) ** 2)
    assert_allclose(least.uncontrolled, right @ right, rtol=1e-12)
    assert_allclose(least.integral, expected, rtol=1e-7)
    assert least.proven <= expected * (1 + 1e-12)
    assert_allclose(least.proven, expected, rtol=1e-5)


def test_commands_are_at_the_limits():
    """Bang-bang, as the thesis says of this criterion, where limits are tight, but for the end."""
    least = least_integral(beam_case(limits=[-0.3, 0.3]), period=PERIOD)
    crossing = least.commands[: int(0.6 / 2.5 / PERIOD)]
    assert np.abs(least.commands).max() <= 0.3
    assert np.mean(np.abs(crossing) > 0.3 * (1 - 1e-6)) > 0.85
    assert 0.5 < least.share_at_limits < 1.0
    assert 0.1 < least.reduction < 0.6


def test_a_run_has_the_integral_and_no_law_less(least):
    """Feedback, and the commands of the least peak, are above it."""
    found = jb.simulate(beam_case(least.controller()))
    assert_allclose(least.of_record(found), least.integral, rtol=1e-5)
    feedback = jb.Feedback([200.0, 200.0], period=PERIOD)
    for law in (feedback, jb.bound(beam_case(), period=PERIOD).controller()):
        assert least.proven < least.of_record(jb.simulate(beam_case(law))) < least.uncontrolled


def test_limits_of_rates():
    """Commands keep them, and a linear program of scipy proves that none are better."""
    patch = {"correction": 0.3, "amplifier_gain": 200.0, "limits": [-2.5, 7.5]}
    free, limited = (
        dataclasses.replace(beam_case(), actuators=(jb.Patch(0.25, 0.35, 8.3e-4, **patch, **rate),))
        for rate in ({}, {"rate_limit": 60.0})
    )
    fast, slow = (least_integral(case, period=PERIOD) for case in (free, limited))
    assert np.abs(np.diff(slow.commands, axis=0, prepend=0.0)).max() <= 60.0 * PERIOD * (1 + 1e-12)
    assert 1.02 * fast.integral < slow.proven <= slow.integral
    assert slow.integral - slow.proven < 1e-6 * slow.uncontrolled


def test_errors():
    unlimited = dataclasses.replace(beam_case(), actuators=(jb.PointForce(0.2),))
    with pytest.raises(ValueError, match=r"^actuators.0.limits must be given"):
        least_integral(unlimited)
    with pytest.raises(ValueError, match="weights must list 2 numbers"):
        least_integral(beam_case(), weights=[1.0])
