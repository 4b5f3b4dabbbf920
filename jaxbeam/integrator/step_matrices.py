"""What a chunk of steps needs of the path and the rig alone, the same for all its lanes.

Within a step every contact force is the polynomial through its values at the Gauss nodes, and so
is every command; the rig answers both exactly (`exponentials`). Here the answers become matrices:
what the contact law feels at the nodes, the state at the end, the watched deflections.
"""

import dataclasses
import operator
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Bool, Float, Int

from jaxbeam.integrator.input_policy import AbstractInputPolicy
from jaxbeam.integrator.propagators import GAUSS, LOOKED, Step, propagators
from jaxbeam.integrator.time_grid import Grid
from jaxbeam.model.contact import Traffic, contact_rows
from jaxbeam.model.modal_model import Rig

CHUNK = 16  # steps that are tabulated at once


class CommandTables(eqx.Module):
    """How commands at the nodes act: on the contact law, and on the state at the end."""

    respond: Float[Array, "step row command"]
    push: Float[Array, "step state command"]


class InnerTables(eqx.Module):
    """The states at the nodes, from the state at the start, contact forces and commands."""

    drift: Float[Array, "step inner state"]
    push: Float[Array, "step inner row"]
    command: Float[Array, "step inner command"]


class Tables(eqx.Module):
    """Matrices of each step of a chunk. Rows are (slot, node), commands (node, actuator).

    What is watched follows from state at the start, contact forces and commands, one after the
    other. Steps are active with a load on the beam.
    """

    respond: Float[Array, "step row state"]
    gains: Float[Array, "step row row"]
    drift: Float[Array, "step block side side"]
    push: Float[Array, "step state row"]
    watch: Float[Array, "step looked all"] | None
    commands: CommandTables | None
    inner: InnerTables | None
    active: Bool[Array, " step"]


class Rigging(eqx.Module):
    """A rig on a grid: its propagators, and the rows that give the watched deflections.

    `flexibility` is the static deflection at each watched place under a unit force there, which
    bounds the deflection by the energy. `inner` asks for the states at the nodes too. `size` is
    what makes a watched deflection large; see `both_sides`.
    """

    rig: Rig
    grid: Grid
    step: Step
    watch: Float[Array, "length looked block side"] | None
    watch_push: Float[Array, "length looked force block input"] | None
    flexibility: Float[Array, " place"] | None
    commands: Float[Array, "mode actuator"] | None
    inner: bool = eqx.field(static=True)
    size: Callable = eqx.field(static=True, default=abs)

    @property
    def places(self) -> int:
        """How many places are watched."""
        return 0 if self.flexibility is None else self.flexibility.shape[0]


def make_rigging(
    rig: Rig,
    grid: Grid,
    watched: Float[Array, " place"] | None,
    driver: AbstractInputPolicy | None = None,
) -> Rigging:
    """Propagators for all step lengths of a grid; deflections are watched at some places (m)."""
    driven = driver is not None
    inner = driver is not None and driver.implicit
    step = propagators(rig, grid.lengths, driven)
    each = rig.modes_per_block
    commands = rig.command_matrix[1 : 2 * each : 2] if driven else None
    if watched is None:
        return Rigging(rig, grid, step, None, None, None, commands, inner)
    blocks = rig.state_matrix.shape[0]
    shapes = rig.shapes(watched, (0,))[0]
    rows = shapes.reshape(-1, blocks, each)
    drifts, pushes = _looked(step, np.arange(0, 2 * each, 2))
    watch = jnp.einsum("wbm,lpbmj->lpwbj", rows, drifts)
    push = jnp.einsum("wbm,lpfbmk->lpwfbk", rows, pushes)
    flat = (grid.lengths.shape[0], -1)
    return Rigging(
        rig,
        grid,
        step,
        watch.reshape(*flat, *watch.shape[3:]),
        push.reshape(*flat, *push.shape[3:]),
        _flexibility(rig, shapes),
        commands,
        inner,
    )


def _looked(step: Step, places):
    """Rows of the propagators, (length, point, ...), at the points looked at, start to end."""
    start = jnp.broadcast_to(jnp.eye(step.drift_end.shape[-1]), step.drift_end.shape)
    drifts = jnp.concatenate([start[:, None], step.drift_nodes, step.drift_end[:, None]], axis=1)
    ends = jnp.zeros_like(step.push_end)[:, None], step.push_nodes, step.push_end[:, None]
    return drifts[..., places, :], jnp.concatenate(ends, axis=1)[..., places, :]


def _flexibility(rig: Rig, shapes: Float[Array, "place mode"]) -> Float[Array, " place"]:
    """Static deflection at places under a unit force there; not finite if a mode has no stiffness.

    Modes that nothing couples need no factorisation, which takes longer than all the rest.
    """
    if rig.modes_per_block == 1:
        return jnp.sum(shapes**2 / -rig.state_matrix[:, 1, 0], axis=1)
    bent = solve_triangular(jnp.linalg.cholesky(rig.stiffness()), shapes.T, lower=True)
    return jnp.sum(bent**2, axis=0)


def both_sides(rigging: Rigging) -> Rigging:
    """A rigging that watches every place twice: how far up the beam goes, then how far down."""

    def twice(rows):
        split = rows.reshape(rows.shape[0], len(LOOKED), rigging.places, *rows.shape[2:])
        both = jnp.concatenate([split, -split], axis=2)
        return both.reshape(rows.shape[0], -1, *rows.shape[2:])

    return dataclasses.replace(
        rigging,
        watch=twice(rigging.watch),
        watch_push=twice(rigging.watch_push),
        flexibility=jnp.tile(rigging.flexibility, 2),
        size=operator.pos,
    )


class Path(eqx.Module):
    """Where the loads are in each step of a chunk, and what the contact law feels of the rig there.

    `kind` says which of the grid's lengths a step has; the times of its start and its length are in
    s. Rows of idle slots are zero.
    """

    kind: Int[Array, " step"]
    start: Float[Array, " step"]
    span: Float[Array, " step"]
    slots: Int[Array, "step slot"]
    active: Bool[Array, "step slot"]
    shape: Float[Array, "step slot node block mode"]
    rows: Float[Array, "step slot node block side"]


@jax.named_scope("path")
def follow(rigging: Rigging, traffic: Traffic, slots: int, index: Int[Array, " step"]) -> Path:
    """The path of the loads in the steps with the given indices."""
    rig, grid = rigging.rig, rigging.grid
    panel, start, kind = grid.steps(index)
    span = grid.lengths[kind]
    # As an array: JAX remembers a NumPy constant in the precision in which it met it first.
    times = start[:, None] + span[:, None] * jnp.asarray(GAUSS, span.dtype)
    position, speed, acceleration = (jnp.moveaxis(p, 0, 1) for p in traffic.travel(times))
    active = grid.active[panel]  # step, load
    if slots < len(traffic.motions):
        # Loads on the beam first; those that find no slot are off the beam.
        chosen = jnp.argsort(~active, axis=1)[:, :slots]
        pick = chosen[:, :, None]
        position, speed, acceleration = (
            jnp.take_along_axis(part, pick, axis=1) for part in (position, speed, acceleration)
        )
        active = jnp.take_along_axis(active, chosen, axis=1)
    else:
        chosen = jnp.broadcast_to(jnp.arange(slots), active.shape)
    on = jnp.broadcast_to(active[:, :, None], position.shape)
    shape, rows = contact_rows(rig, position, speed, acceleration, on)
    return Path(kind, start, span, chosen, active, shape, rows)


@jax.named_scope("path")
def tabulate(rigging: Rigging, path: Path) -> Tables:
    """Tables of the steps of a chunk."""
    # Chosen out here, because derivatives of what a branch chooses from go all the way into it.
    first = _of_kind(rigging, path.kind[0])

    def alike(_):
        return _of_one_kind(rigging, first, path.shape, path.rows)

    def one_by_one(_):
        def single(step):
            kind, shape, rows = step
            tables = _of_one_kind(rigging, _of_kind(rigging, kind), shape[None], rows[None])
            return jax.tree.map(lambda table: table[0], tables)

        return jax.lax.map(single, (path.kind, path.shape, path.rows))

    # Mostly all steps of a chunk are equally long, and then share their propagators.
    tables: Any = jax.lax.cond(jnp.all(path.kind == path.kind[0]), alike, one_by_one, None)
    return Tables(*tables, active=jnp.any(path.active, axis=1))


def _of_kind(rigging: Rigging, kind):
    """Propagators of steps of one length, and what they do to what is watched."""
    return jax.tree.map(
        lambda table: jax.lax.dynamic_index_in_dim(table, kind, keepdims=False),
        (rigging.step, rigging.watch, rigging.watch_push),
    )


def _of_one_kind(rigging: Rigging, propagators, shape, rows):
    """Tables of steps of one length, from the shape and contact rows (step, slot, node, ...)."""
    step, watch, watch_push = propagators
    steps, slots, nodes, _, modes = shape.shape
    size = slots * nodes
    states = rows.shape[3] * rows.shape[4]
    respond = jnp.einsum("tpcbi,cbij->tpcbj", rows, step.drift_nodes)
    felt = jnp.einsum("tpcbi,cfbim->tpcfbm", rows, step.push_nodes[..., :modes])
    gains = jnp.einsum("tpcfbm,tqfbm->tpcqf", felt, shape)
    direct = jnp.einsum("tpcbm,tqcbm->tpcq", shape, shape)
    gains = gains + direct[..., None] * np.eye(nodes)[:, None, :]
    push = jnp.einsum("tqfbm,fbim->tbiqf", shape, step.push_end[..., :modes])

    def each(table, *shape):
        table = table.reshape(shape or table.shape)
        return jnp.broadcast_to(table, (steps, *table.shape))

    tables = (
        respond.reshape(steps, size, states),
        gains.reshape(steps, size, size),
        each(step.drift_end),
        push.reshape(steps, states, size),
    )
    if watch is None:
        tables = (*tables, None)
    else:
        looked = watch.shape[0]
        seen = jnp.einsum("lfbm,tqfbm->tlqf", watch_push[..., :modes], shape)
        parts = [each(watch, looked, states), seen.reshape(steps, looked, size)]
        if rigging.commands is not None:
            parts.append(each(watch_push[:, :, 0, modes:], looked, -1))
        tables = (*tables, jnp.concatenate(parts, axis=2))
    commands = inner = None
    if rigging.commands is not None:
        # A rig that takes commands is a single block.
        orders = nodes * rigging.commands.shape[1]
        ordered = step.push_nodes[:, :, 0, :, modes:]
        answer = jnp.einsum("tpci,cfiu->tpcfu", rows[..., 0, :], ordered)
        at_once = jnp.einsum("tpcm,mu->tpcu", shape[..., 0, :], rigging.commands)
        answer = answer + at_once[:, :, :, None] * np.eye(nodes)[:, :, None]
        commands = CommandTables(
            answer.reshape(steps, size, orders),
            each(jnp.moveaxis(step.push_end[:, 0, :, modes:], 1, 0), states, orders),
        )
    if rigging.inner:
        pressed = step.push_nodes[:, :, 0, :, :modes]
        pushed = jnp.einsum("tqfm,cfim->tciqf", shape[..., 0, :], pressed)
        inner = InnerTables(
            each(step.drift_nodes, nodes * states, states),
            pushed.reshape(steps, nodes * states, size),
            each(jnp.moveaxis(ordered, 1, 2), nodes * states, orders),
        )
    return *tables, commands, inner
