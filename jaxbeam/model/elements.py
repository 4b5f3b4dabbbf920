"""Layout of a beam: nodes and elements along it; stiffness, mass and fields of the elements.

Bending energy 1/2 int E I phi'^2, shear 1/2 int kGA (w' - phi)^2, axial force 1/2 int T w'^2,
foundation 1/2 int k w^2; kinetic energy 1/2 int m w_t^2 + 1/2 int r phi_t^2. A beam that is rigid
in shear has the rotation phi = w'. The functions of an element are those of a uniform beam with phi
= w', which have no shear; a Timoshenko beam adds polynomials of w that vanish at both nodes, with
phi = 0, and one of phi, 1 - t^2, with w = 0. Then phi and w are all polynomials of their degrees,
and the problem is well conditioned for stiff and for soft shear.
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev, legendre

from jaxbeam.case.beam import (
    END_CONDITIONS,
    Segment,
    has,
    mass_per_length,
    optional_property,
    polynomial_degree,
    rigidity,
    segment_edges,
)
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.case.sensors import SLOPE
from jaxbeam.numerics.polynomials import legendre_to_chebyshev, piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, Module, add_at, set_at, xp

NODE_TOLERANCE = 1e-9  # of the length: closer nodes are one node

# Polynomials for properties that vary within a segment: of degree VARIATION_DEGREE per decade of
# convergence; static solutions are series of a fixed degree on parts of the elements, in which
# exponentials grow by less than e^MAX_GROWTH and depths fall to no less than a third.
VARIATION_DEGREE, MAX_VARIATION_DEGREE = 12, 60
MAX_GROWTH, MAX_TAPER, MAX_PARTS = 1.0, 2.2, 400
SAMPLES = np.linspace(0, 1, 33)  # of a segment, for estimates of how its properties vary


@dataclasses.dataclass(frozen=True)
class Layout:
    """Nodes, elements and end conditions along the beam: order and incidence, hence static.

    `nodes[i]` lists the parts at node i, as indices into `node_positions(case)`; `constrained[i]`
    says whether its deflection and rotation are zero; element i, from node i to i + 1, carries the
    patches `patches[i]` (indices of actuators) and a polynomial of degree `degrees[i]`.

    Of a beam that is not uniform (see `is_uniform`), `segments[i]` is the index of the segment of
    the beam in which element i lies, and `parts[i]` the number of equal parts of static solutions.
    """

    nodes: tuple[tuple[int, ...], ...]
    constrained: tuple[tuple[bool, bool], ...]
    patches: tuple[tuple[int, ...], ...]
    degrees: tuple[int, ...]
    segments: tuple[int, ...] = ()
    parts: tuple[int, ...] = ()


def largest_layout(layouts: Sequence[Layout]) -> Layout | None:
    """Layout with the largest degrees and parts of several; None if they differ in others."""
    largest = {
        name: tuple(map(max, zip(*(getattr(one, name) for one in layouts), strict=False)))
        for name in ("degrees", "parts")
    }
    common = [dataclasses.replace(one, **largest) for one in layouts]
    return common[0] if all(one == common[0] for one in common) else None


def held_positions(case: Case) -> Float[np.ndarray, " support"]:
    """Positions (m) at which ends and supports hold the deflection, from left to right."""
    length = float(concrete(case.beam.length))
    ends = (0.0, case.beam.left_end), (length, case.beam.right_end)
    held = {x for x, end in ends if END_CONDITIONS[end][0]}
    return np.array(sorted(held | {float(concrete(s.position)) for s in case.supports}))


def is_uniform(case: Case) -> bool:
    """Whether the beam is an Euler-Bernoulli beam of uniform section without bearings of mass."""
    return case.beam.is_uniform and all(support.mass is None for support in case.supports)


def node_positions(case: Case) -> list:
    """Positions (m) of possible nodes: both ends, every support, both edges of every patch.

    Then, unless the beam is uniform, the edges of its segments, its hinges, and the points on which
    actuators act.
    """
    patch_ends = [
        edge for _, patch in _stiffened_sections(case) for edge in (patch.start, patch.end)
    ]
    positions = [0.0, case.beam.length, *(s.position for s in case.supports), *patch_ends]
    if is_uniform(case):
        return positions
    positions += segment_edges(case.beam)[1:-1]
    positions += [hinge.position for hinge in case.beam.hinges]
    return positions + [place for place, _, _ in actuator_terms(case)]


def actuator_terms(case: Case) -> list:
    """Terms of the displacement maps of all actuators, one after the other."""
    return [term for actuator in case.actuators for term in actuator.displacement_map()]


def _counts(case: Case) -> tuple[int, int, int]:
    """Numbers of supports, of edges of patches, and of edges between segments."""
    edges = max(len(case.beam.segments) - 1, 0)
    return len(case.supports), 2 * len(_stiffened_sections(case)), edges


def hinge_nodes(case: Case, layout: Layout) -> dict[int, int]:
    """Node of each hinge: indices of nodes and of hinges of the beam."""
    first = 2 + sum(_counts(case))
    last = first + len(case.beam.hinges)
    return {
        node: index - first
        for node, indices in enumerate(layout.nodes)
        for index in indices
        if first <= index < last
    }


def kink_nodes(case: Case, layout: Layout) -> list[int]:
    """Nodes off rigid supports at which slopes of modes may jump: hinges, with shear also others.

    There w' - phi is V / kGA: it jumps at elastic supports, and at edges between segments. Where
    a rigid support holds the beam, it takes all of the impulse of a wheel over a kink.
    """
    kinks = set(hinge_nodes(case, layout))
    if has(case.beam, "shear_stiffness"):
        supports, patch_edges, edges = _counts(case)
        first = 2 + supports + patch_edges
        places = {*range(2, 2 + supports), *range(first, first + edges)}
        kinks |= {i for i, indices in enumerate(layout.nodes) if places & set(indices)}
    held = {i for i, (deflection, _) in enumerate(layout.constrained) if deflection}
    return sorted(kinks - held - {0, len(layout.nodes) - 1})


def actuator_nodes(case: Case, layout: Layout) -> list[int]:
    """Node of each of the `actuator_terms`, of a beam that is not uniform."""
    first = 2 + sum(_counts(case)) + len(case.beam.hinges)
    nodes = {index: node for node, indices in enumerate(layout.nodes) for index in indices}
    return [nodes[first + i] for i in range(len(actuator_terms(case)))]


def longest_span(case: Case, layout: Layout, nodes):
    """Longest distance between neighbouring nodes with supports, rigid or elastic, of some `nodes`.

    In the unit of the nodes; the whole length if fewer than two are supported.
    """
    supports = range(2, 2 + len(case.supports))
    held = [
        i
        for i, (indices, (fixed, _)) in enumerate(
            zip(layout.nodes, layout.constrained, strict=True)
        )
        if fixed or any(index in supports for index in indices)
    ]
    return nodes[-1] - nodes[0] if len(held) < 2 else xp.max(xp.diff(nodes[np.array(held)]))


def _stiffened_sections(case: Case) -> list:
    """Index of each actuator that stiffens the section of the beam, and its stiffening."""
    pairs = ((i, actuator.section_stiffening()) for i, actuator in enumerate(case.actuators))
    return [(i, bonded) for i, bonded in pairs if bonded is not None]


def find_layout(case: Case) -> Layout:
    """Layout of nodes and elements of a case; its numbers must be concrete (not inside `jit`)."""
    why = "it decides the order of supports and patches; or pass the layout, where one is taken"
    length = float(concrete(case.beam.length, "beam.length", why))
    places = [concrete(x, "a position along the beam", why) for x in node_positions(case)]
    positions = np.array([float(place) / length for place in places])
    nodes: list[list[int]] = []
    for index in np.argsort(positions, kind="stable"):
        if nodes and positions[index] - positions[nodes[-1][0]] < NODE_TOLERANCE:
            nodes[-1].append(int(index))
        else:
            nodes.append([int(index)])
    # The lowest index comes first: an end keeps its exact position where a support sits on it.
    nodes = [sorted(node) for node in nodes]

    def node_conditions(node):
        ends = (case.beam.left_end, case.beam.right_end)
        end_constraints = [END_CONDITIONS[ends[i]] for i in node if i < 2]
        rigid = any(case.supports[i - 2].stiffness is None for i in node if 1 < i < first_patch_end)
        return (rigid or any(w[0] for w in end_constraints), any(w[1] for w in end_constraints))

    first_patch_end = 2 + len(case.supports)
    places = np.array([positions[node[0]] for node in nodes])
    midpoints = (places[1:] + places[:-1]) / 2
    patches = tuple(
        tuple(
            i
            for n, (i, _) in enumerate(_stiffened_sections(case))
            if positions[first_patch_end + 2 * n] < middle < positions[first_patch_end + 2 * n + 1]
        )
        for middle in midpoints
    )
    # A wave of wavenumber k over a length l needs a little more than k l / 2 terms.
    # Half of those on a track of layers are of the rail.
    count = case.beam.modes // 2 if case.on_rail else case.beam.modes
    phases = np.pi / 2 * (count + len(nodes)) * np.diff(places)
    constrained = tuple(node_conditions(node) for node in nodes)
    all_nodes = tuple(map(tuple, nodes))
    if is_uniform(case):
        return Layout(all_nodes, constrained, patches, _degrees(phases))
    segments, parts, phases, variation = _variation(concrete_case(case), places, phases)
    return Layout(all_nodes, constrained, patches, _degrees(phases, variation), segments, parts)


def _degrees(phases, further=0) -> tuple[int, ...]:
    return tuple(int(z) for z in np.ceil(phases + 4 * phases ** (1 / 3) + 9) + further)


def _variation(case: Case, places, phases):
    """Segments and parts of elements, their phases, and further degrees, by how properties vary.

    Wavenumbers vary as (m / E I)^(1/4); those of foundation and tension decay, and bound them.
    """
    beam = case.beam
    edges = np.array([float(x) for x in segment_edges(beam)]) / float(beam.length)
    segments = beam.segments or (Segment(),)
    midpoints = (places[1:] + places[:-1]) / 2
    index = np.clip(np.searchsorted(edges, midpoints, side="right") - 1, 0, len(segments) - 1)
    tension = max(0.0, float(beam.axial_force or 0.0))
    waves, rates, ratios = [], [], []
    for i, left, right in zip(index, places[:-1], places[1:], strict=True):
        start, end = edges[i], edges[i + 1]
        s = (left + (right - left) * SAMPLES - start) / (end - start)
        stiffness = np.asarray(rigidity(beam, segments[i], s))
        mass = np.asarray(mass_per_length(beam, segments[i], s))
        foundation = optional_property(beam, segments[i], "foundation_stiffness", s)
        waves.append(np.max(mass / stiffness) ** 0.25)
        decay = np.max(foundation / stiffness) ** 0.25 + np.sqrt(np.max(tension / stiffness))
        rates.append(float(decay) * float(beam.length))
        ratios.append(np.cbrt(np.min(stiffness) / np.max(stiffness)))
    lengths, waves, rates, ratios = np.diff(places), *map(np.array, (waves, rates, ratios))
    mean_wave = np.sum(waves * lengths)
    phases = np.maximum(phases * waves / mean_wave, rates * lengths / 2)
    reach = (1 + ratios) / np.maximum(1 - ratios, 1e-12)
    variation = VARIATION_DEGREE / np.log10(reach + np.sqrt(reach**2 - 1))
    variation = np.ceil(np.minimum(variation, MAX_VARIATION_DEGREE))
    parts = np.maximum(rates * lengths / MAX_GROWTH, (1 - ratios) / (MAX_TAPER * ratios))
    parts = np.clip(np.ceil(parts), 1, MAX_PARTS)
    return tuple(map(int, index)), tuple(map(int, parts)), phases, variation


PROPERTIES = ("rigidity", "mass", "shear_stiffness", "rotary_inertia", "foundation_stiffness")
RIGIDITY, MASS, SHEAR, ROTARY, FOUNDATION = range(len(PROPERTIES))


class Sections(Module):
    """Section properties as polynomials on each element between the `nodes` (in L).

    In beam units, of the `bending_stiffness` E I and the `linear_density` m of the beam: E I, m,
    E I / L^2 of shear stiffness, m L^2 of rotary inertia, E I / L^4 of a foundation. The axial
    force is in E I / L^2. `series` are Chebyshev series of the `PROPERTIES`; without
    `shear_flexible` that of the shear stiffness is zero and has no meaning.
    """

    nodes: Float[Array, " node"]
    series: Float[Array, "element degree property"]
    axial_force: Float[Array, ""]
    shear_flexible: bool = eqx.field(static=True)

    def at(self, x, derivative: int = 0) -> Float[Array, "*position property"]:
        """Properties, or their derivatives, at positions x (in L)."""
        return piecewise_chebyshev(self.nodes, self.series, x, (derivative,))[0]

    def in_element(self, element: int, local: Float[np.ndarray, " point"]):
        """Properties (point, property) at local positions, -1 to 1, of an element."""
        return chebyshev.chebvander(local, self.series.shape[1] - 1) @ self.series[element]


def sections(case: Case, layout: Layout) -> Sections:
    """Section properties of the beam with the patches that stiffen it."""
    beam = case.beam
    positions = xp.stack([x / beam.length for x in node_positions(case)])
    nodes = positions[np.array([node[0] for node in layout.nodes])]
    terms = max(polynomial_degree(beam) + 1, 2)
    points = chebyshev.chebpts1(terms)
    to_series = np.linalg.inv(chebyshev.chebvander(points, terms - 1))
    edges = [x / beam.length for x in segment_edges(beam)]
    stiffness, mass, length = beam.bending_stiffness, beam.linear_density, beam.length
    segments, series = beam.segments or (Segment(),), []
    for i, index in enumerate(layout.segments):
        x = nodes[i] + (points + 1) / 2 * (nodes[i + 1] - nodes[i])
        s = (x - edges[index]) / (edges[index + 1] - edges[index])
        segment = segments[index]
        bending, density = rigidity(beam, segment, s), mass_per_length(beam, segment, s)
        for actuator in layout.patches[i]:
            patch = case.actuators[actuator].section_stiffening()
            bending = bending + patch.bending_stiffness
            density = density + patch.mass_per_length
        shear, rotary, foundation = (
            optional_property(beam, segment, name, s) for name in PROPERTIES[2:]
        )
        values = [
            bending / stiffness,
            density / mass,
            shear * length**2 / stiffness,
            rotary / (mass * length**2),
            foundation * length**4 / stiffness,
        ]
        series.append(to_series @ xp.stack(values, axis=-1))
    axial_force = xp.zeros(()) if beam.axial_force is None else beam.axial_force
    return Sections(
        nodes,
        xp.stack(series),
        axial_force * length**2 / stiffness,
        has(beam, "shear_stiffness"),
    )


def rigidity_at(case: Case, x) -> Float[Array, "*position"]:
    """Bending stiffness (N m^2) of the beam without patches at x (m); at a step, to the right."""
    beam, edges = case.beam, segment_edges(case.beam)
    total = xp.zeros(x.shape)
    for i, segment in enumerate(beam.segments):
        inside = x < edges[i + 1] if i == 0 else x >= edges[i]
        if 0 < i < len(beam.segments) - 1:
            inside = inside & (x < edges[i + 1])
        inside = inside | True if len(beam.segments) == 1 else inside
        s = (x - edges[i]) / (edges[i + 1] - edges[i])
        total = total + xp.where(inside, rigidity(beam, segment, xp.clip(s, 0.0, 1.0)), 0.0)
    return total


FURTHER_POINTS = 8  # of the quadrature, for properties of degree up to 15


def bending_basis(degree: int) -> np.ndarray:
    """Functions without shear on t in [-1, 1] as Legendre series (degree, function).

    The four Hermite cubics (deflection and slope at both ends), then functions that vanish with
    their slope at both ends: Legendre polynomials integrated twice, orthonormal in bending.
    """
    hermite = np.array([[2, -3, 0, 1], [1, -1, -1, 1], [2, 3, 0, -1], [-1, -1, 1, 1]]) / 4.0
    basis = np.zeros((degree + 1, degree + 1))
    for i, cubic in enumerate(hermite):
        basis[:4, i] = legendre.poly2leg(cubic)
    for n in range(4, degree + 1):
        bubble = legendre.legint(np.eye(n - 1)[n - 2] * np.sqrt((2 * n - 3) / 2), 2, lbnd=-1)
        basis[: bubble.size, n] = bubble
    return basis


def shear_basis(degree: int) -> np.ndarray:
    """Functions that vanish at both ends, orthonormal by their slopes, as Legendre series."""
    basis = np.zeros((degree + 1, degree - 1))
    for n in range(2, degree + 1):
        bubble = legendre.legint(np.eye(n)[n - 1] * np.sqrt((2 * n - 1) / 2), lbnd=-1)
        basis[: bubble.size, n - 2] = bubble
    return basis


@functools.cache
def _tables(degree: int):
    """Quadrature points and weights, and values of both bases and their derivatives by t there."""
    points, weights = legendre.leggauss(degree + FURTHER_POINTS)
    bending, shear = bending_basis(degree), shear_basis(degree)
    of_bending = [legendre.legval(points, legendre.legder(bending, n)).T for n in range(3)]
    of_shear = [legendre.legval(points, legendre.legder(shear, n)).T for n in range(2)]
    return points, weights, of_bending, of_shear


@functools.cache
def _chebyshev(degree: int):
    """Chebyshev series of w and phi h of all functions of an element, without their scales."""
    convert = legendre_to_chebyshev(degree + 1)
    bending, shear = bending_basis(degree), shear_basis(degree)
    slope = np.vstack([legendre.legder(bending), np.zeros((1, degree + 1))])
    bubble = np.zeros((degree + 1, 1))
    bubble[:3, 0] = legendre.poly2leg([1.0, 0.0, -1.0])
    deflection = np.hstack([bending, shear, np.zeros((degree + 1, 1))])
    rotation = np.hstack([slope, np.zeros_like(shear), bubble])
    return convert @ deflection, convert @ rotation


def _element(properties, half_length, degree: int, axial_force, shear_flexible: bool):
    """Stiffness and mass of an element, and the scales of its functions."""
    _, weights, (w, w_t, w_tt), (b, b_t) = _tables(degree)
    points = weights.shape[0]
    middle = properties[points // 2]
    rigidity, mass = properties[:, RIGIDITY], properties[:, MASS]
    rotary, foundation = properties[:, ROTARY], properties[:, FOUNDATION]
    unity = xp.ones(())
    bubbles = xp.broadcast_to(half_length**1.5 / xp.sqrt(middle[RIGIDITY]), (degree - 3,))
    scale = xp.concatenate([xp.stack([unity, half_length, unity, half_length]), bubbles])
    weights = weights * half_length
    deflection, rotation = w * scale, w_t * scale / half_length
    curvature, slope = w_tt * scale / half_length**2, w_t * scale / half_length
    shear = None
    if shear_flexible:
        local, stiffness = _tables(degree)[0][:, None], properties[:, SHEAR]
        shear_scale = xp.broadcast_to(xp.sqrt(half_length / middle[SHEAR]), (degree - 1,))
        last = 1 / xp.sqrt(middle[SHEAR] * half_length + middle[RIGIDITY] / half_length)
        none, no_bubble = np.zeros_like(b), np.zeros((points, 1))
        deflection = xp.concatenate([deflection, b * shear_scale, no_bubble], axis=1)
        shear_slope = b_t * shear_scale / half_length
        slope = xp.concatenate([slope, shear_slope, no_bubble], axis=1)
        rotation = xp.concatenate([rotation, none, (1 - local**2) * last], axis=1)
        curvature = xp.concatenate([curvature, none, -2 * local / half_length * last], axis=1)
        shear = xp.concatenate([np.zeros_like(w), shear_slope, -(1 - local**2) * last], axis=1)
        scale = xp.concatenate([scale, shear_scale, last[None] * half_length])

    def product(function, factor):
        return function.T @ ((weights * factor)[:, None] * function)

    bending = product(curvature, rigidity) + axial_force * product(slope, 1.0)
    bending = bending + product(deflection, foundation)
    if shear is not None:
        bending = bending + product(shear, stiffness)
    return bending, product(deflection, mass) + product(rotation, rotary), scale


def assemble_sections(case: Case, layout: Layout, sections: Sections):
    """Stiffness and mass matrices in beam units, and Chebyshev series of w and phi.

    The series have the shape (element, degree, unknown); that of phi is None for a beam that is
    rigid in shear, whose rotation is w'.
    """
    nodes, degrees = sections.nodes, layout.degrees
    flexible = sections.shear_flexible
    unknowns, size = nodal_unknowns(case, layout)
    bubbles = [2 * degree - 3 if flexible else degree - 3 for degree in degrees]
    total, terms = size + sum(bubbles), max(degrees) + 1
    stiffness, mass = xp.zeros((total, total)), xp.zeros((total, total))
    deflection_series, rotation_series = [], []
    for i, (degree, count) in enumerate(zip(degrees, bubbles, strict=True)):
        half_length = (nodes[i + 1] - nodes[i]) / 2
        (w1, _, phi1), (w2, phi2, _) = unknowns[i], unknowns[i + 1]
        index = np.array([w1, phi1, w2, phi2, *range(size, size + count)])
        size += count
        free = np.flatnonzero(index >= 0)
        block, pairs = np.ix_(free, free), np.ix_(index[free], index[free])
        properties = sections.in_element(i, _tables(degree)[0])
        bending, inertia, scale = _element(
            properties, half_length, degree, sections.axial_force, flexible
        )
        stiffness = add_at(stiffness, pairs, bending[block])
        mass = add_at(mass, pairs, inertia[block])
        deflection, rotation = _chebyshev(degree)
        rows = np.ix_(np.arange(degree + 1), index[free])
        blank, scale = xp.zeros((terms, total)), scale[free]
        deflection_series.append(set_at(blank, rows, deflection[:, free] * scale))
        if flexible:
            rotation_series.append(set_at(blank, rows, rotation[:, free] * scale / half_length))
    stiffness, mass = add_nodal_parts(case, layout, unknowns, stiffness, mass)
    rotation = xp.stack(rotation_series) if flexible else None
    return stiffness, mass, xp.stack(deflection_series), rotation


def nodal_unknowns(case: Case, layout: Layout) -> tuple[list[tuple[int, int, int]], int]:
    """Unknowns of each node (w, phi to its left, phi to its right), -1 for none; their number."""
    hinges, unknowns, size = hinge_nodes(case, layout), [], 0
    for i, (held, clamped) in enumerate(layout.constrained):
        w, size = (-1, size) if held else (size, size + 1)
        left, size = (-1, size) if clamped else (size, size + 1)
        right = left
        if i in hinges:
            right, size = size, size + 1
        unknowns.append((w, left, right))
    return unknowns, size


def add_nodal_parts(case: Case, layout: Layout, unknowns, stiffness, mass):
    """Matrices (the mass may be None) with springs and masses of supports and springs of hinges."""
    beam = case.beam
    spring_unit = beam.length**3 / beam.bending_stiffness
    rotational_unit = beam.length / beam.bending_stiffness
    for i, node in enumerate(layout.nodes):
        w, left, _ = unknowns[i]
        for index in node:
            if not 2 <= index < 2 + len(case.supports):
                continue
            support = case.supports[index - 2]
            if support.stiffness is not None and w >= 0:
                stiffness = add_at(stiffness, (w, w), support.stiffness * spring_unit)
            if support.mass is not None and w >= 0 and mass is not None:
                mass = add_at(mass, (w, w), support.mass / (beam.linear_density * beam.length))
            if left >= 0:
                spring = support.rotational_stiffness * rotational_unit
                stiffness = add_at(stiffness, (left, left), spring)
    for node, hinge in hinge_nodes(case, layout).items():
        _, left, right = unknowns[node]
        spring = beam.hinges[hinge].rotational_stiffness * rotational_unit
        pair = np.ix_([left, right], [left, right])
        stiffness = add_at(stiffness, pair, spring * np.array([[1.0, -1.0], [-1.0, 1.0]]))
    return stiffness, mass


class FieldParts(NamedTuple):
    """Nodes (m), Chebyshev series of w and phi, and eigenvalues in E I / (m L^4), of modes."""

    nodes: Float[Array, " node"]
    deflection: Float[Array, "element degree mode"]
    rotation: Float[Array, "element degree mode"] | None
    eigenvalues: Float[Array, " mode"]


def section_fields(
    sections: Sections, modes: FieldParts, x, orders: tuple[int, ...]
) -> Float[Array, "order *position mode"]:
    """Fields of orders 0 to 3 (see `Modes.fields`), or SLOPE, at positions x (m).

    In free vibration the rotary inertia r bends too: V = M' + omega^2 r phi with M = E I phi'.
    """
    x = xp.asarray(x, float)
    length, found = modes.nodes[-1], {}
    if 0 in orders or SLOPE in orders:
        rows = piecewise_chebyshev(modes.nodes, modes.deflection, x, (0, 1))
        found[0], found[SLOPE] = rows[0], rows[1]
    if set(orders) & {1, 2, 3}:
        if modes.rotation is None:
            rows = piecewise_chebyshev(modes.nodes, modes.deflection, x, (1, 2, 3))
        else:
            rows = piecewise_chebyshev(modes.nodes, modes.rotation, x, (0, 1, 2))
        found[1], found[2] = rows[0], rows[1]
    if 3 in orders:
        values, slopes = sections.at(x / length), sections.at(x / length, 1)
        rigidity = values[..., RIGIDITY, None]
        change = slopes[..., RIGIDITY, None] / (rigidity * length)
        inertia = values[..., ROTARY, None] / rigidity * modes.eigenvalues / length**2
        found[3] = rows[2] + change * rows[1] + inertia * rows[0]
    return xp.stack([found[order] for order in orders])
