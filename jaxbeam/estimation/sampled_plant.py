"""Sampled plant: transition from one sample of a controller to the next, with process noise.

A command begins a delay after its sample: within each period the previous command acts first, then
the one that acts at the end of the period.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
from jaxtyping import Bool, Float, Int

from jaxbeam.case.controller import AbstractController
from jaxbeam.numerics.discretisation import exponential_and_gramian
from jaxbeam.runtime.arrays import Array, stop_gradient, xp
from jaxbeam.runtime.module import Module

BLOCK = 256  # samples, of which the intermediate results fit into a cache
PERIOD_ROUNDING = 1e-9  # of a period; delays that exceed whole periods by less count as whole

Square = Float[Array, "*sample state state"]
Inputs = Float[Array, "*sample state input"]
Number = Float[Array, ""]
Times = Float[Array, "*sample"]
# State matrix and input matrix at times (s), or those of all times.
StateAndInputMatrices = Callable[[Times], tuple[Float[Array, "..."], Float[Array, "..."]]]


class Transition(Module):
    """Transition over a period: x+ = matrix x + previous_input_matrix u- + input_matrix u + w.

    `noise_covariance` is that of w. Of one sample, or of several along a first axis.
    """

    matrix: Square
    previous_input_matrix: Inputs
    input_matrix: Inputs
    noise_covariance: Square

    def predict(self, state, previous_input, input) -> Float[Array, "*sample state"]:
        """State at the end of the period without noise; of each sample, from one state."""
        return (
            self.matrix @ state
            + self.previous_input_matrix @ previous_input
            + self.input_matrix @ input
        )

    def predict_covariance(self, covariance: Square) -> Square:
        """Covariance of the state at the end of the period, from that at its start."""
        return self.matrix @ covariance @ self.matrix.mT + self.noise_covariance

    def compose(self, later: "Transition") -> "Transition":
        """Composition with a later transition in the same period."""
        return Transition(
            later.matrix @ self.matrix,
            later.matrix @ self.previous_input_matrix + later.previous_input_matrix,
            later.matrix @ self.input_matrix + later.input_matrix,
            later.predict_covariance(self.noise_covariance),
        )


class SampleTiming(Module):
    """Sampling period (s), and delay (s) within it after which a command begins, or None."""

    period: Number
    input_delay: Number | None

    def sample_at(self, t: Number) -> Int[Array, ""]:
        """Number of the sample at t (s)."""
        return xp.floor(t / self.period + 0.5).astype(int)

    def transition(
        self,
        matrices_at: StateAndInputMatrices,
        noise_intensity: Float[Array, "state state"],
        scale: Float[Array, " state"],
        t: Times | float = 0.0,
    ) -> Transition:
        """Transition to the sample at t (s), or to several, from the one before.

        With white noise on x'. Exact for a time-invariant plant; else by Magnus' method of order 4,
        with one exponential between any two changes of the command. `scale` are the magnitudes of
        the states, from `numerics.discretisation.balance`.
        """
        parts, _, _ = self.transitions(matrices_at, noise_intensity, scale, t)
        return functools.reduce(Transition.compose, parts)

    def transitions(
        self,
        matrices_at: StateAndInputMatrices,
        noise_intensity: Float[Array, "state state"],
        scale: Float[Array, " state"],
        t: Times | float = 0.0,
        breaks: Sequence[Number] = (),
    ) -> tuple[list[Transition], Float[Array, " part"], Bool[Array, " part"]]:
        """Transitions of the parts of a period, split at the command change and at `breaks` (s).

        Breaks are counted from the start of the period. Returns the transitions, whose composition
        is that of `transition`, the end of each part (s from the start of the period), and whether
        the previous command acts in it.
        """
        input_delay = xp.zeros(()) if self.input_delay is None else self.input_delay
        cuts = [*breaks, *([] if self.input_delay is None else [input_delay])]
        ends = xp.sort(xp.stack([*cuts, self.period]))
        starts = xp.concatenate([xp.zeros(1), ends[:-1]])
        before_command = ends <= input_delay
        steps = _magnus_steps(
            matrices_at,
            noise_intensity,
            scale,
            xp.asarray(t, float)[..., None] - self.period + starts,
            ends - starts,
        )
        parts = []
        for k in range(ends.shape[0]):
            matrix, inputs, noise = (part[..., k, :, :] for part in steps)
            previous, present = (
                xp.where(acts, inputs, 0.0) for acts in (before_command[k], ~before_command[k])
            )
            parts.append(Transition(matrix, previous, present, noise))
        return parts, ends, before_command


def sample_timing(controller: AbstractController) -> SampleTiming:
    """Timing of a controller with a sampling period; whole periods of its delay are left out."""
    period, delay = controller.period, controller.delay
    return SampleTiming(period, None if delay is None else split_delay(delay, period)[1])


def in_blocks(function: Callable[[int, int], Any], count: int) -> Any:
    """Arrays of `count` samples, computed block by block to save memory.

    `function` returns those of a block, given its first sample and its number of samples; the first
    axis of the arrays is that of the samples.
    """
    starts = range(0, count, BLOCK)
    parts = [function(first, min(BLOCK, count - first)) for first in starts]
    return jax.tree.map(lambda *blocks: xp.concatenate(blocks), *parts)


def split_delay(delay: Number, period: Number) -> tuple[Number, Number]:
    """Number of whole periods in a delay (s), and the rest (s); the number has no derivative."""
    whole = stop_gradient(xp.floor(delay / period + PERIOD_ROUNDING))
    return whole, xp.maximum(delay - whole * period, 0.0)


def _magnus_steps(matrices_at: StateAndInputMatrices, noise_intensity, scale, starts, spans):
    """Transition matrix, matrix of a held input, and covariance of the noise over spans (s).

    The last axis of the starts (s) is that of the spans.
    """
    middle, node_offset = starts + spans / 2, math.sqrt(3) / 6 * spans
    nodes = xp.stack([middle - node_offset, middle + node_offset])
    early, late = _augmented_matrices(matrices_at, nodes, scale)
    span, node_offset = spans[:, None, None], node_offset[:, None, None]
    commutator = late @ early - early @ late
    matrix = span / 2 * (early + late) + span * node_offset / 2 * commutator
    states, covariance_scale = noise_intensity.shape[0], scale * scale[:, None]
    noise = xp.pad(noise_intensity / covariance_scale, (0, matrix.shape[-1] - states))
    noise_commutator = (late - early) @ noise
    noise = span * noise + span * node_offset / 2 * (noise_commutator + noise_commutator.mT)
    propagator, noise = exponential_and_gramian(matrix, noise)
    transition = propagator[..., :states, :states] * scale[:, None] / scale
    return (
        transition,
        propagator[..., :states, states:] * scale[:, None],
        noise[..., :states, :states] * covariance_scale,
    )


def _augmented_matrices(matrices_at: StateAndInputMatrices, times, scale):
    """Matrices of the plant with its inputs as further, constant states; in scaled states."""
    A, B = matrices_at(times)
    top = xp.concatenate([A * scale / scale[:, None], B / scale[:, None]], axis=-1)
    square = xp.pad(top, [*[(0, 0)] * (top.ndim - 2), (0, B.shape[-1]), (0, 0)])
    return xp.broadcast_to(square, (*times.shape, *square.shape[-2:]))
