"""Statics of beams by transfer matrices: deflection, axial force and buckling.

Matrices along a beam that is not uniform are Chebyshev series.
The state s = (w, phi, M, S) of a section has the deflection, rotation, bending moment M = E I phi'
and vertical force S = M' - T w', which carries the shear force V = M' and the share of the axial
force T. With the shear flexibility c = 1 / kGA and g = 1 / (1 + c T),

    w' = g (phi - c S),    phi' = M / E I,    M' = S + T w',    S' = p - k w,

with the load p (upwards) per length and the foundation k. The system s' = A s is solved on each
part of an element by collocation; its transfer matrix Phi is symplectic.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.case.quantities import SLOPE
from jaxbeam.model.layout import Layout, actuator_nodes
from jaxbeam.model.theory.elements import (
    FOUNDATION,
    RIGIDITY,
    SHEAR,
    Sections,
    add_nodal_parts,
    assemble_sections,
    nodal_unknowns,
    sections,
)
from jaxbeam.numerics.polynomials import chebyshev_polynomials, piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, add_at, solve, take, xp
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
        """Stiffness, shear flexibility and axial force of the sections at positions x (in L)."""
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
    """Chebyshev points, and matrices of integration from -1 of a function given there.

    The first takes values to the integral at the points, the second to its Chebyshev series.
    """
    points = chebyshev.chebpts1(POINTS)
    to_series = np.linalg.inv(chebyshev.chebvander(points, POINTS - 1))
    integral = chebyshev.chebint(to_series, lbnd=-1)
    return points, chebyshev.chebvander(points, POINTS) @ integral, integral


def transfer(sections: Sections, layout: Layout) -> Transfer:
    """Transfer matrices of a beam: s(x) = s_0 + int A s, at the points of the collocation."""
    nodes = []
    for i, parts in enumerate(layout.parts):
        fractions = np.arange(parts) / parts
        nodes.append(sections.nodes[i] + fractions * (sections.nodes[i + 1] - sections.nodes[i]))
    nodes = xp.concatenate([*nodes, sections.nodes[-1:]])
    points, values, integral = _integration()
    half_lengths = xp.diff(nodes) / 2
    elements = np.repeat(np.arange(len(layout.parts)), layout.parts)
    first, last = sections.nodes[elements], sections.nodes[elements + 1]
    x = nodes[:-1, None] + half_lengths[:, None] * (points + 1)
    local = 2 * (x - first[:, None]) / (last - first)[:, None] - 1
    table = chebyshev_polynomials(local, sections.series.shape[1])
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


NO_FORCE = 1e-6  # of E I / L^2: a critical force below this is that of a rigid body
RIGID_BODY_SHIFT = 1e-10  # of the mass matrix: makes the stiffness of a free beam invertible


def check_buckling(case: Case, layout: Layout) -> None:
    """Check that the axial force does not make the beam buckle.

    Raises ValueError, with the critical force.
    """
    force = case.beam.axial_force
    if force is None or not float(concrete(force)) < 0:
        return
    critical = critical_axial_force(concrete_case(case), layout)
    if critical > -NO_FORCE * float(concrete(case.beam.bending_stiffness / case.beam.length**2)):
        raise ValueError(
            f"beam.axial_force is {float(concrete(force)):g} N, but the beam ({case.beam.ends}) can"
            " turn as a rigid body, so that any compression makes it buckle: hold it, or leave the"
            " compression out"
        )
    if float(concrete(force)) <= critical:
        raise ValueError(
            f"beam.axial_force is {float(concrete(force)):g} N, but the beam buckles at"
            f" {critical:.6g} N (compression is negative): reduce it, or hold the beam"
        )


def critical_axial_force(case: Case, layout: Layout) -> float:
    """Axial force (N) at which the beam buckles, negative; suspensions of actuators left out.

    K_0 x = -T G x, with the stiffness K_0 without axial force and G = int w'^2.
    """
    found = sections(case, layout)
    matrices = []
    for axial_force in (0.0, 1.0):
        changed = eqx.tree_at(lambda s: s.axial_force, found, xp.asarray(axial_force))
        stiffness, mass, *_ = assemble_sections(case, layout, changed)
        matrices.append(np.asarray(stiffness))
    stiffness = matrices[0] + RIGID_BODY_SHIFT * np.asarray(mass)
    factor = np.linalg.inv(np.linalg.cholesky(stiffness))
    largest = np.linalg.eigvalsh(factor @ (matrices[1] - matrices[0]) @ factor.T)[-1]
    unit = float(case.beam.bending_stiffness) / float(case.beam.length) ** 2
    return -unit / float(largest)


# Signs of the entries (S, -M) of nodal forces in (M, S), so that work is w P + phi C.
TO_FORCES = np.array([[0.0, 1.0], [-1.0, 0.0]])
LEAST_STIFFNESS = 1e-8  # of a supported beam, in E I / L^3


class SectionFlexibility(Module):
    """Fields of the beam under unit sources, to be evaluated at any position y (see `Flexibility`).

    `left_states` are the states at the left node of each part under each source; source i makes the
    state jump by `jumps` at its position.
    """

    transfer: Transfer
    left_states: Float[Array, "part 4 source"]
    positions: Float[Array, " source"]
    jumps: Float[Array, "source 4"]

    @property
    def breakpoints(self) -> Float[Array, " breakpoint"]:
        """Positions (in L) between which the fields are smooth."""
        return xp.concatenate([self.transfer.nodes, self.positions])

    def __call__(
        self, y: Float[Array, "*position"], derivative: int = 0
    ) -> Float[Array, "*position source"]:
        """Field of an order (see `Modes.fields`) at positions y (in L) under each source."""
        matrices, part = self.transfer.to(y), self.transfer.part_of(y)
        row = (self.transfer.section(y).rows(derivative)[..., None, :] @ matrices)[..., 0, :]
        nodal = (row[..., None, :] @ take(self.left_states, part))[..., 0, :]
        started = _started(self.transfer, self.positions, self.jumps)
        beyond = (y[..., None] > self.positions) & (
            part[..., None] == self.transfer.part_of(self.positions)
        )
        return nodal + xp.where(beyond, row @ started.T, 0.0)


def _started(transfer: Transfer, positions, jumps) -> Float[Array, "source 4"]:
    """States at the left nodes that the transfer matrices carry to the jumps: Phi^-1 jump."""
    inverse = SYMPLECTIC.T @ xp.swapaxes(transfer.to(positions), -1, -2) @ SYMPLECTIC
    return (inverse @ jumps[..., None])[..., 0]


class NodalSystem(NamedTuple):
    """Stiffness of the nodal unknowns, and the parts that it was assembled from."""

    transfer: Transfer
    stiffness: Float[Array, "unknown unknown"]
    unknowns: Float[np.ndarray, "part 4"]
    force_of_deflection: Float[Array, "part 2 2"]


def nodal_system(case: Case, layout: Layout, suspended: bool = True) -> NodalSystem:
    """Stiffness matrix of nodes, supports and, if `suspended`, suspensions, in beam units.

    Across a part d_2 = A_11 d_1 + A_12 f_1 with d = (w, phi) and f = (M, S), so that
    f_1 = A_12^-1 (d_2 - A_11 d_1) and f_2 = A_21 d_1 + A_22 f_1.
    """
    across = transfer(sections(case, layout), layout)
    matrices, (unknowns, size) = across.across(), _part_unknowns(case, layout)
    a11, a12 = matrices[:, :2, :2], matrices[:, :2, 2:]
    a21, a22 = matrices[:, 2:, :2], matrices[:, 2:, 2:]
    inverse = xp.linalg.inv(a12)
    blocks = xp.block(
        [
            [-TO_FORCES @ inverse @ a11, TO_FORCES @ inverse],
            [-TO_FORCES @ (a21 - a22 @ inverse @ a11), -TO_FORCES @ a22 @ inverse],
        ]
    )
    stiffness = xp.zeros((size, size))
    for i, index in enumerate(unknowns):
        free = np.flatnonzero(index >= 0)
        stiffness = add_at(
            stiffness, np.ix_(index[free], index[free]), blocks[i][np.ix_(free, free)]
        )
    main, _ = nodal_unknowns(case, layout)
    stiffness, _ = add_nodal_parts(case, layout, main, stiffness, None)
    if suspended:
        rows, suspensions = suspension_rows(case, layout, size)
        stiffness = stiffness + rows.T @ (suspensions[:, None] * rows)
    return NodalSystem(across, (stiffness + stiffness.T) / 2, unknowns, inverse)


def _part_unknowns(case: Case, layout: Layout):
    """Unknowns (part, 4), w and phi at the left and the right of each part; their number."""
    main, size = nodal_unknowns(case, layout)
    parts = []
    for i, count in enumerate(layout.parts):
        left = (main[i][0], main[i][2])
        for _ in range(count - 1):
            parts.append((*left, size, size + 1))
            left, size = (size, size + 1), size + 2
        parts.append((*left, main[i + 1][0], main[i + 1][1]))
    return np.array(parts), size


def suspension_rows(case: Case, layout: Layout, size: int):
    """Rows (actuator, unknown) of the displacements of actuators, and their stiffness, in L."""
    main, _ = nodal_unknowns(case, layout)
    length, unit = case.beam.length, case.beam.length**3 / case.beam.bending_stiffness
    nodes = iter(actuator_nodes(case, layout))
    rows = xp.zeros((len(case.actuators), size))
    for i, actuator in enumerate(case.actuators):
        for _, order, factor in actuator.displacement_map():
            unknown = main[next(nodes)][2 if order == 1 else 0]
            if unknown >= 0:
                rows = add_at(rows, (i, unknown), factor / length**order)
    stiffness = [actuator.attachment().stiffness * unit for actuator in case.actuators]
    return rows, xp.array(stiffness).reshape(-1)


def section_flexibility(
    case: Case, layout: Layout, x: Float[Array, " position"], order: int
) -> SectionFlexibility:
    """Flexibility for unit sources at positions x (m), dual to the field of an order there."""
    system = nodal_system(case, layout)
    across, positions = system.transfer, x / case.beam.length
    jumps = across.section(positions).sources(order)
    matrices, part = across.across(), across.part_of(positions)
    in_part = xp.where(part == np.arange(matrices.shape[0])[:, None], 1.0, 0.0)
    started = _started(across, positions, jumps)
    arrived = in_part[:, None, :] * (matrices @ started.T)  # at the right nodes: (part, 4, source)
    inverse, a22 = system.force_of_deflection, matrices[:, 2:, 2:]
    at_left = TO_FORCES @ inverse @ arrived[:, :2]
    at_right = TO_FORCES @ (arrived[:, 2:] - a22 @ inverse @ arrived[:, :2])
    forces = xp.concatenate([at_left, at_right], axis=1)
    right = xp.zeros((system.stiffness.shape[0], x.shape[0]))
    for i, index in enumerate(system.unknowns):
        free = np.flatnonzero(index >= 0)
        right = add_at(right, index[free], forces[i][free])
    found = solve(system.stiffness, right)
    padded = xp.concatenate([found, xp.zeros((1, x.shape[0]))])  # -1: no displacement
    displacements = padded[system.unknowns]
    d1, d2 = displacements[:, :2], displacements[:, 2:]
    f1 = inverse @ (d2 - matrices[:, :2, :2] @ d1 - arrived[:, :2])
    return SectionFlexibility(across, xp.concatenate([d1, f1], axis=1), positions, jumps)


def is_held(case: Case, layout: Layout) -> bool:
    """Whether supports, foundation and suspensions resist every motion; numbers are concrete."""
    stiffness = np.asarray(nodal_system(case, layout).stiffness)
    return not stiffness.size or bool(np.linalg.eigvalsh(stiffness)[0] > LEAST_STIFFNESS)
