"""Peaks of many runs by hand-written C (`native.c`), where that was compiled for this machine.

XLA makes of a step some forty small loops over the lanes; by hand it is one, and so are all steps
of all tasks. The C is compiled once, when asked for, by the C compiler of the machine, into the
user's cache folder. Sweeps then use it where they look for peaks alone (not histories), without a
controller, in double precision, on CPUs. Nobody needs it.
"""

import ctypes
import functools
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbeam.case.case import Case
from jaxbeam.integrator.integrate import march as plain_march
from jaxbeam.integrator.propagators import DOUBLINGS, GAUSS, LOOKED, NODES, TERMS, lagrange
from jaxbeam.integrator.running_peaks import NEAR, Found
from jaxbeam.integrator.step_matrices import CHUNK, make_rigging
from jaxbeam.integrator.time_grid import Grid
from jaxbeam.model.contact import Traffic
from jaxbeam.model.modal_model import Rig
from jaxbeam.numerics.peak_search import CLIMBS, ROUNDINGS, STARTS, VERTEX_ROUNDS, reach, through
from jaxbeam.runtime.native_library import Library

FILL = 8  # numbers that fill whole vector registers of any machine
CONSTANTS = {
    "FILL": FILL,
    "STEPS": CHUNK,
    "NODES": NODES,
    "TERMS": TERMS,
    "DOUBLINGS": DOUBLINGS,
    "POINTS": len(LOOKED),
    "NEAR": NEAR,
    "BESIDE_END": (NEAR - 1) * float(np.diff(LOOKED)[0] / np.diff(LOOKED).max()) ** 2,
    "REACH": reach(LOOKED),
    "ROUNDS": VERTEX_ROUNDS,
    "STARTS": STARTS,
    "CLIMBS": CLIMBS,
    "SLACK": ROUNDINGS * sys.float_info.epsilon,
}
PARTS = ("exponentials", "lanes", "matrices", "path", "peaks", "steps", "tables", "work")
LIBRARY = Library(
    name="native",
    sources=("native.c",),
    headers=tuple(f"native_{part}.h" for part in PARTS),
    constants=tuple(CONSTANTS.items()),
    targets=("march",),
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


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
@jax.named_scope("native")
def march(
    slots: int,
    wanted: Bool[Array, " task"],
    rigs: Rig,
    grids: Grid,
    watched: Float[Array, "task place"],
    traffic: Traffic,
) -> Found:
    """What is found of tasks that C integrates one after the other, if it is `ready`.

    All have tasks as the first axis; a single rig is that of all. Grids are those of `even_grid`,
    `watched` the places (m) at which peaks are looked for, on both sides of the beam; `slots` is
    how many loads may be on the beam at once. No driver, double precision. Tasks that are not
    wanted come out as at rest.
    """
    shapes = rigs.modes.series
    if rigs.mixing is not None:
        shapes = shapes @ rigs.mixing[:, None]
    numbers = np.asarray(GAUSS), lagrange(), through(LOOKED)[: len(LOOKED)].T, np.asarray(LOOKED)
    given = (
        *(wanted, rigs.state_matrix, rigs.modes.nodes, shapes),
        *(grids.edges, grids.counts, grids.lengths, grids.active, grids.windows),
        *(*jax.vmap(Traffic.pieces)(traffic), traffic.inertia, traffic.weight, watched),
        *(part[None] for part in numbers),
    )
    tasks, loads, lanes = traffic.inertia.shape
    places, modes = watched.shape[1], shapes.shape[-1]
    blocks, side = rigs.state_matrix.shape[1:3]
    beam = grids.counts.shape[1], blocks, side, modes // blocks, *shapes.shape[1:3]
    sizes = *beam, slots, loads, places, lanes
    room = LIBRARY.loaded().march_room
    room.restype, room.argtypes = ctypes.c_int64, [ctypes.c_int64] * len(sizes)
    results = [(tasks, lanes, count) for count in (places, places, loads, loads)]
    call = jax.ffi.ffi_call(
        LIBRARY.target("march"),
        [jax.ShapeDtypeStruct(shape, float) for shape in (*results, (room(*sizes),))],
        vmap_method="sequential",
    )
    return Found(*call(*given, slots=np.int64(slots))[:-1])


@march.defjvp
def _march_jvp(slots, given, changes):
    """C is not differentiated, but what it stands for."""

    def plain(wanted, rigs, *rest):
        def task(rig, grid, watched, traffic):
            rigging = make_rigging(rig, grid, watched)
            return plain_march(rigging, traffic, slots=slots)[0].found()

        tasks = wanted.shape[0]
        rigs = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (tasks, *leaf.shape[1:])), rigs)
        return jax.vmap(task)(rigs, *rest)

    return jax.jvp(plain, given, changes)
