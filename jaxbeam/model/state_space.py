"""Continuous state space of a case, for the design of controllers and for other tools.

    z' = A(t) z + B(t) u + B_f(t) W,     y = C(t) z + D(t) (u, W)

with the states z = (q, q', states of the actuators), eqs (2.36) and (2.46) of the thesis, commands
u, and the weights W of the loads (N, positive downwards). The inverse of the mass matrix
I + sum m psi psi^T of the beam with its loads is a low-rank update, one rank for each load.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.model.contact import surface_rows
from jaxbeam.model.linear_system import Signal, StateSpace
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, compiled_modal_model
from jaxbeam.model.modes import Layout
from jaxbeam.model.sensing.output_rows import sensor_rows
from jaxbeam.numerics.batched_linalg import solve_small
from jaxbeam.runtime.arrays import Array, set_at, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.module import Module


class Plant(Module):
    """State space of the beam with its loads, at any time t (s).

    The coordinates q of the states are `coordinate_scale` times those of the modal model (see
    `state_space`). Outputs are the readings of ideal sensors.
    """

    case: Case
    modal_model: ModalModel
    loads: LoadSet
    coordinate_scale: Float[Array, " mode"]
    coordinate: Signal = eqx.field(static=True)

    @property
    def states(self) -> tuple[Signal, ...]:
        """Names and units of the states: coordinates, their rates, states of the actuators."""
        modes = range(1, self.coordinate_scale.shape[0] + 1)
        name, unit = self.coordinate
        coordinates = [Signal(f"{name}_{n}", unit) for n in modes]
        rates = [Signal(f"{name}_{n}_rate", f"{unit}/s") for n in modes]
        actuator_states = range(1, self.modal_model.state_count - 2 * len(modes) + 1)
        return (
            *coordinates,
            *rates,
            *(Signal(f"actuator_state_{n}", "own") for n in actuator_states),
        )

    @property
    def weights(self) -> Float[Array, " load"]:
        """Weights W of the loads in N, on the beam or off it."""
        return self.loads.weight[:, 0]

    def from_modal(self, states: Float[Array, "state *batch"]) -> Float[Array, "state *batch"]:
        """States z from the states of the modal model, whose order is (q_1, q_1', q_2, ...)."""
        ordered = states[self._state_order]
        return ordered * self._state_scales.reshape(-1, *(1,) * (states.ndim - 1))

    def to_modal(self, states: Float[Array, "state *batch"]) -> Float[Array, "state *batch"]:
        """States of the modal model from the states z."""
        scaled = states / self._state_scales.reshape(-1, *(1,) * (states.ndim - 1))
        return scaled[np.argsort(self._state_order)]

    def at(self, t: Float[Array, ""] | float) -> StateSpace:
        """System with the loads frozen at a time (s); inputs are the commands, then the weights.

        At the instant at which a load enters or leaves, the system just after it.
        """
        return _plant_at(self, xp.asarray(t, float))

    def A(self, t: Float[Array, ""] | float) -> Float[Array, "state state"]:
        """State matrix A(t) with the masses on the beam."""
        return self.at(t).A

    def B(self, t: Float[Array, ""] | float) -> Float[Array, "state actuator"]:
        """Command matrix B(t) with the masses on the beam."""
        return self.at(t).B[:, : len(self.case.actuators)]

    def B_f(self, t: Float[Array, ""] | float) -> Float[Array, "state load"]:
        """Matrix of the weights W; the columns of loads off the beam are zero."""
        return self.at(t).B[:, len(self.case.actuators) :]

    @property
    def unloaded(self) -> StateSpace:
        """Time-invariant system without loads; its inputs are the commands."""
        return _unloaded_plant(self)

    def augmented(self, t: Float[Array, ""] | float) -> StateSpace:
        """System augmented by the weights as constant states, eq. (5.8) of the thesis.

        Its inputs are the commands; the initial values of the added states are the `weights`.
        """
        frozen_system, commands = self.at(t), len(self.case.actuators)
        loads = frozen_system.inputs[commands:]
        zero_rows = np.zeros((len(loads), len(frozen_system.states)))
        return StateSpace(
            A=xp.block(
                [
                    [frozen_system.A, frozen_system.B[:, commands:]],
                    [zero_rows, np.zeros((len(loads),) * 2)],
                ]
            ),
            B=xp.concatenate([frozen_system.B[:, :commands], np.zeros((len(loads), commands))]),
            C=xp.concatenate([frozen_system.C, frozen_system.D[:, commands:]], axis=1),
            D=frozen_system.D[:, :commands],
            states=frozen_system.states + loads,
            inputs=frozen_system.inputs[:commands],
            outputs=frozen_system.outputs,
        )

    @property
    def _state_order(self) -> np.ndarray:
        """Index of each state z among the states of the modal model."""
        modal = 2 * self.coordinate_scale.shape[0]
        actuator_states = np.arange(modal, self.modal_model.state_count)
        return np.concatenate([np.arange(0, modal, 2), np.arange(1, modal, 2), actuator_states])

    @property
    def _state_scales(self) -> Float[Array, " state"]:
        """Scale of each state z relative to that of the modal model."""
        actuator_scales = xp.ones(self.modal_model.state_count - 2 * self.coordinate_scale.shape[0])
        return xp.concatenate([self.coordinate_scale, self.coordinate_scale, actuator_scales])

    def _contact_matrices(self, t):
        """Shape rows (load, mode), contact rows (load, state) and masses (kg) on the beam at t."""
        loads = self.loads
        position, speed, acceleration = loads.kinematics(t)
        active = loads.on_beam(t)
        rows = surface_rows(self.modal_model, position, speed, acceleration, active)
        count = loads.wheel_count
        mass = xp.where(active, loads.inertia[:, 0], 0.0)
        return (
            rows.shape.reshape(count, self.coordinate_scale.size),
            rows.acceleration.reshape(count, self.modal_model.state_count),
            mass,
        )

    def _system_with_loads(self, shape_rows, contact_rows, mass) -> StateSpace:
        """System with loads of given masses (kg), shape and contact rows on the beam."""
        model = self.modal_model
        rates, matrix, command = model.rate_index, model.A, model.command_matrix
        # The contact forces: (1 + m S S') r = -W - m (rows z + S forces of the commands).
        force_input = set_at(
            xp.zeros((model.state_count, shape_rows.shape[0])), rates, shape_rows.T
        )
        contact_matrix = xp.eye(len(mass)) + mass * (shape_rows @ shape_rows.T)
        force_input = solve_small(contact_matrix[:, :, None], force_input.T[:, :, None])[:, :, 0].T
        matrix = matrix - force_input @ (mass[:, None] * contact_rows)
        command = command - force_input @ (mass[:, None] * (shape_rows @ command[rates]))
        inputs = xp.concatenate([command, -force_input], axis=1)
        C, D = sensor_rows(model, self.case, self.case.sensors).of_system(model, matrix, inputs)
        order, scales = self._state_order, self._state_scales
        loads = tuple(Signal(f"load_{i}", "N") for i in range(len(mass)))
        return StateSpace(
            A=matrix[np.ix_(order, order)] * scales[:, None] / scales,
            B=inputs[order] * scales[:, None],
            C=C[:, order] / scales,
            D=D,
            states=self.states,
            inputs=_command_signals(self.case) + loads,
            outputs=tuple(
                Signal(f"sensor_{i}_{s.quantity}", s.unit) for i, s in enumerate(self.case.sensors)
            ),
        )


@compiled_if_traced
def _plant_at(plant: Plant, t) -> StateSpace:
    return plant._system_with_loads(*plant._contact_matrices(t))


@compiled_if_traced
def _unloaded_plant(plant: Plant) -> StateSpace:
    modes, states = plant.coordinate_scale.shape[0], plant.modal_model.state_count
    return plant._system_with_loads(xp.zeros((0, modes)), xp.zeros((0, states)), xp.zeros(0))


def _command_signals(case: Case) -> tuple[Signal, ...]:
    """Names and units of the commands."""
    units = [actuator.command_unit for actuator in case.actuators]
    return tuple(Signal(f"command_{i}", unit) for i, unit in enumerate(units))


def state_space(case: Case, coordinates: str = "modal", layout: Layout | None = None) -> Plant:
    """State space of a case: beam, supports, actuators and loads, without its controller.

    The coordinates q are mass-normalised ("modal"), in m kg^0.5, or ("sine") the amplitudes in m
    of sin(n pi x / L) as in the thesis, for a uniform pinned-pinned beam without supports in
    between. Filters, delays and noise of the sensors are left out. Inside `jit`, pass the `layout`
    found outside by `model.modes.mesh_layout(case)`.

    Raises ValueError for other coordinates, and for "sine" if the modes are not such sines.
    """
    return build_plant(case, compiled_modal_model(case, layout), coordinates)


def build_plant(case: Case, model: ModalModel, coordinates: str = "modal") -> Plant:
    """State space of a case from its modal model; raises ValueError as `state_space` does."""
    if coordinates == "modal":
        scale, coordinate = xp.ones(case.beam.modes), Signal("q", "m kg^0.5")
    elif coordinates == "sine":
        scale, coordinate = _sine_scale(case, model), Signal("a", "m")
    else:
        raise ValueError(f"coordinates may be 'modal' or 'sine', not {coordinates!r}")
    return Plant(case, model, load_set(case), scale, coordinate)


def _sine_scale(case: Case, model: ModalModel) -> Float[Array, " mode"]:
    """Factors from the coordinates of the modal model to the amplitudes of sines.

    Raises ValueError if the modes are not sines.
    """
    relative_positions = (np.arange(64) + 0.5) / 64
    shapes = model.shapes(case.beam.length * relative_positions, (0,))[0]
    sines = np.sin(np.pi * np.outer(relative_positions, np.arange(1, case.beam.modes + 1)))
    scale = xp.sum(shapes * sines, axis=0) / np.sum(sines**2, axis=0)
    residual = shapes - scale * sines
    if is_concrete(residual) and np.max(np.abs(concrete(residual))) > 1e-6 * np.max(
        np.abs(concrete(scale))
    ):
        raise ValueError(
            "the modes of this beam are not sin(n pi x / L); use coordinates='modal', or a"
            " pinned-pinned beam without supports in between"
        )
    return scale
