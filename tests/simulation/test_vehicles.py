"""Vehicles on beams: published peaks, records, limits, derivatives, and loops that read them.

The runs of `tests/data` are those of an independent implementation: deflections with the static
correction to 1e-5 of the peak, contact forces to 1e-5 of the static load; of rigid wheelsets on a
rough rail, where all modes matter, to 2e-4, as its report states. Heights of bodies follow the beam
without the correction: to 2e-4 of the largest with 16 modes (1e-6 with 40), accelerations to 3e-3
between samples.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.model.load_set import load_set
from jaxbeam.simulation.integration_plan import integration_plan
from jaxbeam.simulation.stored_record import record_from_xarray
from jaxbeam.simulation.views import contact_sentence, wheel_labels
from tests.case.loads.reference import (
    DATA,
    RUNS,
    body_index,
    largest,
    simulated,
)
from tests.differences import assert_close, plan_of
from tests.oracles import vehicle_elements
from tests.oracles.modal_equations import Span
from tests.simulation.test_record import assert_same

# Others have 16. The two spans have the 40 of the reference, without the correction: it misses
# 2.5e-5 of those beyond, as it states.
MODES = {"1d-oscillator-two-span": 40, "2k-fra6-wagon-ss25": 30}
SAMPLES = {
    "1d-oscillator-two-span": 151,
    "2h-isoA-quarter-ss": 1301,
    "1p-train-4-manchester-ss50": 601,
}  # axles on a rough road


@pytest.mark.parametrize("name", RUNS)
def test_runs_are_those_of_the_reference(name):
    run = RUNS[name]
    record, at = simulated(run, MODES.get(name, 16), SAMPLES.get(name, 301))
    deflection, peaks = record.deflection, record.peak_deflection
    if MODES.get(name) != 40:
        deflection = jb.sections.corrected_deflection(record, record.case.sensor_positions)
        peaks = [largest(-history) for history in deflection.T]
    for i, expected in enumerate(run["deflection"].values()):
        found = deflection[[at(share * run["duration"]) for share in run["fractions"]], i]
        scale = abs(expected["w_min"])
        np.testing.assert_allclose(found, expected["w_at_fractions"], rtol=0, atol=1e-5 * scale)
        assert peaks[i] == pytest.approx(scale, rel=2e-5)
    tolerance = 2e-4 if name.startswith("2k") else 1e-5
    for wheel in run["contact"]:
        force = record.contact_force[:, wheel["wheel"]]
        for extreme in ("min", "max"):
            found = force[at(wheel[f"t_{extreme}"])]
            assert found == pytest.approx(wheel[f"F_{extreme}"], abs=tolerance * wheel["static"])
    for body in run["bodies"]:
        column, sign = body_index(record, run, body)
        motion = sign * record.body_displacement[:, column]
        scale = max(body["u_max"], -body["u_min"])
        assert motion[-1] == pytest.approx(body["u_end"], abs=2e-4 * scale)
        extremes = -largest(-motion), largest(motion)
        np.testing.assert_allclose(extremes, [body["u_min"], body["u_max"]], atol=2e-4 * scale)
        motion = sign * record.body_acceleration[:, column]
        expected = np.array([body["acc_min"], body["acc_max"]])
        extremes = -largest(-motion), largest(motion)
        np.testing.assert_allclose(extremes, expected, atol=3e-3 * np.max(np.abs(expected)))


@pytest.mark.parametrize("entry", DATA["trains"], ids=lambda entry: entry["train"])
def test_high_speed_trains_at_two_speeds(entry):
    """Lowest deflection at midspan; 15 modes without a correction for 20 with it."""
    for speed, expected in zip(np.array(entry["speeds_kmh"]) / 3.6, entry["w_min"], strict=True):
        load = jb.Axles(train=entry["train"], speed=speed)
        length = load.vehicle(np.float64(9.81)).offsets[-1] + 25.0
        case = jb.Case(
            jb.Beam(25.0, 3e10, 15e3, 0.01, modes=15),
            sensors=[jb.Sensor(12.5)],
            loads=[load],
            run=jb.Run(length / speed + 0.5, 200.0),
        )
        record = jb.simulate(case)
        assert record.peak_deflection[0] == pytest.approx(-expected, rel=1e-5)
        assert np.all(np.isfinite(record.contact_force))


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


RUN_TIMES = np.linspace(0.0, 1.4, 57)
VARIED_CAR = {
    "body_mass": 14000.0,
    "axle_mass": 1100.0,
    "suspension_stiffness": 9e5,
    "suspension_damping": 3e4,
    "tyre_stiffness": 3e6,
    "tyre_damping": 8e3,
}
VARIED = jb.Case(
    jb.Beam(20.0, 2e10, 1.2e4, 0.02, modes=2),
    sensors=[jb.Sensor(7.0)],
    loads=[jb.QuarterCar(**VARIED_CAR, speed=20.0, start_position=-5.0, deceleration=1.0)],
    profile=jb.profiles.BumpProfile(-4.0, 3.0, 0.02),
    run=jb.Run(1.4, 40.0),
)
NUMBERS = [f"loads.0.{name}" for name in (*VARIED_CAR, "speed", "deceleration", "start_position")]
NUMBERS += ["profile.height", "profile.start", "profile.end", "run.gravity"]


def summary(record: jb.Record):
    """Numbers of order one of a record."""
    return jnp.concatenate(
        [
            1e3 * record.deflection[1::4, 0],
            1e-5 * record.contact_force[1::4, 0],
            1e2 * record.body_displacement[1::4].ravel(),
            1e-1 * record.body_acceleration[1::4].ravel(),
            1e3 * record.peak_deflection,
        ]
    )


def of_factors(case, numbers, plan):
    """Function from factors of numbers to the summary of a run with them."""
    values = {address: jb.addresses(case)[address] for address in numbers}

    def function(factors):
        changed = {a: f * v for f, (a, v) in zip(factors, values.items(), strict=True)}
        return summary(jb.simulate(jb.replace(case, changed), RUN_TIMES, plan))

    return function


def test_reverse_gradients_by_every_number():
    function = of_factors(VARIED, NUMBERS, plan_of(VARIED, substeps=6))
    point = np.ones(len(NUMBERS))
    weights = np.cos(np.arange(function(point).size))
    forward, reverse = (
        jax.jit(derivative(lambda factors: weights @ function(factors)))(jnp.asarray(point))
        for derivative in (jax.jacfwd, jax.jacrev)
    )
    assert_allclose(reverse, forward, rtol=1e-8, atol=1e-8 * np.max(np.abs(forward)))


def test_a_plan_serves_traced_numbers():
    """One that `integration_plan` makes, inside `jit`."""
    plan = integration_plan(VARIED, RUN_TIMES)
    function = of_factors(VARIED, NUMBERS, plan)
    known = function(np.ones(len(NUMBERS)))
    traced = jax.jit(function)(jnp.ones(len(NUMBERS)))
    assert_close(traced, known, 1e-10)


SWEEPS = {
    "numbers of the vehicle": {
        "loads.0.suspension_stiffness": [6e5, 1.2e6],
        "loads.0.body_mass": [1e4, 2e4],
    },
    "speeds": {"loads.0.speed": [18.0, 25.0], "loads.0.tyre_damping": [0.0, 2e4]},
    "the profile": {"profile.height": [0.0, 0.03]},
}


@pytest.mark.parametrize("name", SWEEPS)
def test_sweeps_are_single_runs(name):
    over = SWEEPS[name]
    found = jb.sweep(VARIED, over, progress=False)
    assert not found.failed.any()
    for index in np.ndindex(*(len(values) for values in over.values())):
        chosen = {a: values[i] for i, (a, values) in zip(index, over.items(), strict=True)}
        single = jb.simulate(jb.replace(VARIED, chosen))
        peaks = found.peak_deflection.values[index]
        assert_allclose(peaks, single.peak_deflection, rtol=1e-6)


FORCE = jb.PointForce(9.0)
LOOPS = {
    "sampled feedback": ([jb.Sensor(7.0, "velocity")], jb.Feedback([2e5], period=0.01)),
    "continuous feedback": ([jb.Sensor(7.0, "velocity")], jb.Feedback([2e5])),
    "regulator": ([jb.Sensor(7.0)], jb.LQR([0.1] * 4, [1e-9], period=5e-3)),
}


@pytest.mark.parametrize("name", LOOPS)
def test_closed_loops_with_a_vehicle(name):
    sensors, controller = LOOPS[name]
    case = dataclasses.replace(
        VARIED,
        sensors=sensors,
        actuators=[FORCE],
        controller=controller,
        run=jb.Run(1.4, 40.0),
    )
    plan = integration_plan(case, RUN_TIMES)
    known = jb.simulate(case, RUN_TIMES, plan)
    open_loop = jb.simulate(dataclasses.replace(case, actuators=(), controller=None), RUN_TIMES)
    assert known.peak_deflection[0] < open_loop.peak_deflection[0]
    assert np.max(np.abs(known.command)) > 0
    traced = jax.jit(lambda factor: _with_mass(case, factor, plan))(jnp.ones(()))
    for one, other in zip(traced, _with_mass(case, np.ones(()), plan), strict=True):
        assert_close(one, other, 1e-9)


def _with_mass(case, factor, plan):
    changed = jb.replace(case, {"loads.0.body_mass": factor * VARIED_CAR["body_mass"]})
    record = jb.simulate(changed, RUN_TIMES, plan)
    return record.deflection, record.command, record.contact_force, record.body_acceleration


BODY, AXLE, SUSPENSION, DAMPER, TYRE, WALL = 0.2, 0.05, 60.0, 0.4, 900.0, 0.5
LENGTH, SPEED, PLACE, SENSOR, GAIN, G, END = 0.6, 1.5, 0.22, 0.3, 900.0, 9.81, 0.5
CONTROLLED_SPAN = Span(LENGTH, 11.68, 0.535, 2, 0.03)


def change(t: float, z: np.ndarray, command: float | None) -> np.ndarray:
    """Rates of modes, body and axle (coordinates, then rates) under a command, or its law (None).

    Heights are upwards, from where springs are not strained on a level road.
    """
    (q, (body, axle)), (p, (body_rate, axle_rate)) = np.split(z[:4], 2), np.split(z[4:], 2)
    x = SPEED * t
    on_beam = x <= LENGTH
    shape, slope = CONTROLLED_SPAN.shapes(x) * on_beam, CONTROLLED_SPAN.shapes(x, 1) * on_beam
    force = TYRE * (shape @ q - axle) + WALL * (shape @ p + SPEED * slope @ q - axle_rate)
    spring = SUSPENSION * (axle - body) + DAMPER * (axle_rate - body_rate)
    own = -GAIN * CONTROLLED_SPAN.shapes(SENSOR) @ q if command is None else command
    pushed = -(CONTROLLED_SPAN.frequencies**2) * q - CONTROLLED_SPAN.damping @ p - shape * force
    pushed = pushed + CONTROLLED_SPAN.shapes(PLACE) * own
    return np.concatenate([z[4:], pushed, [spring / BODY - G, (force - spring) / AXLE - G]])


def deflections(times: np.ndarray, period: float | None) -> np.ndarray:
    """Deflections at the sensor (m) at some times (s) before the end, of a sampled law or none."""
    axle = -(BODY + AXLE) * G / TYRE
    z, command, found = np.zeros(8), None, []
    z[2:4] = axle - BODY * G / SUSPENSION, axle  # at rest on the road
    samples = np.array([0.0]) if period is None else np.arange(0.0, END, period)
    edges = np.append(np.unique(np.append(samples, LENGTH / SPEED)), END)
    for start, end in itertools.pairwise(edges):
        if period is not None and start in samples:
            command = -GAIN * CONTROLLED_SPAN.shapes(SENSOR) @ z[:2]
        inside = times[(times >= start - 1e-12) & (times < end - 1e-12)]
        at = np.append(np.maximum(inside, start), end)
        run = solve_ivp(
            change, (start, end), z, "DOP853", at, args=(command,), rtol=1e-11, atol=1e-13
        )
        z, found = run.y[:, -1], [*found, run.y[:2, :-1]]
    return CONTROLLED_SPAN.shapes(SENSOR) @ np.concatenate(found, axis=1)


@pytest.mark.parametrize("period", [None, 0.01], ids=["continuous law", "sampled law"])
def test_a_vehicle_on_a_beam_under_feedback(period):
    car = jb.QuarterCar(BODY, AXLE, SUSPENSION, DAMPER, TYRE, WALL, speed=SPEED)
    case = jb.Case(
        jb.Beam(LENGTH, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.PointForce(PLACE)],
        sensors=[jb.Sensor(SENSOR)],
        loads=[car],
        controller=jb.Feedback([GAIN], period=period),
        run=jb.Run(END, 400.0),
    )
    record = jb.simulate(case, tolerance=1e-9)
    expected = deflections(np.asarray(record.times)[:-1], period)
    found = np.asarray(record.deflection)[:-1, 0]
    assert_allclose(found, expected, rtol=0, atol=1e-7 * np.abs(expected).max())
