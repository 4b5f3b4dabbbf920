"""Sensor chain from the plant to the readings: delays and digital filters as discrete states.

The states just before a sample of the controller are z = (x, h, m, v): x of the plant with the
analogue filters of the sensors; h, for a sensor with a delay, its last samples, newest first; the
states m of digital filters; and the noise v of the samples that these filters receive.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.filters import filter_step
from jaxbeam.estimation.sampled_plant import SampleTiming, Transition, split_delay
from jaxbeam.model.linear_system import StateSpace
from jaxbeam.model.sensing.sensor_signals import Sections, sensor_sections, with_sensor_filters
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array, set_at, xp
from jaxbeam.runtime.module import Module

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
