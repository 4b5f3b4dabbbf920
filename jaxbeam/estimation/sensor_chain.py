"""From the beam to the readings: samples under way and digital filters, as states at the ticks.

The states just before a tick are z = (x, h, m, v): those x of the plant with the sensors' analogue
filters; for a sensor with a delay what it saw when it last looked, when it looked before, and so
on; the memories m of digital filters; and the noise v of the samples that these take at the tick.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.filters import filter_step
from jaxbeam.estimation.sampled_plant import PERIOD_ROUNDING, SampleTiming, Transition
from jaxbeam.model.sensor_filters import with_sensor_filters
from jaxbeam.model.sensor_signals import Sections, sensor_sections
from jaxbeam.model.state_space import Plant, StateSpace

# Of the noise of its samples, what a digital filter is taken to add to its output. Without it the
# filter would be undone exactly, and what it all but stops be taken for known.
FILTER_NOISE_RATIO = 1e-3

# The plant at a time (s), its outputs what the sensors see.
SystemAtTime = Callable[[Float[Array, ""]], StateSpace]


class FilteredPlant(eqx.Module):
    """A loaded beam with its sensors' analogue filters: `output_rows` is what they make of its states."""

    plant: Plant
    output_rows: Float[Array, "sensor state"]

    def with_filtered_outputs(self, system: StateSpace) -> StateSpace:
        """A system of the model, its outputs behind the analogue filters."""
        filters = [sensor.filter for sensor in self.plant.case.sensors]
        analogue = np.array([f is not None and f.realisation == "analogue" for f in filters])
        if not analogue.any():
            return system
        filtered_rows = self.output_rows @ self.plant.to_modal(jnp.eye(self.output_rows.shape[1]))
        filtered_rows = jnp.pad(
            filtered_rows, ((0, 0), (0, system.C.shape[1] - filtered_rows.shape[1]))
        )
        C = jnp.where(analogue[:, None], filtered_rows, system.C)
        D = jnp.where(analogue[:, None], 0.0, system.D)
        return eqx.tree_at(lambda s: (s.C, s.D), system, (C, D))


def filtered_plant(plant: Plant) -> FilteredPlant:
    """A model with the analogue filters of its sensors."""
    filtered_model, output_rows = with_sensor_filters(plant)
    return FilteredPlant(eqx.tree_at(lambda m: m.modal_model, plant, filtered_model), output_rows)


class SensorChain(eqx.Module):
    """Which states the sensors add to `plant_states` of the plant, and how they go on.

    `filter_sections` are those of digital filters, `delays` (s) the delays of the sensors, None where there
    is none; `variance` is that of the noise of their samples. A delay may reach back over `max_delay_periods`
    periods.
    """

    filter_sections: tuple[Sections, ...]
    delays: tuple[Float[Array, ""] | None, ...]
    variance: Float[Array, " sensor"]
    timing: SampleTiming
    plant_states: int = eqx.field(static=True)
    max_delay_periods: int = eqx.field(static=True)

    @property
    def state_count(self) -> int:
        """The number of all states."""
        return self._state_layout()[-1]

    @property
    def noise_covariance(self) -> Float[Array, "sensor sensor"]:
        """Covariance of the noise that readings have beside that among the states."""
        digital = np.array([part is not None for part in self.filter_sections])
        return jnp.diag(jnp.where(digital, FILTER_NOISE_RATIO**2, 1.0) * self.variance)

    def output_matrices(
        self, C, D
    ) -> tuple[Float[Array, "sensor all"], Float[Array, "sensor actuator"]]:
        """What takes the states just before a tick, and the commands, to the readings."""
        return self._jacobians(C, D, 0)

    def transition(self, system_at: SystemAtTime, intensity, scale, t=0.0) -> Transition:
        """The states from just before the tick a period before t (s) to just before that at t.

        White noise of this intensity acts on the rates of the plant; see `Ticks.transition`.
        """
        sensor_states = self.state_count - self.plant_states

        def state_and_input_matrices(time):
            system = system_at(time)
            return system.A, system.B

        start = t - self.timing.period
        previous_inputs = system_at(start)
        matrix, feedthrough = self._jacobians(previous_inputs.C, previous_inputs.D, 1)
        transition = Transition(
            matrix, feedthrough, jnp.zeros_like(feedthrough), jnp.zeros_like(matrix)
        )
        sampling_offsets = {
            i: self._split_delay(lag)[1] for i, lag in enumerate(self.delays) if lag is not None
        }
        parts, ends, before_command = self.timing.transitions(
            state_and_input_matrices, intensity, scale, t, list(sampling_offsets.values())
        )
        for k, part in enumerate(parts):
            padded = jax.scipy.linalg.block_diag(part.matrix, np.eye(sensor_states))
            previous_inputs, after = (
                jnp.pad(x, ((0, sensor_states), (0, 0)))
                for x in (part.previous_input_matrix, part.input_matrix)
            )
            noise = jnp.pad(part.noise_covariance, ((0, sensor_states), (0, sensor_states)))
            transition = transition.compose(Transition(padded, previous_inputs, after, noise))
            for i, look in sampling_offsets.items():
                system, is_sampled = system_at(start + ends[k]), ends[k] == look
                transition = transition.compose(
                    self._sampling_update(
                        i, system.C[i], system.D[i], is_sampled, before_command[k]
                    )
                )
        sample_noise = jnp.zeros(self.state_count)
        for index, variance in zip(self._state_layout()[2], self.variance, strict=True):
            sample_noise = sample_noise if index is None else sample_noise.at[index].set(variance)
        return eqx.tree_at(
            lambda w: w.noise, transition, transition.noise_covariance + jnp.diag(sample_noise)
        )

    def _sampling_update(self, sensor, row, feedthrough, is_sampled, before_command) -> Transition:
        """What a look of a sensor adds, if it is now: its signal becomes the latest sample."""
        index = self._state_layout()[0][sensor]
        identity = jnp.eye(self.state_count)
        seen = jnp.pad(row, (0, self.state_count - self.plant_states))
        matrix = identity.at[index].set(jnp.where(is_sampled, seen, identity[index]))
        no_input = jnp.zeros((self.state_count, feedthrough.shape[0]))
        before, after = (
            no_input.at[index].set(jnp.where(is_sampled & acts, feedthrough, 0.0))
            for acts in (before_command, ~before_command)
        )
        return Transition(matrix, before, after, jnp.zeros_like(identity))

    def _jacobians(self, C, D, which: int):
        """What takes states and commands to the readings (0), or to the states after a tick (1)."""

        def tick(state, command):
            return self._sample(state, C @ state[: self.plant_states] + D @ command)[which]

        return jax.jacfwd(tick, (0, 1))(jnp.zeros(self.state_count), jnp.zeros(D.shape[1]))

    def _sample(self, state, signals):
        """Readings of the states just before a tick, and the states just after it."""
        delay_starts, filter_starts, noise_starts, _ = self._state_layout()
        readings, after = [], state
        for i, sections in enumerate(self.filter_sections):
            sample, delay = signals[i], self.delays[i]
            if delay is not None:
                samples = state[delay_starts[i] : delay_starts[i] + self.max_delay_periods + 1]
                sample = samples @ jax.nn.one_hot(
                    self._split_delay(delay)[0], self.max_delay_periods + 1, dtype=float
                )
                after = after.at[
                    delay_starts[i] + 1 : delay_starts[i] + self.max_delay_periods + 1
                ].set(samples[:-1])
            if sections is not None:
                states = slice(filter_starts[i], filter_starts[i] + 2 * sections.shape[0])
                filter_states = state[states].reshape(-1, 2)
                sample, filter_states = filter_step(
                    sections, filter_states, sample + state[noise_starts[i]]
                )
                after = after.at[states].set(filter_states.reshape(-1)).at[noise_starts[i]].set(0.0)
            readings.append(sample)
        return jnp.stack(readings), after

    def _split_delay(self, delay) -> tuple[Array, Array]:
        """Whole periods in a delay, and how far into each period (s) the sensor looks."""
        whole = jax.lax.stop_gradient(jnp.floor(delay / self.timing.period + PERIOD_ROUNDING))
        fraction = jnp.maximum(delay - whole * self.timing.period, 0.0)
        return whole.astype(int), self.timing.period - fraction

    def _state_layout(self) -> tuple[list, list, list, int]:
        """Where samples, memories and noises of each sensor begin, None for none; and the end."""
        end = self.plant_states
        starts = [], [], []
        for sections, delay in zip(self.filter_sections, self.delays, strict=True):
            lengths = (
                0 if delay is None else self.max_delay_periods + 1,
                0 if sections is None else 2 * sections.shape[0],
                0 if sections is None else 1,
            )
            for places, length in zip(starts, lengths, strict=True):
                places.append(end if length else None)
                end += length
        return *starts, end


def sensor_chain(
    plant: Plant,
    variance: Float[Array, " sensor"],
    timing: SampleTiming,
    plant_states: int,
    max_delay_periods: int,
) -> SensorChain:
    """The chain of a case's sensors behind so many states of a plant."""
    sensors = plant.case.sensors
    sections = tuple(sensor_sections(sensor, timing.period) for sensor in sensors)
    delays = tuple(sensor.delay for sensor in sensors)
    return SensorChain(sections, delays, variance, timing, plant_states, max_delay_periods)
