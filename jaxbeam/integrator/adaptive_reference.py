"""Reference integrator with adaptive steps, slow and readable, to validate the fast one.

With a load of mass m and weight W at x(t), the mode shapes s there with their derivatives s' and
s'', and all loads on the beam summed, the mass-matrix form of the equations of motion is

    (I + m s s^T) q'' = (unloaded model) - s (W + m (2 x' s'^T q' + x'^2 s''^T q + x'' s'^T q)),

eqs (2.11) to (2.16) of the thesis, solved for q'' at every instant. Contact forces are not
collocated: an embedded Runge-Kutta pair (Dopri8 of diffrax) chooses its steps, event by event.
Where a load passes a kink of the beam, the momentum (I + sum m s s^T) q' + sum m s x' s'^T q stays.
"""

import itertools

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.validation import check_case
from jaxbeam.integrator.kinks.passages import kink_passages
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, compiled_modal_model
from jaxbeam.runtime.arrays import Array, set_at, xp
from jaxbeam.runtime.compiling import compiled
from jaxbeam.runtime.module import Module

EVENT_MARGIN_SHARE = (
    1e-14  # of the duration: kinematics are evaluated at least this far from events
)


class AdaptiveSolution(Module):
    """A run by the adaptive integrator: histories in SI units, deflection positive upwards.

    `contact_force` is positive where the load presses on the beam and zero off the beam. Samples
    at the time of an event are those just after it.
    """

    times: Float[Array, " time"]
    coordinates: Float[Array, "time mode"]
    rates: Float[Array, "time mode"]
    accelerations: Float[Array, "time mode"]
    contact_force: Float[Array, "time load"]
    deflection: Float[Array, "time sensor"]


def simulate_adaptive(
    case: Case, times: Float[Array, " time"], tolerance: float = 1e-12
) -> AdaptiveSolution:
    """Simulate a case as `jaxbeam.simulate` does, from rest at t = 0, with adaptive steps.

    Samples are at the ascending `times` (s). `tolerance` bounds the error of a step relative to the
    static deflection of the slowest mode. Neither differentiable nor usable inside `jit`. Raises
    ValueError for an invalid case.
    """
    check_case(case)
    case, times = concrete_case(case), xp.asarray(times, float)
    model, loads = compiled_modal_model(case), load_set(case)
    kinks = kink_passages(case, model, loads)
    windows, legs = _event_times(model, loads, float(times[-1]))
    absolute_tolerance = tolerance * _state_scales(case, model, loads, float(times[-1]))
    state, histories = xp.zeros(model.state_count), []
    for start, stop in itertools.pairwise(legs):
        middle = (start + stop) / 2
        on_beam = (windows[:, 0] < middle) & (middle < windows[:, 1])
        leg = np.array([start, stop])
        state, leg_histories = _solve_leg(
            model, loads, state, leg, on_beam, times, absolute_tolerance
        )
        if kinks is not None:
            at_end = np.abs(kinks.times - stop) <= 10 * EVENT_MARGIN_SHARE * float(times[-1])
            passed = np.flatnonzero(at_end & kinks.happen(windows, times[0], times[-1]))
            state = _after_kinks(model, loads, kinks, passed, on_beam, stop, state)
        in_leg = (times >= start)[:, None]
        previous = histories or leg_histories
        histories = [
            xp.where(in_leg, new, old) for new, old in zip(leg_histories, previous, strict=True)
        ]
    coordinates, rates, accelerations, force = histories
    deflection = coordinates @ model.shapes(case.sensor_positions, (0,))[0].T
    if model.mode_map is not None:
        coordinates, rates, accelerations = (
            part @ model.mode_map.T for part in (coordinates, rates, accelerations)
        )
    return AdaptiveSolution(times, coordinates, rates, accelerations, force, deflection)


def _event_times(model: ModalModel, loads: LoadSet, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Entry and exit of each load (load, 2), and the boundaries of legs without events, in s."""
    windows = np.asarray(loads.entry_exit_times())
    event_times = np.append(windows, loads.passage_times(model.modes.nodes))
    boundaries = np.unique(
        np.concatenate([[0.0, end], event_times[(event_times > 0) & (event_times < end)]])
    )
    return windows, boundaries[np.append(True, np.diff(boundaries) > 10 * EVENT_MARGIN_SHARE * end)]


def _after_kinks(model: ModalModel, loads: LoadSet, kinks, passed, on_beam, time, state):
    """State after the passages of some indices, at one time (s), with the same momentum."""
    x, speed, _ = loads.kinematics(xp.asarray(time))
    shape = model.shapes(xp.where(on_beam, x, 0.0), (0,))[0]
    mass = xp.where(on_beam, loads.inertia[:, 0], 0.0)
    inertia = xp.eye(model.mode_count) + shape.T @ (mass[:, None] * shape)
    for i in passed:
        wheel = kinks.wheels[i]
        rise = xp.abs(speed[wheel]) * (kinks.slope_jumps[i] @ state[model.coordinate_index])
        change = xp.linalg.solve(inertia, mass[wheel] * rise * shape[wheel])
        state = set_at(state, model.rate_index, state[model.rate_index] - change)
    return state


@compiled
def _solve_leg(
    model: ModalModel, loads: LoadSet, state, interval, on_beam, times, absolute_tolerance
):
    """State at the end of a leg, and coordinates, rates, accelerations and forces at the times.

    Values at times outside the leg are meaningless.
    """
    import diffrax

    start, stop = interval
    count, matrix = model.mode_count, model.A
    mass = xp.where(on_beam, loads.inertia[:, 0], 0.0)
    weight = xp.where(on_beam, loads.weight[:, 0], 0.0)

    def accelerations(t, state):
        """Modal accelerations, and contact forces (N, downwards on the beam)."""
        offset = EVENT_MARGIN_SHARE * times[-1]
        x, speed, acceleration = loads.kinematics(xp.clip(t, start + offset, stop - offset))
        shape, slope, curvature = model.shapes(xp.where(on_beam, x, 0.0), (0, 1, 2))
        q, u = state[model.coordinate_index], state[model.rate_index]
        convective = (
            2 * speed * (slope @ u) + speed**2 * (curvature @ q) + acceleration * (slope @ q)
        )
        free_force = weight + mass * convective
        inertia = xp.eye(count) + shape.T @ (mass[:, None] * shape)
        modal_acceleration = xp.linalg.solve(
            inertia, (matrix @ state)[model.rate_index] - shape.T @ free_force
        )
        return modal_acceleration, free_force + mass * (shape @ modal_acceleration)

    def state_rate(t, state, _):
        return set_at(matrix @ state, model.rate_index, accelerations(t, state)[0])

    def save(t, state, _):
        return (
            state,
            state[model.coordinate_index],
            state[model.rate_index],
            *accelerations(t, state),
        )

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(state_rate),
        diffrax.Dopri8(),
        t0=start,
        t1=stop,
        dt0=None,
        y0=state,
        saveat=diffrax.SaveAt(ts=xp.append(xp.clip(times, start, stop), stop), fn=save),
        stepsize_controller=diffrax.PIDController(
            rtol=0.0, atol=1.0, norm=lambda error: xp.max(xp.abs(error / absolute_tolerance))
        ),
        max_steps=None,
        adjoint=diffrax.ForwardMode(),
    )
    states, *histories = jax.tree.leaves(solution.ys)
    return states[-1], [history[:-1] for history in histories]


def _state_scales(
    case: Case, model: ModalModel, loads: LoadSet, end: float
) -> Float[Array, " state"]:
    """Scales of the errors of the states: the slowest mode under the weight of all loads.

    A rigid-body mode is scaled as a mode of angular frequency 1 / duration.
    """
    stiffness = xp.maximum(model.modes.stiffness, 1 / end**2)
    weight = xp.sum(xp.abs(loads.weight)) + xp.finfo(float).tiny
    displacement = weight / xp.sqrt(case.beam.linear_density * case.beam.length) / xp.min(stiffness)
    modal_scale = (
        displacement * xp.stack([xp.ones_like(stiffness), xp.sqrt(stiffness)], axis=-1).ravel()
    )
    return set_at(xp.ones(model.state_count), np.s_[: modal_scale.shape[0]], modal_scale)
