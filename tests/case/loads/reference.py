"""Reference vehicles: their loads in jaxbeam, and the map between the two sets of coordinates."""

import json

import numpy as np

from jaxbeam.case.loads.vehicles import HalfCar, Oscillator, QuarterCar, VehicleLoad, Wagon
from tests.modules import ROOT

REFERENCE = json.loads((ROOT / "tests" / "data" / "vehicles.json").read_text(encoding="utf-8"))


def half_car(d, speed=20.0, **options):
    return HalfCar(
        body_mass=d["mB"],
        body_inertia=d["IB"],
        axle_positions=-np.array(d["d"]),
        axle_masses=d["mG"],
        suspension_stiffness=d["ks"],
        suspension_damping=d["cs"],
        tyre_stiffness=d["kt"],
        tyre_damping=d["ct"],
        speed=speed,
        **options,
    )


def wagon(d, speed=20.0, **options):
    return Wagon(
        body_mass=d["mc"],
        body_inertia=d["Ic"],
        bogie_mass=d["mb"],
        bogie_inertia=d["Ib"],
        wheelset_mass=d["mw"],
        primary_stiffness=d["kp"],
        primary_damping=d["cp"],
        secondary_stiffness=d["ks"],
        secondary_damping=d["cs"],
        bogie_distance=d["lc"],
        wheelset_distance=d["lb"],
        speed=speed,
        **options,
    )


def quarter_car(d, speed=20.0, **options):
    return QuarterCar(
        body_mass=d["ms"],
        axle_mass=d["mu"],
        suspension_stiffness=d["ks"],
        suspension_damping=d["cs"],
        tyre_stiffness=d["kt"],
        tyre_damping=d["ct"],
        speed=speed,
        **options,
    )


def oscillator(d, speed=20.0, **options):
    return Oscillator(
        mass=d["m_v"],
        stiffness=d["k"],
        damping=d["c"],
        wheel_mass=d["m_w"],
        speed=speed,
        **options,
    )


BUILDERS = {
    "oscillator": oscillator,
    "quarter-car": quarter_car,
    "half-car": half_car,
    "half-car of unequal axles": half_car,
    "wagon": wagon,
}
LOADS = {name: build(REFERENCE[name]["input"]) for name, build in BUILDERS.items()}
LOADS["truck of five axles"] = VehicleLoad(model="truck-5-axle", speed=20.0)

# Coordinates of the reference = a permutation of those of jaxbeam, with signs: pitch is positive
# nose down in the reference's road vehicles, nose up in its wagon.
COORDINATES = {
    "oscillator": {"body": 1},
    "quarter-car": {"body": 1, "axle": 1},
    "half-car": {"body": 1, "body pitch": -1, "axle 1": 1, "axle 2": 1},
    "wagon": {
        "body": 1,
        "front bogie": 1,
        "rear bogie": 1,
        "body pitch": 1,
        "front bogie pitch": 1,
        "rear bogie pitch": 1,
    },
}
COORDINATES["truck of five axles"] = {"tractor": 1, "tractor pitch": -1, "trailer pitch": -1} | {
    f"axle {i}": 1 for i in range(1, 6)
}
COORDINATES["half-car of unequal axles"] = COORDINATES["half-car"]


def coordinate_map(names: tuple[str, ...], signs: dict[str, int]) -> np.ndarray:
    """Matrix S of u_reference = S u_jaxbeam."""
    return np.array([[sign * (name == own) for own in names] for name, sign in signs.items()])
