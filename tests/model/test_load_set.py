"""Loads of a run: wheels of all vehicles in order, their paths, systems and states at rest."""

import dataclasses

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import jaxbeam as jb
from jaxbeam.case.trajectory import NEVER
from jaxbeam.model import contact
from jaxbeam.model.along_beam import (
    left_of,
    positions_along,
    refined,
    sections,
    special_positions,
)
from jaxbeam.model.contact import _pressing_forces, contact_at, forces_of_wheels, split_states
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from tests.case.loads import reference

CAR = jb.QuarterCar(14e3, 1100.0, 9e5, 3e4, 3e6, 8e3, speed=-15.0, entry_time=0.1)
WAGONS = reference.wagon(reference.REFERENCE["wagon"]["input"], 30.0, count=2, spacing=25.0)
MASS = jb.MovingMass(5e3, speed=10.0, start_position=-4.0)
PROFILE = jb.profiles.SineProfile(5e-3, 7.0, 0.4)
CASE = jb.Case(
    jb.Beam(20.0, 2e10, 1.2e4, modes=2), loads=[MASS, WAGONS, CAR], profile=PROFILE, run=jb.Run(1.0)
)
LOADS = load_set(CASE)
OFFSETS = np.array([0.0, 2.56, 19.0, 21.56])


def test_wheels_are_those_of_the_loads_in_turn():
    assert LOADS.wheel_count == 1 + 2 * 4 + 1
    assert LOADS.load_of_wheel == [0, *[1] * 8, 2]
    assert_array_equal(LOADS.on_ground, [False, *[True] * 9])
    assert LOADS.vehicle_states == 2 * (2 * 6 + 2)
    wheelset = reference.REFERENCE["wagon"]["input"]["mw"]
    assert_array_equal(LOADS.inertia[:, 0], [5e3, *[wheelset] * 8, 0.0])
    total = 9.81 * (5e3 + 15.1e3) + 2 * sum(reference.REFERENCE["wagon"]["P_static"])
    assert np.sum(LOADS.weight) == pytest.approx(total, rel=1e-7)


def test_wheels_follow_behind_the_first():
    times = np.array([0.0, 0.7, 1.3])
    position, speed, acceleration = LOADS.kinematics(times)
    assert_allclose(position[0], -4.0 + 10.0 * times)
    behind = np.concatenate([OFFSETS, OFFSETS + 25.0])
    assert_allclose(position[1:9], 30.0 * times - behind[:, None])
    assert_allclose(position[9], 20.0 - 15.0 * (times - 0.1))
    assert_array_equal(speed[:, 0], [10.0, *[30.0] * 8, -15.0])
    assert_array_equal(acceleration, 0.0)
    entry, leave = LOADS.entry_exit_times().T
    assert_allclose(entry, [0.4, *behind / 30.0, 0.1])
    assert_allclose(leave - entry, [2.0, *[2 / 3] * 8, 4 / 3])


def test_scaled_wheels_are_those_of_scaled_vehicles():
    numbers = np.array([14e3, 1100.0, 9e5, 3e4, 3e6, 8e3])
    wheels, expected = (
        load_set(jb.Case(CASE.beam, loads=[jb.QuarterCar(*own, speed=-15.0)])).wheels
        for own in (numbers, 1.7 * numbers)
    )
    pairs = zip(*map(jax.tree.leaves, (wheels.scaled(np.array(1.7)), expected)), strict=True)
    for found, own in pairs:
        assert_allclose(found, own, rtol=1e-12)


def test_each_wheel_passes_each_position():
    places = np.array([3.0, 11.0])
    behind = np.concatenate([OFFSETS, OFFSETS + 25.0])
    expected = [(places + 4.0) / 10.0, *(places + behind[:, None]) / 30.0]
    found = LOADS.passages(places)
    assert_allclose(found, [*expected, 0.1 + (20.0 - places) / 15.0], rtol=1e-12)
    assert_array_equal(LOADS.rest_times(), 10 * [NEVER])


def test_cubics_are_the_positions():
    starts, cubics = LOADS.cubics()
    elapsed = 0.6 - starts[:, 0]
    found = np.sum(cubics[:, 0] * elapsed[:, None] ** np.arange(4), axis=1)
    assert_allclose(found, LOADS.kinematics(np.float64(0.6))[0])


def test_cubics_of_axles_that_go_left_and_speed_up():
    """x = L + d - v t - a t^2 / 2 of an axle d behind the first."""
    row = jb.Axles(offsets=[0.0, 3.0, 7.0], forces=1e3, speed=-12.0, deceleration=-2.0)
    starts, cubics = load_set(jb.Case(CASE.beam, loads=[row])).cubics()
    assert_array_equal(starts[:, 0], 0.0)
    assert_allclose(cubics[:, 0], [[20.0 + d, -12.0, -1.0, 0.0] for d in (0.0, 3.0, 7.0)])


def test_motion_of_the_surface_is_that_of_its_height():
    """By differences along the path, of a load that brakes."""
    load = jb.MovingMass(1.0, speed=20.0, deceleration=6.0)
    loads = load_set(jb.Case(CASE.beam, loads=[load], profile=PROFILE))
    step, time = 1e-4, 0.31
    times = time + step * np.array([-1.0, 0.0, 1.0])
    motion = loads.surface_motion(*loads.kinematics(times))
    assert motion is not None
    heights, rates, accelerations = motion
    low, middle, high = heights[0]
    assert rates[0, 1] == pytest.approx((high - low) / (2 * step), rel=1e-5)
    assert accelerations[0, 1] == pytest.approx((high - 2 * middle + low) / step**2, rel=1e-4)


def test_a_sine_profile_presses_by_springs_dampers_and_inertia():
    """y = a sin(2 pi x / L + p) at x = 20 m - v (t - 0.1 s): k y + c y' of a tyre, m y'' of a mass.

    A vehicle stands still where it begins until the run does.
    """
    mass = jb.MovingMass(5e3, speed=-15.0, entry_time=0.1)
    times, wave = np.array([-0.2, 0.0, 0.13, 0.4]), 2 * np.pi / 7.0
    angle, rate = wave * (20.0 - 15.0 * (np.maximum(times, 0.0) - 0.1)) + 0.4, -15.0 * wave
    moves = times >= 0
    height, speed = 5e-3 * np.sin(angle), 5e-3 * rate * np.cos(angle) * moves
    loads = load_set(jb.Case(CASE.beam, loads=[mass, CAR], profile=PROFILE, run=jb.Run(1.0)))
    weight, surface = contact.prescribed_disturbance(loads, times)
    tyre = 3e6 * height + 8e3 * speed
    assert_allclose(surface, np.stack([0 * tyre, tyre], axis=-1), rtol=1e-9, atol=1e-9)
    inertia = -5e3 * rate**2 * height * moves
    assert_allclose(weight, np.stack([inertia, tyre], axis=-1), rtol=1e-9, atol=1e-9)


def test_vehicles_at_rest_stay_so():
    """On surfaces of any heights: no rates, no accelerations, forces in equilibrium."""
    group = LOADS.wheels.vehicles[0]
    heights = np.cos(np.arange(8.0))[:, None]
    surface = LOADS.wheels.stiffness[group.wheels] * heights
    states = group.initial_state(surface)
    assert_allclose(states[:, 6:], 0.0, atol=1e-12)
    scale = np.max(np.abs(surface)) / 2615.0
    assert_allclose(group.accelerations(states, surface), 0.0, atol=1e-10 * scale)
    forces = group.spring_forces(states, surface)[:, 0].reshape(2, 4)
    # Springs give neither a force nor a moment together.
    assert_allclose(np.sum(forces, axis=1), 0.0, atol=1e-9 * np.max(np.abs(surface)))
    assert_allclose(forces @ OFFSETS, 0.0, atol=1e-8 * np.max(np.abs(surface)))


def test_level_raised_surfaces_lift_vehicles():
    group = LOADS.wheels.vehicles[1]
    states = group.initial_state(0.03 * LOADS.wheels.stiffness[group.wheels])
    assert_allclose(states[0, :, 0], [0.03, 0.03, 0.0, 0.0], atol=1e-14)


def test_states_and_forces_are_in_the_order_of_the_loads():
    states = np.arange(4.0 + LOADS.vehicle_states)[:, None]
    beam, (wagons, car) = split_states(4, LOADS, states)
    assert_array_equal(beam[:, 0], np.arange(4.0))
    assert wagons.shape == (2, 12, 1)
    assert wagons[1, 0, 0] == 16
    assert_array_equal(car[0, :, 0], np.arange(28.0, 32.0))
    forces = [np.full((8, 1), 2.0), np.full((1, 1), 3.0)]
    found = forces_of_wheels(LOADS, forces, np.zeros((10, 1)))
    assert_array_equal(found[:, 0], [0.0, *[2.0] * 8, 3.0])


def test_loads_without_inertia_or_springs_are_massless():
    force = jb.MovingForce(force=1.0, speed=2.0)
    assert load_set(jb.Case(CASE.beam, loads=[force])).massless
    for load in (MASS, CAR, jb.Oscillator(1e4, 1e6, speed=1.0)):
        assert not load_set(jb.Case(CASE.beam, loads=[force, load])).massless


# Contact forces at instants: fewer or more loads than modes, beside dense systems of each run.


@pytest.mark.parametrize(("loads", "modes"), [(1, 3), (3, 3), (7, 3), (40, 5)])
@pytest.mark.parametrize("compile", [lambda function: function, jax.jit])
def test_pressing_forces_obey_the_contact_law(loads, modes, compile):
    """Of masses from nothing to a hundred times the modal mass; none off the beam."""
    random = np.random.default_rng(loads)
    shape = random.normal(size=(4, loads, modes))
    mass = 10.0 ** random.uniform(-3, 2, size=(4, loads, 2))
    mass[:, ::3] = 0.0
    free = random.normal(size=(4, loads, 2))
    found = compile(_pressing_forces)(shape, mass, free)
    for instant in range(4):
        for run in range(2):
            coupling = mass[instant, :, run, None] * (shape[instant] @ shape[instant].T)
            expected = np.linalg.solve(np.eye(loads) + coupling, free[instant, :, run])
            assert_allclose(found[instant, :, run], expected, rtol=1e-9, atol=1e-11)


def test_instants_in_blocks_are_those_all_at_once(monkeypatch):
    """Of a mass, a force and a vehicle on springs, with commands of a shaker."""
    case = jb.Case(
        jb.Beam(20.0, 3e9, 8000.0, modes=4),
        sensors=[jb.Sensor(10.0)],
        actuators=[jb.Shaker(8.0)],
        loads=[
            jb.MovingMass(mass=2000.0, speed=20.0),
            jb.MovingForce(force=1e4, speed=25.0, entry_time=0.2),
            jb.QuarterCar(14e3, 1100.0, 9e5, 3e4, 3e6, 8e3, speed=15.0),
        ],
        run=jb.Run(1.0, sample_rate=200.0),
    )
    model, loads = modal_model(case), load_set(case)
    random = np.random.default_rng(0)
    times = np.linspace(0, 1.2, 101)
    states = random.normal(size=(101, model.state_count + loads.vehicle_states, 1))
    commands = random.normal(size=(101, model.command_matrix.shape[1], 1))
    whole = contact_at(model, loads, times, states, commands)
    monkeypatch.setattr(contact, "CONCRETE_BLOCK", 7 * loads.wheel_count)
    in_blocks = contact_at(model, loads, times, states, commands)
    for one, other in zip(jax.tree.leaves(whole), jax.tree.leaves(in_blocks), strict=True):
        assert one.shape == other.shape
        assert_allclose(other, one, rtol=1e-13, atol=1e-13)


# Positions along the beam, both sides of them, and extremes between them.

GENERAL = jb.Case(
    jb.Beam(
        20.0,
        mass_per_length=1e3,
        segments=[
            jb.Segment(7.77, flexural_rigidity=2e9),
            jb.Segment(12.23, flexural_rigidity=3e9),
        ],
        hinges=[jb.Hinge(4.321)],
    ),
    supports=[jb.Support(3.333), jb.Support(11.111, stiffness=1e8)],
    actuators=[jb.PointForce(6.789)],
    sensors=[jb.Sensor(9.876)],
    loads=[
        jb.VaryingForce(force=1e3, position=13.579),
        jb.MovingForce(force=1e3, speed=9.0, deceleration=2.7),  # stops at 15 m
        jb.MovingForce(force=1e3, speed=9.0),
        jb.VaryingForce(force=1e3, position=1.0, entry_time=1e3),
    ],
)
SPECIAL = [0.0, 1.0, 3.333, 4.321, 6.789, 7.77, 9.876, 11.111, 13.579, 15.0, 20.0]


def test_special_positions():
    found = np.unique(special_positions(GENERAL))
    assert_allclose(found, SPECIAL, rtol=1e-12, atol=1e-12)
    along = positions_along(GENERAL)
    assert along.size == 101 + len(SPECIAL) - 3 - 1  # 0, 15, 20 and 1 m are on the grid
    assert np.all(np.diff(along) > 1e-9)
    assert not len(np.setdiff1d(np.round(SPECIAL, 9), np.round(along, 9)))
    patch = jb.Patch(0.2, 0.45, 1e-3)
    case = jb.Case(jb.Beam(1.0, 2.0, 1.0), actuators=[patch])
    assert_allclose(np.unique(special_positions(case)), [0.0, 0.2, 0.45, 1.0])


def test_sides():
    x = np.array([0.0, 2.0, 3.333, 10.0, 20.0])
    for quantity, left in (("deflection", []), ("moment", [0, 2, 4]), ("shear", range(5))):
        found = sections(GENERAL, x, quantity)
        assert_array_equal(found.left_of, list(left))
        values = np.concatenate([np.zeros(5), -1.0 - np.arange(len(left))])
        expected = np.zeros(5)
        expected[list(left)] = -1.0 - np.arange(len(left))
        assert_array_equal(found.smallest(values), expected)
        assert_array_equal(found.largest(values), np.zeros(5))
    assert_allclose(sections(GENERAL, x, "moment").points[5:], [0.0, 3.333, 20.0], atol=3e-6)


@pytest.mark.parametrize("place", [3.14159, 0.05, 19.99])
@pytest.mark.parametrize(
    "shape", [lambda d: -(d**2), lambda d: -np.abs(d), lambda d: np.where(d > 0, -d, 3 * d)]
)
def test_extremes_between_positions(place, shape):
    """A smooth peak, a kink, and a steep one, of size 1 at a place; the other extreme at an end."""

    def evaluate(x):
        return {"value": 1.0 + shape(x - place)}

    def curves(found):
        values = np.stack([found["value"], -found["value"]], -1)
        return values, np.abs(values).max(), [np.zeros((values.shape[0], 0))] * 2

    x, found = refined(dataclasses.replace(GENERAL, loads=[]), evaluate, curves)
    assert np.all(np.diff(x) > 0)
    assert_allclose(found["value"], 1.0 + shape(x - place))
    assert_allclose(found["value"].max(), 1.0, rtol=1e-4)
    assert x.size < 250


def test_peaks_of_sensors_on_both_sides_of_a_support():
    """Those of a shear force in continuous time, against its samples at the passages of the force.

    A sensor nearer to the support than `left_of` has its jump within a step, and peaks 12 % beyond.
    """
    beam = jb.Beam(20.0, 6e9, 1e4, modes=4, damping_ratio=0.02)
    case = jb.Case(beam, supports=[jb.Support(11.3)], loads=[jb.MovingForce(force=2e5, speed=25.0)])
    places = [float(left_of(case, 11.3)), 11.3]
    run = jb.Run(1.0, sample_rate=100.0)
    case = dataclasses.replace(case, sensors=[jb.Sensor(x, "shear") for x in places], run=run)
    passage = 11.3 / 25.0
    times = np.union1d(np.linspace(0.0, 1.0, 2001), passage + np.array([-1e-7, 1e-7]))
    record = jb.simulate(case, times)
    extremes = jb.simulate(case).extremes
    swept = jb.sweep(case, {"loads.0.speed": np.array([25.0, 26.0])})
    for i, side in enumerate(("left", "right")):
        history = np.asarray(record.shear_force(11.3, side))
        assert_allclose(extremes.smallest[i], history.min(), atol=10.0)  # N, of 200 kN
        assert_allclose(extremes.largest[i], history.max(), atol=10.0)
        assert_allclose(swept.peak_shear[0, i], np.abs(history).max(), rtol=1e-4)
