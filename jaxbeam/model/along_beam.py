"""Where along the beam a quantity is taken: the positions, their sides, and extremes between them.

Positions are those of a grid, of ends, supports, hinges, changes of section, actuators, sensors and
stationary loads. A quantity that jumps there, as a shear force or a moment, is taken on both sides.
Between positions the extremes are refined until they no longer change.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.beam import segment_edges
from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.elements import NODE_TOLERANCE, actuator_terms, node_positions
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime.arrays import Array, any_traced, set_at, take, xp

GRID = 101  # equally spaced positions
LEFT_DISTANCE = 1e-7  # from a position to the section left of it, over the length
SETTLED = 1e-4  # change of an extreme, relative to it, at which positions are dense enough
LEAST_SIZE = 1e-3  # of the largest value, below which an extreme need not settle
MAX_ROUNDS = 8
SETTLED_ROUNDS = 2  # without a change; where a curve jumps, its fall next to a peak says nothing
CANDIDATES = 6  # peaks along the beam that are refined at a time
INNER = np.array([0.2, 0.4, 0.6, 0.8])  # of an interval next to a peak


def special_positions(case: Case) -> Float[Array, " place"]:
    """Positions (m) of ends, supports, hinges, changes of section, actuators, sensors and loads.

    Loads are those that stand on the beam for good.
    """
    sensors = (sensor.position for sensor in case.sensors)
    return xp.clip(xp.stack([*_kink_places(case), *sensors]), 0.0, case.beam.length)


def _kink_places(case: Case) -> list:
    loads = load_set(case)
    places = [
        *node_positions(case),
        *segment_edges(case.beam),
        *(hinge.position for hinge in case.beam.hinges),
        *(place for place, _, _ in actuator_terms(case)),
    ]
    enter, leave = loads.entry_exit_times().T
    stands = (enter < NEVER) & (leave >= NEVER)
    standing = xp.where(stands, loads.kinematics(xp.full((), NEVER))[0], 0.0)
    if case.track is not None:
        standing = (standing[:, None] + case.track.kernel().offsets).reshape(-1)
    return [*places, *standing]


def moving_positions(case: Case, x, load_places=()) -> tuple[Float[Array, " position"], np.ndarray]:
    """Positions x (m) with the derivatives of the part of the case at each, and which have any.

    Concrete positions x become those of ends, supports, hinges, edges, actuators and stationary
    loads within rounding of them, and of loads at the times of extremes (`load_places`), so that
    they move with these when differentiated. The first of `special_positions` at a place counts.
    Sensors and parts of concrete numbers do not move.
    """
    tolerance = NODE_TOLERANCE * float(concrete(case.beam.length))
    given, moving = x, np.zeros(x.size, bool)
    for place in (*load_places, *reversed(_kink_places(case))):
        near = np.abs(concrete(place) - given) <= tolerance
        if near.any():
            moving = np.where(near, any_traced(place), moving)
            x = xp.where(near, place if any_traced(place) else given, x)
    return (x if moving.any() else given), moving


def positions_along(
    case: Case, count: int = GRID, places: Float[np.ndarray, " place"] | tuple = ()
) -> Float[Array, " position"]:
    """Ascending positions (m): `count` equally spaced ones, the special ones and concrete `places`.

    Grid points within rounding of special positions are left out, where numbers are concrete, and
    move with these otherwise.
    """
    special, grid = special_positions(case), case.beam.length * np.linspace(0.0, 1.0, count)
    if not is_concrete(special):
        apart = xp.abs(grid[:, None] - special)
        near = xp.min(apart, axis=1) <= NODE_TOLERANCE * case.beam.length
        grid = xp.where(near, take(special, xp.argmin(apart, axis=1)), grid)
        return xp.sort(xp.concatenate([special, grid]))
    special = np.unique(np.concatenate([concrete(special), places]))
    grid = concrete(grid)
    return xp.asarray(np.union1d(special, grid[~_is_among(case, grid, special)]))


def _is_among(case: Case, x, places) -> np.ndarray:
    """Whether concrete positions x (m) are within rounding of one of the ascending places (m)."""
    after = np.clip(np.searchsorted(places, x), 1, len(places) - 1)
    distance = np.minimum(np.abs(x - places[after - 1]), np.abs(x - places[after]))
    return distance <= NODE_TOLERANCE * float(concrete(case.beam.length))


class EnvelopeSections(NamedTuple):
    """Points (m) at which a quantity is computed: the positions, then sections left of some.

    `left_of` has the indices of the positions with such a section. At a position itself a quantity
    that jumps has its value to the right.
    """

    points: Float[Array, " point"]
    left_of: Int[np.ndarray, " left"]

    def largest(self, values: Float[Array, "*rest point"]) -> Float[Array, "*rest position"]:
        """Larger of the values on both sides of each position."""
        return self._of_sides(values, xp.maximum)

    def smallest(self, values: Float[Array, "*rest point"]) -> Float[Array, "*rest position"]:
        """Smaller of the values on both sides of each position."""
        return self._of_sides(values, xp.minimum)

    def _of_sides(self, values, choose: Callable):
        count = values.shape[-1] - self.left_of.size
        right, left = values[..., :count], values[..., count:]
        at = np.s_[..., self.left_of]
        return set_at(right, at, choose(right[..., self.left_of], left)) if count else right


def sections(case: Case, x: Float[Array, " position"], quantity: str) -> EnvelopeSections:
    """Points at which a quantity is computed for the positions x (m) of an envelope.

    Shear forces and torques are taken on both sides of all positions, as a load may be at any;
    moments and other derivatives of the deflection on both sides of the special ones.
    """
    order, left = QUANTITIES[quantity].x_derivative, np.zeros(0, int)
    places = special_positions(case)
    if QUANTITIES[quantity].jumps or (order and not (is_concrete(x) and is_concrete(places))):
        left = np.arange(x.shape[0])
    elif order:
        places = np.unique(concrete(places))
        left = np.flatnonzero(_is_among(case, concrete(x), places))
    return EnvelopeSections(xp.concatenate([x, left_of(case, x[left])]), left)


def left_of(case: Case, x) -> Float[Array, "*position"]:
    """Positions (m) of sensors just left of positions x (m), 0 m at the left end.

    Further away than a wheel moves in the shortest step: there a shear force jumps between steps.
    """
    length = case.beam.length
    return xp.clip(xp.asarray(x, float) - LEFT_DISTANCE * length, 0.0, length)


def refined(
    case: Case,
    evaluate: Callable[[Float[Array, " position"]], Any],
    curves: Callable[[Any], tuple],
    x: Float[Array, " position"] | None = None,
) -> tuple[Float[Array, " refined"], Any]:
    """Positions x (m) with further ones at extremes, and what `evaluate` returns at all of them.

    x are `positions_along` by default.
    `evaluate` returns a tree of arrays with an axis of positions first, of which `curves` gives the
    values (position, curve) whose maxima are refined, the size of each curve, and concrete places
    (m) of loads near maxima. A maximum unchanged by SETTLED_ROUNDS has settled. Traced numbers are
    not refined.
    """
    x = positions_along(case) if x is None else x
    found = evaluate(x)
    if any_traced(x, found):
        return xp.asarray(x), found
    refined_x, tops, unchanged = np.asarray(x), np.array(np.inf), np.zeros(1, int)
    for _ in range(MAX_ROUNDS):
        values, sizes, near = curves(found)
        values, sizes = np.asarray(values), np.broadcast_to(sizes, values.shape[1:])
        if not np.all(np.isfinite(values)):  # a run that diverges
            break
        last, tops = tops, values.max(axis=0)
        unchanged = np.where(np.abs(tops - last) <= SETTLED * np.abs(tops), unchanged + 1, 0)
        each = zip(values.T, sizes, near, unchanged, strict=True)
        peaks = [_beside_peaks(refined_x, *one) for *one, rounds in each if rounds < SETTLED_ROUNDS]
        added = np.unique(np.concatenate([np.zeros(0), *peaks]))
        if not added.size:
            break
        more = evaluate(added)
        order = np.argsort(np.concatenate([refined_x, added]), kind="stable")
        refined_x = np.concatenate([refined_x, added])[order]
        found = jax.tree.map(lambda a, b, i=order: np.concatenate([a, b])[i], found, more)
    return xp.asarray(refined_x), found


def _beside_peaks(x, values, size, near) -> Float[np.ndarray, " added"]:
    """Positions in the intervals next to the peaks of a curve that may exceed its largest value.

    By more than a settled part of it, unless that is next to nothing of its size: between a peak
    and its neighbours a curve rises by half of what it falls to them, at most about.
    """
    top = values.max()
    padded = np.concatenate([[-np.inf], values, [-np.inf]])
    falls = np.stack([values - padded[:-2], values - padded[2:]])
    steps = np.where(np.isfinite(falls), np.abs(falls), 0.0).max(axis=0)
    reach = np.where(np.all(falls >= 0, axis=0), values + steps / 2, -np.inf)
    chosen = np.argsort(-reach, kind="stable")[:CANDIDATES]
    enough = top * (1 + SETTLED) if top > LEAST_SIZE * size else np.inf
    chosen = chosen[reach[chosen] > enough]
    added = []
    for i in chosen:
        left, right = x[max(i - 1, 0)], x[min(i + 1, x.size - 1)]
        inside = near[i][(near[i] > left) & (near[i] < right)]
        added += [left + INNER * (x[i] - left), x[i] + INNER * (right - x[i]), inside]
    added = np.unique(np.concatenate([np.zeros(0), *added]))
    return added[~np.isin(added, x)]
