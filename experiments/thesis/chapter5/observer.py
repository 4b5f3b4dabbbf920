"""Sampled regulator with an observer in its loop: Figs 5.4 to 5.9.

For the rig of Fig. 5.5 at 0.2 ms, for 5 ms with the shaker where it is, and for 10 ms with two
modes and the shaker at 0.25 m. The observer is given the true weight of the load.
"""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.cases import reduction, with_modes
from experiments.thesis.chapter5 import published
from experiments.thesis.chapter5.observer_loop import (
    SENSOR,
    ObservedLoop,
    design,
    simulate_observed,
)
from experiments.thesis.chapter5.regulator_limits import (
    COMMAND_WEIGHT,
    OTHER_SHAKER,
    TWO_MODE_STATES,
    with_active_shaker,
    with_other_shaker,
)
from experiments.thesis.verdicts import LITERAL, Finding, make_finding
from jaxbeam.plot.style import GREY, colour, set_title, use_style

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
    """What the sampling period costs: reductions, and how far the observer is off."""
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
            moved_slow, moved_fast[1], "10 ms, shaker at 0.25 m, two modes (Figs 5.8, 5.9)"
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
    set_title(figure, f"Regulator with an observer, sampled every {title}")
    return figure
