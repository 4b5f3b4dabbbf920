"""Stability margins: of loops at rest, and along a crossing.

The loop is broken at one command while the others stay closed.

The verdict of every command and report is that of `stability_margin`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import scipy  # loads its parts on first use
from jaxtyping import Float

from jaxbeam.analysis.linearised_loop import LinearisedLoop
from jaxbeam.analysis.stationary_loop import stationary_loops
from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.control.predictive.mpc import MPC
from jaxbeam.estimation.kalman import Kalman

POINTS_PER_POLE = 400  # frequencies around each pole
MAX_CONDITION = 1e12  # condition of the eigenvectors above which the matrix counts as defective
BISECTIONS = 50  # of the intervals between frequencies, down to rounding
REFINEMENTS, REFINED_POINTS = 8, 21  # of the frequencies around the smallest distance
LOWEST_FREQUENCY = 1e-3  # lowest frequency of the grid, relative to that of the lowest pole


class Margins(NamedTuple):
    """Margins of a loop broken at one command.

    The loop stays stable for gain factors between `lower_gain` and `gain`, an additional phase lag
    below `phase` (rad) and an additional delay below `delay` (s). `modulus_margin` is the smallest
    distance of the Nyquist curve from the critical point. Without a limit a margin is infinite,
    `lower_gain` zero.
    """

    gain: float
    lower_gain: float
    phase: float
    delay: float
    modulus_margin: float


def margins(loop: LinearisedLoop, actuator: int = 0) -> Margins:
    """Margins of a stable loop at one command, from the frequency response of the loop gain.

    The loop gain is that of `loop_gain`. Raises ValueError for an unstable loop.
    """
    if np.any(loop.poles().real >= 0):
        raise ValueError("margins need a stable closed loop, and this one is unstable")
    omega, response = loop_gain(loop, actuator)
    curve = response(omega)

    def crossings(function):
        signs = np.sign(function(curve))
        before = np.flatnonzero(signs[:-1] * signs[1:] < 0)
        low, high = omega[before], omega[before + 1]
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            below = np.sign(function(response(middle))) == signs[before]
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return (low + high) / 2

    gains = [1 / value.real for value in response(crossings(np.imag))]
    ends = (value for value in (curve[0], curve[-1]) if abs(value.imag) < 1e-9)
    gains += [1 / value.real for value in ends if value.real != 0]
    at_unity = crossings(lambda z: np.abs(z) - 1)
    # Additional lags that turn the response onto the critical point, at angle zero.
    lags = np.angle(response(at_unity)) % (2 * np.pi)
    grid, distance = omega, np.abs(1 - curve)
    for _ in range(REFINEMENTS):
        nearest = int(np.argmin(distance))
        low, high = grid[max(nearest - 1, 0)], grid[min(nearest + 1, grid.size - 1)]
        grid = np.union1d(np.linspace(low, high, REFINED_POINTS), grid[nearest])
        distance = np.abs(1 - response(grid))
    found = Margins(
        gain=min((g for g in gains if g > 1), default=np.inf),
        lower_gain=max((g for g in gains if 0 < g < 1), default=0.0),
        phase=np.min(np.minimum(lags, 2 * np.pi - lags), initial=np.inf),
        delay=np.min(lags / at_unity, initial=np.inf),
        modulus_margin=np.min(distance),
    )
    return Margins(*map(float, found))


def loop_gain(
    loop: LinearisedLoop, actuator: int = 0
) -> tuple[Float[np.ndarray, " frequency"], Callable]:
    """Frequencies (rad/s) that resolve the loop gain L at one command, and L as their function.

    L(s) = K (s - A)^-1 B, with s = i omega, or exp(i omega period) in a sampled loop, broken at the
    command while the others stay closed; the critical point is 1, as u = L u.
    """
    A, B, K = (np.asarray(concrete(part)) for part in (loop.A, loop.B, loop.K))
    others = np.arange(B.shape[1]) != actuator
    A = A + B[:, others] @ K[others]
    values, transfer = _transfer_function(A, B[:, actuator], K[actuator])

    def response(omega):
        s = 1j * np.atleast_1d(omega)
        return transfer(s if loop.period is None else np.exp(s * loop.period))

    return _frequency_grid(values, loop.period), response


def _transfer_function(A, column, row):
    """Poles of row (s - A)^-1 column, and this as a function of s (frequency,) in rad/s, or z."""
    values, vectors = np.linalg.eig(A)
    if np.linalg.cond(vectors) < MAX_CONDITION:
        # Partial fractions: one division per frequency and pole.
        residues = (row @ vectors) * np.linalg.solve(vectors, column.astype(complex))
        return values, lambda s: (residues / (s[:, None] - values)).sum(axis=1)
    # Delays of several periods make A defective: Schur form and back substitution.
    schur_form = scipy.linalg.schur(A, output="complex")
    triangle, basis = np.asarray(schur_form[0]), np.asarray(schur_form[1])
    row, column = row @ basis, basis.conj().T @ column

    def transfer(s):
        solution = np.zeros((column.size, s.size), complex)
        for i in reversed(range(column.size)):
            rest = column[i] + triangle[i, i + 1 :] @ solution[i + 1 :]
            solution[i] = rest / (s - triangle[i, i])
        return row @ solution

    return np.diag(triangle), transfer


def _frequency_grid(poles, period) -> np.ndarray:
    """Frequencies (rad/s), ascending, that resolve each peak of a response with these poles."""
    if period is not None:
        poles = np.log(np.where(poles == 0, np.finfo(float).tiny, poles)) / period
    size = np.abs(poles[poles != 0])
    highest = 1e3 * size.max() if period is None else np.pi / period
    grid = [
        np.geomspace(min(LOWEST_FREQUENCY * size.min(), highest / 2), highest, 4 * POINTS_PER_POLE)
    ]
    for pole in poles:
        # Densest within the half-width of the peak.
        grid.append(pole.imag + abs(pole.real) * np.sinh(np.linspace(-6, 6, POINTS_PER_POLE)))
    omega = np.unique(np.concatenate(grid))
    return omega[(omega > 0) & (omega <= highest)]


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


@refuses_traced("a margin of stability")
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
