"""Envelopes and dynamic amplification against the closed form of a moving force.

Run-up of vehicles on rough roads: decay by hand, peaks that do not depend on the start.
"""

import dataclasses
import tracemalloc

import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.critical_speeds import (
    cancellation_speeds,
    decay_rates,
    regular_spacing,
    resonance_speeds,
    run_up,
    with_run_up,
)
from jaxbeam.analysis.sections import amplification, envelope, record_amplification
from jaxbeam.case.loads.axles import Axles
from jaxbeam.cli.commands.sweep import _with_run_up

LENGTH, RIGIDITY, DENSITY, FORCE = 0.6, 11.68, 0.535, 5.0
POSITIONS = np.array([0.15, 0.3, 0.4])


def crossing(speed: float, modes: int = 4) -> jb.Case:
    """Moving force on an undamped pinned beam, with 0.1 s of free vibration."""
    return jb.Case(
        jb.Beam(length=LENGTH, flexural_rigidity=RIGIDITY, mass_per_length=DENSITY, modes=modes),
        loads=[jb.MovingForce(force=FORCE, speed=speed)],
        run=jb.Run(duration=LENGTH / speed + 0.1),
    )


def forced_deflection(speed: float, times, modes: int = 4):
    """Deflection (time, position) during the crossing: series of a moving force."""
    j = np.arange(1, modes + 1)
    omega = (j * np.pi / LENGTH) ** 2 * np.sqrt(RIGIDITY / DENSITY)
    drive = j * np.pi * speed / LENGTH
    t = times[:, None]
    q = np.sin(drive * t) - drive / omega * np.sin(omega * t)
    q = -2 * FORCE / (DENSITY * LENGTH) * q / (omega**2 - drive**2)
    return q @ np.sin(j[:, None] * np.pi * POSITIONS / LENGTH)


def free_deflection(speed: float, times, modes: int = 4):
    """Deflection (time, position) after the exit: free vibration of each mode."""
    j = np.arange(1, modes + 1)
    omega = (j * np.pi / LENGTH) ** 2 * np.sqrt(RIGIDITY / DENSITY)
    drive, end = j * np.pi * speed / LENGTH, LENGTH / speed
    scale = -2 * FORCE / (DENSITY * LENGTH) / (omega**2 - drive**2)
    coordinate = -scale * drive / omega * np.sin(omega * end)
    rate = scale * drive * (np.cos(drive * end) - np.cos(omega * end))
    phase = omega * (times[:, None] - end)
    q = coordinate * np.cos(phase) + rate / omega * np.sin(phase)
    return q @ np.sin(j[:, None] * np.pi * POSITIONS / LENGTH)


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_envelope_agrees_with_the_series(speed):
    end = LENGTH / speed
    on, after = np.linspace(0, end, 200_001), np.linspace(end, end + 0.1, 200_001)
    series = np.concatenate([forced_deflection(speed, on), free_deflection(speed, after)])
    assert_allclose(forced_deflection(speed, on[-1:]), free_deflection(speed, after[:1]), rtol=1e-9)
    found = envelope(crossing(speed), POSITIONS)
    scale = 1e-7 * np.abs(series).max()
    assert_allclose(found.lowest, series.min(axis=0), atol=scale)
    assert_allclose(found.highest, series.max(axis=0), atol=scale)
    assert np.all(np.asarray(found.highest) > 100 * scale)


def test_envelope_of_a_controlled_run_agrees_with_its_record():
    case = dataclasses.replace(
        crossing(2.0),
        actuators=[jb.PointForce(0.3)],
        sensors=[jb.Sensor(x) for x in POSITIONS],
        controller=jb.Feedback(gains=[2000.0], period=0.002),
    )
    found, record = envelope(case, POSITIONS), jb.simulate(case)
    largest = np.maximum(-np.asarray(found.lowest), found.highest)
    assert_allclose(largest, record.peak_deflection, rtol=1e-7)
    samples = np.asarray(record.deflection)
    assert np.all(samples.min(axis=0) >= found.lowest * (1 + 1e-9))
    assert np.all(samples.max(axis=0) <= found.highest * (1 + 1e-9) + 1e-12)
    assert np.all(np.abs(samples.max(axis=0) - found.highest) < 0.05 * largest)


def test_positions_off_the_beam_are_refused():
    with pytest.raises(ValueError, match="x must lie on the beam.* it is 0.7 m"):
        envelope(crossing(1.0), np.array([0.7]))


def test_amplification_of_slow_and_fast_forces():
    middle = np.array([LENGTH / 2])
    static = FORCE * LENGTH**3 / (48 * RIGIDITY)
    fast = amplification(crossing(15.0), middle)
    assert_allclose(fast, -envelope(crossing(15.0), middle).lowest / static, rtol=1e-12)
    assert 1.6 < fast[0] < 1.8  # near its largest, at 0.62 of the critical speed
    assert_allclose(amplification(crossing(0.05, modes=6), middle), 1.0, atol=3e-3)


def test_record_has_amplification_where_the_static_deflection_is_known():
    """At sensors of deflection, but not over a support, nor with rigid-body modes or control."""
    sensors = [jb.Sensor(0.3), jb.Sensor(0.6), jb.Sensor(0.2, "velocity"), jb.Sensor(0.3, "moment")]
    case = dataclasses.replace(crossing(2.0), sensors=sensors)
    at_sensor, *others, moment = record_amplification(jb.simulate(case))
    assert_allclose(at_sensor, amplification(case, [0.3])[0], rtol=1e-6)
    assert_allclose(moment, amplification(case, [0.3], quantity="moment")[0], rtol=1e-4)
    assert others == [None, None]
    free = dataclasses.replace(case, beam=dataclasses.replace(case.beam, ends="free-free"))
    free = dataclasses.replace(free, sensors=sensors[:1])
    assert record_amplification(jb.simulate(free)) == [None]


def test_envelope_of_moments_against_the_record_and_amplification_of_a_slow_force():
    case = crossing(0.5, modes=3)
    positions, x = np.array([0.15, 0.3]), 0.3
    slow = envelope(case, positions, quantity="moment")
    static = FORCE * positions * (LENGTH - positions) / LENGTH
    assert_allclose(slow.highest, static, rtol=0.02)
    assert list(slow.columns) == ["position (m)", "lowest moment (N m)", "highest moment (N m)"]
    found = amplification(case, positions, quantity="moment")
    assert_allclose(found, np.asarray(slow.highest) / static, rtol=1e-9)
    stress = amplification(case, positions, quantity="stress", section_modulus=-2.0)
    assert_allclose(stress, found, rtol=1e-9)
    fast = crossing(4.0, modes=3)
    record = jb.simulate(fast, np.linspace(0.0, float(fast.run.duration), 4001))
    moments = np.asarray(record.bending_moment(x))
    low, high = envelope(fast, [x], quantity="moment")
    assert_allclose([low[0], high[0]], [moments.min(), moments.max()], rtol=1e-3)
    with pytest.raises(ValueError, match="no amplification of 'velocity'"):
        amplification(fast, [x], quantity="velocity")


def test_amplification_of_the_shear_force_under_a_slow_force():
    """Static: F (1 - x / L) just after the force has passed x, F x / L just before it."""
    x = np.array([0.15, 0.4])
    low, high = envelope(crossing(0.1, modes=3), x, quantity="shear")
    assert_allclose(high, FORCE * (1 - x / LENGTH), rtol=0.03)
    assert_allclose(low, -FORCE * x / LENGTH, rtol=0.03)
    found = amplification(crossing(0.1, modes=3), x, quantity="shear")
    static = FORCE * np.maximum(1 - x / LENGTH, x / LENGTH)
    assert_allclose(found, np.maximum(high, -low) / static, rtol=1e-6)  # both sides of x


def test_an_envelope_without_positions_holds_the_largest_values():
    """Under a slow force F L / 4 at midspan; moments at the ends are none."""
    found = envelope(crossing(0.1, modes=3), quantity="moment")
    best = int(np.argmax(found.highest))
    assert_allclose(found.positions[best], LENGTH / 2, rtol=0.05)  # 0.25 % less moment there
    assert_allclose(found.highest[best], FORCE * LENGTH / 4, rtol=0.02)
    assert_allclose(found.positions[[0, -1]], [0.0, LENGTH], atol=1e-9)
    assert_allclose(found.highest[[0, -1]], 0.0, atol=1e-3 * FORCE * LENGTH)


def test_many_positions_are_taken_in_blocks_that_change_no_value():
    """Each axle passes each position: their steps were held at once, in 0.7 GB of arrays here."""
    axles = Axles(offsets=0.1 * np.arange(6), forces=[3.0, 1.0, 2.0] * 2, speed=3.0)
    case = dataclasses.replace(crossing(3.0), loads=(axles,))
    positions = np.linspace(0.0, LENGTH, 101)
    tracemalloc.start()
    many = envelope(case, positions, quantity="moment")
    largest = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert largest < 0.2e9
    chosen = [1, 37, 38, 100]
    few = envelope(case, positions[chosen], quantity="moment")
    assert_allclose(many.lowest[chosen], few.lowest, rtol=1e-6, atol=1e-9)
    assert_allclose(many.highest[chosen], few.highest, rtol=1e-6, atol=1e-9)


# Resonance and cancellation speeds, against coach lengths and simulated free vibration.

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


CAR = jb.QuarterCar(
    speed=20.0,
    body_mass=17000.0,
    axle_mass=600.0,
    suspension_stiffness=4e5,
    suspension_damping=1e4,
    tyre_stiffness=1.75e6,
)
ROUGH_CASE = jb.Case(
    jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.02, modes=3),
    sensors=[jb.Sensor(10.0)],
    loads=[CAR],
    profile=jb.profiles.ISO8608Profile("C", seed=2),
    run=jb.Run(1.5, sample_rate=200.0),
)


def test_decay_of_a_quarter_car_by_its_matrices():
    m, c = np.diag([17000.0, 600.0]), 1e4 * np.array([[1, -1], [-1, 1]])
    k = np.array([[4e5, -4e5], [-4e5, 4e5 + 1.75e6]])
    inverse = np.linalg.inv(m)
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [-inverse @ k, -inverse @ c]])
    rate = -scipy.linalg.eigvals(A).real.max()
    assert decay_rates(ROUGH_CASE) == [pytest.approx(rate, rel=1e-9)]
    assert run_up(ROUGH_CASE, 0.02)[0] == pytest.approx(20.0 * np.log(50.0) / rate, rel=1e-9)
    assert run_up(ROUGH_CASE, 0.02, [10.0, -30.0])[0] == pytest.approx(
        1.5 * run_up(ROUGH_CASE, 0.02)[0]
    )


@pytest.mark.parametrize("speed", [20.0, -20.0])
def test_peaks_do_not_depend_on_the_start(speed):
    """Half a per mille of the motion left changes no peak by a per mille; at the end it does."""
    case = dataclasses.replace(ROUGH_CASE, loads=[dataclasses.replace(CAR, speed=speed)])
    far, farther = (with_run_up(case, share) for share in (5e-4, 1e-5))
    peaks = [float(jb.simulate(one).peak_deflection[0]) for one in (case, far, farther)]
    assert peaks[1] == pytest.approx(peaks[2], rel=1e-3)
    assert abs(peaks[0] / peaks[2] - 1) > 1e-3
    assert float(far.run.duration) > 1.5 + run_up(case, 5e-4)[0] / 20.0


def test_speeds_of_a_sweep():
    """The fastest one decides on the distance, the slowest on the duration."""
    found = _with_run_up(ROUGH_CASE, {"loads.0.speed": ["36 km/h", "90 km/h"], "profile.seed": [1]})
    start = 10.0 + run_up(ROUGH_CASE, speeds=[25.0])[0]
    slowest = dataclasses.replace(found.loads[0], speed=10.0).trajectory(np.array(20.0))
    assert slowest.kinematics(np.zeros(()))[0] == pytest.approx(-start)
    assert found.profile.switch_on == pytest.approx([-start, 10.0 - start])
    assert float(found.run.duration) == pytest.approx(1.5 + start / 10.0)


def test_loads_meet_on_the_bridge_as_without_a_run_up():
    """Of other speeds, braking, without springs, by tables; all move as they would, but later."""
    table = {"times": [0.0, 1.0, 2.0], "positions": [-3.0, 5.0, 9.0]}
    loads = [
        CAR,
        dataclasses.replace(CAR, speed=12.0, entry_time=0.4, deceleration=3.0),
        dataclasses.replace(CAR, speed=15.0, start_position=-4.0),
        jb.MovingForce(force=1e3, speed=-30.0, entry_time=0.2),
        jb.MovingMass(mass=100.0, **table),
        jb.VaryingForce(
            1e3, [2.0], [500.0], force_times=[0.1, 0.9], forces=[0.0, 2e3], position=7.0
        ),
        jb.Pedestrian(pace=1.8, speed=1.5, step_time=0.1),
    ]
    before = dataclasses.replace(ROUGH_CASE, loads=loads)
    after = with_run_up(before)
    delay = float(after.run.duration) - 1.5
    assert delay == pytest.approx((run_up(ROUGH_CASE)[0] + 10.0) / 12.0)
    times = np.linspace(0.0, 1.5, 31)
    for one, other in zip(before.loads, after.loads, strict=True):
        moved = one.trajectory(np.array(20.0)).kinematics(times)
        assert_allclose(
            other.trajectory(np.array(20.0)).kinematics(times + delay), moved, atol=1e-9
        )
        for wheel, history in one.force_histories().items():
            later = other.force_histories()[wheel].at(times + delay)
            assert_allclose(later, history.at(times), atol=1e-7)
        if one.times is None and other.speed is not None and "Car" in type(one).__name__:
            start = other.trajectory(np.array(20.0)).kinematics(np.zeros(()))[0]
            assert start <= float(after.profile.switch_on[0]) + 1e-9


def test_loads_that_need_none_and_refusals():
    force = dataclasses.replace(ROUGH_CASE, loads=[jb.MovingForce(force=1e3, speed=20.0)])
    assert with_run_up(force) is force
    stiff = dataclasses.replace(CAR, suspension_damping=0.0)
    with pytest.raises(ValueError, match=r"loads\.0 never forgets how it started"):
        with_run_up(dataclasses.replace(ROUGH_CASE, loads=[stiff]))
    both = [CAR, dataclasses.replace(CAR, speed=-20.0)]
    with pytest.raises(ValueError, match="enter at both ends"):
        with_run_up(dataclasses.replace(ROUGH_CASE, loads=both))
    with pytest.raises(ValueError, match="share lies between"):
        run_up(ROUGH_CASE, 1.0)
