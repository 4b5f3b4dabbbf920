"""Records of vehicles: labels of wheels and bodies, files, and wheels that would have to pull."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.model.load_set import load_set
from jaxbeam.simulation.stored_record import record_from_xarray
from jaxbeam.simulation.views import contact_sentence, wheel_labels
from tests.simulation.test_record import assert_same

WAGON = jb.vehicles.Wagon(
    body_mass=32000.0,
    body_inertia=1.97e6,
    bogie_mass=2615.0,
    bogie_inertia=1476.0,
    wheelset_mass=1813.0,
    primary_stiffness=2.4e6,
    primary_damping=8.0e3,
    secondary_stiffness=8.6e5,
    secondary_damping=4.0e4,
    bogie_distance=19.0,
    wheelset_distance=2.56,
    speed=60.0,
    count=2,
    spacing=25.0,
)
CASE = jb.Case(
    jb.Beam(20.0, 4.8e10, 18358.0, 0.02, modes=2),
    sensors=[jb.Sensor(10.0)],
    loads=[jb.Axles(positions=np.arange(8.0), masses=np.full(8, 900.0), speed=40.0), WAGON],
    run=jb.Run(0.4, sample_rate=100.0),
)
WHEELS = [f"{load} wheel {i}" for load in (0, 1) for i in range(1, 9)]
BODIES = [
    f"loads.1 vehicle {i} {body}{motion}"
    for i in (0, 1)
    for body in ("body", "front bogie", "rear bogie")
    for motion in ("", " pitch")
]


@pytest.fixture(scope="module")
def record():
    return jb.simulate(CASE)


def test_wheels_and_bodies_are_labelled(record):
    dataset = record.to_xarray()
    assert list(dataset["load"].values) == WHEELS == list(wheel_labels(load_set(CASE)))
    assert list(dataset.body.values) == BODIES == record.bodies
    assert_array_equal(dataset.contact_force.sel(load="1 wheel 3"), record.contact_force[:, 10])
    pitch = dataset.body_acceleration.sel(body="loads.1 vehicle 1 body pitch")
    assert_array_equal(pitch, record.body_acceleration[:, 7])


def test_file_restores_the_record_exactly(record, tmp_path):
    record.to_netcdf(tmp_path / "run.nc")
    assert_same(jb.read_record(tmp_path / "run.nc"), record)
    assert_same(record_from_xarray(record.to_xarray()), record)


def test_datasets_without_vehicles_and_labels_are_read():
    """Datasets of earlier versions, without labels of loads and without motions of bodies."""
    record = jb.simulate(dataclasses.replace(CASE, loads=[jb.MovingMass(mass=400.0, speed=40.0)]))
    dataset = record.to_xarray()
    assert list(dataset["load"].values) == ["0"] and dataset.sizes["body"] == 0
    bodies = [name for name in dataset.variables if str(name).startswith("body")]
    assert_same(record_from_xarray(dataset.drop_vars(["load", *bodies])), record)


def test_wheels_that_would_have_to_pull_are_named():
    nan, loads = np.nan, load_set(CASE)
    times = np.full(16, nan)
    times[8], times[10] = 0.3, 0.2
    said = contact_sentence(CASE, loads, times, np.full(16, 7.5), np.full(16, -12.0))
    assert said == (
        "load 1 wheel 1 loses contact, first at t = 0.3 s, x = 7.5 m (smallest contact force -12 N)"
        "; load 1 wheel 3 loses contact, first at t = 0.2 s, x = 7.5 m"
        " (smallest contact force -12 N)"
    )
    pressing = contact_sentence(CASE, loads, np.full(16, nan), times, np.ones(16))
    assert pressing == (  # the run ends before the last wheels enter
        "loads 1 wheel 5, 1 wheel 6, 1 wheel 7, 1 wheel 8 are not on the beam;"
        " every other load presses on the beam throughout"
    )
    many = contact_sentence(CASE, loads, 2.0 - 0.1 * np.arange(16), np.ones(16), np.ones(16))
    assert many.count("loses contact, first at") == 4
    assert many.startswith("load 1 wheel 5 ") and many.endswith("; 12 more wheels lose contact")


@pytest.mark.parametrize("speed", [2.0, -2.0])
def test_a_body_on_a_slope_is_inclined_as_it_is(speed):
    """Readings forward and behind on a slope of 1 %, begun in equilibrium on it at t = 0.

    Half a second later it climbs, or descends, steadily: heights are those of the road under each
    sensor but for the start, which lasts. The wheels are 2 m before the end at t = 0.
    """
    x = np.linspace(-60.0, 80.0, 15)
    car = jb.vehicles.HalfCar(
        speed=speed,
        body_mass=1000.0,
        body_inertia=1500.0,
        axle_positions=[1.5, -1.2],
        axle_masses=[50.0, 60.0],
        suspension_stiffness=[4e4, 5e4],
        suspension_damping=[4e3, 4e3],
        tyre_stiffness=[2e5, 2e5],
        tyre_damping=[100.0, 100.0],
        entry_time=1.0,
        deceleration=0.05,
    )
    places = 2.0, 0.0, -3.0
    case = jb.Case(
        jb.Beam(20.0, 1e16, 1e6, damping_ratio=0.5, modes=1),
        loads=[car],
        profile=jb.profiles.TableProfile(positions=x, point_heights=0.01 * x + 0.3),
        vehicle_sensors=[
            jb.vehicles.VehicleSensor(quantity="displacement", position=p) for p in places
        ],
        run=jb.Run(3.0, sample_rate=10.0),
    )
    record = jb.simulate(case)
    # Steady speed before the entry at 1 s, at which braking begins: 2 t - 0.05 (t - 1)^2 / 2.
    t = np.asarray(record.times)
    way = 2.0 * (t - 1.0) - 0.025 * np.maximum(t - 1.0, 0.0) ** 2
    forward = np.sign(speed)
    wheel = way if speed > 0 else 20.0 - way
    road = [0.01 * (wheel + forward * (p - 1.5)) + 0.3 for p in places]
    readings = np.asarray(record.vehicle_readings)
    assert_allclose(readings[0], [own[0] for own in road], atol=1e-4)  # in equilibrium, at rest
    assert_allclose(record.body_velocity[0], 0.0, atol=1e-12)
    assert_allclose(readings[-1], [own[-1] for own in road], atol=1e-4)
    assert_allclose(readings[:, 0] - readings[:, 2], forward * 0.05, atol=1e-3)
