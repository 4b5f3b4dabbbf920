"""Closed loop with a law in continuous time: commands at the Gauss nodes of each step.

They are found by Newton's method together with the states at the nodes.
"""

import contextlib

import equinox as eqx
import jax
from jaxtyping import Float

from jaxbeam.case.controller import AbstractContinuousLaw, Measurement
from jaxbeam.integrator.inputs import AbstractInputPolicy, StepInfo
from jaxbeam.integrator.propagators import GAUSS_NODES, NODE_COUNT
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.sensor_signals import filtered_reading
from jaxbeam.model.state_space import Plant
from jaxbeam.runtime.arrays import Array, any_jax, scan, vmap, xp
from jaxbeam.runtime.vectorised import NotVectorisedError, vectorised
from jaxbeam.simulation.commands import limit_commands

SHORTEST_STEP = 1e-12  # s, and of the time: far above the rounding of times
NEWTON_ITERATIONS = 4  # for the commands of a step; one suffices for a linear law


class ContinuousLoop(AbstractInputPolicy):
    """Input policy of a law in continuous time; its memory holds the commands at the last node.

    The model includes the analogue filters of sensors and law; its last states are the
    `controller_states` of the law, and their rates the last of its commands. `implicit` is False
    for open-loop commands, which do not depend on the state.
    """

    plant: Plant
    law: AbstractContinuousLaw
    model: ModalModel
    output_rows: Float[Array, "output state"]
    load_amplitude: Float[Array, " batch"]
    implicit: bool = eqx.field(static=True)
    controller_states: int = eqx.field(static=True)

    def start(self, batch_size):
        return xp.zeros((self.model.command_matrix.shape[1], batch_size))

    def inputs(self, memory, state, info: StepInfo, states):
        # In a step of no length, commands that jump at its start have jumped.
        length = xp.maximum(info.length, SHORTEST_STEP * (1 + info.start))
        times = info.start + length * GAUSS_NODES
        if not self.implicit:
            commands = self._open_loop_commands(times)[..., None]
            commands = xp.broadcast_to(commands, (*commands.shape[:2], state.shape[-1]))
            return commands, commands[-1]

        def commands_for(commands):
            of_batch = vmap(self._commands, in_axes=(-1, None), out_axes=-1)
            return vmap(of_batch)(states(commands), times)

        guess = xp.broadcast_to(memory, (NODE_COUNT, *memory.shape))
        commands = newton_fixed_point(commands_for, guess, NEWTON_ITERATIONS)
        return commands, commands[-1]

    def observe(self, memory, info):
        return None

    def failures(self, memory) -> Float[Array, " batch"]:
        """Number of samples without a solution: none, as there are no samples."""
        return xp.zeros(memory.shape[-1])

    def commands_at(
        self, states: Float[Array, "time state"], times: Float[Array, " time"]
    ) -> Float[Array, "time command"]:
        """Commands of a single run at some times (s): those to the actuators, then the rates."""
        if not self.implicit:
            return self._open_loop_commands(times)
        if not any_jax(self, states, times):
            with contextlib.suppress(NotVectorisedError):
                return vectorised(self._commands)(states, times)
        return vmap(self._commands)(states, times)

    def _open_loop_commands(self, times):
        """Commands of a law of time alone, (time, command): limits are applied to all at once."""
        sensors, no_command = len(self.plant.case.sensors), xp.zeros(len(self.plant.case.actuators))
        states = self.plant.modal_model.state_count
        nothing = Measurement(xp.zeros(sensors), xp.zeros(states), no_command)
        law_state = xp.zeros(0)
        commands = vmap(lambda time: self.law.command(law_state, nothing, time))(times)
        return limit_commands(self.plant.case, commands.T).T

    def _commands(self, state, time):
        """Commands and rates of the law's states, (command,), for the state of a run."""
        state = state[: self.model.state_count]  # without those of vehicles
        case, outputs = self.plant.case, self.output_rows @ state
        sensors = len(case.sensors)
        pairs = zip(case.sensors, outputs[:sensors], strict=True)
        readings = [filtered_reading(sensor, None, None, value)[0] for sensor, value in pairs]
        if outputs.shape[0]:
            outputs = xp.stack([*readings, *outputs[sensors:]])  # filters of the law follow
        law_state = state[state.shape[0] - self.controller_states :]
        plant_state = self.plant.from_modal(state[: self.plant.modal_model.state_count])
        measurement = Measurement(outputs, plant_state, xp.zeros(len(case.actuators)))
        command = limit_commands(case, self.law.command(law_state, measurement, time))
        rates = self.law.rates(law_state, measurement, command, time)
        return xp.concatenate([command, rates])


def newton_fixed_point(
    function, guess: Float[Array, "*shape batch"], iterations: int
) -> Float[Array, "*shape batch"]:
    """Fixed point of a function by Newton's method, for each entry of a batch by itself."""
    batch_size = guess.shape[-1]
    size = guess.size // batch_size
    unit_vectors = xp.broadcast_to(xp.eye(size)[..., None], (size, size, batch_size))

    def iterate(value, _):
        function_value, derivative = jax.linearize(function, value)
        slopes = vmap(derivative)(unit_vectors.reshape(size, *guess.shape)).reshape(
            unit_vectors.shape
        )
        residual = (function_value - value).reshape(size, batch_size)
        step = xp.linalg.solve((unit_vectors - slopes).T, residual.T[..., None])
        return value + step[..., 0].T.reshape(guess.shape), None

    return scan(iterate, guess, length=iterations)[0]
