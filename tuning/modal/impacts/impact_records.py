"""Instants of impacts that nobody measured: those that errors tell, and those that a model misses.

A vibration of known poles is free but at impacts, each of which adds to it what no force sensor has
measured: amplitudes of each mode in each channel. As responses to unit impulses these are linear in
unknown residues, so that what a further impact would explain of the errors is known at all samples
at once: the errors filtered by the responses of the modes, run backwards. One impact after another
is added, that of most gain, as long as the Bayesian information criterion falls.

Records that begin at an impact: a structure at rest before its first impact tells nothing of it.

What vibrates from the start of a record on and what an early impact leaves are hardly told from
each other. An impact that no search has found is seen in the errors: no vibration fits rest before
it.

Modes from the response to impacts that nobody measured, of whole records.

Decays between impacts are as long as the shortest of them, nearly, when they are fitted side by
side; slow modes have then hardly begun to fade. Here the record is one: unit impulses stand at the
instants of the impacts (`instants`), and the residues are amplitudes of each mode after each
impact, so that a vibration that lasts through the next impact counts as long as it lasts.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int
from scipy.ndimage import median_filter, uniform_filter1d
from scipy.signal import detrend

from tuning.modal.ambient import divided_band
from tuning.modal.decay.poles import NEARBY_BINS, NONLINEARITY_SHARE
from tuning.modal.forced.likelihood import (
    FEWER_REST_POWERS,
    REST_POWERS,
    REST_TERMS,
    FittedModel,
    LinearFit,
    linear_fit,
    refined_poles,
    resonances_of,
    whitened,
)
from tuning.modal.forced.measured_responses import HIGHEST_LINE, Lines, transforms
from tuning.modal.forced.modes import mode_reason, modes_of_model, refined_model, unexplained
from tuning.modal.forced.significance import criterion, criterion_with, promising_poles
from tuning.modal.result import SAME_MAC, IdentifiedMode, mac_matrix

MAX_CONTACT = 40  # samples that an impact marks; more are a lasting excitation
APART_CYCLES = 2.0  # of the lowest frequency, by which a missed impact is away from all others
MAX_IMPACTS = 16  # whose residues are worth their time; of more, decays tell enough
ROWS_OVER_COLUMNS = 2  # of the least squares
WORK = 5e7  # rows times squared columns of them, which takes seconds in all
PLACES_OVER_BINS = 8  # of instants that are tried


class Impact(NamedTuple):
    """Record, and the sample in it, at which the structure was hit."""

    record: int
    sample: int


def marked_impacts(
    impacted: tuple[Bool[np.ndarray, " time"], ...], rate: float, band: tuple[float, float]
) -> tuple[Impact, ...]:
    """Impacts amid marked samples of records at a `rate` (Hz), for a band (Hz)."""
    found: list[Impact] = []
    for record, marks in enumerate(impacted):
        places = np.flatnonzero(marks)
        if not places.size:
            continue
        for group in np.split(places, np.flatnonzero(np.diff(places) > MAX_CONTACT / 2) + 1):
            impact = Impact(record, int(group[0] + group[-1]) // 2)
            rebound = (
                found
                and impact.record == found[-1].record
                and (impact.sample - found[-1].sample <= _apart(rate, band))
            )
            if group[-1] - group[0] < MAX_CONTACT and not rebound:
                found.append(impact)
    return tuple(found)


def _apart(rate, band) -> int:
    """Samples by which impacts must be apart, to be told from each other."""
    return int(APART_CYCLES * rate / band[0]) + 1


class Response(NamedTuple):
    """Lines of records about a band (Hz), in units of a `scale` of the channels, without inputs.

    `lengths` are the samples of the records, at a `rate` (Hz).
    """

    lines: Lines
    scale: Float[np.ndarray, " channel"]
    band: tuple[float, float]
    lengths: tuple[int, ...]
    rate: float

    @property
    def duration(self) -> float:
        """Duration (s) of all records together."""
        return sum(self.lengths) / self.rate


def response_in_band(
    records: tuple[Float[np.ndarray, "_ channel"], ...], rate: float, band: tuple[float, float]
) -> Response:
    """Lines of records about a band (Hz)."""
    none = tuple(np.zeros((len(record), 0)) for record in records)
    lines = transforms(records, none, rate, (band[0] / 2, HIGHEST_LINE * band[1]))
    scale = np.sqrt(np.mean(np.abs(lines.outputs) ** 2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    lengths = tuple(len(record) for record in records)
    return Response(lines._replace(outputs=lines.outputs / scale), scale, band, lengths, rate)


def after_impacts(response: Response, impacts: tuple[Impact, ...]) -> Lines:
    """Lines with a unit impulse for each impact as an input."""
    lines = response.lines
    return lines._replace(inputs=_impulses(response, lines, impacts))


def _impulses(response: Response, lines: Lines, impacts) -> Complex[np.ndarray, "line impact"]:
    inputs = np.zeros((len(lines.z), len(impacts)), complex)
    for number, impact in enumerate(impacts):
        these, length = lines.record == impact.record, response.lengths[impact.record]
        bins = bins_of(lines, these, length, response.rate)
        inputs[these, number] = np.exp(-2j * np.pi * bins * impact.sample / length) / np.sqrt(
            length
        )
    return inputs


def poles_within(
    poles: Complex[np.ndarray, " pole"], band: tuple[float, float]
) -> Complex[np.ndarray, " own"]:
    """Poles (1/s) whose natural frequencies are in a band (Hz)."""
    natural = np.abs(poles) / (2 * np.pi)
    return poles[(natural > band[0]) & (natural < band[1])]


def work(duration: float, band: tuple[float, float], modes: int, impacts: int) -> float:
    """Rows times squared columns of the least squares for records of a `duration` (s) in a band."""
    columns = (4 * modes + REST_TERMS) * (impacts + 1)  # with those of the slopes by the poles
    return 2 * duration * (band[1] - band[0]) * columns**2


class _Fit(NamedTuple):
    """What poles and impacts explain."""

    lines: Lines
    poles: Complex[np.ndarray, " pole"]
    fit: LinearFit


def with_missed_impacts(
    response: Response,
    impacts: tuple[Impact, ...],
    poles: Complex[np.ndarray, " pole"],
    powers: tuple[int, ...] = REST_POWERS,
) -> tuple[Impact, ...]:
    """Impacts with those that vibrations of some poles (1/s) tell of besides, in the order of time.

    `powers` of z stand for other modes. More than MAX_IMPACTS in all are not sought, nor more than
    WORK allows.
    """
    apart = _apart(response.rate, response.band)
    while len(impacts) < MAX_IMPACTS:
        places = _beside(response, impacts, apart)
        more = _with_one_more(response, impacts, poles, powers, places)
        if more is None:
            break
        impacts = more
    for impact in impacts:
        # Beside those found later, its instant may be another.
        others = tuple(one for one in impacts if one != impact)
        places = _about(response, impact, apart)
        impacts = _with_one_more(response, others, poles, powers, places) or impacts
    return impacts


def _beside(response: Response, impacts, apart) -> list[Bool[np.ndarray, " sample"]]:
    """Samples of each record that are apart from the impacts, and from its end."""
    places = [np.arange(length) < length - apart for length in response.lengths]
    for impact in impacts:
        places[impact.record][max(impact.sample - apart, 0) : impact.sample + apart + 1] = False
    return places


def _about(response: Response, impact: Impact, apart) -> list[Bool[np.ndarray, " sample"]]:
    """Samples of each record that are not apart from an impact."""
    places = [np.zeros(length, bool) for length in response.lengths]
    places[impact.record][max(impact.sample - apart, 0) : impact.sample + apart + 1] = True
    return places


def _with_one_more(response: Response, impacts, poles, powers, places) -> tuple[Impact, ...] | None:
    """Impacts with the one that explains most, of some places; None if the criterion is against."""
    own = _fitted(response, impacts, poles, powers)
    if own is None:
        return None
    best, most = Impact(0, 0), -1.0
    for record, (samples, gain) in enumerate(_gains(response, own)):
        gain = gain * places[record][samples]
        if gain.max() > most:
            best, most = Impact(record, int(samples[np.argmax(gain)])), float(gain.max())
    level = np.ones(len(own.lines.z)) if own.lines.level is None else own.lines.level
    impulse = _impulses(response, own.lines, (best,)) * level[:, None]
    lines = own.lines._replace(inputs=np.concatenate([own.lines.inputs, impulse], axis=1))
    count = poles.size
    if criterion(linear_fit(lines, poles, powers), count) > criterion(own.fit, count):
        return None
    return tuple(sorted((*impacts, best)))


def _fitted(response: Response, impacts, poles, powers) -> _Fit | None:
    """Fit by given poles; None with too few lines for them, or too many."""
    lines = after_impacts(response, impacts)
    columns = (2 * poles.size + len(powers) + 2) * (len(impacts) + 2)
    too_few = 2 * len(lines.z) < ROWS_OVER_COLUMNS * columns
    if too_few or work(response.duration, response.band, poles.size, len(impacts)) > WORK:
        return None
    lines = whitened(lines, poles)
    return _Fit(lines, poles, linear_fit(lines, poles, powers))


def _gains(
    response: Response, own: _Fit
) -> list[tuple[Int[np.ndarray, " place"], Float[np.ndarray, " place"]]]:
    """Samples of each record, and what an impact there explains of the errors, over their variance.

    The terms of the model are kept: a first choice. Samples are as close as the band asks for.
    """
    lines, count = own.lines, len(own.lines.z)
    level = np.ones(count) if lines.level is None else lines.level
    first, second = resonances_of(lines, own.poles)
    columns = np.concatenate([first + second, 1j * (first - second)], axis=1) * level[:, None]
    errors = own.fit.errors / np.sqrt(np.maximum(np.mean(own.fit.errors**2, axis=0), 1e-300))
    errors = errors[:count] + 1j * errors[count:]
    found = []
    for number, length in enumerate(response.lengths):
        these = lines.record == number
        bins = bins_of(lines, these, length, response.rate)
        size = min(PLACES_OVER_BINS * int(bins.max()), length)
        gram = (columns[these].conj().T @ columns[these]).real
        factor = np.linalg.pinv(gram, hermitian=True)
        gain = np.zeros(size)
        for error in errors[these].T:
            products = np.zeros((size // 2 + 1, columns.shape[1]), complex)
            products[bins] = columns[these].conj() * error[:, None]
            along = np.fft.irfft(products, size, axis=0) * (size / 2)
            gain += np.einsum("tj,jk,tk->t", along, factor, along, optimize=True)
        found.append((np.arange(size) * length // size, gain))
    return found


def bins_of(
    lines: Lines, these: Bool[np.ndarray, " line"], length: int, rate: float
) -> Int[np.ndarray, " own"]:
    """Numbers of the bins of a record's transform at its lines."""
    return np.round(np.angle(lines.z[these]) / (2 * np.pi * lines.step) * length / rate).astype(int)


EARLY = 0.1  # of a record, within which an impact begins it


class ImpactRecords(NamedTuple):
    """Records from the samples `begins` of whole ones on, and the impacts after these."""

    records: tuple[Float[np.ndarray, "_ channel"], ...]
    begins: tuple[int, ...]
    impacts: tuple[Impact, ...]

    def later(self, samples: Sequence[int]) -> "ImpactRecords":
        """The same from some samples of the records on."""
        shifted = [
            Impact(impact.record, impact.sample - samples[impact.record]) for impact in self.impacts
        ]
        return ImpactRecords(
            tuple(record[n:] for record, n in zip(self.records, samples, strict=True)),
            tuple(begin + n for begin, n in zip(self.begins, samples, strict=True)),
            tuple(impact for impact in shifted if impact.sample > 0),
        )

    def every_impact(self) -> tuple[Impact, ...]:
        """Impacts in samples of whole records, with those that begin records."""
        later = [
            Impact(impact.record, impact.sample + self.begins[impact.record])
            for impact in self.impacts
        ]
        first = [Impact(record, begin) for record, begin in enumerate(self.begins) if begin]
        return tuple(sorted([*first, *later]))


def from_early_impacts(impacted: ImpactRecords) -> ImpactRecords:
    """Records from the last of their early impacts on."""
    samples = [0] * len(impacted.records)
    for impact in impacted.impacts:
        if impact.sample < EARLY * len(impacted.records[impact.record]):
            samples[impact.record] = max(samples[impact.record], impact.sample)
    return impacted.later(samples)


def from_rests(impacted: ImpactRecords, response: Response, errors: Lines) -> ImpactRecords:
    """Records from the ends of early rests on, unless they begin at an impact already.

    There the variance of the `errors`, of one level, falls, by the Bayesian information criterion.
    """
    free = (response.band[1] - response.band[0]) / response.rate  # complex numbers of a sample
    samples = []
    for number, (length, begin) in enumerate(zip(response.lengths, impacted.begins, strict=True)):
        sums = np.cumsum(energy_along(errors, number, length, response.rate))
        before = np.arange(1, max(int(EARLY * length), 2))
        after = length - before
        first, second = sums[before - 1] / before, (sums[-1] - sums[before - 1]) / after
        mean = max(sums[-1] / length, 1e-300)
        first, second = (np.maximum(part / mean, 1e-300) for part in (first, second))
        gain = -free * (before * np.log(first) + after * np.log(second))
        gain = np.where(first > second, gain, 0.0)
        best = int(np.argmax(gain))
        ends = not begin and gain[best] > np.log(2 * free * length)
        samples.append(int(before[best]) if ends else 0)
    return impacted.later(samples)


def energy_along(
    errors: Lines, number: int, length: int, rate: float
) -> Float[np.ndarray, " time"]:
    """Energy of errors along a record of a `length` in samples, of all channels together."""
    these = errors.record == number
    spectrum = np.zeros((length // 2 + 1, errors.outputs.shape[1]), complex)
    spectrum[bins_of(errors, these, length, rate)] = errors.outputs[these]
    return np.sum(np.fft.irfft(spectrum, length, axis=0) ** 2, axis=1)


MIN_IMPACTS = 2  # of a record that is fitted as a whole
MAX_ADDED = 16  # poles, one at a time
TRIED = 6  # for each of them
TRIAL_STEPS = 6  # in which it is refined, before it is compared
MIN_DECAY = 0.2  # nepers, over the whole record, of a mode
SAME_POLE = 0.1  # distance of two poles over the smaller decay rate, below which they are one
MEDIAN_LINES = 30  # on either side of a line, whose errors tell its level
SWING_PARTS = 20  # of a record, whose errors are compared
WEAK = 0.05  # share of a mode in the energy
MAX_ENERGY = 3.0  # of a mode, over that of the log; poles that cancel each other have more


class Search(NamedTuple):
    """How impacts are sought from poles, and what must be true of the errors that are left.

    `powers` of z stand for other modes: of few poles many terms cost more than what an impact
    tells. With `rounds` impacts are sought again beside poles that were added. The `swing` of the
    errors is less than given, and its product with their share of the energy less than `most`.
    """

    powers: tuple[int, ...]
    rounds: bool
    most: float
    swing: float


# Of poles of decays, which are nearly all: more rounds explain forces of crossing loads, too.
AFTER_IMPACTS = Search(REST_POWERS, False, 0.4, np.inf)
# The same of impacts that are not seen: the swing is 1.4 at most in twenty planted logs, 1.8 at
# least in five of crossing loads whose forces impacts explain.
AFTER_UNSEEN_IMPACTS = AFTER_IMPACTS._replace(swing=1.5)
# Of poles of ambient vibration. Of a minute with three modes and six impacts, from two poles, five
# impacts are found so, else two.
FROM_AMBIENT = Search(FEWER_REST_POWERS, True, 0.2, np.inf)


class ImpactModes(NamedTuple):
    """Modes well identified, impacts in samples of their records, and the band (Hz) used."""

    modes: tuple[IdentifiedMode, ...]
    impacts: tuple[Impact, ...]
    band: tuple[float, float]


def impact_modes(
    records: tuple[Float[np.ndarray, "_ channel"], ...],
    rate: float,
    band: tuple[float, float],
    impacts: tuple[Impact, ...],
    poles: Complex[np.ndarray, " pole"],
    search: Search = AFTER_IMPACTS,
) -> ImpactModes | None:
    """Modes of a band (Hz), from known impacts and poles (1/s), to which others are added.

    None if less than two impacts are found, or if impacts are not all that excites: then the modes
    leave much unexplained, or more in some parts of a record than in others. The band is narrower
    if the least squares would be too large.
    """
    if len(impacts) > MAX_IMPACTS:
        return None
    whole = tuple(np.asarray(detrend(record, axis=0)) for record in records)
    impacted = ImpactRecords(whole, (0,) * len(whole), impacts)
    most_poles = poles.size
    while True:
        known = len(impacted.impacts)
        band = _affordable(impacted.records, rate, band, poles, known)
        poles = poles_within(poles, band)
        if not poles.size:
            return None
        response = response_in_band(impacted.records, rate, band)
        found = with_missed_impacts(response, impacted.impacts, poles, search.powers)
        impacted = impacted._replace(impacts=found)
        impacted = from_early_impacts(impacted)
        response = response_in_band(impacted.records, rate, band)
        lines = after_impacts(response, impacted.impacts)
        poles = _completed(lines, poles, band, response.duration)
        more = len(impacted.impacts)
        # More poles tell of more impacts, but in a narrower band some would be lost again.
        same = _affordable(impacted.records, rate, band, poles, more) == band
        if more > known or (search.rounds and poles.size > most_poles and same):
            most_poles = max(most_poles, poles.size)
            continue
        begins = impacted.begins
        impacted = from_rests(impacted, response, _errors(lines, poles, band))
        if impacted.begins == begins:
            break
    if len(impacted.every_impact()) < MIN_IMPACTS:
        return None
    model, _ = refined_model(lines, poles, response.scale, band)
    if not _explains(model, response, search):
        return None
    modes = tuple(
        mode
        for mode in modes_of_model(model, response.scale, divided_band(band))
        if not mode_reason(mode, response.duration, band) and mode.energy_share < MAX_ENERGY
    )
    return ImpactModes(modes, impacted.every_impact(), band)


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


def _affordable(records, rate, band, poles, impacts) -> tuple[float, float]:
    """The band (Hz) or as much of its lower part as WORK allows with room for two more impacts."""
    (low, high), duration = band, sum(map(len, records)) / rate
    while high > low:
        modes = poles_within(poles, (low, high)).size
        if work(duration, (low, high), modes, impacts + 2) < WORK:
            break
        high *= 0.9
    return low, max(high, low)


def _explains(model: FittedModel, response: Response, search: Search) -> bool:
    """Whether modes and impacts explain nearly all, and as much in all parts of the records."""
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

    It is one for noise that goes on as it is, and large if something else than impacts excites.
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
