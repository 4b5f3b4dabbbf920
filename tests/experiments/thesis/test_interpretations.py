"""Interpretations that explain printed numbers, against the equations of the thesis in scipy."""

import dataclasses

import numpy as np
from scipy.linalg import expm, solve_discrete_are

from experiments.thesis.cases import one_span
from experiments.thesis.chapter2 import frequencies, published, shaker
from experiments.thesis.chapter5 import published as published_regulators
from experiments.thesis.chapter5.regulator_limits import (
    COMMAND_WEIGHT,
    optimal_gain,
    with_active_shaker,
    with_other_shaker,
)
from experiments.thesis.chapter5.regulators import STATE_WEIGHTS
from jaxbeam import rigs

LENGTH, RIGIDITY, DENSITY, DAMPING = 0.6, 11.68, 0.535, 0.03
MODAL = DENSITY * LENGTH / 2  # kg, of the sine modes


def sines(modes):
    """Wave numbers and angular frequencies of the pinned beam."""
    waves = np.arange(1, modes + 1) * np.pi / LENGTH
    return waves, waves**2 * np.sqrt(RIGIDITY / DENSITY)


def test_critical_speed_of_the_denser_beam():
    heavier = 2800 * 0.06 * 3.3e-3
    speed = np.pi / LENGTH * np.sqrt(RIGIDITY / heavier)
    computed = LENGTH * frequencies._frequency_at_patch_density(one_span(rigs.load)) / np.pi
    np.testing.assert_allclose(computed, speed, rtol=1e-9)
    assert (
        abs(speed - published.CRITICAL_SPEEDS.numbers[0])
        < published.CRITICAL_SPEEDS.allowed_error[0]
    )


def mobility(s, mass):
    """Eqs (2.29) and (2.30) at the shaker, with a stationary mass at midspan."""
    waves, omega = sines(4)
    at_shaker, at_midspan = np.sin(0.5 * waves), np.sin(0.3 * waves)
    dynamic_stiffness = np.diag(MODAL * (s**2 + 2 * DAMPING * omega * s + omega**2))
    return (
        s
        * at_shaker
        @ np.linalg.solve(
            dynamic_stiffness + mass * s**2 * np.outer(at_midspan, at_midspan), at_shaker
        )
    )


def force_per_volt(frequency, in_impedance, in_transmission):
    """Eq. (2.34), with a stationary mass (kg) in eq. (2.26) and another in (2.33)."""
    s = 2j * np.pi * frequency
    shaker_mobility = s / (0.02 * s**2 + 0.55 * s + 9700)
    impedance_mobility, transmission_mobility = (
        mobility(s, in_impedance),
        mobility(s, in_transmission),
    )
    impedance = (
        0.82 + 5e-5 * s + 4.2**2 * impedance_mobility / (1 + impedance_mobility / shaker_mobility)
    )
    return 4.2 / impedance * shaker_mobility / (shaker_mobility + transmission_mobility)


def test_response_with_the_mass_in_the_impedance_only():
    beam = dataclasses.replace(rigs.load("A").beam, modes=4)
    found = shaker._mass_in_impedance_only(beam)
    every_97th = slice(None, None, 97)
    expected = [force_per_volt(f, 0.5, 0.0) for f in np.asarray(found.frequencies)[every_97th]]
    np.testing.assert_allclose(np.asarray(found.values)[every_97th, 3], expected, rtol=1e-8)
    both = shaker._response(beam, shaker.STATIONARY_MASS)
    expected = [force_per_volt(f, 0.5, 0.5) for f in np.asarray(both.frequencies)[every_97th]]
    np.testing.assert_allclose(np.asarray(both.values)[every_97th, 3], expected, rtol=1e-8)


def test_sampled_gain_of_the_other_shaker():
    """3.25 N/V and 1000 1/s: all seven numbers that are printed for 5 ms."""
    waves, omega = sines(3)
    at_shaker = np.sin(0.5 * waves)
    A, B = np.zeros((7, 7)), np.zeros((7, 1))
    A[:3, 3:6] = np.eye(3)
    A[3:6, :3] = -np.diag(omega**2) - 3500 / MODAL * np.outer(at_shaker, at_shaker)
    A[3:6, 3:6] = -np.diag(2 * DAMPING * omega) - 80 / MODAL * np.outer(at_shaker, at_shaker)
    A[3:6, 6], A[6, 6], B[6] = 3.25 * at_shaker / MODAL, -1000, 1000
    exponential = expm(5e-3 * np.vstack([np.hstack([A, B]), np.zeros((1, 8))]))
    A, B = exponential[:7, :7], exponential[:7, 7:]
    cost = solve_discrete_are(A, B, np.diag(STATE_WEIGHTS), [[COMMAND_WEIGHT]])
    expected = np.linalg.solve(COMMAND_WEIGHT + B.T @ cost @ B, B.T @ cost @ A)[0]
    computed = np.asarray(
        optimal_gain(with_other_shaker(with_active_shaker(rigs.load("A"))), 5e-3, STATE_WEIGHTS)[0]
    )[0]
    np.testing.assert_allclose(computed, expected, rtol=1e-6)
    printed = published_regulators.SAMPLED_GAIN
    assert np.all(np.abs(expected - printed.numbers) <= printed.allowed_error)
