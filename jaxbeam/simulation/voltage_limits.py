"""Limits of the voltages that inner loops set: what a saturated amplifier leaves out of them.

A loop asks for the voltage v, a linear function of states and command; the coil gets clip(v). What
is missing, clip(v) - v, is one more command of the linear model: it acts on the coil, and takes
the integral of the loop back to where clip(v) is (see `jaxbeam.case.actuators.electrodynamic`).
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.actuators.electrodynamic import limited_loops
from jaxbeam.case.case import Case
from jaxbeam.integrator.propagators import NODE_COUNT
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.numerics.polynomials import lagrange_coefficients
from jaxbeam.runtime.arrays import Array, Module, set_at, xp

POINTS = 128  # within a step, at which voltages are compared with their limits
_FRACTIONS = (np.arange(POINTS) + 0.5) / POINTS
TO_POINTS = np.vander(_FRACTIONS, NODE_COUNT, increasing=True) @ lagrange_coefficients(NODE_COUNT).T
FROM_POINTS = np.linalg.pinv(TO_POINTS)


class VoltageLimits(Module):
    """Limits (V) of coils, and rows from the states of a plant and from commands to voltages."""

    low: Float[Array, " coil"]
    high: Float[Array, " coil"]
    of_states: Float[Array, "coil state"]
    of_commands: Float[Array, "coil actuator"]

    def asked(
        self, state: Float[Array, "all *batch"], command: Float[Array, "actuator *batch"]
    ) -> Float[Array, "coil *batch"]:
        """Voltages (V) that the loops ask for; states after those of the plant do not count."""
        return self.of_states @ state[: self.of_states.shape[1]] + self.of_commands @ command

    def missing(self, asked: Float[Array, "node coil batch"]) -> Float[Array, "node coil batch"]:
        """Voltages (V) missing to those asked for, from Gauss nodes to Gauss nodes of a step.

        Where a limit is passed within the step, the polynomial through the nodes with the least
        square of its distance, whose effect at the end of the step is that of the voltages.
        """
        low, high = self.low[:, None], self.high[:, None]
        within = xp.tensordot(TO_POINTS, asked, axes=1)
        return xp.tensordot(FROM_POINTS, xp.clip(within, low, high) - within, axes=1)


def with_missing_voltages(
    case: Case, plant: ModalModel, model: ModalModel
) -> tuple[ModalModel, VoltageLimits | None]:
    """Model whose last commands are missing voltages (V), and their limits; None without limits.

    `plant` is the modal model of the case, `model` the same with states and commands added.
    """
    coils = limited_loops(case.actuators)
    if not coils:
        return model, None
    sizes = [actuator.attachment().state_matrix.shape[0] for actuator in case.actuators]
    starts = 2 * plant.mode_count + np.cumsum([0, *sizes])
    of_states = xp.zeros((len(coils), plant.state_count))
    of_commands = xp.zeros((len(coils), len(case.actuators)))
    columns = xp.zeros((model.state_count, len(coils)))
    for row, i in enumerate(coils):
        port, own = case.actuators[i].coil_port(), np.arange(starts[i], starts[i + 1])
        shape, (on_s, on_rate, _) = plant.displacement_map[i], port.voltage.port
        coordinates, rates = (np.arange(k, 2 * plant.mode_count, 2) for k in (0, 1))
        of_states = set_at(of_states, (row, coordinates), on_s * shape)
        of_states = set_at(of_states, (row, rates), on_rate * shape)
        of_states = set_at(of_states, (row, own), port.voltage.states)
        of_commands = set_at(of_commands, (row, i), port.voltage.command)
        columns = set_at(columns, (own, row), port.on_missing)
    low, high = (xp.stack([case.actuators[i].limits[end] for i in coils]) for end in (0, 1))
    commands = xp.concatenate([model.command_matrix, columns], axis=1)
    limited = eqx.tree_at(lambda m: m.command_matrix, model, commands)
    return limited, VoltageLimits(low, high, of_states, of_commands)
