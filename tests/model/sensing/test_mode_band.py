"""Accelerations of the modes that count by EN 1990 against the sum of the lowest modes."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.model.sensing.output_rows import band_weights

# 4, 16, 36, 64 Hz: three of the four count, the third beyond 30 Hz.
RIGIDITY = (4.0 * 2 * np.pi) ** 2 * 15000.0 * 25.0**4 / np.pi**4
BANDED = jb.Sensor(12.5, "acceleration", mode_band="en1990")
CASE = jb.Case(
    jb.Beam(25.0, RIGIDITY, 15000.0, damping_ratio=0.01, modes=5),
    sensors=[BANDED, jb.Sensor(12.5, "acceleration")],
    loads=[jb.MovingForce(force=1e5, speed=50.0)],
    run=jb.Run(0.7, sample_rate=2000.0),
)


def test_modes_of_the_band():
    assert_allclose(band_weights(jb.modes(CASE), "en1990"), [1, 1, 1, 0, 0])


def test_readings_extremes_and_sweeps_have_the_modes_of_the_band():
    record = jb.simulate(CASE)
    fewer = dataclasses.replace(
        CASE,
        beam=dataclasses.replace(CASE.beam, modes=3),
        sensors=[jb.Sensor(12.5, "acceleration")],
    )
    expected = np.asarray(jb.simulate(fewer).sensor_values[:, 0])
    values = np.asarray(record.sensor_values)
    size = np.abs(expected).max()
    assert_allclose(values[:, 0], expected, rtol=0, atol=1e-6 * size)
    assert np.abs(values[:, 1] - expected).max() > 0.05 * size
    assert_allclose(record.measured[:, 0], values[:, 0], rtol=1e-12)
    largest = max(record.extremes.largest[0], -record.extremes.smallest[0])
    assert_allclose(largest, size, rtol=2e-3)
    assert largest >= size * (1 - 1e-7)
    swept = jb.sweep(CASE, {"loads.0.speed": [50.0]}, progress=False)
    assert_allclose(swept["peak_acceleration"][0, 0], largest, rtol=1e-6)


def test_corrected_quantities_have_no_band():
    with pytest.raises(ValueError, match=r"sensors.0.mode_band would have no effect .* moment"):
        jb.simulate(
            dataclasses.replace(CASE, sensors=[jb.Sensor(1.0, "moment", mode_band="en1990")])
        )
