"""Running peaks: largest deflections and smallest contact forces, updated chunk by chunk.

Histories are not stored.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.trajectory import NEVER
from jaxbeam.integrator.contact_forces import contact_minimum
from jaxbeam.integrator.load_path import LoadPath
from jaxbeam.integrator.propagators import PEAK_NODES
from jaxbeam.integrator.step_matrices import StepMatrices
from jaxbeam.numerics.polynomials import (
    estimate_peak,
    locate_peak,
    max_with_ties,
    refine_peak,
    steps_near_peak,
)
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    cond,
    is_jax,
    optimization_barrier,
    stop_gradient,
    take,
    xp,
)

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
