"""The programs of a sweep, each compiled once for all its blocks.

A case comes with the addresses of what varies and, task by task, its values there. Tasks differ in
`heavy` values, which decide the path and the rig, and the lanes of a task in `light` ones. Of the
tasks that a program is given only those `wanted` are worked out; the others come out as zeros.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbeam import native
from jaxbeam.case import replace
from jaxbeam.compiling import ROUGHLY, SIDE_BY_SIDE, compiled, compiled_with
from jaxbeam.dynamics import Traffic, traffic
from jaxbeam.grid import even_grid, scheduled_grid
from jaxbeam.integrate import longest_step, march, trace
from jaxbeam.loads import motion
from jaxbeam.loop import make_loop
from jaxbeam.rig import Rig, rig
from jaxbeam.tables import make_rigging


def _varied(case, addresses, values):
    return replace(case, dict(zip(addresses, values, strict=True)))


@compiled_with(**SIDE_BY_SIDE, **ROUGHLY)
def rigs(case, form, addresses, heavy):
    """Rigs of some tasks, and the longest step (s) each allows."""

    def task(values):
        assembled = rig(_varied(case, addresses, values), form.layout, form.coupled)
        return assembled, longest_step(assembled, case.loads)

    return jax.lax.map(task, heavy)  # traced in less time than side by side


@compiled
def windows(case, addresses, heavy):
    """Times of entry and exit (task, load, 2) of the loads."""

    def task(values):
        varied = _varied(case, addresses, values)
        paths = [motion(load, varied.beam.length) for load in varied.loads]
        return jnp.array([path.window() for path in paths]).reshape(-1, 2)

    return jax.vmap(task)(heavy)


def _grid(case, addresses, schedule, substeps, assembled, heavy, pace):
    """The grid of one task. Its pace: the longest step (s), and how many more between events."""
    varied = _varied(case, addresses, heavy)
    longest, more = pace
    if schedule is None:
        return even_grid(varied, assembled, longest, more)
    finer = jnp.ceil(jnp.max(schedule.lengths) / longest).astype(int) + more
    return scheduled_grid(varied, assembled, schedule, substeps or finer)


def _prepare(case, addresses, schedule, substeps, assembled, heavy, pace, driver=None):
    """A rig on the grid of one task."""
    grid = _grid(case, addresses, schedule, substeps, assembled, heavy, pace)
    places = _varied(case, addresses, heavy).sensor_places
    return make_rigging(assembled, grid, places, driver)


def _map(task, wanted, values):
    """What `task` makes of each of the values that are wanted, one after the other."""
    task = jax.jit(task)  # which is then traced once
    shapes = jax.eval_shape(task, jax.tree.map(lambda leaf: leaf[0], values))

    def nothing(values):
        return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)

    return jax.lax.map(
        lambda given: jax.lax.cond(given[0], task, nothing, given[1]), (wanted, values)
    )


@compiled_with(**SIDE_BY_SIDE)
def riggings(case, addresses, schedule, substeps, wanted, rigs, heavy, pace):
    """Rigs on the grids of some tasks; a single rig is that of all, and stays single."""

    def task(rig, *values):
        rigging = _prepare(case, addresses, schedule, substeps, rig, *values)
        return _without_rig(rigging)

    shared, given = _shared(rigs)
    if (shared or jax.tree.map(lambda leaf: leaf[0], rigs)).modes_per_block == 1:
        # Modes that nothing couples take so little that calling the kernels is what costs.
        found = jax.vmap(task, (None if shared else 0, 0, 0))(shared or given, heavy, pace)
    else:
        found = _map(
            lambda values: task(shared or values[0], *values[1:]), wanted, (given, heavy, pace)
        )
    return _with_rig(found, rigs)


def _without_rig(rigging):
    return eqx.tree_at(lambda rigging: rigging.rig, rigging, None)


def _with_rig(rigging, rig):
    return eqx.tree_at(lambda rigging: rigging.rig, rigging, rig, is_leaf=lambda leaf: leaf is None)


def _shared(rigs):
    """The rig that all tasks share, if they do, and what is theirs otherwise."""
    if rigs.state_matrix.shape[0] > 1:
        return None, rigs
    return jax.tree.map(lambda leaf: leaf[0], rigs), None


@compiled
def block(case, form, addresses, devices, schedule, substeps, wanted, rigs, heavy, light, pace):
    """Results of some tasks: lanes side by side, tasks one after the other, shared by devices.

    `rigs` are on their grids, or bare, and are then put on them here.
    """
    heavy_addresses, light_addresses = addresses
    clocked = heavy_addresses, schedule, substeps

    def loads_of(heavy, light):
        """The loads of a task, in all its lanes."""
        varied = _varied(case, heavy_addresses, heavy)

        def press(values):
            loads = traffic(_varied(varied, light_addresses, values))
            return loads.inertia[:, 0], loads.weight[:, 0]

        inertia, weight = jax.vmap(press, out_axes=1)(light)
        return Traffic(traffic(varied).motions, inertia, weight)

    def task(rigging, heavy, light, pace):
        varied, loads, driver = _varied(case, heavy_addresses, heavy), loads_of(heavy, light), None
        if rigging is None:
            driver = make_loop(varied, form.layout, loads, schedule)
            rigging = _prepare(case, *clocked, driver.rig, heavy, pace, driver)
        if substeps is None:
            best, memory = march(rigging, loads, slots=form.slots, driver=driver)
            history = {}
        else:
            grid = rigging.grid
            steps = grid.counts.shape[0] * substeps
            best, states, *_, memory = trace(
                rigging, loads, slots=form.slots, steps=steps, driver=driver
            )
            edges = substeps * grid.place[schedule.samples]
            samples = states[edges][:, 0 : 2 * varied.beam.modes : 2]
            rows = rigging.rig.shapes(varied.sensor_places, (0,))[0]
            history = {"deflection": jnp.einsum("sm,tml->lts", rows, samples)}
        if driver is not None:
            history["controller_failures"] = driver.failures(memory)
        return best.found()._asdict() | history

    def by_hand(wanted, rigs, heavy, light, pace):
        shared, given = _shared(rigs)

        def around(rig, heavy, light, pace):
            grid = _grid(case, *clocked, shared or rig, heavy, pace)
            places = _varied(case, heavy_addresses, heavy).sensor_places
            return grid, places, loads_of(heavy, light)

        around_all = jax.vmap(around)(given, heavy, light, pace)
        return native.march(form.slots, wanted, rigs, *around_all)._asdict()

    def by_xla(wanted, rigs, heavy, light, pace):
        if rigs is None:
            return _map(lambda values: task(None, *values), wanted, (heavy, light, pace))
        shared, own = _shared(rigs.rig)

        def one(values):
            rigging, own, *rest = values
            return task(_with_rig(rigging, shared or own), *rest)

        return _map(one, wanted, (_without_rig(rigs), own, heavy, light, pace))

    if form.by_hand and substeps is None and light.dtype == jnp.float64:
        part = by_hand
    else:
        part = by_xla
        if isinstance(rigs, Rig):
            rigs = riggings(case, *clocked, wanted, rigs, heavy, pace)
    if devices > 1:
        mesh, spec = Mesh(np.array(jax.local_devices()), ("device",)), PartitionSpec("device")
        part = jax.shard_map(part, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return part(wanted, rigs, heavy, light, pace)
