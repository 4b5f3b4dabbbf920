"""Beams of chapter 2 that are no rigs of their own: that of rig A bare, over one span and two."""

import dataclasses

import numpy as np

import jaxbeam as jb


def one_span(load_rig) -> jb.Case:
    """Rig A without its shaker."""
    return dataclasses.replace(load_rig("A"), actuators=())


def two_spans(load_rig, modes: int = 8) -> jb.Case:
    """The beam of rig A over two of its spans, of which rigidity and density "stay unchanged"."""
    one = one_span(load_rig)
    return dataclasses.replace(
        one,
        beam=dataclasses.replace(one.beam, length=2 * one.beam.length, modes=modes),
        supports=(jb.Support(one.beam.length),),
    )


def as_moving_force(case: jb.Case) -> jb.Case:
    """The same case with loads that weigh as much and have no inertia."""
    loads = [jb.MovingForce(mass=load.mass, speed=load.speed) for load in case.loads]
    return dataclasses.replace(case, loads=tuple(loads))


def critical_speed(case: jb.Case) -> float:
    """L omega_1 / pi in m/s, eq. (2.38)."""
    return 2 * float(case.beam.length) * float(jb.modes(case).frequencies[0])


def with_modes(case: jb.Case, modes: int) -> jb.Case:
    """The same case with another number of modes."""
    return dataclasses.replace(case, beam=dataclasses.replace(case.beam, modes=modes))


def with_sensors(case: jb.Case, *positions: float, duration: float) -> jb.Case:
    """The same case with sensors at places (m), for a duration (s)."""
    sensors = tuple(jb.Sensor(place) for place in positions)
    run = dataclasses.replace(case.run, duration=np.asarray(duration))
    return dataclasses.replace(case, sensors=sensors, run=run)
