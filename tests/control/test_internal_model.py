"""Commands that answer the deflection under the load: against scipy's filters and closed forms."""

import dataclasses

import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.files.case_file import case_from_dict, case_to_dict

LENGTH, RIGIDITY, MODES = 0.6, 13.2, 3
START, END, MOMENT = 0.25, 0.35, 8.3e-4 * 0.3 * 200
READINGS = 1e-3 * np.array([-0.4, -0.1, 0.0, 0.2])
VALUES = [[7.0, 3.0, 0.0, -2.0]]
LAW = jb.InternalModel(READINGS, VALUES, compensation=0.9, period=0.01, delay=0.02)
SMOOTH = jb.Filter(10.0, order=4)


def rig(controller=LAW, **sensor):
    patch = jb.Patch(START, END, 8.3e-4, correction=0.3, amplifier_gain=200.0, limits=[-2.5, 7.5])
    return jb.Case(
        jb.Beam(LENGTH, RIGIDITY, 0.81, 0.03, modes=MODES),
        actuators=[patch],
        sensors=[jb.Sensor(0.3, filter=SMOOTH, **sensor)],
        loads=[jb.MovingMass(mass=0.4, speed=1.0, entry_time=0.05)],
        controller=controller,
        run=jb.Run(duration=0.8, sample_rate=100.0),
    )


def lift():
    """Static deflection at 0.3 m per volt: a sum over sine modes, of moments at the patch ends."""
    k = np.arange(1, MODES + 1) * np.pi / LENGTH
    moments = k * (np.cos(k * START) - np.cos(k * END))
    return np.sum(MOMENT * moments * np.sin(k * 0.3) * 2 / (LENGTH * RIGIDITY * k**4))


def test_commands_are_those_of_the_table_for_readings_without_the_own_lift():
    """Replayed from what a run recorded, with a filter of scipy's for the lift."""
    record = jb.simulate(rig(noise=np.asarray(4e-6)))
    sent = np.asarray(record.command)[:, 0]
    sections = scipy.signal.butter(4, 10.0, fs=100.0, output="sos")
    before = np.append(0.0, sent[:-1])  # in force until the tick
    caused = scipy.signal.sosfilt(sections, lift() * before)
    wanted = np.interp(record.measured[:, 0] - 0.9 * caused, READINGS, VALUES[0])
    assert sent.max() > 6.0
    # The command of a tick begins two ticks later; limits are not reached.
    assert_allclose(sent[2:], wanted[:-2], atol=1e-6)


def test_notches_are_the_analogue_ones_warped_to_their_frequencies():
    law = dataclasses.replace(LAW, notches=[16.0, 27.0], notch_damping=0.4)
    made = law.init(jb.state_space(rig(law))).notch_sections
    # At rest 1, at its frequency 0, and in between what the analogue one gives a warped frequency.
    for hertz, section in zip([16.0, 27.0], np.asarray(made), strict=True):
        turn, at = 2 * 100.0 * np.tan(np.pi * hertz / 100.0), np.array([0.0, 9.0, hertz])
        analogue = [1.0, 0.0, turn**2], [1.0, 0.8 * turn, turn**2]
        warped = 2 * 100.0 * np.tan(np.pi * at / 100.0)
        _, expected = scipy.signal.freqs(*analogue, worN=warped)
        _, found = scipy.signal.freqz(section[:3], section[3:], worN=at, fs=100.0)
        assert_allclose(found, expected, atol=1e-12)
    with pytest.raises(
        ValueError, match="notches must be below half the sampling frequency, 50 Hz"
    ):
        jb.simulate(rig(dataclasses.replace(LAW, notches=[16.0, 60.0])))


def test_it_may_be_steep_where_plain_feedback_of_the_same_slope_is_not_stable():
    steep, times = 3e4, np.zeros(1)  # V/m; the load is not on the beam yet
    readings, values = [-2e-4, 2e-4], [[6.0, -6.0]]
    relief = jb.InternalModel(readings, values, period=0.01, delay=0.02)
    plain = jb.Feedback([steep], period=0.01, delay=0.02)
    smooth = jb.Filter(10.0, order=10)
    rates = [
        frozen_poles(
            dataclasses.replace(rig(law), sensors=(jb.Sensor(0.3, filter=smooth),)), times
        ).largest_real_part[0]
        for law in (relief, plain)
    ]
    assert rates[0] < -1.0 and rates[1] > 1.0


def test_in_a_file():
    case = rig()
    assert case_to_dict(case)["controller"]["kind"] == "relief"
    again = case_from_dict(case_to_dict(case))
    assert_allclose(again.controller.readings, READINGS)
    assert_allclose(again.controller.values, VALUES)


BAD = [
    ({"period": None, "delay": None}, {}, "period must be given: kind 'relief' acts at its ticks"),
    ({"values": np.ones((1, 3))}, {}, "as many entries as readings has, 4"),
    ({}, {"quantity": "velocity"}, "needs a sensor of deflection for each of 1 actuators"),
]


@pytest.mark.parametrize(("changes", "sensor", "message"), BAD, ids=["period", "values", "sensor"])
def test_what_does_not_fit_is_refused(changes, sensor, message):
    with pytest.raises(ValueError, match=message):
        jb.simulate(rig(dataclasses.replace(LAW, **changes), **sensor))
