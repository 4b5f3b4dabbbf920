"""Readings that a logger repeats, and zeros in their place, are told from the sensor's own."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from tests.oracles.planted_structures import Structure, random_structure, response
from tuning import Log, ModalSettings, identify_modes
from tuning.logs import find_faults, mask
from tuning.logs.quality import samples_held, sensor_readings, unread
from tuning.modal.decay.stretches import excited_samples

TIMES = np.arange(600) / 500
SMOOTH = np.sin(12 * TIMES) * np.exp(-TIMES)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(2.0, 9.0), st.sampled_from([0.0, 1e-3]))
def test_held_readings_are_counted(seed, hold, resolution):
    """A sensor at a rate of its own, asked at the rate of the logger."""
    random = np.random.default_rng(seed)
    readings = random.normal(size=400)
    if resolution:
        readings = np.round(readings / resolution) * resolution
    asked = np.arange(int(390 * hold)) + random.uniform()
    held = samples_held(readings[(asked / hold).astype(int)])
    assert held == pytest.approx(hold, rel=0.02)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 0.3), st.floats(0.0, 0.02))
def test_coarse_readings_are_not_held(seed, resolution, noise):
    values = SMOOTH + noise * np.random.default_rng(seed).normal(size=SMOOTH.size)
    assert samples_held(np.round(values / resolution) * resolution) == 1.0


def test_switches_are_not_held():
    random = np.random.default_rng(0)
    switched = np.repeat(random.integers(0, 9, 200), random.integers(1, 40, 200))
    assert samples_held(1.0 * switched) == 1.0
    assert samples_held(np.zeros(600)) == 1.0 and samples_held(np.repeat(SMOOTH[:9], 4)) == 1.0


def test_zeros_that_are_no_readings():
    gravity = 9.81 + 0.1 * SMOOTH
    gravity[[0, 300]] = 0.0
    assert np.flatnonzero(unread(gravity)).tolist() == [0, 300]
    for values in (SMOOTH, np.abs(SMOOTH), np.zeros(600), np.maximum(SMOOTH, 0), np.ones(600)):
        assert not unread(values).any()
    # Zero is a reading of a positive quantity that varies as much.
    assert not unread(np.r_[0.0, np.random.default_rng(0).uniform(1.0, 2.0, 99)]).any()
    log = Log(TIMES, gravity[:, None], ("a",), ("acceleration",), ("m/s^2",), "node.csv")
    assert str(find_faults(log)[1]) == (
        "node.csv: a reads 0, as if its sensor did not answer (2 samples), first at t = 0 s"
    )
    assert np.sum(~mask(log, ["dropouts"]).valid) == 2


def test_readings_of_a_log_without_such_faults_are_the_log():
    log = Log(TIMES, SMOOTH[:, None], ("a",), ("acceleration",), ("m/s^2",))
    assert sensor_readings(log) is log


def test_samples_left_out_are_interpolated():
    values = SMOOTH.copy()
    values[100] = 5.0
    log = mask(Log(TIMES, values[:, None], ("a",), ("acceleration",), ("m/s^2",)), ["spikes"])
    np.testing.assert_allclose(sensor_readings(log).values[:, 0], SMOOTH, atol=1e-3)


def test_one_channel_that_is_not_held_keeps_the_rate():
    both = np.stack([np.repeat(np.random.default_rng(0).normal(size=150), 4), SMOOTH], axis=1)
    log = Log(TIMES, both, ("a", "b"), ("acceleration",) * 2, ("m/s^2",) * 2)
    assert sensor_readings(log) is log
    assert [str(fault) for fault in find_faults(log)] == ["log: a holds each reading for 4 samples"]


FREQUENCIES, DAMPING = np.array([12.0, 17.5, 26.0]), np.array([0.01, 0.008, 0.006])


def after_an_impact(frequencies, damping, rate, duration):
    """Accelerations (m/s^2) of a structure after one impact, with noise, and its random numbers."""
    whole, random = random_structure(1), np.random.default_rng(0)
    planted = Structure(frequencies, damping, whole.shapes[:3, :1], whole.inputs[:3])
    forces = np.zeros((int(duration * rate), 4))
    forces[16:19, 0] = [1.0, 2.0, 1.0]
    clean = np.gradient(response(planted, forces, rate), 1 / rate, axis=0)
    return 0.3 * clean / clean.std() + 0.005 * random.normal(size=clean.shape), random


def test_steps_of_held_readings_look_like_impacts_and_readings_do_not():
    clean, _ = after_an_impact(FREQUENCIES, DAMPING, 1600.0, 4.0)
    asked = np.arange(int(4 * 7200) - 8) / 7200
    held = np.round(clean[(asked * 1600).astype(int)] - 9.81, 3)
    log = Log(asked, held, ("a",), ("acceleration",), ("m/s^2",))
    excited_late = []
    for one in (log, sensor_readings(log)):
        values = one.values - one.values.mean(axis=0)
        marks = excited_samples(values, one.sample_rate, 1 / FREQUENCIES[0])
        excited_late.append(bool(marks[one.times > 0.1].any()))
    assert excited_late == [True, False]


def test_modes_of_a_hammer_test_from_a_node_that_repeats_readings():
    """As a wireless node writes: gravity, a zero first, readings held, a pause before the impact.

    The modes are those of the same test without these faults, and the truth.
    """
    rate, frequencies, damping = 1600.0, FREQUENCIES, DAMPING
    clean, random = after_an_impact(frequencies, damping, rate, 6.0)
    asked = np.arange(int(6 * 7200) - 8) / 7200 + 1e-4
    held = np.round(clean[(asked * rate).astype(int), 0] - 9.81, 3)
    held[0] = 0.0
    rest = np.round(0.005 * random.normal(size=1800) - 9.81, 3)[(asked[:8000] * rate).astype(int)]
    rest[0] = 0.0
    times = np.r_[np.arange(rest.size) / 7200, rest.size / 7200 + 0.016 + asked]
    columns = ("a",), ("acceleration",), ("m/s^2",)
    log = Log(times, np.r_[rest, held][:, None], *columns)
    fit = identify_modes(log)
    notes = " ".join(fit.notes)
    assert "a reads 0 in 2 samples" in notes and "held for 4.5 samples" in notes
    assert fit.kind == "free decay"
    direct = identify_modes(Log(np.arange(len(clean)) / rate, clean, *columns))
    for one in (fit, direct):
        np.testing.assert_allclose(one.frequencies, frequencies, rtol=2e-3)
        np.testing.assert_allclose(one.damping_ratios, damping, rtol=0.1)
    raw = str(identify_modes(log, settings=ModalSettings(as_logged=True)))
    assert "holds each reading" in raw and "reads 0" in raw and "decimated" not in raw
