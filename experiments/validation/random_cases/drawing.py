"""Draws of random valid cases: heavy and fast loads, many modes, events that coincide.

Masses are 1e-3 to 100 times that of the beam, speeds 0.05 to 10 times the critical one, modes 1 to
60. Loads enter together, meet, leave at once, or stop on the beam and stay. Frequencies are those
of a span on two pins, of two equal clamped spans (in pairs), or of a free beam (two are zero).
"""

from typing import NamedTuple

import numpy as np

import jaxbeam as jb
from jaxbeam.model.modal_model import modal_model
from tests.oracles.loads import Load
from tests.oracles.modal_equations import KnownModes, Span

LENGTH, RIGIDITY, MASS_PER_LENGTH = 2.0, 50.0, 1.5  # m, N m^2, kg/m
CRITICAL_SPEED = np.pi / LENGTH * np.sqrt(RIGIDITY / MASS_PER_LENGTH)  # of a span on pins, m/s
PERIOD = 2 * LENGTH / CRITICAL_SPEED  # of its first mode, s
MAX_MODES = 60
SAMPLES = 60  # of a run
SENSORS = np.array([0.37, 0.5]) * LENGTH  # positions, m
CLAMP = 1e10 * RIGIDITY / LENGTH  # rotational stiffness between two equal spans, N m/rad


class Drawn(NamedTuple):
    """A case, and its loads, modes and damping for another integrator."""

    case: jb.Case
    loads: list[Load]
    span: Span | KnownModes
    duration: float  # s


def draw(seed: int, index: int) -> Drawn:
    """The case of an index, the same each time."""
    rng = np.random.default_rng([seed, index])
    modes = round(10 ** rng.uniform(0.0, np.log10(MAX_MODES)))
    damping = float(rng.choice([0.0, 0.01, 0.1]))
    beam = str(rng.choice(["pinned", "pinned", "pinned", "paired", "free"]))
    loads = _loads(rng)
    ends = [min(load.time_at(LENGTH), load.stop_time) for load in loads]
    duration = float(max(ends) + rng.choice([0.1, 2.0]) * PERIOD)
    case = _case(beam, modes, damping, loads, duration)
    if beam == "pinned":
        span = Span(LENGTH, RIGIDITY, MASS_PER_LENGTH, modes, damping)
    else:
        model = modal_model(case)
        span = KnownModes(LENGTH, model.modes.stiffness, damping, model.shapes)
    return Drawn(case, loads, span, duration)


def _loads(rng: np.random.Generator) -> list[Load]:
    """One to three loads; one may enter with the one before, at its speed or against it."""
    loads: list[Load] = []
    for _ in range(rng.integers(1, 4)):
        speed = 10 ** rng.uniform(np.log10(0.05), 1.0) * CRITICAL_SPEED
        entry = rng.choice([0.0, 0.0, 0.1, 0.7]) * PERIOD
        if loads and rng.random() < 0.5:
            speed, entry = abs(loads[-1].speed), loads[-1].entry_time
        stop = rng.choice([np.inf, np.inf, np.inf, 0.3, 0.5, 0.9])  # share of the beam
        loads.append(
            Load(
                mass=float(10 ** rng.uniform(-3.0, 2.0) * MASS_PER_LENGTH * LENGTH),
                speed=float(speed * rng.choice([1, -1])),
                entry_time=float(entry),
                deceleration=float(speed**2 / (2 * stop * LENGTH)),
                kind=str(rng.choice(["mass", "mass", "force"])),
            )
        )
    return loads


def _case(beam: str, modes: int, damping: float, loads: list[Load], duration: float) -> jb.Case:
    ends = {"pinned": "pinned-pinned", "paired": "clamped-clamped", "free": "free-free"}[beam]
    clamp = [jb.Support(LENGTH / 2, rotational_stiffness=CLAMP)]
    kinds = {"mass": jb.MovingMass, "force": jb.MovingForce}
    return jb.Case(
        jb.Beam(LENGTH, RIGIDITY, MASS_PER_LENGTH, damping_ratio=damping, modes=modes, ends=ends),
        supports=clamp if beam == "paired" else [],
        sensors=[jb.Sensor(float(x)) for x in SENSORS],
        loads=[
            kinds[load.kind](
                mass=load.mass,
                speed=load.speed,
                entry_time=load.entry_time,
                deceleration=load.deceleration,
            )
            for load in loads
        ],
        run=jb.Run(duration, sample_rate=SAMPLES / duration),
    )
