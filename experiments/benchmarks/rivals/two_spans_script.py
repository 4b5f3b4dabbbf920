"""The run of the benchmark `first_answer` by numpy and scipy alone, as one would write it at hand.

    python experiments/benchmarks/rivals/two_spans_script.py

Six modes of a beam on three supports by the Ritz method with Chebyshev polynomials in each span,
then DOP853 from event to event under a moving mass and a moving force. Prints frequencies (Hz) and
peak deflections (m), true to one part in a million, as JSON.
"""

import json

import numpy as np
from numpy.polynomial import chebyshev, legendre
from scipy.integrate import solve_ivp
from scipy.linalg import block_diag, eigh, null_space

SPANS, RIGIDITY, MASS_PER_LENGTH = ((0.0, 0.5), (0.5, 1.2)), 11.68, 0.535  # m, N m^2, kg/m
LENGTH, DAMPING, MODES, GRAVITY = 1.2, 0.03, 6, 9.81
MASS, MASS_SPEED = 0.3, 1.0  # kg, m/s; enters at t = 0
FORCE, FORCE_SPEED, FORCE_ENTRY = 3.0, 1.3, 0.3  # N, m/s, s
SENSORS, DURATION, RATE = (0.2, 0.8), 2.0, 1000.0  # m, s, Hz
DEGREE = 22


def values(x, span, series):
    """Series of Chebyshev polynomials in a span at x, (series,)."""
    left, right = SPANS[span]
    angle = np.arccos(np.clip((2 * x - left - right) / (right - left), -1, 1))
    return np.cos(np.arange(DEGREE + 1) * angle) @ series


def derivative(series, span, order):
    """Derivatives of series in a span by x, padded to the same degree, (degree, series)."""
    left, right = SPANS[span]
    derived = chebyshev.chebder(series, order) * (2 / (right - left)) ** order
    return np.pad(derived, [(0, DEGREE + 1 - len(derived)), (0, 0)])


basis_series = [[derivative(np.eye(DEGREE + 1), span, d) for d in range(3)] for span in (0, 1)]
nodes, weights = legendre.leggauss(DEGREE + 1)
masses, stiffnesses = [], []
for span, (left, right) in enumerate(SPANS):
    half, points = (right - left) / 2, (left + right) / 2 + (right - left) / 2 * nodes
    shapes, bendings = (
        np.array([values(x, span, basis_series[span][d]) for x in points]) for d in (0, 2)
    )
    masses.append(MASS_PER_LENGTH * half * shapes.T @ (weights[:, None] * shapes))
    stiffnesses.append(RIGIDITY * half * bendings.T @ (weights[:, None] * bendings))
none = np.zeros(DEGREE + 1)
(first, first_slope, _), (second, second_slope, _) = basis_series
conditions = [  # clamped, over a support in between, pinned
    [*values(0.0, 0, first), *none],
    [*values(0.0, 0, first_slope), *none],
    [*values(0.5, 0, first), *none],
    [*none, *values(0.5, 1, second)],
    [*values(0.5, 0, first_slope), *-values(0.5, 1, second_slope)],
    [*none, *values(LENGTH, 1, second)],
]
basis = null_space(np.array(conditions) / np.linalg.norm(conditions, axis=1)[:, None])
reduced = (basis.T @ block_diag(*parts) @ basis for parts in (stiffnesses, masses))
squares, vectors = eigh(*reduced, subset_by_index=[0, MODES - 1])
frequencies = np.sqrt(squares)
mode_series = [
    np.hstack([derivative(part, span, d) for d in range(3)])
    for span, part in enumerate(np.split(basis @ vectors, len(SPANS)))
]


def shape(x):
    """Mode shapes at x, their slopes and curvatures, (3, mode)."""
    span = int(x > SPANS[0][1])
    return values(x, span, mode_series[span]).reshape(3, MODES)


def rate(t, state, middle):
    """Rates of coordinates and velocities; `middle` (s) tells which loads are on the beam."""
    q, velocity = np.split(state, 2)
    free = -squares * q - 2 * DAMPING * frequencies * velocity
    if FORCE_ENTRY < middle < FORCE_ENTRY + LENGTH / FORCE_SPEED:
        free = free - FORCE * shape(FORCE_SPEED * (t - FORCE_ENTRY))[0]
    if middle < LENGTH / MASS_SPEED:
        x, v = MASS_SPEED * t, MASS_SPEED
        phi, slope, curvature = shape(x)
        convected = phi @ free + 2 * v * slope @ velocity + v**2 * curvature @ q
        free = free - phi * MASS * (GRAVITY + convected) / (1 + MASS * phi @ phi)
    return np.concatenate([velocity, free])


events = [0.0, DURATION]
for entry, speed in ((0.0, MASS_SPEED), (FORCE_ENTRY, FORCE_SPEED)):
    events += [entry + x / speed for x in (0.0, 0.5, LENGTH)]
events = np.unique(events)
rows = np.array([shape(x)[0] for x in SENSORS])
state, peaks, record = np.zeros(2 * MODES), np.zeros(len(SENSORS)), []
samples = np.arange(int(DURATION * RATE) + 1) / RATE
for start, end in zip(events[:-1], events[1:], strict=True):
    middle = (start + end) / 2
    run = solve_ivp(
        rate, (start, end), state, "DOP853", args=(middle,), rtol=1e-6, atol=1e-9,
        dense_output=True,
    )  # fmt: skip
    state = run.y[:, -1]
    record.append(rows @ run.sol(samples[(samples >= start) & (samples < end)])[:MODES])
    times = np.linspace(start, end, max(2, int((end - start) * RATE) + 1))
    for i, row in enumerate(rows):
        top = times[np.argmax(np.abs(row @ run.sol(times)[:MODES]))]
        around = np.clip(np.linspace(top - 1 / RATE, top + 1 / RATE, 2001), start, end)
        peaks[i] = max(peaks[i], np.max(np.abs(row @ run.sol(around)[:MODES])))
print(json.dumps({"frequencies": (frequencies / 2 / np.pi).tolist(), "peaks": peaks.tolist()}))
