"""Stability of loops with loads: margins, largest real parts, and the limits of parameters.

Frozen poles, those of the loop with its loads frozen in one position, describe slow crossings only:
the stability of a time-varying loop does not follow from them. It follows from the transition
matrix: the growth of deviations over a crossing, and the Floquet multipliers of a periodic stream
of equal loads.

For margins the loop is broken at one command while the others stay closed. The verdict of every
command and report is that of `stability_margin`.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import scipy  # loads its parts on first use
from jaxtyping import Complex, Float

from jaxbeam.analysis.frozen_loop import LoopDynamics, LoopTiming, NotAffineError, loop_dynamics
from jaxbeam.analysis.linearised_loop import (
    LinearisedLoop,
    linear_loop,
    linearise_each,
    loop_timing,
    sampled_matrices,
    stationary_loops,
)
from jaxbeam.case.case import Case, concrete_case, crossing_times, replace
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.trajectory import NEVER
from jaxbeam.control.estimation.kalman import Kalman
from jaxbeam.control.mpc import MPC
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.stages import propagate
from jaxbeam.runtime.arrays import ravel_pytree, scan, to_numpy, xp
from jaxbeam.runtime.compiling import compiled

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


MAX_PHASE_PER_STEP = 0.4  # rad: phase of the fastest mode per step of the transition matrix
SAMPLES_AT_ONCE = 2048  # of which the plant is propagated together


class FrozenPoles(NamedTuple):
    """Poles (1/s) of the closed loop with frozen loads, at `times` (s) of a run.

    Each column of `poles` follows one branch. Where `largest_real_part` is positive, the loop with
    loads frozen at that time is unstable.
    """

    times: Float[np.ndarray, " time"]
    poles: Complex[np.ndarray, "time state"]

    @property
    def largest_real_part(self) -> Float[np.ndarray, " time"]:
        """Largest real part of all poles at each time, in 1/s."""
        return self.poles.real.max(axis=1)


class Growth(NamedTuple):
    """Growth of deviations from the start of a crossing to `times` (s).

    `factor` is the largest ratio of the square root of the mechanical energy to that at the start,
    over all initial deviations of the beam; states of filters, actuators and laws start at rest.
    For an uncontrolled stable beam it is near one or below.
    """

    times: Float[np.ndarray, " time"]
    factor: Float[np.ndarray, " time"]


class Stream(NamedTuple):
    """Floquet multipliers of a loop under a periodic stream of equal loads with a `period` (s).

    The loop is stable if all `multipliers` lie within the unit circle.
    """

    multipliers: Complex[np.ndarray, " state"]
    period: float

    @property
    def largest_multiplier(self) -> float:
        """Largest absolute value of the multipliers."""
        return float(np.max(np.abs(self.multipliers)))

    @property
    def stable(self) -> bool:
        """Whether all multipliers lie within the unit circle."""
        return self.largest_multiplier < 1


@refuses_traced("the stability of a loop")
def frozen_poles(case: Case, times: Float[np.ndarray, " time"] | None = None) -> FrozenPoles:
    """Poles of the closed loop with loads frozen at ascending times (s) (Figs 5.17, 5.18).

    Default: 100 times of the crossing. Raises ValueError as `linearised_loop`.
    """
    timing = loop_timing(case)
    if times is None:
        times = np.linspace(*_crossing_interval(case), 101)[:-1] if case.loads else np.zeros(1)
    times = np.asarray(times, float)
    loop = loop_dynamics(case, mesh_layout(concrete_case(case)))
    poles = [frozen.poles() for frozen in linearise_each(loop, timing, times)]
    return FrozenPoles(times, _tracked_branches(np.stack(poles)))


@refuses_traced("the stability of a loop")
def growth(case: Case, points: int = 100) -> Growth:
    """Growth of deviations over a crossing, at `points` intervals or at the sampling instants.

    The loop is linearised about rest, where a cubic law has no gain. Raises ValueError as
    `linearised_loop`, and for a case without loads.
    """
    timing = loop_timing(case)
    start, end = _crossing_interval(case)
    loop = loop_dynamics(case, mesh_layout(concrete_case(case)))
    if timing is None:
        times = np.linspace(start, end, points + 1)
    else:
        sampling_instants = np.arange(
            math.ceil(start / timing.period), math.floor(end / timing.period) + 1
        )
        times = sampling_instants * timing.period
    steps = _substeps(loop, timing, times)
    transitions, energy = _transition_matrices(loop, timing, times, steps)
    size = energy.shape[0]
    energy_root = np.linalg.cholesky(energy).T
    energy_transitions = energy_root @ transitions[:, :size, :size] @ np.linalg.inv(energy_root)
    return Growth(times, np.linalg.norm(energy_transitions, ord=2, axis=(1, 2)))


@refuses_traced("the stability of a loop")
def stream(case: Case, spacing: float) -> Stream:
    """Floquet multipliers of the loop under a periodic stream of loads, `spacing` (s) apart.

    The load of the case, which travels over the whole beam, is repeated; a law must not depend on
    time. Raises ValueError for a case without exactly one load, one that stays on the beam, or a
    spacing that is not a multiple of the sampling period, and as `linearised_loop`.
    """
    timing = loop_timing(case)
    if len(case.loads) != 1:
        raise ValueError(f"a stream repeats the one load of a case; this has {len(case.loads)}")
    start, end = _crossing_interval(case)
    if crossing_times(case)[0, 1] >= NEVER:
        raise ValueError("the load of a stream must leave the beam; loads.0 stays on it")
    if not spacing > 0:
        raise ValueError(f"spacing must be positive, in s; it is {spacing:g}")
    if timing is not None and abs(spacing / timing.period - round(spacing / timing.period)) > 1e-6:
        raise ValueError(
            f"spacing must be a whole number of the controller's periods, {timing.period:g} s, for"
            f" the loop to repeat itself; it is {spacing:g} s"
        )
    count = max(1, math.ceil((end - start) / spacing))
    load = case.loads[0]
    if load.times is None:
        loads = [
            eqx.tree_at(lambda x: x.entry_time, load, load.entry_time - i * spacing)
            for i in range(count)
        ]
    else:
        loads = [
            eqx.tree_at(lambda x: x.times, load, load.times - i * spacing) for i in range(count)
        ]
    repeated = dataclasses.replace(case, loads=tuple(loads))
    loop = loop_dynamics(repeated, mesh_layout(concrete_case(case)))
    intervals = 1 if timing is None else round(spacing / timing.period)
    times = start + np.linspace(0.0, spacing, max(intervals, 20 if timing is None else 1) + 1)
    steps = _substeps(loop, timing, times)
    transitions, _ = _transition_matrices(loop, timing, times, steps)
    return Stream(np.linalg.eigvals(transitions[-1]), float(spacing))


def _crossing_interval(case: Case) -> tuple[float, float]:
    """First entry and last exit (s); the end of the run if a load stays."""
    if not case.loads:
        raise ValueError("there is no crossing: the case has no loads")
    entries, exits = crossing_times(case).T
    end = exits.max() if exits.max() < NEVER else concrete(case.run.duration)
    return float(entries.min()), float(end)


def _substeps(loop, timing, times) -> int:
    """Steps between two of the times, short enough for MAX_PHASE_PER_STEP."""
    fastest = float(np.max(loop.plant.modal_model.modes.angular_frequencies))
    longest = float(np.max(np.diff(times))) if timing is None else timing.period
    return max(1, math.ceil(fastest * longest / MAX_PHASE_PER_STEP))


def _transition_matrices(
    loop: LoopDynamics, timing: LoopTiming | None, times, substeps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Transition matrices (time, state, state) from the first time; energy matrix of q and q'."""
    if timing is not None:
        try:
            return _affine_transitions(loop, timing, times, substeps), _energy_matrix(loop)
        except NotAffineError:
            pass
    return to_numpy(_compiled_transitions(loop, timing, times, substeps)), _energy_matrix(loop)


def _affine_transitions(loop: LoopDynamics, timing: LoopTiming, times, substeps: int):
    """Transition matrices of a concrete, affine sampled loop; raises NotAffineError for another.

    The law may change from sample to sample.
    """
    transitions: list[np.ndarray] = []
    for first in range(0, len(times) - 1, SAMPLES_AT_ONCE):
        chunk = times[:-1][first : first + SAMPLES_AT_ONCE]
        linear = linear_loop(loop, chunk)
        plant = linear.plant_transitions(timing, chunk, substeps, weights=False)
        A, B, K = sampled_matrices(linear, timing, chunk, plant)
        for matrix in A + B @ K:
            transitions.append(matrix @ transitions[-1] if transitions else matrix)
    return np.stack([np.eye(len(transitions[0])), *transitions])


def _energy_matrix(loop: LoopDynamics) -> Float[np.ndarray, "state state"]:
    """Matrix of twice the mechanical energy of q and q'."""
    model, modes = loop.plant, loop.plant.coordinate_scale.shape[0]
    stiffness = model.modal_model.stiffness() / xp.outer(
        model.coordinate_scale, model.coordinate_scale
    )
    mass = xp.diag(1 / model.coordinate_scale**2)
    zeros = xp.zeros((modes, modes))
    return np.asarray(xp.block([[stiffness, zeros], [zeros, mass]]))


@compiled
def _compiled_transitions(loop: LoopDynamics, timing: LoopTiming | None, times, substeps: int):
    """Transition matrices of any loop."""
    if timing is None:

        def closed_matrix(t):
            A, input_matrix, _, command = loop.continuous_dynamics(t)
            return A + input_matrix @ jax.jacfwd(command)(xp.zeros(A.shape[0]))

        def advance(transition, t):
            transition = propagate(closed_matrix, t[0], t[1] - t[0], substeps, transition)
            return transition, transition

        start = xp.eye(closed_matrix(times[0]).shape[0])
        spans = xp.stack([times[:-1], times[1:]], axis=1)
        transitions = scan(advance, start, spans)[1]
    else:
        rest_state, rebuild = loop.rest_state(timing)
        # Deviations from rest: weights left out.
        unweighted = eqx.tree_at(
            lambda loop: loop.augmented_plant.loads.wheels.weight,
            loop,
            0 * loop.augmented_plant.loads.wheels.weight,
        )

        def advance_sample(transition, t):
            plant = unweighted.plant_transitions(timing, t, substeps)

            def after(state):
                return ravel_pytree(unweighted.sampling_step(timing, rebuild(state), t, plant)[0])[
                    0
                ]

            transition = jax.jacfwd(after)(rest_state) @ transition
            return transition, transition

        start = xp.eye(rest_state.shape[0])
        transitions = scan(advance_sample, start, times[:-1])[1]
    return xp.concatenate([start[None], transitions])


def _tracked_branches(
    poles: Complex[np.ndarray, "time state"],
) -> Complex[np.ndarray, "time state"]:
    """Poles ordered so that each column follows one branch: the nearest continuation in time."""
    ordered = poles.copy()
    for i in range(1, len(ordered)):
        # Linear extrapolation tells branches apart where they cross.
        predicted = ordered[i - 1] if i == 1 else 2 * ordered[i - 1] - ordered[i - 2]
        ordered[i] = poles[i][_assignment(np.abs(predicted[:, None] - poles[i][None]))]
    return ordered


def _assignment(distances: Float[np.ndarray, "branch pole"]) -> list[int]:
    """Poles of the branches, one each, with the smallest sum of distances."""
    found: list[int] = []
    for to_poles in distances:
        left = to_poles.copy()
        left[found] = np.inf
        found.append(int(np.argmin(left)))
        if left[found[-1]] > np.min(to_poles):  # nearest to two branches
            return scipy.optimize.linear_sum_assignment(distances)[1].tolist()
    return found


# Function of a case that is positive if its loop is unstable.
StabilityMeasure = Callable[[Case], float]


class LoadStabilityLimits(NamedTuple):
    """Mass (kg) and speed (m/s, absolute) of a load above which a loop is unstable.

    Infinite if no limit was found, zero if all values tried are unstable, None if the load has no
    mass (or speed).
    """

    mass: float | None
    speed: float | None


def largest_frozen_pole(case: Case) -> float:
    """Largest real part (1/s) of the frozen poles over the crossing."""
    return float(frozen_poles(case).largest_real_part.max())


def stream_excess(spacing: float) -> StabilityMeasure:
    """Stability measure: largest Floquet multiplier less one, with loads a `spacing` (s) apart."""
    return lambda case: stream(case, spacing).largest_multiplier - 1


def stability_limit(
    case: Case,
    address: str,
    low: float,
    high: float,
    measure: StabilityMeasure = largest_frozen_pole,
    points: int = 25,
) -> float | None:
    """Smallest value of a number of the case at which its loop turns unstable; None without one.

    `measure` is positive for an unstable case: `largest_frozen_pole`, `stream_excess(spacing)`, or
    a function such as `lambda case: growth(case).factor.max() - 10`. It is evaluated at `points`
    values from `low` to `high` in equal ratios; its first change of sign is then refined to 1e-6
    (relative). Negative bounds are given by increasing size. Raises ValueError for an unknown
    address, for bounds that do not ascend, and if the loop is unstable at `low`.
    """
    if not 0 < low < high and not high < low < 0:
        raise ValueError(f"low and high must be positive and ascend; they are {low:g}, {high:g}")

    def measure_at(value):
        return measure(replace(case, {address: float(value)}))

    values = np.geomspace(low, high, points)
    if measure_at(values[0]) > 0:
        raise ValueError(f"the loop is unstable already at {address} = {low:g}; start lower")
    for lower, upper in zip(values[:-1], values[1:], strict=True):
        if measure_at(upper) > 0:
            return float(scipy.optimize.brentq(measure_at, lower, upper, rtol=1e-6))
    return None


def load_stability_limits(
    case: Case,
    measure: StabilityMeasure = largest_frozen_pole,
    factor: float = 10.0,
    points: int = 12,
) -> LoadStabilityLimits:
    """Mass and speed of the first load above which a loop is unstable, each with the other kept.

    The search goes up to `factor` times the value of the case, or from a `factor` below up to it if
    the case is unstable. The law is designed anew for each value. Raises ValueError for a case
    without loads, and as `measure`.
    """
    if not case.loads:
        raise ValueError("there is no load whose mass or speed could have a limit; add one")
    unstable = measure(case) > 0

    def limit_of(name):
        value = getattr(case.loads[0], name)
        if value is None or concrete(value) == 0:
            return None
        value, address = float(concrete(value)), f"loads.0.{name}"
        low, high = (value / factor, value) if unstable else (value, value * factor)
        if unstable and measure(replace(case, {address: low})) > 0:
            return 0.0
        found = stability_limit(case, address, low, high, measure, points)
        return np.inf if found is None else abs(found)

    return LoadStabilityLimits(limit_of("mass"), limit_of("speed"))
