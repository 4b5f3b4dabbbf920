"""Contact forces within steps and at their ends: smallest force, and first loss of contact.

Within a step a contact force is the polynomial through its values at the Gauss nodes. It is
compared at fractions of the step, which include the ends, and at the vertices of the parabolas
through three of these. `runtime/native/contact.c` does the same in C.

Peaks of statically corrected outputs often are at an end, where an axle stands on a sensor. An
extrapolation of the forces at the Gauss nodes is the least accurate there; the states are the most
accurate, of order 12, and so are the forces that the contact law gives for them.
"""

import functools

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.trajectory import NEVER
from jaxbeam.integrator.propagators import NODE_COUNT, PEAK_NODES, end_weights
from jaxbeam.model.contact import solve_at_instants, surface_rows
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.numerics.polynomials import lagrange_coefficients, polynomial
from jaxbeam.runtime.arrays import Array, Module, cond, fori_loop, is_jax, stop_gradient, take, xp

ZERO_ITERATIONS = 4  # of Newton's method for the time of a loss
# Peak nodes, and the middles between them.
FORCE_FRACTIONS = np.interp(
    np.arange(2 * len(PEAK_NODES) - 1) / 2, np.arange(len(PEAK_NODES)), PEAK_NODES
)
FORCE_GAP = float(np.diff(FORCE_FRACTIONS).max())


def force_weights_at_fractions() -> Float[np.ndarray, "fraction node"]:
    """Weights that interpolate contact forces at the Gauss nodes of a step to FORCE_FRACTIONS."""
    powers = FORCE_FRACTIONS[:, None] ** np.arange(NODE_COUNT)
    return powers @ lagrange_coefficients(NODE_COUNT).T


def spread_factor() -> float:
    """Bound of the distance of a force from the middle of its nodal values, over their spread.

    It is half the Lebesgue constant of the Gauss nodes, which is reached at the ends of the step.
    """
    return 0.5 * float(np.abs(force_weights_at_fractions()).sum(axis=1).max())


def contact_minimum(
    lowest: Float[Array, "load batch"],
    lost_time: Float[Array, "load batch"],
    forces: Float[Array, "step row batch"],
    is_load: Bool[Array, "step row_load load"],
    start: Float[Array, " step"],
    length: Float[Array, " step"],
) -> tuple[Float[Array, "load batch"], Float[Array, "load batch"]]:
    """Smallest forces (N, positive where a load presses) and times of the first loss (s), updated.

    `forces` act on the beam at the Gauss nodes of steps, positive upwards; `is_load` marks the load
    of each row. The loss of contact is the first zero of the polynomial, or the start of a step
    that begins with a tensile force; its time is NEVER without a loss.
    """
    if not is_load.size:  # of a case without loads
        return lowest, lost_time
    steps, batch_size = forces.shape[0], forces.shape[-1]
    by_row = forces.reshape(steps, -1, NODE_COUNT, batch_size)
    most, least = xp.max(by_row, axis=2), xp.min(by_row, axis=2)
    bound = 0.5 * (most + least) + spread_factor() * (most - least)
    bound = xp.where(is_load[..., None], bound[:, :, None], -xp.inf)

    whole_run = is_jax(bound) and not is_jax(lowest)

    def pulls_of_loads():
        pulls = _at_fractions(by_row, whole_run)
        pull = xp.maximum(xp.max(pulls, axis=0), xp.max(_vertices(pulls)[0], axis=0))
        return xp.where(is_load[..., None], pull[:, :, None], -xp.inf)

    if whole_run:  # no branches, each of which has its own
        pulls_of_loads = functools.cache(pulls_of_loads)

    def with_smaller(lowest):
        return xp.minimum(lowest, xp.min(-pulls_of_loads(), axis=(0, 1), initial=xp.inf))

    def with_first_loss(lost_time):
        """Of each load only the first step with a pull counts."""
        pulls = pulls_of_loads().reshape(-1, *lost_time.shape) > 0
        loses, found = xp.any(pulls, axis=0), xp.argmax(pulls, axis=0)
        of_rows = by_row.reshape(-1, NODE_COUNT, batch_size)
        nodes = xp.take_along_axis(of_rows, found[:, None], axis=0)[:, None]  # load, 1, node, batch
        pulls = _at_fractions(nodes, whole_run)
        powers = xp.einsum("slnb,nk->kslb", nodes, lagrange_coefficients(NODE_COUNT))
        near = stop_gradient((powers, pulls))
        fraction = _zero_nearby(near[0], _first_loss(near[1], *_vertices(near[1])))
        fraction = _moving_zero(powers, fraction)[:, 0]
        step = found // is_load.shape[1]
        time = take(start, step) + take(length, step) * fraction
        return xp.minimum(lost_time, xp.where(loses, time, NEVER))

    # Most chunks stay above the smallest force so far; NaN is passed on.
    lowest = cond(whole_run or xp.any(~(bound <= -lowest)), with_smaller, lambda same: same, lowest)
    loses = whole_run or xp.any((lowest < 0) & (lost_time >= NEVER))
    return lowest, cond(loses, with_first_loss, lambda same: same, lost_time)


def _at_fractions(by_row: Float[Array, "step row node batch"], by_product: bool):
    """Tensile forces at the FORCE_FRACTIONS, (fraction, step, row, batch).

    The sum is one that XLA fuses with the operations after it; `by_product` it is one product,
    which makes a smaller program.
    """
    if by_product:
        return xp.einsum("fn,slnb->fslb", force_weights_at_fractions(), by_row)
    weights = force_weights_at_fractions()[..., None, None, None]
    return sum(weights[:, node] * by_row[:, :, node] for node in range(NODE_COUNT))


def _parabolas() -> tuple[Float[np.ndarray, "inner fraction"], ...]:
    """Weights of the values at all fractions in the parabolas through three fractions.

    They give the slopes before and after the middle fraction, the slope at it, and half the second
    derivative.
    """
    gaps = np.diff(FORCE_FRACTIONS)[:, None]
    slopes = np.diff(np.eye(FORCE_FRACTIONS.size), axis=0) / gaps
    rise, fall = slopes[:-1], slopes[1:]
    curvature = (fall - rise) / (gaps[:-1] + gaps[1:])
    return rise, fall, rise + curvature * gaps[:-1], curvature


PARABOLAS = _parabolas()


def _vertices(pulls: Float[Array, "fraction step row batch"]):
    """Maxima of the parabolas through three fractions, -inf without one, and their rising zeros."""
    rise, fall, slope, curvature = (xp.tensordot(weights, pulls, 1) for weights in PARABOLAS)
    inside = (rise > 0) & (fall < 0) & (curvature < 0)  # which rounding of a level pull may not be
    curvature = xp.where(inside, curvature, -1.0)
    top = xp.where(inside, pulls[1:-1] - slope**2 / (4 * curvature), -xp.inf)
    at = FORCE_FRACTIONS[1:-1, None, None, None] - slope / (2 * curvature)
    return top, at - xp.sqrt(xp.where(top > 0, top, 1.0) / -curvature)


def _first_loss(pulls, vertex, rising) -> Float[Array, "step row batch"]:
    """Fraction of each step at which the force first becomes tensile, NEVER without one.

    It is found on the line between two fractions, or on the parabola if the force is tensile only
    between them.
    """
    before, after = pulls[:-1], pulls[1:]
    rises = (before <= 0) & (after > 0)
    fraction = before / xp.where(rises, before - after, 1.0)
    starts, gaps = FORCE_FRACTIONS[:-1], np.diff(FORCE_FRACTIONS)
    crossing = starts[:, None, None, None] + gaps[:, None, None, None] * fraction
    first = xp.min(xp.where(rises, crossing, NEVER), axis=0)
    touching = (vertex > 0) & (pulls[1:-1] <= 0)
    first = xp.minimum(first, xp.min(xp.where(touching, rising, NEVER), axis=0))
    return xp.where(pulls[0] > 0, 0.0, first)


def _moving_zero(
    powers: Float[Array, "power step row batch"], zero: Float[Array, "step row batch"]
) -> Float[Array, "step row batch"]:
    """`zero` with the derivative of the instant at which the polynomial is zero."""
    if not is_jax(powers):
        return zero
    inside = (zero > 0) & (zero < NEVER)
    at = xp.where(inside, zero, 0.5)
    slope = polynomial(_slopes(stop_gradient(powers)), at)
    value = polynomial(powers, at)
    change = (value - stop_gradient(value)) / xp.where(slope == 0, 1.0, slope)
    return xp.where(inside, zero - change, zero)


def _slopes(powers: Float[Array, "power *rest"]) -> Float[Array, "power_less_one *rest"]:
    """Coefficients of the derivative of a polynomial, lowest power first."""
    return powers[1:] * np.arange(1.0, powers.shape[0]).reshape(-1, *(1,) * (powers.ndim - 1))


def _zero_nearby(
    powers: Float[Array, "power step row batch"], start: Float[Array, "step row batch"]
) -> Float[Array, "step row batch"]:
    """Zero of a polynomial within a gap of FORCE_FRACTIONS of a start; 0 and NEVER are kept.

    It is found by Newton's method; the start is kept if that ends farther from zero. The line
    between two fractions misses the zero by up to 1e-3 of the step.
    """
    inside = (start > 0) & (start < NEVER)
    first = xp.where(inside, start, 0.5)
    low, high = xp.maximum(first - FORCE_GAP, 0.0), xp.minimum(first + FORCE_GAP, 1.0)
    slopes = _slopes(powers)

    def newton(_, x):
        slope = polynomial(slopes, x)
        step = polynomial(powers, x) / xp.where(slope == 0, 1.0, slope)
        return xp.clip(x - step, low, high)

    found = fori_loop(0, ZERO_ITERATIONS, newton, first)
    nearer = xp.abs(polynomial(powers, found)) <= xp.abs(polynomial(powers, first))
    return xp.where(inside & nearer, found, start)


# Fractions of a step for limits from within at its ends, where accelerations of loads jump.
END_FRACTIONS = (1e-9, 1.0 - 1e-9)


class EndRows(Module):
    """Rows of the wheels at the two ends of steps: mode shapes, accelerations, and profile.

    `accelerations` map states to the accelerations under the wheels, `surface` is the second rate
    of the profile's height there (m/s^2), None without a profile.
    """

    shapes: Float[Array, "step end load mode"]
    accelerations: Float[Array, "step end load state"]
    surface: Float[Array, "step end load"] | None


def end_rows(
    model: ModalModel, loads: LoadSet, start, length, load_index, on_beam
) -> EndRows | None:
    """Rows of the wheels at the ends of steps; None for massless forces and for vehicles."""
    if loads.massless or loads.wheels.vehicles:
        return None
    times = start[:, None] + length[:, None] * xp.asarray(END_FRACTIONS, length.dtype)
    index = load_index[:, None]
    position, speed, acceleration = (
        xp.take_along_axis(xp.moveaxis(part, 0, -1), index, axis=2)
        for part in loads.kinematics(times)
    )
    active = xp.broadcast_to(on_beam[:, None], position.shape)
    arms = None if loads.eccentricity is None else take(loads.eccentricity, index)
    rows = surface_rows(model, position, speed, acceleration, active, eccentricity=arms)
    surface = loads.surface_motion(position, speed, acceleration)
    return EndRows(
        rows.shape.reshape(*active.shape, -1),
        rows.acceleration.reshape(*active.shape, -1),
        None if surface is None else surface[2],
    )


def end_forces(
    rows: EndRows | None,
    inertia: Float[Array, "step row batch"],
    weight: Float[Array, "step load end batch"],
    before: Float[Array, "step state batch"],
    last: Float[Array, "state batch"],
    forces: Float[Array, "step row batch"],
) -> Float[Array, "step row_end batch"]:
    """Contact forces (N) of wheels at the ends of steps, from the states there.

    States are those `before` each step, and the `last` after all steps. Without `rows` forces are
    extrapolated from those at the Gauss nodes.
    """
    steps, count, batch = forces.shape
    nodes = end_weights().shape[0]
    by_load = (steps, count // nodes, nodes, batch)
    if rows is None:
        extrapolated = xp.einsum("tlfb,fe->tleb", forces.reshape(by_load), end_weights())
        return extrapolated.reshape(steps, -1, batch)
    mass = inertia.reshape(by_load)[:, None, :, 0]  # step, 1, load, batch
    acceleration = _at_ends(rows.accelerations, before, last)
    if rows.surface is not None:
        acceleration = acceleration + rows.surface[..., None]
    right = xp.swapaxes(weight, 1, 2) + mass * acceleration
    compliance = rows.shapes @ rows.shapes.mT
    matrix = np.eye(mass.shape[2])[..., None] + mass[:, :, :, None] * compliance[..., None]
    found = -solve_at_instants(matrix, right)
    return xp.swapaxes(found, 1, 2).reshape(steps, -1, batch)


def _at_ends(
    rows: Float[Array, "step end load state"],
    before: Float[Array, "step state batch"],
    last: Float[Array, "state batch"],
) -> Float[Array, "step end load batch"]:
    """Products of rows at the two ends of steps with the states there.

    A step ends where the next one begins, so that both rows act on the states before the steps.
    These states, by far the largest array, are read once and not copied.
    """
    at_end = rows[:, 1]
    of_former = xp.concatenate([xp.zeros_like(at_end[:1]), at_end[:-1]])
    starts, ends = xp.split(xp.concatenate([rows[:, 0], of_former], axis=1) @ before, 2, axis=1)
    ends = xp.concatenate([ends[1:], (at_end[-1] @ last)[None]])
    return xp.stack([starts, ends], axis=1)
