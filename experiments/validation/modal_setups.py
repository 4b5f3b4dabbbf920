"""Modes of planted structures from several setups, merged, against the truth.

    python -m experiments.validation.modal_setups 30
    python -m experiments.validation.modal_setups 30 ambient impacts

Random structures by finite elements, as in `modal_identification`, those with four channels or
more: two are references, and the others are measured in two or three setups, each excited anew.
Printed are, for each kind of excitation: modes found, intervals that hold the truth, false modes,
and the errors of merged shapes. The table is written for the page on logs.
"""

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from experiments.validation.modal_identification import (
    DURATIONS,
    FIRST_SEED,
    WORDS,
    compare,
    log_of,
)
from jaxbeam.runtime.printer import markdown_table
from tests.oracles.planted_structures import Planted, random_structure, sampled
from tuning.modal.identify_modes import identify_modes
from tuning.modal.setups import merge_setups

TABLE_FILE = Path(__file__).parents[2] / "docs" / "_static" / "modal_setups.md"
KINDS = ("ambient", "impacts", "decay", "crossing")
REFERENCES = (0, 1)
MAX_SETUPS = 3
HEADER = (
    "excitation", "strong modes found", "modes found", "95 % intervals that hold the frequency",
    "the damping ratio", "a component of the shape", "false modes",
    "error of a component of the shape, median", "90 %",
)  # fmt: skip


def planted_setups(kind: str, seed: int) -> list[tuple[Planted, tuple[int, ...]]]:
    """A log of each setup of a structure, and the channels of the structure that it has."""
    structure = random_structure(seed)
    moving = range(len(REFERENCES), structure.shapes.shape[1])
    size = -(-len(moving) // MAX_SETUPS)
    setups = []
    for k, start in enumerate(range(moving.start, moving.stop, size)):
        own = (*REFERENCES, *moving[start - moving.start :][:size])
        part = structure._replace(shapes=structure.shapes[:, own])
        setups.append((sampled(part, kind, 10_000 * (k + 1) + seed, DURATIONS[kind]), own))
    return setups


def assess(kind: str, seeds: Sequence[int]) -> tuple[str, ...]:
    """Row of the table for one kind of excitation."""
    strong, covered, false, inside, errors = [], [], 0, [], []
    for seed in seeds:
        setups = planted_setups(kind, seed)
        fits = []
        for k, (planted, own) in enumerate(setups):
            log = log_of(planted, tuple(f"v{i + 1}" for i in own), f"setup {k + 1}")
            fits.append(identify_modes(log))
        fit = merge_setups(fits)
        # A mode is strong if it has its share of the energy in some setup.
        energies = np.max([planted.energies for planted, _ in setups], axis=0)
        structure = random_structure(seed)
        one = compare(fit, setups[0][0]._replace(structure=structure, energies=energies))
        strong += one.found
        covered.append(one.covered)
        false += len(one.false_modes)
        channels = [int(name[1:]) - 1 for name in fit.channels.names]
        matched = [mode for mode in fit.modes if mode.frequency not in one.false_modes]
        for mode, planted_mode in zip(matched, one.planted, strict=True):
            known = np.flatnonzero(np.isfinite(mode.shape))
            truth = structure.shapes[planted_mode][channels]
            largest = known[np.argmax(np.abs(mode.shape[known]))]
            others = known[known != largest]
            off = np.abs(mode.shape.real - truth / truth[largest])[others]
            deviation = np.sqrt(np.diag(mode.shape_covariance)[others])
            inside += (off < mode.quantile * deviation).tolist()
            errors += off.tolist()
        print(
            f"{kind} {seed}: {len(fit.modes)} modes of {energies.size}, covered "
            f"{one.covered.sum(axis=0)} of {len(one.covered)}, false {one.false_modes}, missed "
            f"{one.missed}",
            flush=True,
        )
    every = np.concatenate(covered)
    return (
        WORDS[kind],
        f"{sum(strong)} of {len(strong)}",
        str(len(every)),
        *(f"{100 * share:.0f} %" for share in (*every.mean(axis=0), np.mean(inside))),
        str(false),
        *(f"{value:.2g}" for value in np.quantile(errors, [0.5, 0.9])),
    )


def main(arguments: list[str]) -> None:
    """Write the table for a number of structures (30) of all kinds, or of some.

    Raises SystemExit for an unknown kind.
    """
    kinds = arguments[1:] or list(KINDS)
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise SystemExit(f"unknown excitation {unknown[0]!r}; known are {', '.join(KINDS)}")
    count = int(arguments[0]) if arguments else 30
    every = (seed for seed in itertools.count(FIRST_SEED) if _channels(seed) >= 4)
    seeds = list(itertools.islice(every, count))
    rows = [assess(kind, seeds) for kind in kinds]
    text = "\n".join(markdown_table(HEADER, rows))
    TABLE_FILE.write_text(text, encoding="utf-8")
    print(text)


def _channels(seed: int) -> int:
    return random_structure(seed).shapes.shape[1]


if __name__ == "__main__":
    main(sys.argv[1:])
