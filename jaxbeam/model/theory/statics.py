"""Statics of beams by transfer matrices: deflection, axial force and buckling."""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.model.layout import Layout, actuator_nodes
from jaxbeam.model.theory.elements import (
    add_nodal_parts,
    assemble_sections,
    nodal_unknowns,
    sections,
)
from jaxbeam.model.theory.transfer import SYMPLECTIC, Transfer, transfer
from jaxbeam.runtime.arrays import Array, add_at, solve, take, xp
from jaxbeam.runtime.module import Module

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
    """States at the left nodes that would become the jumps at their positions: Phi^-1 jump."""
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
