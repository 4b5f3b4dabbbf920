"""Layout of a beam: order of nodes at supports, patch edges, hinges and edges of segments."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbeam.case.beam import (
    END_CONDITIONS,
    Segment,
    has,
    mass_per_length,
    optional_property,
    rigidity,
    segment_edges,
)
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.runtime.arrays import xp

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
