"""Steps of wheels that press or fly: contact laws, heights of wheels in flight, propagation.

In a step the set of wheels that press is fixed, and the beam is propagated exactly under contact
forces that are polynomials through the Gauss nodes. Heights h of wheels and the states z of the
vehicles above them are one linear system,

    e' = A e + B (F - P),

with the contact forces F (N, positive where a wheel presses) and the static loads P. Of a wheel
of mass m below a spring k and a damper c, m h'' = F - P - s with s = k h + c h' - H z; the massless
lower end of a tyre follows from F - P = s. In flight F = 0. Pressing, with the surface y under it,

    rigid wheel:       F = P + s + m y'',
    tyre:              F = P + k y + c y' - H z,
    spring of contact: F = C d^p, d = d_0 + y - h the compression, P = C d_0^p.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.model.contact import solve_at_instants, surface_rows, vehicle_system
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.numerics.polynomials import lagrange_weights
from jaxbeam.simulation.integrator.discrete_model import (
    GAUSS_NODES,
    NODE_COUNT,
    PEAK_NODES,
    force_weights,
    phi_functions_of,
    propagators,
)
from jaxbeam.simulation.integrator.load_path import END_FRACTIONS

POINTS = np.array(PEAK_NODES)  # of a step: its start, the Gauss nodes, its end
INSIDE = np.array([END_FRACTIONS[0], *GAUSS_NODES, END_FRACTIONS[1]])  # limits within the step
NODES = slice(1, -1)  # the Gauss nodes among the points
AT_POINTS = lagrange_weights(NODE_COUNT, POINTS)
NEWTON_ITERATIONS = 50
NEWTON_TOLERANCE = 1e-13


class ContactLaw(NamedTuple):
    """Numbers of all wheels, and the linear system of heights and vehicles; see the module.

    `rigid` wheels have mass and no spring of contact, `sprung` wheels have both, `tyre` wheels
    stand on a spring of the vehicle; others are given forces. Wheels of absorbers are `held` on the
    beam. A `spring` of contact has a factor and a power, `compressed` is d_0 (m). `height` and
    `force` map e to h and s, `direct` is the compliance 1 / k of a tyre without damper, whose h is
    no state. `height_index` and `rate_index` are the indices of h and h' in e, -1 for none; `scale`
    are the factors that scale e.
    """

    mass: Float[np.ndarray, " wheel"]
    stiffness: Float[np.ndarray, " wheel"]
    damping: Float[np.ndarray, " wheel"]
    rigid: Bool[np.ndarray, " wheel"]
    sprung: Bool[np.ndarray, " wheel"]
    tyre: Bool[np.ndarray, " wheel"]
    held: Bool[np.ndarray, " wheel"]
    spring: tuple[float, float]
    compressed: Float[np.ndarray, " wheel"]
    A: Float[np.ndarray, "e e"]
    B: Float[np.ndarray, "e wheel"]
    height: Float[np.ndarray, "wheel e"]
    force: Float[np.ndarray, "wheel e"]
    direct: Float[np.ndarray, " wheel"]
    height_index: Int[np.ndarray, " wheel"]
    rate_index: Int[np.ndarray, " wheel"]
    scale: Float[np.ndarray, " e"]

    @property
    def contact(self) -> Bool[np.ndarray, " wheel"]:
        """Whether each wheel has a contact law; the others are given forces."""
        return self.rigid | self.sprung | self.tyre

    def norm(self) -> float:
        """Norm of the scaled matrix A (1/s), or the frequency of a wheel on its contact spring."""
        matrix = np.abs(self.A * self.scale[:, None] / self.scale)
        (factor, power), own = self.spring, self.sprung
        stiffness = factor * power * self.compressed[own] ** (power - 1)
        frequency = np.sqrt(np.max(stiffness / self.mass[own], initial=0.0))
        return float(np.max(np.sum(matrix, axis=1), initial=frequency))

    def of_compression(self, compression):
        """Force (N) of a contact spring at a compression (m), and its derivative (N/m)."""
        factor, power = self.spring
        pressed = np.maximum(compression, 0.0)
        return factor * pressed**power, factor * power * pressed ** (power - 1)


def contact_law(loads: LoadSet, spring: tuple[float, float] | None) -> ContactLaw:
    """Contact law of the loads of one run; the contact `spring` is None for rigid wheels."""
    mass, weight = (np.asarray(part)[:, 0] for part in (loads.inertia, loads.weight))
    none = np.zeros((mass.size, 1))
    springs = loads.wheels.stiffness, loads.wheels.damping
    k, c = (np.asarray(none if part is None else part)[:, 0] for part in springs)
    massive = mass > 0
    sprung = massive & ~loads.fixed & (spring is not None)
    tyre = loads.on_ground & ~massive
    A_z, B_z, H = (np.asarray(part) for part in vehicle_system(loads))
    count = states = A_z.shape[0]
    height_index, rate_index = np.full((2, mass.size), -1)
    for wheel in np.flatnonzero(massive | (tyre & (c > 0))):
        height_index[wheel], count = count, count + 1
        if massive[wheel]:
            rate_index[wheel], count = count, count + 1
    A, B, direct = np.zeros((count, count)), np.zeros((count, mass.size)), np.zeros(mass.size)
    height, force = np.zeros((2, mass.size, count))
    A[:states, :states], force[:, :states] = A_z, -H
    for wheel in np.flatnonzero(massive | tyre):
        h, rate = height_index[wheel], rate_index[wheel]
        if h >= 0:
            height[wheel, h] = 1.0
        if massive[wheel]:
            force[wheel, [h, rate]] = k[wheel], c[wheel]
            A[:states, [h, rate]] = np.outer(B_z[:, wheel], [k[wheel], c[wheel]])
            A[h, rate], A[rate], B[rate, wheel] = 1.0, -force[wheel] / mass[wheel], 1 / mass[wheel]
            continue
        A[:states, :states] += np.outer(B_z[:, wheel], H[wheel])
        B[:states, wheel] = B_z[:, wheel]
        if h >= 0:
            A[h, :states], A[h, h], B[h, wheel] = H[wheel] / c[wheel], -k[wheel] / c[wheel], 1.0
            B[h, wheel] /= c[wheel]
        else:
            height[wheel, :states], direct[wheel] = H[wheel] / k[wheel], 1 / k[wheel]
    # Displacements are scaled to the size of rates.
    displacement, first = np.zeros(count, bool), 0
    displacement[height_index[height_index >= 0]] = True
    for group in loads.wheels.vehicles:
        dofs = group.A.shape[0] // 2
        for _ in range(group.count):
            displacement[first : first + dofs] = True
            first += 2 * dofs
    stiffest = np.sum(np.abs(A[np.ix_(~displacement, displacement)]), axis=1)
    scale = np.where(displacement, np.sqrt(1.0 + np.max(stiffest, initial=0.0)), 1.0)
    factor, power = spring or (1.0, 1.0)
    compressed = np.where(sprung, (weight / factor) ** (1 / power), 0.0)
    kinds = massive & ~sprung, sprung, tyre, loads.fixed
    system = A, B, height, force, direct, height_index, rate_index, scale
    return ContactLaw(mass, k, c, *kinds, (factor, power), compressed, *system)


class Instants(NamedTuple):
    """Inputs of the contact law at instants.

    `rows` map states of the beam to y, y' and y'' under the wheels, to which the `profile` adds its
    height, velocity and acceleration. `shape` are mode shapes at the wheels, `weight` the static
    loads P (N).
    """

    rows: Float[np.ndarray, "*time 3 wheel state"]
    profile: Float[np.ndarray, "*time 3 wheel"]
    shape: Float[np.ndarray, "*time wheel mode"]
    weight: Float[np.ndarray, "*time wheel"]
    on_beam: Bool[np.ndarray, "*time wheel"]

    def motion(
        self, states: Float[np.ndarray, "*time state"]
    ) -> Float[np.ndarray, "*time 3 wheel"]:
        """Height, velocity and acceleration of the surface, contact forces left out."""
        moved = (self.rows @ states[..., None, :, None])[..., 0]
        return moved + self.profile

    def forces(
        self,
        law: ContactLaw,
        pressing: Bool[np.ndarray, "*time wheel"],
        states: Float[np.ndarray, "*time state"],
        e: Float[np.ndarray, "*time e"],
    ) -> Float[np.ndarray, "*time wheel"]:
        """Contact forces (N) of all wheels by their laws; zero for wheels in flight."""
        y, rate, acceleration = np.moveaxis(self.motion(states), -2, 0)
        s = e @ law.force.T
        force = np.where(law.contact, 0.0, self.weight * self.on_beam)
        on_tyre = self.weight + law.stiffness * y + law.damping * rate + s
        force = np.where(law.tyre & pressing, on_tyre, force)
        on_spring = law.of_compression(law.compressed + y - e @ law.height.T)[0]
        force = np.where(law.sprung & pressing, on_spring, force)
        rigid = law.rigid & pressing
        if not rigid.any():
            return force
        # Forces on the beam change the acceleration under rigid wheels at once.
        coupling = self.shape @ np.swapaxes(self.shape, -1, -2)
        mass = np.where(rigid, law.mass, 0.0)
        by_others = (coupling @ force[..., None])[..., 0]
        right = np.where(rigid, self.weight + s + mass * (acceleration - by_others), 0.0)
        matrix = np.eye(mass.shape[-1]) + mass[..., None] * coupling * rigid[..., None, :]
        found = np.asarray(solve_at_instants(matrix[..., None], right[..., None]))[..., 0]
        return np.where(rigid, found, force)


def instants(model: ModalModel, loads: LoadSet, times, on_beam) -> Instants:
    """Inputs of the contact law at times (s) of any shape; `on_beam` (*time, wheel)."""
    position, speed, acceleration = (
        np.moveaxis(np.asarray(part), 0, -1) for part in loads.kinematics(times)
    )
    motion = position, speed, acceleration, on_beam
    rows = surface_rows(model, *motion, True, eccentricity=loads.eccentricity)
    parts = (rows.deflection, rows.velocity, rows.acceleration)
    shape = (*position.shape, -1)
    stacked = np.stack([np.asarray(part).reshape(shape) for part in parts], axis=-3)
    profile = np.zeros(stacked.shape[:-1])
    surface = loads.surface_motion(position, speed, acceleration)
    if surface is not None:
        profile = np.stack([np.asarray(part) for part in surface], axis=-2)
    weight = np.asarray(loads.varying_weight(times))[..., 0]
    return Instants(stacked, profile, np.asarray(rows.shape).reshape(shape), weight, on_beam)


class Steps(NamedTuple):
    """Matrices of steps without load events inside, prepared together.

    `at` are the inputs of the contact law at the points of the steps. States at the points are
    `transition` times the state at the start plus `forced` times the contact forces (wheel, node);
    e at the points is `of_e` times e at the start plus `by_excess` times F plus `at_rest`, the
    response to -P. The contact law at the nodes is F (or the compression of a contact spring) =
    `law_constant` + `law_rows` states + `law_e` e + `compliance` F, with the states and e of free
    vibration.
    """

    start: Float[np.ndarray, " step"]
    length: Float[np.ndarray, " step"]
    length_index: Int[np.ndarray, " step"]
    at: Instants
    transition: Float[np.ndarray, "length point block side side"]
    forced: Float[np.ndarray, "step point_state wheel_node"]
    of_e: Float[np.ndarray, "length point e e"]
    by_excess: Float[np.ndarray, "length point_e wheel_node"]
    at_rest: Float[np.ndarray, "step point e"]
    law_rows: Float[np.ndarray, "step node wheel state"]
    law_e: Float[np.ndarray, "wheel e"]
    law_constant: Float[np.ndarray, "step wheel node"]
    compliance: Float[np.ndarray, "step wheel node wheel node"]


def prepare(model: ModalModel, loads: LoadSet, law: ContactLaw, start, length, on_beam) -> Steps:
    """Matrices of steps with given starts and lengths (s) and wheels on the beam (step, wheel)."""
    times = start[:, None] + length[:, None] * INSIDE
    steps, count = on_beam.shape
    active = np.broadcast_to(on_beam[:, None], (steps, POINTS.size, count))
    at = instants(model, loads, times, active)
    lengths, index = np.unique(length, return_inverse=True)
    to_nodes = propagators(model, lengths)
    transition, response = (
        np.concatenate([np.asarray(nodes), np.asarray(end)[:, None]], axis=1)
        for nodes, end in (
            (to_nodes.transition_nodes, to_nodes.transition_end),
            (to_nodes.input_nodes, to_nodes.input_end),
        )
    )
    blocks, side, _ = model.state_matrix.shape
    identity = np.broadcast_to(np.eye(side), (lengths.size, 1, blocks, side, side))
    transition = np.concatenate([identity, transition], axis=1)
    shape = at.shape[:, NODES].reshape(steps, NODE_COUNT, count, blocks, -1)
    # Downward forces, at all points but the start, where they have no effect yet.
    forced = np.zeros((steps, POINTS.size, blocks, side, count, NODE_COUNT))
    for own in range(lengths.size):
        which = index == own
        by_node = np.einsum("pfbim,tfwbm->tpbiwf", response[own], shape[which], optimize=True)
        forced[which, 1:] = -by_node
    forced = forced.reshape(steps, POINTS.size, model.state_count, count * NODE_COUNT)
    of_e, by_excess = _of_heights(law, lengths)
    weight = np.swapaxes(at.weight[:, NODES], 1, 2)
    at_rest = np.stack(
        [-np.einsum("pewf,wf->pe", by_excess[i], one) for i, one in zip(index, weight, strict=True)]
    )
    law_rows, law_constant = _law_at_nodes(law, at)
    law_constant = law_constant + np.where(law.sprung[:, None], 0.0, weight)
    law_e = np.where(law.sprung[:, None], -law.height, law.force)
    compliance = law_rows @ forced[:, NODES]  # step, node, wheel, (wheel, node)
    compliance = np.moveaxis(compliance.reshape(steps, NODE_COUNT, count, count, NODE_COUNT), 1, 2)
    at_nodes = by_excess[:, NODES]
    compliance = compliance + np.einsum("we,lcevf->lwcvf", law_e, at_nodes)[index]
    mass = np.where(law.rigid, law.mass, 0.0)
    own = at.shape[:, NODES] @ np.swapaxes(at.shape[:, NODES], -1, -2)
    at_once = np.swapaxes(mass[:, None] * own, 1, 2)[..., None] * np.eye(NODE_COUNT)[:, None, :]
    return Steps(
        start, length, index, at, transition,
        forced.reshape(steps, -1, count * NODE_COUNT), of_e,
        by_excess.reshape(lengths.size, -1, count * NODE_COUNT), at_rest,
        law_rows, law_e, law_constant, compliance - at_once,
    )  # fmt: skip


def _law_at_nodes(law: ContactLaw, at: Instants):
    """Rows (step, node, wheel, state) and constant (step, wheel, node) of the contact law."""
    rows, profile = np.moveaxis(at.rows[:, NODES], 2, 0), np.moveaxis(at.profile[:, NODES], 2, 0)
    of_motion = np.stack(
        [
            np.where(law.sprung, 1.0, np.where(law.tyre, law.stiffness, 0.0)),
            np.where(law.tyre, law.damping, 0.0),
            np.where(law.rigid, law.mass, 0.0),
        ]
    )
    law_rows = np.einsum("jw,jtcwn->tcwn", of_motion, rows)
    constant = np.einsum("jw,jtcw->twc", of_motion, profile)
    return law_rows, constant + np.where(law.sprung, law.compressed, 0.0)[:, None]


def _of_heights(law: ContactLaw, lengths: Float[np.ndarray, " length"]):
    """Maps to e at the points: of e at the start, and of F - P (length, point, e, wheel, node)."""
    size, count = law.B.shape
    if not size:
        none = np.zeros((lengths.size, POINTS.size, 0, 0))
        return none, np.zeros((lengths.size, POINTS.size, 0, count, NODE_COUNT))
    durations = lengths[:, None] * np.append(GAUSS_NODES, 1.0)
    A, B = law.A * law.scale[:, None] / law.scale, law.B * law.scale[:, None]
    transition, phi = phi_functions_of(A[..., None], B[..., None], durations, few_doublings=True)
    transition = np.moveaxis(transition[:, :, 0], (0, 1), (-2, -1)) / law.scale[:, None] * law.scale
    inputs = np.einsum("cfp,pewlc->lcewf", force_weights(), phi[:, :, :, 0])
    inputs = inputs / law.scale[:, None, None]
    start = np.broadcast_to(np.eye(size), (lengths.size, 1, size, size))
    return (
        np.concatenate([start, transition], axis=1),
        np.concatenate([np.zeros_like(inputs[:, :1]), inputs], axis=1),
    )


class Piece(NamedTuple):
    """A step without events inside: wheels that press, forces (N), states, e and gaps (m)."""

    start: float
    length: float
    on_beam: Bool[np.ndarray, " wheel"]
    pressing: Bool[np.ndarray, " wheel"]
    force: Float[np.ndarray, "wheel node"]
    states: Float[np.ndarray, "point state"]
    heights: Float[np.ndarray, "point e"]
    gap: Float[np.ndarray, "wheel point"]


def advance(law: ContactLaw, steps: Steps, i: int, pressing, state, e) -> Piece:
    """Step `i` from a state of the beam and e of the heights, with the given wheels `pressing`."""
    own = steps.length_index[i]
    on_beam = steps.at.on_beam[i, 0]
    transition = steps.transition[own]
    blocks, side = transition.shape[1:3]
    free = (transition @ state.reshape(blocks, side, 1)).reshape(POINTS.size, -1)
    free_e = steps.of_e[own] @ e + steps.at_rest[i]
    weight = steps.at.weight[i, NODES].T
    force = np.where((~law.contact & on_beam)[:, None], weight, 0.0)  # of wheels without a law
    index = np.flatnonzero(pressing)
    if index.size:
        constant = steps.law_constant[i, index] + steps.law_e[index] @ free_e[NODES].T
        rows, compliance = steps.law_rows[i][:, index], steps.compliance[i, index]
        constant = constant + (rows @ free[NODES, :, None])[..., 0].T
        size = index.size * NODE_COUNT
        constant = constant.ravel() + compliance.reshape(size, -1) @ force.ravel()
        matrix = compliance[:, :, index].reshape(size, size)
        sprung = np.repeat(law.sprung[index], NODE_COUNT)
        found = _forces(law, matrix, constant, sprung, weight[index].ravel())
        force[index] = found.reshape(index.size, NODE_COUNT)
    if force.any():
        free = free + (steps.forced[i] @ force.ravel()).reshape(free.shape)
        free_e = free_e + (steps.by_excess[own] @ force.ravel()).reshape(free_e.shape)
    height = law.height @ free_e.T
    if law.direct.any():
        height = height + law.direct[:, None] * ((force - weight) @ AT_POINTS.T)
    surface = (steps.at.rows[i, :, 0] @ free[..., None])[..., 0] + steps.at.profile[i, :, 0]
    gap = height - surface.T - law.compressed[:, None]
    start, length = float(steps.start[i]), float(steps.length[i])
    return Piece(start, length, on_beam, pressing.copy(), force, free, free_e, gap)


def _forces(law: ContactLaw, matrix, constant, sprung, start):
    """Forces F with F = constant + matrix F; by Newton's method for contact springs.

    For a contact spring, constant + matrix F is the compression, and F the force at it.
    """
    if not sprung.any():
        return np.linalg.solve(np.eye(constant.size) - matrix, constant)
    force = start
    for _ in range(NEWTON_ITERATIONS):
        argument = constant + matrix @ force
        of_spring, stiffness = law.of_compression(argument)
        found, slope = np.where(sprung, of_spring, argument), np.where(sprung, stiffness, 1.0)
        change = np.linalg.solve(np.eye(force.size) - slope[:, None] * matrix, found - force)
        force = force + change
        if np.max(np.abs(change)) <= NEWTON_TOLERANCE * np.max(np.abs(force)):
            break
    return force
