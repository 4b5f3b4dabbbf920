"""Steps of a batch under the commands of an input policy."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.integrator.growth import OVERFLOW
from jaxbeam.integrator.inputs import StepInfo
from jaxbeam.integrator.propagators import GAUSS_NODES
from jaxbeam.integrator.step import step_maps
from jaxbeam.integrator.vehicles import StepInput, Vehicles
from jaxbeam.runtime.arrays import any_jax, any_traced, collapse, xp
from jaxbeam.runtime.compiling import compiled

BLOCK_STEPS = 64  # of a law in continuous time, which a program advances together


def advance_with_inputs(policy, vehicles: Vehicles | None, steps: StepInput, infos, state, memory):
    """Steps under commands: (state, memory) after them, and (states, forces, commands, observed).

    These are at the starts of the steps; forces and commands at their nodes.
    """
    maps = step_maps(steps, vehicles)
    known = not policy.implicit and not any_jax(maps, state, memory, policy)
    found = _advance_known(policy, maps.states, infos, state, memory) if known else None
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
    start = jax.tree.map(jnp.asarray, (state, memory))  # even if all numbers are known
    if not policy.implicit or any_traced(steps, start, policy):
        after, (sources, observed) = _scan_steps(policy, steps, start)
        return after, sources, observed
    # Blocks of equal length share one program; the last is filled up by repetitions of its step.
    count, found, carry = len(infos.start), [], start
    index = np.minimum(np.arange(-(-count // BLOCK_STEPS) * BLOCK_STEPS), count - 1)
    for block in index.reshape(-1, BLOCK_STEPS):
        own = jax.tree.map(lambda part, block=block: part[block], steps)
        carry, (sources, _) = _scan_block(policy, own, carry)
        found.append(np.asarray(sources))
    sources, (state, memory) = np.concatenate(found), carry
    if count < len(sources):
        state = sources[count, :, : state.shape[0]].T
    return (np.asarray(state), np.asarray(memory)), sources[:count], None


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


def _advance_known(policy, of_states, infos, state, memory):
    """The same of known numbers, under commands that do not depend on the states within a step.

    None if the policy computes with JAX in spite of known numbers, as a law of a user may.
    """
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
    observed = jax.tree.map(lambda *parts: np.stack(parts), *observations)
    return (sources[-1, :, :state_count].T, memory), sources[:-1], observed
