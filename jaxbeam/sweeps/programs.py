"""Compiled programs of a sweep, the same for all its blocks.

Batches differ in shared values, which determine path and model, and the runs of a batch in batched
values. All batches of a block have equal shapes; `mask` marks those whose results count.
"""

import dataclasses
import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbeam.case.case import Case, replace
from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.integrate import (
    integrate_history,
    integrate_peaks,
    max_stable_step,
)
from jaxbeam.integrator.static_shapes import StaticShapes
from jaxbeam.integrator.time_grid import (
    EventSchedule,
    LoadEvents,
    grid_by_schedule,
    grid_by_step_length,
)
from jaxbeam.model.load_set import LoadSet, load_set, wheel_set
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.model.sensing.output_rows import (
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
from jaxbeam.simulation.closed_loop import closed_loop

# Rows of what the sensors measure, and their static correction.
Outputs = tuple[OutputRows, StaticCorrection | None]


class Stepping(NamedTuple):
    """Steps of a batch: the longest (s), extra steps per panel, and load events, if known."""

    max_step: Array
    extra_steps: Array
    load_events: LoadEvents | None = None


class Program(NamedTuple):
    """Data of the programs of a sweep: case, static shapes, addresses of the values.

    With a `schedule` steps end at its events; with `substeps` there are so many between events, and
    histories are saved, otherwise the step size of each batch determines their number.
    `known_outputs` are those of all batches, if they share them. Each of the `devices` computes a
    part of a block.
    """

    case: Case
    shapes: StaticShapes
    shared_addresses: tuple[str, ...]
    batched_addresses: tuple[str, ...]
    schedule: EventSchedule | None = None
    substeps: int | None = None
    known_outputs: Outputs | None = None
    devices: int = 1

    def case_with(self, shared_values) -> Case:
        """Case of a batch."""
        return replace(self.case, dict(zip(self.shared_addresses, shared_values, strict=True)))

    def loads(self, shared_values, batched_values) -> LoadSet:
        """Loads of a batch, in all its runs."""
        varied = self.case_with(shared_values)

        def wheels_of_run(values):
            pairs = zip(self.batched_addresses, values, strict=True)
            wheels = wheel_set(replace(varied, dict(pairs)))
            if wheels.massless:  # known to be, which `vmap` would hide: no equations of contact
                wheels = eqx.tree_at(_inertia, wheels, None)
            return jax.tree.map(lambda part: part[..., 0], wheels)

        wheels = vmap(wheels_of_run, out_axes=-1)(batched_values)
        if wheels.inertia is None:
            massless = np.zeros(wheels.weight.shape)
            wheels = eqx.tree_at(_inertia, wheels, massless, is_leaf=lambda leaf: leaf is None)
        return dataclasses.replace(load_set(varied, self.shapes.layout), wheels=wheels)

    def grid(self, model, shared_values, stepping: Stepping):
        """Time grid of a batch."""
        varied, steps = self.case_with(shared_values), (stepping.max_step, stepping.extra_steps)
        known = stepping.load_events
        if known is not None:
            return grid_by_step_length(varied, model, *steps, known_events=known)
        places = corrected_places(varied, model, varied.sensors)
        if self.schedule is None:
            return grid_by_step_length(varied, model, *steps, places)
        longest = xp.max(self.schedule.lengths)
        substeps = xp.ceil(longest / stepping.max_step).astype(int) + stepping.extra_steps
        return grid_by_schedule(varied, model, self.schedule, self.substeps or substeps, places)

    def discretise(self, model, shared_values, stepping, policy=None):
        """Discrete model of a batch, with peaks of what the sensors measure."""
        grid = self.grid(model, shared_values, stepping)
        return discrete_model(model, grid, None, policy, *self.outputs(model, shared_values))

    def outputs(self, model, shared_values) -> Outputs:
        """Outputs of a batch."""
        if self.known_outputs is not None:
            return self.known_outputs
        return outputs_of(self.case_with(shared_values), model)


def outputs_of(case: Case, model: ModalModel) -> Outputs:
    """Rows of what the sensors of a case measure, and their static correction."""
    rows = sensor_rows(model, case, case.sensors)
    return rows, static_correction(model, case, case.sensors, rows)


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
    """Discrete models of batches; a single model is shared by all and stays single."""
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
    """The program of a block: `native_block`, whose steps are taken in C, or `integrate_block`."""
    native = program.shapes.native and program.substeps is None and not single
    return native_block if native else integrate_block


@compiled
def integrate_block(program: Program, mask, models, shared_values, batched_values, stepping):
    """Results of a block by name: runs of a batch vectorised, batches in sequence on each device.

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
    """What the C integrator needs to know of a block, from modal models."""
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
    """A function of arrays of batches, each device computing its part of them."""
    if devices == 1:
        return integrate
    mesh, spec = Mesh(np.array(jax.local_devices()), ("device",)), PartitionSpec("device")
    return jax.shard_map(integrate, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)


def _compiled_results(program: Program, mask, discrete, shared_values, batched_values, stepping):
    """Results of the integrator in JAX."""
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
    """Results of a batch with a controller."""
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
    """Values of a function for each marked batch; any for the others."""
    if not in_sequence():
        return jax.vmap(function)(values)
    function = jax.jit(function)  # traced once
    shapes = jax.eval_shape(function, jax.tree.map(lambda leaf: leaf[0], values))

    def zeros(_):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    return jax.lax.map(lambda row: jax.lax.cond(row[0], function, zeros, row[1]), (mask, values))


def _inertia(wheels):
    return wheels.inertia


def _split_shared_model(models: ModalModel):
    """Model that all batches share, or None, and the models of each, or None."""
    if models.state_matrix.shape[0] > 1:
        return None, models
    return jax.tree.map(lambda leaf: leaf[0], models), None


def _without_model(discrete):
    return eqx.tree_at(lambda d: d.model, discrete, None)


def _with_model(discrete, model):
    return eqx.tree_at(lambda d: d.model, discrete, model, is_leaf=lambda leaf: leaf is None)
