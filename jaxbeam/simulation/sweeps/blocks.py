"""Runner of a sweep: computes its batches in blocks of equal shape, with the longest valid steps.

Sensors that are too many for one integration are integrated in groups, one after the other.
"""

import contextlib
import dataclasses
import functools
import logging
import os
import re
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.actuators.base import limited_loops
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.profiles.spectra import AbstractSpectralProfile
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import has_coupling
from jaxbeam.runtime.vectorised import NotVectorisedError
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import (
    runs_compiled,
    sample_times,
    steps_per_interval,
)
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.integrator.integrate import max_stable_step
from jaxbeam.simulation.integrator.step_size import StaticShapes, max_concurrent_loads
from jaxbeam.simulation.integrator.time_grid import sample_schedule
from jaxbeam.simulation.sweeps.batches import Batches, common_layout, swept_masses
from jaxbeam.simulation.sweeps.integration import (
    CompiledBatches,
    NumpyBatches,
    Program,
    in_sequence,
)
from jaxbeam.simulation.sweeps.native_integration import NativeBatches, shared_model
from jaxbeam.simulation.sweeps.step_size import (
    RANDOM_FRACTION,
    PathTimes,
    Trials,
    choose_step_sizes,
    largest_error,
    path_times,
    rounding_error,
    step_limits,
    stratified_sample,
)

LOGGER = logging.getLogger(__name__)
MAX_BLOCK_RUNS = 512  # about; a block is one call of the compiled program and one write
# Runs of a block whose batches are integrated at once: an H100 takes 65536 runs in 0.33 s, in one
# block of all of them in 0.71 s. Histories are large, and have the blocks of a CPU.
MAX_VECTORISED_RUNS = 16384
MIN_BLOCKS = 8  # of a large sweep, to use all cores
MAX_TRIAL_RUNS = 256  # about; runs per call while step sizes are measured
MIN_TRIAL_BATCHES = 4  # for which step sizes are measured
# Batches, and batches of one run, up to which the errors of all are measured: their results are
# then computed, too. A sample of few batches is most of them.
MAX_MEASURED_BATCHES, MAX_MEASURED_RUNS = 16, 256
MAX_SEARCHED_RUNS = 8  # of a batch, with which the search for its step begins
MAX_TRIAL_BATCHES = 16  # further batches of one run cost more than the steps that they would save
# Paths and runs up to which NumPy gives the first answer sooner than a compiler: each path takes
# some hundredths of a second, programs some seconds.
MAX_PATHS, MAX_RUNS = 8, 1024
# Numbers that change neither the model nor its outputs.
LEAVES_MODEL_UNCHANGED = re.compile(
    r"(loads|profile|run|controller)\.|absorbers\.(\d+|\*)\.(?!position)"
)
OF_SENSORS = "peak_deflection", "peak_time", "deflection"  # along the last axis


class Runner:
    """Runner of all batches of a sweep in blocks of equal shape.

    With `single` precision the integration is in float32, models and propagators are made in
    float64; `native` steps are taken in C. Memory allows blocks of `most_batches`, and inputs of
    the C integrator for `most_inputs` batches at once. Only C takes `profiles` of runs. If `small`,
    NumPy takes the steps of a few batches, and nothing is compiled. Raises ValueError if positions
    along the beam change their order within the sweep.
    """

    def __init__(
        self,
        case: Case,
        batches: Batches,
        histories: bool,
        tolerance: float,
        single: bool = False,
        native: bool = False,
        most_batches: int = 2**31,
        most_inputs: int = 2**31,
        small: bool = False,
        profiles: tuple[AbstractProfile, ...] = (),
    ):
        self.case, self.batches, self.tolerance = case, batches, tolerance
        self.histories, self.single, self.profiles = histories, single, profiles
        self.schedule = None
        if case.controller is not None:
            self.schedule = loop_schedule(
                case, np.asarray(sample_times(case)), float(case.run.duration)
            )
        elif histories:
            self.schedule = sample_schedule(sample_times(case), True, end=case.run.duration)
        self.trials = Trials()
        self._set_block_size(most_batches)
        # All batches share a model; not on several devices, each of which has those of its part.
        same_model = all(map(LEAVES_MODEL_UNCHANGED.match, batches.shared_addresses))
        self.shared_model = shared_model(case) if same_model and self.devices == 1 else None
        self.program = self._make_program(native)
        in_c = self._native_batches(most_inputs) if native else None
        # More threads than cores where some wait for others.
        self.pool = ThreadPoolExecutor((os.cpu_count() or 1) * (1 if in_c else 2))
        small = small and suits_numpy(case, batches, self.schedule)
        self.backend: NativeBatches | NumpyBatches | CompiledBatches = in_c or (
            self._numpy_batches() if small else self._compile()
        )
        LOGGER.info("sweep in %d blocks by %s", self.block_count, type(self.backend).__name__)
        longest = None
        if self.schedule is not None and case.controller is not None:  # steps end at events
            longest = self.schedule.lengths.max()
        limits = self._path_times, self._stable_steps(), longest, tolerance
        self.limits = step_limits(case, batches, *limits)

    def _make_program(self, native: bool) -> Program:
        """`Program` of the peaks of the sweep."""
        case, batches = self.case, self.batches
        shapes = StaticShapes(common_layout(case, batches), has_coupling(case), 1, native)
        # Compilation of the programs for one load need not wait for its entry and exit times.
        max_loads = load_set(case).wheel_count
        if max_loads > 1:
            max_loads = max(map(max_concurrent_loads, self._path_times.load_events[0]))
        shared = self.shared_model is not None and case.controller is None
        return Program(
            case,
            dataclasses.replace(shapes, max_loads=max_loads),
            batches.shared_addresses,
            batches.batched_addresses,
            self.schedule if case.controller is not None else None,
            shared_outputs=self.shared_model.outputs if shared else None,
            devices=self.devices,
            profiles=self.profiles,
        )

    def _compile(self) -> CompiledBatches:
        """Batches with compiled programs; path times are computed during the compilation."""
        shared, events = self.shared_model, None
        if shared is not None and self.schedule is None:
            events = self._path_times.load_events
        settings = self.batches, self.batches_per_block, shared and shared.model, events
        compiled = CompiledBatches(self.program, *settings, self.schedule)
        compilations = compiled.begin_compilation(self.pool)
        _ = self._path_times  # computed meanwhile
        for compilation in compilations:
            compilation.result()  # raises its error, if any
        return compiled

    def _numpy_batches(self) -> NumpyBatches:
        """Batches of a small sweep, integrated by NumPy without compilation."""
        shared, events = self.shared_model, None
        if shared is not None and self.schedule is None:
            events = self._path_times.load_events
        model = shared and shared.model
        return NumpyBatches(self.program, self.batches, model, events, self.schedule)

    def _stable_steps(self) -> Float[np.ndarray, " path"]:
        """Longest stable steps (s) of the batches; infinite where no step is stable."""
        if self.shared_model is None:
            limits = self.backend.make_models()
        else:
            loads = load_set(concrete_case(self.case), self.program.shapes.layout)
            limit = max_stable_step(self.shared_model.model, loads)
            limits = np.repeat(limit, self.batches.run_index.shape[0])
        return np.where(np.isfinite(limits), limits, np.inf)

    def _set_block_size(self, most_batches: int):
        """Set the numbers of batches per block and per trial, multiples of the number of devices.

        A device has `most_batches` at most.
        """
        count, batch_size = self.batches.run_index.shape
        self.devices = len(jax.local_devices())
        vectorised = not (self.histories or in_sequence())
        block_runs = MAX_VECTORISED_RUNS if vectorised else MAX_BLOCK_RUNS
        max_batches, trial_batches = (
            max(1, min(runs // batch_size, most_batches)) * self.devices
            for runs in (block_runs, MAX_TRIAL_RUNS)
        )
        trial_batches = min(count, trial_batches, MAX_TRIAL_BATCHES)
        self.trial_batches = _round_up(trial_batches, self.devices)
        max_batches = min(count if vectorised else count // MIN_BLOCKS, max_batches)
        self.batches_per_block = max(self.trial_batches, _round_up(max_batches, self.devices))
        self.block_count = -(-count // self.batches_per_block)

    @functools.cached_property
    def _path_times(self) -> PathTimes:
        """Load events and longest force steps of all paths.

        Events include wheels that pass the event places of a shared model.
        """
        case, places = concrete_case(self.case), np.zeros(0)
        if self.shared_model is not None:
            places = self.shared_model.event_places
        found = path_times(case, self.batches.shared_addresses, self.batches.shared_values, places)
        return jax.tree.map(np.asarray, found)

    def _native_batches(self, most_inputs: int) -> NativeBatches | None:
        """Batches integrated in C, their inputs made by NumPy; None unless all share a model.

        Without a shared model, compiled programs make the inputs of C, where they can.
        """
        if self.shared_model is not None:
            program = self.program._replace(case=concrete_case(self.case))
            given = self.shared_model, self._path_times.load_events, self.batches
            with contextlib.suppress(NotVectorisedError):
                sizes = self.batches_per_block, most_inputs
                schedule = self.schedule if self.histories else None
                return NativeBatches(program, *given, *sizes, schedule)
        if native_peaks.has_inputs_over_time(self.case) or self.case.controller is not None:
            self.program = self._make_program(native=False)
        return None

    def choose_step_sizes(self) -> tuple[Float[np.ndarray, " steps"], float]:
        """Step sizes (s) of all batches, then their extra steps; and the relative error of peaks.

        Raises RuntimeError if no time step meets the tolerance.
        """
        count = MIN_TRIAL_BATCHES
        if isinstance(self.backend, CompiledBatches):  # calls of a program take equally many
            count = _round_up(count, self.trial_batches)
        of_all = functools.partial(self._trial_peaks, self.backend, self.trials)
        masses, few = swept_masses(self.case, self.batches), None
        batches, runs = self.batches.run_index.shape
        all_measured = batches <= (MAX_MEASURED_RUNS if runs == 1 else MAX_MEASURED_BATCHES)
        if runs > MAX_SEARCHED_RUNS:
            with_few = self.backend.with_few_runs(MAX_SEARCHED_RUNS)
            few = with_few and functools.partial(self._trial_peaks, with_few, Trials())
        is_random = isinstance(self.case.profile, AbstractSpectralProfile)
        fraction = RANDOM_FRACTION if is_random else 1.0
        rates, initial_steps, max_steps = self.limits
        search = rates, masses, initial_steps, max_steps, count
        steps, extra, error = choose_step_sizes(
            of_all, *search, self.tolerance, all_measured, few, fraction
        )
        if self.single:
            sample = stratified_sample(rates, count)
            given = sample, steps[sample], extra[sample]
            error += rounding_error(*(of_all(*given, single) for single in (False, True)))
        return np.append(steps, extra), error

    def _trial_peaks(self, backend, trials, batch_indices, steps, extra_steps, single=False):
        """Peaks (path, batch and quantity, sensor) of batches; `trials` keep their results."""
        given = batch_indices, steps, extra_steps
        if single:
            results = self._trial_results(backend, *given, single)
            return self._compared_by_quantity(results["peak_deflection"])
        _, which = np.unique(np.stack(given), axis=1, return_index=True)
        new = which[~trials.has_results(*(part[which] for part in given))]
        if new.size:
            indices, own, extra = (part[new] for part in given)
            found = self._trial_results(backend, indices, own, extra, single)
            trials.add(indices, own, extra, found)
        results = trials.completed({}, *given, np.ones(len(steps), bool))
        return self._compared_by_quantity(results["peak_deflection"])

    def _compared_by_quantity(self, peaks):
        """Peaks (path, batch and quantity, sensor): sensors of other quantities are zero.

        So relative errors do not compare peaks of different quantities.
        """
        absorbers = len(self.case.absorbers)
        quantities = [*(sensor.quantity for sensor in self.case.sensors), *absorbers * ["stroke"]]
        quantities = np.array([*quantities, *absorbers * ["absorber_force"]])
        return np.concatenate(
            [peaks * (quantities == one) for one in np.unique(quantities)], axis=1
        )

    def run_count(self, block: int) -> int:
        """Number of runs in a block, without padding."""
        rows = slice(block * self.batches_per_block, (block + 1) * self.batches_per_block)
        return int((self.batches.run_index[rows] >= 0).sum())

    def block_function(
        self, steps: Float[np.ndarray, " steps"], trials: Trials | None = None
    ) -> Callable[[int], dict[str, np.ndarray]]:
        """Function from the number of a block to its results (path, batch, ...) by name.

        `steps` are those of `choose_step_sizes`. Results among the `trials` are not
        computed again.
        """
        substeps, stored_results = None, trials or Trials()
        steps, extra = np.split(steps, 2)
        extra = extra.astype(int)
        if self.histories:
            substeps = steps_per_interval(float(self.schedule.lengths.max()), steps.min())
        stepping = steps, extra, substeps
        integrate = self.backend.block_integrator(self._batches_of, *stepping, self.single)
        if self.histories or self.single:
            stored_results = Trials()  # trials are of peaks, in double precision

        def compute(block: int) -> dict[str, np.ndarray]:
            rows = self._batches_of(block)
            given = rows, steps[rows], extra[rows]
            is_stored = stored_results.has_results(*given)
            results = {} if is_stored.all() else integrate(block, ~is_stored)
            if not is_stored.any():
                return results
            return stored_results.completed(results, *given, is_stored)

        return compute

    def _batches_of(self, block: int) -> Int[np.ndarray, " path"]:
        """Indices of the batches of a block; the last one is filled with the first batches."""
        first, count = block * self.batches_per_block, self.batches.run_index.shape[0]
        return np.arange(first, first + self.batches_per_block) % count

    def _trial_results(self, backend, batch_indices, steps, extra_steps, single):
        """Results of batches by name, computed on all cores."""
        count = batch_indices.size
        results = []
        for rows in np.array_split(np.arange(count), -(-count // backend.most_at_once)):
            given = batch_indices[rows], steps[rows], extra_steps[rows], single
            integrate, calls = backend.rows_integrator(*given, self.trial_batches)
            results += self.pool.map(integrate, np.array_split(np.arange(rows.size), calls))
        return {name: np.concatenate([one[name] for one in results]) for name in results[0]}


def suits_numpy(case: Case, batches: Batches, schedule) -> bool:
    """Whether NumPy integrates a sweep: it is small, and needs no compiled control loop."""
    paths, runs = batches.run_index.shape
    if not in_sequence() or len(jax.local_devices()) > 1:
        return False
    if case.controller is not None and (
        runs_compiled(schedule)
        or case.controller.period is None
        or limited_loops(case.actuators)  # solved in each step
    ):
        return False
    return paths <= MAX_PATHS and paths * runs <= MAX_RUNS


def _round_up(count: int, unit: int) -> int:
    """Smallest multiple of a unit that is at least a count."""
    return -(-count // unit) * unit


class SensorGroups:
    """Runner of several groups of sensors: one `Runner` of the same batches for each group.

    `groups` are the numbers of the sensors of each runner.
    """

    trials = None  # are not kept

    def __init__(self, runners: Sequence[Runner], groups: Sequence[Sequence[int]]):
        self.runners, self.groups = runners, groups
        self.batches, self.block_count = runners[0].batches, runners[0].block_count
        self.run_count = runners[0].run_count

    @property
    def pool(self) -> ThreadPoolExecutor:
        """Pool of threads that compute blocks."""
        return self.runners[0].pool

    def choose_step_sizes(self) -> tuple[Float[np.ndarray, " steps"], float]:
        """Steps of all batches, the finest of any group, and the largest error of peaks."""
        found = [runner.choose_step_sizes() for runner in self.runners]
        steps, errors = zip(*found, strict=True)
        sizes, extra = np.split(np.array(steps), 2, axis=1)
        return np.append(np.min(sizes, axis=0), np.max(extra, axis=0)), largest_error(errors)

    def block_function(
        self, steps: Float[np.ndarray, " steps"], trials: None = None
    ) -> Callable[[int], dict[str, np.ndarray]]:
        """Function from the number of a block to its results (path, batch, ...) by name."""
        functions = [runner.block_function(steps) for runner in self.runners]
        order = np.argsort(np.concatenate(self.groups))

        def compute(block: int) -> dict[str, np.ndarray]:
            parts = [function(block) for function in functions]
            joined = {}
            for name in set(OF_SENSORS) & set(parts[0]):
                split = [
                    np.split(part[name], [len(group)], -1)
                    for part, group in zip(parts, self.groups, strict=True)
                ]
                of_sensors = np.concatenate([own for own, _ in split], -1)[..., order]
                of_absorbers = split[0][1]  # in each group the same
                joined[name] = np.concatenate([of_sensors, of_absorbers], -1)
            return parts[0] | joined

        return compute
