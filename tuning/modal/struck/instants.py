"""Instants of blows that nobody measured: those that errors tell, and those that a model misses.

A vibration of known poles is free but at blows, each of which adds to it what no force sensor has
measured: amplitudes of each mode in each channel. As responses to unit impulses these are linear in
unknown residues, so that what a further blow would explain of the errors is known at all samples at
once: the errors filtered by the responses of the modes, run backwards. One blow after another is
added, that of most gain, as long as the Bayesian information criterion falls.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from tuning.modal.forced.common_denominator import Lines, transforms
from tuning.modal.forced.likelihood import (
    REST_POWERS,
    REST_TERMS,
    LinearFit,
    linear_fit,
    whitened,
)
from tuning.modal.forced.significance import criterion
from tuning.modal.forced.terms import resonances_of

MAX_CONTACT = 40  # samples that a blow marks; more are a lasting excitation
APART_CYCLES = 2.0  # of the lowest frequency, by which a missed blow is away from all others
MAX_BLOWS = 16  # whose residues are worth their time; of more, decays tell enough
ROWS_OVER_COLUMNS = 2  # of the least squares
WORK = 5e7  # rows times squared columns of them, which takes seconds in all
PLACES_OVER_BINS = 8  # of instants that are tried
HIGHEST_LINE = 1.15  # over the upper end of a band


class Blow(NamedTuple):
    """Record, and the sample in it, at which the structure was struck."""

    record: int
    sample: int


def marked_blows(
    struck: tuple[Bool[np.ndarray, " time"], ...], rate: float, band: tuple[float, float]
) -> tuple[Blow, ...]:
    """Blows amid marked samples of records at a `rate` (Hz), for a band (Hz)."""
    found: list[Blow] = []
    for record, marks in enumerate(struck):
        places = np.flatnonzero(marks)
        if not places.size:
            continue
        for group in np.split(places, np.flatnonzero(np.diff(places) > MAX_CONTACT / 2) + 1):
            blow = Blow(record, int(group[0] + group[-1]) // 2)
            rebound = (
                found
                and blow.record == found[-1].record
                and (blow.sample - found[-1].sample <= _apart(rate, band))
            )
            if group[-1] - group[0] < MAX_CONTACT and not rebound:
                found.append(blow)
    return tuple(found)


def _apart(rate, band) -> int:
    """Samples by which blows must be apart, to be told from each other."""
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


def after_blows(response: Response, blows: tuple[Blow, ...]) -> Lines:
    """Lines with a unit impulse for each blow as an input."""
    lines = response.lines
    return lines._replace(inputs=_impulses(response, lines, blows))


def _impulses(response: Response, lines: Lines, blows) -> Complex[np.ndarray, "line blow"]:
    inputs = np.zeros((len(lines.z), len(blows)), complex)
    for number, blow in enumerate(blows):
        these, length = lines.record == blow.record, response.lengths[blow.record]
        bins = bins_of(lines, these, length, response.rate)
        inputs[these, number] = np.exp(-2j * np.pi * bins * blow.sample / length) / np.sqrt(length)
    return inputs


def poles_within(
    poles: Complex[np.ndarray, " pole"], band: tuple[float, float]
) -> Complex[np.ndarray, " own"]:
    """Poles (1/s) whose natural frequencies are in a band (Hz)."""
    natural = np.abs(poles) / (2 * np.pi)
    return poles[(natural > band[0]) & (natural < band[1])]


def work(duration: float, band: tuple[float, float], modes: int, blows: int) -> float:
    """Rows times squared columns of the least squares for records of a `duration` (s) in a band."""
    columns = (4 * modes + REST_TERMS) * (blows + 1)  # with those of the slopes by the poles
    return 2 * duration * (band[1] - band[0]) * columns**2


class _Fit(NamedTuple):
    """What poles and blows explain."""

    lines: Lines
    poles: Complex[np.ndarray, " pole"]
    fit: LinearFit


def with_missed_blows(
    response: Response,
    blows: tuple[Blow, ...],
    poles: Complex[np.ndarray, " pole"],
    powers: tuple[int, ...] = REST_POWERS,
) -> tuple[Blow, ...]:
    """Blows with those that vibrations of some poles (1/s) tell of besides, in the order of time.

    `powers` of z stand for other modes. More than MAX_BLOWS in all are not sought, nor more than
    WORK allows.
    """
    apart = _apart(response.rate, response.band)
    while len(blows) < MAX_BLOWS:
        places = _beside(response, blows, apart)
        more = _with_one_more(response, blows, poles, powers, places)
        if more is None:
            break
        blows = more
    for blow in blows:
        # Beside those found later, its instant may be another.
        others = tuple(one for one in blows if one != blow)
        places = _about(response, blow, apart)
        blows = _with_one_more(response, others, poles, powers, places) or blows
    return blows


def _beside(response: Response, blows, apart) -> list[Bool[np.ndarray, " sample"]]:
    """Samples of each record that are apart from the blows, and from its end."""
    places = [np.arange(length) < length - apart for length in response.lengths]
    for blow in blows:
        places[blow.record][max(blow.sample - apart, 0) : blow.sample + apart + 1] = False
    return places


def _about(response: Response, blow: Blow, apart) -> list[Bool[np.ndarray, " sample"]]:
    """Samples of each record that are not apart from a blow."""
    places = [np.zeros(length, bool) for length in response.lengths]
    places[blow.record][max(blow.sample - apart, 0) : blow.sample + apart + 1] = True
    return places


def _with_one_more(response: Response, blows, poles, powers, places) -> tuple[Blow, ...] | None:
    """Blows with the one that explains most, of some places; None if the criterion is against."""
    own = _fitted(response, blows, poles, powers)
    if own is None:
        return None
    best, most = Blow(0, 0), -1.0
    for record, (samples, gain) in enumerate(_gains(response, own)):
        gain = gain * places[record][samples]
        if gain.max() > most:
            best, most = Blow(record, int(samples[np.argmax(gain)])), float(gain.max())
    level = np.ones(len(own.lines.z)) if own.lines.level is None else own.lines.level
    impulse = _impulses(response, own.lines, (best,)) * level[:, None]
    lines = own.lines._replace(inputs=np.concatenate([own.lines.inputs, impulse], axis=1))
    count = poles.size
    if criterion(linear_fit(lines, poles, powers), count) > criterion(own.fit, count):
        return None
    return tuple(sorted((*blows, best)))


def _fitted(response: Response, blows, poles, powers) -> _Fit | None:
    """Fit by given poles; None with too few lines for them, or too many."""
    lines = after_blows(response, blows)
    columns = (2 * poles.size + len(powers) + 2) * (len(blows) + 2)
    too_few = 2 * len(lines.z) < ROWS_OVER_COLUMNS * columns
    if too_few or work(response.duration, response.band, poles.size, len(blows)) > WORK:
        return None
    lines = whitened(lines, poles)
    return _Fit(lines, poles, linear_fit(lines, poles, powers))


def _gains(
    response: Response, own: _Fit
) -> list[tuple[Int[np.ndarray, " place"], Float[np.ndarray, " place"]]]:
    """Samples of each record, and what a blow there explains of the errors, over their variance.

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
