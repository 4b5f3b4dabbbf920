"""Cases stacked along a first axis, and times at which loads enter and leave."""

import dataclasses

import numpy as np

import jaxbeam as jb
from jaxbeam.case.case import crossing_times, replace, stack_cases
from jaxbeam.case.trajectory import NEVER

CASE = jb.Case(
    jb.Beam(length=1.2, flexural_rigidity=10.0, mass_per_length=1.0),
    loads=[
        jb.MovingMass(mass=0.5, speed=-2.0, entry_time=0.1),
        jb.MovingMass(mass=0.5, speed=1.0, deceleration=1.0),  # stops after 0.5 m
    ],
)


def test_crossing_times():
    np.testing.assert_allclose(crossing_times(CASE), [[0.1, 0.7], [0.0, NEVER]])
    assert crossing_times(dataclasses.replace(CASE, loads=())).shape == (0, 2)


def test_stacked_cases_have_all_numbers_along_a_first_axis():
    stacked = stack_cases([CASE, replace(CASE, {"beam.length": 2.0})])
    assert stacked.beam.length.tolist() == [1.2, 2.0]
    assert stacked.loads[0].speed.tolist() == [-2.0, -2.0]
