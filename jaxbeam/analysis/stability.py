"""Stability of loops with loads: largest real parts, and the limits of parameters.

Frozen poles, those of the loop with its loads frozen in one position, describe slow crossings only:
the stability of a time-varying loop does not follow from them. It follows from the transition
matrix: the growth of deviations over a crossing, and the Floquet multipliers of a periodic stream
of equal loads.
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
    linear_loop,
    linearise_each,
    loop_timing,
    sampled_matrices,
)
from jaxbeam.case.case import Case, concrete_case, crossing_times, replace
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.modes import mesh_layout
from jaxbeam.numerics.discretisation import propagate
from jaxbeam.runtime.arrays import ravel_pytree, scan, to_numpy, xp
from jaxbeam.runtime.compiling import compiled

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
