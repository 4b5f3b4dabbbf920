"""A quarter car against scipy; mirror images, tables of positions, starts on raised surfaces."""

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
