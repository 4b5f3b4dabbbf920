"""Peaks of many runs by the C integrator (`integrate_peaks.c`), where there is a C compiler.

XLA splits a step into some forty loops over the runs of a batch; in C it is one, and so are all
steps of all tasks. It serves sweeps of peaks of all quantities (not of histories) without a
controller, in double precision, on CPUs. The first large sweep compiles it, once for a machine: in
1.7 s of processor time, of which each new structure regains 1.2 s, as XLA has less to compile, and
4096 crossings 0.05 (3 modes) to 0.27 s (12 modes), measured in the benchmark `sweep`.
"""

import ctypes
import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Int

from jaxbeam.case.case import Case
from jaxbeam.integrator.discrete_model import discrete_model
from jaxbeam.integrator.integrate import integrate_peaks as integrate_peaks_in_jax
from jaxbeam.integrator.kinks.passages import may_have_kinks
from jaxbeam.integrator.peaks.contact_minimum import (
    FORCE_FRACTIONS,
    FORCE_GAP,
    ZERO_ITERATIONS,
    force_weights_at_fractions,
    spread_factor,
)
from jaxbeam.integrator.peaks.monitored_rows import bounds_by_energy
from jaxbeam.integrator.peaks.running_peaks import PEAK_MARGIN, Peaks
from jaxbeam.integrator.propagators import (
    DOUBLINGS,
    GAUSS_NODES,
    NODE_COUNT,
    PEAK_NODES,
    TAYLOR_TERMS,
)
from jaxbeam.integrator.step_matrices import CHUNK_STEPS
from jaxbeam.integrator.time_grid import TimeGrid
from jaxbeam.model.layout import is_uniform
from jaxbeam.model.load_set import LoadSet, WheelSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.sensing.corrected_rows import StaticCorrection
from jaxbeam.model.sensing.linear_outputs import linear_outputs
from jaxbeam.model.sensing.output_rows import OutputRows
from jaxbeam.model.settlement import has_settlement
from jaxbeam.numerics.gauss import lagrange_coefficients
from jaxbeam.numerics.peak_search import (
    ESTIMATE_ITERATIONS,
    NEWTON_ITERATIONS,
    START_POINTS,
    TIE_ROUNDING_UNITS,
    interpolation_matrix,
    newton_step_limit,
)
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.native_library import Library

MIN_RUNS_TO_COMPILE = 1000  # smaller sweeps do not wait for a compiler
PADDING = 8  # doubles in the widest vector register
C_MACROS = {
    "PADDING": PADDING,
    "CHUNK_STEPS": CHUNK_STEPS,
    "NODES": NODE_COUNT,
    "TAYLOR_TERMS": TAYLOR_TERMS,
    "DOUBLINGS": DOUBLINGS,
    "PEAK_POINTS": len(PEAK_NODES),
    "FORCE_POINTS": len(FORCE_FRACTIONS),
    "FORCE_GAP": FORCE_GAP,
    "ZERO_ITERATIONS": ZERO_ITERATIONS,
    "SPREAD_FACTOR": spread_factor(),
    "PEAK_MARGIN": PEAK_MARGIN,
    "END_PEAK_MARGIN": (PEAK_MARGIN - 1)
    * float(np.diff(PEAK_NODES)[0] / np.diff(PEAK_NODES).max()) ** 2,
    "NEWTON_STEP_LIMIT": newton_step_limit(PEAK_NODES),
    "ESTIMATE_ITERATIONS": ESTIMATE_ITERATIONS,
    "START_POINTS": START_POINTS,
    "NEWTON_ITERATIONS": NEWTON_ITERATIONS,
    "TIE_TOLERANCE": TIE_ROUNDING_UNITS * sys.float_info.epsilon,
}
HEADERS = (
    *("ffi", "load_path", "matrices", "peak_search", "preparation", "propagators", "registers"),
    *("step_matrices", "steps", "vehicle_layout", "vehicle_propagators", "vehicles", "workspace"),
)
LIBRARY = Library(
    sources=("integrate_peaks.c", "preparation.c", "matrices.c"),
    headers=tuple(f"{name}.h" for name in HEADERS),
    macros=tuple(C_MACROS.items()),
    targets=("integrate_peaks",),
)


def chosen_for(case: Case, runs: int) -> bool:
    """Whether a new sweep of peaks of a case uses the C integrator.

    A sweep of many runs compiles it if it is missing; without a compiler, XLA integrates.
    """
    if not supports(case):
        return False
    return available() or (runs >= MIN_RUNS_TO_COMPILE and LIBRARY.build_if_missing())


def supports(case: Case) -> bool:
    """Whether the C integrator can compute the peaks of a case."""
    plain = (
        case.controller is None
        and case.profile is None
        and not has_settlement(case)
        and not may_have_kinks(case)
        and not any(load.force_histories() for load in case.loads)
    )
    # The static influence is then a polynomial in each step.
    return plain and (
        not any(sensor.bends for sensor in case.sensors)
        or (is_uniform(case) and not case.actuators)
    )


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
    outputs: OutputRows,
    correction: StaticCorrection | None,
    loads: LoadSet,
) -> Peaks:
    """Peaks of tasks, each a batch of runs without commands; only where C is `available`.

    All arguments but `max_loads`, the largest number of loads on the beam at once, have tasks as
    their first axis, of length one where models are shared. Peaks are those of the `outputs` with
    their static `correction`, if it is given. Grids are of one step length a panel
    (`grid_by_step_length`). Tasks not in the mask stay at rest.
    """
    shapes = models.modes.series
    if models.mode_map is not None:
        shapes = shapes @ models.mode_map[:, None]
    constants = (
        np.asarray(GAUSS_NODES),
        lagrange_coefficients(NODE_COUNT),
        interpolation_matrix(PEAK_NODES)[: len(PEAK_NODES)].T,
        np.asarray(PEAK_NODES),
        FORCE_FRACTIONS,
        force_weights_at_fractions(),
    )
    shared = None if models.state_matrix.shape[0] == 1 else 0
    own = jax.tree.map(lambda leaf: leaf[0], models) if shared is None else models
    linear = jax.vmap(linear_outputs, (shared, 0, 0))(own, outputs, correction)
    corrected = None if correction is None else correction.rows
    bounds = jax.vmap(bounds_by_energy, (shared, 0, 0))(own, outputs, corrected)
    count = linear.rows.shape[1]
    influence = np.zeros((1, 1)), np.zeros((1, 1, 0, count))
    if linear.influence is not None:
        influence = linear.influence.breaks, linear.influence.series
    arguments = (
        *(mask, models.state_matrix, models.modes.nodes, shapes),
        *(
            grids.boundaries,
            grids.counts,
            grids.lengths,
            grids.loads_on_beam,
            grids.on_beam_intervals,
        ),
        *(*jax.vmap(LoadSet.cubics)(loads), loads.wheels.inertia, loads.wheels.weight),
        *_vehicle_arguments(loads.wheels),
        *(linear.rows, bounds, *influence),
        *(part[None] for part in constants),
    )
    tasks, load_count, batch_size = loads.wheels.inertia.shape
    modes = shapes.shape[-1]
    blocks, block_size = models.state_matrix.shape[1:3]
    beam = grids.counts.shape[1], blocks, block_size, modes // blocks, *shapes.shape[1:3]
    groups = vehicle_numbers(loads.wheels)
    sizes = *beam, max_loads, load_count, count, batch_size, len(groups)
    workspace_size = LIBRARY.load().workspace_size
    pointer = np.ctypeslib.ndpointer(np.int64, flags="C")
    workspace_size.restype = ctypes.c_int64
    workspace_size.argtypes = [*(ctypes.c_int64,) * len(sizes), pointer]
    results = [(tasks, batch_size, columns) for columns in (count, count, load_count, load_count)]
    call = jax.ffi.ffi_call(
        LIBRARY.ffi_name("integrate_peaks"),
        [
            jax.ShapeDtypeStruct(shape, float)
            for shape in (*results, (workspace_size(*sizes, groups),))
        ],
        vmap_method="sequential",
    )
    return Peaks(*call(*arguments, max_loads=np.int64(max_loads))[:-1])


def vehicle_numbers(wheels: WheelSet) -> Int[np.ndarray, "group 4"]:
    """First wheel, wheels and states of one vehicle, and number of vehicles, of loads with them."""
    numbers = [(group.first_wheel, *group.H.shape[-3:-1], group.count) for group in wheels.vehicles]
    return np.array(numbers, np.int64).reshape(-1, 4)


def _vehicle_arguments(wheels: WheelSet):
    """Springs of the wheels, numbers of the vehicles, and their matrices, one after the other."""
    if not wheels.vehicles:
        none = np.zeros((1, 0, 1))
        return none, none, np.zeros((1, 0, 4), np.int64), none, none, none
    parts = []
    for name in ("A", "B", "H"):
        matrices = [getattr(group, name) for group in wheels.vehicles]
        flat = [part.reshape(part.shape[0], -1, part.shape[-1]) for part in matrices]
        parts.append(jnp.concatenate(flat, axis=1))
    return wheels.stiffness, wheels.damping, vehicle_numbers(wheels)[None], *parts


@integrate_peaks.defjvp
def _integrate_peaks_jvp(max_loads, primals, tangents):
    """Derivatives of the same function in JAX."""

    def jax_peaks(mask, models, *rest):
        def task(model, grid, outputs, correction, loads):
            discrete = discrete_model(model, grid, None, None, outputs, correction)
            return integrate_peaks_in_jax(discrete, loads, max_loads=max_loads)[0].peaks()

        tasks = mask.shape[0]
        models = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (tasks, *leaf.shape[1:])), models)
        return jax.vmap(task)(models, *rest)

    return jax.jvp(jax_peaks, primals, tangents)
