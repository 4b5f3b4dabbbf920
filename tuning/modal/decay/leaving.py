"""Decays during which the structure is still excited, found by the residuals of their fit.

A load that excites little while it leaves shows in the fit: it explains forces by several modes
where there is one, or by vibrations that grow; of several decays it leaves more of those in which
forces act.

Impacts are samples that cannot be predicted; decays follow the hardest of them.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from tuning.modal.ambient import Candidate
from tuning.modal.decay.stretches import MIN_DECAY_CYCLES, Stretch
from tuning.modal.preprocessing import Samples, prepare
from tuning.modal.result import mac_matrix

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
