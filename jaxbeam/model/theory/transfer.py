"""Static transfer matrices along a beam that is not uniform, as Chebyshev series.

The state s = (w, phi, M, S) of a section has the deflection, rotation, bending moment M = E I phi'
and vertical force S = M' - T w', which carries the shear force V = M' and the share of the axial
force T. With the shear flexibility c = 1 / kGA and g = 1 / (1 + c T),

    w' = g (phi - c S),    phi' = M / E I,    M' = S + T w',    S' = p - k w,

with the load p (upwards) per length and the foundation k. The system s' = A s is solved on each
part of an element by collocation; its transfer matrix Phi is symplectic.
"""

import functools
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from jaxbeam.model.layout import Layout
from jaxbeam.model.theory.elements import FOUNDATION, RIGIDITY, SHEAR, SLOPE, Sections
from jaxbeam.numerics.piecewise import piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, solve, xp
from jaxbeam.runtime.module import Module

POINTS = 24  # of the collocation: exact to rounding on the parts that a layout has
SYMPLECTIC = np.array([[0, 0, 0, 1], [0, 0, -1, 0], [0, 1, 0, 0], [-1, 0, 0, 0]], float)


class Transfer(Module):
    """Transfer matrices Phi(x) from the left node of each part to x, in beam units.

    `nodes` (in L) are those between the parts; `series` are Chebyshev series of the 16 entries.
    """

    sections: Sections
    nodes: Float[Array, " node"]
    series: Float[Array, "part degree entry"]

    def to(self, x: Float[Array, "*position"]) -> Float[Array, "*position 4 4"]:
        """Transfer matrix from the left node of the part of x to x."""
        return piecewise_chebyshev(self.nodes, self.series, x, (0,))[0].reshape(*x.shape, 4, 4)

    def part_of(self, x):
        """Index of the part in which each position lies; at a node, the part to its right."""
        return xp.sum(x[..., None] >= self.nodes[1:-1], axis=-1)

    def across(self) -> Float[Array, "part 4 4"]:
        """Transfer matrices across the parts."""
        return xp.sum(self.series, axis=1).reshape(-1, 4, 4)

    def section(self, x) -> "Section":
        """Coefficients at positions x."""
        values = self.sections.at(x)
        shear = 1 / values[..., SHEAR] if self.sections.shear_flexible else xp.zeros(x.shape)
        return Section(values[..., RIGIDITY], shear, self.sections.axial_force)


class Section(NamedTuple):
    """Bending stiffness, shear flexibility c and axial force T of sections, in beam units."""

    rigidity: Float[Array, "*position"]
    shear: Float[Array, "*position"]
    axial_force: Float[Array, ""]

    @property
    def gain(self) -> Float[Array, "*position"]:
        """Factor g = 1 / (1 + c T) of the slope."""
        return 1 / (1 + self.shear * self.axial_force)

    def rows(self, order: int) -> Float[Array, "*position 4"]:
        """Row from a state to a field: see `Modes.fields` for the orders."""
        one, zero = xp.ones_like(self.rigidity), xp.zeros_like(self.rigidity)
        slope = [zero, self.gain, zero, -self.shear * self.gain]
        row = {
            0: [one, zero, zero, zero],
            1: [zero, one, zero, zero],
            2: [zero, zero, 1 / self.rigidity, zero],
            3: [
                zero,
                self.axial_force * self.gain / self.rigidity,
                zero,
                self.gain / self.rigidity,
            ],
            SLOPE: slope,
        }[order]
        return xp.stack(row, axis=-1)

    def sources(self, order: int) -> Float[Array, "*position 4"]:
        """Jump of the state at a unit source, dual to a field: its row times the symplectic form.

        Of order 0 a force, of order 1 a couple, of order 2 and 3 kinks and steps of the deflection,
        by the theorem of Mueller-Breslau.
        """
        return self.rows(order) @ SYMPLECTIC


@functools.cache
def _integration() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points; integrals from -1 as values there, and as Chebyshev coefficients, from values."""
    points = chebyshev.chebpts1(POINTS)
    to_series = np.linalg.inv(chebyshev.chebvander(points, POINTS - 1))
    integral = chebyshev.chebint(to_series, lbnd=-1)
    return points, chebyshev.chebvander(points, POINTS) @ integral, integral


def transfer(sections: Sections, layout: Layout) -> Transfer:
    """Transfer matrices of a beam: s(x) = s_0 + int A s, at the points of the collocation."""
    nodes = []
    for i, parts in enumerate(layout.parts):
        shares = np.arange(parts) / parts
        nodes.append(sections.nodes[i] + shares * (sections.nodes[i + 1] - sections.nodes[i]))
    nodes = xp.concatenate([*nodes, sections.nodes[-1:]])
    points, values, integral = _integration()
    half_lengths = xp.diff(nodes) / 2
    elements = np.repeat(np.arange(len(layout.parts)), layout.parts)
    first, last = sections.nodes[elements], sections.nodes[elements + 1]
    x = nodes[:-1, None] + half_lengths[:, None] * (points + 1)
    local = 2 * (x - first[:, None]) / (last - first)[:, None] - 1
    table = _chebyshev_table(local, sections.series.shape[1])
    at_points = xp.einsum("pjd,pdk->pjk", table, sections.series[elements])
    A = _matrices(sections, at_points)
    operator = half_lengths[:, None, None, None, None] * xp.einsum("ij,pjab->piajb", values, A)
    size = 4 * POINTS
    system = xp.eye(size) - operator.reshape(-1, size, size)
    start = xp.broadcast_to(np.tile(np.eye(4), (POINTS, 1)), (nodes.shape[0] - 1, size, 4))
    states = solve(system, start).reshape(-1, POINTS, 4, 4)
    rates = half_lengths[:, None, None, None] * xp.einsum("pjab,pjbc->pjac", A, states)
    series = xp.einsum("dj,pjac->pdac", integral, rates)
    unit = np.zeros((POINTS + 1, 4, 4))
    unit[0] = np.eye(4)
    return Transfer(sections, nodes, (series + unit).reshape(-1, POINTS + 1, 16))


def _chebyshev_table(local, terms: int):
    """Chebyshev polynomials below a degree at local positions, along a new last axis."""
    table = [xp.ones_like(local), local]
    while len(table) < terms:
        table.append(2 * local * table[-1] - table[-2])
    return xp.stack(table[:terms], axis=-1)


def _matrices(sections: Sections, values) -> Float[Array, "part point 4 4"]:
    """Matrices A of s' = A s, from the properties of sections."""
    shear = xp.zeros(values.shape[:-1])
    if sections.shear_flexible:
        shear = 1 / values[..., SHEAR]
    found = Section(values[..., RIGIDITY], shear, sections.axial_force)
    slope, zero = found.rows(SLOPE), xp.zeros(shear.shape)
    vertical = np.array([0.0, 0.0, 0.0, 1.0])
    rows = [
        slope,
        found.rows(2),
        vertical + sections.axial_force * slope,
        xp.stack([-values[..., FOUNDATION], zero, zero, zero], axis=-1),
    ]
    return xp.stack(rows, axis=-2)
