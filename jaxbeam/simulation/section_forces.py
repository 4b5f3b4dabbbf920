"""Section forces and reactions of a run, statically corrected, with those of settled supports.

Shear forces jump at the positions of loads, supports and point actuators, so that they have a
value on either side; reactions are jumps of the shear force, less the other forces there.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.quantities import SIDES, SLOPE, quantity_of
from jaxbeam.model.modes import Modes
from jaxbeam.model.sensing.output_rows import (
    SIDE_DISTANCE,
    at_side,
    quantity_factor,
    quantity_history,
)
from jaxbeam.model.settlement import has_settlement, settled_beam
from jaxbeam.model.static_correction import (
    Motion,
    corrected_history,
    port_forces,
)
from jaxbeam.runtime.arrays import Array, xp


def history(
    case: Case,
    modes: Modes,
    motion: Motion,
    x,
    name: str,
    fibre_distance=None,
    section_modulus=None,
    side: str = "",
) -> Float[Array, "time *position"]:
    """History of a quantity at positions x (m), on one side of them; raises as `quantity_history`.

    Moments, shear forces and stresses have those of settled supports in them. Displacements,
    strains and curvatures are measured from the settled beam at rest.
    """
    parameters = fibre_distance, section_modulus
    changes = quantity_history(case, modes, motion, x, name, *parameters, side=side)
    if not (quantity_of(name, *parameters).section_force and has_settlement(case)):
        return changes
    return changes + locked_in(case, modes, at_side(case, x, side or "right"), name, *parameters)


def locked_in(
    case: Case, modes: Modes, x, name: str, fibre_distance=None, section_modulus=None
) -> Float[Array, "*position"]:
    """Moment, shear force or stress due to settled supports at positions x (m), in its SI unit."""
    parameters = fibre_distance, section_modulus
    quantity = quantity_of(name, *parameters)
    field = settled_beam(case, modes.layout).field(x, quantity.x_derivative)
    return quantity_factor(case, x, quantity, *parameters) * field


def shear_force(
    case: Case, modes: Modes, motion: Motion, x, side: str = "right"
) -> Float[Array, "time *position"]:
    """Shear force in N on one side, "left" or "right", of positions x (m).

    It is dM/dx, less the rotary inertia of a section that has one.

    Raises ValueError for another side.
    """
    if side not in SIDES:
        raise ValueError(f"side must be 'left' or 'right' of x, not {side!r}")
    return history(case, modes, motion, x, "shear", side=side)


def support_positions(case: Case, modes: Modes) -> Float[Array, " support"]:
    """Positions (m) at which ends and supports hold the deflection, from left to right."""
    return modes.nodes[_support_nodes(case, modes)]


def _support_nodes(case: Case, modes: Modes) -> np.ndarray:
    """Indices of the nodes with a support or with an end that holds the deflection."""
    layout = modes.layout
    supports = range(2, 2 + len(case.supports))  # indices of supports among the parts at nodes
    held = [
        constrained[0] or any(part in supports for part in node)
        for node, constrained in zip(layout.nodes, layout.constrained, strict=True)
    ]
    return np.flatnonzero(held)


def reactions(case: Case, modes: Modes, motion: Motion) -> Float[Array, "time support"]:
    """Reactions in N, positive upwards, at `support_positions`; forces of their dampers included.

    R = S(x+) - S(x-) + F, with the vertical force S = V - T w' of the section under an axial force
    T, and the contact forces F of loads that stand on the support. The mass of a bearing is part of
    it: the reaction is that on the ground.
    """
    nodes, step = _support_nodes(case, modes), SIDE_DISTANCE * case.beam.length
    x = modes.nodes[nodes]
    first, last = nodes == 0, nodes == modes.nodes.shape[0] - 1
    right, left = (_vertical_force(case, modes, motion, x, side) for side in ("right", "left"))
    reaction = xp.where(last, 0.0, right) - xp.where(first, 0.0, left)
    # Loads between the sections on both sides.
    low, high = xp.where(first, -xp.inf, x - step), xp.where(last, xp.inf, x + step)
    for offset, fraction in _spread_forces(case):
        position = motion.load_position[..., None] + offset
        on_beam = (position >= -step) & (position <= case.beam.length + step)
        stands_there = on_beam & (position > low) & (position <= high)
        force = xp.where(stands_there, fraction * motion.contact_force[..., None], 0.0)
        reaction = reaction + xp.sum(force, axis=1)
    for actuator, force in zip(case.actuators, port_forces(case, modes, motion, True), strict=True):
        for place, order, factor in actuator.displacement_map():
            if order == 0:
                at_support = (place > low) & (place <= high)
                reaction = reaction - factor * xp.where(at_support, force[:, None], 0.0)
    for support in case.supports:
        if support.mass is not None:
            acceleration = motion.accelerations @ modes.shapes(support.position)
            there = (support.position > low) & (support.position <= high)
            inertia = xp.where(there, support.mass * acceleration[:, None], 0.0)
            reaction = reaction + inertia
    return reaction


def _spread_forces(case: Case) -> list[tuple[Any, Any]]:
    """Offset (m), and fraction of the load, of each point force in which a track spreads a load."""
    if case.track is None:
        return [(0.0, 1.0)]
    kernel = case.track.kernel()
    if kernel.integrated or case.track.layered:
        return []
    return list(zip(kernel.offsets, kernel.weights, strict=True))


def _vertical_force(case: Case, modes: Modes, motion: Motion, x, side: str):
    """Vertical force V - T w' in N on one side of positions x."""
    shear = shear_force(case, modes, motion, x, side)
    if case.beam.axial_force is None:
        return shear
    x = at_side(case, x, side)
    slope = corrected_history(case, modes, motion, x, SLOPE)
    if has_settlement(case):
        slope = slope + settled_beam(case, modes.layout).field(x, SLOPE)
    return shear - case.beam.axial_force * slope
