"""Modes from responses to measured forces, of a hammer or a shaker, with their uncertainties.

Poles of p-LSCF (`measured_responses`) that are stable are refined by the likelihood of a modal
model, to which poles are added where errors are more than noise. A wide band is divided into bands
of three octaves.

A pole placed at a chance peak of the noise fits it well, so that its errors say nothing against it;
but what it explains, at one of many lines, is not more than the noise makes it. A pole that is
missing leaves errors along 1 / (s - p). These are tests of F.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.signal import detrend
from scipy.stats import f as fisher, t as student

from tuning.modal.ambient import MAX_ORDER, Candidate, divided_band, overlapping, without_duplicates
from tuning.modal.forced.likelihood import (
    BLOCKS,
    NEIGHBOURS,
    FittedModel,
    LinearFit,
    both_parts,
    coefficient_places,
    fit_modal_model,
    line_means,
    linear_fit,
    replicates,
    resonances_of,
    split_coefficients,
    times_signals,
    transients_of,
)
from tuning.modal.forced.measured_responses import (
    HIGHEST_LINE,
    Lines,
    fit_common_denominator,
    products,
    transforms,
)
from tuning.modal.result import (
    MIN_COLLINEARITY,
    IdentifiedMode,
    frequency_and_damping,
    rejection_reason,
)
from tuning.modal.subspace import Diagram, Poles, stabilise

DAMPING_RATIOS = (0.004, 0.016, 0.064)  # of poles that are tried
NEAR_LINES, NEAR_WIDTHS = 32, 16.0  # about a pole that is tried: lines, and decay rates
MIN_SIZE = 1e-12  # of the largest; directions below it were left out of the fit
MOST_PROMISING = 3  # of them, whose probabilities are computed


def mode_chances(model: FittedModel) -> Float[np.ndarray, " mode"]:
    """Probability that noise explains the response of each mode, forced and free.

    Both together, as the response to an impact at the start of a record is like a free one.
    """
    outputs, found = model.fit.errors.shape[1], []
    variance = _local_variance(model.fit.errors, model.free.free)
    for k in range(model.poles.size):
        # Without its coefficients x the sum of squared errors is more by x^T (F F^T)^-1 x. After a
        # impact at the start forced and free ones are nearly one: F F^T would lose their sum.
        own = coefficient_places(model.lines, model.poles.size, k)
        directions, sizes, _ = np.linalg.svd(model.fit.inverse_factor[own], full_matrices=False)
        kept = sizes > MIN_SIZE * sizes[0]
        along = directions.T[kept] @ model.fit.found[own] / sizes[kept, None]
        gains = np.sum(along**2, axis=0)
        count = own.size * outputs
        statistic = np.sum(gains / variance[model.peak(k)]) / count
        chance = fisher.sf(statistic, count, model.freedom(k) * outputs)
        found.append(len(model.lines.z) * chance)
    return np.array(found)


def missing_pole(model: FittedModel, band: tuple[float, float]) -> tuple[complex, float]:
    """The pole (1/s) that would lower the errors most, and the probability that noise does so."""
    tried = promising_poles(model.lines, model.fit.errors, band)
    best = tried[:MOST_PROMISING]
    chances = [_chance(model, pole) for pole in best]
    least = int(np.argmin(chances))
    return best[least], len(tried) * chances[least]


def promising_poles(
    lines: Lines, errors: Float[np.ndarray, "row output"], band: tuple[float, float]
) -> list[complex]:
    """Poles (1/s) in a band (Hz), those first that seem to explain most of the errors.

    They are of several damping ratios, a half-power bandwidth apart.
    """
    low, high = 2 * np.pi * band[0], 2 * np.pi * band[1]
    tried = [
        -ratio * angular + 1j * angular
        for ratio in DAMPING_RATIOS
        for angular in np.geomspace(low, high, int(np.log(high / low) / (2 * ratio)) + 2).tolist()
    ]
    # Without the terms of the model in them, columns explain less than they could: a first choice.
    least = _least_statistics(lines, errors, tried)
    return [tried[k] for k in np.argsort(-least, kind="stable")]


def _least_statistics(lines: Lines, errors, tried) -> Float[np.ndarray, " tried"]:
    """Reduction of the errors by a pole 1 / (s - p), over their variance, the model unchanged."""
    angular = np.angle(lines.z) / lines.step
    variance = line_means(errors**2, NEIGHBOURS)
    errors = errors.reshape(2, len(lines.z), -1)
    reach = NEAR_LINES * lines.spacing
    found = []
    for pole in tried:
        near = np.abs(angular - pole.imag) < reach + NEAR_WIDTHS * abs(pole.real)
        columns = _columns_of(lines.part(near), pole)
        along = np.linalg.qr(columns)[0].T @ errors[:, near].reshape(len(columns), -1)
        own = variance[np.argmin(np.abs(angular - pole.imag))]
        found.append(np.sum(np.sum(along**2, axis=0) / np.maximum(own, 1e-300)))
    return np.array(found)


def _columns_of(lines: Lines, pole):
    """Columns (row, column) of 1 / (s - p), forced and free."""
    parts = []
    for signals, (first, second) in (
        (lines.inputs, resonances_of(lines, np.array([pole]))),
        (lines.unforced, transients_of(lines, np.array([pole]))),
    ):
        parts += [times_signals(first + second, signals)]
        parts += [times_signals(1j * (first - second), signals)]
    return both_parts(np.concatenate(parts, axis=1))


def _chance(model: FittedModel, pole: complex) -> float:
    """Probability that a pole 1 / (s - p) reduces the errors as much by noise alone."""
    fit, columns = model.fit, _columns_of(model.lines, pole)
    basis = np.linalg.qr(columns - fit.basis @ (fit.basis.T @ columns))[0]
    along = basis.T @ fit.errors
    variance = _without(model, basis, along, model.peak_at(pole))
    statistic = np.sum(np.sum(along**2, axis=0) / variance) / along.size
    freedom = max(model.freedom_at(pole) - basis.shape[1], 1.0) * fit.errors.shape[1]
    return float(fisher.sf(statistic, along.size, freedom))


def _without(model: FittedModel, basis, along, peak):
    """Variance of each output about a line, without the errors along a basis."""
    count = len(model.lines.z)
    lines = np.arange(max(peak - NEIGHBOURS, 0), min(peak + NEIGHBOURS + 1, count))
    rows = np.concatenate([lines, count + lines])
    errors = model.fit.errors[rows] - basis[rows] @ along
    free = model.free.free[rows] - np.sum(basis[rows] ** 2, axis=1)[:, None]
    return np.sum(errors**2, axis=0) / np.maximum(np.sum(free, axis=0), 1e-3 * rows.size)


def criterion(fit: LinearFit, modes: int) -> float:
    """Bayesian information criterion (Schwarz 1978) of a fit to lines with errors of one level.

    It is less for the better model.
    """
    (rows, columns), squares = fit.columns.shape, np.sum(fit.errors**2, axis=0)
    parameters = squares.size * columns + 2 * modes
    size = np.sum(np.log(np.maximum(squares / rows, 1e-300)))
    return float(rows * size + parameters * np.log(rows))


def _local_variance(errors, free):
    """Variance of a real or imaginary part at each line (line, output), by its neighbours."""
    power, freedom = (line_means(one, NEIGHBOURS) for one in (errors**2, free))
    return power / np.maximum(freedom, 1e-3)


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
