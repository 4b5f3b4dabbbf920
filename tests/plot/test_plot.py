"""Pictures hold the right data under the right labels; how they look is for the eye."""

import dataclasses
import json

import jax.numpy as jnp
import matplotlib.pyplot
import numpy as np
import pytest
import xarray
from matplotlib.colors import to_hex
from matplotlib.text import Text
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageSequence

import jaxbeam as jb
from jaxbeam.files.case_file import case_to_dict
from jaxbeam.model.frequency_response import frequency_response
from jaxbeam.plot import (
    FitPanel,
    animate,
    plot_fit,
    plot_frequency_response,
    plot_modes,
    plot_record,
    plot_sweep,
)
from jaxbeam.plot.style import INK, format_number, separate_labels, unit_scale

CASE = jb.Case(
    jb.Beam(0.6, 11.68, 0.535, damping_ratio=0.02, modes=2),
    sensors=[jb.Sensor(0.15), jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.5, speed=2.0, entry_time=0.1)],
    run=jb.Run(duration=0.5, sample_rate=400.0),
    title="one ball",
)
MANY = dataclasses.replace(
    CASE,
    supports=[jb.Support(0.4, stiffness=1e4), jb.Support(0.5)],
    actuators=[jb.Patch(0.1, 0.2, 1e-3), jb.Shaker(0.3)],
    loads=[
        jb.MovingMass(mass=3.0, speed=6.0),
        jb.MovingForce(force=2.0, speed=-1.0, entry_time=0.2, deceleration=1.0),
        jb.MovingMass(mass=1.0, speed=1.0, entry_time=9.0),
    ],
)


@pytest.fixture(scope="module")
def record():
    """One ball over one span."""
    return jb.simulate(CASE)


def words(figure) -> str:
    """All that is written in a figure, a line each."""
    figure.draw_without_rendering()
    texts = figure.findobj(lambda artist: isinstance(artist, Text) and artist.get_visible())
    return "\n".join(text.get_text() for text in texts)


def data(line) -> np.ndarray:
    """Positions and heights of the points of a curve, (2, point)."""
    return np.asarray(line.get_xydata(), float).T


def lines_of(axes, size: int):
    """The curves of an axes with so many points."""
    return [line for line in axes.lines if np.size(data(line)[0]) == size]


def test_record(record):
    figure = plot_record(record)
    _, top, bottom = figure.axes
    times = np.asarray(record.times)
    curves = lines_of(top, times.size)
    assert len(curves) == 2
    for i, curve in enumerate(curves):
        assert_array_equal(data(curve)[0], times)
        assert_allclose(data(curve)[1], 1e3 * np.asarray(record.deflection)[:, i])
    dots = [line for line in lines_of(top, 1) if line.get_marker() == "o"]
    assert_allclose([data(dot)[0][0] for dot in dots], record.peak_time)
    assert_allclose([-data(dot)[1][0] for dot in dots], 1e3 * record.peak_deflection)
    (force,) = lines_of(bottom, times.size)
    pressed = np.isfinite(np.asarray(record.load_position)[:, 0])
    assert_array_equal(np.isfinite(data(force)[1]), pressed)
    assert_allclose(data(force)[1][pressed], np.asarray(record.contact_force)[pressed, 0])
    shaded = [patch.get_extents() for patch in top.patches]
    assert_allclose([top.transData.inverted().transform(box)[:, 0] for box in shaded], [[0.1, 0.4]])
    said = words(figure)
    for text in ("one ball", "deflection (mm)", "contact force (N)", "time (s)", "0.15 m",
                 "0.5 kg, 2 m/s", "weight 4.91 N"):  # fmt: skip
        assert text in said
    assert f"peak {format_number(-1e3 * float(record.peak_deflection[1]))} mm" in said


def test_record_of_many_parts(record):
    count = record.times.shape[0]
    figure = plot_record(
        dataclasses.replace(
            record,
            case=MANY,
            load_position=jnp.full((count, 3), jnp.nan).at[:100, 0].set(0.2).at[50:, 1].set(0.1),
            contact_force=jnp.zeros((count, 3)).at[:100, 0].set(-1.0).at[50:, 1].set(2.0),
            contact_lost_time=jnp.array([0.05, jnp.nan, jnp.nan]),
            contact_lost_position=jnp.array([0.3, jnp.nan, jnp.nan]),
            lowest_contact_force=jnp.array([-1.0, 2.0, 0.0]),
        )
    )
    _, top, bottom = figure.axes
    edges = [patch.get_x() for patch in top.patches]
    assert_allclose(edges, [0.0, 0.2], atol=1e-12)  # the third load never comes
    (lost,) = [line for line in bottom.lines if line.get_marker() == "X"]
    assert_allclose(data(lost)[0], [0.05])
    said = words(figure)
    assert "load 0" in said and "load 1" in said and "load 2" not in said
    assert "has to pull" in said


def test_record_without_sensors_or_loads(record):
    loads_only = dataclasses.replace(record, case=dataclasses.replace(CASE, sensors=()))
    assert len(plot_record(loads_only).axes) == 2
    nothing = dataclasses.replace(record, case=dataclasses.replace(CASE, sensors=(), loads=()))
    with pytest.raises(ValueError, match="neither sensors nor loads"):
        plot_record(nothing)


def test_modes():
    found = jb.modes(CASE)
    figure = plot_modes(CASE)
    for i, curve in enumerate(lines_of(figure.axes[0], 401)):
        shape = np.sin((i + 1) * np.pi * data(curve)[0] / 0.6)
        assert_allclose(data(curve)[1] + i, 0.36 * shape, atol=1e-4)
    said = words(figure)
    for frequency in np.asarray(found.frequencies):
        assert f"{frequency:.4g} Hz\ndamping 2 %" in said


@pytest.mark.parametrize(
    ("ends", "held"), [("pinned-pinned", 4), ("clamped-guided", 4), ("free-free", 2)]
)
def test_supports_are_drawn_at_every_mode(record, ends, held):
    beam = jb.Beam(0.6, 11.68, 0.535, ends=ends, modes=2)
    figure = plot_modes(dataclasses.replace(MANY, beam=beam), record.modes)
    marks = [line for line in figure.axes[0].lines if line.get_marker() != "None"]
    assert len(marks) == 2 * held
    assert {data(mark)[0][0] for mark in marks} >= {0.4, 0.5}


def swept(paired=False, **axes):
    """A dataset such as a sweep returns, with peaks that are known."""
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
    for text in ("loads.0.speed (m/s)", "peak deflection (mm)", "at 0.15 m", "at 0.3 m"):
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
    for text in ("loads.0.speed (m/s)", "loads.0.mass (kg)", "at 0.3 m, largest 10.6 mm"):
        assert text in said
    assert bar.get_ylabel() == "peak deflection (mm)"


def test_no_number_of_a_line_is_cut_off_at_an_edge():
    """A "1.2" of which only the "2" is seen would be another number."""
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


def test_sweep_held_at_a_value():
    dataset = swept(loads_0_mass=[0.1, 0.2], loads_0_speed=[1.0, 2.0], run_duration=[1.0])
    assert len(plot_sweep(dataset).axes) == 3
    figure = plot_sweep(dataset.isel({"loads.0.mass": 1, "sensor": 1}))
    (curve,) = lines_of(figure.axes[0], 2)
    assert_allclose(data(curve)[1], [4.4, 6.4])
    assert "loads.0.mass = 0.2 kg" in words(figure)


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
def test_what_is_no_drawable_sweep_is_refused(dataset, message):
    with pytest.raises(ValueError, match=message):
        plot_sweep(dataset)


def test_fit():
    times = np.arange(50) / 10.0
    fitted = np.stack([np.sin(times), np.cos(times)], axis=1) * 1e-3
    noise = np.random.default_rng(1).normal(0, 1e-5, fitted.shape)
    both = FitPanel("first.csv", times, fitted + noise, fitted, ("d1", "d2"))
    one = FitPanel("second.csv", times, fitted[:, :1], 0.5 * fitted[:, :1], ("a",), "m/s^2")
    figure = plot_fit([both, one], "two logs")
    grid = np.array(figure.axes).reshape(3, 2)
    assert not grid[2, 1].axison
    measured, line = grid[0, 0].lines[:2]
    assert_allclose(data(measured)[1], 1e3 * both.measured[:, 0])
    assert_allclose(data(line)[1], 1e3 * fitted[:, 0])
    assert_allclose(data(grid[2, 0].lines[0])[1], 1e6 * noise[:, 1])
    said = words(figure)
    for text in ("two logs", "first.csv", "second.csv", "d1", "d2", "measured and fitted (mm)",
                 "measured and fitted (mm/s\N{SUPERSCRIPT TWO})", "fitted",
                 f"residual sd {format_number(np.std(noise[:, 1]) * 1e6)} \N{MICRO SIGN}m"):  # fmt: skip
        assert text in said
    with pytest.raises(ValueError, match="at least one log"):
        plot_fit([])


def test_a_perfect_fit():
    zeros = np.zeros((5, 1))
    said = words(plot_fit([FitPanel("log", np.arange(5.0), zeros, zeros, ("w",))]))
    assert "residual sd 0.00 m" in said


def test_frequency_responses():
    """A column a unit; the curve of each pair, without a frequency of zero."""
    pairs = [("force@0.3", "sensors.0"), ("force@0.3", "velocity@0.1"), ("force@0.2", "sensors.1")]
    response = frequency_response(CASE, [0.0, 2.0, 20.0, 200.0], pairs)
    figure = plot_frequency_response(response)
    grid = np.array(figure.axes).reshape(2, 2)
    assert [len(axes.lines) for axes in grid.ravel()] == [2, 1, 2, 1]
    assert_allclose(data(grid[0, 0].lines[1])[1], response.magnitude[1:, 2])
    assert_allclose(data(grid[1, 1].lines[0])[0], [2, 20, 200])
    assert_allclose(data(grid[1, 1].lines[0])[1], response.phase[1:, 1])
    assert [axes.get_xscale() for axes in grid[1]] == ["log", "log"]
    said = words(figure)
    for text in ("one ball", "magnitude (m/N)", "magnitude ((m/s)/N)", "phase (°)",
                 "frequency (Hz)", "force@0.2 → sensors.1"):  # fmt: skip
        assert text in said


def test_animation(record, tmp_path):
    path = tmp_path / "run.gif"
    animate(record, path, frames=3, rate=10)
    with Image.open(path) as picture:
        assert (picture.format, picture.info["duration"]) == ("GIF", 100)
        assert len(list(ImageSequence.Iterator(picture))) == 3
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="run.gif exists"):
        animate(record, path)
    assert path.read_bytes() == before
    animate(record, path, frames=2, overwrite=True)
    assert path.read_bytes() != before


def test_animation_of_a_controlled_rig(tmp_path):
    """Shaker and patch, commands, supports of both kinds: a picture as high as its rows."""
    loop = jb.Feedback(gains=[1e3, 1e3], period=0.005)
    case = dataclasses.replace(MANY, controller=loop, loads=CASE.loads)
    record = jb.simulate(case)
    heights = []
    for name, shown in (("controlled", record), ("plain", jb.simulate(CASE))):
        animate(shown, tmp_path / f"{name}.gif", frames=3)
        with Image.open(tmp_path / f"{name}.gif") as picture:
            heights.append(picture.size[1])
            frames = [np.asarray(f.convert("L")) for f in ImageSequence.Iterator(picture)]
        assert len(frames) == 3 and not np.array_equal(frames[0], frames[1])
    assert heights[0] > heights[1]
    diverged = dataclasses.replace(record, coordinates=record.coordinates.at[9:].set(jnp.nan))
    with pytest.raises(ValueError, match="diverges"):
        animate(diverged, tmp_path / "diverged.gif")
    assert not (tmp_path / "diverged.gif").exists()


def test_style_stays_in_the_figure():
    before = dict(matplotlib.rcParams)
    figure = plot_sweep(swept(loads_0_speed=[1.0, 2.0]))
    assert dict(matplotlib.rcParams) == before
    figure.draw_without_rendering()  # ticks are made as late as this
    assert {to_hex(text.get_color()) for text in figure.axes[0].get_xticklabels()} == {INK}
    assert not matplotlib.pyplot.get_fignums()


@pytest.mark.parametrize(
    ("values", "unit", "expected"),
    [
        ([-1.4e-3, 0.0], "m", (1e-3, "mm")),
        ([0.5e-3], "m", (1e-3, "mm")),
        ([5e-6, np.nan], "m", (1e-6, "\N{MICRO SIGN}m")),
        ([2e-9], "m", (1e-9, "nm")),
        ([0.6], "m", (1.0, "m")),
        ([0.0], "m", (1.0, "m")),
        ([], "N", (1.0, "N")),
        ([4905.0], "N", (1e3, "kN")),
        ([3.0], "m/s^2", (1.0, "m/s\N{SUPERSCRIPT TWO}")),
        ([2e-5], "1", (1e-6, "$10^{-6}$")),
        ([0.5], "1", (1.0, "")),
    ],
)
def test_prefixes(values, unit, expected):
    assert unit_scale(values, unit) == expected


def test_labels_keep_apart():
    assert_allclose(separate_labels([3.0, 1.0, 2.0], 0.5), [3, 1, 2])
    assert_allclose(separate_labels([1.0, 1.0, 5.0], 0.5), [0.75, 1.25, 5.0])
    assert separate_labels([], 1.0).shape == (0,)
