"""Running peaks: largest deflections and smallest contact forces, updated chunk by chunk.

Histories are not stored. Within a step a contact force is the polynomial through its values at the
Gauss nodes. It is compared at fractions of the step, which include the ends, and at the vertices of
the parabolas through three of these. `runtime/native/contact.c` does the same in C.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.trajectory import NEVER
from jaxbeam.numerics.polynomials import (
    estimate_peak,
    lagrange_coefficients,
    lagrange_weights,
    locate_peak,
    max_with_ties,
    polynomial,
    refine_peak,
    steps_near_peak,
)
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    cond,
    fori_loop,
    is_jax,
    optimization_barrier,
    stop_gradient,
    take,
    xp,
)
from jaxbeam.simulation.integrator.discrete_model import NODE_COUNT, PEAK_NODES
from jaxbeam.simulation.integrator.load_path import LoadPath
from jaxbeam.simulation.integrator.step_matrices import StepMatrices

PEAK_MARGIN = 1.1  # upper bound of a peak over the largest of the samples around it


class Peaks(NamedTuple):
    """Peaks of runs (m) and their times (s), smallest contact forces (N) and first losses (s).

    NaN where a run failed; the time of a loss is NaN where contact is never lost.
    """

    peak_deflection: Float[Array, "*task batch sensor"]
    peak_time: Float[Array, "*task batch sensor"]
    lowest_contact_force: Float[Array, "*task batch load"]
    contact_lost_time: Float[Array, "*task batch load"]


class RunningPeaks(Module):
    """Peaks of the runs of a batch up to the current chunk of steps.

    `samples` are the deflections (m) at the peak nodes of the step with the largest `estimate` of
    the `magnitude` of each monitored deflection; that step has `step_start` (s) and `step_length`
    (s). Contact forces (N) are positive where a load presses on the beam; `contact_lost_time` (s)
    is the first instant of a tensile contact force. A run is `finite` until it diverges. The
    `position` of the peak in its step, in [-1, 1], is given only if all steps are one chunk.
    """

    estimate: Float[Array, "sensor batch"]
    samples: Float[Array, "sample sensor batch"]
    step_start: Float[Array, "sensor batch"]
    step_length: Float[Array, "sensor batch"]
    lowest_contact_force: Float[Array, "load batch"]
    contact_lost_time: Float[Array, "load batch"]
    finite: Bool[Array, " batch"]
    magnitude: Callable = eqx.field(static=True)
    position: Float[Array, "sensor batch"] | None = None

    def refined_peak(self) -> tuple[Float[Array, "sensor batch"], Float[Array, "sensor batch"]]:
        """Peak magnitude of each monitored deflection (m), and its time (s); NaN if not finite."""
        value, position = refine_peak(self.samples, PEAK_NODES, self.magnitude, self.position)
        time = self.step_start + position * self.step_length
        return xp.where(self.finite, value, xp.nan), xp.where(self.finite, time, xp.nan)

    def without(self, failed: Bool[Array, " batch"]) -> "RunningPeaks":
        """Running peaks in which diverged runs have no peak and no contact force."""
        return eqx.tree_at(lambda own: own.finite, self, self.finite & ~failed)

    def with_contact(
        self, lowest: Float[Array, "load batch"], lost_time: Float[Array, "load batch"]
    ) -> "RunningPeaks":
        """Running peaks with other smallest contact forces (N) and times of loss (s)."""
        parts = lowest, lost_time
        return eqx.tree_at(
            lambda own: (own.lowest_contact_force, own.contact_lost_time), self, parts
        )

    def peaks(self) -> Peaks:
        """Peaks at the end of the runs, with the batch axis first."""
        lowest = xp.where(self.finite, self.lowest_contact_force, xp.nan)
        is_lost = self.finite & (self.contact_lost_time < NEVER)
        lost = xp.where(is_lost, self.contact_lost_time, xp.nan)
        return Peaks(*(part.T for part in (*self.refined_peak(), lowest, lost)))


@jax.named_scope("running_peaks")
def update_peaks(
    running_peaks: RunningPeaks,
    matrices: StepMatrices,
    path: LoadPath,
    inputs,
    monitored: Callable,
) -> RunningPeaks:
    """Running peaks after a further chunk of steps.

    `inputs` of the monitored outputs are states, contact forces at the nodes, contact forces at the
    ends of the steps, and commands; the last two may be None. `monitored` takes samples of the
    outputs (step, sample, output, batch) to those of which there are peaks.
    """
    states, forces, *_ = inputs
    steps, batch_size = states.shape[0], states.shape[-1]
    start, length = path.start, path.length
    others = [part for part in inputs[1:] if part is not None]
    if path.influence is None:
        outputs = matrices.monitored @ xp.concatenate([states, *others], axis=1)
    else:
        # Two products: sweeps of moments take a tenth less time, those of deflections 3 % more.
        on_states, on_others = xp.split(matrices.monitored, [states.shape[1]], axis=2)
        outputs = on_states @ states + on_others @ xp.concatenate(others, axis=1)
        # Steps of zero length after the end are no part of the run.
        outputs = xp.where(length[:, None, None] > 0, outputs, 0.0)
    samples = monitored(outputs.reshape(steps, len(PEAK_NODES), -1, batch_size))
    samples = optimization_barrier(samples)

    largest = xp.max(xp.abs(samples), axis=(0, 1))
    # Whether this is a traced run whose steps are all in one chunk.
    whole_run = is_jax(largest) and not is_jax(running_peaks.estimate)

    def updated(best):
        estimate = optimization_barrier(
            estimate_peak(xp.moveaxis(samples, 1, 0), PEAK_NODES, best.magnitude)
        )
        best_estimate, is_best = max_with_ties(estimate)
        best_step = xp.max(xp.where(is_best, np.arange(steps)[:, None, None], 0), axis=0)
        better = best_estimate > best.estimate
        chosen = xp.take_along_axis(samples, best_step[None, None], axis=0)[0]
        return RunningPeaks(
            xp.where(better, best_estimate, best.estimate),
            xp.where(better, chosen, best.samples),
            xp.where(better, take(start, best_step), best.step_start),
            xp.where(better, take(length, best_step), best.step_length),
            best.lowest_contact_force,
            best.contact_lost_time,
            best.finite,
            best.magnitude,
        )

    if whole_run:
        running_peaks = peaks_of_steps(running_peaks, samples, start, length)
    else:
        # Most chunks stay far below the current peak and lose no contact: they skip refinement.
        running_peaks = cond(
            xp.any(largest * PEAK_MARGIN > running_peaks.estimate),
            updated,
            lambda best: best,
            running_peaks,
        )
    # Loads off the beam and impulses do not count.
    is_load = (
        path.loads[:, :, None] == np.arange(running_peaks.lowest_contact_force.shape[0])
    ) & path.pressing[..., None]
    lowest_force, contact_lost_time = contact_minimum(
        running_peaks.lowest_contact_force,
        running_peaks.contact_lost_time,
        forces,
        is_load,
        start,
        length,
    )
    # By a sum: maxima of XLA on CPUs pass over NaN in arrays of several runs.
    finite = running_peaks.finite & xp.isfinite(xp.sum(samples, axis=(0, 1, 2)))
    return eqx.tree_at(
        lambda b: (b.lowest_contact_force, b.contact_lost_time, b.finite),
        running_peaks,
        (lowest_force, contact_lost_time, finite),
    )


def peaks_of_steps(initial: RunningPeaks, samples, start, length) -> RunningPeaks:
    """Running peaks of a traced run with all steps in one chunk, computed without branches."""
    fixed, magnitude = stop_gradient(samples), initial.magnitude
    steps = steps_near_peak(fixed, stop_gradient(length), PEAK_NODES, magnitude)
    candidates = xp.moveaxis(xp.take_along_axis(samples, steps[:, None], axis=0), 0, 1)
    positions, heights = locate_peak(stop_gradient(candidates), PEAK_NODES, magnitude)
    highest = xp.argmax(heights, axis=0) == np.arange(len(steps))[:, None, None]
    highest = highest & (heights > initial.estimate)  # without motion, the peak is that at rest

    def chosen(parts):
        return xp.sum(xp.where(highest, parts, 0.0), axis=-3)

    return RunningPeaks(
        chosen(heights),
        chosen(candidates),
        chosen(take(start, steps)),
        chosen(take(length, steps)),
        initial.lowest_contact_force,
        initial.contact_lost_time,
        initial.finite,
        magnitude,
        chosen(positions),
    )


def initial_peaks(positions: int, loads: int, batch_size: int, magnitude: Callable) -> RunningPeaks:
    """Running peaks at rest, before the first step; `magnitude` of a deflection is zero at rest."""
    zeros = xp.zeros((positions, batch_size))
    return RunningPeaks(
        zeros,
        xp.zeros((len(PEAK_NODES), positions, batch_size)),
        zeros,
        zeros,
        xp.full((loads, batch_size), xp.inf),
        xp.full((loads, batch_size), NEVER),
        xp.ones(batch_size, bool),
        magnitude,
    )


ZERO_ITERATIONS = 4  # of Newton's method for the time of a loss
# Peak nodes, and the middles between them.
FORCE_FRACTIONS = np.interp(
    np.arange(2 * len(PEAK_NODES) - 1) / 2, np.arange(len(PEAK_NODES)), PEAK_NODES
)
# Weights (fraction, node) of contact forces at the Gauss nodes of a step.
FORCE_WEIGHTS = lagrange_weights(NODE_COUNT, FORCE_FRACTIONS)
FORCE_GAP = float(np.diff(FORCE_FRACTIONS).max())


def spread_factor() -> float:
    """Bound of the distance of a force from the middle of its nodal values, over their spread.

    It is half the Lebesgue constant of the Gauss nodes, which is reached at the ends of the step.
    """
    return 0.5 * float(np.abs(FORCE_WEIGHTS).sum(axis=1).max())


def contact_minimum(
    lowest: Float[Array, "load batch"],
    lost_time: Float[Array, "load batch"],
    forces: Float[Array, "step row batch"],
    is_load: Bool[Array, "step row_load load"],
    start: Float[Array, " step"],
    length: Float[Array, " step"],
) -> tuple[Float[Array, "load batch"], Float[Array, "load batch"]]:
    """Smallest forces (N, positive where a load presses) and times of the first loss (s), updated.

    `forces` act on the beam at the Gauss nodes of steps, positive upwards; `is_load` marks the load
    of each row. The loss of contact is the first zero of the polynomial, or the start of a step
    that begins with a tensile force; its time is NEVER without a loss.
    """
    if not is_load.size:  # of a case without loads
        return lowest, lost_time
    steps, batch_size = forces.shape[0], forces.shape[-1]
    by_row = forces.reshape(steps, -1, NODE_COUNT, batch_size)
    most, least = xp.max(by_row, axis=2), xp.min(by_row, axis=2)
    bound = 0.5 * (most + least) + spread_factor() * (most - least)
    bound = xp.where(is_load[..., None], bound[:, :, None], -xp.inf)

    whole_run = is_jax(bound) and not is_jax(lowest)

    def pulls_of_loads():
        pulls = _at_fractions(by_row, whole_run)
        pull = xp.maximum(xp.max(pulls, axis=0), xp.max(_vertices(pulls)[0], axis=0))
        return xp.where(is_load[..., None], pull[:, :, None], -xp.inf)

    if whole_run:  # no branches, each of which has its own
        pulls_of_loads = functools.cache(pulls_of_loads)

    def with_smaller(lowest):
        return xp.minimum(lowest, xp.min(-pulls_of_loads(), axis=(0, 1), initial=xp.inf))

    def with_first_loss(lost_time):
        """Of each load only the first step with a pull counts."""
        pulls = pulls_of_loads().reshape(-1, *lost_time.shape) > 0
        loses, found = xp.any(pulls, axis=0), xp.argmax(pulls, axis=0)
        of_rows = by_row.reshape(-1, NODE_COUNT, batch_size)
        nodes = xp.take_along_axis(of_rows, found[:, None], axis=0)[:, None]  # load, 1, node, batch
        pulls = _at_fractions(nodes, whole_run)
        powers = xp.einsum("slnb,nk->kslb", nodes, lagrange_coefficients(NODE_COUNT))
        near = stop_gradient((powers, pulls))
        fraction = _zero_nearby(near[0], _first_loss(near[1], *_vertices(near[1])))
        fraction = _moving_zero(powers, fraction)[:, 0]
        step = found // is_load.shape[1]
        time = take(start, step) + take(length, step) * fraction
        return xp.minimum(lost_time, xp.where(loses, time, NEVER))

    # Most chunks stay above the smallest force so far; NaN is passed on.
    lowest = cond(whole_run or xp.any(~(bound <= -lowest)), with_smaller, lambda same: same, lowest)
    loses = whole_run or xp.any((lowest < 0) & (lost_time >= NEVER))
    return lowest, cond(loses, with_first_loss, lambda same: same, lost_time)


def _at_fractions(by_row: Float[Array, "step row node batch"], by_product: bool):
    """Tensile forces at the FORCE_FRACTIONS, (fraction, step, row, batch).

    The sum is one that XLA fuses with the operations after it; `by_product` it is one product,
    which makes a smaller program.
    """
    if by_product:
        return xp.einsum("fn,slnb->fslb", FORCE_WEIGHTS, by_row)
    weights = FORCE_WEIGHTS[..., None, None, None]
    return sum(weights[:, node] * by_row[:, :, node] for node in range(NODE_COUNT))


def _parabolas() -> tuple[Float[np.ndarray, "inner fraction"], ...]:
    """Weights of the values at all fractions in the parabolas through three fractions.

    They give the slopes before and after the middle fraction, the slope at it, and half the second
    derivative.
    """
    gaps = np.diff(FORCE_FRACTIONS)[:, None]
    slopes = np.diff(np.eye(FORCE_FRACTIONS.size), axis=0) / gaps
    rise, fall = slopes[:-1], slopes[1:]
    curvature = (fall - rise) / (gaps[:-1] + gaps[1:])
    return rise, fall, rise + curvature * gaps[:-1], curvature


PARABOLAS = _parabolas()


def _vertices(pulls: Float[Array, "fraction step row batch"]):
    """Maxima of the parabolas through three fractions, -inf without one, and their rising zeros."""
    rise, fall, slope, curvature = (xp.tensordot(weights, pulls, 1) for weights in PARABOLAS)
    inside = (rise > 0) & (fall < 0) & (curvature < 0)  # which rounding of a level pull may not be
    curvature = xp.where(inside, curvature, -1.0)
    top = xp.where(inside, pulls[1:-1] - slope**2 / (4 * curvature), -xp.inf)
    at = FORCE_FRACTIONS[1:-1, None, None, None] - slope / (2 * curvature)
    return top, at - xp.sqrt(xp.where(top > 0, top, 1.0) / -curvature)


def _first_loss(pulls, vertex, rising) -> Float[Array, "step row batch"]:
    """Fraction of each step at which the force first becomes tensile, NEVER without one.

    It is found on the line between two fractions, or on the parabola if the force is tensile only
    between them.
    """
    before, after = pulls[:-1], pulls[1:]
    rises = (before <= 0) & (after > 0)
    fraction = before / xp.where(rises, before - after, 1.0)
    starts, gaps = FORCE_FRACTIONS[:-1], np.diff(FORCE_FRACTIONS)
    crossing = starts[:, None, None, None] + gaps[:, None, None, None] * fraction
    first = xp.min(xp.where(rises, crossing, NEVER), axis=0)
    touching = (vertex > 0) & (pulls[1:-1] <= 0)
    first = xp.minimum(first, xp.min(xp.where(touching, rising, NEVER), axis=0))
    return xp.where(pulls[0] > 0, 0.0, first)


def _moving_zero(
    powers: Float[Array, "power step row batch"], zero: Float[Array, "step row batch"]
) -> Float[Array, "step row batch"]:
    """`zero` with the derivative of the instant at which the polynomial is zero."""
    if not is_jax(powers):
        return zero
    inside = (zero > 0) & (zero < NEVER)
    at = xp.where(inside, zero, 0.5)
    slope = polynomial(_slopes(stop_gradient(powers)), at)
    value = polynomial(powers, at)
    change = (value - stop_gradient(value)) / xp.where(slope == 0, 1.0, slope)
    return xp.where(inside, zero - change, zero)


def _slopes(powers: Float[Array, "power *rest"]) -> Float[Array, "power_less_one *rest"]:
    """Coefficients of the derivative of a polynomial, lowest power first."""
    return powers[1:] * np.arange(1.0, powers.shape[0]).reshape(-1, *(1,) * (powers.ndim - 1))


def _zero_nearby(
    powers: Float[Array, "power step row batch"], start: Float[Array, "step row batch"]
) -> Float[Array, "step row batch"]:
    """Zero of a polynomial within a gap of FORCE_FRACTIONS of a start; 0 and NEVER are kept.

    It is found by Newton's method; the start is kept if that ends farther from zero. The line
    between two fractions misses the zero by up to 1e-3 of the step.
    """
    inside = (start > 0) & (start < NEVER)
    first = xp.where(inside, start, 0.5)
    low, high = xp.maximum(first - FORCE_GAP, 0.0), xp.minimum(first + FORCE_GAP, 1.0)
    slopes = _slopes(powers)

    def newton(_, x):
        slope = polynomial(slopes, x)
        step = polynomial(powers, x) / xp.where(slope == 0, 1.0, slope)
        return xp.clip(x - step, low, high)

    found = fori_loop(0, ZERO_ITERATIONS, newton, first)
    nearer = xp.abs(polynomial(powers, found)) <= xp.abs(polynomial(powers, first))
    return xp.where(inside & nearer, found, start)
