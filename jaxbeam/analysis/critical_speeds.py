"""Speeds at which loads in a row build up vibration, and at which a load leaves none behind."""

from typing import NamedTuple

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.base import wheel_distances
from jaxbeam.model.modes import modes

SAME_DISTANCE = 1e-3  # m: distances of wheels that are equal
LEAST_REPEATS = 3  # pairs of wheels at a distance that make it a regular spacing


class CriticalSpeed(NamedTuple):
    """Resonance or cancellation speed (m/s) of a mode, counted from 1, and its order."""

    speed: float
    mode: int
    order: int


def regular_spacing(case: Case, load: int = 0) -> float | None:
    """Distance (m) at which the wheels of a load of a case repeat: the length of a coach.

    The distance that the largest static loads have in common, sum P_i P_j over all pairs of wheels
    at that distance; the smallest of equal ones. None if fewer than three pairs repeat.
    """
    row = case.loads[load]
    vehicle = row.vehicle(case.run.gravity)
    distances = concrete(wheel_distances(row, vehicle))
    weights = np.tile(concrete(vehicle.static_loads), len(distances) // len(vehicle.offsets))
    first, second = np.triu_indices(len(distances), 1)
    apart, product = distances[second] - distances[first], weights[first] * weights[second]
    order = np.argsort(apart)
    groups = np.split(order, np.flatnonzero(np.diff(apart[order]) > SAME_DISTANCE) + 1)
    common = {float(np.mean(apart[group])): group for group in groups if len(group)}
    common = {gap: group for gap, group in common.items() if gap > SAME_DISTANCE}
    if not common:
        return None
    totals = {gap: np.sum(product[group]) for gap, group in common.items()}
    largest = max(totals.values())
    gap = min(gap for gap, total in totals.items() if total > (1 - 1e-9) * largest)
    return gap if len(common[gap]) >= LEAST_REPEATS else None


def resonance_speeds(
    case: Case, spacing: float, lowest: float, highest: float, count: int = 1
) -> list[CriticalSpeed]:
    """Resonance speeds v = d f_k / i (m/s) between two speeds, of the first `count` modes.

    Loads at a regular spacing d (m) act on mode k every d / v, which is i of its periods: Xia, Li,
    Guo and De Roeck (2014), Journal of Engineering Mechanics, 10.1061/(ASCE)EM.1943-7889.0000714;
    Yang, Yau and Wu (2004), Vehicle-Bridge Interaction Dynamics.
    """
    found = []
    for mode, frequency in enumerate(concrete(modes(case).frequencies)[:count], 1):
        critical = spacing * frequency
        orders = range(max(1, int(np.ceil(critical / highest))), int(critical / lowest) + 1)
        found += [CriticalSpeed(critical / order, mode, order) for order in orders]
    return found


def cancellation_speeds(
    case: Case, lowest: float, highest: float, count: int = 1
) -> list[CriticalSpeed]:
    """Cancellation speeds v = 2 L f_k / (k + 2 i) (m/s) between two speeds, i not 0.

    A single force that has crossed leaves no vibration of mode k of an undamped, pinned beam: it
    has acted as half waves sin(k pi v t / L) over T = L / v, whose free vibration 1 - (-1)^k
    exp(j 2 pi f_k T) vanishes. Trains do not build up vibration there, whatever their spacing, and
    little on a damped beam: the first kind of cancellation of Xia et al. (2014), see
    `resonance_speeds`. `order` is k + 2 i. None for beams with other ends, supports or patches.
    """
    if case.beam.ends != "pinned-pinned" or case.supports or case.actuators:
        return []
    found = []
    for mode, frequency in enumerate(concrete(modes(case).frequencies)[:count], 1):
        critical = 2 * float(concrete(case.beam.length)) * frequency
        orders = range(max(1, int(np.ceil(critical / highest))), int(critical / lowest) + 1)
        found += [
            CriticalSpeed(critical / order, mode, order)
            for order in orders
            if order != mode and (order - mode) % 2 == 0
        ]
    return found
