"""Static response of a beam to settlements of its supports, by reciprocity with reactions."""

import equinox as eqx
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam
from jaxbeam.case.validation import check_case
from jaxbeam.model.flexibility import check_supported
from jaxbeam.model.layout import find_layout
from jaxbeam.model.theory.fields import SLOPE
from jaxbeam.model.theory.sections import RIGIDITY
from jaxbeam.model.theory.statics import section_flexibility
from jaxbeam.runtime.arrays import Array, xp

SIDE = 1e-12  # of the length: distance from a support to the sections beside it


def settlement_response(
    case: Case, settlements, x, derivative: int = 0
) -> Float[Array, "*position"]:
    """Static deflection (m, positive upwards) at x (m) from settlements of the supports.

    `settlements` (support,) in m, positive downwards, are those of the `supports` of the case,
    rigid or elastic; an end settles as a rigid support at its position. `derivative` is that of
    `influence_line`: with 2, times the bending stiffness, it is a bending moment. The response
    is linear, so it adds to that of a run with forces. Field = sum of R_i s_i, with the
    reaction R_i of support i under the unit source dual to the field (Betti). Differentiable in
    settlements and stiffnesses; the positions must be known.

    Raises ValueError as `influence_line` does, and for a number of settlements other than that of
    the supports.

    >>> import jaxbeam as jb
    >>> two_spans = jb.Case(
    ...     jb.Beam(length=4.0, flexural_rigidity=6.0, mass_per_length=1.0), [jb.Support(2.0)]
    ... )
    >>> curvature = jb.settlement_response(two_spans, [0.1], x=2.0, derivative=2)
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
    # A foundation of no stiffness: statics by transfer matrices, of a uniform beam too.
    if case.beam.foundation_stiffness is None:
        case = eqx.tree_at(
            lambda c: c.beam.foundation_stiffness,
            case,
            xp.zeros(()),
            is_leaf=lambda leaf: leaf is None,
        )
    layout = find_layout(case)
    check_supported(case, layout)
    greens = section_flexibility(case, layout, x.reshape(-1), derivative)

    def vertical_force(y):
        """V - T w' in beam units, (side..., source)."""
        sections = greens.transfer.sections
        shear = sections.at(y)[..., RIGIDITY, None] * greens(y, 3)
        return shear - sections.axial_force * greens(y, SLOPE)

    total = xp.zeros(x.size)
    for i, support in enumerate(case.supports):
        place = support.position / case.beam.length
        sides = xp.stack([place - SIDE, place + SIDE])
        left, right = vertical_force(xp.clip(sides, SIDE, 1 - SIDE))
        left = xp.where(place > SIDE, left, 0.0)
        right = xp.where(place < 1 - SIDE, right, 0.0)
        # A source on the support itself is no part of the reaction.
        own = xp.where(xp.abs(greens.positions - place) <= SIDE, greens.jumps[:, 3], 0.0)
        total = total + settlements[i] * (right - left - own)
    # Beam units: a unit source dual to a derivative has the unit of a force over L^derivative.
    return (total / case.beam.length**derivative).reshape(x.shape)
