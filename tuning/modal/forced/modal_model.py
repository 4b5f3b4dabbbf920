"""Modal model of responses to measured forces: modes with their uncertainties."""

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from tuning.modal.forced.common_denominator import Lines
from tuning.modal.forced.likelihood import (
    BLOCKS,
    FittedModel,
    replicates,
    resonances_of,
    split_coefficients,
    transients_of,
)
from tuning.modal.result import IdentifiedMode, frequency_and_damping


def _blocks(rows: Float[np.ndarray, "row *more"]) -> Float[np.ndarray, "block place *more"]:
    """Rows of real, then imaginary parts in blocks of lines; missing ones are zero."""
    more = rows.shape[1:]
    parts = rows.reshape(2, len(rows) // 2, *more)
    missing = -parts.shape[1] % BLOCKS
    padded = np.pad(parts, [(0, 0), (0, missing), *[(0, 0)] * (rows.ndim - 1)])
    each = padded.shape[1] // BLOCKS
    divided = padded.reshape(2, each, BLOCKS, *more)
    return np.moveaxis(divided, 2, 0).reshape(BLOCKS, 2 * each, *more)


def _steps(model: FittedModel) -> list[Float[np.ndarray, "block part"]]:
    """Changes of real and imaginary parts of moving poles for errors that could have been.

    They are those of each block of lines, carried through the step of Gauss-Newton: a sandwich, so
    that the errors may have any spectrum.
    """
    solution = np.linalg.pinv(model.normal, rcond=1e-12, hermitian=True)
    slopes = _blocks(np.swapaxes(model.slopes * model.weight, 1, 2))
    slopes = slopes.reshape(BLOCKS, slopes.shape[1] * slopes.shape[2], slopes.shape[3])
    return [
        np.sqrt(share) * (_blocks(errors).reshape(BLOCKS, 1, -1) @ slopes)[:, 0] @ solution
        for errors, share in replicates(model.free)
    ]


def _coefficient_steps(model: FittedModel, pole_steps):
    """Changes of the coefficients (replicate, column, output) beside those of the poles."""
    inverse = np.swapaxes(_blocks(model.fit.inverse.T), 1, 2)
    found = []
    for (errors, share), steps in zip(replicates(model.free), pole_steps, strict=True):
        own = np.sqrt(share) * inverse @ _blocks(errors)
        found.append(own - np.tensordot(steps, model.by_poles, axes=(1, 1)))
    return np.concatenate(found)


def pole_covariances(model: FittedModel) -> Float[np.ndarray, "mode 2 2"]:
    """Covariances of decay rate and angular frequency (1/s), zero for poles not refined.

    The change of a pole with fewer terms for the modes that are not in the model adds to them.
    """
    steps, moving = np.concatenate(_steps(model)), model.moving
    found = np.zeros((model.poles.size, 2, 2))
    for place, k in enumerate(moving):
        pair = [place, place + moving.size]
        own = steps[:, pair] * [-1.0, 1.0]
        found[k] = own.T @ own + np.diag(model.model_errors[pair] ** 2)
    return found


def damping_doubts(model: FittedModel) -> Float[np.ndarray, " mode"]:
    """Half the 95 % interval of each damping ratio, over the ratio."""
    found = []
    for k, (pole, covariance) in enumerate(zip(model.poles, pole_covariances(model), strict=True)):
        _, _, damping, damping_sd = frequency_and_damping(complex(pole), covariance)
        found.append(_quantile(model, k) * damping_sd / damping)
    return np.array(found)


def _quantile(model: FittedModel, k: int) -> float:
    return float(student.ppf(0.975, model.freedom(k)))


def unexplained(model: FittedModel) -> Lines:
    """Lines of the band with the errors of the model as outputs."""
    errors, level = model.fit.errors, model.lines.level
    assert level is not None
    count = len(level)
    return model.plain._replace(outputs=(errors[:count] + 1j * errors[count:]) / level[:, None])


def _stacked(found, lines: Lines, modes: int):
    """Residues above transients (mode, signal, output)."""
    return np.concatenate(split_coefficients(found, lines, modes), axis=1)


def modes_of_model(
    model: FittedModel,
    scale: Float[np.ndarray, " output"],
    bands: tuple[tuple[float, float], ...] = (),
) -> tuple[IdentifiedMode, ...]:
    """Modes of a fitted model with uncertainties; those of poles not refined have none.

    Outputs are in units of `scale`, shapes in those of the log. Shares in the energy are those of
    the first of some bands (Hz) in which a mode is, by default of all lines.
    """
    plain, lines, poles, fit = model.plain, model.lines, model.poles, model.fit
    covariances = pole_covariances(model)
    coefficients = _stacked(fit.found, lines, poles.size)
    changes = _coefficient_steps(model, _steps(model))
    changes = np.array([_stacked(one, lines, poles.size) for one in changes])
    resonances, mirrored = resonances_of(plain, poles)
    transients, mirrored_transients = transients_of(plain, poles)
    modes = []
    for k, pole in enumerate(poles):
        # Residues and transients are multiples of one shape. What they are together is known well,
        # but hardly each, if one impact at the beginning is all that excites.
        terms = resonances[:, [k]] * plain.inputs, transients[:, [k]] * plain.unforced
        signals = np.concatenate(terms, axis=1)
        response = signals @ coefficients[k]
        along = np.linalg.svd(response, full_matrices=False)[0][:, 0].conj() @ signals
        physical = (along @ coefficients[k]) * scale
        largest = int(np.argmax(np.abs(physical)))
        unit = physical / physical[largest]
        moved = (along @ changes[:, k]) * scale / physical[largest]
        moved = moved - moved[:, [largest]] * unit
        parts = np.concatenate([moved.real, moved.imag], axis=1)
        frequency, frequency_sd, damping, damping_sd = frequency_and_damping(
            complex(pole), covariances[k]
        )
        power = _power(plain, [one for one in bands if one[0] <= frequency <= one[1]])
        terms = mirrored[:, [k]] * plain.inputs, mirrored_transients[:, [k]] * plain.unforced
        part = response + np.concatenate(terms, axis=1) @ coefficients[k].conj()
        modes.append(
            IdentifiedMode(
                frequency=frequency,
                frequency_sd=frequency_sd,
                damping_ratio=damping,
                damping_sd=damping_sd,
                energy_share=float(np.mean(np.sum(np.abs(part) ** 2, axis=0) / power)),
                shape=unit,
                shape_covariance=parts.T @ parts,
                quantile=_quantile(model, k),
            )
        )
    return tuple(modes)


def _power(lines: Lines, bands):
    """Power of the outputs at all lines, or at those of the first of some bands (Hz)."""
    outputs = lines.outputs
    if bands:
        frequencies = np.angle(lines.z) / (2 * np.pi * lines.step)
        outputs = outputs[(frequencies >= bands[0][0]) & (frequencies <= bands[0][1])]
    return np.maximum(np.sum(np.abs(outputs) ** 2, axis=0), 1e-300)
