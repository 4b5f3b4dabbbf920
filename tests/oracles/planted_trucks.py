"""Suspended trucks of two to six axles that cross bridges on rough roads, by finite elements.

The ends of the bridges are partly clamped; two strain gauges have white noise of four per cent of
the rms reading. Each of the two bridges has a road of class A, B and C of ISO 8608, which five
trucks, and before them two trucks of known axle loads, cross at several speeds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from tests.oracles import finite_elements, vehicle_elements
from tests.oracles.crossing import GRAVITY

ELEMENTS, FIBRE, NOISE, LEAD = 32, -0.6, 0.04, 6.0
CLASSES = {"A": 16e-6, "B": 64e-6, "C": 256e-6}  # m^3 at 0.1 cycles per metre
STEP, EVERY = 2.5e-3, 2
CALIBRATION_SPEEDS = 9.0, 14.0, 20.0  # m/s, of both known trucks


@dataclass(frozen=True)
class Bridge:
    """A bridge with rotational springs at its ends, gauges at 0.35 and 0.65 of its length."""

    length: float
    rigidity: float
    density: float
    clamping: float  # rotational stiffness of each end over E I / L

    @property
    def places(self) -> list[float]:
        """Positions (m) of the gauges."""
        return [0.35 * self.length, 0.65 * self.length]

    @property
    def beam(self) -> finite_elements.Beam:
        """Its finite elements."""
        spring = self.clamping * self.rigidity / self.length
        ends = [finite_elements.Support(x, rotational_stiffness=spring) for x in (0.0, self.length)]
        return finite_elements.Beam(
            self.length, self.rigidity, self.density, damping_ratio=0.02, elements=ELEMENTS,
            supports=ends,
        )  # fmt: skip


BRIDGES = Bridge(20.0, 1e10, 1e4, 0.8), Bridge(28.0, 4e10, 1.3e4, 1.5)


@dataclass(frozen=True)
class Truck:
    """Axle loads (N), their distances (m) behind the first, and a speed (m/s; to the left if < 0).

    The first axle is LEAD before the bridge at the start.
    """

    loads: np.ndarray
    offsets: np.ndarray
    speed: float

    @property
    def groups(self) -> list[list[int]]:
        """Axles less than 2.2 m behind the one before (COST 323)."""
        apart = np.flatnonzero(np.diff(self.offsets) >= 2.2) + 1
        return [part.tolist() for part in np.split(np.arange(len(self.loads)), apart)]


@dataclass(frozen=True)
class Passage:
    """What was logged of a truck: times (s) and strains (time, gauge), and the truth."""

    bridge: Bridge
    truck: Truck
    road_class: str
    times: np.ndarray
    strain: np.ndarray


def draw_truck(rng: np.random.Generator, axles: int) -> Truck:
    """A truck of usual spacings and loads; axles of a group differ by some per cent."""
    pair = rng.uniform(1.25, 1.4)
    gaps = {
        2: [rng.uniform(3.6, 5.5)],
        3: [rng.uniform(3.5, 5.0), pair],
        4: [rng.uniform(3.3, 4.2), rng.uniform(4.5, 6.5), pair],
        5: [rng.uniform(3.4, 4.0), rng.uniform(4.8, 6.2), pair, pair],
        6: [rng.uniform(2.8, 3.3), pair, rng.uniform(4.8, 6.2), pair, pair],
    }[axles]
    offsets = np.append(0.0, np.cumsum(gaps))
    truck = Truck(np.zeros(axles), offsets, float(rng.uniform(12.0, 24.0)))
    loads = np.empty(axles)
    for number, group in enumerate(truck.groups):
        one = 62e3 if number == 0 else {1: 95e3, 2: 82e3, 3: 72e3}[len(group)]
        own = one * rng.uniform(0.75, 1.15)
        loads[group] = own * (1 + 0.05 * rng.normal(size=len(group)))
    return replace(truck, loads=loads)


def suspended(truck: Truck, rng: np.random.Generator) -> vehicle_elements.Vehicle:
    """A rigid body on suspended axles, air springs of 1.4 to 1.9 Hz, tyres of 10 to 12 Hz hop."""
    loads, count = truck.loads, len(truck.loads)
    axle_masses = np.full(count, 700.0)
    sprung = loads / GRAVITY - axle_masses
    body = float(sprung.sum())
    places = float(truck.offsets @ sprung) / body - truck.offsets  # forward of the body's centre
    inertia = body * max(float(np.var(truck.offsets)), 2.0)
    springs = sprung * (2 * np.pi * rng.uniform(1.4, 1.9)) ** 2
    dampers = 2 * rng.uniform(0.12, 0.2) * np.sqrt(springs * sprung)
    tyres = axle_masses * (2 * np.pi * rng.uniform(10.0, 12.0)) ** 2 - springs
    tyres = np.maximum(tyres, 3e6 * loads / 80e3)
    reach = np.column_stack([np.ones(count), places, -np.eye(count)])
    wheels = np.column_stack([np.zeros((count, 2)), np.eye(count)])
    return vehicle_elements.Vehicle(
        np.diag([body, inertia, *axle_masses]), reach.T @ (dampers[:, None] * reach),
        reach.T @ (springs[:, None] * reach), wheels, tyres,
        np.full(count, 2e3), truck.offsets, loads,
    )  # fmt: skip


def road(road_class: str, rng: np.random.Generator):
    """Height (m) and slope of a surface of random phases, 0.05 to 2 cycles per metre."""
    n = np.geomspace(0.05, 2.0, 80)
    amplitude = np.sqrt(2 * CLASSES[road_class] * (0.1 / n) ** 2 * np.gradient(n))
    phase = rng.uniform(0.0, 2 * np.pi, n.size)

    def surface(x):
        angle = 2 * np.pi * n * np.asarray(x)[..., None] + phase
        return np.cos(angle) @ amplitude, -np.sin(angle) @ (2 * np.pi * n * amplitude)

    return surface


def cross(bridge: Bridge, truck: Truck, road_class: str, surface, rng) -> Passage:
    """The passage of a truck; one to the left crosses the bridge seen from its other side."""
    speed, length = abs(truck.speed), bridge.length
    duration = (LEAD + truck.offsets[-1] + length) / speed + 0.6
    vehicle = suspended(truck, rng)
    places = bridge.places
    if truck.speed < 0:
        places = [length - x for x in places]

        def profile(x):
            height, slope = surface(length - np.asarray(x))
            return height, -slope
    else:
        profile = surface
    run = vehicle_elements.cross(
        bridge.beam, vehicle, speed, -LEAD, places, duration, profile, step=STEP, every=EVERY
    )
    strain = -FIBRE * run.moment / bridge.rigidity
    noise = NOISE * np.sqrt(np.mean(strain**2, axis=0))
    return Passage(
        bridge, truck, road_class, run.times, strain + noise * rng.normal(size=strain.shape)
    )


@lru_cache
def site(bridge: int, road_class: str, trucks: tuple[int, ...] = (2, 3, 4, 5, 6), seed: int = 0):
    """Passages of the known trucks, and of those to be weighed, of so many axles, on one road."""
    own = BRIDGES[bridge]
    rng = np.random.default_rng([seed, bridge, ord(road_class)])
    surface = road(road_class, rng)
    known = [
        Truck(np.array([70e3, 110e3]), np.array([0.0, 4.2]), 1.0),
        Truck(np.array([65e3, 90e3, 85e3]), np.array([0.0, 3.8, 5.15]), 1.0),
    ]
    calibration = [
        cross(own, replace(truck, speed=speed), road_class, surface, rng)
        for truck in known
        for speed in CALIBRATION_SPEEDS
    ]
    weighed = [cross(own, draw_truck(rng, axles), road_class, surface, rng) for axles in trucks]
    return calibration, weighed
