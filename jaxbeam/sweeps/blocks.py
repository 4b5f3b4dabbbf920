"""Runner of a sweep: its batches in blocks of equal shape, compiled once."""

import contextlib
import dataclasses
import functools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.events import sample_schedule
from jaxbeam.integrator.integrate import max_stable_step
from jaxbeam.integrator.static_shapes import StaticShapes, max_concurrent_loads
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import ModalModel, has_coupling
from jaxbeam.runtime.vectorised import NotVectorisedError
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import sample_times, steps_per_interval
from jaxbeam.sweeps import programs
from jaxbeam.sweeps.batches import Batches, common_layout, swept_masses
from jaxbeam.sweeps.known_inputs import KnownInputs, inputs_of_rows, known_model
from jaxbeam.sweeps.path_times import PathTimes, path_times
from jaxbeam.sweeps.step_limits import step_limits
from jaxbeam.sweeps.step_size import (
    choose_step_sizes,
    rounding_error,
    stratified_sample,
)
from jaxbeam.sweeps.trials import Trials

MAX_BLOCK_RUNS = 512  # about; a block is one call of the compiled program and one write
# The same where batches are integrated at once: an H100 takes 65536 runs in 0.33 s, in blocks of
# all of them in 0.71 s. Histories are large, and have the blocks of a CPU.
MAX_VECTORISED_RUNS = 16384
MIN_BLOCKS = 8  # of a large sweep, to use all cores
MAX_TRIAL_RUNS = 256  # about; runs per call while step sizes are measured
MIN_TRIAL_BATCHES = 4  # for which step sizes are measured
MAX_CHECKED_RUNS = 256  # of paths of their own: to check all takes three times as long
MAX_TRIAL_BATCHES = 16  # more of one run each cost more than the steps that they would save


class Runner:
    """Runner of all batches of a sweep in blocks of equal shape.

    With `single` precision the integration is in float32, models and propagators are made in
    float64; `native` steps are taken in C. Raises ValueError if positions along the beam change
    their order within the sweep.
    """

    def __init__(
        self,
        case: Case,
        batches: Batches,
        histories: bool,
        tolerance: float,
        single: bool = False,
        native: bool = False,
    ):
        self.case, self.batches, self.tolerance = case, batches, tolerance
        self.histories, self.single = histories, single
        self.schedule = None
        if case.controller is not None:
            self.schedule = loop_schedule(
                case, np.asarray(sample_times(case)), float(case.run.duration)
            )
        elif histories:
            self.schedule = sample_schedule(sample_times(case), True, end=case.run.duration)
        self.trials = Trials()
        # The variant that measures step sizes is compiled below, others on first use.
        self._compile_lock, self._compiled_variants = threading.Lock(), {(None, False)}
        self._set_block_size()
        self.addresses = (batches.shared_addresses, batches.batched_addresses)
        layout = common_layout(case, batches)
        # Loads, settings of the run and controllers do not change the model, which all batches then
        # share; not on several devices, each of which has the models of its part of a block.
        leaves_model_unchanged = ("loads.", "run.", "controller.")
        same_model = all(name.startswith(leaves_model_unchanged) for name in self.addresses[0])
        self.shapes = StaticShapes(layout, has_coupling(case), 1, native)
        self.known_model = known_model(case) if same_model and self.devices == 1 else None
        # Compilation of the programs for one load need not wait for its entry and exit times.
        max_loads = load_set(case).wheel_count
        if max_loads > 1:
            max_loads = max(map(max_concurrent_loads, self._path_times.load_events[0]))
        self.shapes = dataclasses.replace(self.shapes, max_loads=max_loads)
        # The C library makes its own step matrices.
        self.discretise_separately = case.controller is None and not native
        self.known_inputs = self._known_inputs()
        # More threads than cores where some wait for others.
        waiting = self.known_inputs is None
        self.pool = ThreadPoolExecutor((os.cpu_count() or 1) * (2 if waiting else 1))
        if self.known_inputs is None:
            self._compile_programs()
        self.models, limits = self._make_models()
        longest = None
        if self.schedule is not None and case.controller is not None:  # steps end at events
            longest = self.schedule.lengths.max()
        self.limits = step_limits(case, batches, self._path_times, limits, longest, tolerance)

    def _set_block_size(self):
        """Numbers of batches per block and per trial, multiples of the number of devices."""
        count, batch_size = self.batches.run_index.shape
        self.devices = len(jax.local_devices())
        vectorised = not (self.histories or programs.in_sequence())
        block_runs = MAX_VECTORISED_RUNS if vectorised else MAX_BLOCK_RUNS
        max_batches, trial_batches = (
            max(1, runs * self.devices // batch_size) for runs in (block_runs, MAX_TRIAL_RUNS)
        )
        trial_batches = min(count, trial_batches, MAX_TRIAL_BATCHES)
        self.trial_batches = _round_up(trial_batches, self.devices)
        max_batches = min(count if vectorised else count // MIN_BLOCKS, max_batches)
        self.batches_per_block = max(self.trial_batches, _round_up(max_batches, self.devices))
        self.block_count = -(-count // self.batches_per_block)

    @functools.cached_property
    def _path_times(self) -> PathTimes:
        """Times of all paths, with passages of the model if all share one."""
        case, places = concrete_case(self.case), np.zeros(0)
        if self.known_model is not None:
            places = self.known_model.event_places
        found = path_times(case, self.addresses[0], self.batches.shared_values, places)
        return jax.tree.map(np.asarray, found)

    def _model_groups(self) -> list:
        """Indices of batches whose models are made in one call."""
        count = self.batches.run_index.shape[0]
        return list(np.resize(np.arange(count), (self.block_count, self.batches_per_block)))

    def _known_inputs(self) -> KnownInputs | None:
        """What the C integrator needs to know, if all batches share a model; else None."""
        if self.known_model is None or not self.shapes.native:
            return None
        program = self.program()._replace(case=concrete_case(self.case))
        events = self._path_times.load_events
        try:
            return KnownInputs(program, self.known_model, events, self.batches)
        except NotVectorisedError:
            return None

    def _compile_programs(self) -> None:
        """Compile the programs for step sizes."""
        program = self.program()
        first_values = self.batches.shared_values[self._model_groups()[0]]
        compilations = [
            self.pool.submit(compiled_program.precompile(*arguments))
            for compiled_program, arguments in self._programs_to_compile(program, first_values)
        ]
        _ = self._path_times  # meanwhile, unless they are known
        for compilation in compilations:
            compilation.result()  # raises its error, if any

    def _make_models(self) -> tuple[ModalModel, Float[np.ndarray, " path"]]:
        """Models of all batches, a single one if they share it; longest stable steps (s)."""
        count = self.batches.run_index.shape[0]
        if self.known_model is not None:
            model = self.known_model.model
            limit = max_stable_step(model, load_set(concrete_case(self.case), self.shapes.layout))
            models = jax.tree.map(lambda leaf: leaf[None], model)
            return models, _stable_steps(np.repeat(limit, count))
        groups = [
            programs.modal_models(self.program(), self.batches.shared_values[group])
            for group in self._model_groups()
        ]
        models, limits = jax.tree.map(lambda *leaves: np.concatenate(leaves), *groups)
        return models, _stable_steps(limits[:count])

    def choose_step_sizes(self) -> tuple[Float[np.ndarray, " path"], float]:
        """Step sizes (s) of all batches, and the estimated relative error of their peaks.

        Raises RuntimeError if no time step meets the tolerance.
        """
        count = _round_up(MIN_TRIAL_BATCHES, self.trial_batches)

        def peaks(batch_indices, steps, extra_steps, single=False):
            results = self._trial_results(batch_indices, steps, extra_steps, single)
            if not single:
                final = extra_steps == 0  # as those of blocks
                of_final = {name: values[final] for name, values in results.items()}
                self.trials.add(batch_indices[final], steps[final], of_final)
            return self._compared_by_quantity(results["peak_deflection"])

        masses, checked = swept_masses(self.case, self.batches), None
        batches, runs = self.batches.run_index.shape
        if runs == 1 and batches <= MAX_CHECKED_RUNS:
            checked = np.arange(batches)
        rates, initial_steps, max_steps = self.limits
        search = rates, masses, initial_steps, max_steps, count
        steps, error = choose_step_sizes(peaks, *search, self.tolerance, checked)
        if self.single:
            sample = stratified_sample(rates, count)
            given = sample, steps[sample], np.zeros(sample.size, int)
            error += rounding_error(*(peaks(*given, single) for single in (False, True)))
        return steps, error

    def _compared_by_quantity(self, peaks):
        """Peaks (path, batch, sensor) of each quantity as further runs: they are not compared."""
        quantities = np.array([sensor.quantity for sensor in self.case.sensors])
        return np.concatenate(
            [peaks * (quantities == one) for one in np.unique(quantities)], axis=1
        )

    def run_count(self, block: int) -> int:
        """Number of runs in a block, without padding."""
        rows = slice(block * self.batches_per_block, (block + 1) * self.batches_per_block)
        return int((self.batches.run_index[rows] >= 0).sum())

    def block_function(
        self, steps: Float[np.ndarray, " path"], trials: Trials | None = None
    ) -> Callable[[int], dict[str, np.ndarray]]:
        """Function of a block's number: its results (path, batch, ...) by name.

        `steps` (s) are those of all batches. Results among the `trials` are not computed again;
        nor are those from which an interrupted sweep continues, which agree to the bit.
        """
        integrate, known_results = self._block_integrator(steps), trials or Trials()
        if self.histories:
            known_results = Trials()  # trials have none

        def compute(block: int) -> dict[str, np.ndarray]:
            batch_indices = self._batches_of(block)
            known = known_results.known(batch_indices, steps[batch_indices])
            results = integrate(block, ~known)
            if not known.any():
                return results
            return known_results.completed(results, batch_indices, known)

        return compute

    def _batches_of(self, block: int) -> Int[np.ndarray, " path"]:
        """Indices of the batches of a block; the last one is filled with the first batches."""
        first, count = block * self.batches_per_block, self.batches.run_index.shape[0]
        return np.arange(first, first + self.batches_per_block) % count

    def _block_integrator(self, steps) -> Callable:
        """Function of a block's number and a mask of its batches: results of those in the mask."""
        if self.known_inputs is not None:
            inputs_of_block = self.known_inputs.of_blocks(steps, self.batches_per_block)
            return lambda block, mask: self._integrate_in_c(inputs_of_block(block), mask)
        substeps = None
        if self.histories:
            substeps = steps_per_interval(float(self.schedule.lengths.max()), steps.min())

        def integrate(block, mask):
            rows = self._batches_of(block)
            stepping = steps[rows], np.zeros(rows.size, int)
            return self._integrate_compiled(rows, *stepping, mask, substeps, self.single)

        return integrate

    def _programs_to_compile(self, program, shared_values):
        """Programs that step sizes need, the slowest to compile first, and template arguments."""
        indices = np.zeros(self.batches_per_block, int)
        stepping, mask = self._stepping(indices, np.ones(indices.size), indices), indices > 0
        if self.known_model is not None:
            models = jax.tree.map(lambda leaf: leaf[None], self.known_model.model)
        else:
            model_template, _ = programs.modal_models.template(program, shared_values)
            models = jax.tree.map(lambda leaf: leaf[indices], model_template)
        discretise_arguments = program, mask, models, self.batches.shared_values[indices], stepping
        if self.discretise_separately:
            models = programs.discrete_models.template(*discretise_arguments)
        else:
            models = self._models_without_controller(models)
        yield (
            programs.block_program(program, single=False),
            (program, mask, models, *self._values_of(indices), stepping),
        )
        if self.discretise_separately:
            yield programs.discrete_models, discretise_arguments
        if self.known_model is None:
            yield programs.modal_models, (program, shared_values)

    def _trial_results(self, batch_indices, steps, extra_steps, single):
        """Results of batches by name, on all cores."""
        if self.known_inputs is not None:
            inputs = self.known_inputs.of_batches(batch_indices, steps, extra_steps)
            calls = min(batch_indices.size, os.cpu_count() or 1)
        else:
            inputs, calls = None, -(-batch_indices.size // self.trial_batches)

        def integrate(rows):
            if inputs is not None:
                return self._integrate_in_c(inputs_of_rows(inputs, rows), np.ones(rows.size, bool))
            return self._integrate_few(batch_indices[rows], steps[rows], extra_steps[rows], single)

        parts = np.array_split(np.arange(batch_indices.size), calls)
        results = list(self.pool.map(integrate, parts))
        return {name: np.concatenate([one[name] for one in results]) for name in results[0]}

    def _integrate_few(self, batch_indices, steps, extra_steps, single):
        """Results of at most a block of batches by name."""
        # They are spread over the block, so that each device has its part.
        rows = np.arange(batch_indices.size) * self.batches_per_block // batch_indices.size
        mask = np.zeros(self.batches_per_block, bool)
        mask[rows] = True
        nearest_row = np.cumsum(mask) - 1
        stepping = steps[nearest_row], extra_steps[nearest_row]
        settings = mask, None, single
        results = self._integrate_compiled(batch_indices[nearest_row], *stepping, *settings)
        return {name: values[rows] for name, values in results.items()}

    def _integrate_in_c(self, inputs: native_peaks.NativeInputs, mask):
        """Results by name of batches whose inputs are known; any for those not in the mask."""
        return native_peaks.integrate_peaks(self.shapes.max_loads, mask, inputs)._asdict()

    def _integrate_compiled(self, batch_indices, steps, extra_steps, mask, substeps, single):
        """Results of a block of batches by name; any for those not in the mask."""
        stepping = self._stepping(batch_indices, steps, extra_steps)
        program, models = self.program(substeps), self._models_of(batch_indices)
        shared_values, batched_values = self._values_of(batch_indices)
        if self.discretise_separately:
            models = programs.discrete_models(program, mask, models, shared_values, stepping)
        else:
            models = self._models_without_controller(models)
        arguments = program, mask, models, shared_values, batched_values, stepping
        arguments = jax.tree.map(_to_single_precision, arguments) if single else arguments
        compiled_program = programs.block_program(program, single)
        with _single_precision() if single else contextlib.nullcontext():
            with self._compile_lock:  # other threads wait instead of compiling the same variant
                if (substeps, single) not in self._compiled_variants:
                    compiled_program.precompile(*arguments)()
                    self._compiled_variants.add((substeps, single))
            results = compiled_program(*arguments)
        if compiled_program is programs.native_block:
            return self._integrate_in_c(results, mask)
        return {name: np.asarray(values) for name, values in results.items()}

    def _stepping(self, batch_indices, steps, extra_steps) -> programs.Stepping:
        """Steps of batches; their load events are known if all share a model."""
        events = None
        if self.known_model is not None and self.schedule is None:
            events = jax.tree.map(lambda part: part[batch_indices], self._path_times.load_events)
        return programs.Stepping(steps, extra_steps, events)

    def _models_of(self, batch_indices):
        """Models of batches; one that all share is single."""
        if self.known_model is not None:
            return self.models
        return jax.tree.map(lambda leaf: leaf[batch_indices], self.models)

    def _models_without_controller(self, models):
        """Models for the program of a block: None with a controller, whose loop has its own."""
        return models if self.case.controller is None else None

    def _values_of(self, batch_indices):
        """Shared and batched values of batches."""
        return self.batches.shared_values[batch_indices], self.batches.batched_values[batch_indices]

    def program(self, substeps: int | None = None) -> programs.Program:
        """Data of the programs; with `substeps` per sample interval, also for histories."""
        scheduled = substeps is not None or self.case.controller is not None
        sampling = (self.schedule if scheduled else None), substeps
        shared = self.known_model is not None and self.case.controller is None
        outputs = self.known_model.outputs if shared else None
        return programs.Program(
            self.case,
            self.shapes,
            *self.addresses,
            *sampling,
            known_outputs=outputs,
            devices=self.devices,
        )


@contextlib.contextmanager
def _single_precision():
    """A context of float32; of all its digits in products, of which GPUs keep three by default."""
    with jax.enable_x64(False), jax.default_matmul_precision("highest"):
        yield


def _round_up(count: int, unit: int) -> int:
    """Smallest multiple of a unit that is at least a count."""
    return -(-count // unit) * unit


def _stable_steps(limits) -> Float[np.ndarray, " path"]:
    """Longest stable steps (s), infinite where there is none: such a run fails with any step."""
    return np.where(np.isfinite(limits), limits, np.inf)


def _to_single_precision(leaf):
    """Array in float32 or int32; booleans and static values as they are."""
    if not eqx.is_array(leaf) or leaf.dtype == bool:
        return leaf
    return np.asarray(leaf, np.float32 if np.issubdtype(leaf.dtype, np.floating) else np.int32)
