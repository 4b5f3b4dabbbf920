"""Fields of the modes of a beam that is not uniform: rotation, curvature, shear force."""

from typing import NamedTuple

from jaxtyping import Float

from jaxbeam.model.theory.sections import RIGIDITY, ROTARY, Sections
from jaxbeam.numerics.piecewise import piecewise_chebyshev
from jaxbeam.runtime.arrays import Array, xp

SLOPE = -1  # order of the slope w' of the axis, which is the rotation only without shear


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
