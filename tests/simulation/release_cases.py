"""Cases of all kinds whose answers of version 0.2.0 are kept in `tests/data/release_0_2_0.json`.

`python -m tests.simulation.release_cases` prints the answers of this version.
"""

import dataclasses
import json

import numpy as np

import jaxbeam as jb
from tests.c_code.cases import CASES as LOOPS, rig
from tests.test_known_and_traced import CASES as OPEN, CONTROLLED, LAWS, MASSES

# Their answers are those at a tolerance of 1e-12: 0.2.0 chose steps by another error of peaks
# between them, too small for the mass on a ramp (1.2e-8 in its peak), too large for the half car.
OTHER_STEPS = ("a mass on a ramp", "a half car")
LATER = ("eccentric masses",)  # what 0.2.0 had not
SAMPLES = 3  # of each history that is kept
LOOP_NAMES = (
    "feedback",
    "spring",
    "feedback-cubic",
    "output-feedback",
    "pd",
    "lead",
    "ppf",
    "prescribed",
)
ROAD = jb.Beam(25.0, 5e9, 2e3, damping_ratio=0.01, modes=4)


def _road(*loads, **parts):
    sensors = [jb.Sensor(12.5), jb.Sensor(8.0, "acceleration")]
    settings = {"sensors": sensors, "run": jb.Run(1.2, 50.0)} | parts
    return jb.Case(ROAD, loads=loads, **settings)


def _quarter(speed=30.0, **others):
    return jb.QuarterCar(2e3, 200.0, 2e5, 5e3, 1e6, speed=speed, **others)


CASES = {
    **{f"open: {name}": case for name, case in OPEN.items() if name not in LATER},
    **{
        f"law: {name}": dataclasses.replace(CONTROLLED, controller=law)
        for name, law in LAWS.items()
    },
    **{f"loop: {name}": LOOPS[name] for name in LOOP_NAMES},
    "a quarter car": _road(_quarter()),
    "a quarter car on a bump": _road(_quarter(), profile=jb.profiles.BumpProfile(8.0, 9.0, 0.01)),
    "a quarter car on waves": _road(_quarter(), profile=jb.profiles.SineProfile(4.0, 2e-3)),
    "a quarter car on a random road": _road(
        _quarter(), profile=jb.profiles.ISO8608Profile("B", seed=3)
    ),
    "a mass on a ramp": _road(
        jb.MovingMass(mass=500.0, speed=20.0), profile=jb.profiles.RampProfile(5.0, 9.0, 0.02)
    ),
    "an oscillator that brakes": _road(
        jb.Oscillator(2e3, 2e5, 3e3, 50.0, speed=30.0, deceleration=4.0)
    ),
    "two vehicles meet": _road(_quarter(), _quarter(-25.0, entry_time=0.1)),
    "a walking force": _road(jb.Pedestrian(pace=1.9, speed=20.0)),
    "a beam with a hinge": jb.Case(
        jb.Beam(25.0, 5e9, 2e3, 0.01, modes=4, hinges=[jb.Hinge(10.0)]),
        supports=[jb.Support(12.0)],
        sensors=[jb.Sensor(6.0)],
        loads=[jb.MovingMass(mass=300.0, speed=20.0)],
        run=jb.Run(1.4, 50.0),
    ),
    "many modes": dataclasses.replace(
        MASSES, beam=dataclasses.replace(MASSES.beam, modes=28, damping_ratio=0.01)
    ),
    "axles with masses": _road(
        jb.Axles(offsets=[0.0, 3.0, 9.0], forces=[1e4] * 3, masses=[0.0, 300.0, 200.0], speed=30.0)
    ),
    "a half car": _road(
        jb.vehicles.HalfCar(
            3e3,
            4e3,
            [1.5, -1.5],
            [200.0] * 2,
            [1e5] * 2,
            [4e3] * 2,
            [1e6] * 2,
            [0.0] * 2,
            speed=30.0,
        )
    ),
    "a varying force": _road(
        jb.VaryingForce(force=1e4, frequencies=[6.0], amplitudes=[3e3], speed=30.0)
    ),
    "a law in continuous time": rig(jb.Feedback([2e3, 1e3])),
    "prescribed in continuous time": rig(
        jb.Prescribed([0.1, 0.2], times=[0.0, 0.1, 0.3], values=[[0.0, 1.0, -1.0], [2.0, 0.0, 1.0]])
    ),
    "a mass that stops": _road(jb.MovingMass(mass=500.0, speed=25.0, deceleration=20.0)),
    "a load within the run": _road(jb.MovingForce(force=1e4, speed=30.0, entry_time=0.4)),
}


def answers(name: str) -> dict[str, list]:
    """Peaks, contact, and samples of the histories of the run of a case; None for NaN."""
    exact = {"tolerance": 1e-12} if name in OTHER_STEPS else {}
    record = jb.simulate(CASES[name], **exact)
    rows = np.linspace(0, record.times.size - 1, SAMPLES + 2).astype(int)[1:-1]
    parts = {
        "peaks": record.peak_deflection,
        "largest": record.largest,
        "contact": record.lowest_contact_force,
        "lost": record.contact_lost_time,
        "coordinates": record.coordinates[rows],
        "accelerations": record.accelerations[rows],
        "forces": record.contact_force[rows],
        "commands": record.command[rows],
        "bodies": record.body_displacement[rows],
    }
    return {name: _rounded(part) for name, part in parts.items() if np.size(part)}


def _rounded(part) -> list:
    """Numbers of an array to twelve digits, None for NaN."""
    return [None if np.isnan(x) else float(f"{x:.12g}") for x in np.ravel(part)]


if __name__ == "__main__":
    import warnings

    warnings.simplefilter("ignore")
    found = {name: answers(name) for name in CASES}
    print(json.dumps(found))
