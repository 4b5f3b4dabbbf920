"""The runs of a sweep, cut into blocks of equal shape that are compiled once."""

import contextlib
import dataclasses
import os
import re
import threading
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.events import sample_schedule
from jaxbeam.model.modal_model import has_coupling
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.simulation.closed_loop import loop_schedule
from jaxbeam.simulation.integration_plan import StaticShapes, max_concurrent_loads, sample_times
from jaxbeam.sweeps import programs
from jaxbeam.sweeps.batches import Batches
from jaxbeam.sweeps.step_size import (
    CONVERGENCE_ORDER,
    choose_step_sizes,
    rounding_error,
    stratified_sample,
)

MAX_BLOCK_RUNS = 512  # in a block, at most, about: each is one call and one write
MIN_BLOCKS = 8  # at least, if each then has more runs than are tried at once: for all cores
MAX_TRIAL_RUNS = 256  # runs, about, at once while time steps are looked for
MIN_TRIAL_BATCHES = 4  # at which time steps are measured, at least
POSITION_ADDRESS = re.compile(r"beam\.length|(supports|actuators)\.\d+\.(position|start|end)")


class Runner:
    """All tasks of a sweep, cut into blocks of equal shape.

    `single` says that runs are integrated in single precision; rigs and propagators are made in
    double all the same. Raises ValueError if places along the beam change their order within the
    sweep.
    """

    def __init__(
        self, case: Case, batches: Batches, histories: bool, tolerance: float, single: bool = False
    ):
        self.case, self.batches, self.histories, self.tolerance = (
            case,
            batches,
            histories,
            tolerance,
        )
        self.single = single
        self.schedule = None
        if case.controller is not None:
            self.schedule = loop_schedule(case, np.asarray(sample_times(case)))
        elif histories:
            self.schedule = sample_schedule(sample_times(case), True)
        count, batch_size = batches.run_index.shape
        # Twice as many threads as cores: some hand over work while others wait for theirs.
        self.pool = ThreadPoolExecutor(2 * (os.cpu_count() or 1))
        # What finds the steps is compiled below, all else when it is first wanted.
        self._compile_lock, self._compiled_variants = threading.Lock(), {(None, False)}
        # Each device takes an equal part of a block.
        self.devices = len(jax.local_devices())
        max_batches, trial_batches = (
            max(1, runs * self.devices // batch_size) for runs in (MAX_BLOCK_RUNS, MAX_TRIAL_RUNS)
        )
        self.trial_batches = _round_up(min(count, trial_batches), self.devices)
        self.batches_per_block = max(
            self.trial_batches, _round_up(min(count // MIN_BLOCKS, max_batches), self.devices)
        )
        self.block_count = -(-count // self.batches_per_block)
        self.addresses = (batches.shared_addresses, batches.batched_addresses)
        layout = _common_layout(case, batches)
        # Loads, settings of the run and controllers leave the rig as it is: one serves all tasks,
        # but not on several devices, each of which takes its part of them.
        leaves_model_unchanged = ("loads.", "run.", "controller.")
        same_model = all(name.startswith(leaves_model_unchanged) for name in self.addresses[0])
        self.same_model = same_model and self.devices == 1
        parts = (
            [[0]]
            if self.same_model
            else np.resize(np.arange(count), (self.block_count, self.batches_per_block))
        )

        def windows():
            return np.asarray(
                programs.entry_exit_times(case, self.addresses[0], batches.shared_values)
            )

        # One load takes one slot, whenever it comes: what is compiled below need not wait for that.
        max_loads = len(case.loads)
        if max_loads > 1:
            max_loads = max(max_concurrent_loads(window) for window in windows())
        self.shapes = StaticShapes(
            layout, has_coupling(case), max_loads, native_peaks.supports(case) and not single
        )
        # C puts rigs on their steps itself.
        self.discretise_separately = case.controller is None and not self.shapes.native
        program = self.program()
        # What takes longest to compile goes first; meanwhile the others are made ready for it.
        compilations = [
            self.pool.submit(program.precompile(*arguments))
            for program, arguments in self._programs_to_compile(
                program, batches.shared_values[parts[0]]
            )
        ]
        entries, exits = np.moveaxis(windows(), 2, 0)
        for compilation in compilations:
            compilation.result()  # raises what went wrong
        model_groups = [
            programs.modal_models(program, batches.shared_values[part]) for part in parts
        ]
        if self.same_model:
            self.models, limit = model_groups[0]
            limits = np.repeat(np.asarray(limit), count)
        else:
            self.models, limits = jax.tree.map(
                lambda *leaves: np.concatenate(leaves), *model_groups
            )
        limits = limits[:count]
        limits = np.where(np.isfinite(limits), limits, np.inf)  # else the run fails with any step
        duration = _values_at(case, batches, "run.duration")
        times_on_beam = np.minimum(exits, duration[:, None]) - entries
        times_on_beam = np.where(times_on_beam > 0, times_on_beam, duration[:, None])
        crossing_time = np.min(times_on_beam, axis=1, initial=np.inf)
        crossing_time = np.where(np.isfinite(crossing_time), crossing_time, duration)
        self.crossing_rates = 1 / crossing_time
        self.max_steps = np.minimum(limits, duration)
        if case.controller is not None:  # between its samples there is a step at least
            self.max_steps = np.minimum(self.max_steps, self.schedule.lengths.max())
        # As found for beams of one and two spans, 1 to 12 modes, at fast and slow crossings, errors
        # of 1e-7.
        modes = case.beam.modes
        self.initial_steps = crossing_time / (
            20 * modes + 1.84 * crossing_time / limits / np.sqrt(modes)
        )
        self.initial_steps *= (tolerance / 1e-7) ** (1 / CONVERGENCE_ORDER)

    def choose_step_sizes(self) -> tuple[Float[np.ndarray, " task"], float]:
        """Time steps (s) of all tasks, and the relative error of peaks seen with them.

        Raises RuntimeError if no time step meets the tolerance.
        """
        count = _round_up(MIN_TRIAL_BATCHES, self.trial_batches)

        def peaks(chosen, steps, more=0, single=False):
            batches = chosen.size // self.trial_batches
            parts = zip(np.split(chosen, batches), np.split(steps, batches), strict=True)
            found = [
                self._integrate(*part, None, single, more)["peak_deflection"] for part in parts
            ]
            return np.concatenate(found)

        given = self.crossing_rates, self.initial_steps, self.max_steps, count, self.tolerance
        steps, error = choose_step_sizes(peaks, *given, self.pool.map)
        if self.single:
            sample = stratified_sample(self.crossing_rates, count)
            error += rounding_error(
                *(peaks(sample, steps[sample], single=single) for single in (False, True))
            )
        return steps, error

    def run_count(self, number: int) -> int:
        """How many runs are in a block, apart from those that only fill it up."""
        tasks = slice(number * self.batches_per_block, (number + 1) * self.batches_per_block)
        return int((self.batches.run_index[tasks] >= 0).sum())

    def compute_block(
        self, number: int, steps: Float[np.ndarray, " task"]
    ) -> dict[str, np.ndarray]:
        """Results of a block of tasks, (task, lane, ...), with the steps (s) of all tasks."""
        count = self.batches.run_index.shape[0]
        batch_indices = (
            np.arange(number * self.batches_per_block, (number + 1) * self.batches_per_block)
            % count
        )
        substeps = None
        if self.histories:
            substeps = max(1, int(np.ceil(float(self.schedule.lengths.max()) / steps.min())))
        return self._integrate(batch_indices, steps[batch_indices], substeps, self.single)

    def _programs_to_compile(self, program, shared_values):
        """What finds the steps, slowest to compile first, with arguments of the right shapes."""
        model_template, _ = programs.modal_models.template(program, shared_values)
        indices = np.zeros(self.batches_per_block, int)
        step_size = np.ones(self.batches_per_block), indices
        mask = indices > 0
        models = (
            model_template
            if self.same_model
            else jax.tree.map(lambda leaf: leaf[indices], model_template)
        )
        discretise_arguments = program, mask, models, self.batches.shared_values[indices], step_size
        models = (
            programs.discrete_models.template(*discretise_arguments)
            if self.discretise_separately
            else self._models_without_controller(models)
        )
        yield (
            programs.integrate_block,
            (program, self.devices, mask, models, *self._values_of(indices), step_size),
        )
        if self.discretise_separately:
            yield programs.discrete_models, discretise_arguments
        yield programs.modal_models, (program, shared_values)

    def _integrate(self, batch_indices, steps, substeps, single, extra_steps=0):
        # What is not a whole block is spread over it, so that each device has its part.
        rows = np.arange(batch_indices.size) * self.batches_per_block // batch_indices.size
        mask = np.zeros(self.batches_per_block, bool)
        mask[rows] = True
        nearest_row = np.cumsum(mask) - 1
        batch_indices, steps = batch_indices[nearest_row], steps[nearest_row]
        step_size = steps, np.full(batch_indices.size, extra_steps)
        program, models = self.program(substeps), self._models_of(batch_indices)
        discretise_arguments = (
            program,
            mask,
            models,
            self.batches.shared_values[batch_indices],
            step_size,
        )
        models = (
            programs.discrete_models(*discretise_arguments)
            if self.discretise_separately
            else self._models_without_controller(models)
        )
        arguments = program, self.devices, mask, models, *self._values_of(batch_indices), step_size
        arguments = jax.tree.map(_to_single_precision, arguments) if single else arguments
        with jax.enable_x64(False) if single else contextlib.nullcontext():
            with (
                self._compile_lock
            ):  # others wait for the first, instead of compiling the same again
                if (substeps, single) not in self._compiled_variants:
                    programs.integrate_block.precompile(*arguments)()
                    self._compiled_variants.add((substeps, single))
            results = programs.integrate_block(*arguments)
        found = {name: np.asarray(values) for name, values in results.items()}
        # Histories are large, and copied only where some of them were not wanted.
        return found if mask.all() else {name: found[name][rows] for name in found}

    def _models_of(self, batch_indices):
        """Rigs of some tasks."""
        return (
            self.models
            if self.same_model
            else jax.tree.map(lambda leaf: leaf[batch_indices], self.models)
        )

    def _models_without_controller(self, models):
        """Rigs that `programs.integrate_block` takes; none with a controller, which has one of its own."""
        return models if self.case.controller is None else None

    def _values_of(self, batch_indices):
        """What varies in some tasks, and in their lanes."""
        return self.batches.shared_values[batch_indices], self.batches.batched_values[batch_indices]

    def program(self, substeps: int | None = None) -> programs.Program:
        """What all tasks share; with `substeps` from sample to sample histories are kept."""
        scheduled = substeps is not None or self.case.controller is not None
        sampling = (self.schedule if scheduled else None), substeps
        return programs.Program(self.case, self.shapes, *self.addresses, *sampling)


def _round_up(count: int, unit: int) -> int:
    """The next multiple of a unit."""
    return -(-count // unit) * unit


def _values_at(case: Case, batches: Batches, address: str) -> np.ndarray:
    """A number of the case in every task."""
    if address in batches.shared_addresses:
        return batches.shared_values[:, batches.shared_addresses.index(address)]
    return np.full(batches.shared_values.shape[0], float(value_at(case, address)))


def _common_layout(case: Case, batches: Batches) -> Layout:
    """One layout for all tasks: the same order of places, degrees high enough for each.

    Raises ValueError if places change their order along the beam within the sweep.
    """
    varying_positions = [
        i for i, name in enumerate(batches.shared_addresses) if POSITION_ADDRESS.fullmatch(name)
    ]
    if not varying_positions:
        return mesh_layout(case)
    values = np.unique(batches.shared_values[:, varying_positions], axis=0)
    names = [batches.shared_addresses[i] for i in varying_positions]
    layouts = [mesh_layout(replace(case, dict(zip(names, row, strict=True)))) for row in values]
    degrees = (
        np.max([layout.degrees for layout in layouts], axis=0)
        if len({len(layout.degrees) for layout in layouts}) == 1
        else layouts[0].degrees
    )
    common = {dataclasses.replace(layout, degrees=tuple(map(int, degrees))) for layout in layouts}
    if len(common) > 1:
        raise ValueError(
            f"places along the beam change their order over {', '.join(names)}: split the sweep "
            "where supports or patch edges meet"
        )
    return common.pop()


def _to_single_precision(leaf):
    """Numbers in half the length."""
    if not eqx.is_array(leaf) or leaf.dtype == bool:
        return leaf
    return np.asarray(leaf, np.float32 if np.issubdtype(leaf.dtype, np.floating) else np.int32)
