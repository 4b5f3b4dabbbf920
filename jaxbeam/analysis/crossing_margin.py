"""Stability along a crossing: the verdict, and the smallest margin over positions of the loads.

The verdict of every command and report is that of `stability_margin`.
"""

from typing import NamedTuple

import numpy as np

from jaxbeam.analysis.loops.stationary_loop import stationary_loops
from jaxbeam.analysis.margins import margins
from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.fields import concrete
from jaxbeam.control.predictive.mpc import MPC
from jaxbeam.estimation.kalman import Kalman

LOAD_POSITIONS = 13  # load positions along a crossing at which margins are computed
MIN_RATE = 1e-6  # 1/s; a pole whose real part is smaller counts as marginally stable


class UnstableInterval(NamedTuple):
    """Time interval in which a loop with stationary loads at their positions is unstable.

    From the first such time, `start` (s), to the last, `end` (s). `rate` (1/s) is the largest real
    part of the poles in between, `frequency` (Hz) that of its pole.
    """

    start: float
    end: float
    rate: float
    frequency: float


class StabilityMargin(NamedTuple):
    """Gain margin (factor) and delay margin (s) at one command, the smallest along the crossing.

    Loads are stationary, at LOAD_POSITIONS positions; a nonlinear law is linearised about the
    equilibrium under them, and limits of the actuators are left out. Both margins are zero if the
    loop is `unstable`, NaN if there are none, with the reason in `obstacle`.
    """

    gain: float
    delay: float
    obstacle: str = ""
    unstable: UnstableInterval | None = None

    @property
    def verdict(self) -> str:
        """The loop along the crossing: "stable", "unstable", or "undetermined"."""
        if self.obstacle:
            return "undetermined"
        return "stable" if self.unstable is None else "unstable"

    def __str__(self):
        if self.obstacle:
            return f"{self.verdict}: {self.obstacle}"
        if self.unstable is None:
            return "stable with stationary loads at all their positions"
        start, end, rate, frequency = self.unstable
        return (
            f"unstable with stationary loads at their positions of t = {start:.3g} to {end:.3g} s:"
            f" deviations grow by {rate:.3g} 1/s at {frequency:.3g} Hz, so lower the gains, or"
            " shorten filters and delays"
        )


def stability_margin(case: Case, verdict_only: bool = False) -> StabilityMargin:
    """Stability margin of the closed loop of a case, the smallest along the crossing.

    With `verdict_only` the margins of a stable loop are NaN: they take longer than its poles.

    Stationary loads lack the velocity terms of moving ones, which act as damping of either sign;
    `stability.growth` includes these.
    """
    controller = case.controller
    if controller is None or controller.open_loop:
        return _no_margin("commands that do not depend on readings close no loop")
    if isinstance(controller, MPC) and controller.solver != "unconstrained":
        return _no_margin("a constrained MPC law is not linear at its limits")
    if controller.period is not None and _has_varying_filter(controller):
        return _no_margin("the gain of the filter varies with its estimates")
    try:
        times = _crossing_times(case)
        found = stationary_loops(case, times)
    except ValueError as error:
        return _no_margin(str(error))
    loops, unstable = [], []
    for t, stationary in zip(times, found, strict=True):
        if not np.all(np.isfinite(stationary.closed_matrix)):
            return _no_margin("the law has no equilibrium under stationary loads")
        rightmost = complex(stationary.poles()[0])
        if abs(rightmost.real) < MIN_RATE:
            return _no_margin("the loop has a marginally stable pole, as of a mode without damping")
        if rightmost.real > 0:
            unstable.append((float(t), rightmost.real, abs(rightmost.imag) / (2 * np.pi)))
        loops.append(stationary)
    if unstable:
        _, rate, frequency = max(unstable, key=lambda one: one[1])
        return StabilityMargin(
            0.0, 0.0, "", UnstableInterval(unstable[0][0], unstable[-1][0], rate, frequency)
        )
    if verdict_only:
        return StabilityMargin(np.nan, np.nan)
    with np.errstate(divide="ignore"):  # infinite margin of a loop without gain
        margins_found = [margins(one, i) for one in loops for i in range(len(case.actuators))]
    return StabilityMargin(
        min(one.gain for one in margins_found), min(one.delay for one in margins_found)
    )


def _has_varying_filter(controller) -> bool:
    """Whether a filter propagates its covariance, other than one that settles (`settled_law`)."""
    estimator = getattr(controller, "estimator", None)
    return estimator is not None and estimator.varies and not isinstance(estimator, Kalman)


def _no_margin(obstacle: str) -> StabilityMargin:
    return StabilityMargin(np.nan, np.nan, obstacle)


def _crossing_times(case: Case) -> np.ndarray:
    """Times (s) from the first entry to the last exit, at most the end of the run."""
    if not case.loads:
        return np.zeros(1)
    entries, exits = crossing_times(case).T
    return np.linspace(entries.min(), min(exits.max(), concrete(case.run.duration)), LOAD_POSITIONS)
