"""Motion of beam and vehicles at the samples of a run; section forces and reactions from it.

Motion is that of states, or in closed form. Section forces are statically corrected, with those of
settled supports. Shear forces jump at the positions of loads, supports and point actuators, so that
they have a value on either side; reactions are jumps of the shear force, less the other forces
there.
"""

from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.sensors import SIDES, SLOPE, quantity_of
from jaxbeam.model.contact import ContactState, contact_at, split_states
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.model.output_rows import (
    SIDE_DISTANCE,
    LinearOutputs,
    at_side,
    quantity_factor,
    quantity_history,
)
from jaxbeam.model.sensor_signals import VehicleMotion
from jaxbeam.model.static_correction import Motion, corrected_history, port_forces
from jaxbeam.model.transfer_matrices import has_settlement, settled_beam
from jaxbeam.runtime.arrays import Array, add_at, xp
from jaxbeam.simulation.integrator.force_peaks import (
    ForcePaths,
    constant_speeds,
    force_panels,
    force_paths,
    force_wheels,
)
from jaxbeam.simulation.integrator.force_system import ForceSystem, force_responses, force_system


def outputs_of_forces(
    system: ForceSystem, paths: ForcePaths, times: Float[np.ndarray, " time"]
) -> Float[np.ndarray, "time output"]:
    """Outputs Re(C eta) of one run, from rest, at times (s); without their static parts."""
    responses = force_responses(system, np.unique(paths.speed))
    panels = force_panels(responses, paths)
    panel = np.maximum(np.searchsorted(panels.start, times, side="right") - 1, 0)
    since = (times - panels.start[panel])[:, None]
    eta = panels.amplitude[panel] * np.exp(since * system.poles)
    which, at = panels.forces_in(panel)
    piece, number = panels.piece[at], panels.response[at]
    x = panels.origin[at] + panels.speed[at] * times[which]
    x = np.clip(x, system.breaks[piece], system.breaks[piece + 1])
    segment = system.segment[piece]
    for u, s in np.unique(np.stack([number, segment]), axis=1).T.tolist():
        here = (number == u) & (segment == s)
        p = responses.particular(u, s, x[here])
        np.add.at(eta, which[here], panels.force[at][here, None] * p)
    return (eta @ system.on_outputs.T).real


def motion_at(
    case: Case,
    model: ModalModel,
    loads: LoadSet,
    times: Float[Array, " time"],
    states: Float[Array, "time state 1"],
    commands: Float[Array, "time command"] | None = None,
) -> tuple[Motion, VehicleMotion]:
    """Motion of the modes with the forces on the beam, and motion of the vehicles.

    At samples (s) of a run, from the states there and the commands; None are taken as zero.
    """
    columns = None if commands is None else commands[..., None]
    contact = contact_at(model, loads, times, states, columns)
    return motion_of(case, model, loads, times, states, contact, commands)


def motion_of(
    case: Case,
    model: ModalModel,
    loads: LoadSet,
    times: Float[Array, " time"],
    states: Float[Array, "time state 1"],
    contact: ContactState,
    commands: Float[Array, "time command"] | None = None,
) -> tuple[Motion, VehicleMotion]:
    """`motion_at`, given the contact forces and accelerations."""
    vehicles = _vehicle_motion(model, loads, states, contact.vehicle_acceleration)
    force, accelerations = contact.force[..., 0], contact.modal_acceleration[..., 0]
    count = 2 * accelerations.shape[1]
    coordinates, rates = states[:, 0:count:2, 0], states[:, 1:count:2, 0]
    if model.mode_map is not None:
        coordinates, rates, accelerations = (
            part @ model.mode_map.T for part in (coordinates, rates, accelerations)
        )
    position = xp.where(loads.on_beam(times).T, loads.kinematics(times)[0].T, xp.nan)
    actuators = len(case.actuators)
    command = xp.zeros((times.shape[0], actuators)) if commands is None else commands[:, :actuators]
    motion = Motion(coordinates, rates, accelerations, position, -force, command)
    return motion, _with_absorbers(case, model, loads, motion, vehicles)


def _with_absorbers(
    case: Case, model: ModalModel, loads: LoadSet, motion: Motion, vehicles: VehicleMotion
) -> VehicleMotion:
    """Motion of the bodies, with absorbers themselves in place of their equivalent oscillators.

    u = r z + (1 - r) y; see `jaxbeam.case.absorbers`. The oscillators stand on the profile, whose
    height is none of the absorbers', as these hang on the beam.
    """
    if not case.absorbers:
        return vehicles
    shapes = model.modes.shapes(xp.stack([one.position for one in case.absorbers]))
    fraction = xp.stack([one.body_fraction for one in case.absorbers])
    count, moved = len(case.absorbers), []
    places = loads.kinematics(np.zeros(()))[0][-count:]
    surface = loads.surface_motion(places, *2 * (xp.zeros(count),))
    if surface is not None:
        displacement = add_at(vehicles.body_displacement, np.s_[:, -count:], -surface[0])
        vehicles = vehicles._replace(body_displacement=displacement)
    of_modes = motion.coordinates, motion.rates, motion.accelerations
    for equivalent, modal in zip(vehicles, of_modes, strict=True):
        own = fraction * equivalent[:, -count:] + (1 - fraction) * (modal @ shapes.T)
        moved.append(xp.concatenate([equivalent[:, :-count], own], axis=1))
    return VehicleMotion(*moved)


def _vehicle_motion(model: ModalModel, loads: LoadSet, states, accelerations) -> VehicleMotion:
    """Motion of the bodies at instants, from the states and the accelerations at contact."""
    _, vehicle_states = split_states(model.state_count, loads, states)
    none = xp.zeros((states.shape[0], 0))
    parts = []
    for state, acceleration in zip(vehicle_states, accelerations, strict=True):
        dofs = acceleration.shape[-2]
        motion = state[..., :dofs, 0], state[..., dofs:, 0], acceleration[..., 0]
        parts.append([part.reshape(part.shape[0], -1) for part in motion])
    if not parts:
        return VehicleMotion(none, none, none)
    return VehicleMotion(*(xp.concatenate(part, axis=1) for part in zip(*parts, strict=True)))


def motion_of_forces(
    case: Case, model: ModalModel, loads: LoadSet, times: Float[np.ndarray, " time"]
) -> Motion | None:
    """Motion of a run at times (s) in closed form; None where there is no closed form.

    All loads have to be forces at constant speeds, without a controller, and the poles of the beam
    distinct.
    Forces off the beam are left out of the motion.
    """
    if not constant_speeds(loads):
        return None
    states = LinearOutputs(np.eye(model.state_count), None)
    system = force_system(model, states, np.zeros(0))
    if system is None:
        return None
    paths = force_paths(case, force_wheels(case), (), np.zeros((1, 0)))
    found = outputs_of_forces(system, paths, times)
    motion = motion_at(case, model, loads, times, found[..., None], None)[0]
    # Only as many columns as there are forces on the beam at once.
    off_beam = ~np.isfinite(motion.load_position)
    most = int((~off_beam).sum(axis=1).max(initial=0))
    on_beam = np.argsort(off_beam, axis=1, kind="stable")[:, :most]
    position, force = (
        np.take_along_axis(np.asarray(part), on_beam, axis=1)
        for part in (motion.load_position, motion.contact_force)
    )
    return motion._replace(load_position=position, contact_force=force)


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
