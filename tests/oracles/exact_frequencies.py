"""Exact natural frequencies of beams in any number of pieces, none of them missed.

The dynamic stiffness matrix of a continuous beam is exact at every frequency, and the count of
Wittrick and Williams (Q. J. Mech. Appl. Math. 24, 1971) says how many natural frequencies lie
below it: those of the members with clamped ends, and the negative eigenvalues of the matrix.
Members are cut so short here that none reaches a frequency of its own, which leaves the second
number and no poles. Bisection on it finds every frequency, repeated ones as often as they occur.
"""

from __future__ import annotations

from dataclasses import replace
from math import factorial

import numpy as np

from tests.oracles.finite_elements import Beam, mesh, section, supports_on


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
