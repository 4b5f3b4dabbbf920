"""Figures of sweeps."""

import dataclasses
import json

import numpy as np
import pytest
import xarray
from matplotlib.text import Text
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.files.case_file import case_to_dict
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
