"""Sampled regulator with an observer in its loop: Figs 5.4 to 5.9.

For the rig of Fig. 5.5 at 0.2 ms, for 5 ms with the shaker where it is, and for 10 ms with two
modes and the shaker at 0.25 m. The observer is given the true weight of the load.

The sampled regulator with a real observer in its loop, eqs (5.3) to (5.6).

    x(k+1) = A_m(k) x(k) + B_m(k) u(k) + B_f(k) u_f(k),   y(k) = C x(k) + v(k),   u = -K xh
    xh(k+1) = (A - B K - L C) xh(k) + L y(k) + B_f u_f(k)

The plant has the mass at one of 240 positions along the beam, the observer does not; both
have its weight, the true one. K is the optimal gain of the sampled beam without a load, L that of
the dual problem. States are amplitudes of sine modes (m), their rates, and the shaker's.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.linalg import expm, solve_discrete_are

import jaxbeam as jb
from experiments.thesis.cases import reduction, with_modes
from experiments.thesis.chapter5 import published
from experiments.thesis.chapter5.regulator_limits import (
    COMMAND_WEIGHT,
    OTHER_SHAKER,
    TWO_MODE_STATES,
    with_active_shaker,
    with_other_shaker,
)
from experiments.thesis.verdicts import LITERAL, Finding, make_finding
from jaxbeam.plot.style import GREY, colour, set_title, use_style

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
    deviations = np.sqrt(NOISE_VARIANCES)[: len(C)]
    noise = deviations * np.random.default_rng(SEED).normal(size=(count + 1, len(C)))
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


PERIOD, MASS, SPEED = 2e-4, 0.501, 0.5  # s, kg, m/s, of Fig. 5.4
AFTER_EXIT = 0.3  # s, drawn after the load has left
CONTINUOUS = "0.2 ms"  # nearest to the continuous loop of the thesis's figures


def observed_regulator(
    rig: jb.Case, state_weights, command_weight: float
) -> tuple[Finding, dict[str, Figure], str]:
    """Reduction (%) of the peak by the observed regulator, figures by name, and a sentence.

    `command_weight` is the other printed R, that of the experiments.
    """
    rig = jb.replace(with_active_shaker(rig), {"loads.0.mass": MASS, "loads.0.speed": SPEED})
    readings = {
        LITERAL: (rig, COMMAND_WEIGHT),
        f"R = {command_weight:g}, as in the experiments": (rig, command_weight),
        OTHER_SHAKER: (with_other_shaker(rig), COMMAND_WEIGHT),
    }
    values = {}
    for name, (case, weight) in readings.items():
        gains = design(case, PERIOD, state_weights, weight)
        pair = (simulate_observed(case, PERIOD, each) for each in (None, gains))
        values[name] = _peak_reduction(*pair)
    literal = values.pop(LITERAL)
    finding = make_finding(published.OBSERVED_REGULATOR, literal, values, null=("no control", 0.0))
    loops = sampled_loops(with_other_shaker(rig), state_weights)
    return finding, _figures(loops), _remark(loops)


def sampled_loops(rig: jb.Case, state_weights) -> dict[str, tuple[ObservedLoop, ...]]:
    """Runs without control and under the observed regulator, by sampling period, with noise."""
    moved = with_modes(jb.replace(rig, {"actuators.0.position": 0.25}), 2)
    two_mode_weights = [state_weights[i] for i in TWO_MODE_STATES]
    problems = {
        CONTINUOUS: (rig, PERIOD, state_weights),
        "5 ms": (rig, 5e-3, state_weights),
        "10 ms, shaker at 0.25 m": (moved, 1e-2, two_mode_weights),
        "0.2 ms, shaker at 0.25 m": (moved, PERIOD, two_mode_weights),
    }
    loops = {}
    for name, (case, period, weights) in problems.items():
        gains = design(case, period, weights, COMMAND_WEIGHT)
        loops[name] = (
            simulate_observed(case, period, None, after_exit=AFTER_EXIT),
            simulate_observed(case, period, gains, after_exit=AFTER_EXIT),
        )
    return loops


def _peak_reduction(uncontrolled: ObservedLoop, controlled: ObservedLoop) -> float:
    """Reduction (%) of the peak at 0.25 m."""
    free, held = (np.abs(one.deflection[:, SENSOR]).max() for one in (uncontrolled, controlled))
    return float(reduction(free, held))


def _remark(loops: Mapping[str, tuple[ObservedLoop, ...]]) -> str:
    """Sentence on the effect of the sampling period: reductions, and errors of the observer."""
    parts = []
    for name, (uncontrolled, controlled) in loops.items():
        q1, estimated = controlled.states[:, 0], controlled.estimates[:, 0]
        off = 100 * np.abs(q1 - estimated).max() / np.abs(q1).max()
        change = _peak_reduction(uncontrolled, controlled)
        side = "below" if change > 0 else "above"
        parts.append(
            f"{name}: peak at 0.25 m {abs(change):.0f} % {side} no control, q1 of the observer off"
            f" by at most {off:.2g} % of its largest"
        )
    return f"Observer in the loop, {OTHER_SHAKER}. " + "; ".join(parts)


def _figures(loops) -> dict[str, Figure]:
    fast, slow, moved_slow, moved_fast = loops.values()
    return {
        "observed-0.2ms": _draw(fast, None, "0.2 ms (Figs 5.4, 5.5, 5.7)"),
        "observed-5ms": _draw(slow, fast[1], "5 ms (Figs 5.6, 5.7)"),
        "observed-10ms": _draw(
            moved_slow, moved_fast[1], "10 ms, shaker at 0.25 m (Figs 5.8, 5.9)"
        ),
    }


@use_style
def _draw(loops: tuple[ObservedLoop, ...], reference: ObservedLoop | None, title: str):
    """Modal coordinates of plant and observer, deflection at 0.25 m, and voltage.

    The `reference` is the same loop sampled every 0.2 ms.
    """
    uncontrolled, controlled = loops
    modes = (controlled.states.shape[1] - 1) // 2
    figure = Figure(figsize=(7.2, 1.6 * (modes + 2)))
    *rows, deflection, voltage = figure.subplots(modes + 2, 1, sharex=True, squeeze=False)[:, 0]
    times = controlled.times
    for i, axes in enumerate(rows):
        if reference is not None:
            axes.plot(reference.times, 1e3 * reference.states[:, i], color=GREY, label=CONTINUOUS)
        axes.plot(times, 1e3 * controlled.states[:, i], color=colour(0), label="plant")
        axes.plot(times, 1e3 * controlled.estimates[:, i], "--", color=colour(1), label="observer")
        axes.set_ylabel(f"q{i + 1} (mm)")
    free, held = (1e3 * one.deflection[:, SENSOR] for one in loops)
    deflection.plot(uncontrolled.times, free, color=GREY, label="no control")
    deflection.plot(times, held, color=colour(0), label="observed regulator")
    deflection.set_ylabel("at 0.25 m (mm)")
    deflection.legend(loc="lower right")
    voltage.plot(times, controlled.commands, color=colour(2), drawstyle="steps-post")
    voltage.set(ylabel="voltage (V)", xlabel="time (s)", xlim=(0, times[-1]))
    rows[0].legend(loc="lower right", ncols=3)
    set_title(figure, f"Regulator with an observer, every {title}")
    return figure
