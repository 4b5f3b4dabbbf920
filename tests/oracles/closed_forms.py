"""Closed forms: characteristic equations, a moving force on two pins, static influence lines."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from scipy.optimize import brentq

from tests.oracles.modal_equations import Span

# Zero at x = k L; divided by cosh x, so that nothing overflows.
CHARACTERISTIC = {
    frozenset({"pinned"}): lambda x: np.sin(x),
    frozenset({"guided"}): lambda x: np.sin(x),
    frozenset({"pinned", "guided"}): lambda x: np.cos(x),
    frozenset({"clamped"}): lambda x: np.cos(x) - 1.0 / np.cosh(x),
    frozenset({"free"}): lambda x: np.cos(x) - 1.0 / np.cosh(x),
    frozenset({"clamped", "free"}): lambda x: np.cos(x) + 1.0 / np.cosh(x),
    frozenset({"clamped", "pinned"}): lambda x: np.sin(x) - np.cos(x) * np.tanh(x),
    frozenset({"free", "pinned"}): lambda x: np.sin(x) - np.cos(x) * np.tanh(x),
    frozenset({"clamped", "guided"}): lambda x: np.sin(x) + np.cos(x) * np.tanh(x),
    frozenset({"free", "guided"}): lambda x: np.sin(x) + np.cos(x) * np.tanh(x),
}
RIGID_BODY_MODES = {"free-free": 2, "free-pinned": 1, "free-guided": 1, "guided-guided": 1}


def single_span_parameters(ends: str, count: int) -> np.ndarray:
    """k L of the first modes of one span, roots of its characteristic equation; 0 if rigid."""
    left, right = ends.split("-")
    rigid = RIGID_BODY_MODES.get(ends, RIGID_BODY_MODES.get(f"{right}-{left}", 0))
    equation = CHARACTERISTIC[frozenset({left, right})]
    grid = 0.75 + np.pi * np.arange(count + 2)  # at most one root in between, and not that at 0
    return np.append(np.zeros(rigid), _roots(equation, grid))[:count]


def two_span_parameters(ratio: float, count: int) -> np.ndarray:
    """k L of the first modes of a beam of length L on three pins, the middle one at ratio L.

    Roots of the three-moment condition sum over both spans of coth x - cot x = 0, multiplied by
    the sines, which leaves no poles; found on a fine grid, so no two roots may be close.
    """

    def condition(x: float) -> float:
        a, b = ratio * x, (1.0 - ratio) * x
        cotangents = np.sin(a) * np.sin(b) * (1.0 / np.tanh(a) + 1.0 / np.tanh(b))
        return cotangents - np.sin(a + b)

    return _roots(condition, np.linspace(0.5, (count + 3) * np.pi, 400 * count))[:count]


def _roots(function: Callable[[float], float], grid: np.ndarray) -> np.ndarray:
    """One root wherever the function changes its sign between points of the grid."""
    changes = [(a, b) for a, b in pairwise(grid) if function(a) * function(b) <= 0.0]
    return np.array([brentq(function, a, b, xtol=1e-14, rtol=1e-15) for a, b in changes])


def moving_force(
    span: Span, force: float, speed: float, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Modal coordinates and rates (time, mode) under a force that enters at t = 0 and leaves.

    Undamped, any positive speed, critical ones included: with W = n pi v / L,

        q = -force phi_n (w sin W t - W sin w t) / (w (w^2 - W^2))      on the beam,

    rewritten in the sum and difference of w and W, so that W = w is nothing special; free
    vibration from the state at the exit afterwards.
    """
    w, drive = span.frequencies, speed * span.wavenumbers
    amplitude = -force * np.sqrt(2.0 / (span.mass_per_length * span.length))
    exit_time = span.length / speed
    t = np.minimum(times, exit_time)[:, None]
    mean, half = 0.5 * (drive + w), 0.5 * (drive - w)
    lag = t * np.sinc(half * t / np.pi)  # sin(half t) / half
    q = (np.sin(mean * t) * np.cos(half * t) / mean - lag * np.cos(mean * t)) / (2.0 * w)
    u = drive * np.sin(mean * t) * lag / (2.0 * mean)
    free = np.maximum(times - exit_time, 0.0)[:, None]
    cosine, sine = np.cos(w * free), np.sin(w * free)
    return amplitude * (q * cosine + u / w * sine), amplitude * (u * cosine - w * q * sine)


def critical_speed(span: Span) -> float:
    """Speed in m/s at which a force meets the first mode in resonance."""
    return span.frequencies[0] / span.wavenumbers[0]


def cancellation_speed(span: Span, mode: int, order: int) -> float:
    """The speed in m/s after which a crossing force leaves mode `mode` (from 1) at rest.

    The force passes n half waves of the mode while that swings n / 2 + order times.
    """
    return mode**2 / (mode + 2.0 * order) * critical_speed(span)


def influence_line(
    length: float, flexural_rigidity: float, ends: str, at: float, positions: np.ndarray
) -> np.ndarray:
    """Static deflection at `at` under 1 N downwards at `positions`, in m/N, of one span.

    Macaulay's method: EI w = a cubic with two coefficients left open by the left end, less the
    load's <x - position>^3 / 6; the right end fixes the two. Raises LinAlgError if the beam can
    move rigidly.
    """
    left, right = (
        {"pinned": (0, 2), "clamped": (0, 1), "guided": (1, 3), "free": (2, 3)}[end]
        for end in ends.split("-")
    )

    def power(x: float, exponent: int, derivative: int) -> float:
        """A derivative of <x>^n / n! for x from the start of the term."""
        n = exponent - derivative
        return 0.0 if n < 0 or x < 0.0 else x**n / (1.0, 1.0, 2.0, 6.0)[n]

    open_terms = [exponent for exponent in range(4) if exponent not in left]
    system = [[power(length, e, d) for e in open_terms] for d in right]
    line = []
    for position in positions:
        load = [power(length - position, 3, d) for d in right]
        coefficients = np.linalg.solve(system, load)
        free = sum(c * power(at, e, 0) for c, e in zip(coefficients, open_terms, strict=True))
        line.append((free - power(at - position, 3, 0)) / flexural_rigidity)
    return np.array(line)
