"""Modes from responses to measured forces, of a hammer or a shaker.

Poles of p-LSCF (`measured_responses`) that are stable are refined by the likelihood of a modal
model, to which poles are added where errors are more than noise. A wide band is divided into bands
of three octaves.

Modal model of responses to measured forces: modes with their uncertainties.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.signal import detrend
from scipy.stats import t as student

from tuning.modal.ambient import (
    MAX_ORDER,
    Candidate,
    divided_band,
    overlapping,
    without_duplicates,
)
from tuning.modal.forced.likelihood import (
    BLOCKS,
    FittedModel,
    fit_modal_model,
    linear_fit,
    replicates,
    resonances_of,
    split_coefficients,
    transients_of,
)
from tuning.modal.forced.measured_responses import (
    HIGHEST_LINE,
    Lines,
    fit_common_denominator,
    products,
    transforms,
)
from tuning.modal.forced.significance import (
    criterion,
    missing_pole,
    mode_chances,
)
from tuning.modal.result import (
    MIN_COLLINEARITY,
    IdentifiedMode,
    frequency_and_damping,
    rejection_reason,
)
from tuning.modal.stabilisation import Diagram, stabilise
from tuning.modal.subspace import Poles


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
    """Changes of real and imaginary parts of moving poles for replicates of the errors.

    Errors of each block of lines are carried through the step of Gauss-Newton: a sandwich estimate,
    so that the errors may have any spectrum.
    """
    solution = np.linalg.pinv(model.normal, rcond=1e-12, hermitian=True)
    slopes = _blocks(np.swapaxes(model.slopes * model.weight, 1, 2))
    slopes = slopes.reshape(BLOCKS, slopes.shape[1] * slopes.shape[2], slopes.shape[3])
    return [
        np.sqrt(weight) * (_blocks(errors).reshape(BLOCKS, 1, -1) @ slopes)[:, 0] @ solution
        for errors, weight in replicates(model.free)
    ]


def _coefficient_steps(model: FittedModel, pole_steps):
    """Changes of the coefficients (replicate, column, output) with those of the poles."""
    inverse = np.swapaxes(_blocks(model.fit.inverse.T), 1, 2)
    found = []
    for (errors, weight), steps in zip(replicates(model.free), pole_steps, strict=True):
        own = np.sqrt(weight) * inverse @ _blocks(errors)
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
    model: FittedModel, scale: Float[np.ndarray, " output"]
) -> tuple[IdentifiedMode, ...]:
    """Modes of a fitted model with uncertainties; those of poles not refined have none.

    Outputs are in units of `scale`, shapes in those of the log. Fractions of the energy are those
    of all lines.
    """
    plain, lines, poles, fit = model.plain, model.lines, model.poles, model.fit
    covariances = pole_covariances(model)
    coefficients = _stacked(fit.found, lines, poles.size)
    changes = _coefficient_steps(model, _steps(model))
    changes = np.array([_stacked(one, lines, poles.size) for one in changes])
    power = np.maximum(np.sum(np.abs(plain.outputs) ** 2, axis=0), 1e-300)
    resonances, mirrored = resonances_of(plain, poles)
    transients, mirrored_transients = transients_of(plain, poles)
    modes = []
    for k, pole in enumerate(poles):
        # Residues and transients are multiples of one shape. Their sum is determined well, but
        # hardly each of them, if one impact at the beginning is the only excitation.
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


MAX_ADDED = 12  # poles, one at a time
WEIGHT_DEGREE = 0.5  # degree of the denominator that weights lines, over the highest
MIN_WEIGHT = 1e-3  # size of the denominator, over its median, below which weights are equal
CHANCE = 1e-3  # probability below which noise is no explanation
SAME_POLE = 0.5  # distance of two poles over the smaller decay rate, below which they are one
# variance of a shape, over its squares, beyond which it may be complex by chance
MAX_SHAPE_ERRORS = 0.1


class ForcedModes(NamedTuple):
    """Candidate modes, stabilisation diagrams, and the fraction of the responses explained."""

    candidates: tuple[Candidate, ...]
    diagrams: tuple[Diagram, ...]
    explained: float


def forced_modes(
    records: tuple[Float[np.ndarray, "_ channel"], ...],
    forces: tuple[Float[np.ndarray, "_ force"], ...],
    rate: float,
    band: tuple[float, float],
    *,
    order: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> ForcedModes:
    """Modes of a band (Hz) from records and the forces measured with them.

    Raises ValueError if a force is zero throughout.
    """
    duration = sum(map(len, records)) / rate
    records, forces = (tuple(detrend(r, axis=0) for r in some) for some in (records, forces))
    found: list[Candidate] = []
    diagrams, rest, whole = [], 0.0, 0.0
    for low, high in divided_band(band):
        if progress:
            progress(f"modes from {low:.3g} Hz to {high:.4g} Hz")
        part = overlapping((low, high), band)
        lines = transforms(records, forces, rate, (part[0] / 2, HIGHEST_LINE * part[1]))
        scale, force_scale = (
            np.sqrt(np.mean(np.abs(one) ** 2, axis=0)) for one in (lines.outputs, lines.inputs)
        )
        if not np.all(force_scale > 0):
            raise ValueError("a measured force is zero throughout; leave it out")
        scale = np.where(scale > 0, scale, 1.0)
        lines = lines._replace(outputs=lines.outputs / scale, inputs=lines.inputs / force_scale)
        candidates, diagram, powers = _modes_of_lines(
            lines, scale, part, band, duration, order, _poles(found)
        )
        found += candidates
        diagrams.append(diagram)
        rest, whole = rest + powers[0], whole + powers[1]
    return ForcedModes(without_duplicates(found), tuple(diagrams), 1 - rest / max(whole, 1e-300))


def _poles(found):
    """Poles of candidates that are well identified."""
    return np.array([one.mode.pole for one in found if not one.reason], complex)


def _modes_of_lines(lines: Lines, scale, part, band, duration, order, known):
    """Candidates and diagram of a part of a band, and the powers of errors and responses.

    Poles `known` from other parts of the band have flanks in this one.
    """
    diagram = _diagram(lines, scale, part, order)
    model, dropped = refined_model(lines, _distinct(known, diagram), scale, part)
    model = completed(lines, model, scale, part)
    rest = unexplained(model)
    modes = [mode for mode in modes_of_model(model, scale) if part[0] <= mode.frequency <= part[1]]
    candidates = [Candidate(mode, mode_reason(mode, duration, band), 1) for mode in modes]
    candidates += [
        Candidate(mode, mode_reason(mode, duration, band) or reason, 1)
        for mode, reason in dropped
        if part[0] <= mode.frequency <= part[1]
    ]
    return (
        candidates,
        diagram,
        (np.sum(np.abs(rest.outputs) ** 2), np.sum(np.abs(model.plain.outputs) ** 2)),
    )


def mode_reason(mode: IdentifiedMode, duration, band) -> str:
    """Reason for rejecting a mode, or ""; a shape must be complex beyond its errors to count.

    Of a close pair that one force excites alike, the sum of the shapes is determined, hardly each.
    """
    errors = np.trace(mode.shape_covariance) / np.sum(np.abs(mode.shape) ** 2)
    least = MIN_COLLINEARITY if errors < MAX_SHAPE_ERRORS else 0.0
    return rejection_reason(mode, duration, band, least)


def _diagram(lines: Lines, scale, part, order) -> Diagram:
    """Stabilisation diagram of common denominators of rising degree."""
    highest = min(order or MAX_ORDER, len(lines.z) // (4 * lines.inputs.shape[1] + 4))
    degrees = range(2, max(highest, 3) + 1)
    first = fit_common_denominator(
        products(lines, degrees[-1]), max(int(WEIGHT_DEGREE * degrees[-1]), 2)
    )
    size = np.abs(np.polyval(first.denominator[::-1], lines.z))
    weights = 1 / np.maximum(size, MIN_WEIGHT * np.median(size))
    system = products(lines, degrees[-1], weights / weights.max())
    fits = [fit_common_denominator(system, degree) for degree in degrees]
    sizes = [fit.poles.size for fit in fits]
    poles = Poles(
        np.repeat(np.array(degrees), sizes),
        np.concatenate([fit.poles for fit in fits]),
        np.concatenate([fit.shapes for fit in fits]) * scale,
        np.zeros(sum(sizes)),
    )
    # Modes outside the band have flanks in it.
    return stabilise(poles, (part[0] / 4, 0.5 / lines.step))


def refined_model(lines, poles, scale, part):
    """Modal model of the poles that the lines determine, and the other modes with reasons.

    Two poles for one resonance, or one for none, make others uncertain, so that one goes at a time.
    """
    dropped = []
    while True:
        model = fit_modal_model(lines, poles, part)
        doubts, chances, reason = damping_doubts(model), mode_chances(model), ""
        if np.any(doubts >= 1):
            worst = int(np.argmax(doubts))
        elif np.any(chances > CHANCE):
            worst = int(np.argmax(chances))
            reason = "no response beyond what noise explains"
        else:
            return model, dropped
        dropped.append((modes_of_model(model, scale)[worst], reason))
        poles = np.delete(model.poles, worst)


def completed(lines, model, scale, part):
    """Model with poles added where errors are more than noise, if that is the better one."""
    tried: list[complex] = []
    for _ in range(MAX_ADDED):
        missing, chance = missing_pole(model, part)
        apart = all(abs(missing - one) > SAME_POLE * -one.real for one in tried)
        if chance >= CHANCE or not apart:
            break
        tried.append(missing)
        other, _ = refined_model(lines, np.append(model.poles, missing), scale, part)
        fit = linear_fit(model.lines, other.poles)
        if criterion(fit, other.poles.size) < criterion(model.fit, model.poles.size):
            model = other
    return model


def _distinct(known, diagram: Diagram) -> Complex[np.ndarray, " mode"]:
    """The `known` poles, and those of the chains of a diagram that differ, longer chains first."""
    kept = [complex(pole) for pole in known]
    for chain in sorted(diagram.chains, key=lambda chain: -chain.members.size):
        pole = complex(diagram.poles.poles[chain.best])
        if all(abs(pole - one) > SAME_POLE * min(-pole.real, -one.real) for one in kept):
            kept.append(pole)
    return np.array(sorted(kept, key=abs), complex)
