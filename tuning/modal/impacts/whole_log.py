"""What the decays of a log tell: in a band, in a narrower one, above it, and of whole records."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from tuning.modal.ambient import Candidate, without_duplicates
from tuning.modal.decay.fit import NONLINEARITY
from tuning.modal.decay.modes import (
    Decays,
    band_of_ends,
    find_excited,
    follow_impacts,
    free_decay_modes,
)
from tuning.modal.decay.stretches import MIN_DECAY_CYCLES, Stretch
from tuning.modal.impacts.impact_records import (
    AFTER_IMPACTS,
    AFTER_UNSEEN_IMPACTS,
    FROM_AMBIENT,
    MIN_IMPACTS,
    WEAK,
    Impact,
    Search,
    alike,
    impact_modes,
    marked_impacts,
)
from tuning.modal.preprocessing import HALF_POWER, Samples, kinetic_band, prepare
from tuning.modal.result import is_at_edge
from tuning.modal.stabilisation import Diagram

AFTER_CYCLES = 2.0  # of the lowest frequency, in which an impact's energy is compared

Band = tuple[float, float]
Excited = tuple[Bool[np.ndarray, " time"], ...]


class FromDecays(NamedTuple):
    """Candidates, diagrams, decays, the band (Hz) used, and how many impacts were used together."""

    candidates: tuple[Candidate, ...]
    diagrams: tuple[Diagram, ...]
    decays: Decays
    band: Band
    impacts: int = 0


def modes_of_decays(
    samples: Samples,
    excited: Excited,
    derivatives: tuple[int, ...],
    bands: tuple[Band, Band],
    may_narrow: bool,
    how: dict,
) -> FromDecays | None:
    """Modes of the decays of a log in two bands (Hz), the latter as wide or wider; None without.

    `excited` are samples excited in the former, `derivatives` the orders of the channels as time
    derivatives, `how` what else `free_decay_modes` takes. A decay is sought in a narrower band,
    too, if it `may_narrow`: it drowns sooner in the noise of a wide one.
    """
    band, wide = bands
    found = _in_band(samples, excited, derivatives, band, may_narrow, how)
    if found is None:
        return None
    if all(one.from_rest for one in found.decays.stretches):
        return found
    if wide != band:
        more = free_decay_modes(samples, excited, derivatives, wide, **how)
        found = _with_others(found, more, wide)
    return _with_impacts(found, samples, excited, wide)


def _in_band(samples, excited, derivatives, band, may_narrow, how) -> FromDecays | None:
    if may_narrow and follow_impacts(samples, excited, derivatives, band):
        # Contacts and rattling parts have most of the velocities above what the structure moves.
        displacements = tuple(order + 1 for order in derivatives)
        narrower = kinetic_band(samples.records, samples.rate, displacements)
        marks = find_excited(samples, derivatives, narrower)
        told = free_decay_modes(samples, marks, derivatives, narrower, **how)
        if told is not None:
            return FromDecays(*told, narrower)
    found = free_decay_modes(samples, excited, derivatives, band, **how)
    if found is None and may_narrow:
        lower = kinetic_band(samples.records, samples.rate, derivatives, HALF_POWER)
        others = dict.fromkeys((lower, band_of_ends(samples, derivatives, lower)))
        for narrower in (one for one in others if one != band):
            marks = find_excited(samples, derivatives, narrower)
            found = free_decay_modes(samples, marks, derivatives, narrower, **how)
            if found is not None:
                return FromDecays(*found, narrower)
    return None if found is None else FromDecays(*found, band)


def _with_others(found: FromDecays, more, wide: Band) -> FromDecays:
    """Modes of decays in a band, with those (`more`) of a wider one outside it.

    In the wider band alone, what decays fast would end decays before slow modes are certain.
    """
    others = [
        one
        for one in (more[0] if more else ())
        if not one.reason and is_at_edge(one.mode, found.band)
    ]
    if not others:
        return found
    return found._replace(candidates=without_duplicates([*found.candidates, *others]), band=wide)


def _with_impacts(found: FromDecays, samples: Samples, excited: Excited, band: Band) -> FromDecays:
    """Modes of decays, with those of whole records if impacts are all that excites them."""
    seen = marked_impacts(excited, samples.rate, band)
    poles = [one.mode.pole for one in found.candidates if not one.reason]
    search = AFTER_IMPACTS if len(seen) >= MIN_IMPACTS else AFTER_UNSEEN_IMPACTS
    told = _of_whole_records(found.candidates, samples, band, seen, poles, search)
    if told is None:
        return found
    return found._replace(candidates=told[0], band=band, impacts=told[1])


def modes_after_unseen_impacts(
    candidates: tuple[Candidate, ...], samples: Samples, excited: Excited, band: Band
) -> tuple[tuple[Candidate, ...], int] | None:
    """Candidates of whole records, and the number of impacts, of a log without clear decays.

    Lightly damped structures may hardly fall from one impact to the next, which looks like ambient
    vibration, of which some candidates are given. None if impacts are not all that excites.
    """
    poles = [
        one.mode.pole
        for one in candidates
        if one.mode.damping_ratio > 0 and (not one.reason or one.mode.energy_share > WEAK)
    ]
    if not poles:
        return None
    seen = marked_impacts(excited, samples.rate, band)
    return _of_whole_records(candidates, samples, band, seen, poles, FROM_AMBIENT)


def _of_whole_records(candidates, samples: Samples, band, seen, poles, search: Search):
    """Candidates of whole records, and the number of impacts, if these are all that excites them.

    Whole records must tell of all strong modes among some candidates, too; others of these, and
    what they know as nonlinearity, are kept.
    """
    starts = np.array(poles, complex)
    whole = impact_modes(samples.records, samples.rate, band, seen, starts, search)
    if whole is None:
        return None
    strong = [
        one.mode
        for one in candidates
        if not one.reason and one.mode.energy_share > WEAK and not is_at_edge(one.mode, whole.band)
    ]
    if not all(any(alike(mode, other) for other in whole.modes) for mode in strong):
        return None
    added = [one.mode for one in candidates if one.reason.startswith(NONLINEARITY)]
    modes = [mode for mode in whole.modes if not any(alike(mode, one) for one in added)]
    others = [
        one
        for one in candidates
        if one.reason.startswith(NONLINEARITY) or not any(alike(one.mode, mode) for mode in modes)
    ]
    every = [*(Candidate(mode, "", 1) for mode in modes), *others]
    return tuple(sorted(every, key=lambda one: one.mode.frequency)), len(whole.impacts)


def impacts_left_out(
    samples: Samples, excited: Excited, decays: Sequence[Stretch], band: Band
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
    why = "what follows it is not the free decay that tells most"
    if wait * band[0] < MIN_DECAY_CYCLES:
        why = f"the next impact comes {wait:.3g} s later"
    return [f"the hardest impact, at {start:.4g} s, is left out: {why}"]
