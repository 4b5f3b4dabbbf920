"""Step matrices shared by all runs of a batch; they depend on load path and model only.

Within a step, contact forces and commands are polynomials through their values at the Gauss nodes,
under which the model is propagated exactly (`propagators`). The matrices map these values, and the
state at the start, to the acceleration under the loads at the nodes, the state at the end and the
deflections at monitored positions.

A wheel with mass that passes a kink changes velocities at once, not positions. With the mode
shapes S at the wheels on the beam, their masses m, and the change d = |v| ([w'] + [r']) of the
velocity of the wheel that passes at constant q', impulses p on the beam (N s, upwards) change the
rates q' by S' p, and

    p = -m (d + S S' p):

no wheel leaves the surface. That is the contact law of a step in which d takes the place of the
acceleration of the surface under a wheel, and S S' that of the compliance. So a passage is a step
of no length with matrices of its own, and impulses are its contact forces at its first node.
"""

import dataclasses
import math
import operator
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.model.contact import KinkSteps, ModalCompliance, SurfaceRows
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    add_at,
    any_jax,
    cond,
    is_jax,
    map_elements,
    set_at,
    take,
    xp,
)
from jaxbeam.simulation.integrator.discrete_model import NODE_COUNT, PEAK_NODES, DiscreteModel
from jaxbeam.simulation.integrator.load_path import LoadPath

CHUNK_STEPS = 16  # steps whose matrices a compiled program computes together
FEW_STEPS = 16  # of one length, below which a call takes longer than their own propagators
MANY_STATES = 48  # from which NumPy makes no matrix of all states for a step
# Entries of the largest matrix of all steps of a prepared run: 67 MB. The runs and derivatives of a
# batch multiply it: with 0.3 GB, the tuning of an absorber under a train of 50 axles, three runs
# and two parameters, took 11 GB and 2.5 times as long. Single runs take as long with either.
PREPARED_ENTRIES = 2**23
NUMPY_CHUNK_ENTRIES = 2**19  # entries of matrices that NumPy computes together, to fit in caches


class CommandMatrices(Module):
    """Maps of commands at the nodes to the acceleration under the loads and the final state."""

    contact_response: Float[Array, "step solved_row command"] | None
    input_matrix: Float[Array, "step state command"]


class NodeMatrices(Module):
    """Maps of initial state, contact forces and commands to the states at the Gauss nodes."""

    transition: Float[Array, "step node_state state"]
    force_response: Float[Array, "step node_state row"]
    command_response: Float[Array, "step node_state command"]


class SpringMatrices(Module):
    """Maps of initial state, contact forces and commands to the motion under the wheels at nodes.

    The motion is the deflection, then the velocity, of the surface.
    """

    response: Float[Array, "step motion solved_row state"]
    compliance: Float[Array, "step motion solved_row force"]
    commands: Float[Array, "step motion solved_row command"] | None


class StepMatrices(Module):
    """Matrices of the steps of a chunk; rows are (load, node), commands (node, actuator).

    `contact_response` maps the state at the start to the acceleration under the loads at the
    nodes, `contact_compliance` the contact forces; both are None where no load has inertia. Their
    rows are those of the first loads, the forces of all others being prescribed.
    `springs` are None where no wheel has springs. The columns of `monitored` are state at the
    start, contact forces at the nodes, contact forces at the ends if outputs respond to them
    directly, and commands. A step is `loaded` with a load on the beam.
    """

    contact_response: Float[Array, "step solved_row state"] | None
    contact_compliance: Float[Array, "step solved_row force"] | ModalCompliance | None
    transition: Float[Array, "step block side side"]
    force_response: Float[Array, "step state row"]
    monitored: Float[Array, "step sample input"] | None
    commands: CommandMatrices | None
    nodes: NodeMatrices | None
    springs: SpringMatrices | None
    loaded: Bool[Array, " step"]

    @property
    def state_count(self) -> int:
        """Number of states of the model."""
        return self.transition.shape[-3] * self.transition.shape[-2]


def advances_by_forces(states: int) -> bool:
    """Whether NumPy propagates this number of states by contact forces, not by one matrix a step.

    A step then takes more operations, but their sizes grow with the number of states and not with
    its square.
    """
    return states >= MANY_STATES


def share_matrices(inertia: Float[Array, "*axis"]) -> bool:
    """Whether the runs of a batch, along the second axis, are known to have the same wheels."""
    return inertia.shape[1] > 1 and not is_jax(inertia) and not np.ptp(inertia, axis=1).any()


def chunk_length(
    discrete: DiscreteModel, loads: LoadSet, max_loads: int, prepared: int | None = None
) -> int:
    """Number of steps whose matrices are computed together.

    NumPy, where each operation takes microseconds to begin, takes as many as caches hold. All of
    the `prepared` steps of a traced run are together, if they fit into memory.
    """
    if any_jax(discrete) and not prepared:
        return CHUNK_STEPS
    rows = max_loads * NODE_COUNT
    states = discrete.model.state_count + loads.vehicle_states
    solved = min(max_loads, loads.solved_count) * NODE_COUNT
    compliance = solved * min(rows, NODE_COUNT * discrete.model.mode_count)
    if loads.wheels.vehicles:  # springs feel deflection and velocity, and those of a vehicle all
        sprung = int(loads.on_ground.sum() + 1) * NODE_COUNT
        compliance = max(2 * solved * rows, sprung**2)
    transition = states**2
    plain = discrete.modal_command_matrix is None and not loads.wheels.vehicles
    if plain and advances_by_forces(states):
        transition = discrete.model.state_matrix.size
        if discrete.monitored_transition is not None:
            transition = max(transition, discrete.monitored_transition[0].size)
    batch = loads.inertia.shape[1]
    shared = not loads.wheels.vehicles and share_matrices(loads.inertia)
    of_matrices = (1 if shared else batch) * max(compliance, rows * states, transition)
    monitored = 0
    if discrete.load_influence is not None:  # of the loads on the outputs, of each step its own
        monitored = discrete.monitored_transition.shape[1] * (states + rows)
    entries = max(of_matrices, batch * (rows + states), monitored)
    if prepared:
        return prepared if prepared * entries <= PREPARED_ENTRIES else CHUNK_STEPS
    if any_jax(loads):
        return CHUNK_STEPS
    return int(max(1, min(discrete.grid.step_count, NUMPY_CHUNK_ENTRIES // entries)))


@jax.named_scope("load_path")
def step_matrices(discrete: DiscreteModel, path: LoadPath) -> StepMatrices:
    """Matrices of the steps of a chunk."""
    monitored = discrete.monitored_transition, discrete.monitored_input
    if not any_jax(discrete.propagators, monitored, path.length_index, path.rows):
        matrices = _matrices_by_length(discrete, path)
    elif len(path.length_index) > CHUNK_STEPS:  # a whole run
        propagators = _propagators_of(discrete, path.length_index)
        matrices = _matrices_of_steps(discrete, propagators, path.rows, "t")
    else:
        matrices = _matrices_by_branch(discrete, path)
    if path.influence is not None:
        matrices = (*matrices[:4], _with_influence(discrete, matrices[4], path), *matrices[5:])
    return StepMatrices(*matrices, loaded=xp.any(path.on_beam, axis=1))


def _with_influence(discrete: DiscreteModel, monitored, path: LoadPath):
    """Rows of monitored outputs with the static influence of the forces at the peak nodes added.

    Peak nodes are the start, the Gauss nodes and the end of a step.
    """
    steps, loads = path.on_beam.shape
    first, samples = discrete.model.state_count, monitored.shape[1]

    def of_forces(influence, peaks):
        """Rows on forces at some peak nodes: a force acts on the outputs at its own node."""
        at = np.eye(len(PEAK_NODES))[:, peaks]
        return xp.einsum("pf,tlps->tpslf", at, influence).reshape(steps, samples, -1)

    at_nodes = of_forces(path.influence, np.arange(1, NODE_COUNT + 1))
    at_ends = of_forces(path.influence, np.array([0, NODE_COUNT + 1]))
    last = first + loads * NODE_COUNT
    parts = monitored[..., :first], monitored[..., first:last] + at_nodes
    return xp.concatenate([*parts, at_ends, monitored[..., last:]], axis=2)


def _matrices_by_length(discrete: DiscreteModel, path: LoadPath):
    """Matrices of the steps of a chunk in NumPy, computed together for steps of equal length.

    Steps whose lengths are rare are together, too, each with its own propagators.
    """
    lengths, counts = np.unique(path.length_index, return_counts=True)
    rare = np.isin(path.length_index, lengths[counts < FEW_STEPS])
    groups = [(path.length_index == one, "") for one in lengths[counts >= FEW_STEPS]]
    groups += [(rare, "t")] if rare.any() else []

    def matrices_of(steps, t):
        rows = jax.tree.map(lambda part: part[steps], path.rows)
        own = path.length_index[steps]
        return _matrices_of_steps(
            discrete, _propagators_of(discrete, own if t else own[0]), rows, t
        )

    if len(groups) == 1:
        return matrices_of(slice(None), groups[0][1])
    # Written into preallocated arrays: concatenation would take three times the memory.
    whole: Any = None
    for steps, t in groups:
        part = matrices_of(steps, t)
        if whole is None:
            whole = jax.tree.map(lambda one: np.empty((len(rare), *one.shape[1:])), part)
        jax.tree.map(lambda all_, one, steps=steps: operator.setitem(all_, steps, one), whole, part)
    return whole


def _matrices_by_branch(discrete: DiscreteModel, path: LoadPath):
    """Matrices of the steps of a chunk with traced lengths, which may be equal or not."""
    # Chosen outside the branches: inside, derivatives would pass through all lengths.
    first_propagators = _propagators_of(discrete, path.length_index[0])

    def equal_lengths(_):
        return _matrices_of_steps(discrete, first_propagators, path.rows)

    def mixed_lengths(_):
        def single_step(step):
            kind, rows = step
            rows = jax.tree.map(lambda part: part[None], rows)
            matrices = _matrices_of_steps(discrete, _propagators_of(discrete, kind), rows)
            return jax.tree.map(lambda matrix: matrix[0], matrices)

        return map_elements(single_step, (path.length_index, path.rows))

    # In most chunks all steps are equally long and have the same propagators.
    return cond(
        xp.all(path.length_index == path.length_index[0]), equal_lengths, mixed_lengths, None
    )


def _propagators_of(discrete: DiscreteModel, length_index):
    """Propagators and monitored rows for one index of a step length, or for several."""
    parts = discrete.propagators, discrete.monitored_transition, discrete.monitored_input
    return jax.tree.map(lambda part: take(part, length_index), parts)


def _matrices_of_steps(discrete: DiscreteModel, propagators, motion: SurfaceRows, t: str = ""):
    """Matrices of steps from the rows `motion` (step, load, node, ...) at the wheels.

    Propagators are those of one length, or of each step if `t` is "t", the label of their first
    axis.
    """
    shape, rows = motion.shape, motion.acceleration
    of_states, deflection_transition, deflection_force_response = propagators
    steps, load_count, nodes, _, modes = shape.shape
    size = load_count * nodes
    solved = 0 if rows is None else rows.shape[1] * nodes
    states = discrete.model.state_count
    contact_response = contact_compliance = None
    if rows is not None:
        contact_response = xp.einsum(f"tpcbi,{t}cbij->tpcbj", rows, of_states.transition_nodes)
        contact_response = contact_response.reshape(steps, solved, states)
        contact_compliance = _contact_compliance(
            of_states.input_nodes[..., :modes], shape, rows, motion.deflection is None, t
        )
    force_response = xp.einsum(f"tqfbm,{t}fbim->tbiqf", shape, of_states.input_end[..., :modes])

    def for_all_steps(matrix, *shape):
        """Matrix repeated for each step, reshaped."""
        first = (steps,) if t else ()
        matrix = matrix.reshape(*first, *(shape or matrix.shape[len(first) :]))
        return xp.broadcast_to(matrix, (steps, *matrix.shape[len(first) :]))

    matrices = (
        contact_response,
        contact_compliance,
        for_all_steps(of_states.transition_end),
        force_response.reshape(steps, states, size),
    )
    if deflection_transition is None:
        matrices = (*matrices, None)
    else:
        deflection_count = deflection_transition.shape[-3]
        force_to_deflection = xp.einsum(
            f"{t}lfbm,tqfbm->tlqf", deflection_force_response[..., :modes], shape
        )
        parts = [
            for_all_steps(deflection_transition, deflection_count, states),
            force_to_deflection.reshape(steps, deflection_count, size),
        ]
        if discrete.modal_command_matrix is not None:
            responses = deflection_force_response[..., 0, modes:]
            width = math.prod(responses.shape[-2:])  # not -1: there may be no deflections
            parts.append(for_all_steps(responses, deflection_count, width))
        matrices = (*matrices, xp.concatenate(parts, axis=2))
    commands = node_states = None
    if discrete.modal_command_matrix is not None:
        # The model of a run with commands is a single block.
        command_responses = of_states.input_nodes[..., 0, :, modes:]
        command_count = nodes * discrete.modal_command_matrix.shape[1]
        commands = CommandMatrices(
            None
            if rows is None
            else _command_response(discrete, command_responses, shape, rows, t).reshape(
                steps, solved, command_count
            ),
            for_all_steps(
                xp.moveaxis(of_states.input_end[..., 0, :, modes:], -2, -3), states, command_count
            ),
        )
    if discrete.with_node_states:
        force_inputs = of_states.input_nodes[..., 0, :, :modes]
        force_to_node_states = xp.einsum(f"tqfm,{t}cfim->tciqf", shape[..., 0, :], force_inputs)
        node_states = NodeMatrices(
            for_all_steps(of_states.transition_nodes, nodes * states, states),
            force_to_node_states.reshape(steps, nodes * states, size),
            for_all_steps(xp.moveaxis(command_responses, -3, -2), nodes * states, command_count),
        )
    springs = None
    if motion.deflection is not None:
        spring_rows = xp.concatenate([motion.deflection, motion.velocity], axis=1)
        springs = _spring_matrices(discrete, of_states, shape, spring_rows, t)
    return *matrices, commands, node_states, springs


def _spring_matrices(discrete: DiscreteModel, of_states, shape, rows, t) -> SpringMatrices:
    """Maps to the motion of the surface under the wheels, from its `rows`.

    Rows are those to the deflection under all wheels, then to the velocity.
    """
    steps, load_count, nodes, _, modes = shape.shape
    solved = rows.shape[1] // 2 * nodes
    response = xp.einsum(f"tpcbi,{t}cbij->tpcbj", rows, of_states.transition_nodes)
    by_force = xp.einsum(f"tpcbi,{t}cfbim->tpcfbm", rows, of_states.input_nodes[..., :modes])
    compliance = xp.einsum("tpcfbm,tqfbm->tpcqf", by_force, shape)
    commands = None
    if discrete.modal_command_matrix is not None:
        by_command = of_states.input_nodes[..., 0, :, modes:]
        commands = xp.einsum(f"tpci,{t}cfiu->tpcfu", rows[..., 0, :], by_command)
        count = math.prod(commands.shape[3:])
        commands = commands.reshape(steps, 2, solved, count)
    states = discrete.model.state_count
    return SpringMatrices(
        response.reshape(steps, 2, solved, states),
        compliance.reshape(steps, 2, solved, load_count * nodes),
        commands,
    )


def _contact_compliance(input_nodes, shape, rows, by_factors, t):
    """Acceleration (m/s^2) under the loads at the nodes due to contact forces of one newton.

    With `by_factors` it is a product of two factors where generalised forces are fewer than contact
    forces.
    """
    steps, load_count, nodes, blocks, modes = shape.shape
    solved, size = rows.shape[1], load_count * nodes
    own_shape = shape[:, :solved]
    response = xp.einsum(f"tpcbi,{t}cfbim->tpcfbm", rows, input_nodes)
    if by_factors and solved > blocks * modes:
        own_node = np.eye(nodes)[:, :, None, None]
        response = response + own_shape[:, :, :, None] * own_node
        shape_rows = shape.reshape(steps, load_count, nodes, -1)
        return ModalCompliance(response.reshape(steps, solved * nodes, -1), shape_rows)
    compliance = xp.einsum("tpcfbm,tqfbm->tpcqf", response, shape)
    direct = xp.einsum("tpcbm,tqcbm->tpcq", own_shape, shape)
    compliance = compliance + direct[..., None] * np.eye(nodes)[:, None, :]
    return compliance.reshape(steps, solved * nodes, size)


def _command_response(discrete: DiscreteModel, command_responses, shape, rows, t):
    """Acceleration (m/s^2) under the loads at the nodes due to unit commands at the nodes."""
    response = xp.einsum(f"tpci,{t}cfiu->tpcfu", rows[..., 0, :], command_responses)
    own_shape = shape[:, : rows.shape[1], :, 0]
    feedthrough = xp.einsum("tpcm,mu->tpcu", own_shape, discrete.modal_command_matrix)
    return response + feedthrough[:, :, :, None] * np.eye(shape.shape[2])[:, :, None]


def weights_with_impulses(
    kinks: KinkSteps,
    inertia: Float[Array, "step row batch"],
    weight: Float[Array, "step row batch"],
) -> Float[Array, "step row batch"]:
    """Weights (N) of the rows (wheel and node) of steps; m |v| [r'] (N s) in kink passages."""
    steps, loads = kinks.profile.shape
    others = xp.zeros((steps, loads, inertia.shape[1] // loads - 1))
    jumps = xp.concatenate([kinks.profile[..., None], others], axis=2).reshape(steps, -1, 1)
    return _in_passages(kinks, inertia * jumps, weight)


def with_prescribed_forces(
    matrices: StepMatrices,
    inertia: Float[Array, "step row batch"],
    weight: Float[Array, "step row batch"],
):
    """Matrices of the solved rows alone, weights, and motion (m, m/s) of the surface, or None.

    The forces of the other rows are prescribed. They accelerate the surface under the solved
    wheels, as a profile does, and move it under those with springs.
    """
    solved = 0 if matrices.contact_response is None else matrices.contact_response.shape[1]
    if not solved or solved == weight.shape[1]:
        return matrices, weight, None
    forces = -set_at(weight, np.s_[:, :solved], 0.0)
    compliance: Any = matrices.contact_compliance
    weight = add_at(weight, np.s_[:, :solved], inertia[:, :solved] * (compliance @ forces))
    motion, springs = None, matrices.springs
    if springs is not None:
        motion = springs.compliance @ forces[:, None]
        springs = dataclasses.replace(springs, compliance=springs.compliance[..., :solved])
    if not isinstance(compliance, ModalCompliance):
        compliance = compliance[..., :solved]
    kept = dataclasses.replace(matrices, contact_compliance=compliance, springs=springs)
    return kept, weight, motion


def with_impulses(
    kinks: KinkSteps,
    matrices: StepMatrices,
    shape: Float[Array, "step load node block mode"],
    model: ModalModel,
) -> StepMatrices:
    """Matrices of steps, replaced by those of impulses in kink passages.

    `shape` are the mode shapes at the wheels.
    """
    steps, loads, nodes = shape.shape[:3]
    shapes = shape[:, :, 0].reshape(steps, loads, -1)
    solved = matrices.contact_response.shape[1] // nodes
    own_shapes = shapes[:, :solved]

    def at_first_node(like, axes: tuple[int, ...], index, values):
        """`like` with values at an index in passages; rows along `axes` are (wheel, node)."""
        size: list[Any] = list(like.shape)
        for axis in sorted(axes, reverse=True):
            size[axis : axis + 1] = size[axis] // nodes, nodes
        return _in_passages(kinks, set_at(xp.zeros(size), index, values).reshape(like.shape), like)

    index = np.s_[:, :, 0, model.coordinate_index]
    response = at_first_node(matrices.contact_response, (1,), index, kinks.slopes[:, :solved])
    compliance: Any = matrices.contact_compliance
    if isinstance(compliance, ModalCompliance):
        index = np.s_[:, :, 0, : shapes.shape[2]]
        factor = at_first_node(compliance.response, (1,), index, own_shapes)
        compliance = ModalCompliance(factor, compliance.shape_rows)
    else:
        mobility = own_shapes @ xp.swapaxes(shapes, 1, 2)
        compliance = at_first_node(compliance, (1, 2), np.s_[:, :, 0, :, 0], mobility)
    index = np.s_[:, model.rate_index, :, 0]
    forces = at_first_node(matrices.force_response, (2,), index, xp.swapaxes(shapes, 1, 2))

    def absent(matrices):
        """Matrices that are zero in a passage: those of commands and of the springs of wheels."""
        commands, springs = matrices.commands, matrices.springs
        parts = [] if commands is None else [commands.contact_response]
        if springs is not None:
            parts += [springs.response, springs.compliance]
            parts += [] if springs.commands is None else [springs.commands]
        return parts

    zero = [_in_passages(kinks, 0.0, part) for part in absent(matrices)]
    return eqx.tree_at(
        lambda m: [m.contact_response, m.contact_compliance, m.force_response, *absent(m)],
        matrices,
        [response, compliance, forces, *zero],
    )


def _in_passages(kinks: KinkSteps, values, others):
    """`values` in steps that are kink passages, `others` in other steps."""
    return xp.where(kinks.here.reshape(-1, *(1,) * (others.ndim - 1)), values, others)
