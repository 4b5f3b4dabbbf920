"""Free decays in a log: stretches after impacts, or after a load has left, without excitation.

Between impacts the samples are predicted by the past ones, but for noise. An autoregressive model
of each channel shows excitation by its prediction errors: an impact is an error far beyond those of
the quietest parts of the log, and beyond those before it or not small against the signal itself.
The model is that of the log at its own rate, whose highest frequencies show a contact best,
whatever the band in which modes are sought. Impacts too soft, or in too much noise, for that are
found by the energy, which rises at once. The last functions say whether decays stand for a log.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy.signal import lfilter

MIN_ENERGY_RISE = 2.0  # energy in two cycles after an impact over that before it
RISE_WIDTHS = 5  # of two cycles each, before such a rise
MIN_START_RATIO = 10.0  # energy right after an impact over that of a structure at rest
MAX_HARDER = 10.0  # energy after the hardest impact over that after the softest; less is noise


def vibration_energy(
    record: Float[np.ndarray, "sample channel"], width: int
) -> Float[np.ndarray, " sample"]:
    """Energy of a record around each sample, with each channel relative to its mean energy."""
    scaled = record / np.maximum(record.std(axis=0), 1e-300)
    return moving_mean(np.sum(scaled**2, axis=1), width)


def moving_mean(values: Float[np.ndarray, " sample"], width: int) -> Float[np.ndarray, " sample"]:
    """Means of the values around each sample; fewer at the ends."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(values.size)
    low, high = np.maximum(index - width // 2, 0), np.minimum(index + width // 2 + 1, values.size)
    return (total[high] - total[low]) / (high - low)


def until_soft_impact(record: Float[np.ndarray, "sample channel"], width: int) -> int:
    """Number of samples of a record before an impact too soft for prediction errors, or all.

    `width` are two cycles of the strongest vibration in samples.
    """
    return until_impact(vibration_energy(record, width), width)


def after_first_impact(energy: Float[np.ndarray, " sample"], width: int) -> int | None:
    """Sample of most energy after an impact that strikes a structure at rest; None without one."""
    rise = _until_rise(energy, width, width, MIN_START_RATIO)
    if rise == energy.size:
        return None
    highest = _highest_after(energy, rise, width)
    return highest if MAX_HARDER * energy[highest] > energy.max() else None


def between_soft_impacts(
    energy: Float[np.ndarray, " sample"], first: int, last: int, width: int
) -> Iterator[tuple[int, int]]:
    """First and last samples of the parts of a stretch before and after soft impacts."""
    while True:
        rise = first + until_impact(energy[first:last], width)
        yield first, rise
        if rise == last:
            return
        first = _highest_after(energy[:last], rise, width)


def _highest_after(energy, rise, width) -> int:
    """Sample of most energy after an impact, from which on nothing acts."""
    return rise + int(np.argmax(energy[rise : rise + 4 * width]))


def until_impact(energy: Float[np.ndarray, " sample"], width: int) -> int:
    """Number of samples before an impact too soft to be found by prediction errors.

    Close modes make the energy rise, too, but not above its value as long before its least.
    """
    return _until_rise(energy, width, RISE_WIDTHS * width, MIN_ENERGY_RISE)


def _until_rise(energy, width, past, ratio) -> int:
    """Number of samples before the energy rises, within `width`, above `ratio` times its `past`."""
    if energy.size < past + 2 * width:
        return energy.size
    before = sliding_window_view(energy, past).max(axis=-1)[: -2 * width]
    risen = energy[past + 2 * width - 1 :][: before.size] > ratio * before
    return past + int(np.argmax(risen)) if risen.any() else energy.size


AR_ORDER = 24  # of the model by which samples are predicted
AR_ITERATIONS = 6  # of reweighting
AR_ROWS = 20_000  # equations from which its coefficients are found
QUIET_QUANTILE = 0.2  # of the blocks, by their prediction errors
IMPACT_SD = 10.0  # prediction errors of quiet blocks, beyond which the structure is excited
IMPACT_OVER_SIGNAL = 0.25  # prediction errors over the rms of the signal around, likewise
IMPACT_LOCAL_SD = 8.0  # or of the errors before it; normal errors reach six in a day of samples
CONTACT_SAMPLES = 4  # within which past and future fail after an impact
MIN_DECAY_CYCLES = 5.0  # of the strongest vibration
MIN_FALL_NEPERS = 1.0  # of the energy over a decay
MIN_LINEARITY = 0.6  # fraction of the variance of the log energy that a straight line explains
MAX_COLUMNS = 24  # channels times decays that are fitted together
# Least information of stacked decays over that of one long decay alone; below it intervals would be
# ten times as wide. Impacts at random have a tenth or more (24 planted logs).
LEAST_STACKED_INFORMATION = 0.01
# Least energy in decays after impacts that the energy alone shows, over that of the record. Ambient
# vibration rises and falls, too: its falls held as much in one of eight short records of one mode.
MIN_ENERGY_AFTER_SOFT_IMPACTS = 0.7
FALL_PARTS = 10  # parts of a decay, from whose mean energies its fall is computed
NOISE_QUANTILE = 0.25  # of the energy of a stretch: that of the noise, if the decay has ended
CORES_BEFORE_NOISE = 8  # times that of 95 % of the energy above noise: 12 decay times of one mode
CORE, WHOLE = 0.95, 0.999  # fractions of the energy of a decay: for its fall, and for its end


# Least information of other decays over that of the decay right after an impact, if they are taken
# instead: with less than a tenth, their intervals are more than three times as wide.
LEAST_INFORMATION = 0.1
CONTACT_CYCLES = 0.5  # of the strongest vibration, in which marks are those of the impact itself
# Falls of the energy in nepers, the times of which are compared. One exponential needs half of the
# time to the second fall for the first, several need less. Under a crossing load the energy stays
# up until it has left: the first neper takes most of the time to the second.
FALLS = 1.0, 2.0
MAX_FIRST_FALL = 0.6  # time of the first fall over that of the second


class Stretch(NamedTuple):
    """Samples (start, stop) of a record between excitations, and the fall of energy in nepers.

    `from_rest` marks the decay right after an impact on a structure at rest.
    """

    record: int
    start: int
    stop: int
    fall: float
    from_rest: bool = False


def excited_samples(
    record: Float[np.ndarray, "time channel"], rate: float, cycle: float
) -> Bool[np.ndarray, " time"]:
    """Mask of samples at which the structure is excited, as neither past nor future predicts them.

    `cycle` (s) is that of the strongest vibration. After an impact prediction from the past fails
    for as many samples as the model has coefficients, before it prediction from the future. Two
    models must fail, one of errors relative to the signal around, one of absolute errors, in which
    the loud parts count.
    """
    span = max(int(2 * cycle * rate), 16)
    excited = np.zeros(len(record), bool)
    for values in record.T:
        if not values.any():
            continue
        around = np.sqrt(moving_mean(values**2, span)) + 1e-12 * np.abs(values).max() + 1e-300
        forward, backward = np.ones((2, values.size), bool)
        for scale in (around, np.ones(values.size)):
            forward &= _is_large(prediction_errors(values, scale), around, span)
            errors = prediction_errors(values[::-1], scale[::-1])[::-1]
            backward &= _is_large(errors, around, span)
        excited |= _widened(forward) & _widened(backward)
    return excited


def _is_large(error, around, span):
    """Mask of errors beyond those of the quietest blocks, and not small against the signal."""
    size, found = max(span, 32), np.abs(error)
    if error.size < 2 * size:
        return found > IMPACT_OVER_SIGNAL * around
    blocks = found[: error.size // size * size].reshape(-1, size)
    quiet = np.sqrt(np.quantile(np.mean(blocks**2, axis=1), QUIET_QUANTILE))
    local = _level_before(error, max(span // 4, 16))
    return (found > IMPACT_SD * quiet) & (
        (found > IMPACT_OVER_SIGNAL * around) | (found > IMPACT_LOCAL_SD * local)
    )


def _level_before(error, size):
    """Deviation of the errors in the block of half a cycle before that of each sample.

    In a decay, whose errors may fall with the signal, none exceeds those before it.
    """
    count = max(error.size // size, 1)
    blocks = np.abs(error[: count * size]).reshape(count, -1)
    medians = np.median(blocks, axis=1) / 0.6745  # standard deviations of normal errors
    return medians[np.clip(np.arange(error.size) // size - 1, 0, count - 1)]


def _widened(samples):
    """Mask of samples widened by `CONTACT_SAMPLES` neighbours on either side."""
    return np.convolve(samples, np.ones(2 * CONTACT_SAMPLES + 1), "same") > 0.5


def prediction_errors(
    values: Float[np.ndarray, " time"], scale: Float[np.ndarray, " time"]
) -> Float[np.ndarray, " time"]:
    """Errors of an autoregressive model, zero where the past is too short.

    The model has the least sum of absolute errors over a scale (by iteratively reweighted least
    squares), so that excited samples, however strong, do not shape it.
    """
    order = min(AR_ORDER, values.size // 8)
    step = max(values.size // AR_ROWS, 1)
    past = sliding_window_view(values, order)[:-1:step]
    target, scale = values[order::step], scale[order::step]
    least = 1e-6 * values.std() + 1e-300
    weight = 1 / scale**2
    for _ in range(AR_ITERATIONS):
        weighted = past * weight[:, None]
        gram = past.T @ weighted
        coefficients = np.linalg.lstsq(gram, weighted.T @ target, rcond=1e-14)[0]
        weight = 1 / (scale * np.maximum(np.abs(target - past @ coefficients), least))
    errors = np.asarray(lfilter(np.concatenate([[1.0], -coefficients[::-1]]), [1.0], values))
    errors[:order] = 0.0
    return errors


def free_decays(
    excited: tuple[Bool[np.ndarray, " time"], ...],
    records: tuple[Float[np.ndarray, "sample channel"], ...],
    rate: float,
    frequency: float,
) -> tuple[Stretch, ...]:
    """Decays between the excited samples of records, in samples of these.

    `records` are those of the band, at the `rate` (Hz) after decimation; `frequency` (Hz) is that
    of the strongest vibration. A decay lasts at least five cycles, in which the energy falls by one
    neper, along a line or after an impact that raised it; it ends when 99.9 % of the energy above
    the least has passed, or sooner if a long rest is noise. A record may begin right after an
    impact: its energy is then far above that at its end, though close modes make it rise and fall
    on the way. What is at rest before a first impact that was not found does not count. In a record
    without a lasting excitation the energy also shows impacts too soft, or in too much noise, to
    be found by their errors, down to a tenth of the highest energy.

    The decay right after an impact on a structure at rest takes their place in its record where
    they have far less information.
    """
    shortest = int(np.ceil(MIN_DECAY_CYCLES * rate / frequency))
    width = max(int(2 * rate / frequency), 4)
    found = []
    for number, (marks, record) in enumerate(zip(excited, records, strict=True)):
        energy = vibration_energy(record, width)
        decays = _decays_of_record(number, marks, energy, shortest, width)
        own = _decay_of_impact(number, marks, energy, shortest, width)
        found += decays if own is None or _tell_enough(decays, own, marks, energy) else [own]
    return tuple(found)


def _decay_of_impact(number, marks, energy, shortest, width) -> Stretch | None:
    """The decay right after the strongest impact, if that strikes a structure at rest.

    A hammer leaves the structure after milliseconds. Friction, rattling parts and frequencies that
    depend on amplitude cause prediction errors in the decay without any excitation, and no linear
    model explains it: it is found by the energy, which rises at once and falls from then on.
    """
    ratio = marks.size / len(energy)
    highest = int(np.argmax(energy))
    # The moving mean is highest where it begins with the impact.
    impact = max(highest - width // 2, 0)
    past = energy[max(impact - RISE_WIDTHS * width, 0) : max(impact - width // 2, 0)]
    if past.size < width or MIN_START_RATIO * past.max() > energy[highest]:
        return None
    excited = marks[int((impact - width) * ratio) : int((impact + width) * ratio)]
    if not excited.any() or not _falls_at_once(energy[highest:]):
        return None
    exact, contact = int(impact * ratio), int(CONTACT_CYCLES * width / 2 * ratio)
    start = exact + int(np.flatnonzero(marks[exact : exact + contact])[-1:].sum()) + 2
    first = int(np.ceil(start / ratio))
    last = highest + until_impact(energy[highest:], width)
    part = energy[first:last]
    if part.size < shortest:
        return None
    fall = _fall_of_decay(part, True)
    if fall < MIN_FALL_NEPERS:
        return None
    stop = start + int(max(_until_noise(part), shortest) * ratio)
    return Stretch(number, start, min(stop, int(last * ratio)), fall, True)


def _falls_at_once(energy) -> bool:
    """Whether energy falls from its beginning, as in a free decay."""
    level = np.log(np.maximum(energy, 1e-300))
    first, second = (np.flatnonzero(level < level[0] - fall) for fall in FALLS)
    return bool(second.size and first[0] <= MAX_FIRST_FALL * second[0])


def _tell_enough(decays, own: Stretch, marks, energy) -> bool:
    """Whether decays have enough information compared with the decay right after an impact."""
    ratio = len(energy) / marks.size
    least = LEAST_INFORMATION * _information_of(own, energy, ratio)
    return sum(_information_of(one, energy, ratio) for one in decays) > least


def _information_of(one: Stretch, energy, ratio: float) -> float:
    """Information of a decay: its nepers times the energy above the noise, the usual energy.

    `ratio` is that of the samples of the energy over those of the log.
    """
    part = energy[int(one.start * ratio) : int(one.stop * ratio)] - np.median(energy)
    return float(one.fall * np.maximum(part, 0.0).sum())


def or_most_informative(
    rest: tuple[Stretch, ...],
    impacts: tuple[Stretch, ...],
    records: tuple[Float[np.ndarray, "time channel"], ...],
    ratio: float,
    cycle: float,
) -> tuple[Stretch, ...]:
    """The `rest` of some decays, or that after an impact which has more information alone.

    Nothing acts in decays after `impacts`: what a fit does not explain there is nonlinearity.
    `records` are those of the band, `ratio` their samples over those of the log, `cycle` that of
    the strongest vibration in samples of `records`.
    """
    energies = [vibration_energy(record, max(int(2 * cycle), 4)) for record in records]

    def information(one):
        return _information_of(one, energies[one.record], ratio)

    best = tuple(sorted(impacts, key=information)[-1:])
    return max(rest, best, key=lambda some: sum(map(information, some)))


def _decays_of_record(number, marks, energy, shortest, width) -> list[Stretch]:
    """Decays between the excited samples of a record, from the energy of its vibration.

    Without excited samples the energy may show impacts, if the decays hold most of it.
    """
    ratio = marks.size / len(energy)
    only_impacts = _longest_run(marks) < shortest * ratio
    found = _decays_between(number, marks, energy, shortest, width, only_impacts)
    if marks.any():
        return found
    spans = [(int(one.start / ratio), int(one.stop / ratio)) for one in found]
    held = sum(energy[start:stop].sum() for start, stop in spans)
    if len(found) > 1 and held > MIN_ENERGY_AFTER_SOFT_IMPACTS * energy.sum():
        return found
    return _decays_between(number, marks, energy, shortest, width, False)


def _decays_between(number, marks, energy, shortest, width, only_impacts: bool) -> list[Stretch]:
    """Decays between excited samples, also split at soft impacts if only impacts excite."""
    ratio, highest = marks.size / len(energy), energy.max()
    found, excited_from = [], 0
    for start, stop in _free_stretches(marks, shortest * ratio):
        first, last = int(np.ceil(start / ratio)), int(stop / ratio)
        before, excited_from = int(excited_from / ratio) - width, stop
        if last - first < shortest:
            continue
        risen = energy[first : first + width].mean()
        impact = start > 0 and (before < 0 or risen > MIN_ENERGY_RISE * energy[before])
        parts = _parts(energy, (first, last), start == 0, only_impacts, shortest, width)
        for begins, ends in parts:
            part, after_soft_impact = energy[begins:ends], begins > parts[0][0]
            # Noise rises and falls, too, but little against the hardest impact.
            if part.size < shortest or (after_soft_impact and MAX_HARDER * part[0] < highest):
                continue
            raised = impact or after_soft_impact or (start == 0 and _begins_high(part))
            fall = _fall_of_decay(part, raised)
            if fall > MIN_FALL_NEPERS:
                exact = start if begins == first else int(np.ceil(begins * ratio))
                length = max(_until_noise(part), shortest)
                end = min(stop, int(ends * ratio), exact + int(length * ratio))
                found.append(Stretch(number, exact, end, fall))
    return found


def _free_stretches(marks, shortest) -> list[tuple[int, int]]:
    """First sample and end of each stretch between excited samples that is long enough."""
    edges = np.concatenate([[-1], np.flatnonzero(marks), [marks.size]])
    return [
        (0 if i == 0 else int(edges[i]) + 2, int(edges[i + 1]) - (i + 2 < edges.size))
        for i in np.flatnonzero(np.diff(edges) >= shortest).tolist()
    ]


def _parts(energy, stretch, is_first, only_impacts, shortest, width) -> list[tuple[int, int]]:
    """Parts of a stretch in which a decay may be: all of it, or those between soft impacts.

    After another excitation than impacts, that before the first soft impact.
    """
    first, last = stretch
    begins = first
    if is_first:
        begins += _at_rest(energy[first:last], width)
        begins = begins if last - begins >= shortest else first
        if not only_impacts:
            return [(begins, last)]
        impact = after_first_impact(energy[first:last], width)
        begins = begins if impact is None else min(begins, first + impact)
    parts = list(between_soft_impacts(energy, begins, last, width))
    return parts if only_impacts else parts[:1]


def _longest_run(marks) -> int:
    """Length of the longest run of marked samples."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marks, [False]])))
    return int(np.diff(edges)[::2].max(initial=0))


def _begins_high(energy):
    """Whether the energy at the start is far above the usual one of the second half."""
    start = energy[: max(energy.size // FALL_PARTS, 1)].mean()
    return start > MIN_START_RATIO * np.median(energy[energy.size // 2 :])


def _at_rest(energy, width):
    """Number of samples at the beginning of a record before an impact not found by its errors.

    The least energy of its first cycles is then a tenth of the most in the record, or less, and it
    does not begin with much energy, as a fast decay does.
    """
    rises = int(np.argmax(2 * energy > energy.max()))
    if not rises or MIN_START_RATIO * energy[:width].min() > energy.max():
        return 0
    return rises + width // 2


def _fall_of_decay(energy, impact):
    """Fall in nepers of the energy of a decay; zero if it is neither after an impact nor linear.

    A decay that goes on to the end of a stretch has most of the energy above its least. Noise that
    lasts long after a decay holds much energy, too, but as much below its level as above it. What
    holds most energy after an impact may be one beat of close modes, which does not fall.
    """
    whole = np.cumsum(energy - np.quantile(energy, NOISE_QUANTILE))
    lengths = [_length(energy, CORE), int(np.argmax(whole >= CORE * whole.max())) + 1]
    if impact:
        lengths.append(_length(energy, WHOLE))
    falls = [_fall(energy[:length]) for length in lengths]
    return max(
        (fall for fall, linearity in falls if impact or linearity > MIN_LINEARITY), default=0
    )


def _until_noise(energy):
    """Number of samples that hold nearly all energy above the least, without a long rest of noise.

    The level of noise is the usual energy of the second half, if that is all noise. Weak modes may
    last longer than the part with most of the energy above it.
    """
    above = np.cumsum(energy - np.median(energy[energy.size // 2 :]))
    core = int(np.argmax(above >= CORE * above.max())) + 1
    return min(_length(energy, WHOLE), CORES_BEFORE_NOISE * core)


def _length(energy, fraction):
    """Number of samples that hold a fraction of the energy above its least."""
    total = np.cumsum(energy - energy.min())
    return int(np.searchsorted(total, fraction * total[-1])) + 1


def _fall(energy):
    """Fall of the logarithm of the energy along its straight line, and how linear it is."""
    parts = np.array_split(energy, FALL_PARTS)
    level = np.log([part.mean() + 1e-300 for part in parts if part.size])
    if level.size < 3:
        return 0.0, 0.0
    across = np.linspace(-1, 1, level.size)
    slope, middle = np.polyfit(across, level, 1)
    misfit = np.var(level - middle - slope * across)
    return float(-2 * slope), float(1 - misfit / max(np.var(level), 1e-300))


def stacked(
    records: tuple[Float[np.ndarray, "time channel"], ...], decays: tuple[Stretch, ...]
) -> tuple[Float[np.ndarray, "sample column"], tuple[Stretch, ...]]:
    """Decays of one length stacked as columns: channels of the first, then of the second, ...

    The common length is the median; decays of less than half of it are left out, and those between
    shorten it. One long decay is taken alone where it has a hundred times the information. Of more
    than 24 columns in all, the principal combinations of the decays are returned: weighted sums, of
    orthonormal weights, that hold most energy. They have the poles and shapes of the decays, and as
    much noise as one of them.
    """
    lengths = np.array([one.stop - one.start for one in decays])
    used = tuple(
        one for one, length in zip(decays, lengths, strict=True) if 2 * length >= np.median(lengths)
    )
    length = min(int(np.median(lengths)), min(one.stop - one.start for one in used))
    each = _information(records, decays)
    longest = int(np.argmax([one[-1] for one in each]))
    together = sum(one[length - 1] for one in each if one.size >= length)
    if together < LEAST_STACKED_INFORMATION * each[longest][-1]:
        used, length = (decays[longest],), int(lengths[longest])
    parts = np.stack([records[one.record][one.start : one.start + length] for one in used])
    most = max(MAX_COLUMNS // records[0].shape[1], 1)
    if len(used) > most:
        flat = parts.reshape(len(used), -1)
        weights = np.linalg.svd(flat, full_matrices=False)[0].T[:most]
        weights = weights * np.where(weights.sum(axis=1) < 0, -1.0, 1.0)[:, None]
        parts = (weights @ flat).reshape(-1, *parts.shape[1:])
    return np.hstack(list(parts)), used


def _information(records, decays) -> list[Float[np.ndarray, " sample"]]:
    """Information on the poles in each decay to each sample: the sum of t^2 times the energy.

    The energy is that above the noise, the least of the last parts of decays, each channel relative
    to its own.
    """
    size = np.maximum(sum(np.sum(one**2, axis=0) for one in records), 1e-300)
    parts = [records[one.record][one.start : one.stop] for one in decays]
    energies = [np.sum(part**2 / size, axis=1) for part in parts]
    noise = min(np.mean(one[-max(one.size // FALL_PARTS, 1) :]) for one in energies)
    return [np.cumsum(np.arange(one.size) ** 2 * (one - noise)) for one in energies]


MIN_DECAY_ENERGY = 0.3  # fraction of the energy of a log in its decays, if they represent it
LONG_FALL_NEPERS = 1.5  # or fall of the energy; 95 % of that of an exponential falls by 3
MIN_START_LEVEL = 0.2  # energy at the start of such a decay over the mean energy of the log


def dominate(
    decays: tuple[Stretch, ...],
    excited: tuple[Bool[np.ndarray, " time"], ...],
    records: tuple[Float[np.ndarray, "sample channel"], ...],
    ratio: float,
    cycle: float,
) -> bool:
    """Whether decays represent a log: hold much of its energy, fall far, or follow a load.

    `excited` are samples of the log, `ratio` those of `records` over these; `cycle` is that of the
    strongest vibration in samples of `records`. A decay that begins far below the level of the log,
    long after impacts, lacks the modes that have decayed by then; one that begins where a lasting
    excitation ends has them all, however much stronger the excitation was and however far it falls.
    """
    inside = sum(
        np.sum(records[d.record][int(d.start * ratio) : int(d.stop * ratio)] ** 2) for d in decays
    )
    whole = sum(np.sum(record**2) for record in records)
    level = whole / sum(map(len, records))
    longest = max(decays, key=lambda d: d.fall)
    start = int(np.ceil(longest.start * ratio))
    first = records[longest.record][start : start + int(2 * cycle) + 1]
    begins = np.sum(first**2) / len(first) > MIN_START_LEVEL * level
    falls = begins and longest.fall > LONG_FALL_NEPERS
    has_followed = follows(longest, excited[longest.record], cycle / ratio)
    return bool(inside > MIN_DECAY_ENERGY * whole or falls or has_followed)


def after_soft_impacts(
    decays: tuple[Stretch, ...], excited: tuple[Bool[np.ndarray, " time"], ...]
) -> bool:
    """Whether there are several decays in records in which no excitation was found."""
    return len(decays) > len(excited) and not any(marks.any() for marks in excited)


def follows(decay: Stretch, excited: Bool[np.ndarray, " time"], cycle: float) -> bool:
    """Whether a decay begins where the structure was excited for five cycles or more.

    `cycle` is that of the strongest vibration in samples of the log, as are `excited` ones.
    """
    before = excited[: max(decay.start - 2, 0)][-int(MIN_DECAY_CYCLES * cycle) :]
    return bool(before.size and before.all())


def after_impact(decay: Stretch, excited: Bool[np.ndarray, " time"], cycle: float) -> bool:
    """Whether a decay begins right after an impact, not after a lasting excitation.

    `cycle` is that of the strongest vibration in samples of the log, as are `excited` ones.
    """
    before = excited[max(decay.start - CONTACT_SAMPLES, 0) : decay.start]
    return bool(before.any()) and not follows(decay, excited, cycle)
