"""Largest responses to trains over speed, with speeds refined around resonance."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.critical_speeds import regular_spacing, resonance_speeds
from jaxbeam.case.case import Case, Run
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.axles import Axles
from jaxbeam.case.sensors import Sensor
from jaxbeam.integrator.force_peaks import force_paths, force_wheels, peaks_of_forces
from jaxbeam.integrator.force_system import force_responses, force_system
from jaxbeam.library.published import trains as library
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import modes
from jaxbeam.model.sensing.output_rows import (
    SIDE_DISTANCE,
    LinearOutputs,
    linear_outputs,
    sensor_rows,
    static_correction,
)
from jaxbeam.sweeps.computation import peaks_in_memory
from jaxbeam.sweeps.force_runner import PHASE
from jaxbeam.sweeps.quality import failure_sentence
from jaxbeam.sweeps.specification import sweep_specification

# Ratio of speeds: N axles at a spacing build up resonance of order i over a fraction 2 / (N i) of
# the speed, 3 % for the longest trains at third order, with at least one speed within.
SPEED_RATIO = 1.02
SETTLED = 0.01  # change of the largest response, relative, at which speeds are fine enough
NEAR_LARGEST = 0.8  # fraction of the largest response from which on a peak over speed is refined
MAX_ROUNDS = 4
TOLERANCE = 1e-4  # of peaks
NEAR = 1e-6  # m, from a support to a sensor next to it
RUNS_AT_ONCE = 8  # whose reactions are computed together
FREE_PERIODS = 2.0  # of the first mode, simulated after a train has left


class TrainResponse(NamedTuple):
    """Peaks of sensors over the speeds (m/s) of one train, and their change by the refinement.

    `change` is the relative growth of the largest peak of each quantity in the last refinement.
    """

    train: str
    speeds: Float[np.ndarray, " speed"]
    peaks: Float[np.ndarray, "speed sensor"]
    change: float


def train_response(
    case: Case,
    train: str,
    sensors: tuple[Sensor, ...],
    lowest: float,
    highest: float,
    reactions: tuple[float, ...] = (),
) -> TrainResponse:
    """Peaks of sensors under a train of the library at speeds (m/s) between two, refined.

    Followed by those of the reactions of the supports at some positions (m): where the beam has
    repeated poles the sum of the shear forces on both sides, which is no smaller.

    First in steps of 2 %, and at the resonance speeds of the first mode; then around every peak
    near the largest one, until it changes by less than a hundredth. Raises RuntimeError if a run
    fails.
    """
    offsets, forces = library()[train].offsets, library()[train].forces
    load = Axles(speed=highest, offsets=offsets, forces=forces)
    loaded = dataclasses.replace(
        case, sensors=sensors, loads=(load,), run=Run(1.0, sample_rate=20.0)
    )
    way = float(concrete(case.beam.length)) + float(offsets[-1])
    free = FREE_PERIODS / float(concrete(modes(case).frequencies)[0])

    def peaks_at(speeds) -> Float[np.ndarray, "speed sensor"]:
        """Peaks at speeds (m/s). Raises RuntimeError if a run fails."""
        over = {"loads.0.speed": speeds, "run.duration": way / speeds + free}
        plan = sweep_specification(loaded, over, True, False, TOLERANCE, "double")
        found = peaks_in_memory(plan)
        if found.failed_runs:
            raise RuntimeError(f"under {train} {failure_sentence(found)}")
        columns = [found[f"peak_{s.quantity}"].to_numpy()[:, i] for i, s in enumerate(sensors)]
        peaks = np.stack(columns, axis=-1)
        if not reactions:
            return peaks
        values = np.stack([over[name] for name in over], axis=-1)
        found = reaction_peaks(loaded, reactions, tuple(over), values)
        if found is None:
            near = [
                [s.quantity == "shear" and abs(float(s.position) - x) < NEAR for s in sensors]
                for x in reactions
            ]
            found = peaks @ np.array(near, float).T
        return np.concatenate([peaks, found], axis=-1)

    speeds = _first_speeds(loaded, lowest, highest)
    count, peaks, change = speeds.size, peaks_at(speeds), np.inf
    quantities = [sensor.quantity for sensor in sensors] + ["reaction"] * len(reactions)
    quantities = np.array(quantities)
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


def reaction_peaks(
    case: Case, positions: Sequence[float], addresses: Sequence[str], values
) -> Float[np.ndarray, "run reaction"] | None:
    """Largest absolute reactions (N) at positions (m) in runs that differ in values at addresses.

    A reaction is the jump of the shear force, S(x+) - S(x-), in closed form under the forces of a
    train. None where poles of the beam are repeated.
    """
    length, model = float(concrete(case.beam.length)), modal_model(case)
    step, sensors, weights = 4 * SIDE_DISTANCE * length, [], []
    for number, x in enumerate(positions):
        for place, sign, beyond in ((x - step, -1.0, x == 0), (x, 1.0, x == length)):
            if not beyond:
                sensors.append(Sensor(place, "shear"))
                weights.append(sign * (np.arange(len(positions)) == number))
    rows = sensor_rows(model, case, sensors)
    outputs = linear_outputs(model, rows, static_correction(model, case, sensors, rows))
    assert outputs.influence is not None
    jumps = np.array(weights).T
    influence = eqx.tree_at(
        lambda one: one.series, outputs.influence, outputs.influence.series @ jumps.T
    )
    combined = LinearOutputs(jumps @ np.asarray(outputs.rows), influence)
    system = force_system(model, combined, np.array(positions))
    if system is None:
        return None
    found, wheels = [], force_wheels(case)
    for part in np.array_split(values, -(-len(values) // RUNS_AT_ONCE)):
        paths = force_paths(case, wheels, addresses, part)
        responses = force_responses(system, np.unique(paths.speed))
        found.append(peaks_of_forces(responses, paths, PHASE).peak_deflection[:, 0])
    return np.concatenate(found)


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
    """Speeds (`count`) in the intervals next to the peaks over speed that are near the largest."""
    next_to_peak = np.zeros(speeds.size - 1, bool)
    for quantity in np.unique(quantities):
        largest = peaks[:, quantities == quantity].max(axis=1)
        padded = np.concatenate([[-np.inf], largest, [-np.inf]])
        is_peak = (largest >= padded[:-2]) & (largest >= padded[2:])
        for i in np.flatnonzero(is_peak & (largest >= NEAR_LARGEST * largest.max())):
            next_to_peak[max(i - 1, 0) : i + 1] = True
    intervals = np.flatnonzero(next_to_peak)
    counts = np.diff(np.linspace(0, count, intervals.size + 1).astype(int))
    added = [
        np.linspace(speeds[i], speeds[i + 1], number + 2)[1:-1]
        for i, number in zip(intervals, counts, strict=True)
    ]
    return np.concatenate(added)
