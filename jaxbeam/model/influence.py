"""Influence lines of every quantity: deflection, rotation, moment, shear force, reaction.

An influence line is the static value of a quantity under 1 N downwards, over the position of the
force.
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.beam import END_CONDITIONS
from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam, suggestion
from jaxbeam.case.fields import concrete
from jaxbeam.case.quantities import QUANTITIES, quantity_of
from jaxbeam.model import statics
from jaxbeam.model.layout import Layout, is_uniform
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensing.output_rows import SIDE_SHARE, beside, quantity_factor
from jaxbeam.model.theory.fields import SLOPE
from jaxbeam.runtime.arrays import Array, xp

DEFAULT_POSITIONS = 101
REACTION = "reaction"
SIDES = ("left", "right")
# Quantities with an influence line: what moves or accelerates has no static value.
STATIC_QUANTITIES = (
    *(name for name, quantity in QUANTITIES.items() if quantity.time_derivative == 0),
    REACTION,
)


def influence_line(
    case: Case,
    x,
    load_positions=None,
    derivative: int = 0,
    layout: Layout | None = None,
    *,
    quantity: str = "deflection",
    fibre_distance=None,
    section_modulus=None,
    side: str = "right",
) -> Float[Array, "..."]:
    """Influence line of a quantity at x (m): its static value under 1 N downwards at each position.

    Exact for E I w'''' = p with the case's supports, bonded patches and suspensions; commands are
    zero. `x` and `load_positions` (m from the left end; by default 101 equally spaced ones) may
    have any shapes; the result has the shape (load position..., x...), in the unit of the quantity
    per newton: m/N for deflections, N m/N for moments. Quantities are those of sensors
    without time derivatives, and "reaction", of the end or support at x, positive upwards. Moments
    over an inner support or at a clamped end are support moments. A shear force jumps at x by the
    load, and at supports: `side` "left" or "right" of x. Strain needs `fibre_distance` (m), stress
    `section_modulus` (m^3).

    For the deflection, `derivative` (up to 3) gives that x-derivative instead, in
    m^(1-derivative)/N, and by reciprocity the line is the deflected shape under 1 N at x.
    Differentiable in every number. Inside `jit`, pass the `layout` found outside by
    `model.modes.mesh_layout(case)`, and positions of reactions that are known.

    Raises ValueError for an invalid case, a position off the beam, a beam that can move as a rigid
    body, an unknown quantity or side, or a reaction where nothing holds the deflection.

    >>> import jaxbeam as jb
    >>> beam = jb.Case(jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0))
    >>> print(f"{jb.influence_line(beam, x=1.0, load_positions=1.0):.6f}")  # -L^3 / (48 E I)
    -0.027778
    >>> print(jb.influence_line(beam, x=1.0, load_positions=[0.5, 1.0], quantity="moment"))
    [0.25 0.5 ]
    """
    if load_positions is None:
        load_positions = case.beam.length * np.linspace(0.0, 1.0, DEFAULT_POSITIONS)
    if quantity not in STATIC_QUANTITIES:
        known = suggestion(quantity, STATIC_QUANTITIES)
        raise ValueError(f"no influence line of {quantity!r}; {known}")
    if side not in SIDES:
        raise ValueError(f"side must be 'left' or 'right' of x, not {side!r}")
    if quantity == "deflection":
        return statics.influence_line(case, x, load_positions, derivative, layout)
    if derivative:
        raise ValueError(f"derivative is that of the deflection; leave it out for {quantity!r}")
    x, load_positions = xp.asarray(x, float), xp.asarray(load_positions, float)
    check_on_beam("x", x, case.beam.length)
    layout = mesh_layout(case) if layout is None else layout
    if quantity == REACTION:
        return _reactions(case, x, load_positions, layout)
    parameters = fibre_distance, section_modulus
    entry = quantity_of(quantity, *parameters)
    if entry.bends:
        x = beside(case, x, side)
    order = 1 if entry.of_axis and is_uniform(case) else entry.field
    line = statics.influence_line(case, x, load_positions, order, layout)
    return quantity_factor(case, x, entry, *parameters) * line


def _reactions(case: Case, x, load_positions, layout: Layout):
    """Reactions in N per newton: jumps of the vertical force, and the load on the support."""
    _check_held(case, x)
    last = x > case.beam.length * (1 - SIDE_SHARE)
    first = x < case.beam.length * SIDE_SHARE
    left, right = (_vertical_force(case, x, load_positions, side, layout) for side in SIDES)
    jump = xp.where(last, 0.0, right) - xp.where(first, 0.0, left)
    distance = xp.abs(load_positions.reshape((*load_positions.shape, *(1,) * x.ndim)) - x)
    return jump + xp.where(distance <= SIDE_SHARE * case.beam.length, 1.0, 0.0)


def _vertical_force(case: Case, x, load_positions, side: str, layout: Layout):
    """Vertical force V - T w' on one side of x, in N per newton."""
    shear = influence_line(case, x, load_positions, layout=layout, quantity="shear", side=side)
    if case.beam.axial_force is None:
        return shear
    slope = statics.influence_line(case, beside(case, x, side), load_positions, SLOPE, layout)
    return shear - case.beam.axial_force * slope


def held_positions(case: Case) -> Float[np.ndarray, " support"]:
    """Positions (m) at which ends and supports hold the deflection, from left to right."""
    length = float(concrete(case.beam.length))
    ends = (0.0, case.beam.left_end), (length, case.beam.right_end)
    held = {x for x, end in ends if END_CONDITIONS[end][0]}
    return np.array(sorted(held | {float(concrete(s.position)) for s in case.supports}))


def _check_held(case: Case, x) -> None:
    places, step = held_positions(case), 1e-9 * float(concrete(case.beam.length))
    for one in np.atleast_1d(concrete(x)).ravel():
        if not np.any(np.abs(places - one) <= step):
            known = ", ".join(f"{place:g}" for place in places) or "none"
            raise ValueError(
                f"there is no reaction at {one:g} m; the deflection is held at (m): {known}"
            )
