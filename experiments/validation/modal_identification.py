"""Modes of planted structures, identified by jaxbeam and by pyOMA-2, against the truth.

    python -m experiments.validation.modal_identification ambient 10

Random structures by finite elements (`tests/oracles/planted_structures.py`), each excited in one of
several ways. Forces are measured where a hammer strikes one, three or ten times at one place, or
one random force or two shake, with coloured noise of 5 to 30 % rms on the responses, all through
the anti-alias filter of the logger. Printed are, for each kind of excitation: the share of modes
with more than 5 % of the energy that were found, of intervals that cover the truth, of modes that
are none, and the quantiles of the errors.
"""

import sys
import time
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.signal import firwin, lfilter

from tests.oracles.planted_structures import (
    FINER,
    Planted,
    Structure,
    coloured_noise,
    random_structure,
    response,
    sampled,
)
from tuning.logs.log import Log
from tuning.modal.identify_modes import identify_modes
from tuning.modal.result import ModalEstimates

FORCED = ("1 impact", "3 impacts", "10 impacts", "random force", "two random forces")
MATCH_ERROR = 0.02  # relative error of a frequency within which a mode is one of the structure
MIN_ENERGY = 0.05  # energy share of the modes that must be found
DURATIONS = {
    "ambient": 300.0,
    "motor": 300.0,
    "shaken": 300.0,
    "impacts": 60.0,
    "decay": 20.0,
    "crossing": 60.0,
} | dict.fromkeys(FORCED, 60.0)  # s
FIRST_SEED = 2900  # of structures from which no rule was chosen (docs/howto/logs.md)
WORDS = {
    "ambient": "ambient",
    "motor": "ambient, and a motor with its harmonic",
    "shaken": "shaker with four harmonics, unmeasured",
    "impacts": "impacts, unmeasured",
    "decay": "one free decay",
    "crossing": "load that crosses and leaves",
    "1 impact": "one impact, measured",
    "3 impacts": "three impacts, measured",
    "10 impacts": "ten impacts, measured",
    "random force": "random force, measured",
    "two random forces": "two random forces, measured",
}


class PlantedComparison(NamedTuple):
    """Identified modes against planted ones.

    `covered` tells, for each identified mode that is one of the structure, whether its intervals of
    frequency and damping ratio hold the truth; `errors` are relative errors of both, and `found`
    tells of each planted mode with 5 % of the energy whether it was identified. `planted` are the
    indices of the planted modes that the errors are of.
    """

    covered: Float[np.ndarray, "mode 2"]
    errors: Float[np.ndarray, "mode 2"]
    false_modes: tuple[float, ...]
    found: tuple[bool, ...]
    missed: tuple[float, ...]
    planted: tuple[int, ...] = ()


def log_of(planted: Planted, names: tuple[str, ...] = (), source: str = "planted") -> Log:
    """Log of velocities; channels are v1, v2 ... by default."""
    channels = planted.values.shape[1]
    return Log(
        times=np.arange(len(planted.values)) / planted.rate,
        values=planted.values,
        names=names or tuple(f"v{i + 1}" for i in range(channels)),
        quantities=("velocity",) * channels,
        units=("m/s",) * channels,
        source=source,
    )


def forced_log(structure: Structure, excitation: str, seed: int) -> tuple[Log, Planted]:
    """Log of measured forces and the velocities at the channels, with what was planted in it."""
    random = np.random.default_rng(7000 + seed)
    rate = 2.56 * structure.frequencies[-1] * random.uniform(1.2, 2.5)
    fine = FINER * rate
    forces = np.zeros((int(DURATIONS[excitation] * fine), structure.inputs.shape[1]))
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


def planted_log(kind: str, seed: int) -> tuple[Log, Planted]:
    """Log of a random structure under some excitation, and what was planted in it."""
    structure = random_structure(seed)
    if kind in FORCED:
        return forced_log(structure, kind, seed)
    planted = sampled(structure, kind, seed, DURATIONS[kind])
    return log_of(planted), planted


def band_of(planted: Planted) -> tuple[float, float]:
    """Band (Hz) that holds all modes."""
    frequencies = planted.structure.frequencies
    return 0.7 * frequencies[0], min(1.25 * frequencies[-1], 0.45 * planted.rate)


def compare(fit: ModalEstimates, planted: Planted) -> PlantedComparison:
    """Pairs of identified and planted modes, each used once, the nearest poles first."""
    structure = planted.structure
    poles = 2 * np.pi * fit.frequencies * (-fit.damping_ratios + 1j)
    truth = structure.poles
    distance = np.abs(poles[:, None] - truth) / np.abs(truth)
    pairs: dict[int, int] = {}
    for flat in np.argsort(distance, axis=None):
        mine, planted_mode = divmod(int(flat), truth.size)
        near = abs(fit.frequencies[mine] / structure.frequencies[planted_mode] - 1) < MATCH_ERROR
        if near and mine not in pairs and planted_mode not in pairs.values():
            pairs[mine] = planted_mode
    covered, errors = [], []
    for mine, k in sorted(pairs.items()):
        f, z = structure.frequencies[k], structure.damping_ratios[k]
        low, high = fit.frequency_intervals[mine], fit.damping_intervals[mine]
        covered.append([low[0] <= f <= low[1], high[0] <= z <= high[1]])
        errors.append([fit.frequencies[mine] / f - 1, fit.damping_ratios[mine] / z - 1])
    strong = np.flatnonzero(planted.energies > MIN_ENERGY)
    seen = [int(k) in pairs.values() for k in strong]
    return PlantedComparison(
        np.array(covered, float).reshape(-1, 2),
        np.array(errors, float).reshape(-1, 2),
        tuple(f for i, f in enumerate(fit.frequencies.tolist()) if i not in pairs),
        tuple(seen),
        tuple(float(structure.frequencies[k]) for k, s in zip(strong, seen, strict=True) if not s),
        tuple(pairs[mine] for mine in sorted(pairs)),
    )


def assess(kind: str, seeds: Iterable[int]) -> list[PlantedComparison]:
    """PlantedComparison for each seed, printed as it comes."""
    found = []
    for seed in seeds:
        log, planted = planted_log(kind, seed)
        start = time.process_time()
        fit = identify_modes(log, band=band_of(planted) if kind in FORCED else None)
        one = compare(fit, planted)
        found.append(one)
        print(
            f"{kind} {seed}: {fit.kind}, {len(fit.modes)} modes of {planted.energies.size}, "
            f"covered {one.covered.sum(axis=0)} of {len(one.covered)}, false {one.false_modes}, "
            f"missed {one.missed}, {time.process_time() - start:.1f} s",
            flush=True,
        )
    return found


def summary(found: list[PlantedComparison]) -> str:
    """Shares over all seeds, and quantiles of the errors."""
    covered = np.concatenate([one.covered for one in found])
    errors = np.abs(np.concatenate([one.errors for one in found]))
    seen = [s for one in found for s in one.found]
    false = sum(len(one.false_modes) for one in found)
    quantiles = np.quantile(errors, [0.5, 0.9], axis=0)
    return (
        f"found {np.mean(seen):.3f} of {len(seen)} strong modes; covered {covered.mean(axis=0)} of "
        f"{len(covered)}; false {false / max(len(covered) + false, 1):.3f}; relative errors, "
        f"median and 90 %: frequency {quantiles[:, 0]}, damping {quantiles[:, 1]}"
    )


def main(arguments: list[str]) -> None:
    """Print the comparison for one kind or all, and a number of structures (10)."""
    kinds = arguments[:1] or WORDS
    count = int(arguments[1]) if len(arguments) > 1 else 10
    for kind in kinds:
        print(f"{kind}: {summary(assess(kind, range(count)))}")


if __name__ == "__main__":
    main(sys.argv[1:])
