"""Motion of beam and vehicles at the samples of a run, from states or in closed form."""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.integrator.force_peaks import (
    ForcePaths,
    constant_speeds,
    force_panels,
    force_paths,
    force_wheels,
)
from jaxbeam.integrator.force_system import ForceSystem, force_responses, force_system
from jaxbeam.model.contact import ContactState, contact_at, split_states
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.output_rows import LinearOutputs
from jaxbeam.model.sensing.sensor_signals import VehicleMotion
from jaxbeam.model.static_correction import Motion
from jaxbeam.runtime.arrays import Array, add_at, xp


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
