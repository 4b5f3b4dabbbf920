"""Closed forms: characteristic equations, a moving force on two pins, static influence lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import factorial

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from tests.oracles.finite_elements import Beam, mesh, section, supports_on
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


# Frequencies of beams of any section by shooting: the determinant of the boundary conditions.
#
# The state (w, phi, M, S) obeys, at a circular frequency omega and with a slope w' = g (phi - c S),
# c = 1 / kGA, g = 1 / (1 + c T),
#
#     phi' = M / E I,    M' = S + T w' - omega^2 r phi,    S' = (m omega^2 - k) w,
#
# and is integrated from the left end to the right by DOP853.

# Entries of (w, phi, M, S) that vanish at an end.
ENDS = {"pinned": (0, 2), "clamped": (0, 1), "free": (2, 3), "guided": (1, 3)}


@dataclass(frozen=True)
class ShootingBeam:
    """Section properties as functions of x, smooth between the `breaks`."""

    length: float
    rigidity: Callable[[float], float]
    mass: Callable[[float], float]
    shear_flexibility: Callable[[float], float] = lambda x: 0.0
    rotary: Callable[[float], float] = lambda x: 0.0
    foundation: float = 0.0
    axial: float = 0.0
    ends: str = "pinned-pinned"
    breaks: Sequence[float] = ()

    def rate(self, x: float, state: np.ndarray, omega: float) -> np.ndarray:
        w, phi, moment, force = state.reshape(4, -1)
        c = self.shear_flexibility(x)
        slope = (phi - c * force) / (1.0 + c * self.axial)
        return np.concatenate(
            [
                slope,
                moment / self.rigidity(x),
                force + self.axial * slope - omega**2 * self.rotary(x) * phi,
                (omega**2 * self.mass(x) - self.foundation) * w,
            ]
        )

    def determinant(self, omega: float) -> float:
        """Determinant of the conditions at the right end; zero at natural frequencies."""
        left, right = (ENDS[end] for end in self.ends.split("-"))
        start = np.eye(4)[:, [i for i in range(4) if i not in left]]
        edges = [0.0, *self.breaks, self.length]
        state = start.reshape(-1)
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            inside = 1e-13 * self.length
            solution = solve_ivp(
                self.rate,
                (a + inside, b - inside),
                state,
                "DOP853",
                args=(omega,),
                rtol=1e-12,
                atol=1e-14,
            )
            state = solution.y[:, -1]
        return float(np.linalg.det(state.reshape(4, 2)[list(right)]))

    def frequency_near(self, omega: float, share: float = 1e-4) -> float:
        """The natural frequency (rad/s) within a share of an estimate; raises without one."""
        low, high = omega * (1 - share), omega * (1 + share)
        return brentq(self.determinant, low, high, xtol=1e-12 * omega, rtol=1e-13)


# Exact natural frequencies of beams in any number of pieces, none of them missed.
#
# The dynamic stiffness matrix of a continuous beam is exact at every frequency, and the count of
# Wittrick and Williams (Q. J. Mech. Appl. Math. 24, 1971) says how many natural frequencies lie
# below it: those of the members with clamped ends, and the negative eigenvalues of the matrix.
# Members are cut so short here that none reaches a frequency of its own, which leaves the second
# number and no poles. Bisection on it finds every frequency, repeated ones as often as they occur.


def exact_frequencies(beam: Beam, count: int) -> np.ndarray:
    """The first angular frequencies in rad/s, to rounding, without suspensions.

    Rigidity and mass per length, where they are functions of x, must be constant between the
    supports and patch edges. Rigid-body modes have 0, and so has whatever oscillates with less
    than a thousandth of sqrt(EI / (m length^4)).
    """
    nodes = mesh(replace(beam, elements=1, suspensions=()))
    springs, _, free = supports_on(beam, nodes)
    sections = [section(beam, x) for x in 0.5 * (nodes[:-1] + nodes[1:])]
    members = [(h, *s) for h, s in zip(np.diff(nodes), sections, strict=True)]
    rigidity, density = sections[0]
    scale = np.sqrt(rigidity / density) / beam.length**2

    def below(omega: float) -> int:
        return _count_below(omega, members, springs, free)

    frequencies = [0.0] * min(below(1e-3 * scale), count)
    for number in range(len(frequencies), count):
        low = max(frequencies[-1], 1e-3 * scale) if frequencies else 1e-3 * scale
        high = low + scale
        while below(high) <= number:
            high *= 2.0
        while low < (middle := 0.5 * (low + high)) < high:
            low, high = (middle, high) if below(middle) <= number else (low, middle)
        frequencies.append(high)
    return np.array(frequencies)


def wavenumbers(beam: Beam, count: int) -> np.ndarray:
    """(m omega^2 / EI)^(1/4) in 1/m of a uniform beam, for its first exact frequencies."""
    rigidity, density = section(beam, 0.5 * beam.length)
    return (density / rigidity * exact_frequencies(beam, count) ** 2) ** 0.25


def _count_below(omega: float, members: list, springs: np.ndarray, free: np.ndarray) -> int:
    """How many natural frequencies lie below omega (rad/s)."""
    wave = [(density / rigidity * omega**2) ** 0.25 for _, rigidity, density in members]
    pieces = [int(np.ceil(0.5 * k * m[0])) for k, m in zip(wave, members, strict=True)]
    starts = 2 * np.append(0, np.cumsum(pieces))  # degrees of freedom (deflection, slope) per node
    stiffness = np.zeros((starts[-1] + 2, starts[-1] + 2))
    for k, n, start, (length, rigidity, _) in zip(wave, pieces, starts, members, strict=False):
        piece = _piece(k * length / n, length / n, rigidity)
        for at in range(int(start), int(start) + 2 * n, 2):
            stiffness[at : at + 4, at : at + 4] += piece
    ends = (starts[:, None] + [0, 1]).ravel()  # degrees of freedom with springs and restraints
    np.add.at(stiffness, (ends, ends), springs)
    kept = np.setdiff1d(np.arange(len(stiffness)), np.delete(ends, free))
    stiffness = stiffness[np.ix_(kept, kept)]
    # A change of units keeps the signs of the eigenvalues; with entries of one size, rounding of
    # a very stiff spring does not drown the others.
    unit = 1.0 / np.sqrt(np.abs(stiffness).max(axis=0, initial=0.0))
    return int(np.sum(np.linalg.eigvalsh(unit[:, None] * stiffness * unit) < 0.0))


def _piece(x: float, h: float, rigidity: float) -> np.ndarray:
    """Dynamic stiffness over (deflection, slope) at the two ends of a piece of length h, for
    x = (m omega^2 / EI)^(1/4) h up to 2. The combinations of circular and hyperbolic functions
    in it are power series here, free of cancellation for small x."""

    def series(power: int, ratio: float) -> float:
        return sum(ratio**j * x ** (4 * j + power) / factorial(4 * j + power) for j in range(6))

    delta = 4 * series(4, -4)  # 1 - cos cosh
    a = 2 * x**3 * series(1, -4) / delta  # sin cosh + cos sinh
    b = 2 * x**2 * series(2, -4) / delta  # sin sinh
    c = 4 * x * series(3, -4) / delta  # sin cosh - cos sinh
    d = 2 * x**2 * series(2, 1) / delta  # cosh - cos
    e = 2 * x**3 * series(1, 1) / delta  # sinh + sin
    f = 2 * x * series(3, 1) / delta  # sinh - sin
    return rigidity / h**3 * np.array(
        [[a, b * h, -e, d * h],
         [b * h, c * h**2, -d * h, f * h**2],
         [-e, -d * h, a, -b * h],
         [d * h, f * h**2, -b * h, c * h**2]])  # fmt: skip
