"""Modes of all free decays of a log, fitted together."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import butter, detrend, sosfiltfilt

from tuning.modal.ambient import (
    Candidate,
    divided_band,
    overlapping,
    subspace_modes,
    without_duplicates,
)
from tuning.modal.decay.excitation import PARTS, free_end, without_excitation
from tuning.modal.decay.fit import (
    DecayFit,
    decay_candidates,
    fit_decay,
    information_of_modes,
    share_of_modes,
)
from tuning.modal.decay.stretches import (
    Stretch,
    after_impact,
    after_soft_impacts,
    dominate,
    excited_samples,
    free_decays,
    or_most_informative,
    stacked,
    until_soft_impact,
)
from tuning.modal.preprocessing import (
    HALF_POWER,
    MIN_SAMPLES,
    Samples,
    kinetic_band,
    prepare,
    strongest_frequency,
)
from tuning.modal.result import is_at_edge
from tuning.modal.subspace import Diagram

MAX_RESIDUAL_ENERGY = 0.25  # fraction of the energy that the modes of a free decay do not explain
MIN_ENERGY_OF_MODES = 0.5  # of the energy at the beginning of decays
MIN_LEVEL_AT_START = 3.0  # energy of the first part of such a decay over the mean
SHORTER_PARTS = 0.6, 0.35  # of an impact's decay, which may have more information than all of it
MAX_CUTS = 3  # of a decay in which the structure is found to be excited
MAX_RESIDUAL_OF_WINDOW = 0.05  # the same for a window that the user gives and that falls little
# The same after impacts that only the energy shows: those of three planted logs left 0.003 at most,
# falls of the energy in fifteen short records of ambient vibration 0.01 at least.
MAX_RESIDUAL_AFTER_SOFT_IMPACTS = 0.007


class Decays(NamedTuple):
    """Decays that were fitted, and the first of them, measured and fitted, in the band."""

    stretches: tuple[Stretch, ...]
    measured: Float[np.ndarray, "sample channel"]
    fitted: Float[np.ndarray, "sample channel"]


class DecayModes(NamedTuple):
    """Candidates, diagrams, the decays of which they are, and the band (Hz) used."""

    candidates: tuple[Candidate, ...]
    diagrams: tuple[Diagram, ...]
    decays: Decays
    band: tuple[float, float]


def modes_of_decays(
    samples: Samples,
    excited: tuple[Bool[np.ndarray, " time"], ...],
    derivatives: tuple[int, ...],
    bands: tuple[tuple[float, float], tuple[float, float]],
    may_narrow: bool,
    how: dict,
) -> DecayModes | None:
    """Modes of the free decays of a log in two bands (Hz), the second as wide or wider; or None.

    `excited` are samples excited in the first, `derivatives` the orders of the channels as time
    derivatives, `how` further arguments of `free_decay_modes`. A decay is also sought in a narrower
    band if it `may_narrow`: in a wide one it reaches the noise sooner. None without decays.
    """
    band, wide = bands
    found = _in_band(samples, excited, derivatives, band, may_narrow, how)
    if found is None:
        return None
    if wide == band or all(one.from_rest for one in found.decays.stretches):
        return found
    more = free_decay_modes(samples, excited, derivatives, wide, **how)
    return _with_others(found, more, wide)


def _in_band(samples, excited, derivatives, band, may_narrow, how) -> DecayModes | None:
    if may_narrow and follow_impacts(samples, excited, derivatives, band):
        # Contacts and rattling parts have most of the velocities above what the structure moves.
        displacements = tuple(order + 1 for order in derivatives)
        narrower = kinetic_band(samples.records, samples.rate, displacements)
        marks = find_excited(samples, derivatives, narrower)
        found = free_decay_modes(samples, marks, derivatives, narrower, **how)
        if found is not None:
            return DecayModes(*found, narrower)
    found = free_decay_modes(samples, excited, derivatives, band, **how)
    if found is None and may_narrow:
        lower = kinetic_band(samples.records, samples.rate, derivatives, HALF_POWER)
        others = dict.fromkeys((lower, band_of_ends(samples, derivatives, lower)))
        for narrower in (one for one in others if one != band):
            marks = find_excited(samples, derivatives, narrower)
            found = free_decay_modes(samples, marks, derivatives, narrower, **how)
            if found is not None:
                return DecayModes(*found, narrower)
    return None if found is None else DecayModes(*found, band)


def _with_others(found: DecayModes, more, wide: tuple[float, float]) -> DecayModes:
    """Modes of decays in a band, and those of a wider band (`more`) outside it.

    In the wider band alone, modes that decay fast would end decays before slow modes are certain.
    """
    others = [
        one
        for one in (more[0] if more else ())
        if not one.reason and is_at_edge(one.mode, found.band)
    ]
    if not others:
        return found
    return found._replace(candidates=without_duplicates([*found.candidates, *others]), band=wide)


def find_excited(
    samples: Samples, derivatives: tuple[int, ...], band: tuple[float, float]
) -> tuple[Bool[np.ndarray, " time"], ...]:
    """Samples of each record at which the structure is excited, at the rate of the log.

    These are impacts, and all samples before a crossing load has left (`free_end`).

    Below half the band (Hz) drift is removed; above it all frequencies count.
    """
    prepared = prepare(samples.records, samples.starts, samples.rate, band)
    frequency = strongest_frequency(prepared.records, prepared.rate, derivatives, band)
    sos = butter(2, band[0] / 2, "highpass", fs=samples.rate, output="sos")
    narrow = band_of_ends(samples, derivatives, band)
    ends = prepare(samples.records, samples.starts, samples.rate, narrow)
    cycle = ends.rate / strongest_frequency(ends.records, ends.rate, derivatives, narrow)
    independent = min(2 * (narrow[1] - narrow[0]) / ends.rate, 1.0)
    found = []
    for record, end in zip(samples.records, ends.records, strict=True):
        values = sosfiltfilt(sos, detrend(record, axis=0), axis=0)
        marks = excited_samples(values, samples.rate, 1 / frequency)
        last = int(np.flatnonzero(marks)[-1] * len(end) / marks.size) + 1 if marks.any() else 0
        start = free_end(end, cycle, independent, last)
        if start is not None:
            # Decays before it, between impacts, are distinguished from others by their errors.
            decayed = until_soft_impact(end[last:start], max(int(2 * cycle), 4)) if last else 0
            first = last + (decayed if decayed < start - last else 0)
            places = np.arange(marks.size) * len(end) / marks.size
            marks = marks | ((places >= first) & (places < start))
        found.append(marks)
    return tuple(found)


def band_of_ends(
    samples: Samples, derivatives: tuple[int, ...], band: tuple[float, float]
) -> tuple[float, float]:
    """Band (Hz), within another, of the resonances in the second halves of records.

    While a load crosses, it may excite higher frequencies than those of the free vibration after.
    """
    halves = tuple(record[len(record) // 2 :] for record in samples.records)
    low, high = kinetic_band(halves, samples.rate, derivatives, HALF_POWER)
    low, high = max(low, band[0]), min(high, band[1])
    return (low, high) if low < high else band


def follow_impacts(
    samples: Samples,
    excited: tuple[Bool[np.ndarray, " time"], ...],
    derivatives: tuple[int, ...],
    band: tuple[float, float],
) -> bool:
    """Whether the free decays in a band are those right after impacts."""
    decays = _decays_in_band(samples, excited, derivatives, band)[2]
    return bool(decays) and all(one.from_rest for one in decays)


def _decays_in_band(samples: Samples, excited, derivatives, band):
    """The records prepared for a band, the strongest frequency (Hz), and the free decays."""
    prepared = prepare(samples.records, samples.starts, samples.rate, band)
    frequency = strongest_frequency(prepared.records, prepared.rate, derivatives, band)
    return prepared, frequency, free_decays(excited, prepared.records, prepared.rate, frequency)


def free_decay_modes(
    samples: Samples,
    excited: tuple[Bool[np.ndarray, " time"], ...],
    derivatives: tuple[int, ...],
    band: tuple[float, float],
    *,
    kind: str | None = None,
    whole: bool = False,
    order: int | None = None,
) -> tuple[tuple[Candidate, ...], tuple[Diagram, ...], Decays] | None:
    """Modes of the free decays between excited samples; None without decays that represent the log.

    `derivatives` are the orders of the channels as time derivatives. A log without a decay is one
    decay as a whole if it is declared one (`kind`) or may be one (`whole`, of a window that the
    user gives).
    """
    prepared, frequency, decays = _decays_in_band(samples, excited, derivatives, band)
    given = not decays and (kind == "free decay" or whole)
    if given:
        decays = tuple(Stretch(i, 0, len(r), 0.0) for i, r in enumerate(samples.records))
    ratio = prepared.rate / samples.rate
    if not decays or not (
        kind
        or given
        or dominate(decays, excited, prepared.records, ratio, prepared.rate / frequency)
    ):
        return None
    cycle = samples.rate / frequency
    one = _fitted(decays, samples, derivatives, band, order)
    if one is None:
        return None
    if all(one.from_rest for one in decays):
        return _of_fit(_of_best_length(one, samples, derivatives, band, order), samples)

    hit = tuple(one for one in decays if after_impact(one, excited[one.record], cycle))

    def rest_of(fitted: _Fitted) -> tuple[Stretch, ...]:
        rest = _rest(fitted, samples, excited, band, cycle)
        return or_most_informative(rest, hit, prepared.records, ratio, prepared.rate / frequency)

    for _ in range(MAX_CUTS):
        rest = one.used if given else rest_of(one)
        if rest == one.used:
            break
        one = _fitted(rest, samples, derivatives, band, order)
        if one is None:
            return None
    else:
        if kind is None and rest_of(one) != one.used:
            return None
    if given or after_soft_impacts(decays, excited):
        most = MAX_RESIDUAL_OF_WINDOW if given else MAX_RESIDUAL_AFTER_SOFT_IMPACTS
        explained = _unexplained(one.measured, one.fitted) < most
        # In a long record many poles that are no modes explain ambient vibration as well.
        explained = explained and (given or _has_few_others(one.candidates))
    else:
        explained = _unexplained_of_decay(one.measured, one.fitted) < MAX_RESIDUAL_ENERGY
    damped = one.share_of_modes > MIN_ENERGY_OF_MODES
    if kind is None and not (damped and explained):
        return None
    return _of_fit(one, samples)


class _Fitted(NamedTuple):
    """Joint fit of decays of one length (s), in each part of a band and in all of it."""

    used: tuple[Stretch, ...]
    duration: float
    candidates: tuple[Candidate, ...]
    fits: list[tuple[tuple[float, float], DecayFit]]
    diagrams: tuple[Diagram, ...]
    measured: Float[np.ndarray, "sample column"]
    fitted: Float[np.ndarray, "sample column"]

    @property
    def share_of_modes(self) -> float:
        """Fraction of the energy at the beginning that the modes have."""
        return share_of_modes(self.candidates, self.fits, self.duration)


def _of_fit(one: _Fitted, samples: Samples):
    """Candidates, diagrams and decays of a fit."""
    channels = samples.records[0].shape[1]
    first = Decays(one.used, one.measured[:, :channels], one.fitted[:, :channels])
    return one.candidates, one.diagrams, first


def _of_best_length(whole: _Fitted, samples: Samples, derivatives, band, order) -> _Fitted:
    """The fit of an impact's decay, or of its first part if that has more information on modes.

    Unsteady noise and frequencies that depend on amplitude may make the later parts of a decay
    worse than none.
    """
    length, fits = len(whole.measured), [whole]
    for fraction in SHORTER_PARTS:
        part = tuple(one._replace(stop=one.start + int(fraction * length)) for one in whole.used)
        fits.append(_fitted(part, samples, derivatives, band, order) or whole)
    return max(fits, key=lambda one: information_of_modes(one.candidates))


def _fitted(decays, samples: Samples, derivatives, band, order) -> _Fitted | None:
    """Fits of decays; None if they are too short."""
    windows, used = stacked(samples.records, decays)
    if len(windows) < MIN_SAMPLES // 2:
        return None
    channels = samples.records[0].shape[1]
    pieces = tuple(windows[:, i : i + channels] for i in range(0, windows.shape[1], channels))
    starts = tuple(one.start / samples.rate for one in used)
    candidates, diagrams = subspace_modes(
        pieces, starts, samples.rate, band, order=order, refine=False
    )
    poles = np.array([candidate.mode.pole for candidate in candidates], complex)
    fits = [
        (part, fit)
        for part in divided_band(band)
        if (fit := fit_decay(windows, samples.rate, overlapping(part, band), channels, poles))
    ]
    if not fits:
        return None
    measured, fitted = (
        np.sum([_within(getattr(fit, name), samples.rate, part) for part, fit in fits], axis=0)
        for name in ("measured", "fitted")
    )
    duration = len(windows) / samples.rate
    is_free = all(one.from_rest for one in used)
    found = decay_candidates(fits, len(used), derivatives, duration, band, is_free)
    return _Fitted(used, duration, found, fits, diagrams, measured, fitted)


def _has_few_others(candidates: tuple[Candidate, ...]) -> bool:
    """Whether the rejected candidates are not more than the modes."""
    rejected = sum(bool(one.reason) for one in candidates)
    return 2 * rejected <= len(candidates)


def _rest(one: _Fitted, samples: Samples, excited, band, cycle) -> tuple[Stretch, ...]:
    """Fitted decays, or the parts of them, during which nothing excites the structure."""
    return without_excitation(
        one.used,
        one.measured,
        one.fitted,
        one.candidates,
        channels=samples.records[0].shape[1],
        rate=samples.rate,
        after_impact=after_impact(one.used[0], excited[one.used[0].record], cycle),
    )


def _unexplained(measured, fitted) -> float:
    """Fraction of the energy of decays that their fit does not explain."""
    return float(np.sum((measured - fitted) ** 2) / max(np.sum(measured**2), 1e-300))


def _unexplained_of_decay(measured, fitted) -> float:
    """`_unexplained` of a decay, or of its beginning if most of its energy is there.

    The rest of a long window may be mostly noise.
    """
    first = max(len(measured) // PARTS, 1)
    whole = _unexplained(measured, fitted)
    if np.mean(measured[:first] ** 2) < MIN_LEVEL_AT_START * np.mean(measured**2):
        return whole
    return min(whole, _unexplained(measured[:first], fitted[:first]))


def _within(values, rate, part):
    """Samples of the bins of a part of the band."""
    transform = np.fft.rfft(values, axis=0)
    bins = np.fft.rfftfreq(len(values), 1 / rate)
    transform[(bins < part[0]) | (bins >= part[1])] = 0.0
    return np.fft.irfft(transform, len(values), axis=0)
