"""Pinned span of the tests of runs, and cases with its loads."""

import numpy as np

import jaxbeam as jb
from tests.differences import load_of
from tests.oracles.crossing import GRAVITY, Load
from tests.oracles.modal_equations import Span

SPAN = Span(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=4, damping_ratio=0.02)
SENSORS = [0.15, 0.4]
TIMES = np.linspace(0.0, 1.0, 101)


def case_of(span: Span, loads: list[Load], **options) -> jb.Case:
    """Case of the span and loads of an oracle."""
    beam = jb.Beam(
        span.length,
        span.flexural_rigidity,
        span.mass_per_length,
        span.damping_ratio,
        modes=span.modes,
    )
    return jb.Case(
        beam,
        sensors=[jb.Sensor(x) for x in SENSORS],
        loads=[load_of(load) for load in loads],
        run=jb.Run(1.0, gravity=GRAVITY),
        **options,
    )


def random_load(rng: np.random.Generator, kind: str = "mass") -> Load:
    """Load of random direction, deceleration and entry time; it may stop or never enter."""
    speed = rng.uniform(0.8, 4.0)
    stopping = speed**2 / (2 * SPAN.length * rng.uniform(0.3, 0.9))
    return Load(
        mass=rng.uniform(0.05, 0.5),
        speed=speed * rng.choice([-1, 1]),
        entry_time=rng.uniform(-0.1, 0.5),
        deceleration=rng.choice([0.0, stopping, -2.0, 0.5 * stopping]),
        kind=kind,
    )
