"""Vehicles on the beam: exact response of their states to the surface, and their steps.

Within a step, the forces q = k y + c y' that the surface exerts on the springs of the wheels are
polynomials through their values at the Gauss nodes, as the contact forces are. The states of a
vehicle follow exactly (`propagators`), and the springs press on the surface at the nodes with

    s = S q - O z_v

where z_v are its states at the start of the step. With the motion of the beam
y = R z + G f + D u under the wheels, the contact law

    f = -W - m y'' - s

is solved for f as an affine function of the states z of the beam and z_v of the vehicles, and of
the commands u; the states of the vehicles at the end of the step follow. The maps of all steps are
found at once, before the states are computed.
"""

import math

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.model.load_set import LoadSet, VehicleGroup
from jaxbeam.numerics.polynomials import lagrange_coefficients
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    add_at,
    cond,
    is_jax,
    map_elements,
    set_at,
    solve_conditioned,
    stop_gradient,
    take,
    with_blocks,
    xp,
)
from jaxbeam.simulation.integrator.discrete_model import (
    GAUSS_NODES,
    NODE_COUNT,
    PEAK_NODES,
    force_weights,
    phi_functions_of,
)
from jaxbeam.simulation.integrator.load_path import LoadPath
from jaxbeam.simulation.integrator.step_matrices import StepMatrices


class VehiclePropagators(Module):
    """Matrices of the vehicles of one load over steps of some lengths.

    `transition` and `input` map states and q at the nodes to the states at the end;
    `spring_states` is O and `spring_surface` is S. Rows are (wheel, node).
    """

    transition: Float[Array, "*length state state batch"]
    input: Float[Array, "*length state row batch"]
    spring_states: Float[Array, "*length row state batch"]
    spring_surface: Float[Array, "*length row row batch"]


def vehicle_state_norm(loads: LoadSet) -> Float[Array, ""]:
    """Largest norm of the scaled state matrices of the vehicles, in 1/s; zero without any."""
    norms = [
        xp.max(xp.sum(xp.abs(_scaled_systems(group)[0]), axis=1)) for group in loads.wheels.vehicles
    ]
    return stop_gradient(xp.max(xp.stack(norms))) if norms else xp.zeros(())


def _scaled_systems(group: VehicleGroup):
    """State, input and output matrices with displacements scaled to the size of rates; scales."""
    dofs = group.A.shape[0] // 2
    frequency = xp.sqrt(1.0 + xp.max(xp.sum(xp.abs(group.A[dofs:, :dofs]), axis=1), axis=0))
    shape = (dofs, *frequency.shape)
    scale = stop_gradient(xp.concatenate([xp.broadcast_to(frequency, shape), np.ones(shape)]))
    return group.A * scale[:, None] / scale, group.B * scale[:, None], group.H / scale, scale


@jax.named_scope("vehicles")
def vehicle_propagators(
    group: VehicleGroup, lengths: Float[Array, " length"]
) -> VehiclePropagators:
    """Propagators of the vehicles of a load over steps of the given lengths (s)."""
    if not is_jax(lengths):
        return _propagators(group, lengths)

    def of_length(length):
        """Propagators over a step; to first order if it is empty, as most of a program are."""
        parts = cond(
            length > 0, lambda t: _propagators(group, t), lambda t: _at_once(group, t), length[None]
        )
        return jax.tree.map(lambda part: part[0], parts)

    return map_elements(of_length, lengths)


def _at_once(group: VehicleGroup, lengths: Float[Array, " length"]) -> VehiclePropagators:
    """Propagators over steps of zero length (s), to first order, for derivatives by event times."""
    A, B, H = (xp.asarray(part, lengths.dtype) for part in (group.A, group.B, group.H))
    states, wheels, batch_size = B.shape
    rows = wheels * NODE_COUNT
    fractions = np.append(GAUSS_NODES, 1.0)
    # Integrals of the polynomials of the nodes, up to each fraction of a step.
    divisors = [math.factorial(power) for power in range(1, NODE_COUNT + 1)]
    integrals = fractions[:, None] * (force_weights() / divisors).sum(axis=-1)
    to_end = xp.einsum("f,swb->swfb", integrals[-1], B)
    speeds = xp.einsum("c,wsb,stb->wctb", GAUSS_NODES, H, A)
    response = xp.einsum("cf,wsb,svb->wcvfb", integrals[:NODE_COUNT], H, B)

    def first_order(start, slope, columns):
        shape = -1, columns, batch_size
        start, slope = xp.asarray(start, lengths.dtype), slope.reshape(shape)
        return xp.broadcast_to(start, slope.shape) + lengths[:, None, None, None] * slope

    return VehiclePropagators(
        first_order(np.eye(states)[..., None], A, states),
        first_order(xp.zeros((states, rows, 1)), to_end, rows),
        first_order(xp.repeat(H, NODE_COUNT, axis=0), speeds, states),
        first_order(np.eye(rows)[..., None], -response, rows),
    )


def _propagators(group: VehicleGroup, lengths: Float[Array, " length"]) -> VehiclePropagators:
    A, B, H, scale = _scaled_systems(group)
    durations = lengths[:, None] * np.append(GAUSS_NODES, 1.0)
    transition, phi_functions = phi_functions_of(A, B, durations, few_doublings=True)
    inputs = xp.einsum("cfp,pswblc->lcfswb", force_weights(), phi_functions)
    transition = xp.einsum("stblc->lcstb", transition)
    nodes = slice(0, NODE_COUNT)
    spring_states = xp.einsum("wsb,lcstb->lwctb", H, transition[:, nodes]) * scale
    response = xp.einsum("wsb,lcfsvb->lwcvfb", H, inputs[:, nodes])
    to_end = xp.einsum("lfswb->lswfb", inputs[:, -1])
    count, rows, states, batch_size = lengths.shape[0], H.shape[0] * NODE_COUNT, *scale.shape
    return VehiclePropagators(
        transition=transition[:, -1] / scale[:, None] * scale,
        input=to_end.reshape(count, states, rows, batch_size) / scale[:, None],
        spring_states=spring_states.reshape(count, rows, states, batch_size),
        spring_surface=np.eye(rows)[..., None] - response.reshape(count, rows, rows, batch_size),
    )


class VehicleStep(Module):
    """Wheels of vehicles in each step of a chunk, and the surface under them.

    `length_index` is that of the step's length; `wheels` are the indices of the wheels of the rows,
    and whether they are `on_beam`; `surface` is the motion of the profile under all wheels (see
    `LoadPath`), `motion` that of the surface under prescribed forces at the rows, None without any.
    """

    length_index: Int[Array, " *step"]
    wheels: Int[Array, "*step wheel"]
    on_beam: Bool[Array, "*step wheel"]
    surface: Float[Array, "*step 3 all node"] | None
    motion: Float[Array, "*step 2 row batch"] | None = None


class StepInput(Module):
    """Inputs of the steps of a batch: matrices, and inertia (kg) and weight (N) of the rows.

    The weight includes the inertia forces of profile and prescribed forces. Without vehicles,
    `vehicles` is None.
    """

    matrices: StepMatrices
    inertia: Float[Array, "*step row batch"]
    weight: Float[Array, "*step row batch"]
    vehicles: VehicleStep | None


class Vehicles(Module):
    """Loads with vehicles, and the propagators of the vehicles of each for all step lengths."""

    loads: LoadSet
    propagators: tuple[VehiclePropagators, ...]


def vehicles_of(loads: LoadSet, lengths: Float[Array, " length"]) -> Vehicles | None:
    """Vehicles of the loads for steps of the given lengths (s); None without any."""
    groups = loads.wheels.vehicles
    if not groups:
        return None
    return Vehicles(loads, tuple(vehicle_propagators(group, lengths) for group in groups))


def vehicle_maps(vehicles: Vehicles, step: StepInput):
    """Affine maps to the solved forces (linear part, offset), and to the states of the vehicles.

    All are (step, batch, row, column); columns are states of the beam, of the vehicles, and
    commands. The map to the states is a pair of linear part and offset.
    """
    matrices, loads, wheels = step.matrices, vehicles.loads, vehicles.loads.wheels
    steps, batch = step.inertia.shape[0], step.inertia.shape[-1]
    rows = matrices.contact_response.shape[1]
    inertia, weight = (
        xp.swapaxes(part[:, :rows], 1, 2)[..., None] for part in (step.inertia, step.weight)
    )
    at_rows = (take(part, step.vehicles.wheels) for part in (wheels.stiffness, wheels.damping))
    stiffness, damping = (
        xp.swapaxes(xp.repeat(part, NODE_COUNT, axis=1), 1, 2)[..., None] for part in at_rows
    )

    def on_springs(parts):
        return stiffness * parts[:, 0, None] + damping * parts[:, 1, None]

    springs, commands = matrices.springs, matrices.commands
    no_vehicles = np.zeros((steps, batch, rows, loads.vehicle_states))
    surface = [on_springs(springs.response), no_vehicles]
    by_commands = no_vehicles[..., :0]
    if commands is not None:
        surface.append(on_springs(springs.commands))
        by_commands = inertia * commands.contact_response[:, None]
    coupling, by_states, by_profile = springs_of_wheels(vehicles, step.vehicles, batch)
    prescribed = xp.zeros((steps, batch, rows, 1))
    if step.vehicles.motion is not None:
        moved = xp.moveaxis(step.vehicles.motion, 3, 1)[..., None]  # step, batch, motion, row, 1
        prescribed = stiffness * moved[:, :, 0] + damping * moved[:, :, 1]
    surface = xp.concatenate([*surface, prescribed], axis=-1)
    by_beam = inertia * matrices.contact_response[:, None]
    right = xp.concatenate([by_beam, -by_states, by_commands, weight + by_profile], axis=-1)
    right = right + coupling @ surface
    impedance = on_springs(springs.compliance)
    system = np.eye(rows) + inertia * matrices.contact_compliance[:, None]
    forces = -solve_conditioned(system + coupling @ impedance, right)
    of_vehicles = _state_maps(vehicles, step, surface + impedance @ forces)
    of_vehicles = of_vehicles[..., :-1], of_vehicles[..., -1:]
    return forces[..., :-1], forces[..., -1:], of_vehicles


def springs_of_wheels(vehicles: Vehicles, step: VehicleStep, batch: int):
    """Matrices S and O at the rows of the steps, and S q of the profile (step, batch, row, ...)."""
    loads, length, (index, count) = vehicles.loads, step.length_index, _sprung(vehicles.loads)
    on_beam = xp.repeat(step.on_beam, NODE_COUNT, axis=1)[:, None, :, None]
    profile, wheels = _profile(vehicles, step, batch), take(index, step.wheels)
    rows = (wheels[..., None] * NODE_COUNT + np.arange(NODE_COUNT)).reshape(len(wheels), -1)
    all_rows = (count + 1) * NODE_COUNT
    shape = len(length), profile.shape[1], all_rows
    coupling_blocks, state_blocks, first = [], [], 0
    for group, part in zip(loads.wheels.vehicles, vehicles.propagators, strict=True):
        of_surface, of_states = (
            xp.moveaxis(take(matrix, length), -1, 1)
            for matrix in (part.spring_surface, part.spring_states)
        )
        states = of_states.shape[-1]
        for i in range(group.count):
            own = _rows_of(group, i, index)
            coupling_blocks.append((np.s_[..., own, own], of_surface))
            state_blocks.append((np.s_[..., own, first : first + states], of_states))
            first += states
    coupling = with_blocks((*shape, all_rows), coupling_blocks)
    by_states = with_blocks((*shape, loads.vehicle_states), state_blocks)
    by_profile = coupling @ profile
    of_steps, of_batch = np.ogrid[: shape[0], : shape[1]]
    index = of_steps[..., None], of_batch[..., None], rows[:, None]
    pairs = (
        *(part[..., None] for part in index[:2]),
        rows[:, None, :, None],
        rows[:, None, None],
    )
    return (
        take(coupling, pairs) * on_beam,
        take(by_states, index) * on_beam,
        take(by_profile, index) * on_beam,
    )


def _profile(vehicles: Vehicles, step: VehicleStep, batch: int) -> Float[Array, "step batch row 1"]:
    """Spring forces q = k y + c y' (N) of the profile at the rows of `_sprung` wheels."""
    wheels, sprung = vehicles.loads.wheels, vehicles.loads.on_ground
    shape = len(step.wheels), batch, (int(sprung.sum()) + 1) * NODE_COUNT, 1
    if step.surface is None:
        return xp.zeros(shape)
    height, rate, _ = xp.moveaxis(step.surface[:, :, sprung], 1, 0)[:, :, None]
    springs = wheels.stiffness, wheels.damping
    stiffness, damping = (part[sprung].T[..., None] for part in springs)
    pressed = stiffness * height + damping * rate
    return xp.pad(pressed, [(0, 0), (0, 0), (0, 1), (0, 0)]).reshape(shape)


def _state_maps(vehicles: Vehicles, step: StepInput, surface):
    """Maps of the steps to the states of the vehicles at their ends; the last column is the offset.

    `surface` is the map to q = k y + c y' of the beam at the rows.
    """
    loads, length, (index, count) = (
        vehicles.loads,
        step.vehicles.length_index,
        _sprung(vehicles.loads),
    )
    (steps, batch, _, columns), states = surface.shape, step.matrices.state_count
    parts = surface.reshape(steps, batch, -1, NODE_COUNT, columns)
    parts = parts * step.vehicles.on_beam[:, None, :, None, None]
    step_index, batch_index = np.ogrid[:steps, :batch]
    by_wheel = set_at(
        np.zeros((steps, batch, count + 1, NODE_COUNT, columns)),
        (step_index[..., None], batch_index[..., None], take(index, step.vehicles.wheels)[:, None]),
        parts,
    )
    by_row = by_wheel.reshape(steps, batch, -1, columns)
    if step.vehicles.surface is not None:
        by_row = add_at(by_row, np.s_[..., -1:], _profile(vehicles, step.vehicles, batch))
    maps, first = [], states
    for group, part in zip(loads.wheels.vehicles, vehicles.propagators, strict=True):
        transition, to_end = (
            xp.moveaxis(take(matrix, length), -1, 1) for matrix in (part.transition, part.input)
        )
        for i in range(group.count):
            own = slice(first, first + transition.shape[-1])
            next_state = to_end @ by_row[..., _rows_of(group, i, index), :]
            maps.append(add_at(next_state, np.s_[..., own], transition))
            first = own.stop
    return xp.concatenate(maps, axis=2)


def _sprung(loads: LoadSet) -> tuple[Int[np.ndarray, " wheel"], int]:
    """Index of each wheel among those with springs, and their number: the index of all others.

    Of rows of the former there is one wheel more, whose are zero or without meaning.
    """
    sprung = loads.on_ground
    count = int(sprung.sum())
    return np.where(sprung, np.cumsum(sprung) - 1, count), count


def _rows_of(group: VehicleGroup, vehicle: int, index: Int[np.ndarray, " wheel"]) -> slice:
    """Slice of the rows (wheel, node) of a vehicle of a load among those of wheels with springs."""
    rows = group.wheels_per_vehicle * NODE_COUNT
    start = int(index[group.first_wheel]) * NODE_COUNT + vehicle * rows
    return slice(start, start + rows)


def absorber_weights() -> Float[np.ndarray, "2 sample node"]:
    """Weights of the forces on bodies of absorbers, at the peak nodes of a step of unit length.

    Of the force itself, and of the displacement of a unit mass that is at zero at both ends.
    """
    powers = np.arange(NODE_COUNT)
    c = np.array(PEAK_NODES)[:, None]
    twice = (c ** (powers + 2) - c) / ((powers + 1) * (powers + 2))
    return np.stack([c**powers, twice]) @ lagrange_coefficients(NODE_COUNT).T


def absorber_samples(
    loads: LoadSet,
    path: LoadPath,
    count: int,
    before: Float[Array, "step vehicle_state batch"],
    after: Float[Array, "step vehicle_state batch"],
    forces: Float[Array, "step row batch"],
    samples: Float[Array, "step sample output batch"],
) -> Float[Array, "step sample output batch"]:
    """Samples of outputs with strokes (m), then forces (N), of the last `count` wheels.

    In the place of these, samples have the deflections at the absorbers, twice. `before` and
    `after` are the states of all vehicles at the ends of each step. Heights of the body in a step
    are a line through those at its ends, and the double integral of F / m_t, with the force F that
    accelerates its inertia m_t (see `jaxbeam.case.absorbers`). What hangs on the beam has no
    profile under it.
    """
    wheels, weights = loads.wheels, absorber_weights()
    body = 1 / xp.stack([group.B[1, 0] for group in wheels.vehicles[-count:]])
    inertia = body + wheels.inertia[-count:]
    fraction = body / inertia
    index = loads.wheel_count - count + np.arange(count)
    by_row = -forces.reshape(len(forces), -1, 1, NODE_COUNT, forces.shape[-1])
    own = (path.loads[:, :, None] == index) & path.pressing[:, :, None]
    force = xp.sum(xp.where(own[..., None, None], by_row, 0.0), axis=1)  # step, absorber, node
    deflection = samples[:, :, -count:]
    heights = before[:, -2 * count :: 2], after[:, -2 * count :: 2]
    if path.surface is not None:
        at_rest = path.surface[:, 0, index, 0]
        at_rest = at_rest.reshape(*at_rest.shape[:2], -1)
        heights = heights[0] - at_rest, heights[1] - at_rest
    first, last = (
        fraction * z + (1 - fraction) * y
        for z, y in zip(heights, (deflection[:, 0], deflection[:, -1]), strict=True)
    )
    c, length = np.array(PEAK_NODES)[:, None, None], path.length[:, None, None]
    pulled, moved = (xp.einsum("pk,takb->tpab", of, force) for of in weights)
    body_height = (1 - c) * first[:, None] + c * last[:, None]
    stroke = body_height + length[:, None] ** 2 * moved / inertia - deflection
    found = xp.concatenate([samples[:, :, : -2 * count], stroke, pulled], axis=2)
    # Steps of zero length after the end are no part of the run.
    return xp.where(length[:, None] > 0, found, 0.0)
