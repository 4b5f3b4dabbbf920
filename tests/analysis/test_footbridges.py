"""Pedestrian streams against the closed form of a pinned beam, and people who stand in step."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.footbridges import comfort_class, harmonic_fractions, stream_response

LENGTH, MASS, DAMPING, WIDTH = 40.0, 2500.0, 0.02, 3.0
BRIDGE = jb.Case(jb.Beam(LENGTH, 10.4e9, MASS, damping_ratio=DAMPING, modes=2))


@pytest.mark.parametrize(
    ("density", "people", "in_step"),
    [("TC3", 60.0, 10.8 * np.sqrt(DAMPING * 60)), (1.5, 180.0, 1.85 * np.sqrt(180))],
)
def test_stream_on_a_pinned_beam(density, people, in_step):
    """2 p / (pi m zeta) of any mode, as |sin| has the mean 2 / pi."""
    found = stream_response(BRIDGE, density, WIDTH, reduction=[1.0, 0.25])
    assert_allclose(found.equivalent, in_step, rtol=1e-9)
    expected = 2 * 280 * in_step / LENGTH / (np.pi * MASS * DAMPING)
    assert_allclose(found.accelerations, [expected, expected / 4], rtol=1e-5)
    assert list(found.columns["comfort class"]) == [comfort_class(expected * s) for s in (1, 0.25)]


def test_people_in_step_have_the_acceleration_of_the_stream():
    """Thirty people of a share of the force each, in the direction of the second mode, in time."""
    found = stream_response(BRIDGE, "TC2", WIDTH, reduction=1.0)
    count = 30
    amplitude, pace = 280 * found.equivalent[1] / count, [found.frequencies[1]]
    people = [
        jb.VaryingForce(frequencies=pace, amplitudes=[amplitude], phases=[phase], position=at)
        for half, phase in ((0.0, 0.0), (LENGTH / 2, np.pi))
        for at in half + (np.arange(count // 2) + 0.5) * LENGTH / count
    ]
    run = jb.Run(6.0, sample_rate=200.0)  # six time constants
    case = jb.Case(BRIDGE.beam, loads=people, sensors=[jb.Sensor(10.0, "acceleration")], run=run)
    record = jb.simulate(case)
    last = np.asarray(record.sensor_values[record.times > 5.0, 0])
    assert_allclose(np.abs(last).max(), found.accelerations[1], rtol=0.01)


def test_modes_are_pushed_by_the_nearest_harmonic():
    """Modes of 2 and 8 Hz, the first and the fourth harmonic of a pace of 1.89 Hz (CSA S7)."""
    found = stream_response(BRIDGE, "TC3", WIDTH)
    assert_allclose(found.frequencies, [2.0, 8.0], rtol=2e-3)
    whole = stream_response(BRIDGE, "TC3", WIDTH, reduction=1.0)
    assert_allclose(found.accelerations / whole.accelerations, [1.0, 0.041 / 0.4], rtol=1e-12)


@pytest.mark.parametrize(
    ("density", "frequency", "of_weight"),
    [(1.0, 1.643, 0.4), (1.0, 0.82, 0.0), (1.0, 2.46, 0.4), (1.0, 2.47, 0.1), (0.2, 9.03, 0.041)]
    + [(0.2, 9.3, 0.027), (0.2, 11.3, 0.027), (0.2, 11.4, 0.0)],
)
def test_forces_of_harmonics(density, frequency, of_weight):
    """Paces of 1.643 and 2.063 Hz by hand."""
    found = harmonic_fractions(np.array([frequency]), density)
    assert_allclose(0.4 * found, of_weight, atol=1e-12)


def test_comfort_classes_and_wrong_numbers():
    assert [comfort_class(a) for a in (0.5, 0.51, 2.5, 2.6)] == ["CL1", "CL2", "CL3", ""]
    with pytest.raises(ValueError, match="no traffic class 'TC9'"):
        stream_response(BRIDGE, "TC9", WIDTH)
    with pytest.raises(ValueError, match="width must be positive"):
        stream_response(BRIDGE, "TC3", 0.0)
