"""Runner of a sweep of trains of forces, whose peaks are known in closed form.

HSLM-A1 at 101 speeds takes 0.18 s so (six modes, processor time), by steps in C 3.0 s.
"""

import functools
import json
import os
import re
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import has_coupling, modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.output_rows import (
    corrected_places,
    linear_outputs,
    sensor_rows,
    static_correction,
)
from jaxbeam.model.static_correction import is_supported
from jaxbeam.runtime.memory import remembered_within
from jaxbeam.simulation.integrator.force_peaks import (
    MAX_VALUES,
    constant_speeds,
    force_paths,
    force_wheels,
    peaks_of_forces,
    search_bytes,
)
from jaxbeam.simulation.integrator.force_system import (
    ForceResponses,
    ForceSystem,
    force_responses,
    force_system,
)
from jaxbeam.simulation.integrator.peaks import Peaks
from jaxbeam.simulation.sweeps.batches import Batches, values_at
from jaxbeam.simulation.sweeps.step_size import (
    REFINEMENT,
    largest_error,
    relative_changes,
    stratified_sample,
)

MIN_WHEELS = 8  # of a row; below, integration in batches takes less time
LEAST_TOLERANCE = 1e-8  # above the error of the eigenvectors
# Numbers on which the model does not depend, and with which forces keep constant speeds.
ADDRESS = re.compile(r"loads\.(\d+|\*)\.(speed|entry_time|start_position|spacing)|run\.duration")
OF_BEAM = "beam", "supports", "actuators", "sensors", "track"  # the keys on which the model depends
# Runs of a block at most, and pairs of its wheels at most. Twice as many runs as before took 12 %
# less time for ten trains at 101 speeds: threads wait for each other between NumPy's short calls.
FORCE_BLOCK_RUNS, BLOCK_PAIRS = 64, 4e6
LEAST_BYTES = 100 * MAX_VALUES  # of values that a block computes at once, whatever its runs
RESPONSE_BYTES = 2e8  # of the responses that are kept for further trains at the same speeds
OUTPUTS_AT_ONCE, CORRECTED_AT_ONCE = 32, 8
TRIAL_RUNS = 4  # in which the error of the peaks is measured
PHASE = 1.6  # rad of the fastest pole in a step of the search


class ForceRunner:
    """Runner of batches of one run each (see `blocks.Runner`)."""

    trials = None  # are not kept

    def __init__(self, case: Case, batches: Batches, system: str, block_bytes: float):
        self.case, self.batches, self.system = case, batches, system
        self.pool = ThreadPoolExecutor(os.cpu_count())
        self.wheels, count = force_wheels(case), len(batches.run_index)
        self.run_bytes = self._run_bytes()
        most = min(
            FORCE_BLOCK_RUNS,
            BLOCK_PAIRS / self.wheels.force.size**2,
            (block_bytes - LEAST_BYTES) / self.run_bytes,
        )
        # As equal as can be: cores wait for the last block.
        self.block_runs = -(-count // -(-count // max(1, int(most))))
        self.block_count = -(-count // self.block_runs)

    def _run_bytes(self) -> float:
        """Memory (bytes) of a run in a block, at most."""
        batches, length = self.batches, float(concrete(self.case.beam.length))
        varied = {name.rpartition(".")[2] for name in batches.shared_addresses}
        speeds = [np.abs(concrete(load.speed)) for load in self.case.loads]
        speeds += [
            np.abs(values).min()
            for name, values in zip(batches.shared_addresses, batches.shared_values.T, strict=True)
            if name.endswith(".speed")
        ]
        wheels = at_once = self.wheels.force.size
        if "spacing" not in varied:
            behind = map(np.sort, self.wheels.behind)
            at_once = sum(
                (np.searchsorted(x, x + length, "right") - np.arange(x.size)).max(initial=0)
                for x in behind
            )
        duration = float(values_at(self.case, batches, "run.duration").max())
        given = wheels, int(at_once), duration, float(min(speeds)), PHASE
        systems = _systems(self.system)
        assert systems is not None
        return max(search_bytes(system, *given) for system in systems)

    def choose_step_sizes(self) -> tuple[Float[np.ndarray, " path"], float]:
        """Phases (rad) of the fastest pole in a step, and the relative error of peaks with them."""
        count = len(self.batches.run_index)
        sample = stratified_sample(np.arange(1.0, count + 1), min(TRIAL_RUNS, count))
        trials = self.pool.map(
            lambda phase: self._peaks(sample, phase), (PHASE, PHASE / REFINEMENT)
        )
        coarse, fine = (trial.peak_deflection for trial in trials)
        return np.full(count, PHASE), largest_error(relative_changes(coarse, fine))

    def run_count(self, block: int) -> int:
        """Number of runs in a block."""
        return self._runs(block).size

    def block_function(
        self, steps: Float[np.ndarray, " path"], trials: None = None
    ) -> Callable[[int], dict[str, np.ndarray]]:
        """Function of a block's number: its results (path, batch, ...) by name.

        The last run is repeated in a short block. Blocks are of equal size, as those of
        `blocks.Runner`: stores find a block by its size.
        """

        def compute(block: int) -> dict[str, np.ndarray]:
            runs = self._runs(block)
            found = self._peaks(runs, steps[runs[0]])._asdict()
            more = self._runs(0).size - runs.size
            return {
                name: np.concatenate([values, np.repeat(values[-1:], more, axis=0)])
                for name, values in found.items()
            }

        return compute

    def _runs(self, block: int) -> np.ndarray:
        count = len(self.batches.run_index)
        return np.arange(block * self.block_runs, min((block + 1) * self.block_runs, count))

    def _peaks(self, runs: np.ndarray, phase: float) -> Peaks:
        """Peaks of runs, no more at once than in a block."""
        if runs.size > self.block_runs:
            found = [self._peaks(np.array([run]), phase) for run in runs]
            return Peaks(*map(np.concatenate, zip(*found, strict=True)))
        batches = self.batches
        values = batches.shared_values[runs]
        paths = force_paths(self.case, self.wheels, batches.shared_addresses, values)
        speeds = tuple(np.unique(paths.speed).tolist())
        groups, sensors = output_groups(self.case), len(self.case.sensors)
        found = None
        for number, outputs in enumerate(groups):
            of_group = peaks_of_forces(_responses(self.system, number, speeds), paths, phase)
            if found is None:
                found = of_group._replace(
                    peak_deflection=np.empty((runs.size, 1, sensors)),
                    peak_time=np.empty((runs.size, 1, sensors)),
                )
            found.peak_deflection[..., outputs] = of_group.peak_deflection
            found.peak_time[..., outputs] = of_group.peak_time
        assert found is not None
        return found


def output_groups(case: Case) -> list[list[int]]:
    """Numbers of the sensors whose peaks are searched together.

    Steps end where a force passes a sensor that is statically corrected, so that their number grows
    with the places of such sensors: few of them are together, neighbours first.
    """
    order = sorted(range(len(case.sensors)), key=lambda i: float(case.sensors[i].position))
    if len(order) <= CORRECTED_AT_ONCE:
        return [order]
    groups = []
    for bends, most in ((False, OUTPUTS_AT_ONCE), (True, CORRECTED_AT_ONCE)):
        own = [i for i in order if case.sensors[i].bends == bends]
        groups += [own[first : first + most] for first in range(0, len(own), most)]
    return groups


def force_runner(
    case: Case, batches: Batches, tolerance: float, block_bytes: float
) -> ForceRunner | None:
    """Runner of trains of forces at constant speeds; None for other loads and varied models.

    A block of runs takes at most `block_bytes` of memory, if one run takes no more.
    """
    one_model = not batches.batched_addresses
    one_model = one_model and all(map(ADDRESS.fullmatch, batches.shared_addresses))
    if not (one_model and case.controller is None and tolerance >= LEAST_TOLERANCE):
        return None
    case = concrete_case(case)
    loads = load_set(case)
    if loads.wheel_count < MIN_WHEELS or not constant_speeds(loads):
        return None
    arms = np.zeros(1) if loads.eccentricity is None else np.unique(loads.eccentricity)
    if arms.size > 1:  # forces of one speed would not have one response
        return None
    content = case_to_dict(case)
    system = json.dumps([{key: content[key] for key in OF_BEAM if key in content}, *arms.tolist()])
    return None if _systems(system) is None else ForceRunner(case, batches, system, block_bytes)


@functools.lru_cache(maxsize=4)
def _systems(content: str) -> list[ForceSystem] | None:
    """Force system of the beam for each group of sensors; None where there is no closed form.

    `content` is JSON of the keys OF_BEAM of a case, and of the eccentricity (m) of the forces.
    """
    of_case, arm = json.loads(content)
    case = case_from_dict(of_case)
    layout = mesh_layout(case)
    if not is_supported(case, layout):
        return None
    model = modal_model(case, layout, has_coupling(case))
    found = []
    for outputs in output_groups(case):
        sensors = [case.sensors[i] for i in outputs]
        rows = sensor_rows(model, case, sensors)
        correction = static_correction(model, case, sensors, rows)
        places = corrected_places(case, model, sensors)
        places = np.zeros(0) if places is None else np.asarray(places)
        found.append(force_system(model, linear_outputs(model, rows, correction), places, arm))
    return None if None in found else found


@remembered_within(RESPONSE_BYTES)
def _responses(system: str, group: int, speeds: tuple[float, ...]) -> ForceResponses:
    """Responses of a group of outputs to forces at some speeds (m/s), the same for all trains."""
    found = _systems(system)
    assert found is not None
    return force_responses(found[group], np.array(speeds))
