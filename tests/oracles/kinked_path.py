"""Rigid wheels over kinks, by the balance of momentum of the modal equations with full mass matrix.

The beam has mass-normalised modes of given circular frequencies; wheels of mass m at x(t) press
with their weight W, and one may carry a sprung body. While nobody passes a kink,

    (I + sum m s s^T) q'' = -w^2 q - sum s (W + m (2 v s'^T q' + v^2 s''^T q + a s'^T q
                                                   + v^2 r'' + a r') + spring),

and over a kink the momentum (I + sum m s s^T) q' + sum m s (v s'^T q + v r') stays, as forces are
finite: m s times the velocity of each wheel, and q' itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from scipy.integrate import solve_ivp

Path = Callable[[float], tuple[float, float, float]]  # position, speed, acceleration at a time
SIDE = 1e-13  # s, beside an event
TERMS = 26  # of the series of shapes between nodes


@dataclass(frozen=True)
class Wheel:
    """A wheel, and a body above it on a spring and a damper, if it has mass."""

    path: Path
    mass: float
    weight: float  # with the body
    body: float = 0.0
    spring: float = 0.0
    damper: float = 0.0


class PiecewiseShapes:
    """Shapes that are smooth between nodes, and their derivatives, by interpolation of values."""

    def __init__(self, nodes: Sequence[float], values: Callable[[np.ndarray], np.ndarray]):
        self.nodes, self.series = np.asarray(nodes), []
        points = chebyshev.chebpts1(TERMS)
        for left, right in zip(nodes[:-1], nodes[1:], strict=True):
            half = (right - left) / 2
            series = chebyshev.chebfit(points, values(left + half * (1 + points)), TERMS - 1)
            orders = [np.zeros((TERMS, series.shape[1])) for _ in range(3)]
            for order, part in enumerate(orders):
                part[: TERMS - order] = chebyshev.chebder(series, order) / half**order
            self.series.append(np.hstack(orders))

    def __call__(self, x: float) -> np.ndarray:
        """Shapes, slopes and curvatures (order, mode) at a position."""
        i = int(np.clip(np.searchsorted(self.nodes, x) - 1, 0, len(self.series) - 1))
        left, right = self.nodes[i : i + 2]
        t = np.clip(2 * (x - left) / (right - left) - 1, -1.0, 1.0)
        return (np.cos(np.arange(TERMS) * np.arccos(t)) @ self.series[i]).reshape(3, -1)


def crossing(
    frequencies: np.ndarray,
    shapes: Callable[[float], np.ndarray],
    profile: Callable[[float], tuple[float, float, float]],
    wheels: Sequence[Wheel],
    events: Sequence[float],
    times: np.ndarray,
    span: tuple[float, float],
    impulses: list | None = None,
) -> np.ndarray:
    """Modal coordinates and rates (state, time) of a run from rest, by DOP853.

    `events` are all times at which a wheel enters, leaves or passes a kink, and the end. With a
    list of `impulses`, the changes of the rates at every passage are appended to it.
    """
    n, count = len(frequencies), len(wheels)

    def under(wheel, t):
        x, v, a = wheel.path(t)
        if not span[0] < x < span[1]:
            return None
        return *shapes(x), *profile(x), v, a

    def momentum(t, q):
        """Mass matrix, and the momentum at rest in modal coordinates."""
        matrix, rest = np.eye(n), np.zeros(n)
        for wheel in wheels:
            if (now := under(wheel, t)) is not None:
                s, slope, _, _, rise, _, v, _ = now
                matrix = matrix + wheel.mass * np.outer(s, s)
                rest = rest + wheel.mass * s * v * (slope @ q + rise)
        return matrix, rest

    def rate(t, state, start, stop):
        t = np.clip(t, start + SIDE, stop - SIDE)  # on the side of the leg
        q, u, z, dz = state[:n], state[n : 2 * n], state[2 * n :: 2], state[2 * n + 1 :: 2]
        force, matrix, bodies = -(frequencies**2) * q, np.eye(n), np.zeros(2 * count)
        for i, wheel in enumerate(wheels):
            if (now := under(wheel, t)) is None:
                s, spring = None, -wheel.spring * z[i] - wheel.damper * dz[i]
            else:
                s, slope, curve, height, rise, bend, v, a = now
                y, dy = s @ q + height, s @ u + v * (slope @ q + rise)
                spring = wheel.spring * (y - z[i]) + wheel.damper * (dy - dz[i])
                convective = 2 * v * slope @ u + v**2 * (curve @ q + bend) + a * (slope @ q + rise)
                force = force - s * (wheel.weight + wheel.mass * convective + spring)
                matrix = matrix + wheel.mass * np.outer(s, s)
            bodies[2 * i] = dz[i]
            bodies[2 * i + 1] = spring / wheel.body if wheel.body else 0.0
        return np.concatenate([u, np.linalg.solve(matrix, force), bodies])

    state, found = np.zeros(2 * n + 2 * count), np.zeros((2 * n, len(times)))
    limits = np.unique(np.concatenate([[0.0], events]))
    for start, stop in zip(limits[:-1], limits[1:], strict=True):
        inside = (times >= start) & (times < stop)
        solution = solve_ivp(
            rate, (start, stop), state, "DOP853", np.append(times[inside], stop),
            rtol=1e-9, atol=1e-12, args=(start, stop),
        )  # fmt: skip
        found[:, inside] = solution.y[: 2 * n, : inside.sum()]
        state = solution.y[:, -1].copy()
        before, after = (momentum(stop + side, state[:n]) for side in (-SIDE, SIDE))
        if before[0].trace() == n or after[0].trace() == n:
            continue  # entry and exit are without impact
        kept = before[0] @ state[n : 2 * n] + before[1]
        rates = np.linalg.solve(after[0], kept - after[1])
        if impulses is not None:
            impulses.append(rates - state[n : 2 * n])
        state[n : 2 * n] = rates
    return found
