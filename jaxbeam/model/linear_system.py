"""Linear state-space systems: sampling, poles and zeros."""

import os
from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Complex, Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import OUTSIDE, refuse_traced, refuses_traced
from jaxbeam.case.validation import check_case
from jaxbeam.model.channels import check_pairs, input_column, output_row
from jaxbeam.model.frequency_responses import (
    StationaryMasses,
    checked_masses,
    descriptor_matrices,
)
from jaxbeam.model.modal_model import compiled_modal_model
from jaxbeam.numerics.discretisation import c2d
from jaxbeam.runtime.arrays import Array, solve, xp
from jaxbeam.runtime.module import Module
from jaxbeam.runtime.output_file import whole_file


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
