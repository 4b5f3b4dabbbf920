"""Modal model of responses to measured forces: modes with their uncertainties."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from tuning.modal.forced.common_denominator import Lines
from tuning.modal.forced.likelihood import FittedModel, resonances_of, split_coefficients
from tuning.modal.forced.uncertainty import BLOCKS, replicates
from tuning.modal.result import IdentifiedMode, frequency_and_damping


class ForcedModel(NamedTuple):
    """Modes, one for each pole, and what they leave: lines of the band with errors.

    `power` is that of the responses in the band.
    """

    modes: tuple[IdentifiedMode, ...]
    rest: Lines
    power: float


def _steps(model: FittedModel):
    """Changes of poles and coefficients for errors that could have been (replicate, ...).

    They are those of each block of lines, carried through the step of Gauss-Newton: a sandwich, so
    that the errors may have any spectrum.
    """
    solution = np.linalg.pinv(model.normal, rcond=1e-12, hermitian=True)
    blocks = np.tile(np.arange(len(model.lines.z)) % BLOCKS, 2)
    rows = [np.flatnonzero(blocks == block) for block in range(BLOCKS)]
    pole_steps, coefficient_steps = [], []
    for errors, share in replicates(model.free):
        for own in rows:
            one = np.sqrt(share) * errors[own]
            step = solution @ np.einsum(
                "rko,ro,o->k", model.slopes[own], one, model.weight, optimize=True
            )
            pole_steps.append(step)
            coefficient_steps.append(
                model.fit.inverse[:, own] @ one - np.einsum("cko,k->co", model.by_poles, step)
            )
    return np.array(pole_steps), np.array(coefficient_steps)


def modes_of_model(model: FittedModel, scale: Float[np.ndarray, " output"]) -> ForcedModel:
    """Modes of a fitted model with uncertainties; those of poles not refined have none.

    Outputs are in units of `scale`, shapes in those of the log. The change of a pole with fewer
    terms for the modes that are not in the model adds to its uncertainty.
    """
    plain, lines, poles, moving, fit = model[:5]
    model_errors = model.model_errors
    pole_steps, coefficient_steps = _steps(model)
    residues = split_coefficients(fit.found, lines, poles.size)[0]
    changes = np.array([split_coefficients(one, lines, poles.size)[0] for one in coefficient_steps])
    resonances, mirrored = resonances_of(lines, poles)
    power = np.maximum(np.sum(np.abs(plain.outputs) ** 2, axis=0), 1e-300)
    modes = []
    for k, pole in enumerate(poles):
        # A residue (input, output) is participation times shape.
        along = np.linalg.svd(residues[k])[0][:, 0].conj()
        physical = (along @ residues[k]) * scale
        largest = int(np.argmax(np.abs(physical)))
        unit = physical / physical[largest]
        moved = (along @ changes[:, k]) * scale / physical[largest]
        moved = moved - moved[:, [largest]] * unit
        parts = np.concatenate([moved.real, moved.imag], axis=1)
        place = np.flatnonzero(moving == k)
        covariance = np.zeros((2, 2))
        if place.size:
            pair = [place[0], place[0] + moving.size]
            own = pole_steps[:, pair] * [-1.0, 1.0]
            covariance = own.T @ own + np.diag(model_errors[pair] ** 2)
        frequency, frequency_sd, damping, damping_sd = frequency_and_damping(pole, covariance)
        part = resonances[:, [k]] * (plain.inputs @ residues[k])
        part = part + mirrored[:, [k]] * (plain.inputs @ residues[k].conj())
        modes.append(
            IdentifiedMode(
                frequency=frequency,
                frequency_sd=frequency_sd,
                damping_ratio=damping,
                damping_sd=damping_sd,
                energy_share=float(np.mean(np.sum(np.abs(part) ** 2, axis=0) / power)),
                shape=unit,
                shape_covariance=parts.T @ parts,
                quantile=float(student.ppf(0.975, model.freedom(k))),
            )
        )
    errors = fit.errors[: len(lines.z)] + 1j * fit.errors[len(lines.z) :]
    rest = plain._replace(outputs=errors / lines.level[:, None])
    return ForcedModel(tuple(modes), rest, float(np.sum(np.abs(plain.outputs) ** 2)))
