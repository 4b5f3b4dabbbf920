"""Modal model of responses to measured forces, refined by maximum likelihood.

Responses Y = sum_r R_r U / (i w - p_r) + x_r / (z - z_r) + conjugates + rest are linear in the
residues R_r and the transients x_r of the samples, z_r = exp(p_r T). Their errors are minimised
over the poles p_r by Gauss-Newton steps with the residues eliminated: the likelihood of output
errors of one variance for each output (El-Kafafy, De Troyer, Peeters and Guillaume 2013). Shapes
are the residues by least squares (LSFD), of rank one: shape times participation.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.stats import t as student

from tuning.modal.result import IdentifiedMode, frequency_and_damping
from tuning.modal.spectral.forced_fraction import Lines

BLOCKS = 48  # of lines, every 48th in one, whose errors tell the uncertainty
REST_POWERS = (-2, -1, 0, 1, 2)  # of z, for modes outside of the band and those not found
FEWER_REST_POWERS = (0, 1)  # with which poles are compared
STEPS = 12
MAX_STEP = 0.5  # of a pole, over its decay rate
CONVERGED = 1e-6  # step over the decay rate
MAX_SHIFT = 3.0  # from the start, over the decay rate; beyond, a pole is none of the data


class ForcedModel(NamedTuple):
    """Modes, one for each pole at the start, and what they leave: lines of the band with errors.

    `power` is that of the responses in the band.
    """

    modes: tuple[IdentifiedMode, ...]
    rest: Lines
    power: float


def refine_modal_model(
    lines: Lines,
    starts: Complex[np.ndarray, " mode"],
    scale: Float[np.ndarray, " output"],
    band: tuple[float, float],
) -> ForcedModel:
    """Modal model at the lines within a band (Hz), from poles (1/s) to start from.

    Only poles in the band are refined. Outputs are in units of `scale`, shapes in those of the log.
    Uncertainties are those of the errors of each block of lines, carried through the step of
    Gauss-Newton (a sandwich, so that the errors may have any spectrum); the change of a pole with
    fewer terms for the modes that are not in the model adds to them.
    """
    frequencies = np.angle(lines.z) / (2 * np.pi * lines.step)
    inside = (frequencies >= band[0]) & (frequencies <= band[1])
    lines = lines._replace(
        outputs=lines.outputs[inside], inputs=lines.inputs[inside], z=lines.z[inside],
        record=lines.record[inside],
    )  # fmt: skip
    target = np.concatenate([lines.outputs.real, lines.outputs.imag])
    natural = np.abs(starts) / (2 * np.pi)
    moving = np.flatnonzero((natural >= band[0]) & (natural <= band[1]))
    poles = _refined(lines, target, starts, moving)
    others = _refined(lines, target, poles, moving, FEWER_REST_POWERS)[moving]
    model_errors = np.concatenate([(others - poles[moving]).real, (others - poles[moving]).imag])
    fit = _linear_fit(lines, target, poles)
    slopes, by_poles = _slopes(lines, fit, poles, moving)
    blocks = np.tile(np.arange(len(lines.z)) % BLOCKS, 2)
    weight, normal = _normal(slopes, fit.errors)
    unknowns = 2 * moving.size / fit.errors.shape[1] + len(fit.found)
    scatter = np.sqrt(len(target) / max(len(target) - unknowns, 1.0))
    pole_steps, coefficient_steps = [], []
    for block in range(BLOCKS):
        rows = np.flatnonzero(blocks == block)
        errors = scatter * fit.errors[rows]
        right = np.einsum("rko,ro,o->k", slopes[rows], errors, weight, optimize=True)
        step = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
        pole_steps.append(step)
        coefficient_steps.append(
            fit.inverse[:, rows] @ errors - np.einsum("cko,k->co", by_poles, step)
        )
    steps = np.array(pole_steps), np.array(coefficient_steps)
    return _model(lines, target, poles, moving, fit, steps, model_errors, scale)


def _normal(slopes, errors):
    """Weights of the outputs, and the matrix of the normal equations of the poles."""
    weight = 1 / np.maximum(np.mean(errors**2, axis=0), 1e-300)
    return weight, np.einsum("rko,rlo,o->kl", slopes, slopes, weight, optimize=True)


class _LinearFit(NamedTuple):
    """Columns of the linear least squares, their pseudo-inverse, coefficients and errors."""

    columns: Float[np.ndarray, "row column"]
    inverse: Float[np.ndarray, "column row"]
    found: Float[np.ndarray, "column output"]
    errors: Float[np.ndarray, "row output"]


def _refined(lines, target, starts, moving, powers=REST_POWERS):
    """Poles after Gauss-Newton steps; those that leave their surroundings return to the start."""
    poles = starts.astype(complex)
    for _ in range(STEPS):
        fit = _linear_fit(lines, target, poles, powers)
        slopes, _ = _slopes(lines, fit, poles, moving)
        weight, normal = _normal(slopes, fit.errors)
        right = np.einsum("rko,ro,o->k", slopes, fit.errors, weight, optimize=True)
        step = np.linalg.lstsq(normal, right, rcond=1e-12)[0]
        change = step[: moving.size] + 1j * step[moving.size :]
        limit = MAX_STEP * np.abs(poles[moving].real)
        change *= np.minimum(1, limit / np.maximum(np.abs(change), 1e-300))
        poles[moving] += change
        far = np.abs(poles - starts) > MAX_SHIFT * np.abs(starts.real)
        lost = far | (poles.real >= 0)
        poles[lost] = starts[lost]
        if np.all(np.abs(change) < CONVERGED * np.abs(poles[moving].real)):
            break
    return poles


def _linear_fit(lines, target, poles, powers=REST_POWERS) -> _LinearFit:
    columns = _columns(lines, poles, powers)
    inverse = np.linalg.pinv(columns)
    found = inverse @ target
    return _LinearFit(columns, inverse, found, target - columns @ found)


def _columns(lines: Lines, poles, powers):
    """Real parts above imaginary parts of the columns: residues, transients, rest."""
    columns = []
    for signals, first, second in (
        (lines.inputs, *_resonances(lines, poles)),
        (lines.unforced, *_transients(lines, poles)),
    ):
        columns += [_times(first + second, signals), _times(1j * (first - second), signals)]
    rest = lines.z[:, None] ** np.array(powers)
    signals = np.concatenate([lines.inputs, lines.unforced], axis=1)
    columns = np.concatenate([*columns, _times(rest, signals)], axis=1)
    return np.concatenate([columns.real, columns.imag])


def _resonances(lines: Lines, poles):
    """1 / (i w - p) and the same of the conjugate poles (line, mode)."""
    s = 1j * np.angle(lines.z)[:, None] / lines.step
    return 1 / (s - poles), 1 / (s - poles.conj())


def _transients(lines: Lines, poles):
    """1 / (z - exp(p T)) and the same of the conjugate poles (line, mode)."""
    roots = np.exp(poles * lines.step)
    return 1 / (lines.z[:, None] - roots), 1 / (lines.z[:, None] - roots.conj())


def _times(terms, signals):
    """Columns (line, mode and signal)."""
    return (terms[:, :, None] * signals[:, None, :]).reshape(len(terms), -1)


def _coefficients(found, lines: Lines, modes: int):
    """Complex residues (mode, input, output) and transients (mode, record, output)."""
    parts, first = [], 0
    for signals in (lines.inputs.shape[1], lines.unforced.shape[1]):
        half = modes * signals
        both = found[first : first + half] + 1j * found[first + half : first + 2 * half]
        parts.append(both.reshape(modes, signals, -1))
        first += 2 * half
    return parts


def _slopes(lines: Lines, fit: _LinearFit, poles, moving):
    """Derivatives by real and imaginary parts of moving poles: of the responses, and residues.

    Those of the responses (row, part, output) are with residues eliminated; those of the
    coefficients (column, part, output) are by which they are so.
    """
    residues, transients = _coefficients(fit.found, lines, poles.size)
    own, other = _resonances(lines, poles[moving])
    first = _along(own**2, lines.inputs, residues[moving])
    second = _along(other**2, lines.inputs, residues[moving].conj())
    own, other = _transients(lines, poles[moving])
    factor = lines.step * np.exp(poles[moving] * lines.step)
    first += _along(factor * own**2, lines.unforced, transients[moving])
    second += _along(factor.conj() * other**2, lines.unforced, transients[moving].conj())
    both = np.concatenate([first + second, 1j * (first - second)])  # part, line, output
    rows = np.concatenate([both.real, both.imag], axis=1).transpose(1, 0, 2)
    flat = rows.reshape(len(rows), -1)
    by_poles = fit.inverse @ flat
    projected = (flat - fit.columns @ by_poles).reshape(rows.shape)
    return projected, by_poles.reshape(len(by_poles), *rows.shape[1:])


def _along(terms, signals, coefficients):
    """Terms (line, mode) times the signals with their coefficients: (mode, line, output)."""
    return terms.T[:, :, None] * np.einsum("ls,mso->mlo", signals, coefficients)


def _model(
    lines, target, poles, moving, fit: _LinearFit, steps, model_errors, scale
) -> ForcedModel:
    """Modes with uncertainties; those of poles that were not refined have none."""
    pole_steps, coefficient_steps = steps
    residues = _coefficients(fit.found, lines, poles.size)[0]
    changes = np.array([_coefficients(one, lines, poles.size)[0] for one in coefficient_steps])
    resonances, mirrored = _resonances(lines, poles)
    power = np.maximum(np.sum(target**2, axis=0), 1e-300)
    quantile = float(student.ppf(0.975, BLOCKS - 1))
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
        part = resonances[:, [k]] * (lines.inputs @ residues[k])
        part = part + mirrored[:, [k]] * (lines.inputs @ residues[k].conj())
        modes.append(
            IdentifiedMode(
                frequency=frequency,
                frequency_sd=frequency_sd,
                damping_ratio=damping,
                damping_sd=damping_sd,
                energy_share=float(np.mean(np.sum(np.abs(part) ** 2, axis=0) / power)),
                shape=unit,
                shape_covariance=parts.T @ parts,
                quantile=quantile,
            )
        )
    errors = fit.errors[: len(lines.z)] + 1j * fit.errors[len(lines.z) :]
    return ForcedModel(tuple(modes), lines._replace(outputs=errors), float(np.sum(target**2)))
