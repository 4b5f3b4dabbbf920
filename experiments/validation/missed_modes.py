"""Rows of a table of strong planted modes that were missed: whether any method could find them.

Written by `planted_modes`, beside its table. The least 95 % intervals are those of an unbiased
method that knows the noise, the number of modes, and more (`least_errors`); what pyOMA-2 finds
stable within 2 % of the mode, given its frequency, is in the last column: it may be a harmonic.
"""

import numpy as np

from experiments.validation import measured_forces, modal_identification
from experiments.validation.least_errors import (
    QUANTILE,
    LeastErrors,
    expected_gain,
    least_errors,
    least_errors_of_decays,
    least_errors_of_forced,
    why_unidentifiable,
)
from experiments.validation.modal_identification import PlantedComparison
from experiments.validation.modal_methods import pyoma
from tests.oracles.planted_structures import Planted, random_structure, sampled

HEADER = (
    "excitation", "structure", "frequency", "damping ratio", "energy", "least error of frequency",
    "of damping ratio", "why the log does not tell it", "stable in pyOMA-2, SSI-COV",
)  # fmt: skip
RANDOM = ("ambient", "motor", "shaken")


def missed_rows(kind: str, words: str, seed: int, found: PlantedComparison) -> list[tuple]:
    """A row for each strong mode of a structure that was missed; `words` name the excitation."""
    if not found.missed:
        return []
    planted, errors, duration = _planted(kind, seed)
    theirs = pyoma(planted).errors
    structure, rows = planted.structure, []
    for frequency in found.missed:
        mode = int(np.argmin(np.abs(structure.frequencies - frequency)))
        gain = np.inf
        if kind in RANDOM:
            gain = expected_gain(planted, mode, duration, kind == "shaken")
        reason = why_unidentifiable(planted, mode, errors, duration, gain)
        least = (
            f"{QUANTILE * errors.frequencies[mode]:.2g} Hz",
            f"{QUANTILE * errors.damping_ratios[mode]:.2g}",
        )
        rows.append(
            (
                words,
                str(seed),
                f"{frequency:.3f} Hz",
                f"{structure.damping_ratios[mode]:.4f}",
                f"{100 * planted.energies[mode]:.0f} %",
                *least,
                reason or "none: a better method could",
                "not found"
                if np.isnan(theirs[mode, 0])
                else f"{frequency * (1 + theirs[mode, 0]):.3f} Hz, "
                f"{structure.damping_ratios[mode] * (1 + theirs[mode, 1]):.4f}",
            )
        )
    return rows


def _planted(kind, seed) -> tuple[Planted, LeastErrors, float]:
    """Planted structure, the least errors under that excitation, and duration (s)."""
    structure = random_structure(seed)
    if kind in measured_forces.EXCITATIONS:
        log, planted = measured_forces.forced_log(structure, kind, seed)
        inputs = log.values.shape[1] - planted.values.shape[1]
        return (
            planted,
            least_errors_of_forced(planted, log.values[:, :inputs]),
            measured_forces.DURATION,
        )
    duration = modal_identification.DURATIONS[kind]
    planted = sampled(structure, kind, seed, duration)
    if kind in RANDOM:
        return planted, least_errors(planted, duration, kind == "shaken"), duration
    return planted, least_errors_of_decays(planted), duration
