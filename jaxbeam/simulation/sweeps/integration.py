"""Integration of the batches of a sweep: in blocks of equal shape by XLA, or a few in NumPy.

Batches differ in shared values, which determine path and model, and the runs of a batch in batched
values. All batches of a block of XLA have equal shapes; `mask` marks those whose results count.
"""

import contextlib
import dataclasses
import functools
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Bool, Float, Int

from jaxbeam.case.case import Case, concrete_case, replace
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.sensors import Sensor
from jaxbeam.model.load_set import LoadSet, load_set, wheel_set
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.model.output_rows import (
    OutputRows,
    StaticCorrection,
    corrected_places,
    sensor_rows,
    static_correction,
)
from jaxbeam.runtime.arrays import Array, vmap, xp
from jaxbeam.runtime.compiling import (
    LOW_OPTIMISATION,
    PARALLEL_COMPILATION,
    Compiled,
    compiled,
)
from jaxbeam.runtime.vectorised import NotVectorisedError, vectorised
from jaxbeam.simulation.closed_loop import closed_loop
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.integrator.discrete_model import discrete_model
from jaxbeam.simulation.integrator.integrate import (
    integrate_history,
    integrate_peaks,
    max_stable_step,
)
from jaxbeam.simulation.integrator.step_size import StaticShapes
from jaxbeam.simulation.integrator.time_grid import (
    EventSchedule,
    LoadEvents,
    grid_by_schedule,
    grid_by_step_length,
)
from jaxbeam.simulation.sweeps.batches import PROFILE_NUMBER, Batches, with_few_runs
from jaxbeam.simulation.sweeps.step_size import PathEvents

# Output rows of the sensors on the modal states, and their static correction.
Outputs = tuple[OutputRows, StaticCorrection | None]


class Stepping(NamedTuple):
    """Steps of a batch: the longest (s), extra steps per panel, and load events, if computed."""

    max_step: Array
    extra_steps: Array
    load_events: LoadEvents | None = None


class Program(NamedTuple):
    """Data of the programs of a sweep: case, static shapes, addresses of the values.

    With a `schedule` steps end at its events; with `substeps` each interval between events has
    this number of steps, and histories are saved, otherwise the step size of each batch determines
    the number. `shared_outputs` are those of all batches, if they share a model. Each of the
    `devices` computes a part of a block. Runs may differ in their number among the `profiles`.
    """

    case: Case
    shapes: StaticShapes
    shared_addresses: tuple[str, ...]
    batched_addresses: tuple[str, ...]
    schedule: EventSchedule | None = None
    substeps: int | None = None
    shared_outputs: Outputs | None = None
    devices: int = 1
    profiles: tuple[AbstractProfile, ...] = ()

    def case_with(self, shared_values) -> Case:
        """Case with the shared values of a batch."""
        return replace(self.case, dict(zip(self.shared_addresses, shared_values, strict=True)))

    def loads(self, shared_values, batched_values) -> LoadSet:
        """Loads of a batch, with a last axis for its runs."""
        varied = self.case_with(shared_values)

        def wheels_of_run(values):
            pairs = dict(zip(self.batched_addresses, values, strict=True))
            pairs.pop(PROFILE_NUMBER, None)  # changes no wheel
            return jax.tree.map(lambda part: part[..., 0], wheel_set(replace(varied, pairs)))

        wheels = vmap(wheels_of_run, out_axes=-1)(batched_values)
        return dataclasses.replace(load_set(varied, self.shapes.layout), wheels=wheels)

    def grid(self, model, shared_values, stepping: Stepping):
        """Time grid of a batch."""
        varied, steps = self.case_with(shared_values), (stepping.max_step, stepping.extra_steps)
        events = stepping.load_events
        if events is not None:
            return grid_by_step_length(varied, model, *steps, given_events=events)
        places = corrected_places(varied, model, varied.sensors)
        if self.schedule is None:
            return grid_by_step_length(varied, model, *steps, places)
        longest = xp.max(self.schedule.lengths)
        substeps = xp.ceil(longest / stepping.max_step).astype(int) + stepping.extra_steps
        return grid_by_schedule(varied, model, self.schedule, self.substeps or substeps, places)

    def discretise(self, model, shared_values, stepping, policy=None):
        """Discrete model of a batch, with the outputs of its sensors."""
        grid = self.grid(model, shared_values, stepping)
        outputs = self.outputs(model, shared_values)
        discrete = discrete_model(model, grid, None, policy, *outputs)
        return dataclasses.replace(discrete, absorbers=len(self.case.absorbers))

    def outputs(self, model, shared_values) -> Outputs:
        """Output rows and static correction of the sensors of a batch."""
        if self.shared_outputs is not None:
            return self.shared_outputs
        return outputs_of(self.case_with(shared_values), model)


def outputs_of(case: Case, model: ModalModel) -> Outputs:
    """Output rows of the sensors of a case on the modal states, and their static correction.

    The last are those of the deflections at its absorbers, twice: of strokes and of forces.
    """
    places = [Sensor(absorber.position) for absorber in case.absorbers]
    sensors = *case.sensors, *places, *places
    rows = sensor_rows(model, case, sensors)
    return rows, static_correction(model, case, sensors, rows)


@compiled(**PARALLEL_COMPILATION, **LOW_OPTIMISATION)
def modal_models(program: Program, shared_values):
    """Models of batches, and their longest stable steps (s)."""

    def model_and_limit(values):
        varied = program.case_with(values)
        model = modal_model(varied, program.shapes.layout, program.shapes.coupled)
        return model, max_stable_step(model, load_set(varied, program.shapes.layout))

    # `map` is less to trace than `vmap`.
    return jax.lax.map(model_and_limit, shared_values)


@compiled(**PARALLEL_COMPILATION)
def discrete_models(program: Program, mask, models, shared_values, stepping):
    """Discrete models of batches; a modal model that all batches share is not repeated."""
    shared_model, own_models = _split_shared_model(models)

    def discretise_one(own_model, shared, step):
        return _without_model(program.discretise(shared_model or own_model, shared, step))

    if (shared_model or jax.tree.map(lambda leaf: leaf[0], own_models)).modes_per_block == 1:
        # Uncoupled modes take little arithmetic, so that calls of kernels dominate: all at once.
        discretised = jax.vmap(discretise_one)(own_models, shared_values, stepping)
    else:
        discretised = _map_masked(
            lambda values: discretise_one(*values), mask, (own_models, shared_values, stepping)
        )
    return _with_model(discretised, models)


def block_program(program: Program, single: bool) -> Compiled:
    """Compiled program of a block: `native_block` for steps in C, or `integrate_block`."""
    native = program.shapes.native and program.substeps is None and not single
    return native_block if native else integrate_block


@compiled
def integrate_block(program: Program, mask, models, shared_values, batched_values, stepping):
    """Results of a block by name; runs of a batch are vectorised, batches follow in sequence.

    `models` are discrete models, or modal models, which are discretised here; None with a
    controller, whose closed loop has a model of its own.
    """
    if isinstance(models, ModalModel):
        models = discrete_models(program, mask, models, shared_values, stepping)
    values = mask, models, shared_values, batched_values, stepping
    return _on_devices(functools.partial(_compiled_results, program), program.devices)(*values)


@compiled(**PARALLEL_COMPILATION, **LOW_OPTIMISATION)
def native_block(
    program: Program, mask, models, shared_values, batched_values, stepping
) -> native_peaks.NativeInputs:
    """Inputs of the C integrator for a block, from modal models."""
    del mask
    shared_model, own_models = _split_shared_model(models)

    def inputs_of_batch(own_model, shared, batched, step):
        model = shared_model or own_model
        of_model = native_peaks.model_inputs(model, *program.outputs(model, shared))
        grid, loads = program.grid(model, shared, step), program.loads(shared, batched)
        return of_model | native_peaks.batch_inputs(grid, loads.cubics(), loads.wheels)

    found = jax.vmap(inputs_of_batch)(own_models, shared_values, batched_values, stepping)
    return native_peaks.NativeInputs(**found)


def _on_devices(integrate, devices: int):
    """Function `integrate` split over the devices, each of which computes a part of the batches."""
    if devices == 1:
        return integrate
    mesh, spec = Mesh(np.array(jax.local_devices()), ("device",)), PartitionSpec("device")
    return jax.shard_map(integrate, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)


def _compiled_results(program: Program, mask, discrete, shared_values, batched_values, stepping):
    """Results by name of the batches of a block, integrated in JAX."""
    if discrete is None:
        return _map_masked(
            lambda values: _closed_loop_results(program, *values),
            mask,
            (shared_values, batched_values, stepping),
        )
    shared_model, own_models = _split_shared_model(discrete.model)

    def batch_results(values):
        own_discrete, own_model, shared, batched = values
        own_discrete = _with_model(own_discrete, shared_model or own_model)
        case, loads = program.case_with(shared), program.loads(shared, batched)
        return results(program, own_discrete, case, loads)

    return _map_masked(
        batch_results, mask, (_without_model(discrete), own_models, shared_values, batched_values)
    )


def _closed_loop_results(program: Program, shared_values, batched_values, stepping):
    """Results by name of a batch with a controller."""
    varied, loads = program.case_with(shared_values), program.loads(shared_values, batched_values)
    policy = closed_loop(varied, program.shapes.layout, loads, program.schedule)
    return results(
        program,
        program.discretise(policy.model, shared_values, stepping, policy),
        varied,
        loads,
        policy,
    )


def results(program: Program, discrete, varied: Case, loads: LoadSet, policy=None):
    """Results of a batch by name: peaks (batch, ...), histories and controller failures."""
    max_loads, substeps, history = program.shapes.max_loads, program.substeps, {}
    if substeps is None:
        running_peaks, memory = integrate_peaks(discrete, loads, max_loads=max_loads, policy=policy)
    else:
        grid = discrete.grid
        steps = grid.counts.shape[0] * substeps
        running_peaks, states, *_, memory = integrate_history(
            discrete, loads, max_loads=max_loads, steps=steps, policy=policy
        )
        samples = states[substeps * grid.event_panels[program.schedule.sample_events]]
        rows = discrete.model.shapes(varied.sensor_positions, (0,))[0]
        modal = samples[:, 0 : 2 * varied.beam.modes : 2]
        history["deflection"] = xp.einsum("sm,tml->lts", rows, modal)
    if policy is not None:
        history["controller_failures"] = policy.failures(memory)
    return running_peaks.peaks()._asdict() | history


def in_sequence() -> bool:
    """Whether the batches of a block are integrated one after the other.

    On a CPU, whose cache holds one of them. An accelerator takes all at once: an H100 4096 runs of
    three modes in 0.13 s, in sequence in 0.31 s.
    """
    return jax.default_backend() == "cpu"


def _map_masked(function, mask, values):
    """Values of a function for each batch in the mask; undefined for the others."""
    if not in_sequence():
        return jax.vmap(function)(values)
    function = jax.jit(function)  # traced once
    shapes = jax.eval_shape(function, jax.tree.map(lambda leaf: leaf[0], values))

    def zeros(_):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    return jax.lax.map(lambda row: jax.lax.cond(row[0], function, zeros, row[1]), (mask, values))


def _split_shared_model(models: ModalModel):
    """Modal model that all batches share, and models of each batch; one of the two is None."""
    if models.state_matrix.shape[0] > 1:
        return None, models
    return jax.tree.map(lambda leaf: leaf[0], models), None


def _without_model(discrete):
    return eqx.tree_at(lambda d: d.model, discrete, None)


def _with_model(discrete, model):
    return eqx.tree_at(lambda d: d.model, discrete, model, is_leaf=lambda leaf: leaf is None)


class Batchwise:
    """Base of the integrators of batches, which take a few batches or a block in a call."""

    most_at_once = sys.maxsize  # batches whose inputs memory allows at once

    def with_few_runs(self, most: int) -> "Batchwise | None":
        """Integrator of the batches reduced to `most` runs; None where that saves nothing."""
        del most
        return None

    def rows_integrator(self, batch_indices, steps, extra_steps, single: bool, per_call: int):
        """Function from rows of `batch_indices` to their results by name; and number of calls."""

        def integrate(rows):
            return self.integrate_few(batch_indices[rows], steps[rows], extra_steps[rows], single)

        count = batch_indices.size
        return integrate, min(count, max(2, -(-count // per_call)))  # two at least, in parallel

    def block_integrator(
        self, batches_of: Callable, steps, extra_steps, substeps: int | None, single: bool
    ):
        """Function from the number of a block and a mask of its batches to results by name.

        `batches_of` gives the batches of a block; `steps` (s) and `extra_steps` are those of all
        batches. Batches outside the mask have undefined results.
        """

        def integrate_block(block, mask):
            rows = batches_of(block)
            return self.integrate(rows, steps[rows], extra_steps[rows], mask, substeps, single)

        return integrate_block


class CompiledBatches(Batchwise):
    """Batches whose runs compiled programs integrate.

    `program` is for peaks; histories are at the events of the `schedule`. Batches share the
    `model`, if it is given; otherwise `make_models` makes their models. `load_events` of all paths
    are computed in the programs unless they are given.
    """

    def __init__(
        self,
        program: Program,
        batches: Batches,
        block_size: int,
        model: ModalModel | None,
        load_events: PathEvents | None,
        schedule: EventSchedule | None,
    ):
        self.program, self.batches, self.block_size = program, batches, block_size
        self.load_events, self.schedule = load_events, schedule
        self.shares_model = model is not None
        self.models = jax.tree.map(lambda leaf: leaf[None], model)
        self.controlled = program.case.controller is not None
        # The C integrator makes its own step matrices.
        self.discretise_separately = not (self.controlled or program.shapes.native)
        # The variant that measures step sizes is compiled first, others on first use.
        self._compile_lock, self._compiled_variants = threading.Lock(), {(None, False)}

    def begin_compilation(self, pool: Executor) -> list[Future]:
        """Start the compilation of the programs of peaks in other threads."""
        return [
            pool.submit(compiled_program.precompile(*arguments))
            for compiled_program, arguments in self._programs_to_compile()
        ]

    def _programs_to_compile(self) -> Iterator[tuple[Compiled, tuple]]:
        """Programs of peaks and template arguments of each, the slowest to compile first."""
        program, indices = self.program, np.zeros(self.block_size, int)
        stepping, mask = self._stepping(indices, np.ones(indices.size), indices), indices > 0
        shared_values, models = self.batches.shared_values[self._model_groups()[0]], self.models
        if not self.shares_model:
            model_template, _ = modal_models.template(program, shared_values)
            models = jax.tree.map(lambda leaf: leaf[indices], model_template)
        discretise_arguments = program, mask, models, self.batches.shared_values[indices], stepping
        if self.discretise_separately:
            models = discrete_models.template(*discretise_arguments)
        elif self.controlled:
            models = None
        yield (
            block_program(program, single=False),
            (program, mask, models, *self._values_of(indices), stepping),
        )
        if self.discretise_separately:
            yield discrete_models, discretise_arguments
        if not self.shares_model:
            yield modal_models, (program, shared_values)

    def _model_groups(self) -> list:
        """Indices of batches whose models are made in one call."""
        count = self.batches.run_index.shape[0]
        blocks = -(-count // self.block_size)
        return list(np.resize(np.arange(count), (blocks, self.block_size)))

    def make_models(self) -> Float[np.ndarray, " path"]:
        """Make the models of all batches, and return their longest stable steps (s)."""
        groups = [
            modal_models(self.program, self.batches.shared_values[group])
            for group in self._model_groups()
        ]
        self.models, limits = jax.tree.map(lambda *leaves: np.concatenate(leaves), *groups)
        return limits[: self.batches.run_index.shape[0]]

    def integrate_few(
        self,
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        extra_steps: Int[np.ndarray, " path"],
        single: bool,
    ) -> dict[str, np.ndarray]:
        """Results (path, batch, ...) by name of at most a block of batches; see `integrate`."""
        # Batches are spread over the block, so that each device has some.
        rows = np.arange(batch_indices.size) * self.block_size // batch_indices.size
        mask = np.zeros(self.block_size, bool)
        mask[rows] = True
        nearest_row = np.cumsum(mask) - 1
        stepping = steps[nearest_row], extra_steps[nearest_row]
        results = self.integrate(batch_indices[nearest_row], *stepping, mask, None, single)
        return {name: values[rows] for name, values in results.items()}

    def integrate(
        self,
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        extra_steps: Int[np.ndarray, " path"],
        mask: Bool[np.ndarray, " path"],
        substeps: int | None,
        single: bool,
    ) -> dict[str, np.ndarray]:
        """Results (path, batch, ...) by name of a block of batches; undefined outside the mask.

        `steps` (s) are upper limits; `extra_steps` are added in each panel. With `substeps` between
        samples results include histories. In `single` precision integration is in float32.
        """
        stepping = self._stepping(batch_indices, steps, extra_steps)
        program, models = self._program(substeps), self._models_of(batch_indices)
        shared_values, batched_values = self._values_of(batch_indices)
        if self.discretise_separately:
            models = discrete_models(program, mask, models, shared_values, stepping)
        arguments = program, mask, models, shared_values, batched_values, stepping
        arguments = jax.tree.map(_to_single_precision, arguments) if single else arguments
        compiled_program = block_program(program, single)
        with _single_precision() if single else contextlib.nullcontext():
            with self._compile_lock:  # other threads wait instead of compiling the same variant
                if (substeps, single) not in self._compiled_variants:
                    compiled_program.precompile(*arguments)()
                    self._compiled_variants.add((substeps, single))
            results = compiled_program(*arguments)
        if compiled_program is native_block:
            given = program.shapes.max_loads, mask, results, len(program.case.absorbers)
            return native_peaks.integrate_peaks(*given)._asdict()
        return {name: np.asarray(values) for name, values in results.items()}

    def _program(self, substeps: int | None) -> Program:
        """`Program` of peaks, or with `substeps` of histories."""
        if substeps is None:
            return self.program
        return self.program._replace(schedule=self.schedule, substeps=substeps)

    def _stepping(self, batch_indices, steps, extra_steps) -> Stepping:
        """Steps of batches, with their load events, if these are given."""
        events = jax.tree.map(lambda part: part[batch_indices], self.load_events)
        return Stepping(steps, extra_steps, events)

    def _models_of(self, batch_indices):
        """Models of batches, or the single model that all share; None with a controller.

        The closed loop has a model of its own.
        """
        if self.controlled:
            return None
        if self.shares_model:
            return self.models
        return jax.tree.map(lambda leaf: leaf[batch_indices], self.models)

    def _values_of(self, batch_indices):
        """Shared and batched values of batches."""
        return self.batches.shared_values[batch_indices], self.batches.batched_values[batch_indices]


@contextlib.contextmanager
def _single_precision():
    """Context of float32 with products at full precision, of which GPUs keep three digits else."""
    with jax.enable_x64(False), jax.default_matmul_precision("highest"):
        yield


def _to_single_precision(leaf):
    """Array in float32 or int32; booleans and static values unchanged."""
    if not eqx.is_array(leaf) or leaf.dtype == bool:
        return leaf
    return np.asarray(leaf, np.float32 if np.issubdtype(leaf.dtype, np.floating) else np.int32)


class NumpyBatches(Batchwise):
    """Batches whose runs NumPy integrates, one batch after the other; see `CompiledBatches`."""

    def __init__(
        self,
        program: Program,
        batches: Batches,
        model: ModalModel | None,
        load_events: PathEvents | None,
        schedule,
    ):
        self.program = program._replace(case=concrete_case(program.case))
        self.batches, self.model, self.schedule = batches, model, schedule
        self.load_events = load_events
        self._cached_case_and_loads = functools.cache(self._case_and_loads)

    def with_few_runs(self, most):
        """Integrator of the batches reduced to `most` of their runs."""
        few = with_few_runs(self.batches, most)
        return NumpyBatches(self.program, few, self.model, self.load_events, self.schedule)

    def make_models(self) -> Float[np.ndarray, " path"]:
        """Longest stable steps (s) of all batches."""
        limits = []
        for batch in range(self.batches.run_index.shape[0]):
            case, loads = self._cached_case_and_loads(batch)
            limits.append(float(max_stable_step(self._model(case), loads)))
        return np.array(limits)

    def integrate_few(self, batch_indices, steps, extra_steps, single):
        """Results (path, batch, ...) by name of some batches; see `integrate`."""
        everyone = np.ones(batch_indices.size, bool)
        return self.integrate(batch_indices, steps, extra_steps, everyone, None, single)

    def integrate(
        self,
        batch_indices: Int[np.ndarray, " path"],
        steps: Float[np.ndarray, " path"],
        extra_steps: Int[np.ndarray, " path"],
        mask: Bool[np.ndarray, " path"],
        substeps: int | None,
        single: bool,
    ) -> dict[str, np.ndarray]:
        """Results (path, batch, ...) by name of batches, zero for those not in the mask."""
        del single  # NumPy takes no sweeps in single precision
        program = self.program
        if substeps is not None:
            program = program._replace(schedule=self.schedule, substeps=substeps)
        results, computed_rows = {}, {}
        for row in np.flatnonzero(mask):
            batch = int(batch_indices[row])
            same = batch, steps[row], extra_steps[row]
            if same in computed_rows:  # small samples name a batch more than once
                for values in results.values():
                    values[row] = values[computed_rows[same]]
                continue
            computed_rows[same], events = row, None
            if self.load_events is not None:
                events = jax.tree.map(lambda part, batch=batch: part[batch], self.load_events)
            stepping = Stepping(steps[row], extra_steps[row], events)
            with np.errstate(all="ignore"):  # as in compiled code
                found = self._results(program, batch, stepping)
            for name, values in found.items():
                if name not in results:
                    results[name] = np.zeros((mask.size, *np.shape(values)))
                results[name][row] = values
        return results

    def _results(self, program: Program, batch: int, stepping) -> dict[str, np.ndarray]:
        shared = self.batches.shared_values[batch]
        case, loads = self._cached_case_and_loads(batch)
        if case.controller is None:
            discrete = program.discretise(self._model(case), shared, stepping)
            return results(program, discrete, case, loads)
        policy = closed_loop(case, program.shapes.layout, loads, program.schedule)
        discrete = program.discretise(policy.model, shared, stepping, policy)
        return results(program, discrete, case, loads, policy)

    def _case_and_loads(self, batch: int) -> tuple[Case, LoadSet]:
        """Case of a batch, and its loads with a last axis for the runs."""
        shared = self.batches.shared_values[batch]
        values = self.batches.batched_values[batch]
        case = self.program.case_with(shared)

        def wheels(values):
            return self.program.loads(shared, values).wheels

        with np.errstate(all="ignore"):
            try:
                found = jax.tree.map(lambda part: part[0], vectorised(wheels)(values[None]))
            except NotVectorisedError:
                found = wheels(values)
        return case, dataclasses.replace(load_set(case, self.program.shapes.layout), wheels=found)

    def _model(self, case: Case) -> ModalModel:
        if self.model is not None:
            return self.model
        return modal_model(case, self.program.shapes.layout, self.program.shapes.coupled)
