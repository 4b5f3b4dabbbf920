"""A run of a case by scipy's DOP853 on the mass-matrix form of the equations of motion.

With a load of mass m and weight W at x(t), the mode shapes s there with their derivatives s' and
s'', and all loads on the beam summed,

    (I + m s s^T) q'' = (unloaded model) - s (W + m (2 x' s'^T q' + x'^2 s''^T q + x'' s'^T q)),

eqs (2.11) to (2.16) of the thesis, solved for q'' at every instant: no contact force is collocated,
and the solver chooses its steps between events. Modes and paths are those of jaxbeam. Where a load
passes a kink of the beam, the momentum (I + sum m s s^T) q' + sum m s x' s'^T q stays.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.integrator.kinks import kink_passages
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, modal_model

EVENT_MARGIN = 1e-14  # of the duration: kinematics are evaluated at least this far from events


class AdaptiveSolution(NamedTuple):
    """Histories in SI units; at the time of an event the values just after it.

    `rates` are (time, mode), `contact_force` (time, load), positive where the load presses on the
    beam and zero off the beam, `deflection` (time, sensor), positive upwards.
    """

    rates: np.ndarray
    contact_force: np.ndarray
    deflection: np.ndarray


def simulate_adaptive(case: Case, times, tolerance: float = 1e-10) -> AdaptiveSolution:
    """A run from rest at t = 0 with samples at the ascending times (s).

    `tolerance` bounds the error of a step, relative to the static deflection of the slowest mode.
    """
    case, times = concrete_case(case), np.asarray(times, float)
    model, loads = modal_model(case), load_set(case)
    kinks, end = kink_passages(case, model, loads), float(times[-1])
    windows, legs = _event_times(model, loads, end)
    scales = tolerance * _state_scales(case, model, loads, end)
    state, rates, force, coordinates = np.zeros(model.state_count), [], [], []
    for start, stop in itertools.pairwise(legs):
        middle = (start + stop) / 2
        on_beam = (windows[:, 0] < middle) & (middle < windows[:, 1])
        margin = EVENT_MARGIN * end

        def accelerations(t, state, on_beam=on_beam, low=start + margin, high=stop - margin):
            return _accelerations(model, loads, on_beam, np.clip(t, low, high), state)

        def rate(t, state, accelerations=accelerations):
            derivative = model.A @ state
            derivative[model.rate_index] = accelerations(t, state)[0]
            return derivative

        last = stop == legs[-1]
        inside = times[(times >= start) & ((times <= stop) if last else (times < stop))]
        solved = solve_ivp(
            rate,
            (start, stop),
            state,
            "DOP853",
            t_eval=np.append(inside[inside < stop], stop),
            rtol=1e-12,
            atol=scales,
        )
        for t, sample in zip(inside, solved.y.T, strict=False):
            coordinates.append(sample[model.coordinate_index])
            rates.append(sample[model.rate_index])
            force.append(np.where(on_beam, accelerations(t, sample)[1], 0.0))
        state = solved.y[:, -1]
        if kinks is not None:
            at_end = np.abs(kinks.times - stop) <= 10 * margin
            passed = np.flatnonzero(at_end & kinks.happen(windows, times[0], times[-1]))
            state = _after_kinks(model, loads, kinks, passed, on_beam, stop, state)
    coordinates, rates = np.array(coordinates), np.array(rates)
    deflection = coordinates @ model.shapes(case.sensor_positions, (0,))[0].T
    if model.mode_map is not None:
        rates = rates @ model.mode_map.T
    return AdaptiveSolution(rates, np.array(force), deflection)


def _accelerations(model: ModalModel, loads: LoadSet, on_beam, time, state):
    """Modal accelerations, and contact forces (N, downwards on the beam), at a time (s)."""
    mass = np.where(on_beam, loads.inertia[:, 0], 0.0)
    weight = np.where(on_beam, loads.weight[:, 0], 0.0)
    x, speed, acceleration = loads.kinematics(time)
    shape, slope, curvature = model.shapes(np.where(on_beam, x, 0.0), (0, 1, 2))
    q, u = state[model.coordinate_index], state[model.rate_index]
    convective = 2 * speed * (slope @ u) + speed**2 * (curvature @ q) + acceleration * (slope @ q)
    free_force = weight + mass * convective
    inertia = np.eye(model.mode_count) + shape.T @ (mass[:, None] * shape)
    unloaded = (model.A @ state)[model.rate_index]
    found = np.linalg.solve(inertia, unloaded - shape.T @ free_force)
    return found, free_force + mass * (shape @ found)


def _event_times(model: ModalModel, loads: LoadSet, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Entry and exit of each load (load, 2), and the boundaries of legs without events, in s."""
    windows = np.asarray(loads.entry_exit_times())
    event_times = np.append(windows, loads.passage_times(model.modes.nodes))
    boundaries = np.unique(
        np.concatenate([[0.0, end], event_times[(event_times > 0) & (event_times < end)]])
    )
    return windows, boundaries[np.append(True, np.diff(boundaries) > 10 * EVENT_MARGIN * end)]


def _after_kinks(model: ModalModel, loads: LoadSet, kinks, passed, on_beam, time, state):
    """State after the passages of some indices, at one time (s), with the same momentum."""
    x, speed, _ = loads.kinematics(np.asarray(time))
    shape = model.shapes(np.where(on_beam, x, 0.0), (0,))[0]
    mass = np.where(on_beam, loads.inertia[:, 0], 0.0)
    inertia = np.eye(model.mode_count) + shape.T @ (mass[:, None] * shape)
    for i in passed:
        wheel = kinks.wheels[i]
        rise = np.abs(speed[wheel]) * (kinks.slope_jumps[i] @ state[model.coordinate_index])
        change = np.linalg.solve(inertia, mass[wheel] * rise * shape[wheel])
        state = np.array(state)
        state[model.rate_index] -= change
    return state


def _state_scales(case: Case, model: ModalModel, loads: LoadSet, end: float) -> np.ndarray:
    """Scales of the errors of the states: the slowest mode under the weight of all loads.

    A rigid-body mode is scaled as a mode of angular frequency 1 / duration.
    """
    stiffness = np.maximum(model.modes.stiffness, 1 / end**2)
    weight = np.sum(np.abs(loads.weight)) + np.finfo(float).tiny
    displacement = weight / np.sqrt(case.beam.linear_density * case.beam.length) / np.min(stiffness)
    modal_scale = displacement * np.stack([np.ones_like(stiffness), np.sqrt(stiffness)], -1).ravel()
    scales = np.ones(model.state_count)
    scales[: modal_scale.size] = modal_scale
    return scales
