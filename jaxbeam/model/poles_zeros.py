"""Poles and transmission zeros of beam, absorbers and actuators, with stationary masses."""

import numpy as np
import scipy
from jaxtyping import Complex

from jaxbeam.case.case import Case
from jaxbeam.case.validation import check_case
from jaxbeam.model.channels import check_pairs, input_column, output_row
from jaxbeam.model.frequency_response import (
    StationaryMasses,
    checked_masses,
    descriptor_matrices,
)
from jaxbeam.model.modal_model import compiled_modal_model
from jaxbeam.runtime.arrays import xp


def poles(case: Case, stationary_masses: StationaryMasses = ()) -> Complex[np.ndarray, " state"]:
    """Poles of beam, supports, absorbers and actuators in rad/s, in order of magnitude.

    Not differentiable. Raises ValueError as `frequency_response` does.
    """
    check_case(case)
    masses = checked_masses(case, stationary_masses)
    A, E = descriptor_matrices(case, compiled_modal_model(case), masses)
    return _sort_by_magnitude(scipy.linalg.eigvals(np.asarray(A), np.asarray(E)))


def zeros(
    case: Case, pair: tuple[str, str], stationary_masses: StationaryMasses = ()
) -> Complex[np.ndarray, " zero"]:
    """Transmission zeros of a pair (input, output) in rad/s, in order of magnitude.

    Those for the input `actuators.I.active_force` are those for the command. Not differentiable.
    Raises ValueError as `frequency_response` does.
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
    """In order of magnitude; of conjugates, equal up to rounding, the negative frequency first."""
    sizes = np.array([float(f"{size:.9g}") for size in np.abs(values)])
    return values[np.lexsort((values.imag, sizes))]
