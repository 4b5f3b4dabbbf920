"""Sampled plant from one sample of a controller to the next, and the sensor chain to its readings.

A command begins a delay after its sample: within each period the previous command acts first, then
the one that acts at the end of the period. Process noise acts in between.

The states just before a sample of the controller are z = (x, h, m, v): x of the plant with the
analogue filters of the sensors; h, for a sensor with a delay, its last samples, newest first; the
states m of digital filters; and the noise v of the samples that these filters receive.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.sensors import filter_step
from jaxbeam.model.contact import vehicle_system
from jaxbeam.model.sensor_signals import Sections, sensor_sections, with_sensor_filters
from jaxbeam.model.state_space import Plant, StateSpace
from jaxbeam.numerics.stages import exponential_and_gramian
from jaxbeam.runtime.arrays import Array, Module, set_at, stop_gradient, xp

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


# Largest number of steps of a period, or of each part before and after a delayed command begins;
# and largest phase of the fastest mode, or of a vehicle, in one.
MAX_STEPS, MAX_PHASE_PER_STEP = 8, 0.6


def step_count(plant: Plant, period: Number) -> int:
    """Number of steps of a period (s), or of each of its two parts, for a plant that varies.

    Traced vehicles do not count, so that a run has the same steps whether they are traced or not
    unless they are faster than the highest mode.
    """
    rates = plant.modal_model.modes.angular_frequencies
    if not (is_concrete(rates) and is_concrete(period)):
        return MAX_STEPS
    fastest = np.max(concrete(rates))
    if plant.vehicle_states:
        system = vehicle_system(plant.loads)[0]
        if is_concrete(system):
            fastest = max(fastest, np.max(np.abs(np.linalg.eigvals(concrete(system)))))
    return min(MAX_STEPS, math.ceil(float(concrete(period)) * fastest / MAX_PHASE_PER_STEP))


class SampleTiming(Module):
    """Sampling period (s), and delay (s) within it after which a command begins, or None.

    Of a plant that varies in time each part of a period takes so many `steps`.
    """

    period: Number
    input_delay: Number | None
    steps: int = eqx.field(static=True, default=1)

    def varying(self, plant: Plant) -> "SampleTiming":
        """Timing for a plant that varies in time, whose fastest mode its steps follow."""
        return dataclasses.replace(self, steps=step_count(plant, self.period))

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
        in `steps` between any two changes of the command. `scale` are the magnitudes of
        the states, from `numerics.stages.balance`.
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
        spans = xp.repeat((ends - starts) / self.steps, self.steps)
        begun = xp.repeat(starts, self.steps) + np.tile(np.arange(self.steps), len(ends)) * spans
        first = xp.asarray(t, float)[..., None] - self.period
        steps = _magnus_steps(matrices_at, noise_intensity, scale, first + begun, spans)

        def step(k):
            matrix, inputs, noise = (part[..., k, :, :] for part in steps)
            before = before_command[k // self.steps]
            previous, present = (xp.where(acts, inputs, 0.0) for acts in (before, ~before))
            return Transition(matrix, previous, present, noise)

        each = [map(step, range(k, k + self.steps)) for k in range(0, len(spans), self.steps)]
        parts = [functools.reduce(Transition.compose, part) for part in each]
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


# Noise that a digital filter is assumed to add to its output, relative to that of its samples.
# Without it the filter would be inverted exactly, as if attenuated components were measured.
FILTER_NOISE_RATIO = 1e-3

# The plant at a time (s); its outputs are the inputs of the sensors.
SystemAtTime = Callable[[Float[Array, ""]], StateSpace]


class FilteredPlant(Module):
    """Plant with the analogue filters of its sensors; `output_rows` of the filtered outputs."""

    plant: Plant
    output_rows: Float[Array, "sensor state"]

    def with_filtered_outputs(self, system: StateSpace) -> StateSpace:
        """System of the plant with its outputs behind the analogue filters."""
        filters = [sensor.filter for sensor in self.plant.case.sensors]
        analogue = np.array([f is not None and f.realisation == "analogue" for f in filters])
        if not analogue.any():
            return system
        filtered_rows = self.output_rows @ self.plant.to_modal(xp.eye(self.output_rows.shape[1]))
        filtered_rows = xp.pad(
            filtered_rows, ((0, 0), (0, system.C.shape[-1] - filtered_rows.shape[1]))
        )
        C = xp.where(analogue[:, None], filtered_rows, system.C)
        D = xp.where(analogue[:, None], 0.0, system.D)
        return eqx.tree_at(lambda s: (s.C, s.D), system, (C, D))


def filtered_plant(plant: Plant) -> FilteredPlant:
    """Plant with the analogue filters of its sensors."""
    filtered_model, output_rows = with_sensor_filters(plant)
    return FilteredPlant(eqx.tree_at(lambda m: m.modal_model, plant, filtered_model), output_rows)


class SensorChain(Module):
    """States that the sensors add to the `plant_states` of the plant, and their transition.

    `filter_sections` are those of digital filters, `delays` (s) those of the sensors, None where
    there is none; `variance` is that of the noise of their samples. Delays are at most
    `max_delay_periods` periods.
    """

    filter_sections: tuple[Sections, ...]
    delays: tuple[Float[Array, ""] | None, ...]
    variance: Float[Array, " sensor"]
    timing: SampleTiming
    plant_states: int = eqx.field(static=True)
    max_delay_periods: int = eqx.field(static=True)

    @property
    def state_count(self) -> int:
        """Number of all states."""
        return self._state_layout()[-1]

    @property
    def noise_covariance(self) -> Float[Array, "sensor sensor"]:
        """Covariance of the noise of readings that is not among the states."""
        digital = np.array([part is not None for part in self.filter_sections])
        return xp.diag(xp.where(digital, FILTER_NOISE_RATIO**2, 1.0) * self.variance)

    def output_matrices(
        self, C, D
    ) -> tuple[Float[Array, "*sample sensor all"], Float[Array, "*sample sensor actuator"]]:
        """C and D of the readings on the states just before samples and the commands."""
        return self._jacobians(C, D, 0)

    def transition(self, system_at: SystemAtTime, intensity, scale, t=0.0) -> Transition:
        """Transition from just before the previous sample to just before that at t (s), or several.

        White noise of this intensity acts on the rates of the plant; see `SampleTiming.transition`.
        """
        sensor_states = self.state_count - self.plant_states

        def state_and_input_matrices(time):
            system = system_at(time)
            return system.A, system.B

        start = t - self.timing.period
        first = system_at(start)
        matrix, feedthrough = self._jacobians(first.C, first.D, 1)
        transition = Transition(
            matrix, feedthrough, xp.zeros_like(feedthrough), xp.zeros_like(matrix)
        )
        sampling_offsets = {
            i: self._split_delay(lag)[1] for i, lag in enumerate(self.delays) if lag is not None
        }
        parts, ends, before_command = self.timing.transitions(
            state_and_input_matrices, intensity, scale, t, list(sampling_offsets.values())
        )
        for k, part in enumerate(parts):
            unchanged = np.diag(np.append(np.zeros(self.plant_states), np.ones(sensor_states)))
            later = Transition(
                _padded(part.matrix, sensor_states, sensor_states) + unchanged,
                _padded(part.previous_input_matrix, sensor_states, 0),
                _padded(part.input_matrix, sensor_states, 0),
                _padded(part.noise_covariance, sensor_states, sensor_states),
            )
            transition = transition.compose(later)
            for i, offset in sampling_offsets.items():
                system, is_sampled = system_at(start + ends[k]), ends[k] == offset
                transition = transition.compose(
                    self._sampling_update(
                        i, system.C[..., i, :], system.D[..., i, :], is_sampled, before_command[k]
                    )
                )
        sample_noise = xp.zeros(self.state_count)
        for index, variance in zip(self._state_layout()[2], self.variance, strict=True):
            sample_noise = sample_noise if index is None else set_at(sample_noise, index, variance)
        return eqx.tree_at(
            lambda w: w.noise_covariance,
            transition,
            transition.noise_covariance + xp.diag(sample_noise),
        )

    def _sampling_update(self, sensor, row, feedthrough, is_sampled, before_command) -> Transition:
        """Transition at a sample of a sensor, which renews its newest sample h if `is_sampled`."""
        index = self._state_layout()[0][sensor]
        samples, own = row.shape[:-1], np.s_[..., index, :]
        identity = xp.broadcast_to(xp.eye(self.state_count), (*samples, *(self.state_count,) * 2))
        others = self.state_count - self.plant_states
        output_row = xp.pad(row, [*[(0, 0)] * len(samples), (0, others)])
        matrix = set_at(identity, own, xp.where(is_sampled, output_row, identity[own]))
        no_input = xp.zeros((*samples, self.state_count, feedthrough.shape[-1]))
        previous_inputs, inputs = (
            set_at(no_input, own, xp.where(is_sampled & acts, feedthrough, 0.0))
            for acts in (before_command, ~before_command)
        )
        return Transition(matrix, previous_inputs, inputs, xp.zeros_like(identity))

    def _jacobians(self, C, D, which: int) -> Any:
        """Jacobians by states and commands of the readings (0) or the states after a sample (1).

        A sample is linear, so they follow from its results for unit vectors.
        """
        states, sensors = self.state_count, len(self.filter_sections)
        on_states = self._sample(np.eye(states), np.zeros((sensors, states)))[which]
        on_signals = self._sample(np.zeros((states, sensors)), np.eye(sensors))[which]
        signals = _padded(C, 0, states - self.plant_states)
        return on_states + on_signals @ signals, on_signals @ D

    def _sample(self, state, signals) -> Any:
        """Readings, and the states just after a sample, from the states just before it.

        Of several samples, along a second axis of states and signals.
        """
        delay_starts, filter_starts, noise_starts, _ = self._state_layout()
        readings, after = [], state
        for i, sections in enumerate(self.filter_sections):
            sample, delay = signals[i], self.delays[i]
            if delay is not None:
                samples = state[delay_starts[i] : delay_starts[i] + self.max_delay_periods + 1]
                is_read = self._split_delay(delay)[0] == np.arange(self.max_delay_periods + 1)
                sample = xp.where(is_read, 1.0, 0.0) @ samples
                later = slice(delay_starts[i] + 1, delay_starts[i] + self.max_delay_periods + 1)
                after = set_at(after, later, samples[:-1])
            if sections is not None:
                states = slice(filter_starts[i], filter_starts[i] + 2 * sections.shape[0])
                filter_states = state[states].reshape(-1, 2, state.shape[1])
                sample, filter_states = filter_step(
                    sections, filter_states, sample + state[noise_starts[i]]
                )
                after = set_at(after, states, filter_states.reshape(-1, state.shape[1]))
                after = set_at(after, noise_starts[i], 0.0)
            readings.append(sample)
        return xp.stack(readings), after

    def _split_delay(self, delay) -> tuple[Array, Array]:
        """Whole periods of a delay, and the time in each period (s) at which the sensor samples."""
        whole, rest = split_delay(delay, self.timing.period)
        return whole.astype(int), self.timing.period - rest

    def _state_layout(self) -> tuple[list, list, list, int]:
        """First index of samples h, filter states m, noise v of each sensor, or None; the end."""
        end = self.plant_states
        starts = [], [], []
        for sections, delay in zip(self.filter_sections, self.delays, strict=True):
            lengths = (
                0 if delay is None else self.max_delay_periods + 1,
                0 if sections is None else 2 * sections.shape[0],
                0 if sections is None else 1,
            )
            for indices, length in zip(starts, lengths, strict=True):
                indices.append(end if length else None)
                end += length
        return *starts, end


def _padded(matrix, rows: int, columns: int):
    """Matrices with further rows and columns of zeros."""
    return xp.pad(matrix, [*[(0, 0)] * (matrix.ndim - 2), (0, rows), (0, columns)])


def sensor_chain(
    plant: Plant,
    variance: Float[Array, " sensor"],
    timing: SampleTiming,
    plant_states: int,
    max_delay_periods: int,
) -> SensorChain:
    """Chain of the sensors of a case, for a plant with this number of states."""
    sensors = plant.case.sensors
    sections = tuple(sensor_sections(sensor, timing.period) for sensor in sensors)
    delays = tuple(sensor.delay for sensor in sensors)
    return SensorChain(sections, delays, variance, timing, plant_states, max_delay_periods)
