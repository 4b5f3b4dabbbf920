"""The crossing of `pinned_beam` by loops that numba compiles: adaptive Runge-Kutta, run by run.

Runs are distributed over all cores, each with its own steps: an embedded Runge-Kutta pair, as in
scipy and diffrax, with the step controlled by the same norm. Within steps the deflection is the
quintic through values, rates and accelerations at both ends; the rest follows the rules of
`baselines`. Without numba the same functions are plain Python, slow and for tests.
"""

import math
from types import ModuleType

import diffrax
import numpy as np

from experiments.benchmarks.rivals.baselines import GRAVITY, free_times

TOLERANCE = 1e-8  # errors of the peaks of the benchmark's grid stay below 1e-6
SOLVER, ORDER = diffrax.Dopri5, 5  # faster here than Tsit5 and Dopri8, with 3 modes and with 12
MAX_STEPS = 10**6  # of a run
PEAK_INTERVALS = 4  # of each step, in each of which a cubic finds the peak


def compile_peaks(package: ModuleType | None):
    """The function that fills in the peaks of all runs, compiled by numba if it is given."""
    if package is None:
        jit, share, every = (lambda function: function), range, (lambda function: function)
    else:
        jit, share = package.njit(fastmath=True), package.prange
        every = package.njit(fastmath=True, parallel=True)

    @jit
    def accelerate(t, state, out, shape, mass, speed, numbers, squares, damping, amplitude):
        """[q', q''] of a run from [q, q'], as `crossing_rate`; sines by the addition theorem."""
        modes = squares.size
        sine, cosine = math.sin(numbers[0] * speed * t), math.cos(numbers[0] * speed * t)
        now_sine, now_cosine, convected, size = 0.0, 1.0, 0.0, 0.0
        for j in range(modes):
            now_sine, now_cosine = (
                now_sine * cosine + now_cosine * sine,
                now_cosine * cosine - now_sine * sine,
            )
            travel = speed * numbers[j]
            phi = amplitude * now_sine
            free = -damping[j] * state[modes + j] - squares[j] * state[j]
            convected += phi * (free - travel * travel * state[j])
            convected += 2 * travel * amplitude * now_cosine * state[modes + j]
            size += phi * phi
            shape[j], out[j], out[modes + j] = phi, state[modes + j], free
        force = mass * (GRAVITY + convected) / (1 + mass * size)
        for j in range(modes):
            out[modes + j] -= shape[j] * force

    @jit
    def cubic(interval, value, slope, after, after_slope):
        """Largest absolute value of the cubic on one interval, as `hermite_peaks`."""
        left, right, rise = interval * slope, interval * after_slope, after - value
        square, cube = 3 * rise - 2 * left - right, left + right - 2 * rise
        root = math.sqrt(max(square * square - 3 * cube * left, 0.0))
        under = root - square if left > 0 else root + square
        s = min(abs(left) / max(under, 1e-300), 1.0)
        inside = value + s * (left + s * (square + s * cube))
        return max(abs(after), abs(inside))

    @jit
    def quintic(step, row, state, rate, after, after_rate):
        """The largest absolute deflection in a step at the sensor of one row of mode shapes."""
        modes = row.size
        w = v = a = w1 = v1 = a1 = 0.0
        for j in range(modes):
            w, w1 = w + row[j] * state[j], w1 + row[j] * after[j]
            v, v1 = v + row[j] * rate[j], v1 + row[j] * after_rate[j]
            a, a1 = a + row[j] * rate[modes + j], a1 + row[j] * after_rate[modes + j]
        v, v1, a, a1 = step * v, step * v1, step * step * a, step * step * a1
        rise, turn, bend = w1 - w - v - a / 2, v1 - v - a, a1 - a
        third = 10 * rise - 4 * turn + bend / 2
        fourth = -15 * rise + 7 * turn - bend
        fifth = 6 * rise - 3 * turn + bend / 2
        peak, value, slope = 0.0, w, v
        for part in range(1, PEAK_INTERVALS + 1):
            s = part / PEAK_INTERVALS
            now = w + s * (v + s * (a / 2 + s * (third + s * (fourth + s * fifth))))
            now_slope = v + s * (a + s * (3 * third + s * (4 * fourth + s * 5 * fifth)))
            peak = max(peak, cubic(1 / PEAK_INTERVALS, value, slope, now, now_slope))
            value, slope = now, now_slope
        return peak

    @jit
    def cross(mass, speed, beam, coefficients, tolerance, peaks):
        """The state [q, q'] at the exit, NaN if it fails; fills in the peaks of the crossing."""
        length, numbers, squares, damping, amplitude, rows, sizes = beam
        weights, end_weights, error_weights, nodes = coefficients
        modes, stages = squares.size, nodes.size
        rates = np.zeros((stages, 2 * modes))
        state, trial, after = np.zeros(2 * modes), np.zeros(2 * modes), np.zeros(2 * modes)
        shape, after_rate = np.zeros(modes), np.zeros(2 * modes)
        constants = numbers, squares, damping, amplitude
        t, end, step = 0.0, length / speed, 0.1 / math.sqrt(squares[modes - 1])
        accelerate(t, state, rates[0], shape, mass, speed, *constants)
        for _ in range(MAX_STEPS):
            step = min(step, end - t)
            for i in range(1, stages):
                for n in range(2 * modes):
                    total = 0.0
                    for k in range(i):
                        total += weights[i, k] * rates[k, n]
                    trial[n] = state[n] + step * total
                accelerate(t + nodes[i] * step, trial, rates[i], shape, mass, speed, *constants)
            error = 0.0
            for n in range(2 * modes):
                total = difference = 0.0
                for k in range(stages):
                    total += end_weights[k] * rates[k, n]
                    difference += error_weights[k] * rates[k, n]
                after[n] = state[n] + step * total
                error += (step * difference / (sizes[n] * mass)) ** 2
            error = math.sqrt(error / (2 * modes)) / tolerance
            change = min(max(0.9 * max(error, 1e-12) ** (-1 / ORDER), 0.2), 5.0)
            if error <= 1.0:
                accelerate(t + step, after, after_rate, shape, mass, speed, *constants)
                for s in range(peaks.size):
                    peak = quintic(step, rows[s], state, rates[0], after, after_rate)
                    peaks[s] = max(peaks[s], peak)
                t += step
                state[:], rates[0] = after, after_rate
                if t >= end * (1 - 1e-14):
                    return state
            step *= change
        state[:] = np.nan
        return state

    @jit
    def vibrate_freely(state, times, decays, exponents, rows, peaks):
        """Peaks of the free vibration that follows, from tables of exp(p t), (time, mode)."""
        modes = exponents.size
        starts = np.zeros(modes, np.complex128)
        for j in range(modes):
            rest = (state[modes + j] - exponents[j].real * state[j]) / exponents[j].imag
            starts[j] = complex(state[j], -rest)
        before, before_rate = np.zeros(peaks.size), np.zeros(peaks.size)
        q, velocity = np.zeros(modes), np.zeros(modes)
        for i in range(times.size):
            for j in range(modes):
                now = starts[j] * decays[i, j]
                q[j], velocity[j] = now.real, (now * exponents[j]).real
            for s in range(peaks.size):
                value = rate = 0.0
                for j in range(modes):
                    value += rows[s, j] * q[j]
                    rate += rows[s, j] * velocity[j]
                if i > 0:
                    peak = cubic(times[i] - times[i - 1], before[s], before_rate[s], value, rate)
                    peaks[s] = max(peaks[s], peak)
                before[s], before_rate[s] = value, rate

    @every
    def fill(masses, speeds, beam, coefficients, tolerance, times, decays, exponents, peaks):
        for run in share(masses.size * speeds.size):
            i, j = run // speeds.size, run % speeds.size
            state = cross(masses[i], speeds[j], beam, coefficients, tolerance, peaks[i, j])
            vibrate_freely(state, times, decays, exponents, beam[5], peaks[i, j])

    return fill


def numba_peaks(peak_function, beam, masses, speeds):
    """Peaks (mass, speed, sensor) in m by the function that `compile_peaks` returns.

    Masses in kg, speeds in m/s; for beams of one span without control.
    """
    tableau = SOLVER.tableau
    nodes = np.append(0.0, np.asarray(tableau.c))
    weights = np.zeros((nodes.size, nodes.size))
    for i, row in enumerate(tableau.a_lower, 1):
        weights[i, :i] = row
    coefficients = weights, np.asarray(tableau.b_sol), np.asarray(tableau.b_error), nodes
    damping = 2 * beam.damping_ratio * beam.frequencies
    sizes = np.ravel(beam.state_scales)
    modal_numbers = (
        beam.length,
        beam.wavenumbers,
        beam.frequencies**2,
        damping,
        float(beam.mode_amplitudes[0]),
    )
    times = free_times(beam)
    decays = np.exp(np.outer(times, beam.poles))
    peaks = np.zeros((len(masses), len(speeds), len(beam.sensors)))
    swept_values = np.asarray(masses, float), np.asarray(speeds, float)
    beam_numbers = *modal_numbers, np.ascontiguousarray(beam.sensor_shapes), sizes
    peak_function(
        *swept_values, beam_numbers, coefficients, TOLERANCE, times, decays, beam.poles, peaks
    )
    return peaks
