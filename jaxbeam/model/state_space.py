"""Continuous state space of a case, and linear systems with their sampling, poles and zeros.

    z' = A(t) z + B(t) u + B_f(t) W,     y = C(t) z + D(t) (u, W)

with the states z = (q, q', states of the actuators, states of the vehicles), eqs (2.36) and (2.46)
of the thesis, commands u, and the static wheel loads W (N, positive downwards). The inverse of the
mass matrix I + sum m psi psi^T of the beam with its loads is a low-rank update, one rank for each
wheel. Heights and pitch of vehicles are measured from static equilibrium.
"""

import dataclasses
import math
import os
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Complex, Float

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case
from jaxbeam.case.controller import commanded
from jaxbeam.case.fields import OUTSIDE, concrete, is_concrete, refuse_traced, refuses_traced
from jaxbeam.case.validation import check_case, check_plant
from jaxbeam.model.contact import (
    ContactRows,
    contact_rows,
    has_prescribed_disturbance,
    initial_vehicle_states,
    prescribed_disturbance,
    vehicle_system,
)
from jaxbeam.model.frequency_responses import (
    StationaryMasses,
    check_pairs,
    checked_masses,
    descriptor_matrices,
    input_column,
    output_row,
)
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, compiled_modal_model
from jaxbeam.model.modes import Layout
from jaxbeam.model.output_rows import OutputRows, sensor_rows
from jaxbeam.numerics.matrices import solve_small
from jaxbeam.numerics.stages import c2d
from jaxbeam.runtime.arrays import Array, Module, set_at, solve, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.output_file import whole_file
from jaxbeam.runtime.printer import counted


class Signal(NamedTuple):
    """Name and SI unit of a state, an input or an output."""

    name: str
    unit: str


class StateSpace(Module):
    """A linear system z' = A z + B u, y = C z + D u with named signals.

    With a `period` (s) it is one in discrete time, z_(k+1) = A z_k + B u_k. Frozen at several
    times, the matrices of each.
    """

    A: Float[Array, "*time state state"]
    B: Float[Array, "*time state input"]
    C: Float[Array, "*time output state"]
    D: Float[Array, "*time output input"]
    states: tuple[Signal, ...] = eqx.field(static=True)
    inputs: tuple[Signal, ...] = eqx.field(static=True)
    outputs: tuple[Signal, ...] = eqx.field(static=True)
    period: Float[Array, ""] | None = None

    def __repr__(self) -> str:
        named = {"states": self.states, "inputs": self.inputs, "outputs": self.outputs}
        lines = [
            f"  {name}: " + ", ".join(f"{one.name} ({one.unit})" for one in signals)
            for name, signals in named.items()
        ]
        kind = "z' = A z + B u" if self.period is None else "z_(k+1) = A z_k + B u_k"
        return "\n".join([f"StateSpace: {kind}, y = C z + D u", *lines])

    def discretize(self, period: Float[Array, ""] | float) -> "StateSpace":
        """Discrete-time system with this sampling period (s), exact for inputs held in between.

        Differentiable. Raises ValueError if the system is in discrete time already.
        """
        if self.period is not None:
            raise ValueError("the system is in discrete time already; take the continuous one")
        transition, input_matrix = c2d(self.A, self.B, period)
        parts = self.states, self.inputs, self.outputs
        return StateSpace(
            transition, input_matrix[0], self.C, self.D, *parts, xp.asarray(period, float)
        )

    def static_response(self, outputs: Any) -> Float[Array, "output state"]:
        """Rows -C A^-1 of some outputs: their values at rest under constant rates added to z'.

        Times B they are the static gains of the inputs. `outputs` is an index or a slice. Not
        finite where a mode has no stiffness.
        """
        return -solve(self.A.T, self.C[outputs].T).T

    def to_control(self) -> Any:
        """A `control.StateSpace` of the package python-control, with the same signal names.

        Raises ImportError, saying what to install, if that package is missing.
        """
        refuse_traced("a system of python-control", OUTSIDE, self)
        try:
            import control
        except ImportError:
            raise ImportError(
                "python-control is not installed; install jaxbeam with the extra 'control':"
                " pip install 'jaxbeam[control]'"
            ) from None
        return control.StateSpace(
            *(np.asarray(part) for part in (self.A, self.B, self.C, self.D)),
            0 if self.period is None else float(self.period),
            states=[signal.name for signal in self.states],
            inputs=[signal.name for signal in self.inputs],
            outputs=[signal.name for signal in self.outputs],
        )

    def to_mat(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the matrices to a MATLAB file (version 5) with names and units of all signals.

        `period` is 0 for continuous time, as in MATLAB's `ss`. Raises FileExistsError if the file
        exists and `overwrite` is not set.
        """
        refuse_traced("a file", OUTSIDE, self)
        content = {name: np.asarray(getattr(self, name)) for name in "ABCD"}
        content["period"] = np.asarray(0.0 if self.period is None else self.period)
        for kind in ("states", "inputs", "outputs"):
            signals = getattr(self, kind)
            content[kind] = np.array([signal.name for signal in signals], dtype=object)
            content[f"{kind}_units"] = np.array([signal.unit for signal in signals], dtype=object)
        with whole_file(path, overwrite) as partial, open(partial, "wb") as file:
            scipy.io.savemat(file, content)


@refuses_traced("a list of poles")
def poles(case: Case, stationary_masses: StationaryMasses = ()) -> Complex[np.ndarray, " state"]:
    """Poles of beam, supports, absorbers and actuators in rad/s, in order of magnitude.

    Raises ValueError as `frequency_response` does, and for a case whose numbers are traced.
    """
    check_case(case)
    masses = checked_masses(case, stationary_masses)
    A, E = descriptor_matrices(case, compiled_modal_model(case), masses)
    return _sort_by_magnitude(scipy.linalg.eigvals(np.asarray(A), np.asarray(E)))


@refuses_traced("a list of zeros")
def zeros(
    case: Case, pair: tuple[str, str], stationary_masses: StationaryMasses = ()
) -> Complex[np.ndarray, " zero"]:
    """Transmission zeros of a pair (input, output) in rad/s, in order of magnitude.

    Those for the input `actuators.I.active_force` are those for the command. Raises
    ValueError as `frequency_response` does, and for a case whose numbers are traced.
    """
    check_case(case)
    (checked_pair,) = check_pairs(case, [pair])
    model = compiled_modal_model(case)
    A, E = descriptor_matrices(case, model, checked_masses(case, stationary_masses))
    input_vector, command = input_column(case, model, checked_pair.excitation)
    state_row, rate_row, feedthrough_row = output_row(case, model, checked_pair.output)
    feedthrough = xp.atleast_1d(feedthrough_row @ command)
    added = ((0, A.shape[0] - model.state_count),)  # of absorbers
    input_vector, state_row, rate_row = (
        xp.pad(part, added) for part in (input_vector, state_row, rate_row)
    )
    pencil_A = xp.block([[A, input_vector[:, None]], [state_row, feedthrough]])
    pencil_E = xp.block([[E, xp.zeros_like(input_vector)[:, None]], [-rate_row, xp.zeros(1)]])
    eigenvalues = scipy.linalg.eigvals(np.asarray(pencil_A), np.asarray(pencil_E))
    # Zeros at infinity are computed as infinite or as numbers far beyond the poles.
    largest_pole = np.abs(scipy.linalg.eigvals(np.asarray(A))).max()
    return _sort_by_magnitude(eigenvalues[np.abs(eigenvalues) < 1e4 * largest_pole])


def _sort_by_magnitude(values):
    """Complex values in order of magnitude; of a conjugate pair the negative frequency first."""
    sizes = np.array([float(f"{size:.9g}") for size in np.abs(values)])
    return values[np.lexsort((values.imag, sizes))]


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

    def __repr__(self) -> str:
        count = self.coordinate_scale.shape[-1]
        title = f" of {self.case.title!r}" if self.case.title else ""
        return (
            f"Plant{title}: {counted(count, 'mode')} in {self.coordinate.name}"
            f" ({self.coordinate.unit});"
            " .at(t) returns the StateSpace at a time t (s)"
        )

    @property
    def states(self) -> tuple[Signal, ...]:
        """Names and units of the beam's states: coordinates, their rates, those of actuators."""
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
    def weights(self) -> Float[Array, " wheel"]:
        """Static loads W of the wheels in N, on the beam or off it."""
        return self.loads.weight[:, 0]

    @property
    def vehicle_states(self) -> int:
        """Number of states of the vehicles, which follow those of the beam."""
        return self.loads.vehicle_states

    @property
    def augmented_start(self) -> Float[Array, " added"]:
        """States that `augmented` adds to those of the beam, at the start of a run."""
        start = initial_vehicle_states(self.loads)
        vehicles = xp.zeros(0) if start is None else start[:, 0]
        one = xp.ones(int(has_prescribed_disturbance(self.loads)))
        return xp.concatenate([vehicles, self.weights, one])

    @property
    def commands(self) -> int:
        """Number of commands: one for each actuator, or for each driven one (`of_driven`)."""
        return self.modal_model.command_matrix.shape[1]

    def of_driven(self) -> "Plant":
        """The plant whose inputs are the commands of those actuators that take any."""
        if self.commands == len(self.case.driven):
            return self
        columns = self.modal_model.command_matrix[:, np.array(commanded(self.case.actuators), int)]
        model = eqx.tree_at(lambda m: m.command_matrix, self.modal_model, columns)
        return dataclasses.replace(self, modal_model=model)

    def from_modal(self, states: Float[Array, "state *batch"]) -> Float[Array, "state *batch"]:
        """States of the beam from those of the modal model, with the order (q_1, q_1', ...)."""
        ordered = states[self._state_order]
        return ordered * self._state_scales.reshape(-1, *(1,) * (states.ndim - 1))

    def to_modal(self, states: Float[Array, "state *batch"]) -> Float[Array, "state *batch"]:
        """States of the modal model from those of the beam."""
        scaled = states / self._state_scales.reshape(-1, *(1,) * (states.ndim - 1))
        return scaled[np.argsort(self._state_order)]

    def at(self, t: Float[Array, "*time"] | float) -> StateSpace:
        """System with the loads frozen at times (s); inputs are the commands, then the weights.

        Its last states are those of the vehicles, whose wheels travel at their speed. At the
        instant at which a wheel enters or leaves, the system just after it.
        """
        return _plant_at(self, xp.asarray(t, float))

    def A(self, t: Float[Array, ""] | float) -> Float[Array, "state state"]:
        """State matrix A(t) with the masses on the beam."""
        return self.at(t).A

    def B(self, t: Float[Array, ""] | float) -> Float[Array, "state actuator"]:
        """Command matrix B(t) with the masses on the beam."""
        return self.at(t).B[:, : self.commands]

    def B_f(self, t: Float[Array, ""] | float) -> Float[Array, "state load"]:
        """Matrix of the weights W; the columns of loads off the beam are zero."""
        return self.at(t).B[:, self.commands :]

    @property
    def unloaded(self) -> StateSpace:
        """Time-invariant system without loads and absorbers; its inputs are the commands.

        Absorbers are among the wheels of `at`; `jaxbeam.model.state_space.poles` has theirs.
        """
        return _unloaded_plant(self)

    def augmented(self, t: Float[Array, "*time"] | float) -> StateSpace:
        """System augmented by the weights as constant states, eq. (5.8) of the thesis.

        Its inputs are the commands; the states added to those of the beam start at
        `augmented_start`. With a profile, or forces that vary in time, a last state is 1: its
        columns are their effect on the beam and on the vehicles.
        """
        frozen_system, commands = self.at(t), self.commands
        columns = frozen_system.B[..., commands:], frozen_system.D[..., commands:]
        constants = frozen_system.inputs[commands:]
        if has_prescribed_disturbance(self.loads):
            weight, surface = prescribed_disturbance(self.loads, xp.asarray(t, float))
            lead, weight = [(0, 0)] * (surface.ndim - 1), weight[..., None]
            vehicle_rates = surface @ vehicle_system(self.loads)[1].T
            vehicle_rates = xp.pad(vehicle_rates, [*lead, (len(self.states), 0)])[..., None]
            disturbance = columns[0] @ weight + vehicle_rates, columns[1] @ weight
            columns = tuple(
                xp.concatenate(pair, axis=-1) for pair in zip(columns, disturbance, strict=True)
            )
            constants = (*constants, Signal("known_disturbance", "1"))
        rows = [*[(0, 0)] * (frozen_system.A.ndim - 2), (0, len(constants)), (0, 0)]
        return StateSpace(
            A=xp.pad(xp.concatenate([frozen_system.A, columns[0]], axis=-1), rows),
            B=xp.pad(frozen_system.B[..., :commands], rows),
            C=xp.concatenate([frozen_system.C, columns[1]], axis=-1),
            D=frozen_system.D[..., :commands],
            states=frozen_system.states + constants,
            inputs=frozen_system.inputs[:commands],
            outputs=frozen_system.outputs,
        )

    @property
    def output_rows(self) -> OutputRows:
        """Rows of the ideal sensors on the coordinates of the modal model."""
        rows = sensor_rows(self.modal_model, self.case, self.case.sensors)
        if self.commands == len(self.case.actuators):
            return rows
        columns = rows.on_commands[:, np.array(commanded(self.case.actuators), int)]
        return dataclasses.replace(rows, on_commands=columns)

    def with_contact(
        self, contact: ContactRows | None, output_rows: OutputRows | None = None
    ) -> StateSpace:
        """System with loads of given contact rows (*time), or without loads.

        Inputs and states are those of `at`; without loads those of `unloaded`. `output_rows` are
        those of the plant, computed if None.
        """
        model, states = self.modal_model, self.modal_model.state_count
        rates, matrix, command = model.rate_index, model.A, model.command_matrix
        order, scales, signals, weights = self._state_order, self._state_scales, self.states, ()
        inputs = command
        if contact is not None:
            times = contact.mass.shape[:-1]
            if contact.surface is not None:
                A, B, _ = vehicle_system(self.loads)
                added = len(A)
                upper = xp.pad(matrix, ((0, 0), (0, added)))
                upper, below = (xp.broadcast_to(x, (*times, *x.shape)) for x in (upper, A))
                below = xp.concatenate([B @ contact.surface, below], axis=-1)
                matrix = xp.concatenate([upper, below], axis=-2)
                command = xp.pad(command, ((0, added), (0, 0)))
                order = np.append(order, np.arange(states, states + added))
                scales = xp.append(scales, xp.ones(added))
                signals = signals + vehicle_signals(self.loads)
            # The contact forces: (1 + m S S') r = -W - V x - m S (forces of the commands).
            shape, mass = contact.shape, contact.mass
            wheels = mass.shape[-1]
            force_input = xp.zeros((*times, matrix.shape[-1], wheels))
            force_input = set_at(force_input, np.s_[..., rates, :], shape.mT)
            contact_matrix = xp.eye(wheels) + mass[..., None, :] * (shape @ shape.mT)
            systems = contact_matrix, force_input.mT  # of each time, which solve_small has last
            flat = (part.reshape(math.prod(times), wheels, part.shape[-1]) for part in systems)
            solution = xp.moveaxis(solve_small(*(xp.moveaxis(x, 0, -1) for x in flat)), -1, 0)
            force_input = solution.reshape(*times, wheels, matrix.shape[-1]).mT
            matrix = matrix - force_input @ contact.force
            command = command - force_input @ (mass[..., None] * (shape @ command[rates]))
            inputs = xp.concatenate([command, -force_input], axis=-1)
            weights = tuple(Signal(f"load_{i}", "N") for i in range(wheels))
        rows = self.output_rows if output_rows is None else output_rows
        C, D = rows.of_system(model, matrix, inputs)
        return StateSpace(
            A=matrix[..., order[:, None], order] * scales[:, None] / scales,
            B=inputs[..., order, :] * scales[:, None],
            C=C[..., order] / scales,
            D=D,
            states=signals,
            inputs=_command_signals(self) + weights,
            outputs=tuple(
                Signal(f"sensor_{i}_{s.quantity}", s.unit) for i, s in enumerate(self.case.sensors)
            ),
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


@compiled_if_traced
def _plant_at(plant: Plant, t) -> StateSpace:
    return plant.with_contact(contact_rows(plant.modal_model, plant.loads, t))


@compiled_if_traced
def _unloaded_plant(plant: Plant) -> StateSpace:
    return plant.with_contact(None)


def vehicle_signals(loads: LoadSet) -> tuple[Signal, ...]:
    """Names and units of the states of all vehicles: heights and pitch angles, then their rates.

    That of a body of the first load is "load_0_body", in a row "load_0_vehicle_1_body", that of
    the first absorber "absorber_0_body".
    """
    of_wheel, signals, count = loads.load_of_wheel, [], len(loads.trajectories) - loads.absorbers
    for group in loads.wheels.vehicles:
        for i in range(group.count):
            vehicle = f"_vehicle_{i + 1}" if group.count > 1 else ""
            number = of_wheel[group.first_wheel]
            carried = f"load_{number}" if number < count else f"absorber_{number - count}"
            prefix = f"{carried}{vehicle}"
            names = [f"{prefix}_{name.replace(' ', '_')}" for name in group.names]
            units = ["rad" if name.endswith("pitch") else "m" for name in group.names]
            signals += [Signal(*pair) for pair in zip(names, units, strict=True)]
            signals += [
                Signal(f"{name}_rate", f"{unit}/s") for name, unit in zip(names, units, strict=True)
            ]
    return tuple(signals)


def _command_signals(plant: Plant) -> tuple[Signal, ...]:
    """Names and units of the commands, numbered as the actuators are."""
    actuators = plant.case.actuators
    every = plant.commands == len(actuators)
    numbers = range(len(actuators)) if every else commanded(actuators)
    return tuple(Signal(f"command_{i}", actuators[i].command_unit) for i in numbers)


@checks_classes
def state_space(case: Case, coordinates: str = "modal", layout: Layout | None = None) -> Plant:
    """State space of a case: beam, supports, absorbers, actuators, loads; not its controller.

    The coordinates q are mass-normalised ("modal"), in m kg^0.5, or ("sine") the amplitudes in m
    of sin(n pi x / L) as in the thesis, for a uniform pinned-pinned beam without supports in
    between. Filters, delays and noise of the sensors are left out. Inside `jit`, pass the `layout`
    found outside by `model.modes.mesh_layout(case)`.

    Raises ValueError for an invalid case, other coordinates, and for "sine" if the modes are not
    such sines.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(jb.state_space(case).at(0.1).A.shape)
    (6, 6)
    """
    if layout is None:
        check_plant(case)
    return build_plant(case, compiled_modal_model(case, layout), coordinates)


def build_plant(case: Case, model: ModalModel, coordinates: str = "modal") -> Plant:
    """State space of a case from its modal model; raises ValueError as `state_space` does."""
    if coordinates == "modal":
        scale, coordinate = xp.ones(case.beam.modes), Signal("q", "m kg^0.5")
    elif coordinates == "sine":
        scale, coordinate = _sine_scale(case, model), Signal("a", "m")
    else:
        raise ValueError(f"coordinates may be 'modal' or 'sine', not {coordinates!r}")
    return Plant(case, model, load_set(case, model.modes.layout), scale, coordinate)


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
