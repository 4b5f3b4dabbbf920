"""Resonance and cancellation speeds, against coach lengths and simulated free vibration."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.critical_speeds import (
    cancellation_speeds,
    regular_spacing,
    resonance_speeds,
)
from jaxbeam.case.loads.axles import Axles

BEAM = jb.Beam(25.0, 3.0e10, 15000.0, damping_ratio=0.0, modes=2)
CASE = jb.Case(BEAM, sensors=[jb.Sensor(12.5), jb.Sensor(6.25)])
COACHES = range(18, 28)  # m: EN 1991-2, table 6.3


def spacing(load):
    return regular_spacing(jb.Case(BEAM, loads=[load]))


@pytest.mark.parametrize("number", range(1, 11))
def test_spacing_of_high_speed_trains_is_the_length_of_a_coach(number):
    load = Axles(train=f"HSLM-A{number}", speed=50.0)
    assert spacing(load) == pytest.approx(COACHES[number - 1], abs=1e-9)


def test_spacing_of_rows_and_of_single_loads():
    wagons = Axles(train="EN15528-D2", count=6, speed=50.0)
    assert spacing(wagons) == pytest.approx(14.05)
    assert spacing(jb.MovingMass(mass=1.0, speed=1.0)) is None
    assert spacing(Axles(train="HL93-truck", speed=1.0)) is None


def test_resonance_speeds():
    """f_1 = pi / (2 L^2) sqrt(EI / m) = 3.5543 Hz of the beam; 18 m in one, two, ... periods."""
    first = np.pi / (2 * 25.0**2) * np.sqrt(3.0e10 / 15000.0)
    found = resonance_speeds(CASE, 18.0, 15.0, 70.0)
    assert_allclose([one.speed for one in found], 18.0 * first / np.arange(1, 5), rtol=1e-9)
    assert [one.order for one in found] == [1, 2, 3, 4]
    assert {one.mode for one in resonance_speeds(CASE, 18.0, 15.0, 70.0, count=2)} == {1, 2}


def free_vibration(speed: float, mode: int) -> float:
    """Amplitude (m kg^0.5) of a mode after a force has crossed."""
    case = jb.Case(
        BEAM,
        sensors=CASE.sensors,
        loads=[jb.MovingForce(force=1e5, speed=speed)],
        run=jb.Run(duration=25.0 / speed + 0.5),
    )
    record = jb.simulate(case)
    omega = 2 * np.pi * jb.modes(case).frequencies[mode - 1]
    return float(np.hypot(record.coordinates[-1, mode - 1], record.rates[-1, mode - 1] / omega))


def test_nothing_is_left_at_cancellation_speeds():
    found = cancellation_speeds(CASE, 30.0, 200.0, count=2)
    assert [(one.mode, one.order) for one in found] == [(1, 3), (1, 5), (2, 4), (2, 6), (2, 8),
        (2, 10), (2, 12), (2, 14), (2, 16), (2, 18), (2, 20), (2, 22)]  # fmt: skip
    for one in found[:6]:
        left = free_vibration(one.speed, one.mode)
        assert left < 1e-4 * free_vibration(1.07 * one.speed, one.mode)


def test_other_beams_have_no_closed_form():
    clamped = jb.Beam(25.0, 3.0e10, 15000.0, ends="clamped-clamped", modes=1)
    assert cancellation_speeds(jb.Case(clamped), 10.0, 100.0) == []
    assert cancellation_speeds(jb.Case(BEAM, supports=[jb.Support(10.0)]), 10.0, 100.0) == []


@pytest.mark.parametrize(("lowest", "highest"), [(10.0, 60.0), (22.0, 178.0), (12.5, 20.0)])
def test_every_speed_between_two_and_no_other(lowest, highest):
    """2 L f_k / (k + 2 i) and d f_k / i by brute force over a hundred orders."""
    for mode in (1, 2):
        frequency = mode**2 * np.pi / (2 * 25.0**2) * np.sqrt(3.0e10 / 15000.0)
        for found, length, orders in (
            (cancellation_speeds(CASE, lowest, highest, count=2), 50.0, range(mode + 2, 100, 2)),
            (resonance_speeds(CASE, 18.0, lowest, highest, count=2), 18.0, range(1, 100)),
        ):
            # Orders k - 2, k - 4, ... > 0 are none for the first two modes.
            expected = [length * frequency / i for i in orders]
            expected = [speed for speed in expected if lowest <= speed <= highest]
            assert_allclose([one.speed for one in found if one.mode == mode], expected, rtol=1e-9)
