"""Predictions over a horizon, with a preview of the loads to come.

Everywhere  x(k+1) = A_k x(k) + B_k u(k) + E_k W + w,  y(k) = C x(k),  with commands u held over a
period, weights W of the loads, and w the unexplained change of the state, assumed to persist. Moves
are the changes of the commands, u(k+i) = u(k-1) + du(k) + ... + du(k+i).

The plant is that of `crossing_plant`: constant, coupled to forces that vary in time. A period is
divided into cells, in which the constant part is propagated exactly and the forces are polynomials
through Gauss nodes (`coupled_stages`), as in the integration of runs. Samples are multiples of the
period, so that a load event, at which forces have a kink, always divides the same cell: the maps of
such cells are computed once.

What predictive control assumes after its horizon: a cost, and a set of states.

Dual-mode control (Rawlings, Mayne and Diehl, Model Predictive Control, 2nd edition, 2017, section
2.4): from the end of the horizon on a regulator of given cost acts, from a set of states in which
it keeps all limits for ever. The set is the maximal output-admissible one (Gilbert and Tan, IEEE
Trans. Automatic Control 36, 1991): the rows E of the limits, of the next periods,

    E Phi^j z <= 1,  j = 0 ... T - 1,  Phi the closed loop,

of which those of all later periods follow if those of period T do.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.control.crossing_gains import crossing_plant
from jaxbeam.control.estimation.sampled_plant import step_count
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.finite_horizon import MAX_HALVINGS
from jaxbeam.numerics.riccati import dare, dlqr
from jaxbeam.numerics.stages import (
    GAUSS_NODES,
    NODE_COUNT,
    ConstantPlant,
    StageResponse,
    c2d,
    node_forces,
    stage_responses,
)
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    map_elements,
    scan,
    searchsorted,
    take,
    xp,
)


class SampledPlant(NamedTuple):
    """Discrete-time plant of a period, or of several along a first axis; see the module.

    With a delay the previous commands are further states.
    """

    A: Float[Array, "*period state state"]
    B: Float[Array, "*period state actuator"]
    E: Float[Array, "*period state load"]


class Prediction(NamedTuple):
    """Future outputs Y = F initial + Phi variables, eq. (7.4), and the end of the horizon.

    `initial` are the initial conditions (x(k), w, u(k-1), 1), with a column of F for each; that of
    1 is the response to the loads. `end` and `end_phi` give x(k+N-1), x(k+N) and u(k+N-1), N the
    horizon. Of one sample, or of several along a first axis.
    """

    F: Float[Array, "*sample horizon output initial"]
    Phi: Float[Array, "*sample horizon output variable"]
    end: Float[Array, "*sample end initial"]
    end_phi: Float[Array, "*sample end variable"]

    def under(self, load_weights: Float[Array, " load"]) -> "Prediction":
        """Prediction under weights (N) from one whose last initial conditions are those weights."""

        def combined(columns):
            own = columns.shape[-1] - load_weights.shape[0]
            of_loads = columns[..., own:] @ load_weights
            return xp.concatenate([columns[..., :own], of_loads[..., None]], axis=-1)

        return self._replace(F=combined(self.F), end=combined(self.end))


def sampled_plant(
    A: Float[Array, "state state"],
    B: Float[Array, "state actuator"],
    B_f: Float[Array, "state load"],
    period: Float[Array, ""],
    delay: Float[Array, ""] | None = None,
) -> SampledPlant:
    """Discrete-time plant of z' = A z + B u + B_f W over a period (s) with held inputs; exact.

    With a `delay` (s), at most the period, commands begin that much later.
    """
    actuators, loads = B.shape[1], B_f.shape[1]
    transition, input_matrix = c2d(A, xp.concatenate([B, B_f], axis=1), period)
    input_matrix, load_matrix = input_matrix[0, :, :actuators], input_matrix[0, :, actuators:]
    if delay is None:
        return SampledPlant(transition, input_matrix, load_matrix)
    late_input_matrix = c2d(A, B, period - delay)[1][0]
    no_state = xp.zeros((actuators, transition.shape[0]))
    return SampledPlant(
        A=xp.block(
            [
                [transition, input_matrix - late_input_matrix],
                [no_state, xp.zeros((actuators, actuators))],
            ]
        ),
        B=xp.concatenate([late_input_matrix, xp.eye(actuators)]),
        E=xp.concatenate([load_matrix, xp.zeros((actuators, loads))]),
    )


def incremental_model(
    A: Float[Array, "state state"],
    B: Float[Array, "state actuator"],
    C: Float[Array, "output state"],
) -> tuple[
    Float[Array, "augmented augmented"],
    Float[Array, "augmented actuator"],
    Float[Array, "output augmented"],
]:
    """A, B and C of eq. (7.1): the plant in the states (x(k) - x(k-1), y(k)), driven by moves."""
    states, outputs = A.shape[0], C.shape[0]
    transition = xp.block([[A, xp.zeros((states, outputs))], [C @ A, xp.eye(outputs)]])
    output_rows = xp.concatenate([xp.zeros((outputs, states)), xp.eye(outputs)], axis=1)
    return transition, xp.concatenate([B, C @ B]), output_rows


def move_basis(
    horizon: int, terms: int, pole: Float[Array, ""] | None = None
) -> Float[Array, "horizon term"]:
    """Basis of move sequences: unit moves in the first periods, or Laguerre functions.

    With a `pole` a (0 to 1) these are the orthonormal Laguerre functions in discrete time, of which
    a few span a long horizon (Wang, J. Process Control 14, 2004); at a = 0 they are unit moves.
    """
    if pole is None:
        return xp.eye(horizon, terms)
    pole_complement = 1 - pole**2
    first = xp.sqrt(pole_complement) * xp.cumprod(
        xp.concatenate([xp.ones(1), xp.full(terms - 1, -pole)])
    )
    column = xp.concatenate(
        [pole[None], pole_complement * first[: terms - 1] / xp.sqrt(pole_complement)]
    )
    step = xp.array(
        [[column[i - j] if i >= j else 0.0 for j in range(terms)] for i in range(terms)]
    )
    _, sequences = scan(lambda values, _: (step @ values, values), first, length=horizon)
    return sequences


def move_maps(basis: Float[Array, "horizon term"], actuators: int) -> Float[Array, "..."]:
    """Moves (horizon, actuator, variable) per variable, one for each basis term and actuator."""
    terms = basis[:, None, :, None] * np.eye(actuators)[:, None]
    return terms.reshape(basis.shape[0], actuators, -1)


def predict(
    plants: SampledPlant,
    C: Float[Array, "output state"],
    move_maps: Float[Array, "horizon actuator variable"],
    load_weights: Float[Array, "load *constant"],
) -> Prediction:
    """F and Phi of a plant given over each period of the horizon, eqs (7.5) and (7.10).

    `move_maps` map the variables to moves; `load_weights` are in N. For a time-invariant plant F
    initial equals F (x(k) - x(k-1), y(k)) of the thesis. Plants (horizon, sample) give predictions
    at several samples. With a matrix of `load_weights` further initial conditions take the place of
    the last, 1: the weights are the matrix times these.
    """
    states, actuators = plants.B.shape[-2:]
    if load_weights.ndim == 1:
        load_weights = load_weights[:, None]
    initial_count = 2 * states + actuators + load_weights.shape[1]
    columns = initial_count + move_maps.shape[2]
    previous_command = xp.eye(actuators, columns, k=2 * states)
    commands = previous_command + xp.pad(
        xp.cumsum(move_maps, axis=0), ((0, 0), (0, 0), (initial_count, 0))
    )
    unexplained = xp.eye(states, columns, k=states)

    samples = plants.A.shape[1:-2]
    others = [*[(0, 0)] * (len(samples) + 1), (2 * states + actuators, move_maps.shape[2])]

    def advance(state, period):
        plant, command = period
        of_loads = xp.pad(plant.E @ load_weights, others)
        next_state = plant.A @ state + plant.B @ command + unexplained + of_loads
        return next_state, next_state

    initial_state = xp.broadcast_to(xp.eye(states, columns), (*samples, states, columns))
    _, trajectory = scan(advance, initial_state, (plants, commands))
    outputs = C @ trajectory
    trajectory = xp.concatenate([initial_state[None], trajectory])
    last_command = xp.broadcast_to(commands[-1], (*samples, actuators, columns))
    end = xp.concatenate([trajectory[-2], trajectory[-1], last_command], axis=-2)
    outputs = xp.moveaxis(outputs, 0, -3)
    return Prediction(
        outputs[..., :initial_count],
        outputs[..., initial_count:],
        end[..., :initial_count],
        end[..., initial_count:],
    )


def repeat_plant(plant: SampledPlant, periods: int) -> SampledPlant:
    """The same plant over several periods."""
    return jax.tree.map(lambda part: xp.broadcast_to(part, (periods, *part.shape)), plant)


class Preview(Module):
    """Plant under its loads, with the parts of its discrete-time maps that all samples have.

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
        """Discrete-time plants of `count` periods, from `first` periods after the sample at t (s).

        Their load inputs are the constants of `Plant.augmented`.
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
        """Discrete-time plants of periods from the maps of their cells."""
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
    explicit, per_part = plant.loads.massless, step_count(plant, period)
    fractions = np.arange(per_part) / per_part
    marks = [xp.zeros(()), *([] if delay is None else [delay]), period]
    parts = list(zip(marks[:-1], marks[1:], strict=True))
    edges = [start + (end - start) * fractions for start, end in parts]
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
    """Stage response of the plant without loads over a length (s), without cost."""
    states = plant.A.shape[0]
    all_lengths = stage_responses(plant, xp.zeros((states, states)), length, MAX_HALVINGS)
    return jax.tree.map(lambda part: part[0], all_lengths)


LP_ROUNDING = 1e-7  # of limits, within which a linear program counts a row as implied
UNSEEN = 1e-12  # of the largest cost of a mode: less is rounding, as costs fall with frequency
MAX_PERIODS = 2000  # of a terminal set that is searched for

Square = Float[Array, "state state"]
Rows = Float[Array, "row state"]


class Terminal(NamedTuple):
    """Cost z'P z of the end of the horizon, z = `map` (x(k+N-1), x(k+N), u(k+N-1)), and its limits.

    These are `rows` z <= 1. With a `weight` (m^2) they are soft: the greatest excess e costs weight
    (e + e^2), which is none where the limits can be kept, if the weight is large enough.
    """

    map: Float[Array, "terminal end"]
    cost: Float[Array, "terminal terminal"]
    rows: Float[Array, "row terminal"]
    weight: Float[Array, ""] | None


class TerminalRegulator(NamedTuple):
    """Regulator of the unloaded plant after the horizon: z+ = `loop` z, moves du = -`gain` z.

    The states z are those of the plant without those of a delay, then the commands of the last
    period; `cost` is P, and `limits` z <= 1 are the limits of the next period.
    """

    loop: Square
    gain: Float[Array, "actuator state"]
    cost: Square
    limits: Rows

    def rows(self, periods: int) -> Rows:
        """Rows of the set in which the limits are kept over a number of periods."""

        def advance(rows, _):
            return rows @ self.loop, rows

        _, rows = scan(advance, self.limits, None, length=periods)
        return rows.reshape(-1, self.loop.shape[0])


def terminal_regulator(
    sampled: SampledPlant,
    delayed: bool,
    C: Float[Array, "output state"],
    output_weight: Float[Array, " output"],
    move_weight: Float[Array, " actuator"],
    actuators: Sequence[Any],
    period: Float[Array, ""],
    hard_limit: Float[Array, " *output"] | None,
) -> TerminalRegulator:
    """Regulator that minimises the sum of weight y^2 + move_weight du^2 of an unloaded plant.

    `sampled` is the plant, with the last commands as further states if `delayed`; `C` are rows of
    its controlled deflections y. Limits, rate limits and `hard_limit` (m) must permit zero.
    """
    count, states = sampled.B.shape[1], sampled.A.shape[0]
    A, B, outputs = sampled.A, sampled.B, C
    if not delayed:
        A = xp.pad(A, ((0, count), (0, count)))
        B = xp.concatenate([B, xp.eye(count)])
        outputs = xp.pad(C, ((0, 0), (0, count)))
        states += count
    last_command = xp.eye(count, states, k=states - count)
    A = A + B @ last_command
    Q = outputs.T @ (output_weight[:, None] * outputs)
    gain, cost = dlqr(A, B, Q, xp.diag(move_weight))
    loop = A - B @ gain
    next_command, rows = last_command - gain, [xp.zeros((0, states))]
    for i, actuator in enumerate(actuators):
        limits, rate = actuator.command_limits(), actuator.command_rate_limit()
        if limits is not None:
            rows += [next_command[i : i + 1] / limits[1], next_command[i : i + 1] / limits[0]]
        if rate is not None:
            rows += [sign * gain[i : i + 1] / (rate * period) for sign in (1.0, -1.0)]
    if hard_limit is not None:
        within = outputs @ loop / xp.broadcast_to(hard_limit, (C.shape[0],))[:, None]
        rows += [within, -within]
    return TerminalRegulator(loop, gain, cost, xp.concatenate(rows))


def limits_error(actuators: Sequence[Any]) -> str | None:
    """Error of actuators whose limits leave no room about zero, as "terminal must ...", or None."""
    for i, actuator in enumerate(actuators):
        limits = actuator.command_limits()
        if limits is None or actuator.command_unit == "1" or not is_concrete(limits):
            continue
        low, high = concrete(limits)
        if not low < 0 < high:
            return (
                "terminal must be 'none': the regulator brings commands to zero, and the limits of"
                f" actuators.{i} are {low:g} and {high:g}"
            )
    return None


def periods_needed(regulator: TerminalRegulator, at_least: int = 1) -> int | None:
    """Number of periods whose limits imply those of all later periods; None if too many.

    `at_least` so many. By linear programs; numbers must be concrete.
    """

    def enough(periods):
        rows = concrete(regulator.rows(periods + 1))
        count = regulator.limits.shape[0]
        return _implied(rows[:-count], rows[-count:])

    low, high = at_least - 1, at_least
    while not enough(high):
        if high >= MAX_PERIODS:
            return None
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _implied(rows: Float[np.ndarray, "row state"], further: Float[np.ndarray, "new state"]) -> bool:
    """Whether `rows` z <= 1 imply `further` z <= 1."""
    from scipy.optimize import linprog  # late: it takes longer to import than most designs

    scale = np.max(np.abs(rows), axis=0, initial=0.0)
    scale = np.where(scale > 0, scale, 1.0)
    for row in further:
        best = linprog(-row / scale, rows / scale, np.ones(len(rows)), bounds=(None, None))
        if best.status != 0 or -best.fun > 1 + LP_ROUNDING:
            return False
    return True


def dual_mode_terminal(
    regulator: TerminalRegulator,
    periods: int,
    weight: Float[Array, ""] | None,
    states: int,
) -> Terminal:
    """Terminal cost and set of a regulator, for a prediction with a number of `states`.

    The first of them are those of the plant, the others, of vehicles and of a delay, are left out.
    The `weight` of a soft set is relative to the `limit_cost`.
    """
    size, count = regulator.loop.shape[0], regulator.gain.shape[0]
    plant = xp.eye(size - count, 2 * states + count, k=states)
    command = xp.eye(count, 2 * states + count, k=2 * states)
    end_map = xp.concatenate([plant, command])
    weight = None if weight is None else weight * limit_cost(regulator)
    return Terminal(end_map, regulator.cost, regulator.rows(periods), weight)


def unseen_modes(regulator: TerminalRegulator, modes: int) -> Int[np.ndarray, " mode"]:
    """Numbers, from 1, of the modes whose coordinates have no cost; numbers must be concrete.

    By them the cost of a limit has no scale (`limit_cost`). Coordinates are the first states.
    """
    costs = np.diag(concrete(regulator.cost))[:modes]
    return 1 + np.flatnonzero(costs <= UNSEEN * costs.max())


def limit_cost(regulator: TerminalRegulator) -> Float[Array, ""]:
    """Least cost z'P z (m^2) of a state from which the regulator meets a limit; 1 without limits.

    On a row l z = 1 it is 1 / (l P^-1 l').
    """
    if not regulator.limits.shape[0]:
        return xp.ones(())
    spread = xp.linalg.solve(regulator.cost, regulator.limits.T)
    return 1 / xp.max(xp.sum(regulator.limits.T * spread, axis=0))


def incremental_terminal(
    sampled: SampledPlant,
    C: Float[Array, "output state"],
    output_weight: Float[Array, " output"],
    move_weight: Float[Array, " actuator"],
    beam: int,
    vehicles: int,
) -> Terminal:
    """Terminal cost of the incremental model, eq. (7.31), whose last change of state persists.

    A prediction has the states of `vehicles` after `beam` ones; they have no cost of their own.
    """
    A, B, output_rows = incremental_model(sampled.A, sampled.B, C)
    P = dare(A, B, output_rows.T @ (output_weight[:, None] * output_rows), xp.diag(move_weight))
    states, count = sampled.B.shape
    own = np.delete(np.eye(states + vehicles), np.s_[beam : beam + vehicles], axis=0)
    none = np.zeros((states, count))
    difference = np.concatenate([-own, own, none], axis=1)
    deflections = xp.pad(C @ own, ((0, 0), (states + vehicles, count)))
    end_map = xp.concatenate([difference, deflections])
    return Terminal(end_map, P, xp.zeros((0, end_map.shape[0])), None)
