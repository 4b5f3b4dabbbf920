"""Section properties along the elements of a beam that is not uniform, in beam units."""

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from jaxbeam.case.beam_parts.properties import (
    has,
    mass_per_length,
    optional_property,
    polynomial_degree,
    rigidity,
    segment_edges,
)
from jaxbeam.case.beam_parts.segment import Segment
from jaxbeam.case.case import Case
from jaxbeam.model.layout import Layout, node_positions
from jaxbeam.numerics.piecewise import piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module

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
