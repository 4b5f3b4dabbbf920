"""Peaks of many runs by the C integrator (`integrate_peaks.c`), from the wheel or compiled here.

XLA splits a step into some forty loops over the runs of a batch; in C it is one loop, and one call
takes all steps of all tasks. It serves sweeps of peaks of all quantities and of histories, without
a controller or with one that acts at samples, in double precision, on CPUs. If the wheel has no
library the first large sweep compiles it, once for a machine, in 1.2 s of processor time. Each new
structure regains 3 s, as XLA has less to compile, or nothing (two spans, benchmark `first_answer`),
and 4096 crossings 0.05 (3 modes) to 0.26 s (12 modes, benchmark `sweep`). XLA's own calls of C
would take headers, an aligned workspace as one of the results, and rules of derivatives that no
sweep needs; and compile after the C.
"""

import ctypes
import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.case.case import Case
from jaxbeam.case.profiles.spectra import ProfilesOfRuns
from jaxbeam.model.contact import initial_vehicle_states, may_have_kinks
from jaxbeam.model.elements import is_uniform
from jaxbeam.model.load_set import LoadSet, WheelSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.output_rows import OutputRows, StaticCorrection, linear_outputs
from jaxbeam.model.transfer_matrices import has_settlement
from jaxbeam.numerics.polynomials import interpolation_matrix, lagrange_coefficients
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.native_library import Library
from jaxbeam.simulation.integrator.discrete_model import (
    GAUSS_NODES,
    NODE_COUNT,
    PEAK_NODES,
    bounds_by_energy,
    commands_at_once,
)
from jaxbeam.simulation.integrator.inputs import MARK_COUNT
from jaxbeam.simulation.integrator.load_path import END_FRACTIONS
from jaxbeam.simulation.integrator.peaks import FORCE_FRACTIONS, FORCE_WEIGHTS, Peaks
from jaxbeam.simulation.integrator.time_grid import TimeGrid
from jaxbeam.simulation.integrator.vehicles import absorber_weights

PATH_NODES = NODE_COUNT + len(END_FRACTIONS)
MIN_RUNS_TO_COMPILE = 1000  # smaller sweeps do not wait for a compiler
# Runs with a controller from which its law is compiled: in half a second, a predictive one in ten.
MIN_RUNS_OF_LOOPS = 32
HEADERS = (
    *("constants", "contact", "load_path", "matrices", "peak_search", "preparation", "propagators"),
    *("registers", "step_matrices", "steps", "vehicle_layout", "vehicle_propagators", "vehicles"),
    "workspace",
)
LIBRARY = Library(
    sources=("integrate_peaks.c", "contact.c", "preparation.c", "matrices.c", "processor.c"),
    headers=tuple(f"{name}.h" for name in HEADERS),
)


def chosen_for(case: Case, runs: int) -> bool:
    """Whether a new sweep of peaks of a case uses the C integrator, if need be compiling it first.

    Sweeps of many runs compile it where it is missing and there is a compiler.
    """
    if not supports(case) or (case.controller is not None and runs < MIN_RUNS_OF_LOOPS):
        return False
    missing = runs >= MIN_RUNS_TO_COMPILE and on_cpu() and LIBRARY.can_be_built()
    return missing or available()


def supports(case: Case) -> bool:
    """Whether the C integrator can compute the peaks of a case."""
    plain = not has_settlement(case) and not may_have_kinks(case)
    plain &= not case.beam.twists  # wheels off the axis twist the beam
    if case.controller is not None:  # accelerations would follow from the contact forces
        sampled = case.controller.period is not None
        plain &= sampled and not any(sensor.has_feedthrough for sensor in case.sensors)
    # The static influence is then a polynomial in each step.
    return plain and (
        not any(sensor.bends for sensor in case.sensors)
        or (is_uniform(case) and not case.actuators)
    )


def has_inputs_over_time(case: Case) -> bool:
    """Whether a case has a profile or forces over time, which need `inputs_over_time`."""
    return case.profile is not None or any(load.force_histories() for load in case.loads)


def available() -> bool:
    """Whether the C integrator is compiled for this machine, and JAX computes on a CPU."""
    return on_cpu() and LIBRARY.available()


def on_cpu() -> bool:
    """Whether JAX computes on a CPU."""
    return jax.default_backend() == "cpu"


class NativeInputs(NamedTuple):
    """Arguments of the C integrator after the mask, in the order of `workspace.h`.

    A task is a batch of runs. The first axis of each array is that of the tasks, of length one if
    all tasks have the same. `samples` are the sample numbers of a history at the boundaries of
    panels, -1 for none, and `history_rows` are the output rows of the history on the state. None
    stands for an empty array, as each array that a program returns takes 20 microseconds.
    """

    state_matrix: Float[Array, "task block state state"]
    shape_nodes: Float[Array, "task node"]
    shape_series: Float[Array, "task segment term mode"]
    panel_starts: Float[Array, "task boundary"]
    step_counts: Int[Array, "task panel"]
    step_lengths: Float[Array, "task length"]
    loads_on_beam: Bool[Array, "task panel load"]
    on_beam_intervals: Float[Array, "task load 2"]
    breakpoints: Float[Array, "task load piece"]
    cubics: Float[Array, "task load piece 4"]
    inertia: Float[Array, "task load run"]
    weight: Float[Array, "task load run"]
    stiffness: Float[Array, "task load run"] | None
    damping: Float[Array, "task load run"] | None
    vehicles: Int[Array, "task group 4"] | None
    vehicle_state_matrix: Float[Array, "task entry run"] | None
    vehicle_input_matrix: Float[Array, "task entry run"] | None
    vehicle_output_matrix: Float[Array, "task entry run"] | None
    output_rows: Float[Array, "task output state"]
    output_bounds: Float[Array, "task output block"]
    influence_breaks: Float[Array, "task break"] | None
    influence_series: Float[Array, "task piece term output"] | None
    surface: Float[Array, "task step motion_node run"] | None = None
    load_forces: Float[Array, "task step wheel_node run"] | None = None
    initial_vehicles: Float[Array, "task state run"] | None = None
    lengths_of_panels: Int[Array, "task panel"] | None = None
    events: Int[Array, "task panel"] | None = None
    memory: Float[Array, "task memory"] | None = None
    loop_numbers: Int[Array, "task address"] | None = None
    samples: Int[Array, "task boundary"] | None = None
    history_rows: Float[Array, "task row state"] | None = None


class NativeLoop(NamedTuple):
    """A sampled loop in C: its function, number of commands, and index of the failures in memory.

    Four fields of `NativeInputs` are those of a loop: `lengths_of_panels`, the index of the step
    length of each panel (also used for histories); `events`, the event at the start of each panel,
    -1 for none; `memory` of the loop at the start; `loop_numbers`, the addresses of its numbers.
    Commands are states that do not change between events.
    """

    process: Any
    commands: int
    failures: int


class _Loop(ctypes.Structure):
    """`NativeLoop` as a C structure."""

    _fields_ = (
        ("process", ctypes.c_void_p),
        ("commands", ctypes.c_int64),
        ("marks", ctypes.c_int64),
        ("failures", ctypes.c_int64),
    )


class _Argument(ctypes.Structure):
    """Array as a C structure: address of its numbers, and the sizes of its axes."""

    _fields_ = (("numbers", ctypes.c_void_p), ("sizes", ctypes.c_int64 * 4))


def model_inputs(
    model: ModalModel, outputs: OutputRows, correction: StaticCorrection | None
) -> dict[str, Any]:
    """Fields of `NativeInputs` from a modal model and outputs with their static correction."""
    series = model.load_series
    linear = linear_outputs(model, outputs, correction)
    influence = linear.influence
    return {
        "state_matrix": model.state_matrix,
        "shape_nodes": model.load_nodes,
        "shape_series": series if model.mode_map is None else series @ model.mode_map,
        "output_rows": linear.rows,
        "output_bounds": bounds_by_energy(
            model, outputs, None if correction is None else correction.rows
        ),
        "influence_breaks": None if influence is None else influence.breaks,
        "influence_series": None if influence is None else influence.series,
    }


def loop_model_inputs(
    model: ModalModel,
    outputs: OutputRows,
    correction: StaticCorrection | None,
    history_rows: Float[np.ndarray, "row state"] | None = None,
) -> dict[str, Any]:
    """`model_inputs` of a closed loop: held commands are additional states of each block.

    The model has one block, which is split into uncoupled modes where it can be. `history_rows` on
    the states of the model, if given, become rows on the states of the blocks.
    """
    found = model_inputs(model, outputs, correction)
    history = np.zeros((0, model.state_count)) if history_rows is None else history_rows
    corrected = None if correction is None else correction.rows
    direct = commands_at_once(outputs, model.command_matrix[model.rate_index], corrected)
    matrix, side = model.state_matrix[0], 2
    alone = np.kron(np.eye(len(matrix) // 2), np.ones((2, 2))).astype(bool)
    if len(matrix) > 2 * model.mode_count or model.mode_map is not None or matrix[~alone].any():
        side = len(matrix)
    blocks, commands = len(matrix) // side, model.command_matrix.shape[1]
    of_blocks = np.zeros((blocks, side + commands, side + commands))
    given, count = np.concatenate([found["output_rows"], history]), len(outputs.time_derivatives)
    rows = np.zeros((len(given), blocks, side + commands))
    for b in range(blocks):
        own = np.s_[b * side : (b + 1) * side]
        of_blocks[b, :side, :side] = matrix[own, own]
        of_blocks[b, :side, side:] = model.command_matrix[own]
        rows[:, b, :side] = given[:, own]
    rows[:count, 0, side:] = direct
    rows = rows.reshape(len(rows), -1)
    found |= {"state_matrix": of_blocks, "output_rows": rows[:count]}
    found |= {"history_rows": None if history_rows is None else rows[count:]}
    return found | {"output_bounds": np.zeros((count, blocks))}


def batch_inputs(
    grid: TimeGrid,
    paths: tuple[Float[Array, "wheel piece"], Float[Array, "wheel piece 4"]],
    wheels: WheelSet,
) -> dict[str, Any]:
    """Fields of `NativeInputs` from the time grid and the loads of a batch of runs.

    The grid has one step length for each panel (`grid_by_step_length`), the paths are the cubics of
    the `LoadSet`.
    """
    breakpoints, cubics = paths
    return {
        "panel_starts": grid.boundaries,
        "step_counts": grid.counts,
        "step_lengths": grid.lengths,
        "loads_on_beam": grid.loads_on_beam,
        "on_beam_intervals": grid.on_beam_intervals,
        "breakpoints": breakpoints,
        "cubics": cubics,
        "inertia": wheels.inertia,
        "weight": wheels.weight,
        "stiffness": wheels.stiffness,
        "damping": wheels.damping,
        "vehicles": vehicle_numbers(wheels) if wheels.vehicles else None,
        "vehicle_state_matrix": _vehicle_matrices(wheels, "A"),
        "vehicle_input_matrix": _vehicle_matrices(wheels, "B"),
        "vehicle_output_matrix": _vehicle_matrices(wheels, "H"),
    }


def shared_vehicles(inputs: dict[str, Any]) -> dict[str, np.ndarray]:
    """Matrices of vehicles reduced to one run, if they are equal in all runs; otherwise none."""
    names = ("vehicle_state_matrix", "vehicle_input_matrix", "vehicle_output_matrix")
    matrices = [inputs[name] for name in names]
    if matrices[0] is None or any(np.any(part != part[..., :1]) for part in matrices):
        return {}
    return {name: part[..., :1] for name, part in zip(names, matrices, strict=True)}


def inputs_over_time(
    batches: Sequence[LoadSet],
    starts: Float[np.ndarray, "batch boundary"],
    counts: Int[np.ndarray, "batch panel"],
    lengths: Float[np.ndarray, "batch length"],
    one_profile: bool,
) -> dict[str, np.ndarray]:
    """Fields of `NativeInputs` that are functions of time, for batches of concrete numbers.

    Each panel has `counts` steps of its length (s) from its start (s). `surface` is the motion of
    the profile under all wheels, `load_forces` forces in addition to their weights, both at the
    Gauss nodes and then at the ends of the steps; zero after the last step of a batch. Batches with
    `one_profile` are computed together.
    """
    all_times = [_path_nodes(*of_batch) for of_batch in zip(starts, counts, lengths, strict=True)]
    steps, first, inputs = max(map(len, all_times)), batches[0], {}
    if first.wheels.histories:
        runs = first.weight.shape[1]
        forces = np.zeros((len(batches), steps, first.wheel_count, PATH_NODES, runs))
        for row, (loads, times) in enumerate(zip(batches, all_times, strict=True)):
            for wheel, history in loads.wheels.histories.items():
                forces[row, : len(times), wheel] = history.at(times)
        inputs["load_forces"] = forces.reshape(len(batches), steps, -1, runs)
    if first.profile is None or all(loads.massless for loads in batches):
        return inputs
    runs = len(first.profile.phases) if isinstance(first.profile, ProfilesOfRuns) else 1
    surface = np.zeros((len(batches), steps, first.wheel_count, 3, PATH_NODES, runs))
    paths = [loads.kinematics(times) for loads, times in zip(batches, all_times, strict=True)]
    groups = [range(len(batches))] if one_profile else [[row] for row in range(len(batches))]
    for group in groups:
        flat = [np.concatenate([paths[row][i].ravel() for row in group]) for i in range(3)]
        heights: Any = batches[group[0]].surface_motion(*flat)
        ends = np.cumsum([paths[row][0].size for row in group])[:-1]
        for i, motion in enumerate(heights):
            for row, part in zip(group, np.split(motion, ends), strict=True):
                by_wheel = part.reshape(*paths[row][0].shape, runs)
                surface[row, : len(all_times[row]), :, i] = by_wheel.swapaxes(0, 1)
    inputs["surface"] = surface.reshape(len(batches), steps, -1, runs)
    if first.wheels.vehicles:
        at_rest: list[Any] = [initial_vehicle_states(loads) for loads in batches]
        inputs["initial_vehicles"] = np.stack(at_rest)
    return inputs


def _path_nodes(starts, counts, lengths) -> Float[np.ndarray, "step node"]:
    """Times (s) of the Gauss nodes of all steps of a grid, and of their ends."""
    panel = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(panel)) - np.repeat(np.cumsum(counts) - counts, counts)
    fractions = np.array([*GAUSS_NODES, *END_FRACTIONS])
    return starts[panel, None] + lengths[panel, None] * (number[:, None] + fractions)


def integrate_peaks(
    max_loads: int, mask: Bool[np.ndarray, " task"], inputs: NativeInputs, absorbers: int = 0
) -> Peaks:
    """Peaks of tasks without a controller; see `integrate_loops`."""
    return integrate_loops(max_loads, mask, inputs, None, absorbers)[0]


class Integrated(NamedTuple):
    """Results of the C integrator for all tasks.

    They are peaks, numbers of samples without a solution of the law, largest amplitudes up to each
    of `growth_marks`, and histories.
    """

    peaks: Peaks
    failures: Float[np.ndarray, "task run"]
    amplitudes: Float[np.ndarray, "task run mark"]
    history: Float[np.ndarray, "task run sample row"]


def integrate_loops(
    max_loads: int,
    mask: Bool[np.ndarray, " task"],
    inputs: NativeInputs,
    loop: NativeLoop | None,
    absorbers: int = 0,
) -> Integrated:
    """Results of tasks by the C integrator, with histories if the inputs have samples.

    The C integrator must be `available`. The call releases the lock of Python for other threads.

    `max_loads` is the largest number of loads on the beam at once. The last wheels are those of
    `absorbers`, and the last outputs the deflections there, twice, in place of which peaks are
    those of their strokes, then of their forces. Tasks not in the mask stay at rest. Raises
    MemoryError without memory for the matrices of the steps.
    """
    given, none = (mask, *inputs, *_constants()), np.zeros((1, 0, 0))
    arrays = [np.ascontiguousarray(none if array is None else array) for array in given]
    tasks, loads, runs = inputs.weight.shape
    outputs = inputs.output_rows.shape[1]
    peaks = Peaks(*(np.empty((tasks, runs, count)) for count in (outputs, outputs, loads, loads)))
    arguments = (_Argument * len(arrays))(
        *((array.ctypes.data, (*array.shape, 1, 1, 1)[:4]) for array in arrays)
    )
    failures, amplitudes = np.zeros((tasks, runs)), np.zeros((tasks, runs, MARK_COUNT))
    samples = rows = 0
    if inputs.samples is not None and inputs.history_rows is not None:
        samples, rows = int(np.max(inputs.samples)) + 1, inputs.history_rows.shape[1]
    history = np.zeros((tasks, runs, samples, rows))
    outcomes = (*peaks, failures, amplitudes, history)
    found = (ctypes.c_void_p * len(outcomes))(*(part.ctypes.data for part in outcomes))
    given_loop = None
    if loop is not None:
        address = ctypes.cast(loop.process, ctypes.c_void_p)
        given_loop = ctypes.byref(_Loop(address, loop.commands, MARK_COUNT, loop.failures))
    sizes = map(ctypes.c_int64, (max_loads, samples, absorbers))
    if LIBRARY.load().integrate_peaks(*sizes, arguments, found, given_loop):
        raise MemoryError("there is no memory for the matrices of all steps of a sweep")
    amplitudes = np.sqrt(np.maximum.accumulate(amplitudes[..., ::-1], axis=-1)[..., ::-1])
    return Integrated(peaks, failures, amplitudes, history)


@functools.cache
def _constants() -> tuple[np.ndarray, ...]:
    """Nodes, weights and coefficients of the integrator, the same for all tasks."""
    constants = (
        np.asarray(GAUSS_NODES),
        lagrange_coefficients(NODE_COUNT),
        interpolation_matrix(PEAK_NODES)[: len(PEAK_NODES)].T,
        np.asarray(PEAK_NODES),
        FORCE_FRACTIONS,
        FORCE_WEIGHTS,
        absorber_weights().reshape(-1, NODE_COUNT),
    )
    return tuple(np.ascontiguousarray(part, float)[None] for part in constants)


def vehicle_numbers(wheels: WheelSet) -> Int[np.ndarray, "group 4"]:
    """Vehicle groups: first wheel, wheels and states of a vehicle, and number of vehicles."""
    numbers = [(group.first_wheel, *group.H.shape[-3:-1], group.count) for group in wheels.vehicles]
    return np.array(numbers, np.int64).reshape(-1, 4)


def _vehicle_matrices(wheels: WheelSet, name: str) -> Float[Array, "entry run"] | None:
    """Entries of the matrices `name` of all vehicles, concatenated; None without vehicles."""
    matrices = [getattr(group, name) for group in wheels.vehicles]
    flat = [part.reshape(-1, part.shape[-1]) for part in matrices]
    return xp.concatenate(flat) if flat else None
