"""The sampled regulator with a real observer in its loop, eqs (5.3) to (5.6).

    x(k+1) = A_m(k) x(k) + B_m(k) u(k) + B_f(k) u_f(k),   y(k) = C x(k) + v(k),   u = -K xh
    xh(k+1) = (A - B K - L C) xh(k) + L y(k) + B_f u_f(k)

The plant has the mass at one of 240 positions along the beam, the observer does not; both
have its weight, the true one. K is the optimal gain of the sampled beam without a load, L that of
the dual problem. States are amplitudes of sine modes (m), their rates, and the shaker's.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.linalg import expm, solve_discrete_are

import jaxbeam as jb

OBSERVER_WEIGHT = 1e6  # R of the observer, 5.1
NOISE_VARIANCES = np.array([0.0365, 0.135, 0.0729]) * 1e-10  # m^2, of the three sensors, 5.1
SENSOR = 1  # at 0.25 m: the one that the observer reads
SEED = 0
POSITIONS = 240  # of the load, at which the plant is frozen


class ObservedLoop(NamedTuple):
    """A run: times (s), states of plant and observer, and commands (V), one row for each sample."""

    times: Float[np.ndarray, " sample"]
    states: Float[np.ndarray, "sample state"]
    estimates: Float[np.ndarray, "sample state"]
    commands: Float[np.ndarray, " sample"]
    deflection: Float[np.ndarray, "sample sensor"]


class LoopGains(NamedTuple):
    """Gain of the regulator (state,) and of the observer (state,), at one sampling period (s)."""

    regulator: Float[np.ndarray, " state"]
    observer: Float[np.ndarray, " state"]


def sampled(A, B, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Matrices of a system, or of each of several, whose inputs are held over a period (s)."""
    *systems, states, inputs = B.shape
    both = np.zeros((*systems, states + inputs, states + inputs))
    both[..., :states, :] = np.concatenate([A, B], axis=-1)
    exponential = expm(period * both)
    return exponential[..., :states, :states], exponential[..., :states, states:]


def design(case: jb.Case, period: float, state_weights, command_weight: float) -> LoopGains:
    """LoopGains of the regulator and of the observer of the beam without its load."""
    plant = jb.state_space(case, "sine").unloaded
    A, B = sampled(np.asarray(plant.A), np.asarray(plant.B), period)
    C, Q = np.asarray(plant.C)[SENSOR : SENSOR + 1], np.diag(state_weights)
    cost = solve_discrete_are(A, B, Q, [[command_weight]])
    regulator = np.linalg.solve(command_weight + B.T @ cost @ B, B.T @ cost @ A)[0]
    cost = solve_discrete_are(A.T, C.T, Q, [[OBSERVER_WEIGHT]])
    observer = (A @ cost @ C.T / (OBSERVER_WEIGHT + C @ cost @ C.T))[:, 0]
    return LoopGains(regulator, observer)


def simulate_observed(
    case: jb.Case,
    period: float,
    gains: LoopGains | None,
    noisy: bool = True,
    after_exit: float = 0.0,
) -> ObservedLoop:
    """Run of a case with one mass, until some time (s) after it has left.

    Without `gains` there is no control, and the estimates stay zero.
    """
    plant = jb.state_space(case, "sine")
    free = plant.unloaded
    A, C = np.asarray(free.A), np.asarray(free.C)
    weight = float(plant.weights[0])
    crossing = float(case.beam.length / case.loads[0].speed)
    count = round((crossing + after_exit) / period)
    times = period * np.arange(count + 1)
    noise = np.zeros((count + 1, len(C)))
    if noisy:
        deviations = np.sqrt(NOISE_VARIANCES)[: len(C)]
        noise = deviations * np.random.default_rng(SEED).normal(size=noise.shape)
    force = dataclasses.replace(
        case, loads=(jb.MovingForce(mass=case.loads[0].mass, speed=case.loads[0].speed),)
    )
    weight_only = jb.state_space(force, "sine")
    positions = np.linspace(0.0, crossing, POSITIONS + 1)[:-1] + crossing / POSITIONS / 2
    loaded = _sampled_at(plant, [*positions, crossing + period], period)
    weights = _sampled_at(weight_only, [*positions, crossing + period], period)
    state, estimate = np.zeros(len(A)), np.zeros(len(A))
    states, estimates, commands = [], [], []
    for k, t in enumerate(times):
        command = 0.0 if gains is None else -float(gains.regulator @ estimate)
        states.append(state)
        estimates.append(estimate)
        commands.append(command)
        segment = min(int((t + period / 2) / crossing * POSITIONS), POSITIONS)
        inputs = np.array([command, weight])
        reading = C[SENSOR] @ state + noise[k, SENSOR]
        state = loaded[segment][0] @ state + loaded[segment][1] @ inputs
        if gains is not None:
            estimate = (
                weights[segment][0] @ estimate
                + weights[segment][1] @ inputs
                + gains.observer * (reading - C[SENSOR] @ estimate)
            )
    states, estimates = np.array(states), np.array(estimates)
    return ObservedLoop(times, states, estimates, np.array(commands), states @ C.T)


def _sampled_at(plant, times, period: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Sampled matrices of the plant with its load frozen at some times (s)."""
    systems = plant.at(np.array(times))
    pairs = sampled(np.asarray(systems.A), np.asarray(systems.B), period)
    return list(zip(*pairs, strict=True))
