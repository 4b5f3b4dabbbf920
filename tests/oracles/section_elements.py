"""Finite elements of a beam of any section, flexible in shear, and its crossing by a load.

Two nodes with deflection and rotation each; the shape functions are those of a uniform element
without load (Przemieniecki's with the shear parameter 12 E I / (kGA l^2)), the matrices integrals
of the true properties over them. With shear the error is of second order in the element length.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh

from tests.oracles.closed_forms import ShootingBeam

HELD = {"pinned": (0,), "clamped": (0, 1), "free": (), "guided": (1,)}


def element_shapes(s: float, length: float, parameter: float) -> np.ndarray:
    """Rows of w, w', phi, phi' on the nodal values at s = x / length."""
    d, p = 1 + parameter, parameter
    w = [
        (1 - 3 * s**2 + 2 * s**3 + p * (1 - s)) / d,
        length * (s - 2 * s**2 + s**3 + p * (s - s**2) / 2) / d,
        (3 * s**2 - 2 * s**3 + p * s) / d,
        length * (-(s**2) + s**3 - p * (s - s**2) / 2) / d,
    ]
    slope = [
        (-6 * s + 6 * s**2 - p) / (d * length),
        (1 - 4 * s + 3 * s**2 + p * (1 - 2 * s) / 2) / d,
        (6 * s - 6 * s**2 + p) / (d * length),
        (-2 * s + 3 * s**2 - p * (1 - 2 * s) / 2) / d,
    ]
    rotation = [
        6 * (s**2 - s) / (d * length),
        (1 - 4 * s + 3 * s**2 + p * (1 - s)) / d,
        6 * (s - s**2) / (d * length),
        (-2 * s + 3 * s**2 + p * s) / d,
    ]
    curvature = [
        6 * (2 * s - 1) / (d * length**2),
        (-4 + 6 * s - p) / (d * length),
        6 * (1 - 2 * s) / (d * length**2),
        (-2 + 6 * s + p) / (d * length),
    ]
    return np.array([w, slope, rotation, curvature])


def modes(
    beam: ShootingBeam,
    count: int,
    elements: int,
    springs: tuple[tuple[int, float, float], ...] = (),
    hinges: tuple[tuple[int, float], ...] = (),
) -> tuple[np.ndarray, list[Callable], Callable]:
    """Circular frequencies, splines of w between breaks, and the mass-normalised nodal shapes.

    `springs` are (node, stiffness, mass), of hinges (node, rotational stiffness).
    """
    nodes = np.linspace(0, beam.length, elements + 1)
    unknowns, extra = 2 * nodes.size + len(hinges), {}
    for i, (node, _) in enumerate(hinges):
        extra[node] = 2 * nodes.size + i
    stiffness, mass = np.zeros((unknowns, unknowns)), np.zeros((unknowns, unknowns))
    points, weights = np.polynomial.legendre.leggauss(5)
    for e in range(elements):
        length = nodes[e + 1] - nodes[e]
        middle = (nodes[e] + nodes[e + 1]) / 2
        parameter = 12 * beam.rigidity(middle) * beam.shear_flexibility(middle) / length**2
        index = [2 * e, extra.get(e, 2 * e + 1), 2 * e + 2, 2 * e + 3]
        for point, weight in zip((points + 1) / 2, weights / 2 * length, strict=True):
            x = nodes[e] + point * length
            w, slope, rotation, curvature = element_shapes(point, length, parameter)
            parts = beam.rigidity(x) * np.outer(curvature, curvature)
            parts += beam.axial * np.outer(slope, slope) + beam.foundation * np.outer(w, w)
            if beam.shear_flexibility(x):
                shear = slope - rotation
                parts += np.outer(shear, shear) / beam.shear_flexibility(x)
            stiffness[np.ix_(index, index)] += weight * parts
            inertia = beam.mass(x) * np.outer(w, w) + beam.rotary(x) * np.outer(rotation, rotation)
            mass[np.ix_(index, index)] += weight * inertia
    for node, spring, lumped in springs:
        stiffness[2 * node, 2 * node] += spring
        mass[2 * node, 2 * node] += lumped
    for (node, spring), other in zip(hinges, extra.values(), strict=True):
        pair = np.ix_([2 * node + 1, other], [2 * node + 1, other])
        stiffness[pair] += spring * np.array([[1, -1], [-1, 1]])
    left, right = beam.ends.split("-")
    held = [*HELD[left], *(2 * elements + i for i in HELD[right])]
    free = np.setdiff1d(np.arange(unknowns), held)
    values, vectors = eigh(stiffness[np.ix_(free, free)], mass[np.ix_(free, free)])
    shapes = np.zeros((unknowns, count))
    shapes[free] = vectors[:, :count]
    return np.sqrt(values[:count]), nodes, shapes[: 2 * nodes.size : 2]


def crossing(
    frequencies, nodes, shapes, times, speed: float, weight: float, mass: float, x: float
) -> np.ndarray:
    """Deflection at x at some times under one load that enters at zero, by DOP853."""
    spline = CubicSpline(nodes, shapes)
    count = frequencies.size

    def rate(t, state):
        q, rates = state[:count], state[count:]
        place = min(speed * t, nodes[-1])
        row, slope, curve = (spline(place, n) for n in range(3))
        convective = 2 * speed * slope @ rates + speed**2 * curve @ q
        right = -(frequencies**2) * q - row * (weight + mass * convective)
        accelerations = right - mass * row * (row @ right) / (1 + mass * row @ row)
        return np.concatenate([rates, accelerations])

    solution = solve_ivp(
        rate, (0, times[-1]), np.zeros(2 * count), "DOP853", times, rtol=1e-10, atol=1e-13
    )
    return spline(x) @ solution.y[:count]
