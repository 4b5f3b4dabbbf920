"""Modes from the response to blows that nobody measured, of whole records.

Decays between blows are as long as the shortest of them, nearly, when they are fitted side by side;
slow modes have then hardly begun to fade. Here the record is one: unit impulses stand at the
instants of the blows (`instants`), and the residues are amplitudes of each mode after each blow,
so that a vibration that lasts through the next blow counts as long as it lasts.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.signal import detrend

from tuning.modal.ambient import divided_band
from tuning.modal.decay.poles import NEARBY_BINS, NONLINEARITY_SHARE
from tuning.modal.forced.common_denominator import Lines
from tuning.modal.forced.likelihood import (
    FEWER_REST_POWERS,
    REST_POWERS,
    FittedModel,
    linear_fit,
    refined_poles,
)
from tuning.modal.forced.modal_model import modes_of_model, unexplained
from tuning.modal.forced.modes import mode_reason, refined_model
from tuning.modal.forced.significance import criterion, criterion_with, promising_poles
from tuning.modal.result import IdentifiedMode
from tuning.modal.shapes import mac_matrix
from tuning.modal.struck.beginnings import (
    StruckRecords,
    energy_along,
    from_early_blows,
    from_rests,
)
from tuning.modal.struck.instants import (
    MAX_BLOWS,
    WORK,
    Blow,
    Response,
    after_blows,
    poles_within,
    response_in_band,
    with_missed_blows,
    work,
)

MIN_BLOWS = 2
MAX_ADDED = 16  # poles, one at a time
TRIED = 6  # for each of them
TRIAL_STEPS = 6  # in which it is refined, before it is compared
MIN_DECAY = 0.2  # nepers, over the whole record, of a mode
SAME_POLE = 0.1  # distance of two poles over the smaller decay rate, below which they are one
MEDIAN_LINES = 30  # on either side of a line, whose errors tell its level
SWING_PARTS = 20  # of a record, whose errors are compared
SAME_MAC = 0.9
WEAK = 0.05  # share of a mode in the energy
MAX_ENERGY = 3.0  # of a mode, over that of the log; poles that cancel each other have more


class Search(NamedTuple):
    """How blows are sought from poles, and what must be true of the errors that are left.

    `powers` of z stand for other modes: of few poles many terms cost more than what a blow tells.
    With `rounds` blows are sought again beside poles that were added. The `swing` of the errors is
    less than given, and its product with their share of the energy less than `most`.
    """

    powers: tuple[int, ...]
    rounds: bool
    most: float
    swing: float


# Of poles of decays, which are nearly all: more rounds explain forces of crossing loads, too.
AFTER_BLOWS = Search(REST_POWERS, False, 0.4, np.inf)
# The same of blows that are not seen: the swing is 1.4 at most in twenty planted logs, 1.8 at least
# in five of crossing loads whose forces blows explain.
AFTER_UNSEEN_BLOWS = AFTER_BLOWS._replace(swing=1.5)
# Of poles of ambient vibration. Of a minute with three modes and six blows, from two poles, five
# blows are found so, else two.
FROM_AMBIENT = Search(FEWER_REST_POWERS, True, 0.2, np.inf)


class StruckModes(NamedTuple):
    """Modes well identified, blows in samples of their records, and the band (Hz) used."""

    modes: tuple[IdentifiedMode, ...]
    blows: tuple[Blow, ...]
    band: tuple[float, float]


def struck_modes(
    records: tuple[Float[np.ndarray, "_ channel"], ...],
    rate: float,
    band: tuple[float, float],
    blows: tuple[Blow, ...],
    poles: Complex[np.ndarray, " pole"],
    search: Search = AFTER_BLOWS,
) -> StruckModes | None:
    """Modes of a band (Hz), from known blows and poles (1/s), to which others are added.

    None if less than two blows are found, or if blows are not all that excites: then the modes
    leave much unexplained, or more in some parts of a record than in others. The band is narrower
    if the least squares would be too large.
    """
    if len(blows) > MAX_BLOWS:
        return None
    whole = tuple(np.asarray(detrend(record, axis=0)) for record in records)
    struck = StruckRecords(whole, (0,) * len(whole), blows)
    most_poles = poles.size
    while True:
        known = len(struck.blows)
        band = _affordable(struck.records, rate, band, poles, known)
        poles = poles_within(poles, band)
        if not poles.size:
            return None
        response = response_in_band(struck.records, rate, band)
        found = with_missed_blows(response, struck.blows, poles, search.powers)
        struck = struck._replace(blows=found)
        struck = from_early_blows(struck)
        response = response_in_band(struck.records, rate, band)
        lines = after_blows(response, struck.blows)
        poles = _completed(lines, poles, band, response.duration)
        more = len(struck.blows)
        # More poles tell of more blows, but in a narrower band some would be lost again.
        same = _affordable(struck.records, rate, band, poles, more) == band
        if more > known or (search.rounds and poles.size > most_poles and same):
            most_poles = max(most_poles, poles.size)
            continue
        begins = struck.begins
        struck = from_rests(struck, response, _errors(lines, poles, band))
        if struck.begins == begins:
            break
    if len(struck.every_blow()) < MIN_BLOWS:
        return None
    model, _ = refined_model(lines, poles, response.scale, band)
    if not _explains(model, response, search):
        return None
    modes = tuple(
        mode
        for mode in modes_of_model(model, response.scale, divided_band(band))
        if not mode_reason(mode, response.duration, band) and mode.energy_share < MAX_ENERGY
    )
    return StruckModes(modes, struck.every_blow(), band)


def alike(a: IdentifiedMode, b: IdentifiedMode) -> bool:
    """Whether a mode is closer to another than their half-power bandwidths, and of its shape.

    Frequency and damping of a real structure depend on amplitude, so that errors alone do not tell;
    the shape of a weak mode is not known well enough to differ.
    """
    widths = sum(max(one.damping_ratio, 0.0) * one.frequency for one in (a, b))
    errors = a.quantile * a.frequency_sd + b.quantile * b.frequency_sd
    near = abs(a.frequency - b.frequency) < max(widths, errors)
    same = mac_matrix(a.shape[None], b.shape[None])[0, 0] > SAME_MAC
    return bool(near and (same or a.energy_share < WEAK))


def _affordable(records, rate, band, poles, blows) -> tuple[float, float]:
    """The band (Hz), or as much of its lower part as WORK allows, with room for two more blows."""
    (low, high), duration = band, sum(map(len, records)) / rate
    while high > low:
        modes = poles_within(poles, (low, high)).size
        if work(duration, (low, high), modes, blows + 2) < WORK:
            break
        high *= 0.9
    return low, max(high, low)


def _explains(model: FittedModel, response: Response, search: Search) -> bool:
    """Whether modes and blows explain nearly all, and as much in all parts of the records."""
    rest = unexplained(model)
    whole = np.sum(np.abs(model.plain.outputs) ** 2)
    share = np.sum(np.abs(rest.outputs) ** 2) / max(whole, 1e-300)
    swings = [
        _swing(rest, number, length, response.rate)
        for number, length in enumerate(response.lengths)
    ]
    return bool(share * max(swings) < search.most and max(swings) < search.swing)


def _swing(rest: Lines, number: int, length: int, rate: float) -> float:
    """Energy of the errors in the louder parts of a record over that in the quieter ones.

    It is one for noise that goes on as it is, and large if something else than blows excites.
    """
    energy = energy_along(rest, number, length, rate)
    parts = [part.mean() for part in np.array_split(energy, SWING_PARTS)]
    low, high = np.quantile(parts, [0.25, 0.75])
    return float(high / max(low, 1e-300))


def _errors(lines: Lines, poles, band) -> Lines:
    """Lines in a band (Hz) with errors in place of outputs, of one level and unit size."""
    own = _levelled(_inside(lines, band), poles)
    errors = linear_fit(own, poles).errors
    errors = errors / np.sqrt(np.maximum(np.mean(errors**2, axis=0), 1e-300))
    return own._replace(outputs=errors[: len(own.z)] + 1j * errors[len(own.z) :])


def _completed(lines: Lines, poles, band, duration):
    """Poles with those that the criterion asks for, one after another."""
    inside = _inside(lines, band)
    for _ in range(MAX_ADDED):
        own = _levelled(inside, poles)
        poles = refined_poles(own, poles, np.arange(poles.size))
        fit = linear_fit(own, poles)
        tried = _distinct(promising_poles(own, fit.errors, band))
        sizes = [criterion_with(own, fit, poles.size, pole) for pole in tried]
        more = np.append(poles, tried[int(np.argmin(sizes))])
        more = refined_poles(own, more, np.array([poles.size]), steps=TRIAL_STEPS)
        least = criterion(fit, poles.size)
        better = criterion(linear_fit(own, more), more.size) < least
        if not better or not _may_be_mode(more[-1], poles, band, duration):
            break
        poles = more
    return poles


def _distinct(poles: list[complex]) -> list[complex]:
    """The first poles of a list that differ by more than their half-power bandwidths."""
    kept: list[complex] = []
    for pole in poles:
        if all(abs(pole.imag - one.imag) > 2 * max(-pole.real, -one.real) for one in kept):
            kept.append(pole)
        if len(kept) == TRIED:
            break
    return kept


def _may_be_mode(pole: complex, others, band, duration) -> bool:
    """Whether a pole decays, is in the band (Hz) and is none of the others."""
    decays = -pole.real * duration > MIN_DECAY
    within = band[0] < abs(pole) / (2 * np.pi) < band[1]
    apart = np.abs(pole - others) > SAME_POLE * np.minimum(-pole.real, -others.real)
    return bool(decays and within and apart.all())


def _inside(lines: Lines, band) -> Lines:
    frequencies = np.angle(lines.z) / (2 * np.pi * lines.step)
    return lines.part((frequencies >= band[0]) & (frequencies <= band[1]))


def _levelled(lines: Lines, poles) -> Lines:
    """Lines of one level of errors: noise, and what no linear structure explains of strong modes.

    The level of noise is a median, so that modes not yet found stand out.
    """
    errors = linear_fit(lines, poles).errors
    errors = np.sum(errors.reshape(2, len(lines.z), -1) ** 2, axis=0)
    size = np.maximum(np.mean(errors, axis=0), 1e-300)
    nearby = uniform_filter1d(np.abs(lines.outputs) ** 2, 2 * NEARBY_BINS + 1, axis=0)
    power = median_filter(np.mean(errors / size, axis=1), 2 * MEDIAN_LINES + 1, mode="reflect")
    power = power + NONLINEARITY_SHARE**2 * np.mean(nearby / size, axis=1)
    level = 1 / np.sqrt(np.maximum(power, 1e-12))
    return lines._replace(
        outputs=lines.outputs * level[:, None], inputs=lines.inputs * level[:, None], level=level
    )
