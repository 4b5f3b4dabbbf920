"""What the decays of a log tell: in a band, in a narrower one, above it, and of whole records."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from tuning.modal.ambient import Candidate, without_duplicates
from tuning.modal.decay.candidates import NONLINEARITY
from tuning.modal.decay.modes import Decays, band_of_ends, excited, free_decay_modes
from tuning.modal.forced.instants import marked_blows
from tuning.modal.forced.struck import WEAK, alike, struck_modes
from tuning.modal.preprocessing import HALF_POWER, kinetic_band
from tuning.modal.result import is_at_edge
from tuning.modal.samples import Samples
from tuning.modal.stabilisation import Diagram

Band = tuple[float, float]
Struck = tuple[Bool[np.ndarray, " time"], ...]


class FromDecays(NamedTuple):
    """Candidates, diagrams, decays, the band (Hz) used, and how many blows were used together."""

    candidates: tuple[Candidate, ...]
    diagrams: tuple[Diagram, ...]
    decays: Decays
    band: Band
    blows: int = 0


def modes_of_decays(
    samples: Samples,
    struck: Struck,
    derivatives: tuple[int, ...],
    bands: tuple[Band, Band],
    may_narrow: bool,
    how: dict,
) -> FromDecays | None:
    """Modes of the decays of a log in two bands (Hz), the latter as wide or wider; None without.

    `struck` are samples excited in the former, `derivatives` the orders of the channels as time
    derivatives, `how` what else `free_decay_modes` takes. A decay is sought in a narrower band,
    too, if it `may_narrow`: it drowns sooner in the noise of a wide one.
    """
    band, wide = bands
    found = _in_band(samples, struck, derivatives, band, may_narrow, how)
    if found is None:
        return None
    if wide != band:
        more = free_decay_modes(samples, struck, derivatives, wide, **how)
        found = _with_others(found, more, wide)
    return _with_blows(found, samples, struck, wide)


def _in_band(samples, struck, derivatives, band, may_narrow, how) -> FromDecays | None:
    found = free_decay_modes(samples, struck, derivatives, band, **how)
    if found is None and may_narrow:
        lower = kinetic_band(samples.records, samples.rate, derivatives, HALF_POWER)
        others = dict.fromkeys((lower, band_of_ends(samples, derivatives, lower)))
        for narrower in (one for one in others if one != band):
            marks = excited(samples, derivatives, narrower)
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


def _with_blows(found: FromDecays, samples: Samples, struck: Struck, band: Band) -> FromDecays:
    """Modes of decays, with those of whole records if blows are all that excites them.

    Whole records must tell of all strong modes of the decays, too.
    """
    good = [one.mode for one in found.candidates if not one.reason]
    poles = np.array([mode.pole for mode in good], complex)
    blows = marked_blows(struck, samples.rate, band)
    whole = struck_modes(samples.records, samples.rate, band, blows, poles)
    if whole is None:
        return found
    strong = [
        mode for mode in good if mode.energy_share > WEAK and not is_at_edge(mode, whole.band)
    ]
    if not all(any(alike(mode, other) for other in whole.modes) for mode in strong):
        return found
    added = [one.mode for one in found.candidates if one.reason.startswith(NONLINEARITY)]
    modes = [mode for mode in whole.modes if not any(alike(mode, one) for one in added)]
    others = [
        one
        for one in found.candidates
        if one.reason.startswith(NONLINEARITY) or not any(alike(one.mode, mode) for mode in modes)
    ]
    candidates = [*(Candidate(mode, "", 1) for mode in modes), *others]
    return found._replace(
        candidates=tuple(sorted(candidates, key=lambda one: one.mode.frequency)),
        band=band,
        blows=len(whole.blows),
    )
