"""St Venant torsion: twist theta of the sections of a beam about its axis, of its shear centres.

    G J theta'' + m_t = I theta_tt + m e w_tt,    torque T = G J theta',

with torques m_t, the mass moment of inertia I, both per length, and the eccentricity e of the mass
m, which moves by w + e theta (so that the beam's own m w_tt has m e theta_tt beside it). Twist is
about x, from y, left of the axis looking along x, to z, upwards: the deflection of a point at the
distance y is w + y theta, and a force F upwards there twists by F y. Held are ends and rigid
supports, as by forks; hinges transmit the torque. Warping is free.

The modes are those of a Ritz expansion in polynomials between the nodes of the layout, as of
bending, in the same units. Statics is exact: the twist under a torque is linear between nodes.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev, legendre

from jaxbeam.case.case import Case
from jaxbeam.case.sensors import NO_TORSION, TWIST
from jaxbeam.model.elements import Layout, node_positions
from jaxbeam.numerics.polynomials import legendre_to_chebyshev
from jaxbeam.runtime.arrays import Array, Module, add_at, set_at, take, xp


def _holds(case: Case, layout: Layout) -> tuple[list[bool], list[tuple[int, Array]]]:
    """Whether the twist of each node is held, and pairs of a node and a spring on it (N m/rad)."""
    held, springs = [], []
    for i, (node, (deflection, _)) in enumerate(zip(layout.nodes, layout.constrained, strict=True)):
        here = [case.supports[k - 2] for k in node if 2 <= k < 2 + len(case.supports)]
        rigid = [one for one in here if one.stiffness is None]
        at_end = deflection and not rigid
        held.append(at_end or any(one.torsional_stiffness is None for one in rigid))
        springs += [(i, k) for one in here if (k := one.torsional_stiffness) is not None]
    return held, springs


@functools.cache
def _element(degree: int):
    """Chebyshev series of the shape functions of an element, their mass and stiffness matrices.

    Two linear functions, then integrals of Legendre polynomials, which vanish at both ends.
    """
    basis = np.zeros((degree + 1, degree + 1))
    basis[:2, :2] = [[0.5, 0.5], [-0.5, 0.5]]
    for k in range(2, degree + 1):
        basis[[k, k - 2], k] = np.array([1.0, -1.0]) / np.sqrt(2 * (2 * k - 1))
    weights = 2 / (2 * np.arange(degree + 1) + 1)
    slopes = legendre.legder(basis)
    mass = basis.T @ (weights[:, None] * basis)
    stiffness = slopes.T @ (weights[:degree, None] * slopes)
    return legendre_to_chebyshev(degree + 1) @ basis, mass, stiffness


class TorsionMatrices(NamedTuple):
    """Stiffness and mass of the unknowns of the twist, and their Chebyshev series, in beam units.

    `coupling` is the mass between the unknowns of bending and those; None without eccentricity.
    """

    stiffness: Float[Array, "unknown unknown"]
    mass: Float[Array, "unknown unknown"]
    series: Float[Array, "segment degree unknown"]
    coupling: Float[Array, "bending unknown"] | None


def torsion_matrices(
    case: Case, layout: Layout, nodes, bending_series: Float[Array, "segment degree bending"], mass
) -> TorsionMatrices:
    """Stiffness, mass and coupling of the twist on the nodes (in L) of the bending elements.

    `mass` is a function of an element and of positions in it (-1 to 1): the mass per length over
    its mean.
    """
    beam, degrees = case.beam, layout.degrees
    held, springs = _holds(case, layout)
    number = np.where(held, -1, np.cumsum(~np.array(held)) - 1)
    size = int(number.max(initial=-1)) + 1
    total, terms = size + sum(degree - 1 for degree in degrees), bending_series.shape[1]
    rigidity = beam.torsional_rigidity / beam.bending_stiffness
    inertia = beam.polar_inertia / (beam.linear_density * beam.length**2)
    stiffness, inertias, series = xp.zeros((total, total)), xp.zeros((total, total)), []
    eccentric = beam.mass_eccentricity is not None
    coupling = xp.zeros((bending_series.shape[2], total)) if eccentric else None
    for i, degree in enumerate(degrees):
        half = (nodes[i + 1] - nodes[i]) / 2
        index = np.array([number[i], number[i + 1], *range(size, size + degree - 1)])
        size += degree - 1
        free = np.flatnonzero(index >= 0)
        to_series, of_mass, of_stiffness = _element(degree)
        # Bubbles of half the length have as much strain energy with the root of it as a factor.
        scale = xp.concatenate([np.ones(2), xp.broadcast_to(xp.sqrt(half), (degree - 1,))])[free]
        block, pairs = np.ix_(free, free), np.ix_(index[free], index[free])
        scales = scale[:, None] * scale
        stiffness = add_at(stiffness, pairs, of_stiffness[block] * scales * rigidity / half)
        inertias = add_at(inertias, pairs, of_mass[block] * scales * inertia * half)
        rows = np.ix_(np.arange(degree + 1), index[free])
        series.append(set_at(xp.zeros((terms, total)), rows, to_series[:, free] * scale))
        if eccentric:
            points, weights = legendre.leggauss(terms + 1)
            table = chebyshev.chebvander(points, terms - 1)
            weighted = (weights * mass(i, points))[:, None] * (table @ series[-1])
            coupling = coupling + half * (table @ bending_series[i]).T @ weighted
    for node, spring in springs:
        if not held[node]:
            at = (number[node], number[node])
            stiffness = add_at(stiffness, at, spring * beam.length / beam.bending_stiffness)
    if eccentric:
        coupling = coupling * beam.mass_eccentricity / beam.length
    return TorsionMatrices(stiffness, inertias, xp.stack(series), coupling)


class TwistFlexibility(Module):
    """Static twist, or its rate, at points x under a unit torque anywhere; positions in L.

    In the units of `flexibility`. `at_nodes` (point, node) are those under torques at the `nodes`,
    between which they are linear, and beyond the kink or jump at x itself.
    """

    nodes: Float[Array, " node"]
    points: Float[Array, " point"]
    at_nodes: Float[Array, "point node"]
    rigidity: Float[Array, ""]
    order: int = eqx.field(static=True)

    @property
    def breakpoints(self) -> Float[Array, " breakpoint"]:
        """Positions (in L) between which the influence is linear."""
        return xp.concatenate([self.nodes, self.points])

    def __call__(self, y: Float[Array, "*position"]) -> Float[Array, "*position point"]:
        """Twist or rate at each point under a unit torque at positions y (in L)."""
        nodes, inner = self.nodes, self.nodes[1:-1]
        element = xp.sum(y[..., None] >= inner, axis=-1)
        left, right = take(nodes, element), take(nodes, element + 1)
        fraction = ((y - left) / (right - left))[..., None]
        table = self.at_nodes.T
        linear = (1 - fraction) * take(table, element) + fraction * take(table, element + 1)
        of_points = xp.sum(self.points[:, None] >= inner, axis=-1)
        y, left, right = y[..., None], left[..., None], right[..., None]
        if self.order == TWIST:
            low, high = xp.minimum(y, self.points), xp.maximum(y, self.points)
            inside = (low - left) * (right - high)
        else:
            inside = xp.where(self.points < y, right - y, left - y)
        inside = inside / ((right - left) * self.rigidity)
        return linear + xp.where(element[..., None] == of_points, inside, 0.0)


def twist_flexibility(
    case: Case, layout: Layout, x: Float[Array, " position"], order: int
) -> TwistFlexibility:
    """Influence of torques on the twist (order TWIST) or its rate (TWIST_RATE) at x (m).

    Raises ValueError for a beam that does not twist.
    """
    beam = case.beam
    if not beam.twists:
        raise ValueError(NO_TORSION)
    positions = xp.stack([place / beam.length for place in node_positions(case)])
    nodes = positions[np.array([node[0] for node in layout.nodes])]
    held, springs = _holds(case, layout)
    rigidity, count = beam.torsional_rigidity / beam.bending_stiffness, len(held)
    stiffness = xp.zeros((count, count))
    for i in range(count - 1):
        pair = np.ix_([i, i + 1], [i, i + 1])
        own = rigidity / (nodes[i + 1] - nodes[i]) * np.array([[1.0, -1.0], [-1.0, 1.0]])
        stiffness = add_at(stiffness, pair, own)
    for node, spring in springs:
        stiffness = add_at(stiffness, (node, node), spring * beam.length / beam.bending_stiffness)
    points, free = x / beam.length, np.flatnonzero(~np.array(held))
    element = xp.sum(points[:, None] >= nodes[1:-1], axis=-1)
    width = take(nodes, element + 1) - take(nodes, element)
    fraction = (points - take(nodes, element)) / width
    at_ends = (1 - fraction, fraction) if order == TWIST else (-1 / width, 1 / width)
    rows = xp.zeros((x.shape[0], count))
    for end, values in enumerate(at_ends):
        hit = (element[:, None] + end) == np.arange(count)
        rows = rows + xp.where(hit, values[:, None], 0.0)
    at_nodes = xp.zeros((x.shape[0], count))
    if free.size:
        solved = xp.linalg.solve(stiffness[np.ix_(free, free)], rows[:, free].T).T
        at_nodes = set_at(at_nodes, np.s_[:, free], solved)
    return TwistFlexibility(nodes, points, at_nodes, rigidity, order)
