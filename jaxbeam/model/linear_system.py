"""Linear systems with named signals, in continuous or discrete time."""

import os
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxbeam.numerics.discretisation import c2d
from jaxbeam.runtime.arrays import Array, solve, xp
from jaxbeam.runtime.module import Module
from jaxbeam.runtime.whole_file import whole_file


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
        with whole_file(path, overwrite) as beside, open(beside, "wb") as file:
            scipy.io.savemat(file, content)
