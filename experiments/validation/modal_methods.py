"""Methods of modal identification side by side with pyOMA-2, on the same planted structures.

    python -m experiments.validation.modal_methods 12
    python -m experiments.validation.modal_methods 6 excitations

Random structures by finite elements (`tests/oracles/planted_structures.py`) under ambient
excitation, with coloured noise of 5 to 30 % rms. pyOMA-2 (extra `test`) runs its covariance-driven
SSI with its own criteria of stability; a mode is found if five of its poles within 2 % of the truth
are stable, and their median is its estimate: it is given the frequency, ours is not. The second
command takes other excitations, unknown or measured, with what `identify_modes` chooses by itself;
pyOMA-2 uses the responses only. The tables are written for the page on logs.
"""

import sys
import time
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from experiments.validation.modal_identification import (
    FIRST_SEED,
    MATCH_ERROR,
    MIN_ENERGY,
    WORDS,
    band_of,
    compare,
    log_of,
    planted_log,
)
from jaxbeam.files.report import ReportTable
from jaxbeam.runtime.printer import markdown_table
from tests.oracles.planted_structures import Planted, random_structure, sampled
from tuning.logs.log import Log
from tuning.modal.identify_modes import identify_modes

TABLE_FILE = Path(__file__).parents[2] / "docs" / "_static" / "modal_methods.md"
EXCITATIONS_FILE = TABLE_FILE.with_name("modal_excitations.md")
EXCITATIONS = ("motor", "shaken", "impacts", "decay", "1 impact", "10 impacts", "random force")
JAXBEAM = "jaxbeam, by itself"
METHODS = ("covariance", "data")
PYOMA = "pyOMA-2, SSI-COV"
HEADER = (
    "method", "strong modes found", "of those stable in pyOMA-2", "error of frequency, median",
    "90 %", "error of damping ratio, median", "90 %", "95 % intervals that hold the truth",
    "false modes", "processor time of a log",
)  # fmt: skip
DURATION = 300.0  # s
BLOCK_ROWS, MAX_ORDER = 40, 60  # of pyOMA-2
MIN_STABLE = 5  # poles of pyOMA-2 for a mode


class Estimates(NamedTuple):
    """Relative errors (mode, 2) of frequency and damping ratio, NaN for modes not found.

    `covered` tells whether intervals hold the truth (None without intervals); `false` is the number
    of modes that are none; `seconds` the processor time.
    """

    errors: Float[np.ndarray, "mode 2"]
    covered: Float[np.ndarray, "mode 2"] | None
    false: int
    seconds: float


def ours(planted: Planted, method: str) -> Estimates:
    """Estimates of a method of `identify_modes` for ambient excitation."""
    return automatic(planted, log_of(planted), kind="ambient", method=method)


def automatic(planted: Planted, log: Log, **arguments) -> Estimates:
    """Estimates of `identify_modes` with what it chooses itself, but for some arguments."""
    start = time.process_time()
    fit = identify_modes(log, band=band_of(planted), **arguments)
    seconds = time.process_time() - start
    compared = compare(fit, planted)
    errors = np.full((planted.energies.size, 2), np.nan)
    for mode, error in zip(compared.planted, compared.errors, strict=True):
        errors[mode] = error
    return Estimates(errors, compared.covered, len(compared.false_modes), seconds)


def pyoma(planted: Planted) -> Estimates:
    """Estimates by the stable poles of pyOMA-2. Raises ImportError where it is not installed."""
    from pyoma2.algorithms.ssi import SSI
    from pyoma2.setup.single import SingleSetup

    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        setup = SingleSetup(planted.values - planted.values.mean(axis=0), planted.rate)
        highest = min(MAX_ORDER, BLOCK_ROWS * planted.values.shape[1] - 2)
        algorithm = SSI(name="SSI", method="cov", br=BLOCK_ROWS, ordmax=highest, step=2)
        setup.add_algorithms(algorithm)
        setup.run_all()
    seconds = time.process_time() - start
    result = algorithm.result
    stable = np.asarray(result.Lab) == 1
    frequencies, damping = np.asarray(result.Fn_poles)[stable], np.asarray(result.Xi_poles)[stable]
    truth = planted.structure.frequencies
    nearest = np.argmin(np.abs(frequencies[:, None] / truth - 1), axis=1)
    errors = np.full((truth.size, 2), np.nan)
    for mode in range(truth.size):
        near = np.abs(frequencies / truth[mode] - 1) < MATCH_ERROR
        own = (nearest == mode) & near
        if own.sum() >= MIN_STABLE:
            ratio = planted.structure.damping_ratios[mode]
            errors[mode] = (
                np.median(frequencies[own]) / truth[mode] - 1,
                np.median(damping[own]) / ratio - 1,
            )
    return Estimates(errors, None, 0, seconds)


def table(structures: Sequence[Planted], found: Mapping[str, Sequence[Estimates]]) -> ReportTable:
    """Errors of all methods on the same structures; those of `PYOMA` tell which it finds stable."""
    strong = np.concatenate([one.energies > MIN_ENERGY for one in structures])
    theirs = np.concatenate([one.errors for one in found[PYOMA]])
    shared = strong & ~np.isnan(theirs[:, 0])
    rows = []
    for name, estimates in found.items():
        errors = np.abs(np.concatenate([one.errors for one in estimates]))
        both = errors[shared & ~np.isnan(errors[:, 0])]
        quantiles = np.quantile(both, [0.5, 0.9], axis=0)
        covered = [one.covered for one in estimates if one.covered is not None]
        rows.append(
            (
                name,
                f"{np.sum(~np.isnan(errors[strong, 0]))} of {strong.sum()}",
                f"{len(both)} of {shared.sum()}",
                *(f"{100 * value:.2g} %" for value in quantiles[:, 0]),
                *(f"{100 * value:.3g} %" for value in quantiles[:, 1]),
                f"{100 * np.mean(np.concatenate(covered)):.0f} %" if covered else "",
                str(sum(one.false for one in estimates)) if covered else "",
                f"{np.mean([one.seconds for one in estimates]):.1f} s",
            )
        )
    return ReportTable(HEADER, rows)


def excitations(count: int) -> ReportTable:
    """Both programs for a number of structures under each of the other excitations."""
    rows, header = [], ("excitation", *HEADER)
    for kind in EXCITATIONS:
        structures: list[Planted] = []
        found: dict[str, list[Estimates]] = {PYOMA: [], JAXBEAM: []}
        for seed in range(FIRST_SEED, FIRST_SEED + count):
            log, planted = planted_log(kind, seed)
            structures.append(planted)
            found[PYOMA].append(pyoma(planted))
            found[JAXBEAM].append(automatic(planted, log))
        rows += [(WORDS[kind], *row) for row in table(structures, found).rows]
        print(rows[-2:], flush=True)
    return ReportTable(header, rows)


def _write(result: ReportTable, path: Path) -> None:
    text = "\n".join(markdown_table(result.header, result.rows))
    path.write_text(text, encoding="utf-8")
    print(text)


def main(arguments: list[str]) -> None:
    """Write a table for a number of structures (12)."""
    count = int(arguments[0]) if arguments else 12
    if arguments[1:] == ["excitations"]:
        _write(excitations(count), EXCITATIONS_FILE)
        return
    structures: list[Planted] = []
    found: dict[str, list[Estimates]] = {name: [] for name in (PYOMA, *METHODS)}
    for seed in range(count):
        planted = sampled(random_structure(seed), "ambient", seed, DURATION)
        structures.append(planted)
        found[PYOMA].append(pyoma(planted))
        for method in METHODS:
            found[method].append(ours(planted, method))
        print(f"structure {seed}: {planted.energies.size} modes", flush=True)
    _write(table(structures, found), TABLE_FILE)


if __name__ == "__main__":
    main(sys.argv[1:])
