"""Vehicles in figures and animations: where parts are drawn, curves, labels, frames."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageSequence

import jaxbeam as jb
from jaxbeam.plot import animate, plot_record, plot_vehicles
from jaxbeam.plot.traffic.drawing import drawn_vehicle, vehicle_art
from tests.plot.figures import CASE as BALL, data, lines_of, words
from tests.simulation.vehicles.test_vehicle_record import WAGON

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
