"""Interpretations that explain printed numbers, against the equations of the thesis in scipy."""

import dataclasses

import numpy as np
from scipy.linalg import expm, solve_discrete_are

import jaxbeam as jb
from experiments.thesis.cases import critical_speed, one_span
from experiments.thesis.chapter2 import frequencies, published, shaker
from experiments.thesis.chapter5 import (
    published as published_regulators,
    regulator_limits,
    regulators,
)
from experiments.thesis.chapter5.regulator_limits import (
    COMMAND_WEIGHT,
    optimal_gain,
    with_active_shaker,
    with_other_shaker,
)
from experiments.thesis.chapter5.regulators import STATE_WEIGHTS
from jaxbeam import rigs
from jaxbeam.analysis.stability import frozen_poles

LENGTH, RIGIDITY, DENSITY, DAMPING = 0.6, 11.68, 0.535, 0.03
MODAL = DENSITY * LENGTH / 2  # kg, of the sine modes


def sines(modes):
    """Wave numbers and angular frequencies of the pinned beam."""
    waves = np.arange(1, modes + 1) * np.pi / LENGTH
    return waves, waves**2 * np.sqrt(RIGIDITY / DENSITY)


def test_critical_speed_of_the_denser_beam():
    heavier = 2800 * 0.06 * 3.3e-3
    speed = np.pi / LENGTH * np.sqrt(RIGIDITY / heavier)
    case = one_span(rigs.load)
    beam = shaker.beams_of_rig_a(case.beam)[shaker.DENSER]
    computed = critical_speed(dataclasses.replace(case, beam=beam))
    np.testing.assert_allclose(computed, speed, rtol=1e-9)
    assert np.all(published.CRITICAL_SPEED.agrees([speed]))


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


def matrices_with_shaker(rigidity, density, stiffness, damping, force, bandwidth):
    """System matrices of the beam with a shaker at 0.5 m, three sine modes, eq. (2.36)."""
    waves = np.arange(1, 4) * np.pi / LENGTH
    omega, modal = waves**2 * np.sqrt(rigidity / density), density * LENGTH / 2
    at_shaker = np.sin(0.5 * waves)
    A, B = np.zeros((7, 7)), np.zeros((7, 1))
    A[:3, 3:6] = np.eye(3)
    A[3:6, :3] = -np.diag(omega**2) - stiffness / modal * np.outer(at_shaker, at_shaker)
    A[3:6, 3:6] = -np.diag(2 * DAMPING * omega)
    A[3:6, 3:6] -= damping / modal * np.outer(at_shaker, at_shaker)
    A[3:6, 6], A[6, 6], B[6] = force * at_shaker / modal, -bandwidth, bandwidth
    return A, B


def test_sampled_gain_of_the_other_shaker():
    """4.6 N/V over root two and 1000 1/s: all seven numbers for 5 ms to the last digit."""
    height, width = 3.3e-3, 0.06
    A, B = matrices_with_shaker(
        65e9 * width * height**3 / 12, 2700 * width * height, 3500, 80, 4.6 / np.sqrt(2), 1000
    )
    exponential = expm(5e-3 * np.vstack([np.hstack([A, B]), np.zeros((1, 8))]))
    A, B = exponential[:7, :7], exponential[:7, 7:]
    cost = solve_discrete_are(A, B, np.diag(STATE_WEIGHTS), [[COMMAND_WEIGHT]])
    expected = np.linalg.solve(COMMAND_WEIGHT + B.T @ cost @ B, B.T @ cost @ A)[0]
    computed = np.asarray(
        optimal_gain(with_other_shaker(with_active_shaker(rigs.load("A"))), 5e-3, STATE_WEIGHTS)[0]
    )[0]
    np.testing.assert_allclose(computed, expected, rtol=1e-6)
    assert np.all(published_regulators.SAMPLED_GAIN.agrees(expected))


def test_printed_frequencies_with_the_shaker_are_the_damped_ones():
    """24, 72 and 159 Hz: a dashpot lowers frequencies, by more than the spring raises them."""
    A, _ = matrices_with_shaker(RIGIDITY, DENSITY, 3500, 80, 0, 1000)
    poles = np.linalg.eigvals(A)
    expected = np.sort(poles.imag[poles.imag > 0]) / (2 * np.pi)
    computed = frequencies.damped_frequencies(rigs.load("A"), 3500, 80)
    np.testing.assert_allclose(computed, expected, rtol=1e-9)
    assert np.all(published.SHAKER_MODES.agrees(expected))


def test_frozen_poles_by_gains_of_the_table():
    """A - B K at each position, against the poles of the linearised loop."""
    name = regulators.WEAK_SHAKER
    rig = regulators.interpreted_rigs(rigs.load("A"))[name]
    loops = regulators.time_varying_loops(rig, regulators.INTERPRETATIONS[name])
    case = jb.replace(loops.partial_feedback, {"loads.0.speed": 2.0, "loads.0.mass": 0.509})
    times = np.linspace(0.0, 0.3, regulator_limits.LOAD_POSITIONS)[1:-1]
    expected = frozen_poles(case, times).largest_real_part.max()
    np.testing.assert_allclose(regulator_limits.largest_real_part(case), expected, rtol=1e-9)
