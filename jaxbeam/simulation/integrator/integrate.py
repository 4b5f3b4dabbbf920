"""Integrator of a batch of runs: exact modal propagation, contact forces collocated at Gauss nodes.

Within a step, the generalised forces of the loads are polynomials through their values at the
Gauss nodes, under which the modal model is propagated exactly (`propagators`). The contact law at
the nodes is a small linear system for each step. The unloaded model adds neither error nor
stiffness at any step length; the order is twice the number of nodes. Steps are taken in chunks:
their matrices are assembled at once and shared by the batch (`step_matrices`), a short loop
advances the states (`step`), and peaks are updated for the chunk at once (`running_peaks`).
Commands to the actuators are polynomials through the same nodes, given by an input policy.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.model.contact import initial_vehicle_states
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.numerics.polynomials import lagrange_weights
from jaxbeam.runtime.arrays import (
    Array,
    any_jax,
    any_traced,
    checkpoint,
    collapse,
    cond,
    put,
    scan,
    stop_gradient,
    take,
    while_loop,
    xp,
    zeros,
)
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integrator.discrete_model import (
    GAUSS_NODES,
    MAX_STEP_NORM,
    NODE_COUNT,
    DiscreteModel,
    energies,
    state_matrix_norm,
)
from jaxbeam.simulation.integrator.inputs import (
    OVERFLOW,
    AbstractInputPolicy,
    StepInfo,
    amplitudes,
    diverged,
    growth_limit,
    growth_marks,
    has_feedback,
    largest_by_marks,
)
from jaxbeam.simulation.integrator.load_path import END_FRACTIONS, LoadPath, end_forces, load_path
from jaxbeam.simulation.integrator.peaks import RunningPeaks, initial_peaks, update_peaks
from jaxbeam.simulation.integrator.step import advance_free, advance_unforced, step_maps
from jaxbeam.simulation.integrator.step_matrices import (
    chunk_length,
    step_matrices,
    weights_with_impulses,
    with_impulses,
    with_prescribed_forces,
)
from jaxbeam.simulation.integrator.time_grid import TimeGrid
from jaxbeam.simulation.integrator.vehicles import (
    StepInput,
    Vehicles,
    VehicleStep,
    absorber_samples,
    vehicle_state_norm,
    vehicles_of,
)

BLOCK_STEPS = 64  # steps of a law in continuous time that a program advances together
# Largest phase (rad) of the highest mode in a step. Beyond twice the number of nodes, the contact
# force of a mass, a polynomial in each step, cannot follow that mode's oscillation and excites it.
MAX_PHASE_PER_STEP = 1.9 * NODE_COUNT
# Largest phase (rad) of the highest mode shape that a force passes in a step. A polynomial through
# six Gauss nodes follows a sine over this phase to 1e-7 of its amplitude.
MAX_PASSAGE_PER_STEP = 0.64


def advance_with_inputs(policy, vehicles: Vehicles | None, steps: StepInput, infos, state, memory):
    """Steps under commands: (state, memory) after them, and (states, forces, commands, observed).

    States and observations are at the starts of the steps, forces and commands at their nodes.
    """
    maps = step_maps(steps, vehicles)
    concrete = not policy.implicit and not any_jax(maps, state, memory, policy)
    found = _advance_concrete(policy, maps.states, infos, state, memory) if concrete else None
    if found is None:
        found = _advance_traced(policy, maps, infos, state, memory)
    after, sources, observed = found
    forces, count = maps.forces(sources), state.shape[0]
    parts = sources[..., :count], forces, sources[..., count:]
    states, forces, commands = (xp.swapaxes(part, 1, 2) for part in parts)
    return after, (states, forces, commands, observed)


def _advance_traced(policy, maps, infos, state, memory):
    """Final state and memory; states and commands (step, batch, column); observations."""
    steps = (maps.states, maps.nodes), infos
    start = jax.tree.map(jnp.asarray, (state, memory))  # even if all numbers are concrete
    if not policy.implicit or any_traced(steps, start, policy):
        after, (sources, observed) = _scan_steps(policy, steps, start)
        return after, sources, observed
    # Blocks of equal length use one program; the last is filled up by repetitions of its step.
    count, found, carry = len(infos.start), [], start
    index = np.arange(-(-count // BLOCK_STEPS) * BLOCK_STEPS)
    for block in index.reshape(-1, BLOCK_STEPS):
        own = np.minimum(block, count - 1)
        maps, info = jax.tree.map(lambda part, own=own: part[own], steps)
        info = info._replace(event=np.where(block < count, info.event, -1))
        carry, after = _scan_block(policy, (maps, info), carry)
        found.append(jax.tree.map(np.asarray, after))
    sources, observed = jax.tree.map(lambda *parts: np.concatenate(parts), *found)
    state, memory = jax.tree.map(np.asarray, carry)
    if count < len(sources):
        state = sources[count, :, : state.shape[0]].T
    return (state, memory), sources[:count], jax.tree.map(lambda part: part[:count], observed)


def _scan_steps(policy, steps, start):
    """Final (state, memory) of steps; states and commands before each, and observations."""

    def one_step(carry, step):
        state, memory = carry
        (of_states, of_nodes), info = step
        columns = state.T

        def node_states(commands):
            values = of_nodes(xp.concatenate([columns, collapse(commands, 0, 2).T], axis=1))
            return values.T.reshape(len(GAUSS_NODES), -1, values.shape[0])

        node_commands, memory = policy.inputs(memory, state, info, node_states)
        sources = xp.concatenate([columns, collapse(node_commands, 0, 2).T], axis=1)
        after = of_states(sources).T
        # A run becomes NaN here, without affecting the others, before it overflows.
        within = xp.all(xp.abs(after) <= OVERFLOW, axis=0)
        after = xp.where(within, after, xp.nan)
        return (after, memory), (sources, policy.observe(memory, info))

    return jax.lax.scan(one_step, start, steps)


_scan_block = compiled(_scan_steps)


def _advance_concrete(policy, of_states, infos, state, memory):
    """`_advance_traced` in NumPy, for commands that do not depend on the states within a step.

    None if the policy computes with JAX from concrete numbers, as a law of a user may.
    """
    count, batch_size, state_count = of_states.offset.shape
    # State and commands.
    sources = np.ones((count + 1, batch_size, of_states.linear.shape[-1]))
    sources[0, :, :state_count] = state.T
    acts, observations, held = policy.acts_at(infos.event), [], None
    acts[0] = True
    given, observed = policy.of_time(infos), None
    if any_jax(given):
        return None
    for i in range(count):
        state = sources[i, :, :state_count]
        if given is not None:
            held = given[i].ravel()
        elif acts[i]:
            info = StepInfo(infos.start[i], infos.length[i], infos.event[i])
            node_commands, memory = policy.inputs(memory, state.T, info, None)
            if i == 0 and any_jax(node_commands, memory):
                return None
            held = collapse(node_commands, 0, 2).T
            observed = policy.observe(memory, info)
        sources[i, :, state_count:] = held
        observations.append(observed)
        next_state = of_states.at(i, sources[i])
        within = np.abs(next_state) <= OVERFLOW
        if not within.all():
            next_state = np.where(within.all(axis=1, keepdims=True), next_state, np.nan)
        sources[i + 1, :, :state_count] = next_state
    observed = jax.tree.map(lambda *parts: np.stack(parts), *observations)
    return (sources[-1, :, :state_count].T, memory), sources[:-1], observed


def max_stable_step(model: ModalModel, loads: LoadSet) -> Float[Array, ""]:
    """Longest step (s) at which the integration of these loads on the model is stable."""
    limit = MAX_STEP_NORM / state_matrix_norm(model)
    limit = xp.minimum(limit, MAX_STEP_NORM / (vehicle_state_norm(loads) + 1e-30))
    if not loads.massless:
        highest_frequency = xp.sqrt(xp.max(xp.linalg.eigvalsh(model.stiffness())))
        limit = xp.minimum(limit, MAX_PHASE_PER_STEP / highest_frequency)
    return stop_gradient(limit)


def longest_force_step(case: Case, loads: LoadSet) -> Float[Array, ""]:
    """Longest step (s) that resolves the passage of forces over the highest mode shape.

    Generalised forces of such loads are given functions of time, so that the only error is that of
    their polynomials. Infinite for loads with inertia or springs, whose steps an error estimate
    decides.
    """
    if not loads.massless or not loads.trajectories:
        return xp.asarray(np.inf)
    windows = xp.clip(loads.entry_exit_times(), 0.0, case.run.duration)
    first, last = xp.min(windows[:, 0]), xp.max(windows[:, 1])
    times = first + (last - first) * np.linspace(0.0, 1.0, 33)
    speed = xp.max(xp.abs(loads.kinematics(times)[1]))
    wavenumber = (case.beam.modes + 1) * np.pi / case.beam.length
    return stop_gradient(MAX_PASSAGE_PER_STEP / (wavenumber * speed + 1e-30))


def _of_wheels(
    values: Float[Array, "wheel batch"], path: LoadPath
) -> Float[Array, "step load 1 batch"]:
    """Values (of each wheel) arranged by the wheels of the steps of a path; zero off the beam."""
    selected = xp.where(path.on_beam[..., None], take(values, path.loads), 0.0)
    return selected[:, :, None]


def _weights(loads: LoadSet, path: LoadPath, fractions) -> Float[Array, "step load fraction batch"]:
    """Weights (N) of the wheels at fractions of the steps, with forces that vary in time."""
    weight = xp.repeat(_of_wheels(loads.weight, path), len(fractions), axis=2)
    for wheel, history in loads.wheels.histories.items():
        of_wheel = (path.loads == wheel) & path.on_beam
        times = path.start[:, None] + path.length[:, None] * np.asarray(fractions)
        force = history.at(times)[:, None]  # step, 1, fraction, batch
        weight = weight + xp.where(of_wheel[..., None, None], force, 0.0)
    return weight


def step_inputs(discrete: DiscreteModel, loads: LoadSet, path: LoadPath) -> StepInput:
    """Matrices, inertia (kg) and weight (N) of the wheels in the steps of a chunk."""
    weight = collapse(_weights(loads, path, GAUSS_NODES), 1, 3)
    inertia = xp.repeat(_of_wheels(loads.inertia, path)[:, :, 0], NODE_COUNT, axis=1)
    if path.surface is not None:
        by_wheel = xp.take_along_axis(path.surface[:, 2], path.loads[..., None], axis=1)
        weight = weight + inertia * by_wheel.reshape(*by_wheel.shape[:1], -1, 1)
    matrices = step_matrices(discrete, path)
    if path.kinks is not None:
        weight = weights_with_impulses(path.kinks, inertia, weight)
        matrices = with_impulses(path.kinks, matrices, path.rows.shape, discrete.model)
    matrices, weight, motion = with_prescribed_forces(matrices, inertia, weight)
    vehicle_step = None
    if loads.wheels.vehicles:
        solved = np.s_[:, : path.rows.acceleration.shape[1]]
        wheels = path.loads[solved], path.pressing[solved]
        vehicle_step = VehicleStep(path.length_index, *wheels, path.surface, motion)
    return StepInput(matrices, inertia, weight, vehicle_step)


def _chunk_function(
    discrete: DiscreteModel,
    loads: LoadSet,
    max_loads: int,
    policy: AbstractInputPolicy | None,
    steps: int | None = None,
    most: int | None = None,
):
    """Function that advances state, memory and running peaks by a chunk, and steps of a chunk.

    The function also returns the time (s) at the end of the chunk, and the histories (states before
    each step, commands at the nodes, observations). A traced run of `steps` is a single chunk, if
    memory allows it; chunks have `most` steps, if it is given.
    """

    chunk_steps = chunk_length(
        discrete, loads, max_loads, any_jax(discrete, loads, policy) and steps
    )
    chunk_steps = min(chunk_steps, most or chunk_steps)
    vehicles = vehicles_of(loads, discrete.grid.lengths)

    def chunk(state, memory, running_peaks: Any, first_step):
        index = first_step + xp.arange(chunk_steps)
        path = load_path(discrete, loads, max_loads, index)
        commands = observed = None
        end = path.start[-1] + path.length[-1]
        # Without loads on the beam no matrices are needed: fits to logs that go on after a crossing
        # take a quarter less time.
        if policy is None and running_peaks is None and vehicles is None:

            def under_loads():
                return advance_unforced(step_inputs(discrete, loads, path), state, None)[:2]

            def in_free_vibration():
                return advance_free(discrete.propagators.transition_end[path.length_index], state)

            state, states = cond(xp.any(path.on_beam), under_loads, in_free_vibration)
            return state, memory, running_peaks, end, (states, commands, observed)
        steps = step_inputs(discrete, loads, path)
        if policy is None:
            state, states, forces = advance_unforced(steps, state, vehicles)
        else:
            infos = StepInfo(path.start, path.length, discrete.grid.event_at(index))
            (state, memory), (states, forces, commands, observed) = advance_with_inputs(
                policy, vehicles, steps, infos, state, memory
            )
        if running_peaks is not None:
            before = states[:, : discrete.model.state_count]
            ends = _end_forces(loads, path, steps, before, state, forces)
            inputs = [before, forces, ends, commands]
            after = xp.concatenate([states[1:], state[None]])
            monitored = _monitored(discrete, loads, path, states, after, forces)
            running_peaks = update_peaks(running_peaks, steps.matrices, path, inputs, monitored)
        return state, memory, running_peaks, end, (states, commands, observed)

    return chunk, chunk_steps


def _monitored(discrete: DiscreteModel, loads: LoadSet, path: LoadPath, before, after, forces):
    """Function from samples of the outputs of steps to those of which there are peaks.

    `before` and `after` are states at the ends of the steps, `forces` (N) those at their nodes.
    """
    own, count = np.s_[:, discrete.model.state_count :], discrete.absorbers

    def monitored(samples):
        if count:
            moving = before[own], after[own]
            samples = absorber_samples(loads, path, count, *moving, forces, samples)
        return xp.concatenate([samples, -samples], axis=2) if discrete.both_ways else samples

    return monitored


def _end_forces(loads: LoadSet, path: LoadPath, steps: StepInput, before, last, forces):
    """Contact forces (N) at the ends of steps from the beam's states there; None if not needed."""
    if path.influence is None:
        return None
    weight = _weights(loads, path, END_FRACTIONS)
    return end_forces(path.ends, steps.inertia, weight, before, last[: before.shape[1]], forces)


def peaks_of_halves(
    on_grid: Callable[[TimeGrid], DiscreteModel],
    grid: TimeGrid,
    loads: LoadSet,
    max_loads: int,
    running_peaks: RunningPeaks,
    states: Float[np.ndarray, "boundary state batch"],
    commands: Float[np.ndarray, "step command batch"] | None,
) -> RunningPeaks:
    """Peaks of a run computed again with halved steps, only in the steps that have the peaks.

    Each step begins with its state in the run, and has its commands. The function `on_grid` gives
    the discrete model, for the lengths of these halves only.
    """
    _, starts, _ = grid.locate_steps(np.arange(int(grid.step_count)))
    index = np.unique(np.searchsorted(starts, running_peaks.step_start, side="right") - 1)
    discrete = on_grid(grid.with_halves(index))
    path = load_path(discrete, loads, max_loads, (2 * index[:, None] + np.arange(2)).ravel())
    steps = step_inputs(discrete, loads, path)
    maps = step_maps(steps, vehicles_of(loads, discrete.grid.lengths))
    state, sources, after, ends = np.swapaxes(states[index], 1, 2), [], [], None
    for half in range(2):
        parts = [state]
        if commands is not None:
            weights = lagrange_weights(NODE_COUNT, 0.5 * (half + GAUSS_NODES))
            by_node = commands[index].reshape(index.size, NODE_COUNT, -1)
            own = weights @ by_node
            parts.append(np.swapaxes(own.reshape(index.size, *commands.shape[1:]), 1, 2))
        sources.append(np.concatenate(parts, axis=2))
        state = maps.states.at(np.s_[half::2], sources[-1])
        after.append(np.swapaxes(state, 1, 2))
    columns = np.stack(sources, axis=1).reshape(path.start.size, *sources[0].shape[1:])
    forces, columns = (np.swapaxes(part, 1, 2) for part in (maps.forces(columns), columns))
    before, count = columns[:, : discrete.model.state_count], states.shape[1]
    if path.influence is not None:
        pairs = []
        for i, last in enumerate(np.swapaxes(state, 1, 2)):
            own = np.s_[2 * i : 2 * i + 2]
            of_pair = jax.tree.map(lambda part, own=own: part[own], (path, steps))
            motion = before[own], last, forces[own]
            pairs.append(_end_forces(loads, of_pair[0], of_pair[1], *motion))
        ends = np.concatenate(pairs)
    load_count, batch_size = loads.inertia.shape
    first = initial_peaks(discrete.position_count, load_count, batch_size, discrete.magnitude)
    inputs = before, forces, ends, None if commands is None else columns[:, count:]
    after = np.stack(after, axis=1).reshape(path.start.size, *after[0].shape[1:])
    monitored = _monitored(discrete, loads, path, columns[:, :count], after, forces)
    return update_peaks(first, steps.matrices, path, inputs, monitored)


def _initial_state(discrete: DiscreteModel, loads: LoadSet, policy) -> Float[Array, "state batch"]:
    """States of model and vehicles at rest at t = 0."""
    batch_size = loads.inertia.shape[1]
    state = zeros((discrete.model.state_count, batch_size), discrete)
    states = initial_vehicle_states(loads)
    return state if states is None else xp.concatenate([state, states])


def integrate_history(
    discrete: DiscreteModel,
    loads: LoadSet,
    *,
    max_loads: int,
    steps: int,
    policy: AbstractInputPolicy | None = None,
    in_chunks: bool = False,
):
    """Integrate from rest over a grid: running peaks, states, commands, observations, final memory.

    States (boundary, state, batch) are those before each step and at the end. Commands (step,
    command, batch) at the nodes, observations of each step, and the final memory of the `policy`
    are None without one. Running peaks are those at the monitored positions, None without any.
    `max_loads` is the largest number of loads on the beam at once. The reverse pass saves one state
    for each chunk, if the matrices of the run do not fit into memory, or with `in_chunks`.
    """
    at_once = None if in_chunks else steps
    chunk, chunk_steps = _chunk_function(discrete, loads, max_loads, policy, at_once)
    load_count, batch_size = loads.inertia.shape

    def one_chunk(carry, first):
        state, memory, peaks = carry
        state, memory, peaks, _, history = chunk(state, memory, peaks, first)
        return (state, memory, peaks), history

    running_peaks = (
        None
        if discrete.monitored_transition is None
        else initial_peaks(discrete.position_count, load_count, batch_size, discrete.magnitude)
    )
    memory = None if policy is None else policy.start(batch_size)
    initial_state = _initial_state(discrete, loads, policy)
    start = initial_state, memory, running_peaks
    if chunk_steps >= steps:
        (state, memory, running_peaks), history = one_chunk(start, np.zeros((), int))
    else:
        first_steps = xp.arange(0, steps, chunk_steps)
        one_chunk = checkpoint(one_chunk, policy=jax.checkpoint_policies.nothing_saveable)
        (state, memory, running_peaks), history = scan(one_chunk, start, first_steps)
        history = jax.tree.map(lambda part: collapse(part, 0, 2), history)
    history = jax.tree.map(lambda part: part[:steps], history)
    states, commands, observed = history
    states = xp.concatenate([states, state[None]])
    if policy is not None and has_feedback(policy):
        grid = discrete.grid
        _, times, _ = grid.locate_steps(np.arange(steps + 1))
        failed = diverged(discrete.model, grid, states, times, policy.load_amplitude)
        states = xp.where(failed[:, None], xp.nan, states)
        commands = xp.where(failed[:-1, None], xp.nan, commands)
        if running_peaks is not None:
            running_peaks = running_peaks.without(failed[-1])
    return running_peaks, states, commands, observed, memory


def integrate_peaks(
    discrete: DiscreteModel,
    loads: LoadSet,
    *,
    max_loads: int,
    policy: AbstractInputPolicy | None = None,
) -> tuple[RunningPeaks, Any]:
    """Integrate from rest over a grid: running peaks, and the final memory of the policy.

    The loop ends early when no run has finite numbers or, without a policy, when the energy left
    after the last exit cannot raise any peak. `max_loads` is the largest number of loads on the
    beam at once. Forward mode only.
    """
    grid = discrete.grid
    # Where NumPy could take all steps at once, a chunk ends after the last exit: the loop may, too.
    most = None if policy is not None or any_jax(grid) else int(grid.loaded_steps) + 1
    chunk, chunk_steps = _chunk_function(discrete, loads, max_loads, policy, most=most)

    def unfinished(carry):
        *_, first_step, continues = carry
        return continues & (first_step < grid.step_count)

    def can_raise_peak(state, running_peaks, time):
        all_loads_left = time >= grid.last_exit
        roots = xp.sqrt(energies(discrete.model, state[: discrete.model.state_count]))
        bound = discrete.energy_bounds @ roots
        # A run that has diverged cannot raise its peak further.
        diverged = ~xp.all(xp.isfinite(roots), axis=0)
        settled = xp.all((bound < running_peaks.estimate) | diverged)
        return ~(all_loads_left & settled)

    def next_chunk(carry):
        state, memory, peaks, largest, first_step, _ = carry
        state, memory, peaks, time, history = chunk(state, memory, peaks, first_step)
        if feeds_back:
            _, times, _ = grid.locate_steps(first_step + xp.arange(chunk_steps))
            amplitude = amplitudes(discrete.model, history[0])
            largest = xp.maximum(largest, largest_by_marks(marks, times, amplitude))
        first_step = first_step + chunk_steps
        continues = (
            xp.any(peaks.finite) if policy is not None else can_raise_peak(state, peaks, time)
        )
        return state, memory, peaks, largest, first_step, continues

    load_count, batch_size = loads.inertia.shape
    running_peaks = initial_peaks(
        discrete.position_count, load_count, batch_size, discrete.magnitude
    )
    memory = None if policy is None else policy.start(batch_size)
    feeds_back, marks = policy is not None and has_feedback(policy), growth_marks(grid)
    start = (
        _initial_state(discrete, loads, policy),
        memory,
        running_peaks,
        xp.zeros((len(marks), batch_size)) if feeds_back else None,
        xp.zeros((), int),
        xp.ones((), bool),
    )
    final: Any = while_loop(unfinished, next_chunk, start)
    state, memory, running_peaks, largest, *_ = final
    if feeds_back:
        at_end = amplitudes(discrete.model, state[None])
        largest = xp.maximum(largest, largest_by_marks(marks, marks[:1], at_end))
        limit = growth_limit(largest, policy.load_amplitude)
        running_peaks = running_peaks.without(largest[0] > limit)
    return running_peaks, memory


def integrate_at_events(
    discrete: DiscreteModel,
    loads: LoadSet,
    *,
    max_loads: int,
    policy: AbstractInputPolicy | None = None,
) -> Float[Array, "event state batch"]:
    """Integrate from rest over a grid: states at the events of its schedule.

    The number of steps between events may be traced. The state at the last event is zero, unless a
    step with a policy starts there. Forward mode only.
    """
    grid = discrete.grid
    if policy is not None and policy.implicit and not any_jax(grid):
        steps = int(grid.step_count)
        _, states, *_ = integrate_history(
            discrete, loads, max_loads=max_loads, steps=steps, policy=policy
        )
        return states[np.append(0, grid.cumulative_counts)[grid.event_panels]]
    chunk, chunk_steps = _chunk_function(discrete, loads, max_loads, policy)

    def next_chunk(carry):
        state, memory, kept, first_step = carry
        event = grid.event_at(first_step + xp.arange(chunk_steps))
        state, memory, _, _, (states, *_) = chunk(state, memory, None, first_step)
        kept = put(kept, xp.where(event < 0, kept.shape[0], event), states)
        return state, memory, kept, first_step + chunk_steps

    batch_size = loads.inertia.shape[1]
    initial_state = _initial_state(discrete, loads, policy)
    memory = None if policy is None else policy.start(batch_size)
    event_states = xp.zeros((grid.event_panels.shape[0], *initial_state.shape))
    start = initial_state, memory, event_states, xp.zeros((), int)
    final: Any = while_loop(lambda carry: carry[3] < grid.step_count, next_chunk, start)
    return final[2]
