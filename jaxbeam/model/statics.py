"""Influence lines of every quantity: deflection, rotation, moment, shear force, reaction.

An influence line is the static value of a quantity under 1 N downwards, over the position of the
force. Static peaks are the largest values under the loads of a case wherever they are.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case, check_is_case
from jaxbeam.case.fields import check_on_beam, concrete, real_numbers, suggestion
from jaxbeam.case.sensors import QUANTITIES, SIDES, SLOPE, quantity_of
from jaxbeam.model.deflection_lines import (
    influence_functions,
    intervals_of_waves,
    peak_under_loads,
    spread_line,
    static_deflection,
    unchecked_influence_line,
    validated_layout,
)
from jaxbeam.model.elements import Layout, held_positions, is_uniform
from jaxbeam.model.output_rows import SIDE_DISTANCE, at_side, quantity_factor
from jaxbeam.model.static_correction import section_stiffness
from jaxbeam.model.transfer_matrices import settlement_response
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.compiling import compiled_if_traced

__all__ = ["influence_line", "settlement_response", "static_deflection", "static_peak"]

DEFAULT_POSITIONS = 101
REACTION = "reaction"
# Quantities with an influence line: what moves or accelerates has no static value.
STATIC_QUANTITIES = (
    *(name for name, quantity in QUANTITIES.items() if quantity.time_derivative == 0),
    REACTION,
)


def unit_of_effect(quantity: str) -> str:
    """SI unit of a reaction, "N", or of a quantity of the beam."""
    return "N" if quantity == REACTION else QUANTITIES[quantity].unit


@checks_classes
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
    `model.modes.mesh_layout(case)`, and concrete positions of reactions.

    Raises ValueError for an invalid case, a position off the beam, a beam that can move as a rigid
    body, an unknown quantity or side, or a reaction where nothing holds the deflection.

    >>> import jaxbeam as jb
    >>> beam = jb.Case(jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0))
    >>> print(f"{jb.influence_line(beam, x=1.0, load_positions=1.0):.6f}")  # -L^3 / (48 E I)
    -0.027778
    >>> print(jb.influence_line(beam, x=1.0, load_positions=[0.5, 1.0], quantity="moment"))
    [0.25 0.5 ]
    """
    check_is_case(case)
    if load_positions is None:
        load_positions = case.beam.length * np.linspace(0.0, 1.0, DEFAULT_POSITIONS)
    x = real_numbers("x", x, "m", "positions")
    load_positions = real_numbers("load_positions", load_positions, "m", "positions")
    kind = _checked_kind(case, x, _Kind(quantity, derivative, side))
    layout = validated_layout(case, layout, x=x, positions=load_positions)
    if quantity == "deflection":
        return unchecked_influence_line(case, layout, x, load_positions, derivative)
    return _influence_line(case, layout, x, load_positions, kind, fibre_distance, section_modulus)


@checks_classes
def static_peak(
    case: Case,
    x,
    layout: Layout | None = None,
    derivative: int = 0,
    *,
    quantity: str = "deflection",
    fibre_distance=None,
    section_modulus=None,
    side: str = "right",
) -> Float[Array, "*position"]:
    """Largest absolute static value of a quantity at x (m) over the whole crossing of the loads.

    By default the deflection in m. At every instant the loads press with their weights, and with
    forces that vary in time, at their positions, without inertia of loads and beam: the denominator
    of the dynamic amplification, and for one load or loads of equal speed the limit of a slow
    crossing. The crossing is that from the first entry to the last exit, or stop, whatever the
    duration of the run; waves of forces last until the end of the run.

    Quantities, `derivative` of the deflection, and `side` are those of `influence_line`. The
    maximum is exact where the beam is uniform and forces have no waves: between the events of a
    crossing the value is a polynomial in time. Differentiable in every number where the maximum is
    unique. Inside `jit`, pass the `layout`; numbers of loads with waves must be concrete. Raises
    ValueError as `influence_line` does.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(f"{1e3 * jb.statics.static_peak(case, 0.3):.2f} mm")
    1.89 mm
    >>> print(f"{jb.statics.static_peak(case, 0.3, quantity='moment'):.3f} N m")  # m g L / 4
    0.736 N m
    """
    x = real_numbers("x", x, "m", "positions")
    kind = _checked_kind(case, x, _Kind(quantity, derivative, side))
    parameters = fibre_distance, section_modulus
    if quantity != REACTION:
        quantity_of(quantity, *parameters)
    layout = validated_layout(case, layout, x=x)
    if not case.loads:
        return xp.zeros(x.shape)
    if case.on_rail:
        case = dataclasses.replace(case, track=None)  # its axles press on the beam as points
    return _static_peak(case, layout, x, kind, *parameters, intervals_of_waves(case))


class _Kind(NamedTuple):
    """Quantity, derivative of the deflection, and side of x, of an influence line."""

    quantity: str
    derivative: int
    side: str


def _checked_kind(case: Case, x, kind: _Kind) -> _Kind:
    if kind.quantity not in STATIC_QUANTITIES:
        advice = suggestion(kind.quantity, STATIC_QUANTITIES)
        raise ValueError(f"no influence line of {kind.quantity!r}; {advice}")
    if kind.side not in SIDES:
        raise ValueError(f"side must be 'left' or 'right' of x, not {kind.side!r}")
    if kind.derivative and kind.quantity != "deflection":
        message = "derivative is that of the deflection; leave it out for"
        raise ValueError(f"{message} {kind.quantity!r}")
    if kind.quantity == REACTION:
        check_on_beam("x", x, case.beam.length)
        _check_held(case, x)
    return kind


@compiled_if_traced
def _influence_line(case: Case, layout: Layout, x, load_positions, kind: _Kind, *parameters):
    line, _ = _line(case, layout, x.reshape(-1), kind, *parameters)
    return line(load_positions).reshape((*load_positions.shape, *x.shape))


@compiled_if_traced
def _static_peak(
    case: Case,
    layout: Layout,
    x,
    kind: _Kind,
    fibre_distance,
    section_modulus,
    wave_intervals: int,
):
    line, breaks = _line(case, layout, x.reshape(-1), kind, fibre_distance, section_modulus)
    line, breaks = spread_line(case, line, breaks)
    of_torque = kind.quantity != REACTION and QUANTITIES[kind.quantity].of_twist
    return peak_under_loads(case, line, breaks, wave_intervals, of_torque).reshape(x.shape)


def _line(case: Case, layout: Layout, x, kind: _Kind, fibre_distance, section_modulus):
    """Influence line of x (m) as a function of the force's position, and its breaks (m).

    The function maps positions (position...) to values (position..., x); it is smooth between the
    breaks.
    """
    length, rigidity = case.beam.length, case.beam.bending_stiffness

    def field(at, order: int):
        greens = influence_functions(case, layout, at, order)
        scale = -(length ** (3 - abs(order))) / rigidity
        return (lambda y: scale * greens(y / length)), length * greens.breakpoints

    if kind.quantity == REACTION:
        return _reaction_line(case, x, field)
    if kind.quantity == "deflection":
        return field(x, kind.derivative)
    entry = quantity_of(kind.quantity, fibre_distance, section_modulus)
    at = at_side(case, x, kind.side) if entry.x_derivative else x
    line, breaks = field(at, 1 if entry.of_axis and is_uniform(case) else entry.field)
    factor = quantity_factor(case, at, entry, fibre_distance, section_modulus)
    return (lambda y: factor * line(y)), breaks


def _reaction_line(case: Case, x, field):
    """Reactions in N per newton: jumps of the force V - T w', and the load on the support."""
    length, sides, breaks = case.beam.length, [], []
    outer = x < length * SIDE_DISTANCE, x > length * (1 - SIDE_DISTANCE)
    for side, sign, beyond in zip(SIDES, (-1.0, 1.0), outer, strict=True):
        at = at_side(case, x, side)
        third, own = field(at, 3)
        slope = None if case.beam.axial_force is None else field(at, SLOPE)[0]
        share = xp.where(beyond, 0.0, sign)
        sides.append((third, slope, share * section_stiffness(case, at), share))
        breaks.append(own)

    def line(y):
        total = xp.where(xp.abs(y[..., None] - x) <= SIDE_DISTANCE * length, 1.0, 0.0)
        for third, slope, stiffness, share in sides:
            total = total + stiffness * third(y)
            if slope is not None:
                total = total - share * case.beam.axial_force * slope(y)
        return total

    return line, xp.concatenate(breaks)


def _check_held(case: Case, x) -> None:
    places, step = held_positions(case), 1e-9 * float(concrete(case.beam.length))
    for one in np.atleast_1d(concrete(x)).ravel():
        if not np.any(np.abs(places - one) <= step):
            held = ", ".join(f"{place:g}" for place in places) or "none"
            raise ValueError(
                f"there is no reaction at {one:g} m; the deflection is held at (m): {held}"
            )
