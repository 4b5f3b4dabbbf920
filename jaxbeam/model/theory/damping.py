"""Damping of modes: ratios, Rayleigh damping, and loss factors by fractions of strain energy."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from jaxbeam.case.beam import MATERIALS, Beam
from jaxbeam.case.quantities import SLOPE
from jaxbeam.model.layout import Layout
from jaxbeam.model.theory.elements import RIGIDITY, SHEAR, Sections
from jaxbeam.runtime.arrays import Array, xp

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
