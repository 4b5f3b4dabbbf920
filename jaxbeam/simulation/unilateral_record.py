"""Records of runs with unilateral contact: samples, peaks in continuous time, error."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.sensors import Sensor
from jaxbeam.case.trajectory import NEVER
from jaxbeam.integrator.contact_forces import contact_minimum
from jaxbeam.integrator.lifting_steps import INSIDE, NODES, POINTS, Instants, instants
from jaxbeam.integrator.peaks import RunningPeaks, initial_peaks, peaks_of_steps
from jaxbeam.integrator.step_size import UNSAMPLED, rounding_deflection, trial_positions
from jaxbeam.model.contact import ContactState, split_states
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.output_rows import sensor_history
from jaxbeam.model.sensing.sensor_signals import VehicleMotion
from jaxbeam.model.static_correction import Motion
from jaxbeam.simulation.integration_plan import IntegrationPlan
from jaxbeam.simulation.motion import motion_of
from jaxbeam.simulation.unilateral import UnilateralRun, law_of

LARGEST_STEP_NORM = 2.0  # of the matrix of heights and vehicles, times a step
MAX_HALVINGS = 8  # of steps until runs agree
NO_LANDING = (
    "no time step makes runs with unilateral contact agree to {:g}, as landings follow each other"
    " too fast: keep fewer modes (beam.modes), give the contact a spring (contact.hertz_stiffness),"
    " or a larger tolerance"
)


def with_short_steps(case: Case, plan: IntegrationPlan, times) -> IntegrationPlan:
    """The plan with steps short enough for wheels in flight and contact springs too."""
    steps = np.max(np.diff(times)) * law_of(case, load_set(case)).norm() / LARGEST_STEP_NORM
    return dataclasses.replace(plan, substeps=max(plan.substeps, int(np.ceil(steps))))


def change_of_runs(case: Case, model: ModalModel, coarse: Motion, fine: Motion) -> np.ndarray:
    """Error of a run, its change as steps are halved: of the deflection, then of each sensor."""
    shapes = np.asarray(model.modes.shapes(trial_positions(case)))
    least, both = rounding_deflection(case, model, load_set(case)), (coarse, fine)
    pairs = [
        [np.asarray(motion.coordinates) @ shapes.T for motion in both],
        *(
            [np.asarray(sensor_history(case, model.modes, motion, one)) for motion in both]
            for one in case.sensors
        ),
    ]
    errors = []
    for i, (former, present) in enumerate(pairs):
        largest = max(float(np.max(np.abs(present))), 0.0 if i else least)
        change = UNSAMPLED * float(np.max(np.abs(present - former)))
        errors.append(change / largest if largest else 0.0)
    return np.array(errors)


def _accelerations(model: ModalModel, at: Instants, states, force) -> np.ndarray:
    """Second derivatives (time, mode) of coordinates under contact forces (time, wheel) in N."""
    blocks, side, _ = model.state_matrix.shape
    rates = (model.state_matrix @ states.reshape(-1, blocks, side, 1)).reshape(states.shape)
    return rates[:, model.rate_index] - np.einsum("twm,tw->tm", at.shape, force)


def motion_at_samples(
    case: Case,
    model: ModalModel,
    loads: LoadSet,
    run: UnilateralRun,
    times: Float[np.ndarray, " time"],
    sample_steps: Int[np.ndarray, " time"],
) -> tuple[Motion, VehicleMotion]:
    """Motion of beam and vehicles at samples (s), which are at the starts of some steps."""
    pieces, law = [*run.pieces, run.last], run.law
    own = [pieces[i] for i in np.append(run.first_piece, len(run.pieces))[sample_steps]]
    pressing, states, heights = (
        np.stack(part)
        for part in zip(*((p.pressing, p.states[0], p.heights[0]) for p in own), strict=True)
    )
    on_beam = np.asarray(loads.on_beam(times)).T
    at = instants(model, loads, times, on_beam)
    force = at.forces(law, pressing, states, heights)
    excess = np.where(law.contact, force, 0.0) - at.weight
    vehicles = loads.vehicle_states
    rates = (heights @ law.A.T + excess @ law.B.T)[:, :vehicles, None]
    of_groups = zip(loads.wheels.vehicles, split_states(0, loads, rates)[1], strict=True)
    contact = ContactState(
        -np.where(on_beam | loads.on_ground, force, 0.0)[..., None],
        _accelerations(model, at, states, force)[..., None],
        tuple(rate[..., group.A.shape[0] // 2 :, :] for group, rate in of_groups),
    )
    states = np.concatenate([states, heights[:, :vehicles]], axis=1)
    return motion_of(case, model, loads, times, states[..., None], contact)


def peaks_of_run(
    case: Case, model: ModalModel, loads: LoadSet, run: UnilateralRun, sensors: Sequence[Sensor]
) -> RunningPeaks:
    """Peaks of what sensors measure, upwards, then downwards, and the contact forces of a run."""
    pieces: dict[str, Any] = {
        name: np.stack([getattr(piece, name) for piece in run.pieces])
        for name in ("start", "length", "on_beam", "pressing", "force", "states", "heights")
    }
    start, length, on_beam = (pieces[name] for name in ("start", "length", "on_beam"))
    count, wheels = on_beam.shape
    times = (start[:, None] + length[:, None] * INSIDE).reshape(-1)
    states, heights = (pieces[name].reshape(times.size, -1) for name in ("states", "heights"))
    here, pressing = (
        np.repeat(pieces[name], POINTS.size, axis=0) for name in ("on_beam", "pressing")
    )
    at = instants(model, loads, times, here)
    force = at.forces(run.law, pressing, states, heights).reshape(count, POINTS.size, wheels)
    force[:, NODES] = np.swapaxes(pieces["force"], 1, 2)
    force = np.where(on_beam[:, None], force, 0.0)
    force = force.reshape(times.size, wheels)
    parts = [
        states[:, model.coordinate_index],
        states[:, model.rate_index],
        _accelerations(model, at, states, force),
    ]
    if model.mode_map is not None:
        parts = [part @ np.asarray(model.mode_map).T for part in parts]
    coordinates, rates, accelerations = parts
    position = np.where(here, np.asarray(loads.kinematics(times)[0]).T, np.nan)
    commands = np.zeros((times.size, len(case.actuators)))
    motion = Motion(coordinates, rates, accelerations, position, force, commands)
    peaks = initial_peaks(2 * len(sensors), wheels, 1, lambda value: value)
    if sensors:
        values = [np.asarray(sensor_history(case, model.modes, motion, one)) for one in sensors]
        samples = np.stack([*values, *(-value for value in values)], axis=1)
        samples = samples.reshape(count, POINTS.size, -1, 1)
        peaks = peaks_of_steps(peaks, samples, start, length)
    downwards, is_load = -pieces["force"].reshape(count, -1, 1), on_beam[..., None] * np.eye(wheels)
    start_of_contact = peaks.lowest_contact_force, peaks.contact_lost_time
    lowest = contact_minimum(*start_of_contact, downwards, is_load > 0, start, length)[0][:, 0]
    lowest = np.where(run.law.contact & ~loads.fixed, np.maximum(lowest, 0.0), lowest)
    lost = np.full(wheels, NEVER)
    np.minimum.at(lost, run.flights.wheel, run.flights.lift_time)
    return peaks.with_contact(lowest[:, None], lost[:, None])
