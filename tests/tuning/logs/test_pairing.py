"""Logs matched with cases: loads that must have crossed, or stay on the beam."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from tests.tuning.small_rig import rig
from tuning import Log
from tuning.logs.pairing import check_loads

TIMES = np.linspace(0.0, 0.5, 51)
LOG = Log(TIMES, np.zeros((51, 1)), ("w",), ("deflection",), ("m",), "run.csv")


def case_with(load) -> jb.Case:
    """The small rig without its controller, crossed by a load."""
    return dataclasses.replace(rig(), controller=None, loads=(load,))


def test_a_load_that_stops_on_the_beam_need_not_leave_it():
    check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.5, deceleration=5.0)))


def test_a_load_that_leaves_the_beam_must_do_so_within_the_log():
    check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.5)))
    with pytest.raises(ValueError, match="before the first load has crossed at 0.6 s"):
        check_loads(LOG, case_with(jb.MovingMass(mass=0.5, speed=1.0)))
