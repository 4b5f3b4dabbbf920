"""The adaptive reference beside the fast integrator: slow, readable, for checking.

With a load of mass m and weight W at x(t), the mode shapes s there with their derivatives s' and
s'', and all loads on the beam summed, the mass-matrix form of the equations of motion is

    (I + m s s^T) q'' = (rig without loads) - s (W + m (2 x' s'^T q' + x'^2 s''^T q + x'' s'^T q)),

eqs (2.11) to (2.16) of the thesis, solved for q'' at every instant. No collocation of contact
forces: an embedded Runge-Kutta pair (Dopri8 of diffrax) chooses its own steps, from event to event.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.case import Case, known_case
from jaxbeam.case.validation import check
from jaxbeam.model.contact import Traffic, traffic
from jaxbeam.model.modal_model import Rig, rig_in_one
from jaxbeam.runtime.compiling import compiled

BREATH = 1e-14  # of the run: motions are asked for so far from their kinks, on the leg's own side


class AdaptiveRun(eqx.Module):
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
) -> AdaptiveRun:
    """Simulate a case as `jaxbeam.simulate` does, from rest at t = 0, by adaptive steps.

    Samples at the ascending `times` (s); `tolerance` is the error allowed a step, relative to the
    size the slowest mode is likely to reach. Neither differentiable nor for use inside `jit`.
    Raises ValueError for a faulty case.
    """
    check(case)
    case, times = known_case(case), jnp.asarray(times, float)
    assembled, loads = rig_in_one(case), traffic(case)
    windows, edges = _events(assembled, loads, float(times[-1]))
    allowed = tolerance * _size(case, assembled, loads, float(times[-1]))
    state, histories = jnp.zeros(assembled.states), []
    for start, stop in itertools.pairwise(edges):
        middle = (start + stop) / 2
        on = (windows[:, 0] < middle) & (middle < windows[:, 1])
        leg = np.array([start, stop])
        state, found = _solve(assembled, loads, state, leg, on, times, allowed)
        after = (times >= start)[:, None]
        older = histories or found
        histories = [jnp.where(after, new, old) for new, old in zip(found, older, strict=True)]
    coordinates, rates, accelerations, force = histories
    deflection = coordinates @ assembled.shapes(case.sensor_places, (0,))[0].T
    if assembled.mixing is not None:
        coordinates, rates, accelerations = (
            part @ assembled.mixing.T for part in (coordinates, rates, accelerations)
        )
    return AdaptiveRun(times, coordinates, rates, accelerations, force, deflection)


def _events(rig: Rig, loads: Traffic, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Entry and exit of every load (load, 2), and the edges of legs without events, in s."""
    windows = np.array([path.window() for path in loads.motions]).reshape(-1, 2)
    kinks = [np.asarray(path.passage_times(rig.modes.nodes)) for path in loads.motions]
    found = np.concatenate([windows.ravel(), *kinks])
    edges = np.unique(np.concatenate([[0.0, end], found[(found > 0) & (found < end)]]))
    return windows, edges[np.append(True, np.diff(edges) > 10 * BREATH * end)]


@compiled
def _solve(rig: Rig, loads: Traffic, state, leg, on, times, allowed):
    """State at the end of a leg, and coordinates, rates, accelerations and forces at the times.

    What is returned for times outside the leg means nothing.
    """
    import diffrax

    start, stop = leg
    count = rig.modes.stiffness.shape[0]
    place, rate = np.arange(0, 2 * count, 2), np.arange(1, 2 * count, 2)
    matrix = rig.state_matrix[0]
    mass = jnp.where(on, loads.inertia[:, 0], 0.0)
    weight = jnp.where(on, loads.weight[:, 0], 0.0)

    def accelerations(t, state):
        """Of the modes, and the forces with which the loads press."""
        breath = BREATH * times[-1]
        x, speed, braking = loads.travel(jnp.clip(t, start + breath, stop - breath))
        shape, slope, curvature = rig.shapes(jnp.where(on, x, 0.0), (0, 1, 2))
        q, u = state[place], state[rate]
        follow = 2 * speed * (slope @ u) + speed**2 * (curvature @ q) + braking * (slope @ q)
        push = weight + mass * follow
        inertia = jnp.eye(count) + shape.T @ (mass[:, None] * shape)
        second = jnp.linalg.solve(inertia, (matrix @ state)[rate] - shape.T @ push)
        return second, push + mass * (shape @ second)

    def motion(t, state, _):
        return (matrix @ state).at[rate].set(accelerations(t, state)[0])

    def save(t, state, _):
        return state, state[place], state[rate], *accelerations(t, state)

    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(motion),
        diffrax.Dopri8(),
        t0=start,
        t1=stop,
        dt0=None,
        y0=state,
        saveat=diffrax.SaveAt(ts=jnp.append(jnp.clip(times, start, stop), stop), fn=save),
        stepsize_controller=diffrax.PIDController(
            rtol=0.0, atol=1.0, norm=lambda error: jnp.max(jnp.abs(error / allowed))
        ),
        max_steps=None,
        adjoint=diffrax.ForwardMode(),
    )
    states, *histories = jax.tree.leaves(solution.ys)
    return states[-1], [history[:-1] for history in histories]


def _size(case: Case, rig: Rig, loads: Traffic, end: float) -> Float[Array, " state"]:
    """What errors of the states are measured against: the slowest mode under all the weight.

    A rigid-body mode has all of the run to move away.
    """
    stiffness = jnp.maximum(rig.modes.stiffness, 1 / end**2)
    weight = jnp.sum(jnp.abs(loads.weight)) + jnp.finfo(float).tiny
    far = weight / jnp.sqrt(case.beam.linear_density * case.beam.length) / jnp.min(stiffness)
    modal = far * jnp.stack([jnp.ones_like(stiffness), jnp.sqrt(stiffness)], axis=-1).ravel()
    return jnp.ones(rig.states).at[: modal.shape[0]].set(modal)
