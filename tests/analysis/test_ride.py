"""Ride measures against tabulated weights, closed forms for sines, and filters of scipy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.ride import sperling_weighting, vertical_weighting
from tests.differences import central

# Weights W_k (1/1000) at thirds of octaves from 0.5 to 80 Hz: table 3 of ISO 2631-1, as in
# `TimeHisResult` of the open program RideComfortUC. (Copies of the table that begin with 482 at
# 0.5 Hz are shifted by three thirds: the standard has 482 at 1 Hz.)
TABLE = [418, 459, 477, 482, 484, 494, 531, 631, 804, 967, 1039, 1054, 1036, 988, 902, 768, 636,
         513, 405, 314, 246, 186, 132]  # fmt: skip
CENTRES = np.array([0.5, 0.63, 0.8, 1, 1.25, 1.6, 2, 2.5, 3.15, 4, 5, 6.3, 8, 10, 12.5, 16, 20,
                    25, 31.5, 40, 50, 63, 80])  # fmt: skip
TIMES = np.arange(40001) / 1000.0
QUARTER_CAR = jb.QuarterCar(
    16e3, 1.2e3, 8e5, 2e4, 3.5e6, 1e4, speed=20.0, start_position=-20.0
)  # fmt: skip
CASE = jb.Case(
    jb.Beam(20.0, 4.8e10, 18358.0, 0.02, modes=2),
    loads=[QUARTER_CAR],
    profile=jb.profiles.SineProfile(amplitude=0.003, wavelength=10.0),
    run=jb.Run(2.5, sample_rate=200.0),
)


def sine(frequency, amplitude=1.0):
    return amplitude * np.sin(2 * np.pi * frequency * TIMES)


def test_weights_are_those_of_the_table():
    assert_allclose(1e3 * np.abs(vertical_weighting(CENTRES)), TABLE, rtol=0, atol=0.75)


@pytest.mark.parametrize("band", range(0, 23, 3))
def test_a_steady_sine_is_weighted_as_tabulated(band):
    """The amplitude of the second half, over whole periods, against the table."""
    frequency = CENTRES[band]
    weighted = jb.ride.weighted_acceleration(TIMES, sine(frequency))[20000:]
    periods = int(20.0 * frequency)
    whole = TIMES[20000:] <= 20.0 + periods / frequency
    basis = np.exp(-2j * np.pi * frequency * TIMES[20000:][whole])
    amplitude = 2 * np.abs(np.mean(weighted[whole] * basis))
    assert amplitude == pytest.approx(TABLE[band] / 1e3, rel=1e-3, abs=0.75e-3)


def test_filters_begin_at_rest_and_are_causal():
    """A smooth pulse against the same transfer function in time by scipy."""
    times = np.arange(4001) / 1000.0
    pulse = np.exp(-(((times - 1.0) / 0.05) ** 2))
    w = 2 * np.pi * np.array([0.4, 100.0, 12.5, 12.5, 2.37, 3.35])
    root = np.sqrt(2.0)
    sections = [
        ([1.0, 0.0, 0.0], [1.0, root * w[0], w[0] ** 2]),
        ([1.0], [1 / w[1] ** 2, root / w[1], 1.0]),
        ([1 / w[2], 1.0], [1 / w[3] ** 2, 1 / (0.63 * w[3]), 1.0]),
        (
            (w[4] / w[5]) ** 2 * np.array([1 / w[4] ** 2, 1 / (0.91 * w[4]), 1.0]),
            [1 / w[5] ** 2, 1 / (0.91 * w[5]), 1.0],
        ),
    ]
    expected = pulse
    for numerator, denominator in sections:
        expected = scipy.signal.lsim((numerator, denominator), expected, times)[1]
    found = jb.ride.weighted_acceleration(times, pulse)
    assert_allclose(found, expected, rtol=0, atol=2e-4 * np.max(np.abs(expected)))
    assert_allclose(found[:500], 0.0, atol=1e-9)


def test_rms_and_dose_of_a_sine():
    """a W / sqrt(2), and a W (3 T / 8)^(1/4); the start makes the difference of a thousandth."""
    gain = 3.0 * np.abs(vertical_weighting(8.0))
    assert jb.ride.weighted_rms(TIMES, sine(8.0, 3.0)) == pytest.approx(gain / np.sqrt(2), rel=2e-3)
    dose = gain * (3 / 8 * TIMES[-1]) ** 0.25
    assert jb.ride.vibration_dose(TIMES, sine(8.0, 3.0)) == pytest.approx(dose, rel=2e-3)


@pytest.mark.parametrize("frequency", [0.5, 1.0, 5.4, 12.0, 29.0])
def test_sperling_index_of_a_sine(frequency):
    """W_z = (B a)^(2 / 6.67) with a in cm/s^2; 4.42 a_rms^0.3 after Forstberg's equation 3.1."""
    B = sperling_weighting(frequency)
    found = jb.ride.sperling_index(TIMES[:-1], sine(frequency, 0.7)[:-1])
    assert found == pytest.approx((70.0 * B) ** (2 / 6.67), rel=1e-10)
    assert found == pytest.approx(4.42 * (0.7 * B / np.sqrt(2)) ** 0.3, rel=2e-3)


def test_sperling_weighting():
    """Another form of B^2, up to its factor, of the test of David Roberts's module on GitHub.

    2.10173 ((7.97828 f^4 + 243.944 f^2) / (f^6 - 28.006 f^4 + 1393.82 f^2 + 738.422))^0.15 is the
    index of a sine of 1 m/s^2 there, with 0.2777 for 0.277 in B and 4.42 a^0.3 of a rms.
    """
    f = np.array([0.5, 1.0, 3.0, 6.0, 10.0, 25.0])
    square = f**2
    other = (7.97828 * square**2 + 243.944 * square) / (
        square**3 - 28.006 * square**2 + 1393.82 * square + 738.422
    )
    ratio = sperling_weighting(f) ** 2 / other
    assert_allclose(ratio, ratio[1], rtol=0.02)
    assert f[np.argmax(sperling_weighting(f))] == 6.0  # people are most sensitive near 5 Hz
    assert sperling_weighting(100.0) < 0.1


def test_frequencies_outside_of_the_band_do_not_count():
    assert jb.ride.sperling_index(TIMES[:-1], sine(40.0)[:-1]) < 0.05
    assert jb.ride.sperling_index(TIMES[:-1], sine(0.25)[:-1]) < 0.05


def test_measures_of_several_histories_at_once():
    histories = np.stack([sine(2.0), sine(7.0), sine(20.0)], axis=1)
    for measure in (jb.ride.weighted_rms, jb.ride.vibration_dose, jb.ride.sperling_index):
        single = [measure(TIMES, histories[:, i]) for i in range(3)]
        assert_allclose(measure(TIMES, histories), single, rtol=1e-12)


def test_measures_of_a_quarter_car_on_a_sine_profile():
    """Before the beam the road is a sine: unloading and weighted rms against its transfer function.

    A long approach, of which the last two seconds are steady.
    """
    car = dataclasses.replace(QUARTER_CAR, start_position=-200.0)
    case = dataclasses.replace(CASE, loads=[car], run=jb.Run(9.5, sample_rate=400.0))
    record = jb.simulate(case)
    ride = jb.ride.ride_measures(record)
    assert ride.bodies == ["loads.0 body", "loads.0 axle"]
    vehicle = car.vehicle(np.float64(9.81))
    w = 2 * np.pi * 20.0 / 10.0
    drive = 0.003 * (vehicle.contact_stiffness + 1j * w * vehicle.contact_damping)
    dynamic = vehicle.full_stiffness + 1j * w * vehicle.full_damping - w**2 * vehicle.mass
    u = np.linalg.solve(dynamic, vehicle.wheel_map.T @ drive)
    steady = np.asarray(record.body_acceleration)[3000:3800]
    assert_allclose(np.std(steady, axis=0), w**2 * np.abs(u) / np.sqrt(2), rtol=1e-3)
    weighted = jb.ride.weighted_acceleration(record.times, record.body_acceleration)[3000:3800]
    expected = np.abs(vertical_weighting(2.0)) * w**2 * np.abs(u) / np.sqrt(2)
    assert_allclose(np.std(weighted, axis=0), expected, rtol=2e-3)
    force = drive - (vehicle.contact_stiffness + 1j * w * vehicle.contact_damping) * (
        vehicle.wheel_map @ u
    )
    share = np.abs(force) / vehicle.static_loads
    lowest = 1 - np.min(np.asarray(record.contact_force)[3000:3800]) / vehicle.static_loads
    assert_allclose(lowest, share, rtol=2e-3)
    assert ride.wheel_unloading[0] >= lowest[0]


def test_unloading_of_plain_wheels():
    force = jb.simulate(dataclasses.replace(CASE, loads=[jb.MovingForce(1e4, speed=20.0)]))
    assert_allclose(jb.ride.wheel_unloading(force), [0.0], atol=1e-12)
    mass = jb.simulate(dataclasses.replace(CASE, loads=[jb.MovingMass(1e4, speed=20.0)]))
    weight = 1e4 * float(CASE.run.gravity)
    expected = 1 - np.asarray(mass.lowest_contact_force) / weight
    assert_allclose(jb.ride.wheel_unloading(mass), expected, rtol=0, atol=1e-9)
    late = jb.MovingMass(1e4, speed=20.0, entry_time=9.0)
    assert np.isnan(
        jb.ride.wheel_unloading(jb.simulate(dataclasses.replace(CASE, loads=[late])))[0]
    )


def test_gradients_against_differences():
    """With respect to the stiffness of the suspension (relative to its value)."""

    def measures(factor):
        car = dataclasses.replace(QUARTER_CAR, suspension_stiffness=8e5 * factor)
        ride = jb.ride.ride_measures(jb.simulate(dataclasses.replace(CASE, loads=[car])))
        parts = ride.weighted_rms, ride.vibration_dose, ride.sperling_index, ride.wheel_unloading
        return jnp.concatenate([jnp.asarray(part) for part in parts])

    found = jax.jacobian(measures)(jnp.asarray(1.0))
    # A small step: the sample with the smallest force is another one after a larger one.
    assert_allclose(found, central(lambda p: measures(p[0]), [1.0], 1e-4)[:, 0], rtol=1e-5)


def test_known_and_traced_histories_give_the_same():
    history = sine(3.0)[:4000] + sine(11.0)[:4000]
    for measure in (jb.ride.weighted_rms, jb.ride.vibration_dose, jb.ride.sperling_index):
        traced = jax.jit(lambda a, measure=measure: measure(TIMES[:4000], a))(history)
        assert_allclose(traced, measure(TIMES[:4000], history), rtol=1e-11)


def test_bad_times_are_refused():
    for times in ([0.0, 0.001, 0.003], [0.002, 0.001, 0.0]):
        with pytest.raises(ValueError, match="must ascend and be equally spaced"):
            jb.ride.weighted_rms(np.array(times), np.zeros(3))
    with pytest.raises(ValueError, match="at least 160 a second .* there are 100: give a larger"):
        jb.ride.vibration_dose(np.arange(9) / 100, np.zeros(9))
    with pytest.raises(ValueError, match="at least 60 a second"):
        jb.ride.sperling_index(np.arange(9) / 50, np.zeros(9))
    with pytest.raises(ValueError, match="must be concrete numbers"):
        jax.jit(lambda t: jb.ride.weighted_rms(t, np.zeros(9)))(np.arange(9) / 200)
