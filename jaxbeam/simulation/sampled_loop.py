"""Closed loop with a law at samples: readings, law, delayed and held commands.

The law acts at multiples of its period on the readings available by then; its command begins a
delay later and is held, while the beam moves continuously in between.
"""

from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax
from jaxtyping import Float

from jaxbeam.case.controller import AbstractSampledLaw, Measurement
from jaxbeam.integrator.inputs import AbstractInputPolicy, StepInfo
from jaxbeam.integrator.propagators import NODE_COUNT
from jaxbeam.integrator.time_grid import EventSchedule
from jaxbeam.model.contact import contact_at
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.output_rows import OutputRows
from jaxbeam.model.sensing.sensor_signals import filtered_reading, initial_filter_state
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array, cond, is_jax, take, vmap, xp
from jaxbeam.simulation.commands import CommandMemory, CommandPath


class LoopMemory(NamedTuple):
    """Memory of a sampled loop, batch axis last.

    State of the law, commands on their way, states of the digital filters, latest readings and
    those not available yet (newest first), and the number of samples at which the law found no
    solution.
    """

    law_state: Any
    commands: CommandMemory
    filter_states: list
    readings: Float[Array, "age sensor batch"]
    failures: Float[Array, " batch"]


class SampledLoop(AbstractInputPolicy):
    """Input policy of a sampled law: one law for all runs of a batch, a memory for each.

    The model includes the analogue filters of the sensors; `filter_sections` are those of the
    digital ones. `measured_rows` are those of the quantities, of which accelerations follow from
    the forces too; None without accelerations. `path` is the way of the commands.
    """

    plant: Plant
    law: AbstractSampledLaw
    model: ModalModel
    output_rows: Float[Array, "sensor state"]
    measured_rows: OutputRows | None
    load_amplitude: Float[Array, " batch"]
    loads: LoadSet
    schedule: EventSchedule
    filter_sections: tuple
    path: CommandPath
    noise: Float[Array, "sample sensor"] | None
    implicit: bool = eqx.field(static=True, default=False)
    holds_commands: ClassVar[bool] = True

    def start(self, batch_size):
        sensors, zero = self.plant.case.sensors, xp.zeros(batch_size)
        pairs = list(zip(sensors, self.filter_sections, strict=True))
        filter_states = [initial_filter_state(sensor, part, zero) for sensor, part in pairs]
        readings = [
            filtered_reading(*pair, state, zero)[0]
            for pair, state in zip(pairs, filter_states, strict=True)
        ]
        readings = xp.stack(readings) if readings else xp.zeros((0, batch_size))
        return LoopMemory(
            _broadcast_to_batch(self.law.initial_state(), batch_size),
            self.path.start(batch_size, self.schedule.max_waiting),
            filter_states,
            xp.broadcast_to(readings, (self.schedule.max_age + 1, *readings.shape)),
            zero,
        )

    def inputs(self, memory: LoopMemory, state, info: StepInfo, states):
        memory = cond(
            info.event >= 0,
            lambda memory: self._process_event(memory, state, info),
            lambda memory: memory,
            memory,
        )
        acting = self.path.acting(memory.commands)
        return xp.broadcast_to(acting, (NODE_COUNT, *acting.shape)), memory

    def observe(self, memory, info):
        """Available readings (sensor, batch), and number of failures of the law (batch).

        And the commands (actuator, batch) where they act through hysteresis or creep, else None.
        """
        through_operator = any(one is not None for one in self.path.operators)
        sent = memory.commands.command if through_operator else None
        return self._available_readings(memory.readings, info.event), memory.failures, sent

    def failures(self, memory) -> Float[Array, " batch"]:
        """Number of samples at which the law found no solution, up to the end of the run."""
        return memory.failures

    def _process_event(self, memory, state, info):
        """Memory after an event: samples of sensors, a step of the law, a command that begins."""
        schedule, event = self.schedule, info.event
        filter_states, readings = self._sample_sensors(memory, state, info)

        def step(inputs):
            law_state, commands, failures = inputs
            available = self._available_readings(readings, event)
            acting = self.path.assumed_commands(commands, schedule.assumed_age)
            command, law_state, solved = self._step_law(law_state, available, state, acting, info)
            return law_state, self.path.send(commands, command), failures + ~solved

        law_state, commands, failures = cond(
            take(schedule.control_sample, event) >= 0,
            step,
            lambda inputs: inputs,
            (memory.law_state, memory.commands, memory.failures),
        )
        commands = self.path.begin(commands, take(schedule.command_age, event))
        return LoopMemory(law_state, commands, filter_states, readings, failures)

    def _sample_sensors(self, memory, state, info):
        """Filter states and readings after the samples that are due at an event."""
        readings, filter_states, histories = memory.readings, [], []
        signals = cond(
            xp.any(take(self.schedule.reading, info.event) >= 0),
            lambda state: self._sensor_inputs(state, self.path.acting(memory.commands), info.start),
            lambda state: xp.zeros((self.output_rows.shape[0], state.shape[1])),
            state,
        )
        for i, sensor in enumerate(self.plant.case.sensors):
            number = take(self.schedule.reading, (info.event, i))
            if not is_jax(number) and number < 0:
                filter_states.append(memory.filter_states[i])
                histories.append(readings[:, i])
                continue
            noise = None if self.noise is None else take(self.noise, (number, i))
            reading, filter_state = filtered_reading(
                sensor, self.filter_sections[i], memory.filter_states[i], signals[i], noise
            )
            due = number >= 0
            filter_states.append(_tree_where(due, filter_state, memory.filter_states[i]))
            shifted = xp.concatenate([reading[None], readings[:-1, i]])
            histories.append(_tree_where(due, shifted, readings[:, i]))
        return filter_states, xp.stack(histories, axis=1) if histories else readings

    def _available_readings(self, readings, event):
        """Latest readings (sensor, batch) that are available at an event."""
        ages = [take(self.schedule.reading_age, (event, i)) for i in range(readings.shape[1])]
        latest = [take(readings, (age, i)) for i, age in enumerate(ages)]
        return xp.stack(latest) if latest else readings[0]

    def _sensor_inputs(self, state, command, time):
        """Inputs of the sensors (sensor, batch) at a time (s)."""
        signals = self.output_rows @ state[: self.model.state_count]
        if self.measured_rows is None:
            return signals
        contact = contact_at(self.model, self.loads, time, state, command)
        return self.measured_rows.with_accelerations(signals, contact.modal_acceleration)

    def _step_law(self, law_state, readings, state, command, info):
        """Step of the law for each run of the batch."""
        missing = self.schedule.missing
        present = None if missing is None else ~take(missing, info.event)

        def step(law_state, *measured):
            measurement = Measurement(*measured)._replace(present=present)
            return self.law.step(law_state, measurement, info.start)

        plant_state = self.plant.from_modal(state[: self.plant.modal_model.state_count])
        return vmap(step, in_axes=-1, out_axes=-1)(law_state, readings, plant_state, command)


def _broadcast_to_batch(state, batch_size: int):
    """The same state for each run, along a new last axis."""
    return jax.tree.map(
        lambda leaf: xp.broadcast_to(xp.asarray(leaf)[..., None], (*xp.shape(leaf), batch_size)),
        state,
    )


def _tree_where(condition, new, old):
    """Numbers of one tree or of another with the same structure."""
    if not is_jax(condition):
        return new if condition else old
    return jax.tree.map(lambda a, b: xp.where(condition, a, b), new, old)
