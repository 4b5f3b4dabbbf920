"""The programs of a sweep, each compiled once for all its blocks.

Tasks differ in `heavy` values, which decide the path and the rig, and the lanes of a task in
`light` ones. Of the tasks that a program is given only those `wanted` are worked out; what the
others come out as means nothing.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbeam.case.case import Case, replace
from jaxbeam.case.loads import trajectory
from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.events import EventSchedule
from jaxbeam.integrator.integrate import integrate_history, integrate_peaks, max_stable_step
from jaxbeam.integrator.time_grid import grid_by_schedule, grid_by_step_length
from jaxbeam.model.contact import LoadSet, load_set
from jaxbeam.model.modal_model import ModalModel, modal_model
from jaxbeam.runtime.compiling import (
    LOW_OPTIMISATION,
    PARALLEL_COMPILATION,
    compiled,
)
from jaxbeam.simulation.closed_loop import closed_loop
from jaxbeam.simulation.integration_plan import StaticShapes


class Program(NamedTuple):
    """What all tasks share: the case, its form, and the addresses of what varies.

    With a `schedule` steps go from edge to edge of it, with `substeps` so many, and histories are
    kept; otherwise there are as many as the pace of a task asks for.
    """

    case: Case
    shapes: StaticShapes
    shared_addresses: tuple[str, ...]
    batched_addresses: tuple[str, ...]
    schedule: EventSchedule | None = None
    substeps: int | None = None

    def case_with(self, shared_values) -> Case:
        """The case of a task."""
        return replace(self.case, dict(zip(self.shared_addresses, shared_values, strict=True)))

    def loads(self, shared_values, batched_values) -> LoadSet:
        """The loads of a task, in all its lanes."""
        varied = self.case_with(shared_values)

        def load_parameters(values):
            pairs = zip(self.batched_addresses, values, strict=True)
            loads = load_set(replace(varied, dict(pairs)))
            return loads.inertia[:, 0], loads.weight[:, 0]

        inertia, weight = jax.vmap(load_parameters, out_axes=1)(batched_values)
        return LoadSet(load_set(varied).trajectories, inertia, weight)

    def grid(self, model, shared_values, step_size):
        """The steps of a task. Its pace: the longest (s), and how many more between events."""
        varied, (max_step, extra_steps) = self.case_with(shared_values), step_size
        if self.schedule is None:
            return grid_by_step_length(varied, model, max_step, extra_steps)
        substeps = jnp.ceil(jnp.max(self.schedule.lengths) / max_step).astype(int) + extra_steps
        return grid_by_schedule(varied, model, self.schedule, self.substeps or substeps)

    def discretise(self, model, shared_values, step_size, policy=None):
        """The rig of a task on its steps."""
        positions = self.case_with(shared_values).sensor_positions
        return discrete_model(model, self.grid(model, shared_values, step_size), positions, policy)


@compiled(**PARALLEL_COMPILATION, **LOW_OPTIMISATION)
def modal_models(program: Program, shared_values):
    """Rigs of some tasks, and the longest step (s) each allows."""

    def model_and_limit(values):
        varied = program.case_with(values)
        model = modal_model(varied, program.shapes.layout, program.shapes.coupled)
        return model, max_stable_step(model, varied.loads)

    return jax.lax.map(model_and_limit, shared_values)  # traced in less time than side by side


@compiled
def entry_exit_times(case, addresses, shared_values):
    """Times of entry and exit (task, load, 2) of the loads."""

    def entry_exit_times_of(values):
        varied = replace(case, dict(zip(addresses, values, strict=True)))
        trajectories = [trajectory(load, varied.beam.length) for load in varied.loads]
        return jnp.array([path.entry_exit_times() for path in trajectories]).reshape(-1, 2)

    return jax.vmap(entry_exit_times_of)(shared_values)


@compiled(**PARALLEL_COMPILATION)
def discrete_models(program: Program, mask, models, shared_values, step_size):
    """Rigs on the steps of some tasks; a single rig is that of all, and stays single."""
    shared_model, own_models = _split_shared_model(models)

    def discretise_one(own, heavy, pace):
        return _without_model(program.discretise(shared_model or own, heavy, pace))

    if (shared_model or jax.tree.map(lambda leaf: leaf[0], own_models)).modes_per_block == 1:
        # Modes that nothing couples take so little that calling the kernels is what costs.
        discretised = jax.vmap(discretise_one)(own_models, shared_values, step_size)
    else:
        discretised = _map_masked(
            lambda values: discretise_one(*values), mask, (own_models, shared_values, step_size)
        )
    return _with_model(discretised, models)


@compiled
def integrate_block(
    program: Program, devices: int, mask, models, shared_values, batched_values, step_size
):
    """Results of some tasks: lanes side by side, tasks one after the other, shared by devices.

    `models` are on their steps, or bare, and are then put on them here; None with a controller, which
    has a rig of its own.
    """
    if program.shapes.native and program.substeps is None and batched_values.dtype == jnp.float64:
        integrate = functools.partial(_native_results, program)
    else:
        integrate = functools.partial(_compiled_results, program)
        if isinstance(models, ModalModel):
            models = discrete_models(program, mask, models, shared_values, step_size)
    if devices > 1:
        mesh, spec = Mesh(np.array(jax.local_devices()), ("device",)), PartitionSpec("device")
        integrate = jax.shard_map(
            integrate, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
        )
    return integrate(mask, models, shared_values, batched_values, step_size)


def _native_results(program: Program, mask, models, shared_values, batched_values, step_size):
    """Results by C, which wants to know when and where to step, and where to look."""
    shared_model, own_models = _split_shared_model(models)

    def integration_inputs(own, heavy, light, pace):
        grid = program.grid(shared_model or own, heavy, pace)
        return grid, program.case_with(heavy).sensor_positions, program.loads(heavy, light)

    inputs = jax.vmap(integration_inputs)(own_models, shared_values, batched_values, step_size)
    return native_peaks.integrate_peaks(program.shapes.max_loads, mask, models, *inputs)._asdict()


def _compiled_results(program: Program, mask, discrete, shared_values, batched_values, step_size):
    """Results by compiled steps."""
    if discrete is None:
        return _map_masked(
            lambda values: _closed_loop_results(program, *values),
            mask,
            (shared_values, batched_values, step_size),
        )
    shared_model, own_models = _split_shared_model(discrete.model)

    def task(values):
        rigging, own, heavy, light = values
        rigging = _with_model(rigging, shared_model or own)
        return _results(program, rigging, program.case_with(heavy), program.loads(heavy, light))

    return _map_masked(
        task, mask, (_without_model(discrete), own_models, shared_values, batched_values)
    )


def _closed_loop_results(program: Program, shared_values, batched_values, step_size):
    """Results of a task with a controller."""
    varied, loads = program.case_with(shared_values), program.loads(shared_values, batched_values)
    policy = closed_loop(varied, program.shapes.layout, loads, program.schedule)
    return _results(
        program,
        program.discretise(policy.model, shared_values, step_size, policy),
        varied,
        loads,
        policy,
    )


def _results(program: Program, discrete, varied: Case, loads: LoadSet, policy=None):
    """What is found of a task, by name."""
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
        history["deflection"] = jnp.einsum("sm,tml->lts", rows, modal)
    if policy is not None:
        history["controller_failures"] = policy.failures(memory)
    return running_peaks.peaks()._asdict() | history


def _map_masked(function, mask, values):
    """What `function` makes of each of the values that are wanted, one after the other."""
    function = jax.jit(function)  # which is then traced once
    shapes = jax.eval_shape(function, jax.tree.map(lambda leaf: leaf[0], values))

    def zeros(values):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    return jax.lax.map(
        lambda given: jax.lax.cond(given[0], function, zeros, given[1]), (mask, values)
    )


def _split_shared_model(models: ModalModel):
    """The rig that all tasks share, if they do, and what each has of its own."""
    if models.state_matrix.shape[0] > 1:
        return None, models
    return jax.tree.map(lambda leaf: leaf[0], models), None


def _without_model(discrete):
    return eqx.tree_at(lambda rigging: rigging.model, discrete, None)


def _with_model(discrete, model):
    return eqx.tree_at(
        lambda rigging: rigging.model, discrete, model, is_leaf=lambda leaf: leaf is None
    )
