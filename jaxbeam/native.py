"""A chunk of steps by hand-written C (`native.c`), where that was compiled for this machine.

XLA makes of a step some forty small loops over the lanes; by hand it is one. The C is compiled
once, when asked for, by the C compiler of the machine, into the user's cache folder. Sweeps then
use it where they look for peaks alone (not histories), without a controller, in double precision,
on CPUs. Nobody needs it.
"""

import ctypes
import itertools
import math
import operator
import pathlib
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case import Case
from jaxbeam.exponentials import GAUSS, LOOKED, NODES
from jaxbeam.extremes import NEAR, Extremes
from jaxbeam.native_library import Library
from jaxbeam.peaks import CLIMBS, ROUNDINGS, STARTS, VERTEX_ROUNDS, reach, through
from jaxbeam.tables import CHUNK, Path, Rigging

FILL = 8  # numbers that fill whole vector registers of any machine
CONSTANTS = {
    "FILL": FILL,
    "STEPS": CHUNK,
    "NODES": NODES,
    "POINTS": len(LOOKED),
    "NEAR": NEAR,
    "BESIDE_END": (NEAR - 1) * float(np.diff(LOOKED)[0] / np.diff(LOOKED).max()) ** 2,
    "REACH": reach(LOOKED),
    "ROUNDS": VERTEX_ROUNDS,
    "STARTS": STARTS,
    "CLIMBS": CLIMBS,
    "SLACK": ROUNDINGS * sys.float_info.epsilon,
}
# Deflections that count, by what makes them large.
SIDES = {abs: "both_sides", operator.pos: "one_side"}
PARTS = ("chunk", "places")  # of the work that are done in C


def _function(part: str, size: Callable) -> str:
    """The function of the library for a part of the work and deflections that count."""
    return f"{part}_of_{SIDES[size]}"


LIBRARY = Library(
    name="native",
    sources=("native.c",),
    headers=("native_lanes.h", "native_peaks.h", "native_tables.h"),
    constants=tuple(CONSTANTS.items()),
    targets=tuple(_function(*pair) for pair in itertools.product(PARTS, SIDES)),
)


def binary() -> pathlib.Path:
    """Where the compiled C is, or would be: a file for this source, this machine and this JAX."""
    return LIBRARY.binary()


def build() -> pathlib.Path:
    """Compile the C for this machine and return the library's path; sweeps use it from then on.

    Raises RuntimeError without a C compiler, or with what it complains of; OSError if the cache
    folder cannot be written.
    """
    return LIBRARY.build()


def remove() -> None:
    """Remove what was compiled for this machine, if it was: sweeps do without again."""
    LIBRARY.remove()


def serves(case: Case) -> bool:
    """Whether steps of this case, if its peaks are swept, are those in C."""
    return case.controller is None and ready()


def ready() -> bool:
    """Whether the C is compiled for this machine, and of use: computing on a CPU."""
    return LIBRARY.ready()


def _target(part: str, size: Callable) -> str:
    """The name under which XLA knows a function of the library."""
    return LIBRARY.target(_function(part, size))


def prepare(rigging: Rigging) -> tuple:
    """The propagators as `chunk` takes them."""
    step = rigging.step
    return (
        _last(step.drift_nodes, 1),
        _last(step.push_nodes, 2),
        step.drift_end.swapaxes(-1, -2),
        _last(step.push_end, 1),
        jnp.moveaxis(rigging.watch, 1, -1),
        _last(rigging.watch_push, 1),
    )


def _last(part, axis: int):
    """With an axis as the last, padded to fill registers."""
    part = jnp.moveaxis(part, axis, -1)
    return jnp.pad(part, [(0, 0)] * (part.ndim - 1) + [(0, -part.shape[-1] % FILL)])


@jax.named_scope("native")
def chunk(
    prepared: tuple,
    path: Path,
    inertia: Float[Array, "load lane"],
    weight: Float[Array, "load lane"],
    state: Float[Array, "state lane"],
    best: Extremes,
) -> tuple[Float[Array, "state lane"], Extremes]:
    """The state after a chunk of steps, and the extremes so far, from those before it.

    Steps without commands of a driver, in double precision; only if `ready`. `prepared` is what
    `prepare` makes of the rigging.
    """
    changed = state, *jax.tree.leaves(best)
    shape, rows = _last(path.shape, 2), _last(path.rows, 2)
    given = (
        *(*prepared, path.kind, path.start, path.span, path.slots, path.active, shape, rows),
        *(inertia, weight, np.asarray(GAUSS), through(LOOKED)[: len(LOOKED)].T, np.asarray(LOOKED)),
    )
    room_of = LIBRARY.loaded().chunk_room
    room_of.restype = ctypes.c_int64
    room = room_of(state.shape[0], path.slots.shape[1], best.score.shape[0])
    call = jax.ffi.ffi_call(
        _target("chunk", best.size),
        [jax.ShapeDtypeStruct(part.shape, part.dtype) for part in (*changed, np.empty(room))],
        vmap_method="sequential",
        input_output_aliases={len(given) + i: i for i in range(len(changed))},
    )
    state, *leaves, _ = call(*given, *changed)
    return state, jax.tree.unflatten(jax.tree.structure(best), leaves)


@jax.named_scope("native")
def find(
    samples: Float[Array, "point *rest"], points: tuple[float, ...], size: Callable
) -> Float[Array, " *rest"]:
    """What `peaks.find` finds, of samples at the points of a step that are looked at."""
    rest = samples.shape[1:]
    call = jax.ffi.ffi_call(
        _target("places", size),
        jax.ShapeDtypeStruct((math.prod(rest),), samples.dtype),
        vmap_method="sequential",
    )
    return call(samples.reshape(len(points), -1), through(points)[: len(points)].T).reshape(rest)
