"""Numbers of the thesis's chapters: the shaker of rig A, the sine basis, gains over the mass.

Interpretations that explain printed numbers, against the equations of the thesis in scipy.
"""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import eigh, expm, solve_discrete_are

import jaxbeam as jb
from experiments.thesis.cases import critical_speed, one_span, with_duration
from experiments.thesis.chapter2 import frequencies, published, shaker
from experiments.thesis.chapter2.frequencies import sine_basis_modes
from experiments.thesis.chapter2.shaker import OF_MASS, identified_beam
from experiments.thesis.chapter5 import (
    observer,
    published as published_regulators,
    regulator_limits,
    regulators,
)
from experiments.thesis.chapter5.fed_back_states import (
    BUT_FOR_THE_END,
    COMBINATIONS,
    FED_BACK,
    FRACTIONS,
    claims,
    identical_gains,
)
from experiments.thesis.chapter5.regulator_limits import (
    COMMAND_WEIGHT,
    optimal_gain,
    with_active_shaker,
    with_other_shaker,
)
from experiments.thesis.chapter5.regulators import STATE_WEIGHTS
from experiments.thesis.chapter6.gain_scheduling import (
    BestGain,
    best_gains,
    equivalent_gains,
    scheduled_controller,
)
from experiments.thesis.verdicts import LITERAL, STATEMENT, assign_verdicts
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Case, replace
from jaxbeam.case.library import rigs
from jaxbeam.case.validation import check_case
from jaxbeam.model.modes import modes
from tests.control.test_feedback import beam_case, gains_at, law
from tests.loop_as_oracle import expected


@pytest.fixture(scope="module")
def printed():
    return dataclasses.replace(rigs.load("A").beam, modes=4)


@pytest.fixture(scope="module")
def fitted(printed):
    return identified_beam(printed)


def test_one_figure_predicts_the_other(fitted):
    """The numbers with a mass, which were held out, within a unit of their last digits."""
    printed_numbers = np.concatenate([one.numbers for one in OF_MASS])
    units = np.concatenate([one.allowed_error for one in OF_MASS])
    assert_allclose(units, [1.0, 1.0, 0.1])
    assert np.all(np.abs(fitted.predicted - printed_numbers) <= units)


def test_the_fitted_beam_gives_all_ten_numbers_by_equations_in_scipy(fitted, monkeypatch):
    """Within a unit of their last digits, from eqs (2.26) to (2.34) written out."""
    rigidity, mass = fitted.values
    for name, value in (
        ("RIGIDITY", rigidity),
        ("DENSITY", mass),
        ("MODAL", mass * LENGTH / 2),
    ):
        monkeypatch.setitem(globals(), name, value)

    def size(frequency, on_beam=0.0):
        return abs(force_per_volt(frequency, on_beam, 0.0))

    assert_allclose(size(1.0), 2.5, atol=0.1)
    for drop in (21.0, 84.0, 189.0, 340.0):
        _is_extreme_near(drop, size, -1.0)
    assert_allclose(_is_extreme_near(27.0, size, 1.0), 10.0, atol=1.0)
    with_mass = functools.partial(size, on_beam=0.5)
    _is_extreme_near(13.0, with_mass, -1.0)
    assert_allclose(_is_extreme_near(27.0, with_mass, 1.0), 32.5, atol=0.1)


def _is_extreme_near(frequency: float, size, sign: float) -> float:
    """Value of the extreme that is within 1 Hz of a frequency."""
    values = sign * np.array([size(f) for f in frequency + np.linspace(-1.0, 1.0, 401)])
    best = int(np.argmax(values))
    assert 0 < best < 400
    return sign * values[best]


def test_intervals_shrink_with_the_second_figure(printed, fitted):
    jointly = identified_beam(printed, jointly=True)
    assert np.all(np.diag(jointly.covariance) < np.diag(fitted.covariance))
    off = np.abs(jointly.values - fitted.values)
    assert np.all(off < 2 * np.sqrt(np.diag(fitted.covariance)))
    assert_allclose(jointly.predicted[2], 32.5, atol=0.1)


# Table 2.2 of the thesis (section 2.1.1), frequencies in Hz of eight modes of two spans of 0.6 m.
ANALYTICAL = [20.387, 31.849, 81.550, 103.212, 183.488, 215.343, 326.2, 368.249]
APPROXIMATE = [20.387, 31.951, 81.550, 104.304, 183.487, 220.577, 326.198, 100660]
# Twenty sine modes, computed for this project by an independent implementation.
TWENTY = [20.387, 31.856, 81.550, 103.281, 183.487, 215.648, 326.198, 369.143]


def two_spans(count: int) -> Case:
    """The beam of Table 2.2, whose numbers belong to 11.68 N m^2 and 0.535 kg/m."""
    return Case(Beam(1.2, 11.68, 0.535, modes=count), supports=[Support(0.6)])


def test_approximate_frequencies_of_table_2_2_to_all_printed_digits():
    found = sine_basis_modes(two_spans(8)).frequencies
    assert_allclose(found[:7], APPROXIMATE[:7], rtol=0, atol=5.1e-4)
    assert_allclose(found[7], APPROXIMATE[7], rtol=0, atol=5)  # five digits: spurious


def test_analytical_frequencies_of_table_2_2_are_the_exact_ones():
    found = modes(two_spans(8)).frequencies
    # 11.68 and 0.535 are rounded, which changes frequencies by 0.002 Hz.
    assert_allclose(found, ANALYTICAL, rtol=0, atol=2.1e-3)


def test_twenty_sines_are_more_accurate():
    found = sine_basis_modes(two_spans(20)).frequencies
    assert_allclose(found[:8], TWENTY, rtol=0, atol=5.1e-4)
    exact = modes(two_spans(8)).frequencies
    assert np.all(found[:8] > exact * (1 - 1e-12))  # upper bounds, by Rayleigh and Ritz


def test_modes_are_those_of_the_matrix_of_sines():
    """Elastic and rotational springs, against the matrix written out by hand."""
    supports = [Support(0.4, 2e3, rotational_stiffness=3.0), Support(0.9, 5e4)]
    case = Case(Beam(1.2, 11.68, 0.535, modes=6), supports=supports)
    wave = np.pi * np.arange(1, 7) / 1.2
    size = np.sqrt(2 / (0.535 * 1.2))
    matrix = np.diag(11.68 / 0.535 * wave**4)
    for x, k, turn in ((0.4, 2e3, 3.0), (0.9, 5e4, 0.0)):
        shape, slope = size * np.sin(wave * x), size * wave * np.cos(wave * x)
        matrix += k * np.outer(shape, shape) + turn * np.outer(slope, slope)
    values, mix = eigh(matrix)
    found = sine_basis_modes(case)
    assert_allclose(found.stiffness, values, rtol=1e-11)
    x = np.linspace(0.0, 1.2, 50)
    expected = size * np.sin(np.outer(x, wave)) @ mix
    expected *= np.sign(expected[1])
    assert_allclose(found.shapes(x), expected, rtol=0, atol=1e-11 * np.abs(expected).max())


def test_frequencies_are_differentiable():
    case = Case(Beam(1.2, 11.68, 0.535, modes=5), supports=[Support(0.5, 2e3)])

    def frequencies(k):
        return sine_basis_modes(replace(case, {"supports.0.stiffness": k})).frequencies

    difference = (frequencies(2001.0) - frequencies(1999.0)) / 2
    assert_allclose(jax.jacfwd(frequencies)(2000.0), difference, rtol=1e-6, atol=1e-12)


def test_printed_gains_follow_from_statics():
    """Fig. 6.7: 2 V/mm up to 0.345 kg, 3 up to 0.45, then 3.6, in place of 2 V/mm^3.

    The static deflection of a pinned beam is g L^3 / (48 E I) per kilogram; w = 1 mm, where k w = 2
    w^3 at k = 2, and w = 1.2247 mm at k = 3 give the masses, with the lift of a patch at midspan.
    """
    case = jb.replace(beam_case(), {"actuators.0.correction": 0.502})
    deflection_per_mass = 9.81 * 0.6**3 / (48 * 13.211)
    # A moment between 0.2575 m and its mirror image: w(L/2) is the integral of x M / (E I) from
    # the support to the middle.
    lift = 200.0 * 0.502 * 8.292e-4 * (0.3**2 - 0.2575**2) / 2 / 13.211
    masses = [(w + lift * 2e9 * w**3) / deflection_per_mass for w in (1e-3, np.sqrt(1.5) * 1e-3)]
    assert_allclose(masses, [0.344, 0.4486], atol=1e-3)
    assert_allclose(equivalent_gains(case, masses, 2e9), [[2000.0, 3000.0]], rtol=1e-6)
    assert_allclose(equivalent_gains(case, [0.509], 2e9), [[3596.0]], rtol=2e-3)


@pytest.fixture(scope="module")
def loop():
    return beam_case(jb.Feedback([1000.0], period=0.01))


def test_best_gain_has_the_lowest_peak_by_the_oracle(loop):
    """The peak at the samples, by scipy, is higher with a seventh less gain and with more."""
    light, heavy = best_gains(loop, [0.05, 0.2], 1e5)
    times = np.asarray(jb.simulate(loop).times)

    def peak(gain, mass):
        changed = jb.replace(loop, {"loads.0.mass": mass, "controller.gains.0": gain})
        return np.max(np.abs(expected(changed, times).deflection))

    for found in (light, heavy):
        lowest = peak(found.gain, found.mass)
        assert_allclose(found.peak, lowest, rtol=0.02)  # between samples it is a little higher
        assert found.peak < 0.95 * found.uncontrolled
        for other in (0.85, 1.18):
            assert peak(other * found.gain, found.mass) > lowest
    made = scheduled_controller(loop, [light, heavy])
    assert_allclose(gains_at(made, loop, 0.05), [light.gain], rtol=1e-12)
    check_case(dataclasses.replace(loop, controller=made))


def test_other_controllers_are_refused():
    with pytest.raises(ValueError, match="kind 'feedback' with one power"):
        best_gains(beam_case(law()), [0.2], 1.0)
    with pytest.raises(ValueError, match="only 0 sensors for 1 actuators"):
        equivalent_gains(dataclasses.replace(beam_case(), sensors=()), [0.2], 1.0)
    with pytest.raises(ValueError, match="masses must increase"):
        scheduled_controller(
            beam_case(law()), [BestGain(mass, 1.0, 1.0, 1.0) for mass in (0.2, 0.1)]
        )


# Statements on the states fed back, and on both gains of chapter 3, from given peaks and gains.


def ratios(varying, invariant):
    """Peaks in percent by combination: those given, 90 for the others."""
    return {
        LITERAL: {
            "time-varying": np.array([varying.get(name, 90.0) for name in COMBINATIONS]),
            "time-invariant": np.array([invariant.get(name, 90.0) for name in COMBINATIONS]),
        }
    }


def test_statements_hold_or_not():
    as_printed = ratios({"q1 q2": 84.0, "q1 q2 q1'": 83.0, "q1": 85.0}, {"all": 101.0})
    assert claims(as_printed).values(frozenset()).tolist() == [1.0, 1.0, 1.0]
    assert assign_verdicts([claims(as_printed)])[0].verdicts == [STATEMENT] * 3
    opposite = ratios({"q1 q2": 86.0, "q1 q2 q1'": 87.0, "q1": 85.0}, {"all": 99.0})
    assert claims(opposite).values(frozenset()).tolist() == [0.0, 0.0, 0.0]
    diverging = claims(ratios({}, {"all": np.nan})).values(frozenset())
    assert diverging.tolist() == [0.0, 0.0, 1.0]


def test_difference_of_gains_in_percent_of_the_largest():
    finite = np.outer(np.ones(FRACTIONS.size), np.arange(1.0, FED_BACK.size + 1))
    step = finite.copy()
    step[100, 1] += 0.01  # half a percent of the gain of the second state
    step[-1, 0] = 0.0  # at the end of the crossing
    found = identical_gains({"finite-time": finite, "step-by-step": step, "constant": 2 * finite})
    np.testing.assert_allclose(found.values(frozenset()), 100.0)
    np.testing.assert_allclose(found.values(frozenset({BUT_FOR_THE_END})), 0.5)
    np.testing.assert_allclose(found.null.values, 100.0)


# The sampled regulator with an observer in its loop, against the product's gains and runs.

LOAD = {"loads.0.mass": observer.MASS, "loads.0.speed": observer.SPEED}
RIG = jb.replace(with_other_shaker(with_active_shaker(rigs.load("A"))), LOAD)
PERIOD = 5e-3


@pytest.fixture(scope="module")
def runs():
    """A run without control and one under the observed regulator."""
    gains = observer.design(RIG, PERIOD, STATE_WEIGHTS, COMMAND_WEIGHT)
    return [observer.simulate_observed(RIG, PERIOD, each, after_exit=0.1) for each in (None, gains)]


def test_gain_is_that_of_the_sampled_regulator():
    gains = observer.design(RIG, PERIOD, STATE_WEIGHTS, COMMAND_WEIGHT)
    expected = np.asarray(optimal_gain(RIG, PERIOD, STATE_WEIGHTS)[0])[0]
    np.testing.assert_allclose(gains.regulator, expected, rtol=1e-5)


def test_beam_without_control_is_that_of_the_integrator(runs):
    record = jb.simulate(with_duration(RIG, 1.3, 200.0))
    free = runs[0].deflection
    expected = np.asarray(record.deflection)
    peak = np.abs(expected).max()
    np.testing.assert_allclose(free, expected[: len(free)], atol=5e-3 * peak)


def test_at_5_ms_the_regulator_worsens_the_deflection_though_the_observer_is_right(runs):
    """As the thesis finds: not the observer is to blame, but the sampled gain (Figs 5.6, 5.7)."""
    uncontrolled, controlled = runs
    peaks = [np.abs(one.deflection[:, observer.SENSOR]).max() for one in runs]
    assert peaks[1] > 1.1 * peaks[0]
    off = np.abs(controlled.states[:, 0] - controlled.estimates[:, 0]).max()
    assert off < 0.05 * np.abs(controlled.states[:, 0]).max()
    assert not np.any(uncontrolled.estimates) and not np.any(uncontrolled.commands)


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
