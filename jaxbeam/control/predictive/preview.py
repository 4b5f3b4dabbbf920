"""Preview: maps of a plant under travelling loads over the periods of a prediction.

The plant is that of `crossing_plant`: constant, coupled to forces that vary in time. A period is
divided into cells, in which the constant part is propagated exactly and the forces are polynomials
through Gauss nodes (`coupled_stages`), as in the integration of runs. Samples are multiples of the
period, so that a load event, at which forces have a kink, always divides the same cell: the maps of
such cells are computed once.
"""

import math

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.control.optimal.crossing_gains import crossing_plant
from jaxbeam.control.predictive.prediction import SampledPlant
from jaxbeam.model.state_space import Plant
from jaxbeam.model.vehicles.contact_rows import vehicle_system
from jaxbeam.numerics.coupled_stages import (
    ConstantPlant,
    StageResponse,
    node_forces,
    stage_responses,
)
from jaxbeam.numerics.finite_horizon import MAX_HALVINGS
from jaxbeam.numerics.stages import GAUSS_NODES, NODE_COUNT
from jaxbeam.runtime.arrays import (
    Array,
    any_jax,
    map_elements,
    scan,
    searchsorted,
    take,
    xp,
)
from jaxbeam.runtime.module import Module

# Cells of a period, or of each part before and after a delayed command begins, at most; and phase
# of the fastest mode, or of a vehicle, in one, with which fewer have maps exact to about 1e-9.
CELLS, MAX_PHASE_PER_CELL = 8, 1.7

# State at the end of a cell from the state at its start and the held commands.
CellMap = Float[Array, "*cell all all_and_command"]


class Preview(Module):
    """Plant under its loads, and what its maps have in common at all samples.

    `edges` (s) are the ends of the cells of a period. `responses` are those of the constant part
    over cells before, and after, a delayed command begins. Cells that contain load events have the
    indices `event_cells`, counted from t = 0, and the maps `event_maps`, of which the last one with
    an index counts.
    """

    plant: Plant
    period: Float[Array, ""]
    delay: Float[Array, ""] | None
    edges: Float[Array, " edge"]
    responses: tuple[StageResponse, ...]
    event_cells: Int[Array, " event"]
    event_maps: Float[Array, "event all all_and_command"]

    def sampled_plants(self, t: Float[Array, ""], first: int, count: int) -> SampledPlant:
        """Plants over `count` periods, the `first` one so many periods after the sample at t (s).

        Known inputs are the constants of `Plant.augmented`.
        """
        constant_plant, coupling_at = crossing_plant(self.plant, with_weights=True)
        explicit, cells = self.plant.loads.massless, self.edges.shape[0] - 1
        per_part = cells // len(self.responses)
        periods = self.sample_at(t) + first + np.arange(count)
        starts = (periods * self.period)[:, None] + self.edges[:-1]
        lengths = xp.diff(self.edges)
        parts = []
        for i, response in enumerate(self.responses):
            own = slice(i * per_part, (i + 1) * per_part)
            times = starts[:, own, None] + lengths[own, None] * GAUSS_NODES
            coupling = coupling_at(times.reshape(-1, NODE_COUNT))
            maps = cell_maps(constant_plant, response, coupling, explicit)
            parts.append(maps.reshape(count, per_part, *maps.shape[1:]))
        maps = xp.concatenate(parts, axis=1)
        if self.event_cells.shape[0]:
            index = periods[:, None] * cells + np.arange(cells)
            event = searchsorted(self.event_cells, index) - 1
            event = xp.maximum(event, 0)
            divided = take(self.event_cells, event) == index
            maps = xp.where(divided[..., None, None], take(self.event_maps, event), maps)
        return self._compose(maps)

    def sample_at(self, t: Float[Array, ""]) -> Int[Array, ""]:
        """Number of the sample at t (s)."""
        return xp.floor(t / self.period + 0.5).astype(int)

    def _compose(self, maps: Float[Array, "period cell all all_and_command"]) -> SampledPlant:
        """Plants over periods from the maps of their cells."""
        size, commands = maps.shape[2], maps.shape[3] - maps.shape[2]
        states = self.plant.modal_model.state_count + self.plant.vehicle_states
        delayed = self.delay is not None
        previous = np.arange(maps.shape[1]) < (maps.shape[1] // 2 if delayed else 0)

        def advance(total, part):
            cell, before = part
            columns = cell[:, :, size:]
            own = xp.concatenate(
                [
                    xp.where(before, columns, 0.0),
                    xp.where(before, 0.0, columns),
                ],
                axis=2,
            )
            total = cell[:, :, :size] @ total
            return xp.concatenate([total[..., :size], total[..., size:] + own], axis=2), None

        start = xp.broadcast_to(
            xp.eye(size, size + 2 * commands), (maps.shape[0], size, size + 2 * commands)
        )
        total, _ = scan(advance, start, (xp.moveaxis(maps, 1, 0), previous))
        total = total[:, :states]
        A, E = total[..., :states], total[..., states:size]
        before, after = total[..., size : size + commands], total[..., size + commands :]
        if not delayed:
            return SampledPlant(A, after, E)
        none, count = ((0, 0), (0, commands), (0, 0)), (maps.shape[0], commands, commands)
        A = xp.pad(xp.concatenate([A, before], axis=2), none)
        identity = xp.broadcast_to(xp.eye(commands), count)
        return SampledPlant(A, xp.concatenate([after, identity], axis=1), xp.pad(E, none))


def preview(plant: Plant, period: Float[Array, ""], delay: Float[Array, ""] | None) -> Preview:
    """Preview of a plant with its loads for commands held over a period, after a delay (s)."""
    constant_plant, coupling_at = crossing_plant(plant, with_weights=True)
    explicit, per_part = plant.loads.massless, _cell_count(plant, period)
    shares = np.arange(per_part) / per_part
    marks = [xp.zeros(()), *([] if delay is None else [delay]), period]
    parts = list(zip(marks[:-1], marks[1:], strict=True))
    edges = [start + (end - start) * shares for start, end in parts]
    edges = xp.concatenate([*edges, xp.reshape(period, 1)])
    responses = tuple(_response(constant_plant, (end - start) / per_part) for start, end in parts)

    def piece(part):
        start, end = part
        length = xp.maximum(end - start, 0.0)
        coupling = coupling_at((start + length * GAUSS_NODES)[None])
        response = _response(constant_plant, length)
        return cell_maps(constant_plant, response, coupling, explicit)[0]

    events = xp.sort(plant.loads.events(plant.modal_model.modes.nodes[1:-1])[1])
    far = xp.maximum(plant.case.run.duration, 0.0) + 1.0  # beyond any prediction that matters
    events = xp.clip(events, -period, far + 1000 * period)
    cells, number = edges.shape[0] - 1, xp.floor(events / period)
    within = xp.clip(searchsorted(edges, events - number * period) - 1, 0, cells - 1)
    index = (number * cells + within).astype(int)
    cell_starts, cell_ends = (number * period + take(edges, within + i) for i in (0, 1))
    if not index.shape[0]:
        return Preview(plant, period, delay, edges, responses, index, xp.zeros((0, 1, 1)))
    follows = xp.concatenate([xp.zeros(1, bool), index[1:] == index[:-1]])
    leads = xp.concatenate([index[1:] == index[:-1], xp.zeros(1, bool)])
    before_starts = xp.where(follows, xp.concatenate([events[:1], events[:-1]]), cell_starts)
    after_ends = xp.where(leads, events, cell_ends)
    size = constant_plant.A.shape[0]

    def advance(total, part):
        continues, *pieces = part
        total = xp.where(continues, total, xp.eye(size, total.shape[1]))
        for one in pieces:
            total = one[:, :size] @ total + xp.pad(one[:, size:], ((0, 0), (size, 0)))
        return total, total

    pieces = [map_elements(piece, ends) for ends in ((before_starts, events), (events, after_ends))]
    start = xp.eye(size, size + constant_plant.B.shape[1])
    _, maps = scan(advance, start, (follows, *pieces))
    return Preview(plant, period, delay, edges, responses, index, maps)


def _cell_count(plant: Plant, period: Float[Array, ""]) -> int:
    """Cells of a period (s), or of each of its two parts."""
    rates = plant.modal_model.modes.angular_frequencies
    if any_jax(plant, period):
        return CELLS
    if plant.vehicle_states:
        rates = np.append(rates, np.abs(np.linalg.eigvals(vehicle_system(plant.loads)[0])))
    return min(CELLS, math.ceil(period * np.max(rates) / MAX_PHASE_PER_CELL))


def cell_maps(
    plant: ConstantPlant, response: StageResponse, coupling, explicit: bool
) -> Float[Array, "cell all all_and_command"]:
    """Maps over cells of one length from the coupling (cell, node) at their nodes.

    Commands are held; forces are `explicit` if they depend on constant states only.
    """
    states, inputs = plant.B.shape
    free = states + NODE_COUNT * inputs
    force, distribution = node_forces(plant, response, coupling, explicit)
    to_end = response.state_at_end[:, free:].reshape(states, NODE_COUNT, -1)
    to_end = xp.einsum("sqd,qdfi->isqf", to_end, distribution).reshape(len(force), states, -1)
    end = response.state_at_end[:, :free] + to_end @ force
    held = end[..., states:].reshape(*end.shape[:2], NODE_COUNT, inputs)
    return xp.concatenate([end[..., :states], xp.sum(held, axis=2)], axis=2)


def _response(plant: ConstantPlant, length: Float[Array, ""]) -> StageResponse:
    """Response of the constant part over a length (s), without cost."""
    states = plant.A.shape[0]
    all_lengths = stage_responses(plant, xp.zeros((states, states)), length, MAX_HALVINGS)
    return jax.tree.map(lambda part: part[0], all_lengths)
