"""Smallest contact forces within steps, and the first times at which they are tensile.

Within a step a contact force is the polynomial through its values at the Gauss nodes. It is
compared at fractions of the step, the ends among them, and at the vertices of the parabolas through
three of these. `runtime/native/steps.h` does the same in C.
"""

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.trajectory import NEVER
from jaxbeam.integrator.propagators import NODE_COUNT, PEAK_NODES
from jaxbeam.numerics.gauss import lagrange_coefficients
from jaxbeam.runtime.arrays import Array, cond, xp

# Peak nodes, and the middles between them.
FORCE_FRACTIONS = np.interp(
    np.arange(2 * len(PEAK_NODES) - 1) / 2, np.arange(len(PEAK_NODES)), PEAK_NODES
)


def force_weights_at_fractions() -> Float[np.ndarray, "fraction node"]:
    """Weights from contact forces at the Gauss nodes of a step to those at FORCE_FRACTIONS."""
    powers = FORCE_FRACTIONS[:, None] ** np.arange(NODE_COUNT)
    return powers @ lagrange_coefficients(NODE_COUNT).T


def spread_factor() -> float:
    """Bound of a force beyond the middle of its values at the Gauss nodes, over their spread.

    Half the Lebesgue constant of the nodes, which is that at the ends of the step.
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

    `forces` are those on the beam at the Gauss nodes of steps, positive upwards; `is_load` says
    which load a row is. Times are NEVER without a loss, which is where the line between two
    fractions is zero, or at a vertex.
    """
    steps, batch_size = forces.shape[0], forces.shape[-1]
    by_row = forces.reshape(steps, -1, NODE_COUNT, batch_size)
    most, least = xp.max(by_row, axis=2), xp.min(by_row, axis=2)
    bound = 0.5 * (most + least) + spread_factor() * (most - least)
    bound = xp.where(is_load[..., None], bound[:, :, None], -xp.inf)
    # Most chunks stay far above the smallest force so far; NaN is passed on.
    changes = ~(bound <= -lowest) | ((bound > 0) & (lost_time >= NEVER))

    def refined(earlier):
        pulls = xp.einsum("slnb,fn->slfb", by_row, force_weights_at_fractions())
        vertex, at = _vertices(pulls)
        pull = xp.maximum(xp.max(pulls, axis=2), xp.max(vertex, axis=2))
        force = xp.where(is_load[..., None], -pull[:, :, None], xp.inf)
        fraction = _first_loss(pulls, vertex, at)
        time = start[:, None, None] + length[:, None, None] * fraction
        time = xp.where(fraction < NEVER, time, NEVER)
        time = xp.where(is_load[..., None], time[:, :, None], NEVER)
        return (
            xp.minimum(earlier[0], xp.min(force, axis=(0, 1), initial=xp.inf)),
            xp.minimum(earlier[1], xp.min(time, axis=(0, 1), initial=NEVER)),
        )

    return cond(xp.any(changes), refined, lambda earlier: earlier, (lowest, lost_time))


def _vertices(pulls: Float[Array, "step row fraction batch"]):
    """Tops of the parabolas through three fractions, and where they are; -inf without one."""
    gaps = np.diff(FORCE_FRACTIONS)[:, None]
    slopes = xp.diff(pulls, axis=2) / gaps
    rise, fall = slopes[:, :, :-1], slopes[:, :, 1:]
    inside = (rise > 0) & (fall < 0)
    curvature = xp.where(inside, (fall - rise) / (gaps[:-1] + gaps[1:]), -1.0)
    slope = rise + curvature * gaps[:-1]
    top = pulls[:, :, 1:-1] - slope**2 / (4 * curvature)
    at = FORCE_FRACTIONS[1:-1, None] - slope / (2 * curvature)
    return xp.where(inside, top, -xp.inf), at


def _first_loss(pulls, vertex, at) -> Float[Array, "step row batch"]:
    """First fraction of each step with a pull, NEVER without one."""
    before, after = pulls[:, :, :-1], pulls[:, :, 1:]
    rises = (before <= 0) & (after > 0)
    share = before / xp.where(rises, before - after, 1.0)
    crossing = FORCE_FRACTIONS[:-1, None] + np.diff(FORCE_FRACTIONS)[:, None] * share
    first = xp.min(xp.where(rises, crossing, NEVER), axis=2)
    touching = (vertex > 0) & (pulls[:, :, 1:-1] <= 0)
    first = xp.minimum(first, xp.min(xp.where(touching, at, NEVER), axis=2))
    return xp.where(pulls[:, :, 0] > 0, 0.0, first)
