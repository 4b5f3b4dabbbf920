"""Internal-model control: against scipy's filters and closed forms."""

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


def beam_case(controller=LAW, **sensor):
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
    """Static deflection at 0.3 m (m/V): sum over sine modes of the moments at the patch ends."""
    k = np.arange(1, MODES + 1) * np.pi / LENGTH
    moments = k * (np.cos(k * START) - np.cos(k * END))
    return np.sum(MOMENT * moments * np.sin(k * 0.3) * 2 / (LENGTH * RIGIDITY * k**4))


def test_commands_by_the_table_for_readings_without_the_lift():
    """Computed from the record of a run, with scipy's filter of the lift."""
    record = jb.simulate(beam_case(noise=np.asarray(4e-6)))
    commands = np.asarray(record.command)[:, 0]
    sections = scipy.signal.butter(4, 10.0, fs=100.0, output="sos")
    previous = np.append(0.0, commands[:-1])  # until the sample
    filtered_lift = scipy.signal.sosfilt(sections, lift() * previous)
    load_deflection = record.measured[:, 0] - 0.9 * filtered_lift
    expected = np.interp(load_deflection, READINGS, VALUES[0])
    assert commands.max() > 6.0
    # The command of a sample begins two samples later; limits are not reached.
    assert_allclose(commands[2:], expected[:-2], atol=1e-6)


def test_frequency_responses_of_notches():
    controller = dataclasses.replace(LAW, notches=[16.0, 27.0], notch_damping=0.4)
    made = controller.law(jb.state_space(beam_case(controller))).notch_sections
    # 1 at rest, 0 at its frequency; between, that of the analogue notch at the warped frequency.
    for hertz, section in zip([16.0, 27.0], np.asarray(made), strict=True):
        angular_frequency, at = (
            2 * 100.0 * np.tan(np.pi * hertz / 100.0),
            np.array([0.0, 9.0, hertz]),
        )
        analogue = (
            [1.0, 0.0, angular_frequency**2],
            [1.0, 0.8 * angular_frequency, angular_frequency**2],
        )
        warped = 2 * 100.0 * np.tan(np.pi * at / 100.0)
        _, expected = scipy.signal.freqs(*analogue, worN=warped)
        _, found = scipy.signal.freqz(section[:3], section[3:], worN=at, fs=100.0)
        assert_allclose(found, expected, atol=1e-12)
    with pytest.raises(
        ValueError, match="notches must be below half the sampling frequency, 50 Hz"
    ):
        jb.simulate(beam_case(dataclasses.replace(LAW, notches=[16.0, 60.0])))


def test_stable_where_plain_feedback_of_the_same_slope_is_unstable():
    steep, times = 3e4, np.zeros(1)  # V/m; the load is not on the beam yet
    readings, values = [-2e-4, 2e-4], [[6.0, -6.0]]
    internal_model = jb.InternalModel(readings, values, period=0.01, delay=0.02)
    feedback = jb.Feedback([steep], period=0.01, delay=0.02)
    low_pass = jb.Filter(10.0, order=10)
    rates = [
        frozen_poles(
            dataclasses.replace(beam_case(law), sensors=(jb.Sensor(0.3, filter=low_pass),)), times
        ).largest_real_part[0]
        for law in (internal_model, feedback)
    ]
    assert rates[0] < -1.0 and rates[1] > 1.0


def test_case_file_keeps_the_controller():
    case = beam_case()
    assert case_to_dict(case)["controller"]["kind"] == "internal-model"
    restored = case_from_dict(case_to_dict(case))
    assert_allclose(restored.controller.readings, READINGS)
    assert_allclose(restored.controller.values, VALUES)


ERRORS = [
    ({"period": None, "delay": None}, {}, "period must be given: kind 'internal-model' acts"),
    ({"values": np.ones((1, 3))}, {}, "as many entries as readings has, 4"),
    ({}, {"quantity": "velocity"}, "needs a sensor of deflection for each of 1 actuators"),
]


@pytest.mark.parametrize(
    ("changes", "sensor", "message"), ERRORS, ids=["period", "values", "sensor"]
)
def test_errors_of_settings(changes, sensor, message):
    with pytest.raises(ValueError, match=message):
        jb.simulate(beam_case(dataclasses.replace(LAW, **changes), **sensor))
