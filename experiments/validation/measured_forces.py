"""Modes from measured forces of planted structures: coverage of intervals, misses, false modes.

    python -m experiments.validation.measured_forces 10

Random structures by finite elements (`tests/oracles/planted_structures.py`), each struck by one,
three or ten impacts of a hammer at one place, or shaken by one random force or two, with coloured
noise of 5 to 30 % rms on the responses. Forces are measured, through the anti-alias filter of the
logger like the responses.
"""

import sys
import time
from collections.abc import Iterable

import numpy as np
from scipy.signal import firwin, lfilter

from experiments.validation.modal_identification import PlantedComparison, compare, summary
from tests.oracles.planted_structures import (
    FINER,
    Planted,
    Structure,
    coloured_noise,
    random_structure,
    response,
)
from tuning.logs.log import Log
from tuning.modal.identify_modes import identify_modes

EXCITATIONS = ("1 impact", "3 impacts", "10 impacts", "random force", "two random forces")
DURATION = 60.0  # s


def forced_log(structure: Structure, excitation: str, seed: int) -> tuple[Log, Planted]:
    """Log of measured forces and the velocities at the channels, with what was planted in it."""
    random = np.random.default_rng(7000 + seed)
    rate = 2.56 * structure.frequencies[-1] * random.uniform(1.2, 2.5)
    fine = FINER * rate
    forces = np.zeros((int(DURATION * fine), structure.inputs.shape[1]))
    shakers = {"random force": 1, "two random forces": 2}.get(excitation, 0)
    if shakers:
        forces[:, :shakers] = random.normal(size=(len(forces), shakers))
    else:
        impacts = int(excitation.split()[0])
        starts = 0.05 + 0.9 * (np.arange(impacts) + random.uniform(0, 0.5, impacts)) / impacts
        for start in starts * (1 if impacts > 1 else 0.2):
            first = int(start * len(forces))
            shape = np.sin(np.pi * (np.arange(2 * FINER) + 0.5) / (2 * FINER))
            forces[first : first + 2 * FINER, 0] += random.uniform(0.5, 1.5) * shape
    # The anti-alias filter of the logger, for all channels.
    forces = np.asarray(lfilter(firwin(161, 0.8 / FINER), 1.0, forces, axis=0))
    parts = []
    for k in range(structure.frequencies.size):
        one = Structure(*(field[k : k + 1] for field in structure))
        parts.append(response(one, forces, fine)[::FINER])
    parts = np.stack(parts)
    clean = parts.sum(axis=0)
    noise = random.uniform(0.05, 0.3) * clean.std()
    values = clean + noise * coloured_noise(random, clean.shape)
    energies = np.mean(parts.var(axis=1) / clean.var(axis=0), axis=1)
    channels, inputs = values.shape[1], max(shakers, 1)
    log = Log(
        np.arange(len(values)) / rate,
        np.column_stack([forces[::FINER, :inputs], values]),
        (*(f"f{i + 1}" for i in range(inputs)), *(f"v{i + 1}" for i in range(channels))),
        (*["force"] * inputs, *["velocity"] * channels),
        (*["N"] * inputs, *["m/s"] * channels),
        "planted",
    )
    return log, Planted(structure, values, rate, energies, noise=noise)


def assess(excitation: str, seeds: Iterable[int]) -> list[PlantedComparison]:
    """Comparison for each seed, printed as it comes."""
    found = []
    for seed in seeds:
        log, planted = forced_log(random_structure(seed), excitation, seed)
        start = time.process_time()
        frequencies = planted.structure.frequencies
        fit = identify_modes(
            log, band=(0.7 * frequencies[0], min(1.25 * frequencies[-1], 0.45 * planted.rate))
        )
        one = compare(fit, planted)
        found.append(one)
        print(
            f"{excitation} {seed}: {len(fit.modes)} modes of {planted.energies.size}, "
            f"covered {one.covered.sum(axis=0)} of {len(one.covered)}, false {one.false_modes}, "
            f"missed {one.missed}, {time.process_time() - start:.1f} s",
            flush=True,
        )
    return found


def main(arguments: list[str]) -> None:
    """Print the comparison for a number of structures (10)."""
    count = int(arguments[0]) if arguments else 10
    for excitation in EXCITATIONS:
        print(f"{excitation}: {summary(assess(excitation, range(count)))}")


if __name__ == "__main__":
    main(sys.argv[1:])
