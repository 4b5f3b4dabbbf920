"""Peaks of many runs by hand-written C (`native.c`), where that was compiled for this machine.

XLA makes of a step some forty small loops over the lanes; by hand it is one, and so are all steps
of all tasks. The C is compiled once, when asked for, by the C compiler of the machine, into the
user's cache folder. Sweeps then use it where they look for peaks alone (not histories), without a
controller, in double precision, on CPUs. Nobody needs it.
"""

import ctypes
import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbeam.case.case import Case
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.integrate import integrate_peaks as plain_march
from jaxbeam.integrator.propagators import (
    DOUBLINGS,
    GAUSS_NODES,
    NODE_COUNT,
    PEAK_NODES,
    TAYLOR_TERMS,
    lagrange_coefficients,
)
from jaxbeam.integrator.running_peaks import PEAK_MARGIN, Peaks
from jaxbeam.integrator.step_matrices import CHUNK_STEPS
from jaxbeam.integrator.time_grid import TimeGrid
from jaxbeam.model.contact import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.numerics.peak_search import (
    ESTIMATE_ITERATIONS,
    NEWTON_ITERATIONS,
    START_POINTS,
    TIE_ROUNDING_UNITS,
    interpolation_matrix,
    newton_step_limit,
)
from jaxbeam.runtime.native_library import Library

PADDING = 8  # numbers that fill whole vector registers of any machine
C_CONSTANTS = {
    "FILL": PADDING,
    "STEPS": CHUNK_STEPS,
    "NODES": NODE_COUNT,
    "TERMS": TAYLOR_TERMS,
    "DOUBLINGS": DOUBLINGS,
    "POINTS": len(PEAK_NODES),
    "NEAR": PEAK_MARGIN,
    "BESIDE_END": (PEAK_MARGIN - 1)
    * float(np.diff(PEAK_NODES)[0] / np.diff(PEAK_NODES).max()) ** 2,
    "REACH": newton_step_limit(PEAK_NODES),
    "ROUNDS": ESTIMATE_ITERATIONS,
    "STARTS": START_POINTS,
    "CLIMBS": NEWTON_ITERATIONS,
    "SLACK": TIE_ROUNDING_UNITS * sys.float_info.epsilon,
}
HEADERS = ("exponentials", "lanes", "matrices", "path", "peaks", "steps", "tables", "work")
LIBRARY = Library(
    sources=("native.c",),
    headers=tuple(f"native_{part}.h" for part in HEADERS),
    constants=tuple(C_CONSTANTS.items()),
    targets=("march",),
)


def supports(case: Case) -> bool:
    """Whether steps of this case, if its peaks are swept, are those in C."""
    return case.controller is None and available()


def available() -> bool:
    """Whether the C integrator is compiled for this machine, and JAX computes on a CPU."""
    return LIBRARY.available()


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
@jax.named_scope("native")
def integrate_peaks(
    max_loads: int,
    mask: Bool[Array, " task"],
    models: ModalModel,
    grids: TimeGrid,
    positions: Float[Array, "task place"],
    loads: LoadSet,
) -> Peaks:
    """What is found of tasks that C integrates one after the other, if it is `available`.

    All have tasks as the first axis; a single rig is that of all. Grids are those of `even_grid`,
    `positions` the places (m) at which peaks are looked for, on both sides of the beam; `max_loads`
    is how many loads may be on the beam at once. No driver, double precision. Tasks that are not
    wanted come out as at rest.
    """
    shapes = models.modes.series
    if models.mode_map is not None:
        shapes = shapes @ models.mode_map[:, None]
    numbers = (
        np.asarray(GAUSS_NODES),
        lagrange_coefficients(),
        interpolation_matrix(PEAK_NODES)[: len(PEAK_NODES)].T,
        np.asarray(PEAK_NODES),
    )
    arguments = (
        *(mask, models.state_matrix, models.modes.nodes, shapes),
        *(
            grids.boundaries,
            grids.counts,
            grids.lengths,
            grids.loads_on_beam,
            grids.on_beam_intervals,
        ),
        *(*jax.vmap(LoadSet.cubics)(loads), loads.inertia, loads.weight, positions),
        *(part[None] for part in numbers),
    )
    tasks, load_count, batch_size = loads.inertia.shape
    position_count, modes = positions.shape[1], shapes.shape[-1]
    blocks, block_size = models.state_matrix.shape[1:3]
    beam = grids.counts.shape[1], blocks, block_size, modes // blocks, *shapes.shape[1:3]
    sizes = *beam, max_loads, load_count, position_count, batch_size
    workspace_size = LIBRARY.load().march_room
    workspace_size.restype, workspace_size.argtypes = ctypes.c_int64, [ctypes.c_int64] * len(sizes)
    results = [
        (tasks, batch_size, count)
        for count in (position_count, position_count, load_count, load_count)
    ]
    call = jax.ffi.ffi_call(
        LIBRARY.ffi_name("march"),
        [jax.ShapeDtypeStruct(shape, float) for shape in (*results, (workspace_size(*sizes),))],
        vmap_method="sequential",
    )
    return Peaks(*call(*arguments, slots=np.int64(max_loads))[:-1])


@integrate_peaks.defjvp
def _integrate_peaks_jvp(max_loads, primals, tangents):
    """C is not differentiated, but what it stands for."""

    def jax_peaks(mask, models, *rest):
        def task(model, grid, positions, loads):
            discrete = discrete_model(model, grid, positions)
            return plain_march(discrete, loads, max_loads=max_loads)[0].peaks()

        tasks = mask.shape[0]
        models = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (tasks, *leaf.shape[1:])), models)
        return jax.vmap(task)(models, *rest)

    return jax.jvp(jax_peaks, primals, tangents)
