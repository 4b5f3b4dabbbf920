"""Characteristic numbers of a concrete case, from its modes and loads, by which it is checked."""

import dataclasses
import functools
import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.beam import END_CONDITIONS, Support, segment_edges
from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.loads.base import AbstractLoad, wheel_distances
from jaxbeam.case.sensors import QUANTITIES
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.elements import held_positions
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modes import Modes

POSITIONS, TIMES = 201, 501


GRAVITY = 9.81  # m/s^2, of weights where a case has none


@dataclasses.dataclass(frozen=True)
class Plausibility:
    """Characteristic numbers of a case (SI units), and warnings; None for a number without meaning.

    `span` is the longest distance between held points, `deflection` the largest static one under
    the loads on their way (both in m) and `own_deflection` that under the beam's own weight;
    `mass_ratio` is the load on the beam at once over the mass of the beam, `crossing_time` (s) that
    of the slowest load from entry to exit, and `critical_speed` is 2 f_1 times the span (m/s), at
    which a force would follow the first mode of a pinned beam: Fryba (1999), Vibration of solids
    and structures under moving loads, chapter 1. Static deflections are sums of the modes of the
    case.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5), loads=[jb.MovingMass(mass=0.1, speed=1.0)], run=jb.Run(1.0)
    ... )
    >>> found = jb.check(case)
    >>> print(f"{found.first_frequency:.1f} Hz, mass ratio {found.mass_ratio:.2f}")
    21.4 Hz, mass ratio 0.33
    """

    first_frequency: float | None
    span: float
    deflection: float | None
    own_deflection: float | None
    mass_ratio: float | None
    crossing_time: float | None
    speed: float | None
    critical_speed: float | None
    warnings: tuple[str, ...] = ()

    @property
    def span_over_deflection(self) -> float | None:
        """Span over the largest static deflection under the loads."""
        return self.span / self.deflection if self.deflection else None

    @property
    def speed_ratio(self) -> float | None:
        """Largest speed over the critical speed."""
        return self.speed / self.critical_speed if self.speed and self.critical_speed else None

    def __str__(self) -> str:
        """One line with the numbers."""
        parts = []
        if self.first_frequency is not None:
            parts.append(f"first frequency {self.first_frequency:.4g} Hz")
        if self.deflection:
            parts.append(f"span/deflection {float(f'{self.span_over_deflection:.3g}'):.15g}")
        if self.mass_ratio is not None:
            parts.append(f"load/beam mass {self.mass_ratio:.3g}")
        if self.crossing_time is not None:
            parts.append(f"crossing {self.crossing_time:.4g} s")
        if self.speed_ratio is not None:
            parts.append(f"speed/critical {self.speed_ratio:.3g}")
        return ", ".join(parts) or "no elastic mode and no load"


def plausible_numbers(case: Case, found: Modes) -> Plausibility:
    """Characteristic numbers of a concrete case with its modes, without warnings."""
    frequencies = found.frequencies[is_elastic(found)]
    first = float(frequencies[0]) if frequencies.size else None
    span = _longest_span(case)
    loads = load_set(dataclasses.replace(case, absorbers=()))
    deflection, on_beam, fastest = _under_loads(case, found, loads)
    return Plausibility(
        first_frequency=first,
        span=span,
        deflection=deflection,
        own_deflection=_own_deflection(case, found),
        mass_ratio=_mass_ratio(case, on_beam),
        crossing_time=_crossing_time(case),
        speed=fastest,
        critical_speed=None if first is None else 2 * first * span,
    )


def _longest_span(case: Case) -> float:
    marks = sorted({0.0, *held_positions(case).tolist(), float(case.beam.length)})
    return max(right - left for left, right in itertools.pairwise(marks))


def is_elastic(found: Modes) -> Bool[np.ndarray, " mode"]:
    """Whether modes are held by a stiffness, and are not motions as a rigid body."""
    return np.asarray(found.stiffness > 1e-9 * found.stiffness_unit)


def compliance(found: Modes) -> Float[np.ndarray, " mode"]:
    """Inverse of the stiffness of modes; zero for motions as a rigid body."""
    elastic = is_elastic(found)
    return np.where(elastic, 1 / np.where(elastic, found.stiffness, 1.0), 0.0)


def _is_held(found: Modes) -> bool:
    return bool(np.all(is_elastic(found)))


def _under_loads(
    case: Case, found: Modes, loads: LoadSet
) -> tuple[float | None, float, float | None]:
    """Largest static deflection (m), largest weight on the beam at once (N), largest speed (m/s).

    The loads are on their way, whether the run sees them or not.
    """
    if not loads.wheel_count:
        return None, 0.0, None
    windows = np.asarray(loads.entry_exit_times())
    ends = np.where(windows < NEVER, windows, np.nan)
    start = float(np.nanmin(ends[:, 0])) if np.isfinite(ends[:, 0]).any() else 0.0
    last = max(float(np.nanmax(np.append(ends, start))), start)
    if np.any(windows[:, 1] >= NEVER):  # a load that stays on the beam
        last = max(last, float(case.run.duration))
    times = np.linspace(start, last, TIMES)
    position, speed, _ = map(np.asarray, loads.kinematics(times))
    x = np.linspace(0.0, float(case.beam.length), POSITIONS)
    present = (position >= 0) & (position <= x[-1])
    weight = np.where(present, np.asarray(loads.varying_weight(times))[..., 0].T, 0.0)
    fastest = float(np.max(np.abs(speed) * present))
    on_beam = float(np.max(np.abs(np.sum(weight, axis=0))))
    if not _is_held(found):
        return None, on_beam, fastest
    shapes = found.shapes(x)
    under_wheels = np.stack([np.interp(position, x, shape) for shape in shapes.T], -1)
    forces = np.einsum("wt,wtm->tm", weight, under_wheels)
    deflection = (forces * compliance(found)) @ shapes.T
    return float(np.max(np.abs(deflection))), on_beam, fastest


def _own_deflection(case: Case, found: Modes) -> float | None:
    if not _is_held(found):
        return None
    x = np.linspace(0.0, float(case.beam.length), POSITIONS)
    shapes = found.shapes(x)
    weight_per_length = float(case.beam.linear_density * case.run.gravity)
    forces = weight_per_length * np.trapezoid(shapes, x, axis=0)
    return float(np.max(np.abs(shapes @ (forces * compliance(found)))))


def _mass_ratio(case: Case, weight: float) -> float | None:
    if not case.loads:
        return None
    gravity = float(case.run.gravity) or GRAVITY
    return weight / gravity / float(case.beam.linear_density * case.beam.length)


def _crossing_time(case: Case) -> float | None:
    times = [leave - enter for enter, leave in crossing_times(case) if leave < NEVER]
    return float(max(times)) if times else None


UNIT_GRAVITY = np.ones(())


class SuspensionStage(NamedTuple):
    """Spring (N/m) and damper (N s/m) of a vehicle with their addresses, and mass carried (kg)."""

    spring: str
    damper: str
    stiffness: float
    damping: float
    carried: float


def stages(address: str, load: AbstractLoad) -> Iterator[SuspensionStage]:
    """Suspension stages of a vehicle at an address, from below; none of loads without springs."""
    vehicle: Any = load
    match load.kind:
        case "oscillator":
            names = "stiffness", "damping"
            yield _stage(address, vehicle, names, float(vehicle.mass))
        case "quarter-car" | "half-car":
            on_wheels = load.vehicle(UNIT_GRAVITY).static_loads
            axles = np.reshape(
                getattr(vehicle, "axle_masses", getattr(vehicle, "axle_mass", 0)), -1
            )
            for part, carried in (("tyre", on_wheels), ("suspension", on_wheels - axles)):
                names = f"{part}_stiffness", f"{part}_damping"
                yield from _per_axle(address, vehicle, names, carried)
        case "wagon":
            on_wheel = float(load.vehicle(UNIT_GRAVITY).static_loads[0])
            carried = on_wheel - float(vehicle.wheelset_mass)
            yield _stage(address, vehicle, ("primary_stiffness", "primary_damping"), carried)
            names = "secondary_stiffness", "secondary_damping"
            yield _stage(address, vehicle, names, float(vehicle.body_mass) / 2)
        case "vehicle":
            yield from _planar_stages(address, vehicle)


def _planar_stages(address: str, vehicle: Any) -> Iterator[SuspensionStage]:
    model = vehicle.vehicle(UNIT_GRAVITY)
    for part in ("tyre", "suspension"):
        for i, axle in enumerate(vehicle.axles):
            if getattr(axle, f"{part}_stiffness") is not None:
                carried = float(model.static_loads[i])
                carried -= 0.0 if part == "tyre" else float(axle.mass)
                names = f"{part}_stiffness", f"{part}_damping"
                yield _stage(f"{address}.axles.{i}", axle, names, carried)
    heights = [0.0 if name.endswith(" pitch") else 1.0 for name in model.names]
    sag = np.linalg.solve(model.full_stiffness, model.mass @ np.array(heights))
    motion = dict(zip(model.names, sag, strict=True))
    for i, spring in enumerate(vehicle.springs):
        first, second = (
            _sag_at(vehicle, motion, name, spring.position)
            for name in (spring.first, spring.second)
        )
        if first is not None and second is not None and float(spring.stiffness):
            carried = abs(first - second) * float(spring.stiffness)
            yield _stage(f"{address}.springs.{i}", spring, ("stiffness", "damping"), carried)


def _sag_at(vehicle: Any, motion: dict[str, float], name: str, position) -> float | None:
    """Sag of a body at a position under unit gravity; None of one whose height a hinge sets."""
    body = next((body for body in vehicle.bodies if body.name == name), None)
    if body is None or name not in motion:
        return None
    lever = float(position) - float(body.position)
    return motion[name] + lever * motion.get(f"{name} pitch", 0.0)


def _stage(address: str, part: Any, names: tuple[str, str], carried: float) -> SuspensionStage:
    spring, damper = (f"{address}.{name}" for name in names)
    stiffness, damping = (float(getattr(part, name)) for name in names)
    return SuspensionStage(spring, damper, stiffness, damping, carried)


def _per_axle(
    address: str, part: Any, names: tuple[str, str], carried
) -> Iterator[SuspensionStage]:
    stiffness, damping = (np.ravel(getattr(part, name)) for name in names)
    for i, mass in enumerate(carried):
        entry = f".{i}" if np.ndim(getattr(part, names[0])) else ""
        spring, damper = (f"{address}.{name}{entry}" for name in names)
        yield SuspensionStage(spring, damper, float(stiffness[i]), float(damping[i]), float(mass))


PROFILE_POSITIONS = 301
LEAST_BRIDGE = 3.0  # m: shorter beams are rigs, of other sizes and speeds


@dataclasses.dataclass(frozen=True)
class Facts:
    """A concrete case, its modes and `Plausibility`, and quantities derived from them."""

    case: Case
    modes: Modes
    numbers: Plausibility

    @functools.cached_property
    def length(self) -> float:
        """Length of the beam (m)."""
        return float(self.case.beam.length)

    @functools.cached_property
    def density(self) -> float:
        """Mean mass per length (kg/m)."""
        return float(self.case.beam.linear_density)

    @property
    def mass(self) -> float:
        """Mass of the beam (kg)."""
        return self.density * self.length

    @property
    def is_bridge(self) -> bool:
        """Whether the beam is as long as a bridge, not as a rig."""
        return self.length >= LEAST_BRIDGE

    @functools.cached_property
    def rigidity(self) -> float:
        """Mean bending stiffness (N m^2)."""
        return float(self.case.beam.bending_stiffness)

    @functools.cached_property
    def frequencies(self) -> np.ndarray:
        """Elastic natural frequencies (Hz); none of a beam without stiffness."""
        return np.asarray(self.modes.frequencies)[is_elastic(self.modes)]

    @functools.cached_property
    def windows(self) -> np.ndarray:
        """Times (s) of entry and exit of each load, `NEVER` for what does not happen."""
        return np.asarray(crossing_times(self.case))

    def loads(self, *kinds: str) -> Iterator[tuple[str, Any]]:
        """Loads of some kinds with their addresses; without kinds all."""
        for i, load in enumerate(self.case.loads):
            if not kinds or load.kind in kinds:
                yield f"loads.{i}", load

    @functools.cached_property
    def stages(self) -> list[SuspensionStage]:
        """Springs and dampers of all vehicles."""
        return [stage for address, load in self.loads() for stage in stages(address, load)]

    def behind(self, load: AbstractLoad) -> np.ndarray:
        """Distances (m) of the wheels of a load behind its first one."""
        return np.asarray(wheel_distances(load, load.vehicle(self.case.run.gravity)))

    @functools.cached_property
    def static_loads(self) -> list[np.ndarray]:
        """Static loads (N) of the wheels of one vehicle of each load."""
        gravity = self.case.run.gravity
        return [np.abs(load.vehicle(gravity).static_loads) for load in self.case.loads]

    def held(self) -> Iterator[tuple[float, float, str]]:
        """Position (m), stiffness (N/m) and address of each end and support of the deflection."""
        beam = self.case.beam
        ends = (0.0, beam.left_end, "the left end"), (self.length, beam.right_end, "the right end")
        for x, end, name in ends:
            if END_CONDITIONS[end][0]:
                yield x, math.inf, name
        for i, support in enumerate(self.case.supports):
            yield float(support.position), stiffness_of(support), f"supports.{i}"

    @functools.cached_property
    def jumps(self) -> dict[Any, list[tuple[float, str]]]:
        """Positions (m) at which a derivative of the deflection jumps, and names, by its order.

        The key "bend" has those at which only the curvature jumps, not the moment.
        """
        beam, found = self.case.beam, {0: [], 1: [], 2: [], 3: [], "bend": []}
        for i, hinge in enumerate(beam.hinges):
            found[1].append((float(hinge.position), f"beam.hinges.{i}"))
        for i, support in enumerate(self.case.supports):
            place, name = float(support.position), f"supports.{i}"
            found[3].append((place, name))
            if float(support.rotational_stiffness):
                found[2].append((place, name))
        for i, actuator in enumerate(self.case.actuators):
            for place, order, _ in actuator.displacement_map():
                found[3 - order].append((float(place), f"actuators.{i}"))
        edges = [(float(x), "a change of section") for x in segment_edges(beam)]
        return found | {"bend": edges}

    @functools.cached_property
    def shapes(self) -> np.ndarray:
        """Mode shapes (kg^-1/2) at equally spaced positions."""
        return np.asarray(self.modes.shapes(np.linspace(0.0, self.length, POSITIONS)))

    def influence(self, terms) -> np.ndarray:
        """Generalised displacement of each mode at the terms of a displacement map."""
        parts = [
            factor * np.asarray(self.modes.shapes(np.asarray(float(x)), order))
            for x, order, factor in terms
        ]
        return np.sum(parts, axis=0)

    def sag_per_command(self, actuator: Any) -> float:
        """Largest static deflection (m) under a steady command of 1 of its unit (1 V or 1 N)."""
        bend = self.shapes @ (compliance(self.modes) * self.influence(actuator.displacement_map()))
        return abs(float(actuator.attachment().static_gain)) * float(np.max(np.abs(bend)))

    def sag_of_command(self, actuator: Any) -> float | None:
        """Largest static deflection (m) under the largest command; None without limits."""
        limits = actuator.command_limits()
        return (
            None
            if limits is None
            else float(np.max(np.abs(limits)) * self.sag_per_command(actuator))
        )

    def reading(self, sensor: Any) -> float | None:
        """Estimated size of the readings of a sensor, from static deflection and first frequency.

        Readings per metre of deflection are those of the first sine wave over the longest span.
        """
        sag, first = self.numbers.deflection, self.numbers.first_frequency
        if not sag or first is None:
            return None
        quantity = QUANTITIES[sensor.quantity]
        if quantity.of_twist:
            return None
        size = sag * (math.pi / self.numbers.span) ** quantity.x_derivative
        size *= (2 * math.pi * first) ** quantity.time_derivative
        if quantity.at_fibre:
            size *= abs(float(sensor.fibre_distance))
        if quantity.section_force:
            size *= self.rigidity
        if quantity.over_modulus:
            size /= abs(float(sensor.section_modulus))
        return size

    @functools.cached_property
    def profile(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (m), from one length before to one behind the beam, and profile heights (m)."""
        x = np.linspace(-self.length, 2 * self.length, PROFILE_POSITIONS)
        return x, np.asarray(self.case.profile.heights(x)[0])

    @functools.cached_property
    def last_exit(self) -> float:
        """Time (s) at which the last load leaves; 0 if none does."""
        leaving = [leave for _, leave in self.windows if leave < NEVER]
        return float(max(leaving, default=0.0))


def stiffness_of(support: Support) -> float:
    """Stiffness of a support (N/m), infinite if it is rigid."""
    return math.inf if support.stiffness is None else float(support.stiffness)
