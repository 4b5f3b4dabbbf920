"""Whether a structure is still excited while it decays, by the residuals of a fit.

Start of the free end of a record: a load has left, and the vibration decays. From an instant t_0 on
the record is a sum of few decaying vibrations and of steady noise,

    y_c(t) = sum_k Re(a_kc exp(p_k (t - t_0))) + noise_c(t),   t >= t_0.

Earlier instants are tried one after another, from the end of the record backwards: as long as no
force acts after t_0, errors of the fit are as large as those of the ends before, and no larger at
its beginning. Poles are those of the signal subspace of the record's Hankel matrix (Kung 1978),
their number is that of least BIC. Errors of prediction (`stretches`) miss a load whose forces are
small against the noise within a sample; over a decay, their effect adds up.

Decays during which the structure is still excited: a load that excites little while it leaves shows
in the fit: it explains forces by several modes where there is one, or by vibrations that grow; of
several decays it leaves more of those in which forces act. Impacts are samples that cannot be
predicted; decays follow the hardest of them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from tuning.modal.ambient import Candidate
from tuning.modal.decay.stretches import MIN_DECAY_CYCLES, MIN_ENERGY_RISE, Stretch
from tuning.modal.preprocessing import Samples, prepare
from tuning.modal.result import mac_matrix

ORDERS = (2, 4, 6, 8, 12, 16)  # eigenvalues of the models, two for each vibration
HANKEL_CYCLES = 3.0  # of the strongest vibration in the columns of the matrices
MIN_ROWS, MAX_ROWS, MIN_LAGS = 60, 200, 12  # of these, in all channels; samples of each
MAX_TRIED = 60  # instants
MIN_CYCLES = 10  # of the strongest vibration in the shortest end
MIN_LENGTH = 40  # samples of it
END_PARTS = 10  # of an end, whose errors are compared
# Of errors, or deviations of the ratio, beyond which they differ.
MIN_END_RATIO, RATIO_SDS = 1.3, 3.0
MIN_ERRORS = 1e-4  # of the energy of the first part; less may be nonlinearity, or rounding
MAX_DAMPING = 0.15  # ratio of a vibration
# Instants one after another that end the search: some errors, as a weak vibration is seen some
# cycles late, or clear ones.
MAX_REFUSED, CLEAR_MISFIT = 14, 2.3
GOOD_FIT = 0.9  # misfit of an end without forces: errors a fifth more than noise, at most
MARGIN_CYCLES = 1.5  # delay of the end, as forces just before it have little effect
MAX_UNEXPLAINED = 0.15  # of the energy of the first part
MIN_FALL = 1.0  # nepers, of the energy that is explained, from the first part to the last
SAME_RATE = 0.5  # least ratio of slopes of the energy that count as equal
MAX_LEVEL_AT_END = 0.5  # of the record's mean energy; more is no decay after a load


class _End(NamedTuple):
    """Fitted end of a record: first sample, and squares of its errors and of the samples."""

    start: int
    errors: Float[np.ndarray, " sample"]
    energy: Float[np.ndarray, " sample"]
    variance: float  # of the errors, which the fit makes smaller than the noise

    @property
    def explained(self) -> Float[np.ndarray, " part"]:
        """Mean energy of each part of the end that the fit explains."""
        explained = np.maximum(_of_parts(self.energy) - _of_parts(self.errors), 0.0)
        return explained + 1e-6 * explained.max() + 1e-300

    @property
    def is_decay(self) -> bool:
        """Whether the fit explains the beginning of the end, and its energy falls."""
        begins = _of_parts(self.errors)[0] < MAX_UNEXPLAINED * _of_parts(self.energy)[0]
        return bool(begins and np.log(self.explained[0] / self.explained[-1]) > MIN_FALL)

    @property
    def slope(self) -> float:
        """Slope of the logarithm of the energy, for a sample: that of an exponential of its mean.

        The energy of close modes beats, so that it need not fall at the beginning.
        """
        places = (np.arange(END_PARTS) + 0.5) * len(self.errors) / END_PARTS
        return -float(self.explained.sum() / (self.explained @ places))


def free_end(
    record: Float[np.ndarray, "sample channel"], cycle: float, independent: float, since: int = 0
) -> int | None:
    """Sample from which on a record decays freely; None where that is not clear.

    `cycle` is that of the strongest vibration in samples, `independent` the fraction of samples
    that are, in the band of the record. The end is one of the part `since` a sample, after the last
    impact; if it begins soon after that, nothing but the impact excites the structure.
    """
    values = record / np.maximum(record.std(axis=0), 1e-300)
    count, channels = values.shape
    lags = np.clip(int(HANKEL_CYCLES * cycle), MIN_ROWS // channels, MAX_ROWS // channels)
    lags = min(max(int(lags), MIN_LAGS), count // 8)
    shortest = max(int(MIN_CYCLES * cycle), MIN_LENGTH, 2 * lags)
    last = values[-max(count // END_PARTS, 1) :]
    if count - since < 2 * shortest or np.mean(last**2) > MAX_LEVEL_AT_END * np.mean(values**2):
        return None
    step = max(int(2 * cycle), count // MAX_TRIED)
    ends = _Ends(values, lags, independent)
    starts = range(count - shortest, since - 1, -step)
    accepted = later = ends.fit(starts[0])
    refused, previous = 0, 0.0
    earliest = starts[0]
    for earliest in starts[1:]:
        end = ends.fit(earliest)
        misfit = ends.misfit(end, accepted)
        alike = misfit <= 1.0
        if alike and previous <= 1.0:  # one alone, after refusals, may be so by chance
            accepted, later, refused = end, accepted, 0
        else:
            refused += 1
        if refused == MAX_REFUSED or min(misfit, previous) > CLEAR_MISFIT:
            break
        previous = misfit
    if not refused:
        return None
    # Forces that end within a step have little effect: the end begins one step after the earliest,
    # or earlier, where an end has the errors of noise.
    compared = ends.fit(min(later.start + 2 * step, starts[0]))
    least = min(end.variance for end in (compared, later, accepted))
    compared = compared._replace(variance=least)  # a short end may be fitted badly
    fine = range(later.start, earliest, -max(int(cycle / 2), 2))
    found = _earliest_good(ends, fine, compared) or later
    # Soon after the beginning, errors may be those of vibrations that are gone at once.
    if found.start < since + max(count // END_PARTS, END_PARTS) or not found.is_decay:
        return None
    # What decays from the beginning, but not quite linearly, has no forces before the end, either.
    squares = np.mean(values[since : found.start] ** 2, axis=1)
    before = _of_parts(squares)
    rises = _of_parts(found.energy)[0] > MIN_ENERGY_RISE * before[-1]
    if not rises and _slope(before, squares.size) < SAME_RATE * found.slope:
        return None
    return min(found.start + int(MARGIN_CYCLES * cycle), later.start)


def _earliest_good(ends: "_Ends", starts: range, shorter: _End) -> _End | None:
    """The earliest end, from one backwards, whose errors are those of the noise.

    Only ends that begin soon after the forces show the modes that decay first: errors of others,
    which lack them, may be more.
    """
    found, previous = None, 0.0
    for start in starts[1:]:
        end = ends.fit(start)
        misfit = ends.misfit(end, shorter)
        if misfit <= GOOD_FIT:
            found = end
        if min(misfit, previous) > CLEAR_MISFIT:
            break
        previous = misfit
    return found


class _Ends:
    """Fits of ends of values (sample, channel), and the products of their Hankel matrices."""

    def __init__(self, values, lags: int, independent: float):
        self.values, self.independent = values, independent
        windows = np.lib.stride_tricks.sliding_window_view(values, lags, axis=0)
        self.rows = windows.transpose(0, 2, 1).reshape(len(windows), -1)
        self.products = {len(self.rows): np.zeros((self.rows.shape[1],) * 2)}

    def product(self, start: int):
        """Product of the Hankel matrix of an end with itself, from that of a shorter one."""
        later = min(computed for computed in self.products if computed >= start)
        part = self.rows[start:later]
        self.products[start] = self.products[later] + part.T @ part
        return self.products[start]

    def fit(self, start: int) -> _End:
        """Fit of the model of least BIC to the end from a sample on."""
        values = self.values[start:]
        count, channels = values.shape
        basis = np.linalg.eigh(self.product(start))[1][:, ::-1]
        best, errors, parameters = np.inf, values, 0
        for order in ORDERS:
            if order > basis.shape[1] - channels or 8 * order > len(values):
                break
            roots = _roots(basis[:, :order], channels)
            if not roots.size:
                continue
            powers = _powers(roots, count)
            columns = np.hstack([powers.real, powers.imag])
            left = values - columns @ np.linalg.lstsq(columns, values, rcond=None)[0]
            numbers = columns.shape[1] * (channels + 1)
            cost = count * np.sum(np.log(np.mean(left**2, axis=0) + 1e-300))
            cost += numbers * np.log(count * channels)
            if cost < best:
                best, errors, parameters = cost, left, numbers
        squares = np.mean(errors**2, axis=1)
        freedom = max(count - parameters / (channels * self.independent), count / 4)
        energy = np.mean(values**2, axis=1)
        return _End(start, squares, energy, float(squares.sum() / freedom))

    def misfit(self, end: _End, shorter: _End) -> float:
        """Ratio of the errors of an end to those of a shorter one, over the limit of that ratio.

        The largest in the samples before the shorter end, in the first part, and in all.
        """
        before, first = (
            end.errors[:size] for size in (shorter.start - end.start, len(end.errors) // END_PARTS)
        )
        least = MIN_ERRORS * np.mean(end.energy[: first.size]) + 1e-300
        usual, all_before = (
            max(np.median(_of_parts(end.errors)), least),
            max(shorter.variance, least),
        )
        ratios = (
            (np.mean(before) / usual, before.size),
            (np.mean(first) / usual, first.size),
            (end.variance / all_before, end.errors.size),
        )
        size = self.independent * self.values.shape[1]
        return max(
            float(ratio) / max(MIN_END_RATIO, 1 + RATIO_SDS * np.sqrt(2 / max(size * samples, 1.0)))
            for ratio, samples in ratios
        )


def _powers(roots, count: int):
    """Powers 0 to `count` - 1 of roots (power, root), as products of those of a block."""
    block = int(np.sqrt(count)) + 1
    within = roots ** np.arange(block)[:, None]
    starts = (roots**block) ** np.arange(-(-count // block))[:, None]
    return (starts[:, None] * within).reshape(-1, roots.size)[:count]


def _slope(energies, samples: int) -> float:
    """Slope of the logarithm of energies that are evenly spread over some samples."""
    places = np.arange(len(energies)) * samples / len(energies)
    return float(np.polyfit(places, np.log(energies + 1e-300), 1)[0])


def _of_parts(squares):
    """Means of the parts of an end."""
    return np.array([np.mean(part) for part in np.array_split(squares, END_PARTS)])


def _roots(basis, channels: int):
    """Eigenvalues of the shift of a signal subspace that are vibrations, not damped too strongly.

    Others would fit what a force did just after the beginning of an end.
    """
    shift = np.linalg.lstsq(basis[:-channels], basis[channels:], rcond=None)[0]
    roots = np.linalg.eigvals(shift).astype(complex)
    logarithms = np.log(roots[np.abs(roots) > 1e-6])
    decay = -logarithms.real
    kept = (logarithms.imag > 0) & (decay > 0) & (decay < MAX_DAMPING * np.abs(logarithms))
    return np.exp(logarithms[kept])


PARTS = 10  # of a decay, of which one is cut off where forces seem to act
MIN_RATIO = 2.5  # of errors of a decay to the least of others
SPLIT_RATIO, SPLIT_MAC = 1.1, 0.9  # of three frequencies, and of the shapes of modes of one
SPLIT_POLES = 4  # within the same ratio
MIN_GROWTH = 0.2  # nepers of a vibration over the decay
MIN_GROWING_ENERGY = 0.01  # of the energy
MIN_UNEXPLAINED = 0.05  # of the energy of a decay; less may be nonlinearity


def without_excitation(
    decays: tuple[Stretch, ...],
    measured: Float[np.ndarray, "sample column"],
    fitted: Float[np.ndarray, "sample column"],
    candidates: tuple[Candidate, ...],
    *,
    channels: int,
    rate: float,
    after_impact: bool,
) -> tuple[Stretch, ...]:
    """Fitted decays without those that are disturbed by an excitation; all if none is.

    Of a single decay the first part is cut off instead.

    Columns are the `channels` of each decay, at a `rate` (Hz). `candidates` are the modes of the
    fit; `after_impact` says that nothing acts from the beginning.
    """
    first, *others = decays
    split = has_split(candidates)
    if others:
        grows = growing_fraction(candidates, len(measured) / rate) > MIN_GROWING_ENERGY
        least = 0.0 if grows or split else MIN_UNEXPLAINED
        return undisturbed(decays, measured, fitted, channels, least)
    cut = len(measured) // PARTS if split and not after_impact else 0
    return (first._replace(start=first.start + cut),)


def growing_fraction(candidates: tuple[Candidate, ...], duration: float) -> float:
    """Largest fraction of the energy of a fit over a `duration` (s) in a vibration that grows.

    Forces make vibrations grow; steady hum does not. Of 100 decays without forces (60 s, planted
    structures) none has one of more than a hundredth.
    """
    growing = [
        one.mode.energy_share
        for one in candidates
        if 2 * np.pi * one.mode.frequency * -one.mode.damping_ratio * duration > MIN_GROWTH
    ]
    return max(growing, default=0.0)


def has_split(candidates: tuple[Candidate, ...]) -> bool:
    """Whether the fit splits one mode into several, as where forces act.

    Three modes are then close and alike, or four poles are close, whether modes or not, or three in
    two places: of 100 decays without forces of planted structures, with pairs of modes, one has
    three such poles.
    """
    crowds = _crowds(sorted(one.mode.frequency for one in candidates))
    if max(crowds, default=0) >= SPLIT_POLES or sum(n >= SPLIT_POLES - 1 for n in crowds) > 1:
        return True
    modes = [one.mode for one in candidates if not one.reason]
    modes.sort(key=lambda mode: mode.frequency)
    for first, second, third in zip(modes, modes[1:], modes[2:], strict=False):
        if third.frequency < SPLIT_RATIO * first.frequency:
            shapes = np.stack([first.shape, second.shape, third.shape])
            if mac_matrix(shapes, shapes).min() > SPLIT_MAC:
                return True
    return False


def _crowds(frequencies: list[float]) -> list[int]:
    """Numbers of poles that are close, in places apart; the largest first of those that overlap."""
    left, numbers = np.array(frequencies), []
    while left.size:
        inside = (left >= left[:, None]) & (left < SPLIT_RATIO * left[:, None])
        most = int(np.argmax(inside.sum(axis=1)))
        numbers.append(int(inside[most].sum()))
        left = left[~inside[most]]
    return numbers


def undisturbed(
    decays: tuple[Stretch, ...],
    measured: Float[np.ndarray, "sample column"],
    fitted: Float[np.ndarray, "sample column"],
    channels: int,
    least: float = MIN_UNEXPLAINED,
) -> tuple[Stretch, ...]:
    """Fitted decays without those whose errors are larger than those of others.

    Noise is the same in all, however hard the impacts were; errors of less than a fraction `least`
    of the energy may be nonlinearity. Columns are the channels of each decay; if they are
    combinations of decays, all are returned.
    """
    if measured.shape[1] != len(decays) * channels:
        return decays
    errors, energy = (
        np.sum(squares, axis=0).reshape(len(decays), -1).sum(axis=1)
        for squares in ((measured - fitted) ** 2, measured**2)
    )
    more = (errors > MIN_RATIO * errors.min()) & (errors > least * energy)
    return tuple(one for one, has in zip(decays, more, strict=True) if not has)


MAX_CONTACT = 40  # samples that an impact marks; more are a lasting excitation
APART_CYCLES = 2.0  # of the lowest frequency, after which an impact is no rebound of another
AFTER_CYCLES = 2.0  # of the lowest frequency, in which an impact's energy is compared


class Impact(NamedTuple):
    """Record, and the sample in it, at which the structure was hit."""

    record: int
    sample: int


def marked_impacts(
    impacted: tuple[Bool[np.ndarray, " time"], ...], rate: float, band: tuple[float, float]
) -> tuple[Impact, ...]:
    """Impacts amid marked samples of records at a `rate` (Hz), for a band (Hz)."""
    found: list[Impact] = []
    apart = int(APART_CYCLES * rate / band[0]) + 1  # samples, the least distance of two impacts
    for record, marks in enumerate(impacted):
        places = np.flatnonzero(marks)
        if not places.size:
            continue
        for group in np.split(places, np.flatnonzero(np.diff(places) > MAX_CONTACT / 2) + 1):
            impact = Impact(record, int(group[0] + group[-1]) // 2)
            rebound = (
                found
                and impact.record == found[-1].record
                and (impact.sample - found[-1].sample <= apart)
            )
            if group[-1] - group[0] < MAX_CONTACT and not rebound:
                found.append(impact)
    return tuple(found)


def impacts_left_out(
    samples: Samples,
    excited: tuple[Bool[np.ndarray, " time"], ...],
    decays: Sequence[Stretch],
    band: tuple[float, float],
) -> list[str]:
    """A sentence if no decay that is used follows the impact that leaves most energy in a band
    (Hz).

    `excited` are the samples at which the structure is excited.
    """
    impacts = marked_impacts(excited, samples.rate, band)
    if not impacts:
        return []
    prepared = prepare(samples.records, samples.starts, samples.rate, band)
    ratio = prepared.rate / samples.rate
    cycles = int(AFTER_CYCLES * samples.rate / band[0])

    def energy(impact: Impact) -> float:
        first = int(impact.sample * ratio)
        part = prepared.records[impact.record][first : first + max(int(cycles * ratio), 1)]
        return float(np.sum(part**2))

    hardest = max(impacts, key=energy)
    later = [b.sample for b in impacts if b.record == hardest.record and b.sample > hardest.sample]
    last = min([hardest.sample + cycles, *later])
    if any(
        one.record == hardest.record and one.start <= last and hardest.sample < one.stop
        for one in decays
    ):
        return []
    start = samples.starts[hardest.record] + hardest.sample / samples.rate
    wait = (min(later) - hardest.sample) / samples.rate if later else np.inf
    why = "what follows it is not the free decay with most information"
    if wait * band[0] < MIN_DECAY_CYCLES:
        why = f"the next impact comes {wait:.3g} s later"
    return [f"the hardest impact, at {start:.4g} s, is left out: {why}"]
