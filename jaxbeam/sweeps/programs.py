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
from jaxbeam.case.loads import motion
from jaxbeam.integrator import native_peaks
from jaxbeam.integrator.events import Schedule
from jaxbeam.integrator.integrate import longest_step, march, trace
from jaxbeam.integrator.step_matrices import make_rigging
from jaxbeam.integrator.time_grid import even_grid, scheduled_grid
from jaxbeam.model.contact import Traffic, traffic
from jaxbeam.model.modal_model import Rig, rig
from jaxbeam.runtime.compiling import (
    LOW_OPTIMISATION,
    PARALLEL_COMPILATION,
    compiled,
    compiled_with,
)
from jaxbeam.simulation.closed_loop import make_loop
from jaxbeam.simulation.integration_plan import Form


class Job(NamedTuple):
    """What all tasks share: the case, its form, and the addresses of what varies.

    With a `schedule` steps go from edge to edge of it, with `substeps` so many, and histories are
    kept; otherwise there are as many as the pace of a task asks for.
    """

    case: Case
    form: Form
    heavy_addresses: tuple[str, ...]
    light_addresses: tuple[str, ...]
    schedule: Schedule | None = None
    substeps: int | None = None

    def varied(self, heavy) -> Case:
        """The case of a task."""
        return replace(self.case, dict(zip(self.heavy_addresses, heavy, strict=True)))

    def loads(self, heavy, light) -> Traffic:
        """The loads of a task, in all its lanes."""
        varied = self.varied(heavy)

        def press(values):
            pairs = zip(self.light_addresses, values, strict=True)
            loads = traffic(replace(varied, dict(pairs)))
            return loads.inertia[:, 0], loads.weight[:, 0]

        inertia, weight = jax.vmap(press, out_axes=1)(light)
        return Traffic(traffic(varied).motions, inertia, weight)

    def grid(self, assembled, heavy, pace):
        """The steps of a task. Its pace: the longest (s), and how many more between events."""
        varied, (longest, more) = self.varied(heavy), pace
        if self.schedule is None:
            return even_grid(varied, assembled, longest, more)
        finer = jnp.ceil(jnp.max(self.schedule.lengths) / longest).astype(int) + more
        return scheduled_grid(varied, assembled, self.schedule, self.substeps or finer)

    def rigging(self, assembled, heavy, pace, driver=None):
        """The rig of a task on its steps."""
        places = self.varied(heavy).sensor_places
        return make_rigging(assembled, self.grid(assembled, heavy, pace), places, driver)


@compiled_with(**PARALLEL_COMPILATION, **LOW_OPTIMISATION)
def rigs(job: Job, heavy):
    """Rigs of some tasks, and the longest step (s) each allows."""

    def task(values):
        varied = job.varied(values)
        assembled = rig(varied, job.form.layout, job.form.coupled)
        return assembled, longest_step(assembled, varied.loads)

    return jax.lax.map(task, heavy)  # traced in less time than side by side


@compiled
def windows(case, addresses, heavy):
    """Times of entry and exit (task, load, 2) of the loads."""

    def task(values):
        varied = replace(case, dict(zip(addresses, values, strict=True)))
        paths = [motion(load, varied.beam.length) for load in varied.loads]
        return jnp.array([path.window() for path in paths]).reshape(-1, 2)

    return jax.vmap(task)(heavy)


@compiled_with(**PARALLEL_COMPILATION)
def riggings(job: Job, wanted, rigs, heavy, pace):
    """Rigs on the steps of some tasks; a single rig is that of all, and stays single."""
    shared, own = _shared(rigs)

    def task(own, heavy, pace):
        return _without_rig(job.rigging(shared or own, heavy, pace))

    if (shared or jax.tree.map(lambda leaf: leaf[0], own)).modes_per_block == 1:
        # Modes that nothing couples take so little that calling the kernels is what costs.
        found = jax.vmap(task)(own, heavy, pace)
    else:
        found = _map(lambda values: task(*values), wanted, (own, heavy, pace))
    return _with_rig(found, rigs)


@compiled
def block(job: Job, devices: int, wanted, rigs, heavy, light, pace):
    """Results of some tasks: lanes side by side, tasks one after the other, shared by devices.

    `rigs` are on their steps, or bare, and are then put on them here; None with a controller, which
    has a rig of its own.
    """
    if job.form.by_hand and job.substeps is None and light.dtype == jnp.float64:
        part = functools.partial(_by_hand, job)
    else:
        part = functools.partial(_by_xla, job)
        if isinstance(rigs, Rig):
            rigs = riggings(job, wanted, rigs, heavy, pace)
    if devices > 1:
        mesh, spec = Mesh(np.array(jax.local_devices()), ("device",)), PartitionSpec("device")
        part = jax.shard_map(part, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return part(wanted, rigs, heavy, light, pace)


def _by_hand(job: Job, wanted, rigs, heavy, light, pace):
    """Results by C, which wants to know when and where to step, and where to look."""
    shared, own = _shared(rigs)

    def around(own, heavy, light, pace):
        grid = job.grid(shared or own, heavy, pace)
        return grid, job.varied(heavy).sensor_places, job.loads(heavy, light)

    arounds = jax.vmap(around)(own, heavy, light, pace)
    return native_peaks.integrate_peaks(job.form.slots, wanted, rigs, *arounds)._asdict()


def _by_xla(job: Job, wanted, riggings, heavy, light, pace):
    """Results by compiled steps."""
    if riggings is None:
        return _map(lambda values: _driven(job, *values), wanted, (heavy, light, pace))
    shared, own = _shared(riggings.rig)

    def task(values):
        rigging, own, heavy, light = values
        rigging = _with_rig(rigging, shared or own)
        return _results(job, rigging, job.varied(heavy), job.loads(heavy, light))

    return _map(task, wanted, (_without_rig(riggings), own, heavy, light))


def _driven(job: Job, heavy, light, pace):
    """Results of a task with a controller."""
    varied, loads = job.varied(heavy), job.loads(heavy, light)
    driver = make_loop(varied, job.form.layout, loads, job.schedule)
    return _results(job, job.rigging(driver.rig, heavy, pace, driver), varied, loads, driver)


def _results(job: Job, rigging, varied: Case, loads: Traffic, driver=None):
    """What is found of a task, by name."""
    slots, substeps, history = job.form.slots, job.substeps, {}
    if substeps is None:
        best, memory = march(rigging, loads, slots=slots, driver=driver)
    else:
        grid = rigging.grid
        steps = grid.counts.shape[0] * substeps
        best, states, *_, memory = trace(rigging, loads, slots=slots, steps=steps, driver=driver)
        samples = states[substeps * grid.place[job.schedule.samples]]
        rows = rigging.rig.shapes(varied.sensor_places, (0,))[0]
        modal = samples[:, 0 : 2 * varied.beam.modes : 2]
        history["deflection"] = jnp.einsum("sm,tml->lts", rows, modal)
    if driver is not None:
        history["controller_failures"] = driver.failures(memory)
    return best.found()._asdict() | history


def _map(task, wanted, values):
    """What `task` makes of each of the values that are wanted, one after the other."""
    task = jax.jit(task)  # which is then traced once
    shapes = jax.eval_shape(task, jax.tree.map(lambda leaf: leaf[0], values))

    def nothing(values):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    return jax.lax.map(
        lambda given: jax.lax.cond(given[0], task, nothing, given[1]), (wanted, values)
    )


def _shared(rigs: Rig):
    """The rig that all tasks share, if they do, and what each has of its own."""
    if rigs.state_matrix.shape[0] > 1:
        return None, rigs
    return jax.tree.map(lambda leaf: leaf[0], rigs), None


def _without_rig(rigging):
    return eqx.tree_at(lambda rigging: rigging.rig, rigging, None)


def _with_rig(rigging, rig):
    return eqx.tree_at(lambda rigging: rigging.rig, rigging, rig, is_leaf=lambda leaf: leaf is None)
