"""Data and labels of figures."""

import dataclasses
import inspect
import itertools

import jax.numpy as jnp
import matplotlib.pyplot
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageSequence

import jaxbeam as jb
import jaxbeam.plot
from jaxbeam.model.frequency_responses import frequency_response
from jaxbeam.plot import (
    FitPanel,
    TuningPanel,
    animate,
    plot_envelope,
    plot_fit,
    plot_frequency_response,
    plot_modes,
    plot_record,
    plot_tuning,
    plot_vehicles,
)
from jaxbeam.plot.drawing import drawn_vehicle, vehicle_art
from jaxbeam.plot.style import INK, format_number, separate_labels, unit_scale
from tests.plot.figures import CASE, CASE as BALL, MANY, data, lines_of, words
from tests.simulation.test_vehicles import WAGON


@pytest.fixture(scope="module")
def record():
    """Record of one mass on one span."""
    return jb.simulate(CASE)


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
    assert "contact loss" in said


def test_record_of_several_quantities():
    """Each has axes with its unit; names of sensors are beside their larger extremes."""
    sensors = [
        jb.Sensor(0.3, name="midspan"),
        jb.Sensor(0.2, "acceleration"),
        jb.Sensor(0.2, "strain", fibre_distance=-2e-3, name="gauge"),
        jb.Sensor(0.4, "curvature"),
    ]
    record = jb.simulate(dataclasses.replace(CASE, sensors=sensors))
    figure = plot_record(record)
    said = words(figure)
    for text in ("deflection (mm)", "acceleration (m/s²)", "strain ($10^{-3}$)", "midspan",
                 "gauge", "curvature"):  # fmt: skip
        assert text in said
    strain = figure.axes[3]
    (curve,) = lines_of(strain, record.times.size)
    assert_allclose(data(curve)[1], 1e3 * np.asarray(record.measured)[:, 2])
    (dot,) = [line for line in lines_of(strain, 1) if line.get_marker() == "o"]
    found = record.extremes
    assert_allclose(data(dot)[:, 0], [found.largest_time[2], 1e3 * found.largest[2]])
    assert figure.axes[2].get_ylabel() == "acceleration (m/s²)"


def test_envelope(record):
    found = record.envelope("moment", np.linspace(0, 0.6, 31))
    figure = plot_envelope(record, "moment", found.positions)
    low, high = lines_of(figure.axes[1], 31)
    assert_allclose(data(low)[1], found.smallest)
    assert_allclose(data(high)[1], found.largest)
    i = int(np.argmax(found.largest))
    said = words(figure)
    for text in ("moment (N m)", "position (m)", f"at {found.positions[i]:.4g} m", "one ball"):
        assert text in said


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
    deviation = format_number(np.std(noise[:, 1]) * 1e6)
    for text in (
        "two logs",
        "first.csv",
        "second.csv",
        "d1",
        "d2",
        "measured and fitted (mm)",
        "measured and fitted (mm/s\N{SUPERSCRIPT TWO})",
        "fitted",
        f"residual sd {deviation} \N{MICRO SIGN}m",
    ):
        assert text in said
    with pytest.raises(ValueError, match="at least one log"):
        plot_fit([])


def test_samples_left_out_of_a_fit_do_not_count():
    """A spike that was masked is a cross, and neither scales the residuals nor spreads them."""
    fitted = 1e-3 * np.sin(np.arange(50) / 10.0)[:, None]
    noise = np.random.default_rng(1).normal(0, 1e-5, fitted.shape)
    measured = fitted + noise
    measured[20], valid = 9.0, np.arange(50)[:, None] != 20
    figure = plot_fit([FitPanel("log", np.arange(50.0), measured, fitted, ("w",), "m", valid)])
    deviation = format_number(np.std(noise[valid]) * 1e6)
    said = words(figure)
    assert f"residual sd {deviation} \N{MICRO SIGN}m" in said and "left out" in said
    assert figure.axes[1].get_ylim()[1] < 50


def test_a_perfect_fit():
    zeros = np.zeros((5, 1))
    said = words(plot_fit([FitPanel("log", np.arange(5.0), zeros, zeros, ("w",))]))
    assert "residual sd 0.00 m" in said


def test_frequency_responses():
    """A column a unit, a curve a pair; a frequency of zero is left out."""
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


def test_animation_of_a_controlled_beam(tmp_path):
    """Shaker and patch, commands, rigid and elastic supports; higher by the row of commands."""
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
    nothing = jnp.asarray(record.coordinates).at[9:].set(jnp.nan)
    diverged = dataclasses.replace(record, coordinates=nothing)
    with pytest.raises(ValueError, match="diverges"):
        animate(diverged, tmp_path / "diverged.gif")
    assert not (tmp_path / "diverged.gif").exists()


def test_style_does_not_leak():
    before = dict(matplotlib.rcParams)
    figure = plot_modes(CASE)
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


def test_labels_do_not_overlap():
    assert_allclose(separate_labels([3.0, 1.0, 2.0], 0.5), [3, 1, 2])
    assert_allclose(separate_labels([1.0, 1.0, 5.0], 0.5), [0.75, 1.25, 5.0])
    assert separate_labels([], 1.0).shape == (0,)


def test_labels_stay_within_limits():
    found = separate_labels([1.0, 1.0, 1.0, 9.0], 1.0, (0.0, 10.0))
    assert_allclose(found, [0.5, 1.5, 2.5, 9.0])
    assert_allclose(separate_labels([9.0, 9.9], 1.0, (0.0, 10.0)), [8.5, 9.5])


def shown_boxes(figure):
    """Extents of the visible texts of a figure that are not numbers of ticks."""
    figure.draw_without_rendering()
    texts = figure.findobj(lambda artist: isinstance(artist, Text) and artist.get_visible())
    ticks = {id(text) for axes in figure.axes for text in axes.get_xticklabels()}
    ticks |= {id(text) for axes in figure.axes for text in axes.get_yticklabels()}
    own = Text.get_window_extent  # that of an annotation has its line in it
    return [own(t) for t in texts if t.get_text() and id(t) not in ticks]


def test_many_loads_and_sensors_are_readable():
    """Fifty loads and thirty sensors: no text lies on another."""
    wave = {"force": 2e5, "frequencies": [3.0], "amplitudes": [2e4], "speed": 50.0}
    case = jb.Case(
        jb.Beam(25.0, 3e10, 1.5e4, modes=2),
        sensors=[jb.Sensor(x) for x in np.linspace(1.0, 24.0, 30)],
        loads=[jb.VaryingForce(**wave, entry_time=0.05 * i) for i in range(50)],
        run=jb.Run(3.0, sample_rate=20.0),
    )
    figure = plot_record(jb.simulate(case))
    boxes = shown_boxes(figure)
    assert len(boxes) > 15
    pairs = itertools.combinations([box.padded(-1) for box in boxes], 2)
    assert not any(one.overlaps(other) for one, other in pairs)
    said = words(figure)
    assert "loads 0 to " in said and "more" in said and "weight 200 kN" in said


def test_figures_take_the_place_of_axes(record):
    """Single panels are drawn on the axes, others divide their place; other axes stay."""
    figure = Figure(layout="constrained")
    left, right = figure.subplots(1, 2)
    assert record.plot("deflection", ax=left, title="here", labels=["one", "two"]) is figure
    assert left.get_title(loc="left") == "here" and len(lines_of(left, record.times.size)) == 2
    assert "two" in words(figure)
    part = record.plot(ax=right, title="there")
    assert part in figure.subfigs and len(part.axes) == 3
    assert "there" in words(figure)
    with pytest.raises(ValueError, match="ax has no place in a grid"):
        record.plot(ax=Figure().add_axes((0, 0, 1, 1)))
    with pytest.raises(ValueError, match="no sensor measures 'strain'; they measure deflection"):
        record.plot("strain")
    with pytest.raises(ValueError, match="labels names 1 sensor; the case has 2"):
        record.plot(labels=["one"])


def test_every_figure_may_take_the_place_of_axes():
    import jaxbeam.plot

    functions = [name for name in dir(jaxbeam.plot) if name.startswith("plot_")]
    assert len(functions) > 10
    for name in functions:
        assert "ax" in inspect.signature(getattr(jaxbeam.plot, name)).parameters, name


def test_envelope_and_modes_on_axes(record):
    left, right = Figure().subplots(1, 2)
    record.plot_envelope("moment", ax=left)
    assert len(lines_of(left, record.envelope("moment").positions.size)) == 2
    plot_modes(CASE, ax=right, title="shapes")
    assert right.get_title(loc="left") == "shapes" and len(lines_of(right, 401)) == 2


def test_tuning():
    """A panel for each kind of runs, in per cent of no control; the search below all of them."""
    labels, uncontrolled = ["light", "heavy"], np.array([2.0, 4.0])
    panels = [
        TuningPanel(
            title, labels, uncontrolled, *(share * uncontrolled for share in (0.9, 0.5, 0.2))
        )
        for title in ("training runs", "held out runs")
    ]
    history = np.array([[0.9, 1.0], [0.95, 0.6], [0.7, np.nan]])
    figure = plot_tuning(panels, history, "two loads")
    *above, below = figure.axes
    assert [axes.get_title("left") or axes.get_title() for axes in above] == [
        "training runs",
        "held out runs",
    ]
    before, after = (line for line in above[0].lines if line.get_label() in ("before", "after"))
    assert_allclose(data(before)[0], [90, 90])
    assert_allclose(data(after)[0], [50, 50])
    assert_allclose(data(below.lines[-1])[1], [0.9, 0.6, 0.6])  # the best so far
    figure.draw_without_rendering()
    assert below.get_position().width > 1.5 * above[0].get_position().width
    with pytest.raises(ValueError, match="at least one panel"):
        plot_tuning([], history)


# Vehicles in figures and animations: where parts are drawn, curves, labels, frames.

CAR = jb.QuarterCar(16e3, 1.2e3, 8e5, 2e4, 3.5e6, 1e4, speed=25.0, start_position=-5.0)
ROAD = jb.Case(
    jb.Beam(25.0, 4.8e10, 18358.0, 0.02, modes=2),
    sensors=[jb.Sensor(12.5)],
    loads=[CAR],
    profile=jb.profiles.ISO8608Profile("C", seed=3),
    run=jb.Run(1.4, sample_rate=200.0),
    title="on a rough road",
)
WAGONS = dataclasses.replace(ROAD, loads=[WAGON], profile=None)


def test_parts_of_a_wagon_are_found_from_its_matrices():
    """Those of the description: bogies 19 m apart, wheelsets 2.56 m."""
    vehicle = drawn_vehicle(WAGON)
    body, front, rear = vehicle.parts
    assert [part.level for part in vehicle.parts] == [2, 1, 1]
    assert_allclose(vehicle.wheels, [0.0, -2.56, -19.0, -21.56])
    assert_allclose([body.position, front.position, rear.position], [-10.78, -1.28, -20.28])
    assert_allclose(body.ends, [-20.28 - 0.12 * 19.0, -1.28 + 0.12 * 19.0])
    u = np.array([0.1, 0.01, 0, 0, 0, 0])
    assert body.lift(-1.28, u) == pytest.approx(0.1 + 9.5 * 0.01)
    assert sorted(vehicle.springs)[-1] == (0.0, 1, -1)


@pytest.mark.parametrize("model", ["manchester-wagon", "half-truck", "quarter-truck"])
def test_described_vehicles_are_drawn_as_their_matrices_say(model):
    """Positions from the tables of a vehicle file, and from its matrices as for other kinds."""
    load = jb.vehicles.VehicleLoad(model=model, speed=20.0)
    described = drawn_vehicle(load)

    class Other(jb.Oscillator):
        def vehicle(self, gravity):
            return load.vehicle(gravity)

    inferred = drawn_vehicle(Other(1.0, 1.0, speed=1.0))
    for one, other in zip(described.parts, inferred.parts, strict=True):
        assert (one.name, one.level) == (other.name, other.level)
        assert_allclose(one.position, other.position, atol=1e-6)
        assert_allclose(one.ends, other.ends, atol=1e-6)


def test_hinged_bodies_share_the_height_of_their_hinge():
    load = jb.vehicles.VehicleLoad(model="truck-5-axle", speed=20.0)
    tractor, trailer, *axles = drawn_vehicle(load).parts
    hinge = float(load.hinges[0].position - load.axles[0].position)
    u = np.random.default_rng(1).normal(size=len(load.vehicle(np.float64(9.81)).names))
    assert tractor.lift(hinge, u) == pytest.approx(trailer.lift(hinge, u))
    assert tractor.level == trailer.level == 2 and len(axles) == 5


@pytest.mark.parametrize("speed", [25.0, -25.0])
def test_boxes_move_with_the_vehicle(speed):
    case = dataclasses.replace(WAGONS, loads=[dataclasses.replace(WAGON, speed=speed)])
    axes = Figure().subplots()
    (art,) = vehicle_art(axes, case, 7.0, 0.1)
    at_rest, moved = np.zeros(12), np.zeros(12)
    moved[0], moved[6] = 0.5, -0.2  # bodies of both wagons
    side = np.sign(speed)
    positions = 10.0 - side * (np.array([0.0, 2.56, 19.0, 21.56])[None] + [[0.0], [25.0]]).ravel()
    boxes = []
    for u in (at_rest, moved):
        art.update(positions, np.zeros(8), u)
        (drawn,) = [c for c in axes.collections if isinstance(c, PolyCollection)]
        boxes.append(np.array([path.vertices[:4] for path in drawn.get_paths()]))
    rise = boxes[1][:, :, 1] - boxes[0][:, :, 1]
    assert_allclose(rise[:, 0], [0.5, 0, 0, -0.2, 0, 0], atol=1e-12)
    centres = boxes[0][:, :, 0].mean(axis=1)
    assert_allclose(centres[[0, 3]], 10.0 - side * (10.78 + np.array([0.0, 25.0])))


def test_figure_of_a_quarter_car():
    record = jb.simulate(ROAD)
    figure = plot_record(record)
    _, _, forces, bodies = figure.axes
    times = np.asarray(record.times)
    on = np.isfinite(np.asarray(record.load_position)[:, 0])
    (force,) = lines_of(forces, times.size)
    assert_allclose(data(force)[1][on], 1e-3 * np.asarray(record.contact_force)[on, 0])
    (body,) = lines_of(bodies, times.size)  # not the axle
    assert_allclose(data(body)[1], np.asarray(record.body_acceleration)[:, 0])
    said = words(figure)
    for text in ("quarter-car, 25 m/s", "body (m/s\N{SUPERSCRIPT TWO})", "weight 169 kN"):
        assert text in said


def test_curves_of_two_wheels_say_which_is_which():
    truck = jb.vehicles.VehicleLoad(model="half-truck", speed=25.0)
    record = jb.simulate(dataclasses.replace(ROAD, loads=[truck]))
    forces = plot_record(record).axes[2]
    front, rear = (np.mean(line.get_color()) for line in lines_of(forces, len(record.times)))
    assert front < rear  # the darker one
    assert "front wheel dark, rear light" in words(forces.figure)


def test_forces_of_many_wheels_are_an_envelope():
    record = jb.simulate(WAGONS)
    forces, bodies = plot_record(record).axes[2:]
    times, on = np.asarray(record.times), np.isfinite(np.asarray(record.load_position))
    (worst,) = lines_of(forces, times.size)
    wheel = np.nanargmax(jb.ride.wheel_unloading(record))
    seen = np.isfinite(data(worst)[1])
    assert_array_equal(seen, on[:, wheel])
    assert_allclose(data(worst)[1][seen], 1e-3 * np.asarray(record.contact_force)[seen, wheel])
    (band,) = [c for c in forces.collections if isinstance(c, PolyCollection)]
    edges = np.concatenate([path.vertices[:, 1] for path in band.get_paths()])
    all_forces = 1e-3 * np.asarray(record.contact_force)[on]
    assert_allclose([edges.min(), edges.max()], [all_forces.min(), all_forces.max()])
    assert len(lines_of(bodies, times.size)) == 2  # both wagons
    assert f"wheel {wheel + 1}, most unloaded" in words(forces.figure)


def test_constant_forces_have_no_panel():
    """Those of moving forces; of a mass, a varying force, or without a sensor they are drawn."""
    force = jb.MovingForce(force=200e3, speed=25.0)
    wave = jb.VaryingForce(force=200e3, frequencies=[4.0], amplitudes=[20e3], speed=25.0)
    case = dataclasses.replace(ROAD, loads=[force, force], profile=None)
    for loads, count in (([force, force], 2), ([wave], 3), ([jb.MovingMass(20e3, 25.0)], 3)):
        record = jb.simulate(dataclasses.replace(case, loads=loads))
        labels = [axes.get_ylabel() for axes in plot_record(record).axes]
        assert len(labels) == count
        assert any("contact force" in label for label in labels) == (count == 3)
    alone = jb.simulate(dataclasses.replace(case, sensors=()))
    assert "contact force" in plot_record(alone).axes[1].get_ylabel()


def test_lost_contact_names_the_wheel():
    record = jb.simulate(WAGONS)
    lost = jnp.full(8, jnp.nan).at[2].set(0.5)
    said = words(plot_record(dataclasses.replace(record, contact_lost_time=lost)))
    assert "contact loss, load 0 wheel 3" in said


def test_animation_of_vehicles(tmp_path):
    """On a profile and without one; plain wheels in a row too."""
    axles = jb.Axles(train="EN15528-D2", speed=25.0)
    for name, case in (
        ("road", ROAD),
        ("wagons", WAGONS),
        ("axles", dataclasses.replace(ROAD, loads=[axles])),
    ):
        record = jb.simulate(case)
        animate(record, tmp_path / f"{name}.gif", frames=4)
        with Image.open(tmp_path / f"{name}.gif") as picture:
            frames = [np.asarray(f.convert("L")) for f in ImageSequence.Iterator(picture)]
        assert len(frames) == 4
        assert not np.array_equal(frames[1], frames[2])
    animate(jb.simulate(BALL), tmp_path / "ball.gif", frames=4)


def test_vehicles_on_the_ground_with_their_static_loads():
    train = jb.Axles(train="HSLM-A1", speed=1.0)
    figure = plot_vehicles([CAR, dataclasses.replace(WAGON, speed=-1.0), train], ["car", "wagons"])
    said = words(figure)
    for text in ("car", "wagons", "axles", "168.7", "109.1", "static loads in kN", "position (m)"):
        assert text in said
    assert "170" not in said  # of fifty axles
    wheels = [data(line)[0] for line in figure.axes[1].lines if line.get_marker() != "None"]
    assert_allclose(np.sort(wheels[0])[[0, -1]], [0.0, 46.56])
    with pytest.raises(ValueError, match="at least one load"):
        plot_vehicles([])
