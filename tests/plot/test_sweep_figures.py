"""Figures of sweeps."""

import dataclasses
import json

import numpy as np
import pytest
import xarray
from matplotlib.text import Text
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.loads.axles import Axles
from jaxbeam.files.case_file import case_to_dict, with_settings
from jaxbeam.plot import plot_sweep
from tests.plot.figures import CASE, data, lines_of, words


def swept(paired=False, **axes):
    """Dataset of a sweep with given peaks: the sum of the values in mm, twice that at sensor 1."""
    over = {name.replace("_", ".", 2): np.asarray(values) for name, values in axes.items()}
    dims = ("run",) if paired else tuple(over)
    grid = list(over.values()) if paired else np.meshgrid(*over.values(), indexing="ij")
    first = 1e-3 * np.sum(grid, axis=0)
    coordinates = {name: ("run" if paired else name, values) for name, values in over.items()}
    coordinates["sensor"] = ("sensor", ["0: deflection", "1: deflection"])
    return xarray.Dataset(
        {"peak_deflection": ((*dims, "sensor"), np.stack([first, 2 * first], axis=-1))},
        coordinates,
        {"case": json.dumps(case_to_dict(CASE))},
    )


def test_sweep_over_one_address():
    speeds = [3.0, 1.0, 2.0]
    dataset = swept(loads_0_speed=speeds)
    dataset["peak_deflection"][0] = np.nan
    figure = plot_sweep(dataset)
    curves = lines_of(figure.axes[0], 3)
    assert_allclose(data(curves[0])[0], [1, 2, 3])
    assert_allclose([data(curve)[1] for curve in curves], [[1, 2, np.nan], [2, 4, np.nan]])
    said = words(figure)
    for text in ("speed of the load (m/s)", "peak deflection (mm)", "at 0.15 m", "at 0.3 m"):
        assert text in said


def test_sweep_over_two_addresses():
    dataset = swept(loads_0_mass=[0.1, 0.2, 0.3], loads_0_speed=[1.0, 2.0, 4.0, 5.0])
    dataset["peak_deflection"][0, 0] = np.nan
    figure = plot_sweep(dataset)
    first, second, bar = figure.axes
    for axes in (first, second):
        (dot,) = axes.lines
        assert_allclose([data(dot)[0][0], data(dot)[1][0]], [5.0, 0.3])
    said = words(figure)
    for text in ("speed of the load (m/s)", "mass of the load (kg)", "at 0.3 m, largest 10.6 mm"):
        assert text in said
    assert bar.get_ylabel() == "peak deflection (mm)"


@pytest.mark.parametrize("addresses", [1, 2])
def test_sweep_of_several_quantities(addresses):
    """Accelerations are not drawn as deflections: axes and scales of their own, and names."""
    sensors = [jb.Sensor(0.15, name="quarter"), jb.Sensor(0.3, "acceleration")]
    case = dataclasses.replace(CASE, sensors=sensors)
    over = {"loads.0.mass": [0.1, 0.3], "loads.0.speed": [1.0, 2.0]}
    dataset = jb.sweep(case, dict(list(over.items())[:addresses]), progress=False)
    figure = plot_sweep(dataset)
    said = words(figure)
    for text in ("peak deflection (mm)", "peak acceleration (m/s²)", "quarter", "at 0.3 m"):
        assert text in said
    if addresses == 1:
        (curve,) = lines_of(figure.axes[1], 2)
        assert_allclose(data(curve)[1], dataset["peak_acceleration"].values[:, 1])


def test_contour_labels_are_not_cut_off():
    """Contour labels keep off the edges: a "1.2" cut to "2" would be another number."""
    masses, speeds = np.linspace(0.1, 0.6, 12), np.linspace(1.0, 6.0, 9)
    dataset = swept(loads_0_mass=masses.tolist(), loads_0_speed=speeds.tolist())
    flat = 1e-3 * masses[:, None] * (1 + 0.02 * np.sin(2 * speeds))
    dataset["peak_deflection"][...] = np.stack([flat, flat * np.sqrt(speeds)], axis=-1)
    figure = plot_sweep(dataset)
    figure.canvas.draw()
    shown = 0
    for axes in figure.axes[:2]:
        frame = axes.get_window_extent()
        for text in filter(Text.get_visible, axes.texts):
            shown += 1
            extent = text.get_window_extent()
            assert frame.x0 < extent.x0 < extent.x1 < frame.x1
            assert frame.y0 < extent.y0 < extent.y1 < frame.y1
    assert shown


def test_slice_of_a_sweep():
    dataset = swept(loads_0_mass=[0.1, 0.2], loads_0_speed=[1.0, 2.0], run_duration=[1.0])
    assert len(plot_sweep(dataset).axes) == 3
    figure = plot_sweep(dataset.isel({"loads.0.mass": 1, "sensor": 1}))
    (curve,) = lines_of(figure.axes[0], 2)
    assert_allclose(data(curve)[1], [4.4, 6.4])
    assert "mass of the load 0.2 kg" in words(figure)


def test_paired_sweep():
    dataset = swept(paired=True, loads_0_mass=[0.1, 0.2], loads_0_speed=[1.0, 2.0])
    (axes,) = plot_sweep(dataset).axes
    assert_allclose(data(lines_of(axes, 2)[0])[0], [0, 1])
    assert axes.get_xlabel() == "run"


@pytest.mark.parametrize(
    ("dataset", "message"),
    [
        (
            swept(loads_0_mass=[0.1, 0.2], loads_0_speed=[1.0, 2.0], run_duration=[1.0, 2.0]),
            r"one or two addresses, not 3 .*isel\(\{'loads.0.mass': 0\}\)",
        ),
        (swept(loads_0_mass=[0.1]), "a single run"),
        (xarray.Dataset(), "not a sweep of jaxbeam"),
    ],
)
def test_datasets_that_cannot_be_drawn(dataset, message):
    with pytest.raises(ValueError, match=message):
        plot_sweep(dataset)


def test_fractiles_over_an_address():
    """Curves of a sensor beside each other, each under its level; one alone is in the title."""
    dataset = swept(loads_0_mass=[0.1, 0.2, 0.3], loads_0_speed=[1.0, 2.0])
    several = dataset.quantile([0.0, 0.5], "loads.0.mass", keep_attrs=True)
    figure = plot_sweep(several)
    curves = lines_of(figure.axes[0], 2)
    expected = [[1.1, 2.1], [1.2, 2.2], [2.2, 4.2], [2.4, 4.4]]
    assert_allclose([data(curve)[1] for curve in curves], expected)
    assert "at 0.3 m, 50 % fractile" in words(figure)
    one = plot_sweep(dataset.quantile(0.95, "loads.0.mass", keep_attrs=True))
    assert "95 % fractile" in words(one)


# Figures of trains over speed: units, marks at resonance speeds, envelope and largest peak.

TRAIN_CASE = jb.Case(
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
    cases = [
        json.dumps(case_to_dict(with_settings(TRAIN_CASE, {"loads.0.train": t}))) for t in TRAINS
    ]
    return xarray.Dataset(
        {"peak_deflection": (("loads.0.train", "loads.0.speed", "sensor"), peaks[..., None])},
        {
            "loads.0.train": TRAINS,
            "loads.0.speed": SPEEDS,
            "sensor": ["0: deflection"],
            "cases": ("loads.0.train", cases),
        },
        {"case": json.dumps(case_to_dict(TRAIN_CASE))},
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
    assert f"largest 50.0 mm at {3.6 * SPEEDS[WORST]:.0f} km/h, HSLM-A9" in text


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
    assert "km/h, HSLM-A9" in words(figure) and "envelope" not in words(figure)


def test_long_names_of_trains_overlap_nothing():
    """Titles, legend and limits of many trains with long names keep apart and on the figure."""
    names = [f"multiple unit in two parts, series {i} of the operator" for i in range(10)]
    peaks = xarray.concat([dataset().isel({"loads.0.train": [1]})] * 10, "loads.0.train")
    peaks = peaks.assign_coords({"loads.0.train": names})
    sensors = [jb.Sensor(x, name=f"deflection of the girder {x:g} m from its end") for x in (1, 2)]
    case = dataclasses.replace(TRAIN_CASE, sensors=sensors)
    peaks = xarray.concat([peaks.assign_coords(sensor=[one.name]) for one in sensors], "sensor")
    peaks.attrs["case"] = json.dumps(case_to_dict(case))
    peaks["cases"] = "loads.0.train", [json.dumps(case_to_dict(TRAIN_CASE))] * 10
    figure = plot_sweep(peaks, limits={"deflection": 0.02})
    said = words(figure)
    for text in (*names, "limit 20.0 mm", "girder 2 m from its end: largest 50.0 mm"):
        assert text in said.replace("\n", " ")
    texts = [axes.title for axes in figure.axes] + figure.legends[0].get_texts()
    texts += [axes.xaxis.label for axes in figure.axes]
    boxes = [text.get_window_extent() for text in texts if text.get_text()]
    frame = figure.bbox
    assert all(frame.x0 <= b.x0 < b.x1 <= frame.x1 and frame.y0 <= b.y0 for b in boxes)
    pairs = [(one, other) for k, one in enumerate(boxes) for other in boxes[:k]]
    assert not any(one.overlaps(other) for one, other in pairs)
    assert not any(one.overlaps(axes.bbox) for one in boxes for axes in figure.axes)


@pytest.mark.parametrize("addresses", [1, 2])
def test_limits_of_a_quantity(addresses):
    over = {"loads_0_mass": [0.1, 0.2, 0.3], "loads_0_speed": [1.0, 2.0]}
    figure = plot_sweep(swept(**dict(list(over.items())[:addresses])), limits={"deflection": 4e-4})
    assert "limit 0.400 mm" in words(figure)
    lines = [data(line)[1] for line in figure.axes[0].lines]
    assert addresses == 2 or any(np.allclose(line, 0.4) for line in lines)


def test_a_limit_above_all_peaks_is_on_the_axes():
    (axes,) = plot_sweep(dataset(), limits={"deflection": 0.2}).axes
    assert any(np.allclose(data(line)[1], 200.0) for line in axes.lines)
    assert axes.get_ylim()[1] > 200.0


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
