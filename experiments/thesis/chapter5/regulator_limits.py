"""What section 5 says of optimal control beyond its tables: sampled gains, and stability.

Frozen poles are no criterion for a loop that changes with time, but they are what was published.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import jaxbeam as jb
from experiments.thesis.chapter5 import published
from experiments.thesis.verdicts import Finding, make_finding
from jaxbeam.analysis.stability import frozen_poles, growth
from jaxbeam.analysis.stability_limits import stability_limit
from jaxbeam.numerics.riccati import dlqr, stein
from jaxbeam.plot.poles import plot_poles

COMMAND_WEIGHT = 9e-8  # R of the example in 5.1
ACTIVE_STIFFNESS = 3500.0  # N/m
OTHER_SHAKER = "a shaker of 3.25 N/V that lags by 1 ms (alpha = beta = 1000)"
MAX_COST_RATIO = 1.001  # times the least cost: a gain that costs more is not the optimal one
SPEEDS = (0.55, 5.6)  # m/s, that of the experiments and that of Fig. 5.18
MASSES = (0.509, 6.5)  # kg
LOAD_POSITIONS = (
    201  # of the load, for which poles are found: they have a narrow peak near the exit
)


def with_active_shaker(rig: jb.Case) -> jb.Case:
    """The rig with its shaker as it is when it is driven."""
    return jb.replace(rig, {"actuators.0.stiffness": ACTIVE_STIFFNESS})


def with_other_shaker(rig: jb.Case) -> jb.Case:
    """The rig with the shaker that the printed gains of the sampled regulator belong to.

    Its two numbers were fitted to the twelve of the gains for 5 ms and for 10 ms.
    """
    return jb.replace(rig, {"actuators.0.force_per_volt": 3.25, "actuators.0.bandwidth": 1000.0})


def sampling_findings(rig: jb.Case, weights) -> list[Finding]:
    """Limits of sampling, and gains of the sampled regulator, of the rig with its shaker."""
    rig = with_active_shaker(rig)
    moved = jb.replace(rig, {"actuators.0.position": 0.25})
    moved = dataclasses.replace(moved, beam=dataclasses.replace(moved.beam, modes=2))
    two_mode_weights = [weights[i] for i in (0, 1, 3, 4, 6)]
    gains = (
        (published.SAMPLED_GAIN, rig, 5e-3, weights),
        (published.MOVED_SHAKER_GAIN, moved, 1e-2, two_mode_weights),
        (published.FAST_GAIN, rig, 2e-4, weights),
    )
    limits = make_finding(published.SAMPLING_LIMITS, jb.sampling_limit(rig))
    return [limits, *(_gain_finding(printed, *problem) for printed, *problem in gains)]


def optimal_gain(case, period: float, weights, effort: float = COMMAND_WEIGHT):
    """The gain that costs least in discrete time, and that cost; states as in the thesis."""
    plant = jb.state_space(case, "sine").unloaded.discretize(period)
    return dlqr(plant.A, plant.B, jnp.diag(jnp.array(weights)), effort * jnp.eye(1))


def _gain_finding(printed, case, period, weights) -> Finding:
    """A printed gain beside the optimal one; what is wrong with it, if it costs much more."""
    plant = jb.state_space(case, "sine").unloaded.discretize(period)
    Q, R = jnp.diag(jnp.array(weights)), COMMAND_WEIGHT * jnp.eye(1)
    best, least = optimal_gain(case, period, weights)
    printed_gain = jnp.array(printed.numbers)[None]
    closed = plant.A - plant.B @ printed_gain
    radius = np.abs(np.linalg.eigvals(np.asarray(closed))).max()
    obstacle = ""
    if radius >= 1:
        obstacle = (
            f"with the printed gain the loop it is for is unstable: {radius:.2g} times as much"
            " after each period"
        )
    else:
        cost = np.trace(np.asarray(stein(closed, Q + printed_gain.T @ R @ printed_gain)))
        cost_ratio = cost / np.trace(np.asarray(least))
        if cost_ratio > MAX_COST_RATIO:
            obstacle = (
                "with the printed gain the regulator of the stated rig costs"
                f" {100 * (cost_ratio - 1):.2g} % more than the least, which one gain alone attains"
            )
    other = np.asarray(optimal_gain(with_other_shaker(case), period, weights)[0])[0]
    return make_finding(printed, np.asarray(best)[0], {OTHER_SHAKER: other}, obstacle)


class TimeVaryingLoops(NamedTuple):
    """The time-varying loop with few states fed back, and with all; and how much of the way counts.

    Towards its end the gains of a finite time change fast, and frozen poles with them.
    """

    partial_feedback: jb.Case
    full_feedback: jb.Case
    crossing_share: float = 1.0


def frozen_pole_findings(interpretations: Mapping[str, TimeVaryingLoops]) -> list[Finding]:
    """Stability by frozen poles, of loops by name."""
    slow, fast = {"loads.0.speed": SPEEDS[0]}, {"loads.0.speed": SPEEDS[1]}
    unstable, limits = {}, {}
    for name, (few, every, share) in interpretations.items():

        def worst_real_part(case, share=share):
            return largest_real_part(case, share)

        few, every = (jb.replace(case, slow | {"loads.0.mass": MASSES[0]}) for case in (few, every))
        rates = (
            worst_real_part(few),
            worst_real_part(jb.replace(few, fast)),
            worst_real_part(jb.replace(every, fast)),
        )
        unstable[name] = np.array(rates) > 0
        limits[name] = np.array([
            _stability_limit(few, address, bounds, worst_real_part)
            for address, bounds in (("loads.0.speed", SPEEDS), ("loads.0.mass", MASSES))
        ])  # fmt: skip
    highest = np.max(list(limits.values()), axis=0)
    below = np.all(highest < published.FROZEN_POLE_LIMITS.numbers * (1 - 0.05))
    printed, *others = interpretations
    return [
        make_finding(
            published.UNSTABLE_FROZEN_POLES,
            unstable[printed].astype(float),
            {name: unstable[name].astype(float) for name in others},
        ),
        make_finding(
            published.FROZEN_POLE_LIMITS,
            limits[printed],
            {name: limits[name] for name in others},
            inconsistency=f"by every reading frozen poles are to the right from {highest[0]:.2g} m/s"
            f" and from {highest[1]:.2g} kg at the latest"
            if below
            else "",
        ),
    ]


def growth_remark(interpretations: Mapping[str, TimeVaryingLoops]) -> str:
    """What deviations do in the loops with few states, which frozen poles do not tell."""
    words = []
    for name, (few, _, share) in interpretations.items():
        if share < 1:
            continue
        for speed in SPEEDS:
            case = jb.replace(few, {"loads.0.speed": speed, "loads.0.mass": MASSES[0]})
            found = growth(case).factor
            words.append(
                f"{name}, {speed:g} m/s: frozen poles up to {largest_real_part(case):+.2g} 1/s, deviations at"
                f" most {found.max():.3g} times, {found[-1]:.1g} at the exit"
            )
    return "Few states, 0.509 kg. " + "; ".join(words)


def draw_poles(partial_feedback: jb.Case, interpretation: str) -> Figure:
    """Fig. 5.18, few states: frozen poles along a crossing; and what deviations do meanwhile.

    Poles are left out in the last twentieth of the way, where those of the lag run far to the left.
    """
    case = jb.replace(partial_feedback, {"loads.0.speed": SPEEDS[1], "loads.0.mass": MASSES[0]})
    times = np.linspace(0.0, 0.95 * float(case.beam.length) / SPEEDS[1], LOAD_POSITIONS)
    return plot_poles(
        frozen_poles(case, times), growth(case), f"Few states, {SPEEDS[1]:g} m/s; {interpretation}"
    )


def largest_real_part(case: jb.Case, crossing_share: float = 1.0) -> float:
    """The largest real part (1/s) of the frozen poles over a share of the crossing."""
    crossing = float(case.beam.length / case.loads[0].speed)
    return float(
        frozen_poles(
            case, crossing_share * np.linspace(0, crossing, LOAD_POSITIONS)[1:-1]
        ).largest_real_part.max()
    )


def _stability_limit(case, address, bounds, rate) -> float:
    """From which value of a number the loop is unstable; the lower bound if there already."""
    if rate(jb.replace(case, {address: bounds[0]})) > 0:
        return bounds[0]
    found = stability_limit(case, address, bounds[0], bounds[1], rate, points=5)
    return np.inf if found is None else found
