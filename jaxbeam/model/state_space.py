"""Continuous state space of a case, for the design of controllers and for other tools.

    z' = A(t) z + B(t) u + B_f(t) W,     y = C(t) z + D(t) (u, W)

with the states z = (q, q', states of the actuators), eqs (2.36) and (2.46) of the thesis, commands
u, and the weights W of the loads (N, positive downwards). While a mass is on the beam, the mass
matrix I + sum m psi psi^T is inverted by its update of rank one for each load.
"""

import os
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import scipy
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import is_known, known
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.model.contact import Traffic, contact_rows, traffic
from jaxbeam.model.modal_model import Rig, rig_in_one
from jaxbeam.model.modes import Layout
from jaxbeam.numerics.batched_linalg import solve_small
from jaxbeam.numerics.discretisation import c2d
from jaxbeam.runtime.compiling import compiled


class Signal(NamedTuple):
    """Name and SI unit of a state, an input or an output."""

    name: str
    unit: str


class StateSpace(eqx.Module):
    """A linear system z' = A z + B u, y = C z + D u with named signals.

    With a `period` (s) it is one in discrete time, z_(k+1) = A z_k + B u_k.
    """

    A: Float[Array, "state state"]
    B: Float[Array, "state input"]
    C: Float[Array, "output state"]
    D: Float[Array, "output input"]
    states: tuple[Signal, ...] = eqx.field(static=True)
    inputs: tuple[Signal, ...] = eqx.field(static=True)
    outputs: tuple[Signal, ...] = eqx.field(static=True)
    period: Float[Array, ""] | None = None

    def discretize(self, period: Float[Array, ""] | float) -> "StateSpace":
        """The same system at samples a period (s) apart, its inputs held in between. Exact.

        Differentiable. Raises ValueError if it is in discrete time already.
        """
        if self.period is not None:
            raise ValueError("the system is in discrete time already; take the continuous one")
        drift, push = c2d(self.A, self.B, period)
        parts = self.states, self.inputs, self.outputs
        return StateSpace(drift, push[0], self.C, self.D, *parts, jnp.asarray(period, float))

    def to_control(self) -> Any:
        """A `control.StateSpace` of the package python-control, with the same signal names.

        Raises ImportError, saying what to install, if that package is missing.
        """
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
        content = {name: np.asarray(getattr(self, name)) for name in "ABCD"}
        content["period"] = np.asarray(0.0 if self.period is None else self.period)
        for kind in ("states", "inputs", "outputs"):
            signals = getattr(self, kind)
            content[kind] = np.array([signal.name for signal in signals], dtype=object)
            content[f"{kind}_units"] = np.array([signal.unit for signal in signals], dtype=object)
        try:
            with open(path, "wb" if overwrite else "xb") as file:
                scipy.io.savemat(file, content)
        except FileExistsError:
            raise FileExistsError(
                f"{path} exists already; choose another name, or overwrite it"
            ) from None


class LoadedBeam(eqx.Module):
    """State space of a rig crossed by loads, at any time t (s).

    `scale` times the rig's coordinates are the coordinates q of the states (see `state_space`).
    Outputs are what the sensors would read if they were ideal.
    """

    case: Case
    rig: Rig
    traffic: Traffic
    scale: Float[Array, " mode"]
    coordinate: Signal = eqx.field(static=True)

    @property
    def states(self) -> tuple[Signal, ...]:
        """Names and units of the states: coordinates, their rates, states of the actuators."""
        modes = range(1, self.scale.shape[0] + 1)
        name, unit = self.coordinate
        places = [Signal(f"{name}_{n}", unit) for n in modes]
        rates = [Signal(f"{name}_{n}_rate", f"{unit}/s") for n in modes]
        own = range(1, self.rig.states - 2 * len(modes) + 1)
        return (*places, *rates, *(Signal(f"actuator_state_{n}", "own") for n in own))

    @property
    def weights(self) -> Float[Array, " load"]:
        """Weights W of the loads in N, on the beam or off it."""
        return self.traffic.weight[:, 0]

    def from_rig(self, states: Float[Array, "state *lane"]) -> Float[Array, "state *lane"]:
        """The states z of given states of the rig, which keeps (q_1, q_1', q_2, ...)."""
        ordered = states[self._order]
        return ordered * self._scales.reshape(-1, *(1,) * (states.ndim - 1))

    def to_rig(self, states: Float[Array, "state *lane"]) -> Float[Array, "state *lane"]:
        """The states of the rig for given states z."""
        scaled = states / self._scales.reshape(-1, *(1,) * (states.ndim - 1))
        return scaled[np.argsort(self._order)]

    def at(self, t: Float[Array, ""] | float) -> StateSpace:
        """The system frozen at a time (s); its inputs are the commands, then the weights W.

        At the time at which a load enters or leaves it is that just after.
        """
        return _at(self, jnp.asarray(t, float))

    def A(self, t: Float[Array, ""] | float) -> Float[Array, "state state"]:
        """State matrix A(t) with the masses on the beam."""
        return self.at(t).A

    def B(self, t: Float[Array, ""] | float) -> Float[Array, "state actuator"]:
        """Command matrix B(t): the masses take part in the motion that forces cause at once."""
        return self.at(t).B[:, : len(self.case.actuators)]

    def B_f(self, t: Float[Array, ""] | float) -> Float[Array, "state load"]:
        """Matrix of the weights W; the columns of loads off the beam are zero."""
        return self.at(t).B[:, len(self.case.actuators) :]

    @property
    def unloaded(self) -> StateSpace:
        """The time-invariant system without loads; its inputs are the commands."""
        return _unloaded(self)

    def augmented(self, t: Float[Array, ""] | float) -> StateSpace:
        """The system with the weights as further, constant states, eq. (5.8) of the thesis.

        Its inputs are the commands alone; the states of the loads start at `weights`.
        """
        frozen, commands = self.at(t), len(self.case.actuators)
        loads = frozen.inputs[commands:]
        none = np.zeros((len(loads), len(frozen.states)))
        return StateSpace(
            A=jnp.block([[frozen.A, frozen.B[:, commands:]], [none, np.zeros((len(loads),) * 2)]]),
            B=jnp.concatenate([frozen.B[:, :commands], np.zeros((len(loads), commands))]),
            C=jnp.concatenate([frozen.C, frozen.D[:, commands:]], axis=1),
            D=frozen.D[:, :commands],
            states=frozen.states + loads,
            inputs=frozen.inputs[:commands],
            outputs=frozen.outputs,
        )

    @property
    def _order(self) -> np.ndarray:
        """Where the states z are among those of the rig."""
        modal = 2 * self.scale.shape[0]
        own = np.arange(modal, self.rig.states)
        return np.concatenate([np.arange(0, modal, 2), np.arange(1, modal, 2), own])

    @property
    def _scales(self) -> Float[Array, " state"]:
        """What the rig's states, in the order of z, are multiplied by."""
        own = jnp.ones(self.rig.states - 2 * self.scale.shape[0])
        return jnp.concatenate([self.scale, self.scale, own])

    def _contact(self, t):
        """Shape rows (load, mode), contact rows (load, state of the rig) and masses (kg) at t."""
        loads = self.traffic
        position, speed, acceleration = loads.travel(t)
        windows = [path.window() for path in loads.motions]
        active = jnp.array([(entry <= t) & (t < leave) for entry, leave in windows], bool)
        shape, rows = contact_rows(self.rig, position, speed, acceleration, active)
        count = len(loads.motions)
        mass = jnp.where(active, loads.inertia[:, 0], 0.0)
        return shape.reshape(count, self.scale.size), rows.reshape(count, self.rig.states), mass

    def _frozen(self, shape, rows, mass) -> StateSpace:
        """The system while loads of these masses, shape and contact rows are on the beam."""
        model, modes = self.rig, self.scale.shape[0]
        rates = np.arange(1, 2 * modes, 2)
        matrix, command = block_diag(*model.state_matrix), model.command_matrix
        # The contact forces: (1 + m S S') r = -W - m (rows z + S forces of the commands).
        push = jnp.zeros((model.states, shape.shape[0])).at[rates].set(shape.T)
        held = jnp.eye(len(mass)) + mass * (shape @ shape.T)
        push = solve_small(held[:, :, None], push.T[:, :, None])[:, :, 0].T
        matrix = matrix - push @ (mass[:, None] * rows)
        command = command - push @ (mass[:, None] * (shape @ command[rates]))
        inputs = jnp.concatenate([command, -push], axis=1)
        row, direct = self._outputs(matrix, inputs)
        order, scales = self._order, self._scales
        loads = tuple(Signal(f"load_{i}", "N") for i in range(len(mass)))
        return StateSpace(
            A=matrix[np.ix_(order, order)] * scales[:, None] / scales,
            B=inputs[order] * scales[:, None],
            C=row[:, order] / scales,
            D=direct,
            states=self.states,
            inputs=_commands(self.case) + loads,
            outputs=tuple(
                Signal(f"sensor_{i}_{s.quantity}", QUANTITIES[s.quantity])
                for i, s in enumerate(self.case.sensors)
            ),
        )

    def _outputs(self, matrix, inputs):
        """Rows that take the rig's states, and the inputs, to what the sensors measure."""
        states, modal = self.rig.states, 2 * self.scale.shape[0]
        rows = jnp.zeros((len(self.case.sensors), states))
        direct = jnp.zeros((len(self.case.sensors), inputs.shape[1]))
        for i, sensor in enumerate(self.case.sensors):
            derivative = {"slope": 1, "strain": 2}.get(sensor.quantity, 0)
            shape = self.rig.shapes(sensor.position, (derivative,))[0]
            if sensor.quantity == "strain":
                shape = -sensor.fibre_distance * shape
            if sensor.quantity == "acceleration":
                rows = rows.at[i].set(shape @ matrix[1:modal:2])
                direct = direct.at[i].set(shape @ inputs[1:modal:2])
            else:
                first = 1 if sensor.quantity == "velocity" else 0
                rows = rows.at[i, first:modal:2].set(shape)
        return rows, direct


# One program each: done one by one, all these small operations would take seconds to compile.
@compiled
def _at(model: LoadedBeam, t) -> StateSpace:
    return model._frozen(*model._contact(t))


@compiled
def _unloaded(model: LoadedBeam) -> StateSpace:
    modes, states = model.scale.shape[0], model.rig.states
    return model._frozen(jnp.zeros((0, modes)), jnp.zeros((0, states)), jnp.zeros(0))


def _commands(case: Case) -> tuple[Signal, ...]:
    """The commands, in the unit in which the actuators' limits are given."""
    units = [type(a).__dataclass_fields__["limits"].metadata["unit"] for a in case.actuators]
    return tuple(Signal(f"command_{i}", unit) for i, unit in enumerate(units))


def state_space(case: Case, coordinates: str = "modal", layout: Layout | None = None) -> LoadedBeam:
    """The state space of a case: beam, supports, actuators and loads; without its controller.

    The coordinates q are those of the rig ("modal"), mass-normalised, in m kg^0.5; or ("sine")
    the amplitudes in m of sin(n pi x / L), as throughout the thesis, where each mode is such a
    sine: a uniform beam on two pins without supports in between. Filters, delays and noise of the
    sensors are left out. Inside `jit`, give the `layout` found outside by `modes.lay_out`.

    Raises ValueError for other coordinates, and if the modes are no sines.
    """
    return loaded_beam(case, rig_in_one(case, layout), coordinates)


def loaded_beam(case: Case, model: Rig, coordinates: str = "modal") -> LoadedBeam:
    """The state space of a case whose rig is assembled already; see `state_space`.

    Raises ValueError as that does.
    """
    if coordinates == "modal":
        scale, coordinate = jnp.ones(case.beam.modes), Signal("q", "m kg^0.5")
    elif coordinates == "sine":
        scale, coordinate = _sine_amplitudes(case, model), Signal("a", "m")
    else:
        raise ValueError(f"coordinates may be 'modal' or 'sine', not {coordinates!r}")
    return LoadedBeam(case, model, traffic(case), scale, coordinate)


def _sine_amplitudes(case: Case, model: Rig) -> Float[Array, " mode"]:
    """What the coordinates of the rig are to be multiplied by to give amplitudes of sines."""
    shares = (np.arange(64) + 0.5) / 64
    shapes = model.shapes(case.beam.length * shares, (0,))[0]
    sines = np.sin(np.pi * np.outer(shares, np.arange(1, case.beam.modes + 1)))
    scale = jnp.sum(shapes * sines, axis=0) / np.sum(sines**2, axis=0)
    rest = shapes - scale * sines
    if is_known(rest) and np.max(np.abs(known(rest))) > 1e-6 * np.max(np.abs(known(scale))):
        raise ValueError(
            "the modes of this beam are not sin(n pi x / L); use coordinates='modal', or a"
            " pinned-pinned beam without supports in between"
        )
    return scale
