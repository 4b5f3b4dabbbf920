"""The baselines of the speed benchmark solve the same problem, and solve it right."""

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from experiments.benchmarks import baselines
from experiments.benchmarks.baselines import (
    diffrax_peaks,
    reference_peaks,
    scipy_peaks,
    scipy_time,
)
from experiments.benchmarks.crossing import Rig, free_times, hermite_peaks
from experiments.benchmarks.timing import Timing, time_call

MASSES = np.array([0.1, 0.55, 1.0])
# The heavier masses peak after the exit at 5.3 and 10 m/s, all others while they cross.
SPEEDS = np.array([0.8, 2.2, 5.3, 10.0])


@pytest.fixture(scope="module")
def reference():
    return reference_peaks(Rig(3), MASSES, SPEEDS)


def test_scipy_agrees_to_one_in_a_million(reference):
    np.testing.assert_allclose(scipy_peaks(Rig(3), MASSES, SPEEDS), reference, rtol=1e-6)


@pytest.mark.parametrize("shared_steps", [False, True])
def test_diffrax_agrees_to_one_in_a_million(reference, shared_steps):
    peaks = diffrax_peaks(Rig(3), MASSES, SPEEDS, shared_steps=shared_steps)
    np.testing.assert_allclose(peaks, reference, rtol=1e-6)


def test_reference_agrees_with_the_coupled_equations_sampled_finely():
    """The full mass matrix, Gaussian elimination, and no closed form after the exit."""
    mass, speed, length, modes = 0.7, 6.0, 0.6, 3
    order = np.arange(1, modes + 1)
    wavenumber = order * np.pi / length
    stiffness = 11.68 * wavenumber**4
    damping = 2 * 0.03 * np.sqrt(stiffness * 0.535)

    def rate(t, state):
        """Modal amplitudes of sines, modal mass 0.535 L / 2 each."""
        q, velocity = np.split(state, 2)
        inertia = 0.535 * length / 2 * np.eye(modes)
        force = -length / 2 * (stiffness * q + damping * velocity)
        if t < length / speed:
            sine = np.sin(wavenumber * speed * t)
            cosine = np.cos(wavenumber * speed * t)
            inertia = inertia + mass * np.outer(sine, sine)
            convected = 2 * speed * wavenumber * cosine @ velocity
            convected -= speed**2 * (wavenumber**2 * sine) @ q
            force = force - mass * (9.81 + convected) * sine
        return np.concatenate([velocity, np.linalg.solve(inertia, force)])

    state, largest = np.zeros(2 * modes), 0.0
    for start, end in [(0.0, length / speed), (length / speed, length / speed + 0.5)]:
        inside = np.nextafter(end, 0) if start == 0 else end
        samples = np.linspace(start, inside, 200001)  # misses 2e-8 of a peak
        run = solve_ivp(
            rate, (start, inside), state, "DOP853", samples, rtol=1e-10, atol=1e-15, max_step=1e-2
        )
        sensors = np.sin(np.outer([0.15, 0.3, 0.45], wavenumber))
        largest = np.maximum(largest, np.abs(sensors @ run.y[:modes]).max(axis=1))
        state = run.y[:, -1]
    expected = reference_peaks(Rig(modes), [mass], [speed])[0, 0]
    np.testing.assert_allclose(largest, expected, rtol=1e-7)


def test_cubic_peaks_are_exact_for_a_cubic_and_need_no_sample_at_the_peak():
    times = np.array([0.0, 0.7, 1.1])
    value = 2 * times**3 - 3 * times**2 + 0.9 * times - 0.5
    rate = 6 * times**2 - 6 * times + 0.9
    dip = (1 + np.sqrt(0.4)) / 2
    lowest = 2 * dip**3 - 3 * dip**2 + 0.9 * dip - 0.5
    peak = hermite_peaks(np.diff(times), value, rate)
    np.testing.assert_allclose(peak, abs(lowest), rtol=1e-14)


def test_free_times_cover_the_time_asked_for_and_thin_out_as_high_modes_die():
    times = free_times(Rig(12), 0.5)
    assert times[0] == 0.0 and times[-1] == 0.5
    assert np.all(np.diff(times) > 0)
    assert times[-2] - times[-3] > 5 * times[1]


def test_time_call_keeps_compiling_apart():
    timing = time_call(jax.jit(lambda x: x @ x), np.eye(50))
    assert 0 < timing.run < timing.compile


def test_scipy_time_scales_a_sample_to_the_whole_grid(monkeypatch):
    """Costs of the form it assumes are added up exactly."""
    masses, speeds = np.linspace(0.1, 1, 5), np.linspace(0.3, 10, 9)

    def known_cost(function, rig, masses, speeds, repeat):
        return Timing(run=0.01 + 0.02 / speeds[0], compile=0.0)

    monkeypatch.setattr(baselines, "time_call", known_cost)
    whole = np.sum(0.01 + 0.02 / speeds) * len(masses)
    np.testing.assert_allclose(scipy_time(scipy_peaks, Rig(1), masses, speeds, runs=4), whole)
