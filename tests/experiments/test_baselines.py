"""The other solvers of the speed benchmark: agreement with each other and with oracles."""

import time

import jax
import numpy as np
import pytest

from experiments.benchmarks import cases
from experiments.benchmarks.common import Timing, time_call
from experiments.benchmarks.rivals import baselines, numba_peaks
from experiments.benchmarks.rivals.baselines import (
    PinnedBeam,
    crossing_rate,
    diffrax_peaks,
    free_times,
    hermite_peaks,
    reference_peaks,
    scipy_peaks,
    scipy_time,
)
from tests.oracles import modal_equations
from tests.oracles.closed_loop import Actuator, Clock, Sensor, respond
from tests.oracles.crossing import Load
from tests.oracles.modal_equations import Span
from tests.oracles.two_spans import TwoSpans

MASSES = np.array([0.1, 0.55, 1.0])
# The heavier masses peak after the exit at 5.3 and 10 m/s, all others while they cross.
SPEEDS = np.array([0.8, 2.2, 5.3, 10.0])


@pytest.fixture(scope="module")
def reference():
    return reference_peaks(PinnedBeam(3), MASSES, SPEEDS)


def test_scipy_agrees_to_one_in_a_million(reference):
    np.testing.assert_allclose(scipy_peaks(PinnedBeam(3), MASSES, SPEEDS), reference, rtol=1e-6)


@pytest.mark.parametrize("shared_steps", [False, True])
def test_diffrax_agrees_to_one_in_a_million(reference, shared_steps):
    peaks = diffrax_peaks(PinnedBeam(3), MASSES, SPEEDS, shared_steps=shared_steps)
    np.testing.assert_allclose(peaks, reference, rtol=1e-6)


def test_reference_agrees_with_the_coupled_equations_sampled_finely():
    """The full mass matrix, and no closed form after the exit."""
    beam, times = PinnedBeam(3), np.linspace(0.0, 0.6, 20_001)
    span = Span(beam.length, beam.flexural_rigidity, beam.mass_per_length, 3, beam.damping_ratio)
    run = modal_equations.respond(span, [Load(0.7, 6.0)], beam.sensors, times)
    rates = run.modal_rate @ span.shapes(np.array(beam.sensors)).T
    expected = reference_peaks(beam, [0.7], [6.0])[0, 0]
    peaks = hermite_peaks(np.diff(times), run.deflection, rates)
    np.testing.assert_allclose(peaks, expected, rtol=1e-7)


def test_cubic_peaks_are_exact_for_a_cubic_and_need_no_sample_at_the_peak():
    times = np.array([0.0, 0.7, 1.1])
    value = 2 * times**3 - 3 * times**2 + 0.9 * times - 0.5
    rate = 6 * times**2 - 6 * times + 0.9
    dip = (1 + np.sqrt(0.4)) / 2
    lowest = 2 * dip**3 - 3 * dip**2 + 0.9 * dip - 0.5
    peak = hermite_peaks(np.diff(times), value, rate)
    np.testing.assert_allclose(peak, abs(lowest), rtol=1e-14)


def test_free_times_cover_the_duration_and_thin_out_as_high_modes_decay():
    times = free_times(PinnedBeam(12))
    assert times[0] == 0.0 and times[-1] == 0.5
    assert np.all(np.diff(times) > 0)
    assert times[-2] - times[-3] > 5 * times[1]


def test_time_call_keeps_compiling_apart():
    timing = time_call(jax.jit(lambda x: x @ x), np.eye(50))
    assert 0 < timing.run < timing.compile
    assert np.isnan(timing.ratio)


def test_ratio_to_a_reference_does_not_depend_on_the_speed_of_the_machine(monkeypatch):
    """A machine that becomes slower with every call."""
    now, slowness = [0.0], [1.0]

    def work(seconds):
        now[0] += seconds * slowness[0]
        slowness[0] *= 1.1

    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    timing = time_call(work, 6.0, repeat=3, reference=lambda: work(2.0))
    assert timing.ratio == pytest.approx(3.0, rel=0.01)
    assert timing.run > 7.0
    # The shortest calls are the first: that of the reference comes just before the other.
    assert timing.ratio_of_shortest == pytest.approx(3.0 * 1.1)


def test_scipy_time_scales_a_sample_to_the_whole_grid(monkeypatch):
    """Times that are a constant plus a share proportional to 1 / v are summed exactly."""
    masses, speeds = np.linspace(0.1, 1, 5), np.linspace(0.3, 10, 9)

    def known_time(function, beam, masses, speeds, repeat, reference):
        seconds = 0.01 + 0.02 / speeds[0]
        return Timing(
            run=seconds, ratio=3 / speeds[0], shortest=seconds / 2, reference_shortest=0.1
        )

    monkeypatch.setattr(baselines, "time_call", known_time)
    timing = scipy_time(scipy_peaks, PinnedBeam(1), masses, speeds, runs=4)
    np.testing.assert_allclose(timing.run, np.sum(0.01 + 0.02 / speeds) * len(masses))
    np.testing.assert_allclose(timing.ratio, np.sum(3 / speeds) * len(masses))
    np.testing.assert_allclose(timing.ratio_of_shortest, timing.run / 2 / 0.1)


@pytest.mark.parametrize("position", [0.1, 0.55, 0.7, 1.15])
def test_modes_of_two_spans_are_those_of_the_oracle(position):
    beam, oracle = PinnedBeam(6, 1.2, spans=2), TwoSpans(1.2, 11.68, 0.535, 6, 0.03)
    np.testing.assert_allclose(beam.frequencies, oracle.frequencies, rtol=1e-12)
    for order in (0, 1):
        expected = oracle.shapes(position, order)
        atol = 1e-12 * np.max(np.abs(expected))
        np.testing.assert_allclose(beam.shapes(position, order), expected, atol=atol)


@pytest.mark.parametrize("spans", [1, 2])
def test_scipy_histories_under_control_are_those_of_the_oracle(spans):
    """The oracle has a full mass matrix, and its own sensors, clock and patches."""
    beam = cases.pinned_beam(spans, "sampled", 4)
    kind = TwoSpans if spans == 2 else Span
    oracle = kind(beam.length, beam.flexural_rigidity, beam.mass_per_length, 4, beam.damping_ratio)
    edges = [(0.6 * i + 0.2575, 0.6 * i + 0.3425) for i in range(spans)]
    patches = [Actuator([(a, 1, 1.0), (b, 1, -1.0)], 8.292e-4 * 0.35 * 200) for a, b in edges]
    times = np.arange(0.0, 0.5, 0.02)
    expected = respond(
        oracle,
        [Load(0.7, 4.0)],
        patches,
        [Sensor(x) for x in beam.sensors],
        lambda readings, *_: -1e3 * readings[:spans],
        times.tolist(),
        Clock(0.01),
    )
    found = baselines.scipy_histories(beam, [0.7], [4.0], times)[0, 0]
    size = np.max(np.abs(expected.deflection))
    np.testing.assert_allclose(found, expected.deflection, atol=1e-6 * size)


def test_rate_off_the_beam_is_that_of_a_zero_mass():
    beam = PinnedBeam(3)
    state = np.random.default_rng(0).normal(size=(2, 3, 1))
    off_beam = crossing_rate(beam, np.ones(1), 1.0, None)(0.2, state)
    np.testing.assert_allclose(off_beam, crossing_rate(beam, np.zeros(1), 1.0)(0.2, state))


@pytest.mark.parametrize("modes", [3, 6])
def test_loops_for_numba_find_the_peaks_uncompiled(modes):
    beam = PinnedBeam(modes)
    expected = reference_peaks(beam, MASSES, SPEEDS)
    found = numba_peaks.numba_peaks(numba_peaks.compile_peaks(None), beam, MASSES, SPEEDS)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_numba_agrees_with_the_uncompiled_loops():
    package = pytest.importorskip("numba")
    found, plain = (
        numba_peaks.numba_peaks(numba_peaks.compile_peaks(p), PinnedBeam(3), MASSES, SPEEDS)
        for p in (package, None)
    )
    np.testing.assert_allclose(found, plain, rtol=1e-9)
