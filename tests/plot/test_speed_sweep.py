"""Figures of trains over speed: units, marks at resonance speeds, envelope and largest peak."""

import json

import numpy as np
import pytest
import xarray
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.loads.axles import Axles
from jaxbeam.files.case_file import case_to_dict, with_settings
from jaxbeam.plot import plot_sweep
from tests.plot.figures import data, lines_of, words

CASE = jb.Case(
    jb.Beam(25.0, 3.0e10, 15000.0, damping_ratio=0.01, modes=2),
    sensors=[jb.Sensor(12.5)],
    loads=[Axles(train="HSLM-A1", speed=50.0)],
    title="bridge",
)
TRAINS = ["HSLM-A1", "HSLM-A9"]
FIRST = np.pi / (2 * 25.0**2) * np.sqrt(3.0e10 / 15000.0)  # Hz
SPEEDS = np.linspace(30.0, 95.0, 66)
WORST = 40


def dataset() -> xarray.Dataset:
    """Peaks that grow with speed by the train, but for one of 50 mm."""
    peaks = 1e-4 * np.outer([1.0, 1.2], SPEEDS)
    peaks[1, WORST] = 0.05
    cases = [json.dumps(case_to_dict(with_settings(CASE, {"loads.0.train": t}))) for t in TRAINS]
    return xarray.Dataset(
        {"peak_deflection": (("loads.0.train", "loads.0.speed", "sensor"), peaks[..., None])},
        {
            "loads.0.train": TRAINS,
            "loads.0.speed": SPEEDS,
            "sensor": ["0: deflection"],
            "cases": ("loads.0.train", cases),
        },
        {"case": json.dumps(case_to_dict(CASE))},
    )


def test_curves_envelope_and_largest_peak():
    figure = plot_sweep(dataset())
    (axes,) = figure.axes
    envelope, first, second = lines_of(axes, SPEEDS.size)
    assert_allclose(data(first), [3.6 * SPEEDS, 0.1 * SPEEDS])
    assert_allclose(data(envelope)[1], np.maximum(data(first)[1], data(second)[1]))
    text = words(figure)
    for word in ("speed of the train (km/h)", "peak deflection (mm)", "bridge", *TRAINS):
        assert word in text
    assert f"HSLM-A9: 50 mm at {3.6 * SPEEDS[WORST]:.0f} km/h" in text.replace("50.0", "50")


def test_resonance_and_cancellation_speeds_are_marked():
    """Coaches of 18 m and 26 m; the beam does not vibrate on at 2 L f_1 / 3."""
    (axes,) = plot_sweep(dataset()).axes
    marks = [data(line)[0] for line in axes.lines if line.get_marker() == "v"]
    assert_allclose(marks[0], 3.6 * 18.0 * FIRST / np.array([1, 2]), rtol=1e-9)
    assert_allclose(marks[1], 3.6 * 26.0 * FIRST / np.array([1, 2, 3]), rtol=1e-9)
    vertical = sorted(data(line)[0][0] for line in lines_of(axes, 2) if np.ptp(data(line)[0]) == 0)
    lines = 3.6 * FIRST * np.array([26 / 3, 50 / 5, 26 / 2, 50 / 3, 26])
    assert_allclose(vertical, lines, rtol=1e-9)


def test_one_train_is_named():
    figure = plot_sweep(dataset().isel({"loads.0.train": 1}))
    assert len(lines_of(figure.axes[0], SPEEDS.size)) == 1
    assert "HSLM-A9: " in words(figure) and "envelope" not in words(figure)


def test_low_speeds_are_in_metres_per_second():
    slow = dataset().assign_coords({"loads.0.speed": SPEEDS / 100})
    assert "speed of the train (m/s)" in words(plot_sweep(slow))


def test_words_without_speeds_are_bars():
    figure = plot_sweep(dataset().isel({"loads.0.speed": 0}))
    assert len(figure.axes[0].patches) == 2
    text = words(figure)
    assert "speed of the train 108 km/h" in text and "\ntrain\n" in text and "HSLM-A9" in text


def test_words_over_other_numbers_are_not_drawn():
    other = dataset().rename({"loads.0.speed": "beam.length"})
    with pytest.raises(ValueError, match=r"drawn over speed only.*isel\(\{'loads.0.train': 0\}\)"):
        plot_sweep(other)
