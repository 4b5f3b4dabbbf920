"""Table of what is found of planted structures, for each kind of excitation, unknown or measured.

    python -m experiments.validation.planted_modes 30
    python -m experiments.validation.planted_modes 30 crossing shaken

Thirty random structures by finite elements for each kind, the same as in `modal_identification`,
with other seeds than those from which rules were chosen. The table is written for the page on logs;
it takes half an hour on one core. A second table lists the strong modes that were missed, and
whether any method could find them: the least 95 % intervals are those of an unbiased method that
knows the noise, the number of modes, and more (`least_errors`); what pyOMA-2 finds stable within
2 % of the mode, given its frequency, is in the last column: it may be a harmonic.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.validation.least_errors import (
    QUANTILE,
    LeastErrors,
    expected_gain,
    least_errors,
    least_errors_of_decays,
    least_errors_of_forced,
    why_unidentifiable,
)
from experiments.validation.modal_identification import (
    DURATIONS,
    FIRST_SEED,
    FORCED,
    WORDS,
    PlantedComparison,
    assess,
    planted_log,
)
from experiments.validation.modal_methods import pyoma
from jaxbeam.files.report import ReportTable
from jaxbeam.runtime.printer import markdown_table
from tests.oracles.planted_structures import Planted

TABLE_FILE = Path(__file__).parents[2] / "docs" / "_static" / "planted_modes.md"
MISSED_FILE = TABLE_FILE.with_name("planted_missed.md")
HEADER = (
    "excitation", "strong modes found", "modes found", "95 % intervals that hold the frequency",
    "the damping ratio", "false modes", "error of frequency, median", "90 %",
    "error of damping ratio, median", "90 %",
)  # fmt: skip
MISSED_HEADER = (
    "excitation", "structure", "frequency", "damping ratio", "energy", "least error of frequency",
    "of damping ratio", "why the log does not tell it", "stable in pyOMA-2, SSI-COV",
)  # fmt: skip
RANDOM = ("ambient", "motor", "shaken")


def row(excitation: str, found: Sequence[PlantedComparison]) -> tuple[str, ...]:
    """Row of the table for the comparisons of one kind of excitation."""
    covered = np.concatenate([one.covered for one in found])
    errors = np.abs(np.concatenate([one.errors for one in found]))
    strong = [seen for one in found for seen in one.found]
    quantiles = np.quantile(errors, [0.5, 0.9], axis=0)
    return (
        WORDS[excitation],
        f"{sum(strong)} of {len(strong)}",
        str(len(covered)),
        *(f"{100 * share:.0f} %" for share in covered.mean(axis=0)),
        str(sum(len(one.false_modes) for one in found)),
        *(f"{100 * value:.2g} %" for value in quantiles[:, 0]),
        *(f"{100 * value:.3g} %" for value in quantiles[:, 1]),
    )


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
    (log, planted), duration = planted_log(kind, seed), DURATIONS[kind]
    if kind in FORCED:
        inputs = log.values.shape[1] - planted.values.shape[1]
        return planted, least_errors_of_forced(planted, log.values[:, :inputs]), duration
    if kind in RANDOM:
        return planted, least_errors(planted, duration, kind == "shaken"), duration
    return planted, least_errors_of_decays(planted), duration


def table(
    count: int, kinds: Sequence[str] = tuple(WORDS)
) -> tuple[ReportTable, list[tuple[str, ...]]]:
    """Rows for some kinds of excitation, of so many structures each, and rows of missed modes."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    rows, missed = [], []
    for kind in kinds:
        found = assess(kind, seeds)
        rows.append(row(kind, found))
        for seed, one in zip(seeds, found, strict=True):
            missed += missed_rows(kind, WORDS[kind], seed, one)
        print(" | ".join(rows[-1]), flush=True)
    return ReportTable(HEADER, rows), missed


def _written(path: Path, header, rows, kinds) -> None:
    """Write a table with new rows for some kinds; those of others stay."""
    old = path.read_text(encoding="utf-8").splitlines()[2:] if path.exists() else []
    words = [WORDS[kind] for kind in kinds]
    kept = [line for line in old if line.split(" | ")[0].removeprefix("| ") not in words]
    head, ruler, *new, _ = markdown_table(header, rows)
    order = list(WORDS.values())
    lines = sorted(
        kept + new, key=lambda line: order.index(line.split(" | ")[0].removeprefix("| "))
    )
    path.write_text("\n".join([head, ruler, *lines]) + "\n", encoding="utf-8")


def main(arguments: list[str]) -> None:
    """Write the rows for a number of structures (30), of all kinds or of some; others stay.

    Raises SystemExit for an unknown kind.
    """
    kinds = arguments[1:] or list(WORDS)
    unknown = [kind for kind in kinds if kind not in WORDS]
    if unknown:
        raise SystemExit(f"unknown excitation {unknown[0]!r}; known are {', '.join(WORDS)}")
    result, missed = table(int(arguments[0]) if arguments else 30, kinds)
    _written(TABLE_FILE, result.header, result.rows, kinds)
    _written(MISSED_FILE, MISSED_HEADER, missed, kinds)


if __name__ == "__main__":
    main(sys.argv[1:])
