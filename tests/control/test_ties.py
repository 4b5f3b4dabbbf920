"""Laws act at the sample at which a time falls, whatever the rounding of either.

Events are at samples in exact fractions. The numbers of a case lead to them by sums and quotients,
which round otherwise than the product of a sample's number and the period.
"""

import itertools
from fractions import Fraction

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.controller import Measurement
from jaxbeam.control.crossing_gains import GainSchedule
from jaxbeam.control.load_identification import GateIdentifier
from jaxbeam.model.load_set import load_set
from jaxbeam.numerics.finite_horizon import GainTable

PERIODS = [Fraction(1, 10), Fraction(1, 3), Fraction(1, 30), Fraction(7, 1000)]
LENGTH, SPEED = Fraction(6, 10), Fraction(7)
CROSSING, GATES = LENGTH / SPEED, np.array([-0.2, -0.1])
READING = Measurement(np.full(1, -1.0), np.zeros(1), np.zeros(1))
FROM, BEFORE, UP_TO = [False, True, True], [True, False, False], [True, True, False]


def case_of(entry: Fraction, controller=None) -> jb.Case:
    return jb.Case(
        jb.Beam(float(LENGTH), 13.2, 0.81, 0.03, modes=1),
        actuators=[jb.PointForce(0.3)],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.4, speed=float(SPEED), entry_time=float(entry))],
        controller=controller,
    )


def commands(entry, controller):
    """Whether there is a command at a time (s)."""
    law = controller.law(jb.state_space(case_of(entry, controller)))
    return lambda t: bool(law.step(law.initial_state(), READING, t).command[0])


def feedforward(period, entry, shares, **settings):
    table = {"gates": GATES, "shares": shares, "values": [[1.0, 1.0]]}
    return commands(entry, jb.Feedforward(**table, **settings, period=float(period)))


def prescribed(period, start, end):
    table = {"times": [float(start), float(end)], "values": [[1.0, 1.0]]}
    return commands(Fraction(0), jb.Prescribed(offsets=[0.0], **table, period=float(period)))


def identifier(entry, name):
    trajectory = load_set(case_of(entry)).trajectories[0]
    one, gate_times = np.ones((1, 1)), np.asarray(trajectory.passage_times(GATES))[:2]
    numbers = np.asarray(float(LENGTH)), np.asarray(9.81), one, one, np.zeros(1), np.asarray(0.3)
    law = GateIdentifier(*numbers, sensor_indices=(0,), gates=GATES, gate_times=gate_times)
    return lambda t: bool(getattr(law.estimate(np.ones(2), t), name))


def gains(entry, table, final):
    """Whether there is a gain at a time (s); the table has equal intervals of a crossing."""
    start, end = load_set(case_of(entry)).entry_exit_times()[0]
    intervals = np.reshape(table, (-1, 1, 1, 1))
    breakpoints = np.arange(len(intervals) + 1) / len(intervals)
    parts = GainTable(breakpoints, intervals), np.full((1, 1), final)
    law = GainSchedule(*parts, np.zeros(0), start, end)
    return lambda t: bool(law.gain(t)[0, 0])


def on_beam(entry):
    loads = load_set(case_of(entry))
    return lambda t: bool(loads.on_beam(t)[0])


SECOND_GATE = Fraction(1, 10) / SPEED  # before entry
WIDE, SHOWN = [-9.0, 9.0], {"confirmation": 1e-5}
# What a time and the period decide: whether it is so before, at and after the time.
DECISIONS = {
    "second gate": (lambda t, p: feedforward(p, t + SECOND_GATE, WIDE), FROM),
    "gate of a shown load": (lambda t, p: feedforward(p, t + SECOND_GATE, WIDE, **SHOWN), FROM),
    "last showing": (lambda t, p: feedforward(p, t - CROSSING / 4, WIDE, **SHOWN), UP_TO),
    "start of positions": (lambda t, p: feedforward(p, t, [0.0, 9.0]), FROM),
    "end of positions": (lambda t, p: feedforward(p, t - CROSSING, [-9.0, 1.0]), UP_TO),
    "start of times": (lambda t, p: prescribed(p, t, t + 1), FROM),
    "end of times": (lambda t, p: prescribed(p, t - 1, t), UP_TO),
    "speed by gates": (lambda t, p: identifier(t + SECOND_GATE, "speed_identified"), FROM),
    "mass by gates": (lambda t, p: identifier(t - CROSSING * 3 / 10, "mass_identified"), FROM),
    "gains from entry": (lambda t, p: gains(t, [1.0], 1.0), FROM),
    "gains from a third": (lambda t, p: gains(t - CROSSING / 3, [0.0, 1.0, 1.0], 1.0), FROM),
    "gains up to exit": (lambda t, p: gains(t - CROSSING, [1.0], 0.0), BEFORE),
    "gains from exit": (lambda t, p: gains(t - CROSSING, [0.0], 1.0), FROM),
    "load on the beam": (lambda t, p: on_beam(t), FROM),
    "load off the beam": (lambda t, p: on_beam(t - CROSSING), BEFORE),
}


@pytest.mark.parametrize("name", DECISIONS)
def test_the_sample_decides_not_its_rounding(name):
    decide, expected = DECISIONS[name]
    wrong = []
    for period, sample in itertools.product(PERIODS, range(3, 60, 4)):
        time = sample * period
        if time > CROSSING:
            holds = decide(time, period)
            times = float(time) * (1 - 1e-6), sample * float(period), float(time) * (1 + 1e-6)
            found = [holds(np.asarray(t)) for t in times]
            wrong += [] if found == expected else [(float(period), sample, found)]
    assert not wrong
