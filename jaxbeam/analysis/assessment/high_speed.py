"""Largest responses to trains over speed, with speeds refined around resonance."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.critical_speeds import regular_spacing, resonance_speeds
from jaxbeam.case.case import Case, Run
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.axles import Axles
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.modes import modes
from jaxbeam.sweeps.computation import peaks_in_memory
from jaxbeam.sweeps.specification import sweep_specification
from jaxbeam.vehicles.trains import trains as library

# Ratio of speeds: N axles at a spacing build up resonance of order i over a share 2 / (N i) of the
# speed, 3 % for the longest trains at third order, with at least one speed within.
SPEED_RATIO = 1.02
SETTLED = 0.01  # change of the largest response, relative, at which speeds are fine enough
NEAR_LARGEST = 0.8  # share of the largest response from which on a peak over speed is refined
MAX_ROUNDS = 4
TOLERANCE = 1e-4  # of peaks
FREE_PERIODS = 2.0  # of the first mode, simulated after a train has left


class TrainResponse(NamedTuple):
    """Peaks of sensors over the speeds (m/s) of one train, and how far they may still grow.

    `change` is the relative growth of the largest peak of each quantity in the last refinement.
    """

    train: str
    speeds: Float[np.ndarray, " speed"]
    peaks: Float[np.ndarray, "speed sensor"]
    change: float


def train_response(
    case: Case, train: str, sensors: tuple[Sensor, ...], lowest: float, highest: float
) -> TrainResponse:
    """Peaks of sensors under a train of the library at speeds (m/s) between two, refined.

    First in steps of 2 %, and at the resonance speeds of the first mode; then around every peak
    near the largest one, until it changes by less than a hundredth.
    """
    offsets, forces = library()[train].offsets, library()[train].forces
    load = Axles(speed=highest, offsets=offsets, forces=forces)
    loaded = dataclasses.replace(
        case, sensors=sensors, loads=(load,), run=Run(1.0, sample_rate=20.0)
    )
    way = float(concrete(case.beam.length)) + float(offsets[-1])
    free = FREE_PERIODS / float(concrete(modes(case).frequencies)[0])

    def peaks_at(speeds) -> Float[np.ndarray, "speed sensor"]:
        over = {"loads.0.speed": speeds, "run.duration": way / speeds + free}
        plan = sweep_specification(loaded, over, True, False, TOLERANCE, "double")
        found = peaks_in_memory(plan)
        columns = [found[f"peak_{s.quantity}"].to_numpy()[:, i] for i, s in enumerate(sensors)]
        return np.stack(columns, axis=-1)

    speeds = _first_speeds(loaded, lowest, highest)
    count, peaks, change = speeds.size, peaks_at(speeds), np.inf
    quantities = np.array([sensor.quantity for sensor in sensors])
    for _ in range(MAX_ROUNDS):
        before = _largest(peaks, quantities)
        added = _between(speeds, peaks, quantities, count)
        speeds = np.concatenate([speeds, added])
        peaks = np.concatenate([peaks, peaks_at(added)])
        order = np.argsort(speeds)
        speeds, peaks = speeds[order], peaks[order]
        change = max(_largest(peaks, quantities) / before) - 1
        if change < SETTLED:
            break
    return TrainResponse(train, speeds, peaks, float(change))


def _first_speeds(case: Case, lowest: float, highest: float) -> Float[np.ndarray, " speed"]:
    steps = int(np.ceil(np.log(highest / lowest) / np.log(SPEED_RATIO)))
    speeds = np.geomspace(lowest, highest, max(steps, 1) + 1)
    spacing = regular_spacing(case)
    if spacing is not None:
        found = resonance_speeds(case, spacing, lowest, highest)
        speeds = np.union1d(speeds, [critical.speed for critical in found])
    return speeds


def _largest(peaks, quantities) -> Float[np.ndarray, " quantity"]:
    return np.array([peaks[:, quantities == q].max() for q in np.unique(quantities)])


def _between(speeds, peaks, quantities, count: int) -> Float[np.ndarray, " added"]:
    """Speeds (`count`) in the intervals beside the peaks over speed that are near the largest."""
    beside = np.zeros(speeds.size - 1, bool)
    for quantity in np.unique(quantities):
        largest = peaks[:, quantities == quantity].max(axis=1)
        padded = np.concatenate([[-np.inf], largest, [-np.inf]])
        is_peak = (largest >= padded[:-2]) & (largest >= padded[2:])
        for i in np.flatnonzero(is_peak & (largest >= NEAR_LARGEST * largest.max())):
            beside[max(i - 1, 0) : i + 1] = True
    intervals = np.flatnonzero(beside)
    shares = np.diff(np.linspace(0, count, intervals.size + 1).astype(int))
    added = [
        np.linspace(speeds[i], speeds[i + 1], share + 2)[1:-1]
        for i, share in zip(intervals, shares, strict=True)
    ]
    return np.concatenate(added)
