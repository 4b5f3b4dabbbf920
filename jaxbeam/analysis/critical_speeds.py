"""Speeds at which loads in a row build up vibration, and at which a load leaves none behind.

A run-up on a rough track, the distance before the bridge, lets initial motion of vehicles decay.
The free motion of a vehicle on a rigid surface decays as exp(-sigma t), with sigma the least decay
rate of its modes. At speed v a fraction e of it is left after the distance v ln(1 / e) / sigma.
"""

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.base import AbstractLoad, VaryingForce, wheel_distances
from jaxbeam.model.load_set import load_set
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


SHARE = 0.01  # fraction of the free motion of a vehicle that is left when it enters the bridge
SWITCH = 10.0  # m, over which a profile grows from a level surface


def decay_rates(case: Case) -> list[float]:
    """Least decay rate (1/s) of the vehicles of each load on a rigid surface.

    Infinite for loads without springs, 0 without damping.
    """
    loads = load_set(case)
    rates, of_wheel = [math.inf] * len(case.loads), loads.load_of_wheel
    for group in loads.wheels.vehicles:
        number = of_wheel[group.first_wheel]
        if number < len(rates):
            poles = np.linalg.eigvals(concrete(group.A)[..., 0])
            rates[number] = max(0.0, float(np.min(-poles.real)))
    return rates


def run_up(case: Case, share: float = SHARE, speeds: Sequence[float] = ()) -> list[float]:
    """Run-up (m) of each load: distance before the bridge in which its free motion decays.

    A fraction `share` of the motion is left at entry; at the fastest of some `speeds` (m/s), by
    default at its own. Zero for loads without springs, and by a table of times. Raises ValueError
    for a share not between 0 and 1, and for a vehicle without damping.

    >>> import jaxbeam as jb
    >>> from jaxbeam.analysis.critical_speeds import run_up
    >>> car = jb.Oscillator(mass=1000.0, stiffness=4e4, damping=2e3, speed=20.0)
    >>> case = jb.Case(jb.Beam(20.0, 1e10, 12e3), loads=[car])
    >>> print(round(run_up(case)[0], 2))  # sigma = c / (2 m) = 1 / s, 20 m/s ln 100
    92.1
    """
    if not 0 < share < 1:
        raise ValueError(f"share lies between 0 and 1; it is {share:g}")
    distances = []
    for i, (load, rate) in enumerate(zip(case.loads, decay_rates(case), strict=True)):
        if load.speed is None or math.isinf(rate):
            distances.append(0.0)
            continue
        if not rate > 0:
            raise ValueError(
                f"loads.{i} never forgets how it started: a mode of the vehicle has no damping;"
                " give each suspension a damper"
            )
        fastest = max((abs(v) for v in speeds), default=abs(float(concrete(load.speed))))
        distances.append(fastest * math.log(1 / share) / rate)
    return distances


def with_run_up(case: Case, share: float = SHARE, speeds: Sequence[float] = ()) -> Case:
    """The case with its vehicles far enough before the bridge for their free motion to decay.

    The profile grows from a level surface over 10 m, the largest `run_up` of all loads before the
    bridge. All loads come later by the time that the slowest vehicle with springs, at its own or
    one of the `speeds`, takes from there to the bridge, so that they meet on it as they would; the
    run lasts as much longer. Raises ValueError as `run_up`, and for vehicles from both ends.
    """
    signed = [
        float(concrete(load.speed))
        for load, rate in zip(case.loads, decay_rates(case), strict=True)
        if load.speed is not None and not math.isinf(rate)
    ]
    every = [*speeds, *signed]
    distance = max(run_up(case, share, every), default=0.0)
    if distance == 0:
        return case
    start, length = distance + SWITCH, float(concrete(case.beam.length))
    leftwards = {speed < 0 for speed in signed}
    if len(leftwards) > 1:
        raise ValueError(
            "vehicles enter at both ends, and a profile grows from one: make a case of each, or"
            " give start_position and profile.switch_on"
        )
    delay = start / min(map(abs, every))
    ends = (length + start, length + distance) if leftwards == {True} else (-start, -distance)
    profile = case.profile
    if profile is not None and hasattr(profile, "switch_on"):
        profile = dataclasses.replace(profile, switch_on=ends)
    loads = tuple(_later(load, delay) for load in case.loads)
    run = dataclasses.replace(case.run, duration=case.run.duration + delay)
    return dataclasses.replace(case, loads=loads, profile=profile, run=run)


def _later(load: AbstractLoad, delay: float) -> AbstractLoad:
    """The load with its motion and its forces a delay (s) later."""
    names = ["entry_time" if load.times is None else "times", "step_time", "force_times"]
    later = {
        name: getattr(load, name) + delay for name in names if getattr(load, name, None) is not None
    }
    if isinstance(load, VaryingForce):
        phases = 0.0 if load.phases is None else load.phases
        later["phases"] = phases - 2 * np.pi * load.frequencies * delay
    return dataclasses.replace(load, **later)
