"""Facts of a case of known numbers that the table of plausible ranges judges."""

import dataclasses
import functools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from jaxbeam.case.beam import END_CONDITIONS, Support
from jaxbeam.case.case import Case, crossing_times
from jaxbeam.case.loads.base import AbstractLoad, wheel_distances
from jaxbeam.case.quantities import QUANTITIES
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model.modes import Modes
from jaxbeam.model.plausibility.numbers import POSITIONS, Plausibility, compliance
from jaxbeam.model.plausibility.stages import SuspensionStage, stages

PROFILE_POSITIONS = 301
LEAST_BRIDGE = 3.0  # m: shorter beams are rigs, of other sizes and speeds


@dataclasses.dataclass(frozen=True)
class Facts:
    """A case of known numbers, its modes and `Plausibility`, and what follows from them."""

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
        elastic = self.modes.stiffness > 1e-9 * self.modes.stiffness_unit
        return np.asarray(self.modes.frequencies)[elastic]

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
        """Position (m), stiffness (N/m) and address of what holds the deflection of the beam."""
        beam = self.case.beam
        ends = (0.0, beam.left_end, "the left end"), (self.length, beam.right_end, "the right end")
        for x, end, name in ends:
            if END_CONDITIONS[end][0]:
                yield x, math.inf, name
        for i, support in enumerate(self.case.supports):
            yield float(support.position), stiffness_of(support), f"supports.{i}"

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

    def sag_of_command(self, actuator: Any) -> float | None:
        """Largest static deflection (m) by the largest command; None without limits."""
        limits = actuator.command_limits()
        if limits is None:
            return None
        command = np.max(np.abs(limits)) * abs(float(actuator.attachment().static_gain))
        bend = self.shapes @ (compliance(self.modes) * self.influence(actuator.displacement_map()))
        return float(command * np.max(np.abs(bend)))

    def reading(self, sensor: Any) -> float | None:
        """Size of the readings of a sensor by the static deflection and the first frequency.

        Readings per metre of deflection are those of the first sine wave over the longest span.
        """
        sag, first = self.numbers.deflection, self.numbers.first_frequency
        if not sag or first is None:
            return None
        quantity = QUANTITIES[sensor.quantity]
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
        """Positions on the beam, and as far before and behind, and heights of the profile (m)."""
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
