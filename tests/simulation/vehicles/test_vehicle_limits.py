"""Vehicles against scipy, closed relations, and the loads that they become in a limit."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from tests.differences import assert_close
from tests.oracles import vehicle_elements
from tests.oracles.modal_equations import Span

SPAN = Span(20.0, 2e10, 1.2e4, modes=3, damping_ratio=0.02)
BEAM = jb.Beam(20.0, 2e10, 1.2e4, 0.02, modes=3)
CAR = {
    "body_mass": 14000.0,
    "axle_mass": 1100.0,
    "suspension_stiffness": 9e5,
    "suspension_damping": 3e4,
    "tyre_stiffness": 3e6,
    "tyre_damping": 8e3,
}
TIMES = np.linspace(0.0, 1.5, 76)
SENSORS = [jb.Sensor(7.0), jb.Sensor(12.0)]
WEIGHT = 3e5  # N
MASS = WEIGHT / 9.81


def case_of(*loads, profile=None, beam=BEAM, duration=1.5, sensors=SENSORS, **options) -> jb.Case:
    return jb.Case(
        beam,
        loads=loads,
        profile=profile,
        sensors=sensors,
        run=jb.Run(duration, 100.0),
        **options,
    )


PROFILES = {
    "flat": None,
    "sine": jb.profiles.SineProfile(4e-3, 6.0, 0.7),
    "ramp": jb.profiles.RampProfile(4.0, 6.0, 0.01),
    "spectrum": jb.profiles.SpectrumProfile([0.1, 0.3], [2e-3, 1e-3], [0.4, 2.0]),
}


@pytest.mark.parametrize("name", PROFILES)
def test_a_quarter_car_is_that_of_scipy(name):
    """Also braking, before and behind the beam, starting on a profile that is not level."""
    profile, car = PROFILES[name], vehicle_elements.Car(**CAR)
    case = case_of(
        jb.QuarterCar(**CAR, speed=19.0, start_position=-5.0, deceleration=1.3), profile=profile
    )

    def motion(t):
        return -5.0 + 19.0 * t - 0.65 * t**2, 19.0 - 1.3 * t

    def heights(x):
        return (0.0, 0.0) if profile is None else tuple(map(float, profile.heights(x)[:2]))

    places = np.concatenate([[0.0, 20.0], [] if profile is None else profile.kinks()])
    events = (19.0 - np.sqrt(19.0**2 - 2.6 * (places + 5.0))) / 1.3
    states, forces = vehicle_elements.quarter_cross(SPAN, car, motion, heights, events, TIMES)
    record = jb.simulate(case, TIMES, tolerance=1e-10)
    deflection = states[:, :3] @ SPAN.shapes(np.array([7.0, 12.0])).T
    assert_close(record.deflection, deflection, 1e-8)
    assert_close(record.body_displacement, states[:, 6:8], 1e-8)
    assert_close(record.body_velocity, states[:, 8:10], 1e-8)
    assert_close(record.contact_force[1:-1, 0], forces[1:-1], 1e-8)


def deflections(load, times=TIMES, profile=None):
    return np.asarray(jb.simulate(case_of(load, profile=profile), times).deflection)


def test_stiff_springs_become_a_moving_mass():
    """The difference falls as 1 / stiffness: the mass on the spring lags by m a / k."""
    mass = deflections(jb.MovingMass(MASS, speed=20.0))
    errors = [
        np.max(
            np.abs(deflections(jb.Oscillator(MASS, k, 2 * np.sqrt(k * MASS), speed=20.0)) - mass)
        )
        for k in (4e9, 1.6e10)
    ]
    assert errors[1] < 0.02 * np.max(np.abs(mass))
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_soft_springs_become_a_moving_force():
    """The force of the spring beyond the weight is proportional to its stiffness."""
    force = deflections(jb.MovingForce(force=WEIGHT, speed=20.0))
    errors = [
        np.max(np.abs(deflections(jb.Oscillator(MASS, k, speed=20.0)) - force)) for k in (1e3, 1e2)
    ]
    assert errors[1] < 1e-5 * np.max(np.abs(force))
    assert errors[0] / errors[1] == pytest.approx(10.0, rel=1e-2)


def test_the_mass_of_a_wheel_goes_to_zero():
    """The response is a smooth function of the mass on the surface: the difference is linear."""
    light = jb.Oscillator(MASS, 4e6, 6e4, speed=20.0)
    without = deflections(light)
    errors = [
        np.max(np.abs(deflections(dataclasses.replace(light, wheel_mass=m)) - without))
        for m in (1.0, 0.1)
    ]
    assert errors[0] / errors[1] == pytest.approx(10.0, rel=1e-2)


def test_masses_in_a_row_are_moving_masses():
    row = jb.Axles(offsets=[0.0, 6.0], masses=[2e4, 3e4], speed=20.0, deceleration=2.0)
    first, second = (
        jb.MovingMass(m, speed=20.0, deceleration=2.0, start_position=x)
        for m, x in ((2e4, 0.0), (3e4, -6.0))
    )
    one, two = (jb.simulate(case_of(*loads), TIMES) for loads in ([row], [first, second]))
    assert_close(one.deflection, two.deflection, 1e-12)
    assert_close(one.contact_force, two.contact_force, 1e-11)


def test_forces_in_a_row_are_moving_forces():
    row = jb.Axles(offsets=[0.0, 6.0, 9.0], forces=[1e5, 2e5, 1.5e5], speed=-20.0)
    forces = [
        jb.MovingForce(force=f, speed=-20.0, start_position=20.0 + x)
        for f, x in ((1e5, 0.0), (2e5, 6.0), (1.5e5, 9.0))
    ]
    one, two = (jb.simulate(case_of(*loads), TIMES) for loads in ([row], forces))
    assert_close(one.deflection, two.deflection, 1e-12)
    assert_close(one.contact_force, two.contact_force, 1e-12)


def test_work_of_the_contact_forces_is_all_accounted_for():
    """Energy of beam and car: by weight of the wheel on its path, less what dampers take.

    The car is above a surface that moves at y': the force F - P beyond the static one does the work
    (F - P) y' on it, and F takes F w_t from the beam. Kinetic and elastic energy and dissipation
    of both follow.
    """
    profile = jb.profiles.BumpProfile(-3.0, 6.0, 0.02)
    span, beam = dataclasses.replace(SPAN, modes=2), dataclasses.replace(BEAM, modes=2)
    load = jb.QuarterCar(**CAR, speed=20.0, start_position=-5.0)
    case = case_of(load, profile=profile, beam=beam)
    # Gauss points between the events, for the integrals over time: several in each period.
    events = (np.array([-5.0, -3.0, 0.0, 6.0, 20.0]) + 5.0) / 20.0
    points, weights = np.polynomial.legendre.leggauss(120)
    halves = np.diff(events) / 2
    times = (events[:-1, None] + halves[:, None] * (points + 1)).ravel()
    weights = (halves[:, None] * weights).ravel()
    ends = np.array([events[0], events[-1] * (1 - 1e-12)])
    all_times = np.sort(np.concatenate([times, ends]))
    record = jb.simulate(case, all_times, tolerance=1e-10)
    inner = slice(1, -1)

    x = -5.0 + 20.0 * times
    on_beam = (x > 0) & (x < 20.0)
    place = np.where(on_beam, x, 0.0)
    q, rates = (np.asarray(part)[inner] for part in (record.coordinates, record.rates))
    shapes, slopes = (np.where(on_beam[:, None], span.shapes(place, d), 0.0) for d in (0, 1))
    sign = np.sign(record.modes.shapes(np.array([1.0]))[0] * span.shapes(1.0))
    shapes, slopes = shapes * sign, slopes * sign
    beam_rate = np.sum(shapes * rates, axis=1)
    slope = np.sum(slopes * q, axis=1) + profile.heights(x)[1]
    surface_rate = beam_rate + 20.0 * slope
    force = np.asarray(record.contact_force)[inner, 0]
    static = 9.81 * (CAR["body_mass"] + CAR["axle_mass"])

    velocity = np.asarray(record.body_velocity)[inner]
    body, axle = velocity.T
    frequencies = span.frequencies
    power = {
        "into the car": (force - static) * surface_rate,
        "out of the suspension": CAR["suspension_damping"] * (axle - body) ** 2,
        "out of the tyre": CAR["tyre_damping"] * (surface_rate - axle) ** 2,
        "into the beam": -force * beam_rate,
        "out of the beam": 0.04 * np.sum(frequencies * rates**2, axis=1),
    }
    work = {name: weights @ part for name, part in power.items()}

    def car_energy(i, y):
        u, v = np.asarray(record.body_displacement)[i], np.asarray(record.body_velocity)[i]
        kinetic = CAR["body_mass"] * v[0] ** 2 + CAR["axle_mass"] * v[1] ** 2
        springs = CAR["suspension_stiffness"] * (u[1] - u[0]) ** 2
        return (kinetic + springs + CAR["tyre_stiffness"] * (y - u[1]) ** 2) / 2

    def beam_energy(i):
        q, rate = np.asarray(record.coordinates)[i], np.asarray(record.rates)[i]
        return np.sum(rate**2 + (frequencies * q) ** 2) / 2

    car = work["into the car"] - work["out of the suspension"] - work["out of the tyre"]
    assert_allclose(car_energy(-1, 0.0) - car_energy(0, 0.0), car, rtol=1e-6)
    left = work["into the beam"] - work["out of the beam"]
    assert_allclose(beam_energy(-1) - beam_energy(0), left, rtol=1e-6)


def test_travel_to_the_left_mirrors():
    """On a beam of equal halves with a mirrored profile."""
    numbers = {
        "axle_positions": [2.0, -3.0],
        "axle_masses": [700.0, 900.0],
        "suspension_stiffness": [4e5, 8e5],
        "suspension_damping": [1e4, 2e4],
        "tyre_stiffness": [2e6, 3e6],
        "tyre_damping": [2e3, 4e3],
    }
    loads = [
        jb.vehicles.HalfCar(12000.0, 6e4, **numbers, speed=v, start_position=x, deceleration=1.0)
        for v, x in ((20.0, -2.0), (-20.0, 22.0))
    ]
    profiles = jb.profiles.BumpProfile(-3.0, 8.0, 0.02), jb.profiles.BumpProfile(12.0, 23.0, 0.02)
    right, left = (
        jb.simulate(case_of(load, profile=p, sensors=[jb.Sensor(x)]), TIMES)
        for load, p, x in zip(loads, profiles, (7.0, 13.0), strict=True)
    )
    assert_close(left.deflection, right.deflection, 1e-11)
    assert_close(left.contact_force, right.contact_force, 1e-11)
    assert_close(left.body_displacement, right.body_displacement, 1e-11)


def test_vehicles_that_meet_are_symmetrical():
    right = jb.QuarterCar(**CAR, speed=20.0)
    left = jb.QuarterCar(**CAR, speed=-20.0)
    record = jb.simulate(case_of(right, left, sensors=[jb.Sensor(7.0), jb.Sensor(13.0)]), TIMES)
    assert_close(record.deflection[:, 0], record.deflection[:, 1], 1e-11)
    assert_close(record.contact_force[:, 0], record.contact_force[:, 1], 1e-11)
    assert_close(record.body_displacement[:, :2], record.body_displacement[:, 2:], 1e-11)


def test_a_table_of_positions_is_the_braking_that_it_lists():
    """A cubic spline through a parabola is the parabola."""
    profile = jb.profiles.SineProfile(4e-3, 6.0, 0.7)
    braking = jb.QuarterCar(**CAR, speed=20.0, start_position=-4.0, deceleration=3.0)
    times = np.linspace(0.0, 1.6, 9)
    positions = -4.0 + 20.0 * times - 1.5 * times**2
    table = jb.QuarterCar(**CAR, times=times, positions=positions)
    one, two = (jb.simulate(case_of(load, profile=profile), TIMES) for load in (braking, table))
    assert_close(one.deflection, two.deflection, 1e-9)
    assert_close(one.contact_force, two.contact_force, 1e-9)


@pytest.mark.parametrize("start", [-8.0, -8.5])
def test_a_load_begins_in_equilibrium_on_a_raised_surface(start):
    """It stays so on a level part, raised by 0.1 m before the beam, until it meets the slope."""
    profile = jb.profiles.StepProfile(-6.0, -1.0, -0.1)
    raised = jb.profiles.TableProfile([-9.0, -5.0, -1.0], [0.1, 0.1, 0.0])
    for surface, height in ((profile, 0.0), (raised, 0.1)):
        load = jb.QuarterCar(**CAR, speed=1.0, start_position=start)
        case = case_of(load, profile=surface, duration=0.2)
        record = jb.simulate(case)
        expected = surface.heights(start)[0]
        assert_allclose(record.body_displacement[0], expected, atol=1e-12)
        assert abs(expected - height) < 1e-2
        if surface is profile:
            assert_allclose(record.contact_force, 15100.0 * 9.81, rtol=1e-12)
