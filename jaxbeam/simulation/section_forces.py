"""Shear forces and reactions of a run, statically corrected.

Shear forces jump at the positions of loads, supports and point actuators, so that they have a
value on either side; reactions are jumps of the shear force, less the other forces there.
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.model.modes import Modes
from jaxbeam.model.sensing.output_rows import SIDE_SHARE, beside, quantity_history
from jaxbeam.model.static_correction import (
    Motion,
    corrected_history,
    port_forces,
    shear_force as shear_of_third_derivative,
)
from jaxbeam.model.theory.fields import SLOPE
from jaxbeam.runtime.arrays import Array, xp

SIDES = ("left", "right")


def shear_force(
    case: Case, modes: Modes, motion: Motion, x, side: str = "right"
) -> Float[Array, "time *position"]:
    """Shear force in N on one side, "left" or "right", of positions x (m).

    It is dM/dx, less the rotary inertia of a section that has one.

    Raises ValueError for another side.
    """
    if side not in SIDES:
        raise ValueError(f"side must be 'left' or 'right' of x, not {side!r}")
    if side == "right":
        return quantity_history(case, modes, motion, x, "shear")
    x = beside(case, x, side)
    return shear_of_third_derivative(case, x, corrected_history(case, modes, motion, x, 3))


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
    nodes, step = _support_nodes(case, modes), SIDE_SHARE * case.beam.length
    x = modes.nodes[nodes]
    first, last = nodes == 0, nodes == modes.nodes.shape[0] - 1
    right, left = (_vertical_force(case, modes, motion, x, side) for side in ("right", "left"))
    reaction = xp.where(last, 0.0, right) - xp.where(first, 0.0, left)
    # Loads between the sections on both sides; none are beyond the ends.
    low, high = xp.where(first, -xp.inf, x - step), xp.where(last, xp.inf, x + step)
    position = motion.load_position[..., None]
    stands_there = (position > low) & (position <= high)
    reaction = reaction + xp.sum(
        xp.where(stands_there, motion.contact_force[..., None], 0.0), axis=1
    )
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


def _vertical_force(case: Case, modes: Modes, motion: Motion, x, side: str):
    """Vertical force V - T w' in N on one side of positions x."""
    shear = shear_force(case, modes, motion, x, side)
    if case.beam.axial_force is None:
        return shear
    slope = corrected_history(case, modes, motion, beside(case, x, side), SLOPE)
    return shear - case.beam.axial_force * slope
