"""Optimal gains over a crossing by hand-written C, where that was compiled for this machine.

Each function is one of those that XLA runs otherwise, whose derivative it has. Double precision on
CPUs; nobody needs it.
"""

import ctypes

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.numerics import gain_polynomials, stages
from jaxbeam.numerics.batched_linalg import each_lane, in_lanes, lanes_of
from jaxbeam.numerics.coupled_stages import Answers, Coupling, Plant, flows_of_kind
from jaxbeam.numerics.gain_table import AT_ENDS, hermite
from jaxbeam.numerics.intervals import Commands
from jaxbeam.runtime.native_library import Library

LIBRARY = Library(
    name="designs",
    sources=("native_carried.c", "native_flows.c", "native_pieces.c"),
    headers=("native_matrices.h", "native_lanes.h"),
    constants=(("NODES", stages.STAGES),),
    targets=("carried", "coupled", "pieces"),
)


def lacking() -> str | None:
    """Why there are no designs in C here: a sentence, or None if there are."""
    if not jax.config.jax_enable_x64:
        return "in_time = 'native' computes in double precision only; take 'sequential'"
    if not LIBRARY.ready():
        return (
            "in_time = 'native' takes what `jaxbeam native` compiles for this machine, on CPUs; run"
            " that, or take 'sequential', which gives the same gains"
        )
    return None


def _call(name: str, shapes: list[tuple[int, ...]], sizes: tuple[int, ...], *given):
    """What a function of the library makes of arrays: arrays of these shapes.

    The sizes decide how much memory it works in.
    """
    room = getattr(LIBRARY.loaded(), f"{name}_room")
    room.restype = ctypes.c_int64
    results = [jax.ShapeDtypeStruct(shape, float) for shape in (*shapes, (room(*sizes),))]
    call = jax.ffi.ffi_call(LIBRARY.target(name), results, vmap_method="sequential")
    return call(*given)[:-1]


def coupled(
    plant: Plant,
    every: Answers,
    kind: Int[Array, ""],
    coupling: Coupling,
    R: Commands,
    length: Float[Array, ""],
) -> stages.Flow:
    """As `coupled.flows_of_kind`."""
    return stages.Flow(*in_lanes(_coupled, plant, every, kind, coupling, R, length))


@jax.custom_jvp
def _coupled(plant, every, kind, coupling, R, length):
    """The parts of flows, in lanes."""
    effort = each_lane(stages.on_commands, R, length)
    first, changing = (every.inner, every.end, every.toll), (coupling.shape, coupling.rows)
    given = *first, kind, *changing, coupling.direct, coupling.back, effort
    count, (states, inputs) = coupling.shape.shape[0], plant.B.shape[:2]
    values = stages.STAGES * inputs
    results = (states, states), (states, values), (states + values, states + values)
    lanes = lanes_of(given)
    shapes = [(count, *result, lanes) for result in results]
    directions, forces = coupling.shape.shape[2:4]
    return _call("coupled", shapes, (states, inputs, directions, forces, count, lanes), *given)


@_coupled.defjvp
def _coupled_jvp(given, changes):
    def plain(*given):
        return jax.tree.leaves(each_lane(flows_of_kind, *given))

    return jax.jvp(plain, given, changes)


@jax.custom_jvp
def carried(
    parts: stages.Flow,
    effort: Float[Array, "value value _"],
    terminal: Float[Array, "state state _"],
) -> Float[Array, "edge state state lane"]:
    """As `flows.carried`."""
    count, states, values = parts.push.shape[:3]
    effort = jnp.broadcast_to(effort, (values, values, effort.shape[2]))
    given = parts.drift, parts.push, parts.toll, effort, terminal
    shape = count + 1, states, states, lanes_of(given)
    return _call("carried", [shape], (states, values), *given)[0]


@carried.defjvp
def _carried_jvp(given, changes):
    return jax.jvp(stages.carried, given, changes)


@jax.custom_jvp
def pieces(
    plant: Plant,
    shape: Float[Array, "stretch stage direction force _"],
    law: Float[Array, "stretch stage force both _"],
    costs: Float[Array, "edge state state lane"],
    length: Float[Array, " _"],
    Q: Float[Array, "state state _"],
    inverse: Float[Array, "input input _"],
) -> Float[Array, "stretch power input state lane"]:
    """As `gain_pieces.pieces`."""
    given = plant.A, plant.B, plant.E, shape, law, costs, length, Q, inverse
    states, inputs = plant.B.shape[:2]
    fit = np.stack(hermite(AT_ENDS.shape[1])).swapaxes(1, 2)
    count, _, directions, forces = shape.shape[:4]
    found = count, fit.shape[2], inputs, states, lanes_of(given)
    sizes = states, inputs, forces, directions, count
    return _call("pieces", [found], sizes, *given, AT_ENDS, fit)[0]


@pieces.defjvp
def _pieces_jvp(given, changes):
    return jax.jvp(gain_polynomials.pieces, given, changes)
