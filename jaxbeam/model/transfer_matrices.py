"""Statics of beams by transfer matrices: deflection, axial force, buckling, settled supports.

Matrices along a beam that is not uniform are Chebyshev series. The state s = (w, phi, M, S) of a
section has the deflection, rotation, bending moment M = E I phi' and vertical force S = M' - T w',
which carries the shear force V = M' and the share of the axial force T. With the shear flexibility
c = 1 / kGA and g = 1 / (1 + c T),

    w' = g (phi - c S),    phi' = M / E I,    M' = S + T w',    S' = p - k w,

with the load p (upwards) per length and the foundation k. The system s' = A s is solved on each
part of an element by collocation; its transfer matrix Phi is symplectic.

The static equilibrium of a beam whose supports have settled gives a surface to wheels. A run starts
at rest in this equilibrium w_s(x). Equations of motion are linear, so that everything that moves is
measured from it; a wheel at x rolls over the settled surface, the profile r + w_s.
"""

import dataclasses
import functools
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import check_on_beam, concrete, is_concrete
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.sensors import SLOPE
from jaxbeam.case.validation import check_case
from jaxbeam.model.elements import (
    FOUNDATION,
    RIGIDITY,
    SHEAR,
    Layout,
    Sections,
    actuator_nodes,
    add_nodal_parts,
    assemble_sections,
    find_layout,
    kink_nodes,
    nodal_unknowns,
    sections,
)
from jaxbeam.numerics.polynomials import chebyshev_polynomials, piecewise_chebyshev, slope_jumps
from jaxbeam.runtime.arrays import Array, Module, add_at, set_at, solve, take, xp

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


class SettledBeam(Module):
    """Static fields of a beam on settled supports, between the nodes of its `transfer` matrices.

    `left_states` are the states (w, phi, M, S) at the left of each part, in beam units.
    """

    transfer: Transfer
    left_states: Float[Array, "part 4"]
    length: Float[Array, ""]

    def field(self, x, order: int = 0) -> Float[Array, "*position"]:
        """Field of an order (see `Modes.fields`) at positions x (m): 0 is the deflection w_s."""
        y = xp.asarray(x, float) / self.length
        states = piecewise_chebyshev(self.transfer.nodes, self._series(), y, (0,))[0]
        field = xp.sum(self.transfer.section(y).rows(order) * states, axis=-1)
        return field * self.length ** (1 - abs(order))  # SLOPE, of order -1, is w'

    def surface(
        self, below: AbstractProfile | None, kinks: tuple[int, ...] = ()
    ) -> "SettledSurface":
        """Surface of the beam with the profile of the road or track on it, and its `kinks`."""
        nodes = self.transfer.nodes * self.length
        return SettledSurface(below, nodes, self._series()[..., :1] * self.length, kinks)

    def _series(self) -> Float[Array, "part degree 4"]:
        parts, terms, _ = self.transfer.series.shape
        entries = self.transfer.series.reshape(parts, terms, 4, 4)
        return xp.einsum("pdij,pj->pdi", entries, self.left_states)


class SettledSurface(Module):
    """Height r + w_s of the surface of a settled beam; level with its ends before and behind it.

    Embankments settle with the ends. A slope w_s' at an end is that of a joint: wheels with mass
    enter without impact, as they do where the beam vibrates. `kink_nodes` are the inner nodes at
    which w_s' may jump.
    """

    below: AbstractProfile | None
    nodes: Float[Array, " node"] | None
    series: Float[Array, "part degree 1"] | None
    kink_nodes: tuple[int, ...] = eqx.field(static=True, default=())

    def heights(self, x):
        """Height (m), slope and curvature (1/m), as those of a profile.

        Raises RuntimeError where the load set was made without the layout of a traced case.
        """
        if self.nodes is None:
            raise RuntimeError("the surface of a settled beam needs the layout: load_set(case, it)")
        x = xp.asarray(x, float)
        start, end = self.nodes[0], self.nodes[-1]
        parts = piecewise_chebyshev(self.nodes, self.series, xp.clip(x, start, end), (0, 1, 2))
        height, slope, curvature = parts[..., 0]
        inside = (x >= start) & (x <= end)
        own = height, xp.where(inside, slope, 0.0), xp.where(inside, curvature, 0.0)
        if self.below is None:
            return own
        return tuple(a + b for a, b in zip(own, self.below.heights(x), strict=True))

    def kinks(self) -> Float[Array, " kink"]:
        """Positions (m) at which the slope or curvature of the profile jumps; nodes come anyway."""
        return xp.zeros(0) if self.below is None else self.below.kinks()

    def slope_kinks(self) -> tuple[Float[Array, " kink"], Float[Array, " kink"]]:
        """Positions (m) at which the slope jumps, and by how much, as those of a profile."""
        own = xp.zeros(0), xp.zeros(0)
        if self.kink_nodes and self.nodes is not None:
            index = np.array(self.kink_nodes)
            own = self.nodes[index], slope_jumps(self.nodes, self.series)[index - 1, 0]
        if self.below is None:
            return own
        parts = zip(own, self.below.slope_kinks(), strict=True)
        positions, jumps = (xp.concatenate(pair) for pair in parts)
        return positions, jumps


def has_settlement(case: Case) -> bool:
    """Whether a support of a case has a settlement."""
    return any(support.settlement is not None for support in case.supports)


def surface(case: Case, layout: Layout | None = None) -> Module | None:
    """Surface under the wheels of a case: its profile, and the settled beam; None if level."""
    if not has_settlement(case):
        return case.profile
    numbers = case.beam.length, *(support.position for support in case.supports)
    if layout is None and not all(map(is_concrete, numbers)):
        return SettledSurface(case.profile, None, None)
    layout = find_layout(case) if layout is None else layout
    parts = layout.parts or (1,) * len(layout.degrees)
    kinks = tuple(sum(parts[:node]) for node in kink_nodes(case, layout))
    return settled_beam(case, layout).surface(case.profile, kinks)


def settled_beam(case: Case, layout: Layout | None = None, settlements=None) -> SettledBeam:
    """Static equilibrium of a beam from settlements (support,) in m, by default those of the case.

    The foot of an elastic support settles, and its spring pulls. Patches settle with the beam;
    suspensions of actuators are without force afterwards. Displacements of the nodes that rigid
    supports prescribe move the others by K_ff d_f = -K_fh d_h + k s. `layout` (from `mesh_layout`)
    is needed where numbers of the case are traced.

    Raises ValueError for a beam of concrete numbers that is not held in place.
    """
    layout = find_layout(case) if layout is None else layout
    if settlements is None:
        settlements = [0.0 if s.settlement is None else s.settlement for s in case.supports]
    if not layout.parts:  # of a uniform beam, which needs no parts for its own statics
        elements = len(layout.degrees)
        layout = dataclasses.replace(layout, segments=(0,) * elements, parts=(1,) * elements)
    released = dataclasses.replace(
        layout, constrained=tuple((False, clamped) for _, clamped in layout.constrained)
    )
    system = nodal_system(case, released, suspended=False)
    unknowns, length = nodal_unknowns(case, released)[0], case.beam.length
    unit = length**3 / case.beam.bending_stiffness
    size = system.stiffness.shape[0]
    displacement, force, held = xp.zeros(size), xp.zeros(size), []
    for i, (node, (is_held, _)) in enumerate(zip(layout.nodes, layout.constrained, strict=True)):
        w = unknowns[i][0]
        here = [index - 2 for index in node if 2 <= index < 2 + len(case.supports)]
        for n in here:
            foot, stiffness = -settlements[n] / length, case.supports[n].stiffness
            if stiffness is None:
                displacement = set_at(displacement, w, foot)
            elif not is_held:
                force = set_at(force, w, force[w] + stiffness * unit * foot)
        if is_held:
            held.append(w)
    free = np.setdiff1d(np.arange(size), held)
    stiffness = system.stiffness[np.ix_(free, free)]
    checked = free.size > 0 and is_concrete(stiffness)
    if checked and np.linalg.eigvalsh(concrete(stiffness))[0] <= LEAST_STIFFNESS:
        raise ValueError(
            "supports settle, but do not hold the beam in place: clamp an end, or add supports"
        )
    right = force[free] - system.stiffness[np.ix_(free, held)] @ displacement[np.array(held, int)]
    displacement = set_at(displacement, free, solve(stiffness, right))
    padded = xp.concatenate([displacement, xp.zeros(1)])  # -1: no displacement
    at_ends = padded[system.unknowns]
    left, over = at_ends[:, :2, None], at_ends[:, 2:, None]
    across = system.transfer.across()
    forces = system.force_of_deflection @ (over - across[:, :2, :2] @ left)
    states = xp.concatenate([left, forces], axis=1)[..., 0]
    return SettledBeam(system.transfer, states, length)


@checks_classes
def settlement_response(
    case: Case, settlements, x, derivative: int = 0
) -> Float[Array, "*position"]:
    """Static deflection (m, positive upwards) at x (m) from settlements of the supports.

    `settlements` (support,) in m, positive downwards, are those of the `supports` of the case,
    rigid or elastic, in place of their own; an end settles as a rigid support at its position.
    `derivative` is that of `influence_line`: with 2, times the bending stiffness, it is a bending
    moment. Differentiable in settlements and stiffnesses; positions of supports must be concrete.

    Raises ValueError as `influence_line` does, and for a number of settlements other than that of
    the supports.

    >>> import jaxbeam as jb
    >>> two_spans = jb.Case(
    ...     jb.Beam(length=4.0, flexural_rigidity=6.0, mass_per_length=1.0), [jb.Support(2.0)]
    ... )
    >>> curvature = jb.statics.settlement_response(two_spans, [0.1], x=2.0, derivative=2)
    >>> print(f"{6.0 * curvature:.3f} N m")  # 3 E I s / l^2
    0.450 N m
    """
    check_case(case)
    x, settlements = xp.asarray(x, float), xp.asarray(settlements, float)
    check_on_beam("x", x, case.beam.length)
    if settlements.shape != (len(case.supports),):
        raise ValueError(
            f"settlements must be one for each of the {len(case.supports)} supports; their shape"
            f" is {settlements.shape}"
        )
    return settled_beam(case, settlements=settlements).field(x, derivative)
