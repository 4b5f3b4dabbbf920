"""The fast integrator: exact modal propagation, contact forces collocated at Gauss nodes.

Within a step every contact force is the polynomial through its values at the Gauss nodes, and so
is the force it puts on each mode; the rig answers exactly (`exponentials`). Demanding the contact
law at the nodes gives a small linear system a step. The free rig brings neither error nor
stiffness at any step length; the order is twice the number of nodes. Steps are taken in chunks:
what depends on the path alone is tabulated for a chunk at once and shared by all lanes
(`tables`), a short loop then advances the states, and what is wanted of the chunk is reduced at
once again (`extremes`). Commands to the actuators are polynomials at the same nodes, given by a
driver.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.loads import AbstractLoad, MovingMass
from jaxbeam.integrator.input_policy import AbstractInputPolicy, StepInfo
from jaxbeam.integrator.propagators import GAUSS, LONGEST, NODES, norm
from jaxbeam.integrator.running_peaks import Extremes, fold, nothing_seen
from jaxbeam.integrator.step import KEPT, advance, contact, undriven
from jaxbeam.integrator.step_matrices import CHUNK, Path, Rigging, follow, tabulate
from jaxbeam.model.contact import Traffic
from jaxbeam.model.modal_model import Rig

# Radians a step of the highest mode. Beyond twice the number of nodes the contact force of a mass,
# a polynomial in each step, misses that mode's oscillation and feeds it.
RESOLVED = 1.9 * NODES


def longest_step(rig: Rig, loads: tuple[AbstractLoad, ...]) -> Float[Array, ""]:
    """Longest step (s) with which these loads on the rig can be integrated without blowing up."""
    limit = LONGEST / norm(rig)
    if any(isinstance(load, MovingMass) for load in loads):
        fastest = jnp.sqrt(jnp.max(jnp.linalg.eigvalsh(rig.stiffness())))
        limit = jnp.minimum(limit, RESOLVED / fastest)
    return jax.lax.stop_gradient(limit)


def _driven(driver: AbstractInputPolicy, carry, step):
    """One step of all lanes under the commands of a driver."""
    state, memory = carry
    tables, inertia, weight, moment = step

    def states(commands):
        commands = jax.lax.collapse(commands, 0, 2)
        forces = contact(tables, inertia, weight, state, commands)
        inner = tables.inner
        flat = inner.drift @ state + inner.push @ forces + inner.command @ commands
        return flat.reshape(len(GAUSS), *state.shape)

    given, memory = driver.inputs(memory, state, moment, states)
    commands = jax.lax.collapse(given, 0, 2)
    after, (state, forces) = advance(state, (tables, inertia, weight, commands))
    # A loop that diverges ends here, in its own lane, instead of running into overflow.
    lost = jnp.any(~(jnp.abs(after) <= driver.state_bound[:, None]), axis=0)
    after = jnp.where(lost, jnp.nan, after)
    return (after, memory), (state, forces, commands, driver.observe(memory, moment))


def _rows(loads: Float[Array, "load lane"], path: Path) -> Float[Array, "step row lane"]:
    """A property of the loads for every row of the contact equations; zero for idle slots."""
    chosen = jnp.where(path.active[..., None], loads[path.slots], 0.0)
    return jnp.repeat(chosen, len(GAUSS), axis=1)


def _stepper(rigging: Rigging, traffic: Traffic, slots: int, driver: AbstractInputPolicy | None):
    """Function that takes state, memory and extremes through the chunk from a given step on.

    It returns them with the time (s) at its end, and with what may be kept of it.
    """

    def chunk(state, memory, best: Any, first):
        index = first + jnp.arange(CHUNK)
        path = follow(rigging, traffic, slots, index)
        tables = tabulate(rigging, path)
        loads = _rows(traffic.inertia, path), _rows(traffic.weight, path)
        commands = shown = None
        if driver is None:
            state, states, forces = undriven(tables, *loads, state)
        else:
            moments = StepInfo(path.start, path.span, rigging.grid.edge(index))
            (state, memory), (states, forces, commands, shown) = jax.lax.scan(
                lambda carry, step: _driven(driver, carry, step),
                (state, memory),
                (tables, *loads, moments),
            )
        if best is not None:
            best = fold(best, tables, path, states, forces, commands)
        return state, memory, best, path.start[-1] + path.span[-1], (states, commands, shown)

    return chunk


def trace(
    rigging: Rigging,
    traffic: Traffic,
    *,
    slots: int,
    steps: int,
    driver: AbstractInputPolicy | None = None,
):
    """Integrate from rest over a grid: extremes, states, commands, what is shown, and memory.

    States (edge, state, lane) are those at the start of every step and at the end, commands
    (step, command, lane) those at the nodes of every step, None without a `driver`; what it shows
    is kept for every step, its memory that at the end. Extremes are those at the watched places,
    None if there are none. `slots` is how many loads may be on the beam at once. Reverse mode
    keeps the state and the contact forces of every step, under a driver one state a chunk.
    """
    chunk = _stepper(rigging, traffic, slots, driver)
    lanes, loads = traffic.inertia.shape[1], len(traffic.motions)

    def whole(carry, first):
        state, memory, best = carry
        state, memory, best, _, history = chunk(state, memory, best, first)
        return (state, memory, best), history

    best = (
        None if rigging.watch is None else nothing_seen(rigging.places, loads, lanes, rigging.size)
    )
    memory = None if driver is None else driver.start(lanes)
    rest = jnp.zeros((rigging.rig.states, lanes))
    firsts = jnp.arange(0, steps, CHUNK)
    again = jax.checkpoint(whole, policy=jax.checkpoint_policies.save_only_these_names(KEPT))
    (state, memory, best), history = jax.lax.scan(again, (rest, memory, best), firsts)
    history = jax.tree.map(lambda part: jax.lax.collapse(part, 0, 2)[:steps], history)
    states, commands, shown = history
    return best, jnp.concatenate([states, state[None]]), commands, shown, memory


def march(
    rigging: Rigging,
    traffic: Traffic,
    *,
    slots: int,
    driver: AbstractInputPolicy | None = None,
) -> tuple[Extremes, Any]:
    """Integrate from rest over a grid, keeping only extremes at the watched places.

    They are returned with the memory of the driver at the end.

    The loop runs as long as it must: it ends early when all lanes are given up, and without a
    driver when the energy left after the last exit cannot raise any peak. `slots` is how many
    loads may be on the beam at once. Forward mode only.
    """
    chunk = _stepper(rigging, traffic, slots, driver)
    grid, stiffness = rigging.grid, rigging.rig.stiffness()
    size = 2 * stiffness.shape[0]

    def more(carry):
        *_, first, going = carry
        return going & (first < grid.total)

    def still(state, best, time):
        left = time >= grid.last_exit
        place, rate = state[0:size:2], state[1:size:2]
        energy = jnp.sum(rate**2, axis=0) + jnp.sum(place * (stiffness @ place), axis=0)
        reach = jnp.sqrt(rigging.flexibility[:, None] * energy)
        # A run that has blown up has nothing more to show.
        over = jnp.all((reach < best.score) | ~jnp.isfinite(energy))
        return ~(left & over)

    def go(carry):
        state, memory, best, first, _ = carry
        state, memory, best, time, _ = chunk(state, memory, best, first)
        first = first + CHUNK
        going = jnp.any(best.sound) if driver is not None else still(state, best, time)
        return state, memory, best, first, going

    lanes, loads = traffic.inertia.shape[1], len(traffic.motions)
    best = nothing_seen(rigging.places, loads, lanes, rigging.size)
    memory = None if driver is None else driver.start(lanes)
    start = (
        jnp.zeros((rigging.rig.states, lanes)),
        memory,
        best,
        jnp.zeros((), int),
        jnp.ones((), bool),
    )
    ended: Any = jax.lax.while_loop(more, go, start)
    return ended[2], ended[1]


def at_edges(
    rigging: Rigging, traffic: Traffic, *, slots: int, driver: AbstractInputPolicy | None = None
) -> Float[Array, "edge state lane"]:
    """Integrate from rest over a grid, keeping only the states at the edges of its schedule.

    The number of steps between these need not be known when this is compiled. The state at the
    last edge is left out, zero, unless a driver acts there. Forward mode only.
    """
    chunk = _stepper(rigging, traffic, slots, driver)
    grid = rigging.grid

    def go(carry):
        state, memory, kept, first = carry
        edge = grid.edge(first + jnp.arange(CHUNK))
        state, memory, _, _, (states, *_) = chunk(state, memory, None, first)
        kept = kept.at[jnp.where(edge < 0, kept.shape[0], edge)].set(states, mode="drop")
        return state, memory, kept, first + CHUNK

    lanes = traffic.inertia.shape[1]
    rest = jnp.zeros((rigging.rig.states, lanes))
    memory = None if driver is None else driver.start(lanes)
    kept = jnp.zeros((grid.place.shape[0], *rest.shape))
    start = rest, memory, kept, jnp.zeros((), int)
    ended: Any = jax.lax.while_loop(lambda carry: carry[3] < grid.total, go, start)
    return ended[2]
