"""Steps of a batch under the commands of an input policy."""

import jax
import numpy as np

from jaxbeam.integrator.growth import OVERFLOW
from jaxbeam.integrator.input_policy import AbstractInputPolicy, StepInfo
from jaxbeam.integrator.propagators import GAUSS_NODES
from jaxbeam.integrator.step import advance, forces_and_vehicles, known_maps
from jaxbeam.integrator.vehicles.steps import StepInput, Vehicles
from jaxbeam.runtime.arrays import any_jax, collapse, xp


def step_with_inputs(policy: AbstractInputPolicy, vehicles: Vehicles | None, carry, step):
    """One step of a batch under the commands of an input policy."""
    state, memory = carry
    step, info = step
    count = step.matrices.state_count

    def node_states(commands):
        commands = collapse(commands, 0, 2)
        forces, _ = forces_and_vehicles(state, step, commands, vehicles)
        nodes, beam = step.matrices.nodes, state[:count]
        node_values = (
            nodes.transition @ beam
            + nodes.force_response @ forces
            + nodes.command_response @ commands
        )
        return node_values.reshape(len(GAUSS_NODES), *beam.shape)

    node_commands, memory = policy.inputs(memory, state, info, node_states)
    commands = collapse(node_commands, 0, 2)
    next_state, (state, forces) = advance(state, step, commands, vehicles)
    # A run becomes NaN here, without affecting the others, before it overflows.
    within = xp.abs(next_state) <= OVERFLOW
    next_state = xp.where(xp.all(within, axis=0), next_state, xp.nan)
    return (next_state, memory), (state, forces, commands, policy.observe(memory, info))


def advance_known_with_inputs(policy, vehicles, steps: StepInput, infos, state, memory):
    """Steps of known numbers under commands that do not depend on the states within a step.

    Results as of a `scan` of `step_with_inputs`; see `step.known_maps`. None if the policy
    computes with JAX in spite of known numbers, as a law of a user may.
    """
    of_forces, of_states = known_maps(steps, vehicles)
    count, batch_size, state_count = of_states.offset.shape
    # State and commands.
    sources = np.ones((count + 1, batch_size, of_states.linear.shape[-1]))
    sources[0, :, :state_count] = state.T
    events, observations, held = infos.event.tolist(), [], None
    for i in range(count):
        state = sources[i, :, :state_count]
        if events[i] >= 0 or i == 0 or not policy.holds_commands:
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
    forces, states = (np.swapaxes(part, 1, 2) for part in (of_forces(sources[:-1]), sources))
    commands = states[:-1, state_count:]
    observed = jax.tree.map(lambda *parts: np.stack(parts), *observations)
    states = states[:, :state_count]
    return (states[-1], memory), (states[:-1], forces, commands, observed)
