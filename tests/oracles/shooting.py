"""Frequencies of beams of any section by shooting: the determinant of the boundary conditions.

The state (w, phi, M, S) obeys, at a circular frequency omega and with a slope w' = g (phi - c S),
c = 1 / kGA, g = 1 / (1 + c T),

    phi' = M / E I,    M' = S + T w' - omega^2 r phi,    S' = (m omega^2 - k) w,

and is integrated from the left end to the right by DOP853.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

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
