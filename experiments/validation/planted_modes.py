"""Table of what is found of planted structures, for each kind of excitation, unknown or measured.

    python -m experiments.validation.planted_modes 30
    python -m experiments.validation.planted_modes 30 crossing shaken

Thirty random structures by finite elements for each kind, the same as in `modal_identification` and
`measured_forces`, with other seeds than those from which rules were chosen. The table is written
for the page on logs; it takes half an hour on one core.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.validation import measured_forces, modal_identification
from experiments.validation.modal_identification import PlantedComparison
from jaxbeam.files.report import ReportTable

TABLE_FILE = Path(__file__).parents[2] / "docs" / "_static" / "planted_modes.md"
FIRST_SEED = 930
HEADER = (
    "excitation", "strong modes found", "modes found", "95 % intervals that hold the frequency",
    "the damping ratio", "false modes", "error of frequency, median", "90 %",
    "error of damping ratio, median", "90 %",
)  # fmt: skip
WORDS = {
    "ambient": "ambient",
    "motor": "ambient, and a motor with its harmonic",
    "shaken": "shaker with four harmonics, unmeasured",
    "blows": "blows, unmeasured",
    "decay": "one free decay",
    "crossing": "load that crosses and leaves",
    "1 blow": "one blow, measured",
    "3 blows": "three blows, measured",
    "10 blows": "ten blows, measured",
    "random force": "random force, measured",
    "two random forces": "two random forces, measured",
}


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


def table(count: int, kinds: Sequence[str] = tuple(WORDS)) -> ReportTable:
    """Rows for some kinds of excitation, of so many structures each."""
    seeds = range(FIRST_SEED, FIRST_SEED + count)
    rows = []
    for kind in kinds:
        forced = kind in measured_forces.EXCITATIONS
        assess = measured_forces.assess if forced else modal_identification.assess
        rows.append(row(kind, assess(kind, seeds)))
        print(" | ".join(rows[-1]), flush=True)
    return ReportTable(HEADER, rows)


def main(arguments: list[str]) -> None:
    """Write the rows for a number of structures (30), of all kinds or of some; others stay.

    Raises SystemExit for an unknown kind.
    """
    kinds = arguments[1:] or list(WORDS)
    unknown = [kind for kind in kinds if kind not in WORDS]
    if unknown:
        raise SystemExit(f"unknown excitation {unknown[0]!r}; known are {', '.join(WORDS)}")
    result = table(int(arguments[0]) if arguments else 30, kinds)
    old = TABLE_FILE.read_text(encoding="utf-8").splitlines()[2:] if TABLE_FILE.exists() else []
    rows = {line.split(" | ")[0].removeprefix("| "): line for line in old}
    rows |= {row[0]: "| " + " | ".join(row) + " |" for row in result.rows}
    head = ["| " + " | ".join(one) + " |" for one in (result.header, ["---"] * len(result.header))]
    lines = [*head, *(rows[words] for words in WORDS.values() if words in rows)]
    TABLE_FILE.write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
