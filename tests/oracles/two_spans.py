"""Two equal spans on three pins, for the closed loop of `closed_loop`: exact modes, or sines.

The modes are those of a single span between pins, turned over at the middle support, and of one
that is clamped there (tan k l = tanh k l), mirrored. The other basis is the sines of the whole
length that a rigid support leaves: n of them projected on those that vanish in the middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import eigh, null_space
from scipy.optimize import brentq


@dataclass(frozen=True)
class TwoSpans:
    """Exact modes, which count from the lowest; each has the damping ratio."""

    length: float  # m, of both spans
    flexural_rigidity: float  # N m^2
    mass_per_length: float  # kg/m
    modes: int
    damping_ratio: float = 0.0

    @cached_property
    def wavenumbers(self) -> np.ndarray:
        def clamped(x):
            return np.sin(x) - np.cos(x) * np.tanh(x)

        numbers = []
        for n in range(1, self.modes // 2 + 2):
            numbers += [n * np.pi, brentq(clamped, n * np.pi + 0.1, (n + 0.5) * np.pi, xtol=1e-14)]
        return np.array(numbers[: self.modes]) / (self.length / 2)

    @cached_property
    def frequencies(self) -> np.ndarray:
        """Natural angular frequencies in rad/s."""
        return self.wavenumbers**2 * np.sqrt(self.flexural_rigidity / self.mass_per_length)

    @cached_property
    def damping(self) -> np.ndarray:
        """Damping matrix in 1/s."""
        return np.diag(2 * self.damping_ratio * self.frequencies)

    @cached_property
    def scale(self) -> np.ndarray:
        """Factors that normalise the modal masses (mode,), in 1/sqrt(kg)."""
        points, weights = np.polynomial.legendre.leggauss(60 + 4 * self.modes)
        x = self.length / 4 * (points + 1)  # half is enough: the other is its image
        squares = self._left(x, 0) ** 2
        mass = self.mass_per_length * 2 * self.length / 4 * (weights @ squares)
        return 1 / np.sqrt(mass)

    def shapes(self, x: float, derivative: int = 0) -> np.ndarray:
        """Modes or their x-derivatives (mode,), in 1 / (sqrt(kg) m^derivative)."""
        if x <= self.length / 2:
            return self.scale * self._left(np.array([x]), derivative)[0]
        turned = np.where(np.arange(self.modes) % 2 == 0, -1.0, 1.0) * (-1.0) ** derivative
        return self.scale * turned * self._left(np.array([self.length - x]), derivative)[0]

    def _left(self, x, derivative):
        """Shapes (position, mode) on the left span, with a largest sine of one."""
        k, span = self.wavenumbers, self.length / 2
        phase = np.multiply.outer(x, k)
        sine = np.sin(phase + 0.5 * np.pi * derivative)
        hyperbolic = (np.exp(phase - k * span) - (-1) ** derivative * np.exp(-phase - k * span)) / 2
        # sinh(k x) / sinh(k l), or cosh
        hyperbolic = hyperbolic / ((1 - np.exp(-2 * k * span)) / 2)
        sinh_share = np.where(np.arange(self.modes) % 2 == 0, 0.0, np.sin(k * span))
        return k**derivative * (sine - sinh_share * hyperbolic)


@dataclass(frozen=True)
class ProjectedSines:
    """Sines of the whole length, constrained by the support in the middle."""

    length: float
    flexural_rigidity: float
    mass_per_length: float
    sines: int
    damping_ratio: float = 0.0

    @cached_property
    def modes(self) -> int:
        return self.sines - 1

    @cached_property
    def _whole(self) -> np.ndarray:
        """Wavenumbers of the sines."""
        return np.arange(1, self.sines + 1) * np.pi / self.length

    @cached_property
    def _solved(self):
        """Squared angular frequencies, and the map from modal coordinates to those of the sines."""
        size = self.mass_per_length * self.length / 2
        constrained_basis = null_space(np.sin(self._whole * self.length / 2)[None])
        stiffness = self.flexural_rigidity * self._whole**4 * self.length / 2
        squares, vectors = eigh(
            constrained_basis.T @ (stiffness[:, None] * constrained_basis),
            size * np.eye(self.modes),
        )
        return squares, constrained_basis @ vectors

    @cached_property
    def frequencies(self) -> np.ndarray:
        """Natural angular frequencies in rad/s."""
        return np.sqrt(self._solved[0])

    @cached_property
    def damping(self) -> np.ndarray:
        """Damping matrix in 1/s: that of the sines without the support, projected on the modes."""
        turn = self._whole**2 * np.sqrt(self.flexural_rigidity / self.mass_per_length)
        each = 2 * self.damping_ratio * turn * self.mass_per_length * self.length / 2
        return self._solved[1].T @ (each[:, None] * self._solved[1])

    def shapes(self, x: float, derivative: int = 0) -> np.ndarray:
        """Modes or their x-derivatives (mode,), in 1 / (sqrt(kg) m^derivative)."""
        k = self._whole
        return (k**derivative * np.sin(k * x + 0.5 * np.pi * derivative)) @ self._solved[1]
