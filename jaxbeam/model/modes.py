"""Natural frequencies, mode shapes and damping of a supported beam; shapes are mass-normalised.

One method serves every end condition, any number of spans, rigid and elastic supports and bonded
patches: a Ritz expansion in polynomials of high degree, one series for each segment between
supports and patch edges, with continuous deflection and slope. It converges faster than any power
of the degree; frequencies have a relative error of about 1e-11. Rigid supports remove a degree of
freedom instead of adding a penalty, and springs of any stiffness enter through a Cholesky factor,
so neither costs accuracy. The problem is solved in beam units (length L, mass m L, stiffness E I /
L^3), so beams that differ only in those share one solution. Beams that are not uniform have their
elements in `model.elements`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float
from numpy.polynomial import legendre

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.beam import MATERIALS, Beam
from jaxbeam.case.case import Case
from jaxbeam.case.fields import refuses_traced
from jaxbeam.case.sensors import NO_TORSION, SLOPE, TWIST, TWIST_RATE
from jaxbeam.case.validation import check_plant
from jaxbeam.model.elements import (
    MASS,
    RIGIDITY,
    SHEAR,
    FieldParts,
    Layout,
    Sections,
    assemble_sections,
    bending_basis,
    find_layout,
    is_uniform,
    longest_span,
    node_positions,
    section_fields,
    sections,
)
from jaxbeam.model.torsion import TorsionMatrices, torsion_matrices
from jaxbeam.model.track import layers
from jaxbeam.model.transfer_matrices import check_buckling
from jaxbeam.numerics.matrices import REPEATED_EIGENVALUE_TOLERANCE, eigen
from jaxbeam.numerics.polynomials import legendre_to_chebyshev, piecewise_chebyshev
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    add_at,
    block_diag,
    set_at,
    stop_gradient,
    take,
    xp,
)
from jaxbeam.runtime.printer import TableViews, labelled_dataset

FURTHER_POINTS = 8  # of the quadrature, for properties of degree up to 15

Damping = tuple[Float[Array, " mode"], Float[Array, "mode mode"]]


def safe_sqrt(square):
    """Square root whose derivative at zero is zero."""
    return xp.where(square > 0, xp.sqrt(xp.where(square > 0, square, 1.0)), 0.0)


def modal_damping(beam: Beam, values, coupling, span) -> Damping:
    """Modal damping (1/s) of a beam without lossy segments, and that between repeated modes.

    `values` and `coupling` (1/s^2) are the stiffness of the modes, `span` (m) the longest span, by
    which the damping ratio of a bridge of a `material` is looked up. Rayleigh damping is a + b K.
    """
    if beam.rayleigh_damping is not None:
        mass_factor, stiffness_factor = beam.rayleigh_damping
        return mass_factor + stiffness_factor * values, stiffness_factor * coupling
    ratio = beam.damping_ratio
    if beam.loss_factor is not None:
        ratio = beam.loss_factor / 2
    if beam.material:
        ratio = MATERIALS[beam.material].at(beam.length if span is None else span)
    return damping_of_ratios(xp.broadcast_to(ratio, values.shape), values, coupling)


def damping_of_ratios(ratios: Float[Array, " mode"], values, coupling) -> Damping:
    """Modal damping of ratios, D = 2 zeta sqrt(K), and that between repeated modes.

    Its derivative between repeated modes is that of the matrix square root.
    """
    omega = safe_sqrt(values)
    sums = omega[:, None] + omega[None, :]
    coupling_factor = xp.where(
        sums > 0, (ratios[:, None] + ratios) / xp.where(sums > 0, sums, 1.0), 0.0
    )
    return 2 * ratios * omega, coupling_factor * coupling


def has_lossy_segments(beam: Beam) -> bool:
    """Whether a segment has a loss factor of its own."""
    return any(segment.loss_factor is not None for segment in beam.segments)


def ratios_of_segments(
    beam: Beam, layout: Layout, sections: Sections, stiffness, fields: Callable
) -> Float[Array, " mode"]:
    """Damping ratios zeta_n = sum_s eta_s / 2 U_sn / U_n, by the strain energy of each segment s.

    U_sn = 1/2 int (E I phi'^2 + kGA (w' - phi)^2) over the segment, with the loss factors eta_s of
    the segments or else that of the beam; U_n = omega_n^2 / 2 is that of the whole mode of unit
    mass, in which springs, foundation and axial force have no loss: the method of modal strain
    energy of Johnson and Kienholz (1982), AIAA Journal 20. `stiffness` is omega^2 (1/s^2) and
    `fields` are those of the modes. Patches count as the segments on which they are bonded.
    """
    losses = [
        beam.loss_factor if segment.loss_factor is None else segment.loss_factor
        for segment in beam.segments
    ]
    lost, length = xp.zeros(stiffness.shape), beam.length
    for i, degree in enumerate(layout.degrees):
        loss = losses[layout.segments[i]]
        if loss is None:
            continue
        local, weights = np.polynomial.legendre.leggauss(degree + FURTHER_POINTS)
        half = (sections.nodes[i + 1] - sections.nodes[i]) / 2
        y = sections.nodes[i] + half * (local + 1)
        slope, rotation, curvature = fields(y * length, (SLOPE, 1, 2))
        properties = sections.in_element(i, local)
        energy = properties[:, RIGIDITY, None] * curvature**2
        if sections.shear_flexible:
            shear = properties[:, SHEAR, None] / length**2 * (slope - rotation) ** 2
            energy = energy + shear
        lost = lost + loss * half * length * xp.sum(weights[:, None] * energy, axis=0)
    elastic = stiffness > 0
    fractions = lost * beam.bending_stiffness / xp.where(elastic, stiffness, 1.0)
    return xp.where(elastic, fractions / 2, 0.0)


if TYPE_CHECKING:
    import xarray  # imported where it is used, as it takes as long as all of JAX

ROUNDING_LEVEL = 4e-15  # of the largest coefficient of a shape: smaller ones are rounding errors


@functools.cache
def _reference_element(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Chebyshev series (degree, function) of `bending_basis`, and its mass and bending matrices."""
    basis = bending_basis(degree)
    weights = 2 / (2 * np.arange(degree + 1) + 1)
    mass = basis.T @ (weights[:, None] * basis)
    curvature = legendre.legder(basis, 2)
    bending = curvature.T @ (weights[: degree - 1, None] * curvature)
    return legendre_to_chebyshev(degree + 1) @ basis, mass, bending


class Modes(TableViews, Module):
    """Modes of the supported beam: q_j'' + damping_j q_j' + stiffness_j q_j = psi_j(x) . force.

    `coupling` is the off-diagonal stiffness between repeated modes, zero in value but not in
    derivative (see `eigen`). Stiffness is of order one for the lowest mode in the
    `stiffness_unit` E I / (m L^4). Shapes are mass-normalised, in kg^-1/2, positive near the left
    end; `series` are their Chebyshev series between the `nodes` (m) of the `layout`.

    Those of a beam that is not uniform have its `sections`, and if it is flexible in shear the
    `rotation_series` (m^-1 kg^-1/2) of its rotation phi; otherwise phi is the slope w'. Those of a
    beam that twists have the `twist_series` (rad kg^-1/2). Those of a beam under a track of layers
    have the `rail_series` of the rail between the `rail_nodes` (m).
    """

    stiffness: Float[Array, " mode"]
    damping: Float[Array, " mode"]
    coupling: Float[Array, "mode mode"]
    damping_coupling: Float[Array, "mode mode"]
    nodes: Float[Array, " node"]
    series: Float[Array, "segment degree mode"]
    stiffness_unit: Float[Array, ""]
    layout: Layout = eqx.field(static=True)
    sections: Sections | None = None
    rotation_series: Float[Array, "segment degree mode"] | None = None
    twist_series: Float[Array, "segment degree mode"] | None = None
    rail_nodes: Float[Array, " rail_node"] | None = None
    rail_series: Float[Array, "piece term mode"] | None = None

    @property
    def headline(self) -> str:
        """How many modes there are."""
        return f"Modes: {self.stiffness.shape[-1]} of the beam"

    @property
    @refuses_traced("a table")
    def columns(self) -> dict[str, np.ndarray]:
        """Number, frequency (Hz) and damping ratio of each mode, by head."""
        frequencies = np.asarray(self.frequencies)
        return {
            "mode": np.arange(1, 1 + frequencies.size),
            "frequency (Hz)": frequencies,
            "damping ratio": np.asarray(self.damping_ratios),
        }

    @refuses_traced("a dataset")
    def to_xarray(self, positions: int = 101) -> "xarray.Dataset":
        """Frequencies, damping ratios, and shapes at equally spaced positions, with units."""
        heads = self.columns
        x = np.linspace(float(self.nodes[0]), float(self.nodes[-1]), positions)
        return labelled_dataset(
            {
                "frequency": ("mode", heads["frequency (Hz)"], {"units": "Hz"}),
                "damping_ratio": ("mode", heads["damping ratio"], {"units": "1"}),
                "shape": (("position", "mode"), np.asarray(self.shapes(x)), {"units": "kg^-0.5"}),
            },
            {"mode": ("mode", heads["mode"]), "position": ("position", x, {"units": "m"})},
        )

    def lowest(self, count: int) -> "Modes":
        """The lowest modes, as many as `count`."""
        lines = "stiffness", "damping", "series", "rotation_series", "twist_series", "rail_series"
        found = {name: getattr(self, name) for name in lines}
        found = {name: None if one is None else one[..., :count] for name, one in found.items()}
        squares = "coupling", "damping_coupling"
        found |= {name: getattr(self, name)[:count, :count] for name in squares}
        return dataclasses.replace(self, **found)

    @property
    def angular_frequencies(self) -> Float[Array, " mode"]:
        """Natural angular frequencies in rad/s, ascending; zero for rigid-body modes."""
        return safe_sqrt(self.stiffness)

    @property
    def frequencies(self) -> Float[Array, " mode"]:
        """Natural frequencies in Hz, ascending."""
        return self.angular_frequencies / (2 * xp.pi)

    @property
    def has_repeated(self) -> Bool[Array, ""]:
        """Whether any two of the modes have (nearly) the same frequency."""
        low, high = self.stiffness[:-1], self.stiffness[1:]
        return xp.any(
            high - low <= REPEATED_EIGENVALUE_TOLERANCE * (self.stiffness_unit + low + high)
        )

    @property
    def damping_ratios(self) -> Float[Array, " mode"]:
        """Modal damping ratios; zero for rigid-body modes."""
        elastic = self.stiffness > 0
        return xp.where(
            elastic, self.damping / (2 * xp.where(elastic, safe_sqrt(self.stiffness), 1)), 0
        )

    def shapes(self, x, derivative: int = 0) -> Float[Array, "*position mode"]:
        """Mode shapes, or their x-derivatives up to the third, at positions x (m) of any shape.

        In kg^-1/2 m^-derivative; off the beam, by the polynomial of the nearest segment.
        """
        return self.shape_derivatives(x, (derivative,))[0]

    def shape_derivatives(
        self, x, derivatives: tuple[int, ...]
    ) -> Float[Array, "order *position mode"]:
        """Several x-derivatives of the mode shapes at once; the cost is little more than of one."""
        return piecewise_chebyshev(self.nodes, self.series, x, derivatives)

    def fields(self, x, orders: tuple[int, ...]) -> Float[Array, "order *position mode"]:
        """Fields of the mode shapes at positions x (m) that section forces and actuators need.

        Of orders 0 to 3 (or SLOPE): deflection w, rotation phi of the section, curvature phi', and
        shear force over bending stiffness V / E I. Those of a uniform beam are w, w', w'', w'''.
        TWIST and TWIST_RATE are theta and theta'. Raises ValueError for those of a beam that does
        not twist.
        """
        if set(orders) & {TWIST, TWIST_RATE}:
            if self.twist_series is None:
                raise ValueError(NO_TORSION)
            of_twist = piecewise_chebyshev(self.nodes, self.twist_series, x, (0, 1))
            rows = dict(zip((TWIST, TWIST_RATE), of_twist, strict=True))
            others = tuple(order for order in orders if order not in rows)
            if others:
                rows |= zip(others, self.fields(x, others), strict=True)
            return xp.stack([rows[order] for order in orders])
        if self.sections is None:
            derivatives = tuple(1 if order == SLOPE else order for order in orders)
            return self.shape_derivatives(x, derivatives)
        modes = FieldParts(
            self.nodes, self.series, self.rotation_series, self.stiffness / self.stiffness_unit
        )
        return section_fields(self.sections, modes, x, orders)


def mesh_layout(case: Case) -> Layout:
    """Layout of nodes and elements of a case; its numbers must be concrete (not inside `jit`).

    Raises ValueError for a beam that buckles under its axial force.
    """
    layout = find_layout(case)
    check_buckling(case, layout)
    return layout


@checks_classes
@jax.named_scope("modes")
def modes(case: Case, layout: Layout | None = None) -> Modes:
    """Lowest `case.beam.modes` natural modes of the beam on its supports.

    Euler-Bernoulli beam, E I w'''' + m w_tt = 0, with supports, rotational springs and bonded
    patches; suspensions of actuators and support dampers are left to the modal model. The equations
    of beams that are not uniform are in `model.elements`.
    A beam with a torsional rigidity has modes of torsion among them (`model.torsion`), one
    under a track of layers those of beam and track together (`model.track`).
    Differentiable in every number, at repeated frequencies too. Inside `jit`, pass the `layout`
    found outside by `mesh_layout(case)`, for which the case is taken as valid.

    Raises ValueError for an invalid case, and for a beam that buckles under its axial force.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> print(jb.modes(jb.Case(beam)).frequencies.round(2))
    [ 20.39  81.55 183.49]
    """
    if layout is None:
        check_plant(case)
        layout = mesh_layout(case)
    beam, found, to_rotation, track = case.beam, None, None, None
    if is_uniform(case):
        nodes, stiffness, mass, to_series = assemble_matrices(case, layout)
    else:
        found = sections(case, layout)
        nodes = found.nodes
        stiffness, mass, to_series, to_rotation = assemble_sections(case, layout, found)
    if case.beam.twists:

        def density(element: int, positions):
            if found is None:
                return section_properties(case, layout, element)[1]
            return found.in_element(element, positions)[:, MASS]

        torsion = torsion_matrices(case, layout, nodes, to_series, density)
        values, vectors, of_twist, coupling = _with_torsion(beam.modes, stiffness, mass, torsion)
    else:
        matrices = stiffness, mass
        if case.on_rail:
            track = layers(case, layout, nodes, to_series)
            matrices = track.with_beam(stiffness, mass)
        values, vectors, coupling = (part[..., : beam.modes] for part in eigen(*matrices))
        coupling, of_twist, torsion = coupling[: beam.modes], None, None
    every, own = vectors, values
    vectors = vectors[: stiffness.shape[0]]
    values, coupling = values * _stiffness_unit(beam), coupling * _stiffness_unit(beam)
    unit = xp.sqrt(beam.linear_density * beam.length)

    def shapes(to_series, vectors=vectors):
        series = xp.einsum("std,dm->stm", to_series, vectors)
        return _without_rounding(series) / unit

    rotation = None if to_rotation is None else shapes(to_rotation) / beam.length
    twist = None if torsion is None else shapes(torsion.series, of_twist) / beam.length
    nodes = nodes * beam.length
    span = longest_span(case, layout, nodes)
    rail = None if track is None else track.rail(case, every[stiffness.shape[0] :], unit)
    undamped = normalised_modes(
        beam, values, coupling, nodes, shapes(to_series), layout, found, rotation, span, twist, rail
    )
    if track is not None:
        damping = track.damping(case, every, undamped.damping, own, stiffness, mass)
        return eqx.tree_at(lambda m: m.damping, undamped, damping)
    if found is None or not has_lossy_segments(beam):
        return undamped
    ratios = ratios_of_segments(beam, layout, found, undamped.stiffness, undamped.fields)
    damping = damping_of_ratios(ratios, undamped.stiffness, undamped.coupling)
    return eqx.tree_at(lambda m: (m.damping, m.damping_coupling), undamped, damping)


def _with_torsion(count: int, stiffness, mass, torsion: TorsionMatrices):
    """Lowest `count` eigenvalues of bending and torsion together, eigenvectors and coupling.

    The coupling is that of `eigen`.
    """
    first, second = stiffness.shape[0], torsion.stiffness.shape[0]
    if torsion.coupling is not None:
        blocks = [[mass, torsion.coupling], [torsion.coupling.T, torsion.mass]]
        values, vectors, coupling = eigen(
            block_diag(stiffness, torsion.stiffness), xp.block(blocks)
        )
        vectors, coupling = vectors[:, :count], coupling[:count, :count]
        return values[:count], vectors[:first], vectors[first:], coupling
    bending, twist = eigen(stiffness, mass), eigen(torsion.stiffness, torsion.mass)
    most = min(count, first), min(count, second)
    values = xp.concatenate([bending[0][: most[0]], twist[0][: most[1]]])
    order = xp.argsort(stop_gradient(values))[:count]
    zeros = np.zeros((first, most[1])), np.zeros((second, most[0]))
    of_bending = xp.concatenate([bending[1][:, : most[0]], zeros[0]], axis=1)
    of_twist = xp.concatenate([zeros[1], twist[1][:, : most[1]]], axis=1)
    blocks = (one[2][:n, :n] for one, n in zip((bending, twist), most, strict=True))
    coupling = take(take(block_diag(*blocks), order).T, order).T
    of_bending, of_twist = (take(part.T, order).T for part in (of_bending, of_twist))
    return take(values, order), of_bending, of_twist, coupling


def _without_rounding(series):
    """Series whose coefficients below rounding are set to zero; derivatives of these stay.

    A third derivative, hence a shear force, multiplies that of degree n by up to n^6 / 15.
    """
    largest = xp.max(xp.abs(series), axis=1, keepdims=True)
    noise = xp.where(xp.abs(series) < ROUNDING_LEVEL * largest, series, 0.0)
    return series - stop_gradient(noise)


def normalised_modes(
    beam,
    values,
    coupling,
    nodes,
    series,
    layout: Layout,
    sections=None,
    rotation=None,
    span=None,
    twist=None,
    rail=None,
) -> Modes:
    """Modes of given stiffness (1/s^2) with the beam's damping, positive near the left end."""
    damping, damping_coupling = modal_damping(beam, values, coupling, span)
    moves = series if twist is None else series + beam.length * twist
    left_values = piecewise_chebyshev(nodes, moves, beam.length * 1e-3 / beam.modes, (0,))[0]
    signs = stop_gradient(xp.where(left_values < 0, -1.0, 1.0))
    sign_products = signs[:, None] * signs[None, :]
    return Modes(
        values,
        damping,
        coupling * sign_products,
        damping_coupling * sign_products,
        nodes,
        series * signs,
        _stiffness_unit(beam),
        layout,
        sections,
        None if rotation is None else rotation * signs,
        None if twist is None else twist * signs,
        None if rail is None else rail[0],
        None if rail is None else rail[1] * signs,
    )


def _stiffness_unit(beam):
    """E I / (m L^4) in 1/s^2."""
    return beam.bending_stiffness / (beam.linear_density * beam.length**4)


def assemble_matrices(case: Case, layout: Layout):
    """Nodes, stiffness and mass matrices in beam units, and Chebyshev series of the unknowns.

    The series have the shape (segment, degree, unknown).
    """
    beam, degrees = case.beam, layout.degrees
    positions = xp.stack([x / beam.length for x in node_positions(case)])
    nodes = positions[np.array([node[0] for node in layout.nodes])]
    nodal_unknowns = [[-1, -1] for _ in layout.nodes]
    size = 0
    for i, constrained in enumerate(layout.constrained):
        for j in range(2):
            if not constrained[j]:
                nodal_unknowns[i][j], size = size, size + 1
    series_terms = max(degrees) + 1
    total = size + sum(degree - 3 for degree in degrees)
    stiffness, mass = xp.zeros((total, total)), xp.zeros((total, total))
    to_series = []
    for i, degree in enumerate(degrees):
        half_length = (nodes[i + 1] - nodes[i]) / 2
        rigidity, density = section_properties(case, layout, i)
        index = np.array(
            [*nodal_unknowns[i], *nodal_unknowns[i + 1], *range(size, size + degree - 3)]
        )
        size += degree - 3
        free = np.flatnonzero(index >= 0)
        basis, mass_element, bending_element = _reference_element(degree)
        unity = xp.ones(())
        bubble_scale = xp.broadcast_to(half_length**1.5 / xp.sqrt(rigidity), (degree - 3,))
        scale = xp.concatenate([xp.stack([unity, half_length, unity, half_length]), bubble_scale])[
            free
        ]
        free_unknowns = np.ix_(index[free], index[free])
        scales = scale[:, None] * scale[None, :]
        block = bending_element[np.ix_(free, free)] * scales
        stiffness = add_at(stiffness, free_unknowns, block * rigidity / half_length**3)
        mass = add_at(
            mass, free_unknowns, mass_element[np.ix_(free, free)] * scales * density * half_length
        )
        segment_series = xp.zeros((series_terms, total))
        rows = np.ix_(np.arange(degree + 1), index[free])
        to_series.append(set_at(segment_series, rows, basis[:, free] * scale))
    spring_unit = beam.length**3 / beam.bending_stiffness
    for support, node in supported_matrices(case, layout):
        deflection, rotation = nodal_unknowns[node]
        if support.stiffness is not None and deflection >= 0:
            stiffness = add_at(stiffness, (deflection, deflection), support.stiffness * spring_unit)
        if rotation >= 0:
            rotational_spring = support.rotational_stiffness * beam.length / beam.bending_stiffness
            stiffness = add_at(stiffness, (rotation, rotation), rotational_spring)
    return nodes, stiffness, mass, xp.stack(to_series)


def section_properties(case: Case, layout: Layout, segment: int):
    """Bending stiffness and mass per length of a segment, relative to the beam without patches."""
    rigidity, density = xp.ones(()), xp.ones(())
    for actuator in layout.patches[segment]:
        patch = case.actuators[actuator].section_stiffening()
        rigidity = rigidity + patch.bending_stiffness / case.beam.bending_stiffness
        density = density + patch.mass_per_length / case.beam.linear_density
    return rigidity, density


def supported_matrices(case: Case, layout: Layout):
    """Pairs of a support and the index of its node."""
    for i, node in enumerate(layout.nodes):
        for index in node:
            if 2 <= index < 2 + len(case.supports):
                yield case.supports[index - 2], i
