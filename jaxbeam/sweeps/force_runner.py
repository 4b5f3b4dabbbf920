"""Runner of a sweep of trains of forces, whose peaks are known in closed form."""

import os
import re
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case, replace
from jaxbeam.integrator.forces.peaks import constant_speeds, peaks_of_forces
from jaxbeam.integrator.forces.system import ForceSystem, force_system
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import has_coupling, modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensing.corrected_rows import corrected_places, static_correction
from jaxbeam.model.sensing.linear_outputs import linear_outputs
from jaxbeam.model.sensing.output_rows import sensor_rows
from jaxbeam.model.static_correction import is_supported
from jaxbeam.sweeps.batches import Batches
from jaxbeam.sweeps.step_size import REFINEMENT, SAFETY_FACTOR, relative_changes, stratified_sample

MIN_WHEELS = 8  # of a row; below, integration in batches takes less time
LEAST_TOLERANCE = 1e-8  # that tables of the response to a force meet
# Numbers on which the model does not depend, and with which forces keep constant speeds.
ADDRESS = re.compile(r"loads\.(\d+|\*)\.(speed|entry_time|start_position|spacing)|run\.duration")
BLOCK_RUNS = 32
TRIAL_RUNS = 4  # in which the error of the peaks is measured
# Through eight samples a polynomial follows a turn by phi rad to (phi / 2)^8 / (8! 2^7).
SAMPLE_ORDER, SAMPLE_DIVISOR = 8, 40320 * 2**7
LEAST_PHASE, LARGEST_PHASE = 0.5, 3.5  # rad in a step


class ForceRunner:
    """Runner of batches of one run each (see `blocks.Runner`)."""

    def __init__(self, case: Case, batches: Batches, tolerance: float, system: ForceSystem):
        self.case, self.batches, self.tolerance, self.system = case, batches, tolerance, system
        self.pool = ThreadPoolExecutor(os.cpu_count())
        self.block_count = -(-len(batches.run_index) // BLOCK_RUNS)

    def choose_step_sizes(self) -> tuple[Float[np.ndarray, " path"], float]:
        """Phases (rad) of the fastest pole in a step, and the relative error of peaks with them."""
        allowed = self.tolerance / SAFETY_FACTOR
        phase = 2 * (SAMPLE_DIVISOR * allowed) ** (1 / SAMPLE_ORDER)
        count = len(self.batches.run_index)
        phase = float(np.clip(phase, LEAST_PHASE, LARGEST_PHASE))
        sample = stratified_sample(np.arange(1.0, count + 1), min(TRIAL_RUNS, count)).tolist()

        def peaks(phase):
            return np.stack([self._peaks(run, phase).peak_deflection for run in sample])

        coarse, fine = peaks(phase), peaks(phase / REFINEMENT)
        error = float(np.nanmax(relative_changes(coarse, fine), initial=0.0))
        return np.full(count, phase), error

    def run_count(self, block: int) -> int:
        """Number of runs in a block."""
        return len(self._runs(block))

    def compute_block(self, block: int, steps) -> dict[str, np.ndarray]:
        """Results (path, batch, ...) of a block by name."""
        found = [self._peaks(run, steps[run])._asdict() for run in self._runs(block)]
        return {name: np.stack([one[name] for one in found]) for name in found[0]}

    def _runs(self, block: int) -> range:
        return range(len(self.batches.run_index))[block * BLOCK_RUNS : (block + 1) * BLOCK_RUNS]

    def _peaks(self, run: int, phase: float):
        values = dict(
            zip(self.batches.shared_addresses, self.batches.shared_values[run], strict=True)
        )
        varied = replace(self.case, values)
        return peaks_of_forces(self.system, load_set(varied), float(varied.run.duration), phase)


def force_runner(case: Case, batches: Batches, tolerance: float) -> ForceRunner | None:
    """Runner of trains of forces at constant speeds; None for other loads and varied models."""
    case = concrete_case(case)
    addresses, loads = batches.shared_addresses, load_set(case)
    known = all(map(ADDRESS.fullmatch, addresses)) and not batches.batched_addresses
    if not (known and case.controller is None and tolerance >= LEAST_TOLERANCE):
        return None
    if loads.wheel_count < MIN_WHEELS or not constant_speeds(loads):
        return None
    layout = mesh_layout(case)
    if not is_supported(case, layout):
        return None
    model = modal_model(case, layout, has_coupling(case))
    rows = sensor_rows(model, case, case.sensors)
    correction = static_correction(model, case, case.sensors, rows)
    places = corrected_places(case, model, case.sensors)
    system = force_system(
        model,
        linear_outputs(model, rows, correction),
        np.zeros(0) if places is None else np.asarray(places),
    )
    return None if system is None else ForceRunner(case, batches, tolerance, system)
