"""The programs of a sweep, each compiled once for all its blocks.

A case comes with the addresses of what varies and, task by task, its values there. Tasks differ in
`heavy` values, which decide the path and the rig, and the lanes of a task in `light` ones. Of the
tasks that a program is given only those `wanted` are worked out; the others come out as zeros.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxbeam.case import replace
from jaxbeam.compiling import ROUGHLY, SIDE_BY_SIDE, compiled, compiled_with
from jaxbeam.dynamics import Traffic, traffic
from jaxbeam.grid import even_grid, scheduled_grid
from jaxbeam.integrate import longest_step, march, trace
from jaxbeam.loads import motion
from jaxbeam.loop import make_loop
from jaxbeam.record import never_as_nan
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


def _prepare(case, addresses, schedule, substeps, assembled, heavy, pace, driver=None):
    """A rig on the grid of one task. Its pace: the longest step (s), and how many more between."""
    varied = _varied(case, addresses, heavy)
    longest, more = pace
    if schedule is None:
        grid = even_grid(varied, assembled, longest, more)
    else:
        finer = jnp.ceil(jnp.max(schedule.lengths) / longest).astype(int) + more
        grid = scheduled_grid(varied, assembled, schedule, substeps or finer)
    return make_rigging(assembled, grid, varied.sensor_places, driver)


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
    """Rigs on the grids of some tasks; a single rig is that of all."""

    def task(rig, *values):
        return _prepare(case, addresses, schedule, substeps, rig, *values)

    shared = rigs.state_matrix.shape[0] == 1
    if rigs.modes_per_block == 1:
        # Modes that nothing couples take so little that calling the kernels is what costs.
        rigs = jax.tree.map(lambda leaf: leaf[0], rigs) if shared else rigs
        return jax.vmap(task, (None if shared else 0, 0, 0))(rigs, heavy, pace)
    if shared:
        rigs = jax.tree.map(lambda leaf: jnp.repeat(leaf, wanted.shape[0], axis=0), rigs)
    return _map(lambda values: task(*values), wanted, (rigs, heavy, pace))


@compiled
def block(case, form, addresses, devices, schedule, substeps, wanted, rigs, heavy, light, pace):
    """Results of some tasks: lanes side by side, tasks one after the other, shared by devices.

    `rigs` are on their grids, or bare, and are then put on them here.
    """
    heavy_addresses, light_addresses = addresses
    if isinstance(rigs, Rig):
        given = case, heavy_addresses, schedule, substeps, wanted, rigs, heavy, pace
        rigs = riggings(*given)

    def task(values):
        rigging, heavy, light, pace = values
        varied = _varied(case, heavy_addresses, heavy)

        def press(values):
            loads = traffic(_varied(varied, light_addresses, values))
            return loads.inertia[:, 0], loads.weight[:, 0]

        inertia, weight = jax.vmap(press, out_axes=1)(light)
        loads = Traffic(traffic(varied).motions, inertia, weight)
        driver = None
        if rigging is None:
            driver = make_loop(varied, form.layout, loads, schedule)
            given = driver.rig, heavy, pace, driver
            rigging = _prepare(case, heavy_addresses, schedule, substeps, *given)
        if substeps is None:
            best, memory = march(
                rigging, loads, slots=form.slots, driver=driver, by_hand=form.by_hand
            )
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
        peak, time = best.peak()
        return {
            "peak_deflection": peak.T,
            "peak_time": time.T,
            "lowest_contact_force": best.lowest.T,
            "contact_lost_time": never_as_nan(best.lost).T,
            **history,
        }

    part = functools.partial(_map, task)
    if devices > 1:
        mesh, spec = Mesh(np.array(jax.local_devices()), ("device",)), PartitionSpec("device")
        part = jax.shard_map(part, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    return part(wanted, (rigs, heavy, light, pace))
