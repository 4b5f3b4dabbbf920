"""Reference vehicles and their published runs: loads and cases in jaxbeam, maps of coordinates."""

import json
from typing import Any

import numpy as np

import jaxbeam as jb
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


# Runs of `tests/data/vehicle_runs.json` as cases, and their numbers at the stated times.

DATA = json.loads((ROOT / "tests" / "data" / "vehicle_runs.json").read_text(encoding="utf-8"))
RUNS = {run["case"]: run for run in DATA["runs"]}
WAVES = json.loads((ROOT / "tests" / "data" / "profiles.json").read_text(encoding="utf-8"))
SENSORS = {"midspan": 0.5, "mid_span1": 0.25, "mid_span2": 0.75}  # x / length
BEFORE = 1 - 1e-9  # of the duration: when the last axle leaves, the numbers are those just before


def profile_of(run: dict[str, Any]):
    """Profile of a run; None if it is flat."""
    profile = run["profile"]
    if profile == "flat":
        return None
    kind, *numbers = profile.values()
    if kind == "sine":
        return jb.profiles.SineProfile(*numbers)
    if kind == "ramp":
        return jb.profiles.RampProfile(*numbers)
    if kind.startswith("versine"):
        return jb.profiles.BumpProfile(*numbers)
    waves = WAVES[kind.removeprefix("profiles.json: ")]
    switch = waves["switch_on"]["x0"] + np.array([0.0, waves["switch_on"]["length"]])
    return jb.profiles.SpectrumProfile(waves["n"], waves["amp"], waves["phase"], switch_on=switch)


def load_of(run: dict[str, Any]):
    """Load of a run, of a kind of case files."""
    numbers, start = run["vehicle"], run["start"]
    path = {"speed": run["speed"], "start_position": start or None}
    if "a2" in numbers:
        return jb.vehicles.VehicleLoad(model="truck-5-axle", **path)
    if "mc" in numbers:
        row = {"count": run["count"], "spacing": run["spacing"]} if "count" in run else {}
        return wagon(numbers, **path, **row)
    if "mB" in numbers:
        return half_car(numbers, **path)
    if "ms" in numbers:
        return quarter_car(numbers, **path)
    return oscillator(numbers, **path)


def case_of(run: dict[str, Any], modes: int) -> jb.Case:
    """Case of a run with some number of modes."""
    beam = run["beam"]
    return jb.Case(
        jb.Beam(beam["length"], beam["rigidity"], beam["mass"], beam["damping"], modes=modes),
        supports=[jb.Support(beam["length"] / 2)] if beam["spans"] == 2 else [],
        sensors=[jb.Sensor(beam["length"] * SENSORS[name]) for name in run["deflection"]],
        loads=[load_of(run)],
        profile=profile_of(run),
        run=jb.Run(run["duration"], 1e3),
    )


def simulated(run: dict[str, Any], modes: int, samples: int):
    """Record of a run, at equal intervals and at the times of the reference; and a look-up.

    `at(time)` is the index of a sample.
    """
    end = run["duration"] * BEFORE
    forces = [one[key] for one in run["contact"] for key in ("t_min", "t_max")]
    stated = np.minimum(np.array([*forces, *np.array(run["fractions"]) * run["duration"]]), end)
    stated = np.where(stated > 0, stated, 0.0)
    times = np.unique(np.concatenate([np.linspace(0.0, end, samples), stated]))
    times = times[np.diff(times, prepend=-1.0) > 1e-8 * end]
    record = jb.simulate(case_of(run, modes), times)

    def at(time):
        return int(np.argmin(np.abs(times - time)))

    return record, at


# Coordinates of the reference: names here, and sign; pitch is nose down in its road vehicles.
BODIES = {
    "body": ("body", 1),
    "axle": ("axle", 1),
    "yB": ("body", 1),
    "thetaB": ("body pitch", -1),
    "yG1": ("axle 1", 1),
    "yG2": ("axle 2", 1),
    "yB1": ("tractor", 1),
    "thetaB1": ("tractor pitch", -1),
    "thetaB2": ("trailer pitch", -1),
    "zc": ("body", 1),
    "thc": ("body pitch", 1),
    "zb1": ("front bogie", 1),
}


def body_index(record: jb.Record, run: dict[str, Any], body: dict[str, Any]) -> tuple[int, int]:
    """Column of a body of the reference in a record, and its sign."""
    name, sign = BODIES[body["dof"]]
    vehicle = f"vehicle {body['vehicle']} " if "count" in run else ""
    return record.bodies.index(f"loads.0 {vehicle}{name}"), sign


def largest(values) -> float:
    """Largest value of samples (time,) and of the parabolas through three of them."""
    left, middle, right = values[:-2], values[1:-1], values[2:]
    bend = np.minimum(left - 2 * middle + right, -1e-300)
    tops = np.where(
        middle >= np.maximum(left, right), middle - (right - left) ** 2 / (8 * bend), -np.inf
    )
    return float(max(np.max(tops), values[0], values[-1]))
