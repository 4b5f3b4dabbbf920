"""Unilateral contact: published numbers, scipy from event to event, impacts, what is refused."""

import dataclasses
import itertools
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from experiments.thesis.cases import critical_speed, two_spans, with_modes, with_sensors
from jaxbeam.case.library import rigs
from jaxbeam.simulation import unilateral as lifting
from jaxbeam.simulation.integration_plan import integration_plan
from tests.oracles.lifting_wheels import Crossing, Wheel, moreau_steps

UNIT = {"length": 1.0, "flexural_rigidity": 1.0, "mass_per_length": 1.0, "damping_ratio": 0.02}
LIFTING = jb.UnilateralContact()
PUBLISHED = json.loads((Path(__file__).parents[1] / "data" / "contact.json").read_text())
TESTED = ["rigid_N10", "rigid_N20", "linear_kc4.8e+03_N10", "hertz_C4.8e+05_N20"]


def case_of(published, run):
    """Case of published parameters, and the contact of one of its runs."""
    given, modes = published["parameters"], int(run.rpartition("_N")[2])
    speed, mass, body = given["speed"], given["wheel_mass"], given["body"]
    law, factor = run.rpartition("_N")[0].partition("_")[::2]
    word = {"linear": "stiffness", "hertz": "hertz_stiffness"}
    springs = {word[law]: float(factor.removeprefix("kc").removeprefix("C"))} if factor else {}
    contact = jb.UnilateralContact(**springs)
    if body is None:
        load = jb.MovingMass(mass=mass, speed=speed)
    else:
        springs = {"stiffness": body["k"], "damping": body["c"]}
        load = jb.Oscillator(mass=body["m"], wheel_mass=mass, speed=speed, **springs)
    profile, weight = given["profile"], given["static_contact_force"]
    if profile != "flat":
        profile = jb.profiles.BumpProfile(profile["x0"], profile["x1"], profile["height"])
    return jb.Case(
        jb.Beam(**UNIT, modes=modes),
        sensors=[jb.Sensor(0.5)],
        loads=[load],
        profile=None if profile == "flat" else profile,
        contact=contact,
        run=jb.Run(
            1.25 / speed,
            sample_rate=320 * speed,
            gravity=weight / (mass + (body["m"] if body else 0.0)),
        ),
    )


@pytest.mark.parametrize("run", TESTED)
@pytest.mark.parametrize("published", PUBLISHED, ids=lambda one: one["case"])
def test_published_flights(published, run):
    expected = published["runs"][run]
    record = jb.simulate(case_of(published, run))
    flights, events = record.flights, [e for e in expected["first_events"] if e[2]["x"] < 1]
    lifted = [event for event in events if event[0] == "separation"]
    assert flights.wheel.size >= len(lifted)
    assert bool(flights.wheel.size) == bool(lifted)
    tolerance = {"rtol": 2e-6}
    assert_allclose(record.smallest[0], expected["w_mid_min"], rtol=2e-6)
    for i, (_, time, about) in enumerate(lifted):
        assert_allclose(flights.lift_time[i], time, **tolerance)
        assert_allclose(flights.lift_position[i], about["x"], **tolerance)
    landed = [event for event in events if event[0] == "landing"]
    for i, (_, time, about) in enumerate(landed):
        assert_allclose(flights.landing_time[i], time, **tolerance)
        assert_allclose(flights.landing_position[i], about["x"], **tolerance)
        if "impulse" in about:
            assert_allclose(flights.approach_speed[i], about["approach_velocity"], rtol=2e-6)
            assert_allclose(flights.impulse[i], about["impulse"], rtol=2e-6)


def bump(x, start=0.3, end=0.4, height=0.004):
    turn = 2 * np.pi / (end - start)
    if not start <= x < end:
        return 0.0, 0.0, 0.0
    sine, cosine = np.sin(turn * (x - start)), np.cos(turn * (x - start))
    return tuple(height / 2 * np.array([1 - cosine, turn * sine, turn**2 * cosine]))


def high_bump(x):
    return bump(x, height=0.03)


def ramp(start, end):
    def heights(x):
        inside = start <= x < end
        return (
            0.02 * np.clip((x - start) / (end - start), 0.0, 1.0),
            0.02 / (end - start) * inside,
            0.0,
        )

    return heights


def level(x):
    return 0.0, 0.0, 0.0


V, G = 0.3 * np.pi, 10 / 3  # m/s, m/s^2
BUMP = jb.profiles.BumpProfile(0.3, 0.4, 0.004)
HIGH = jb.profiles.BumpProfile(0.3, 0.4, 0.03)
BODY = {"mass": 0.25, "damping": 1.5, "speed": V}
OF_BODY = {"body": 0.25, "damper": 1.5, "speed": V}
# Loads, profile, contact; wheels, the same profile, its kinks.
CASES = {
    "take-off before the end": (
        [jb.MovingMass(0.5, np.pi / 2)], None, LIFTING, [Wheel(0.5, 0.5 * G, np.pi / 2)], level, ()
    ),
    "two masses": (
        [jb.MovingMass(0.3, V), jb.MovingMass(0.2, V, entry_time=0.3 / V)], BUMP, LIFTING,
        [Wheel(0.3, 0.3 * G, V), Wheel(0.2, 0.2 * G, V, start=-0.3)], bump, (0.3, 0.4),
    ),
    "sprung wheel": (
        [jb.Oscillator(stiffness=40.0, wheel_mass=0.05, **BODY)], HIGH, LIFTING,
        [Wheel(0.05, 0.3 * G, spring=40.0, **OF_BODY)], high_bump, (0.3, 0.4),
    ),
    "tyre with a damper": (
        [jb.Oscillator(stiffness=200.0, **BODY)], HIGH, LIFTING,
        [Wheel(0.0, 0.25 * G, spring=200.0, **OF_BODY)], high_bump, (0.3, 0.4),
    ),
    "tyre without damper": (
        [jb.Oscillator(0.25, 200.0, speed=V)], HIGH, LIFTING,
        [Wheel(0.0, 0.25 * G, V, spring=200.0, body=0.25)], high_bump, (0.3, 0.4),
    ),
    "ramp before the beam": (
        [jb.MovingMass(0.3, V, start_position=-0.3)], jb.profiles.RampProfile(-0.2, 0.1, 0.02),
        LIFTING, [Wheel(0.3, 0.3 * G, V, start=-0.3)], ramp(-0.2, 0.1), (-0.2, 0.1),
    ),
    "ramp on the beam": (
        [jb.MovingMass(0.3, V)], jb.profiles.RampProfile(0.2, 0.3, 0.02), LIFTING,
        [Wheel(0.3, 0.3 * G, V)], ramp(0.2, 0.3), (0.2, 0.3),
    ),
    "spring of Hertz": (
        [jb.MovingMass(0.3, V)], BUMP, jb.UnilateralContact(hertz_stiffness=2e4),
        [Wheel(0.3, 0.3 * G, V, law=(2e4, 1.5))], bump, (0.3, 0.4),
    ),
}  # fmt: skip


def lifting_case(name, modes=4):
    loads, profile, contact, wheels, _, _ = CASES[name]
    end = 1.1 * max((1.0 - wheel.start) / wheel.speed for wheel in wheels)
    return jb.Case(
        jb.Beam(**UNIT, modes=modes),
        sensors=[jb.Sensor(0.37), jb.Sensor(0.5, quantity="moment")],
        loads=loads,
        profile=profile,
        contact=contact,
        run=jb.Run(end, sample_rate=200.0, gravity=G),
    )


@pytest.mark.parametrize("name", CASES)
def test_flights_agree_with_integration_from_event_to_event(name):
    *_, wheels, profile, kinks = CASES[name]
    case = lifting_case(name)
    record = jb.simulate(case)
    frequencies = np.sqrt(np.asarray(record.modes.stiffness))
    oracle = Crossing(frequencies, 0.02, 1.0, 1.0, wheels, profile, kinks)
    oracle.step = 1e-3
    states = oracle.run(np.asarray(record.times))
    x = np.array([0.1, 0.37, 0.5, 0.81])
    shapes = np.sqrt(2.0) * np.sin(np.pi * np.outer(np.arange(1, 5), x))
    expected = states[:4].T @ shapes
    assert_allclose(record.at(x), expected, atol=1e-7 * np.abs(expected).max())
    assert float(record.error_estimate) < 1e-7
    flights = record.flights
    assert flights.wheel.size
    assert "leaves at" in record.verdict and int(record.result) == 0
    place = [(w.start, w.speed) for w in wheels]
    over_beam = [
        one
        for one in oracle.flights
        for start, speed in [place[one.wheel]]
        if start + speed * one.lift < 1 - 1e-6 and not start + speed * one.landing <= 0  # or NaN
    ]
    assert flights.wheel.tolist() == [one.wheel for one in over_beam]
    assert_allclose(flights.lift_time, [one.lift for one in over_beam], rtol=1e-7)
    assert_allclose(flights.landing_time, [one.landing for one in over_beam], rtol=1e-7)
    impulses = [np.nan if np.isnan(one.landing) else one.impulse for one in over_beam]
    assert_allclose(flights.impulse, impulses, rtol=1e-5, atol=1e-12)
    rigid = [wheels[one.wheel].mass > 0 for one in over_beam]
    approach = np.array([one.approach for one in over_beam])[rigid]
    assert_allclose(flights.approach_speed[rigid], approach, rtol=1e-5)
    assert np.all(np.asarray(record.lowest_contact_force) == 0)
    assert np.all(np.asarray(record.contact_force) >= -1e-8)


HELD_CASES = {
    "mass": {"loads": [jb.MovingMass(0.1, 1.0)]},
    "rows and profile": {
        "loads": [
            jb.Oscillator(0.2, 60.0, 1.0, wheel_mass=0.02, speed=0.9),
            jb.vehicles.HalfCar(
                body_mass=0.2, body_inertia=0.004, axle_positions=[0.1, -0.1],
                axle_masses=[0.02, 0.02], suspension_stiffness=[40.0] * 2,
                suspension_damping=[0.5] * 2, tyre_stiffness=[90.0] * 2, tyre_damping=[0.1, 0.1],
                speed=-0.8,
            ),
            jb.MovingForce(force=0.3, speed=0.5),
        ],
        "profile": jb.profiles.SineProfile(1e-4, 0.7),
    },
    "absorber and actuator": {
        "loads": [jb.MovingMass(0.1, 1.0)],
        "absorbers": [
            jb.Absorber(0.4, mass=0.02, frequency=1.6, damping_ratio=0.1, inertance=0.01)
        ],
        "actuators": [jb.SpringDamper(0.6, stiffness=3.0, damping=0.1)],
    },
}  # fmt: skip


EXTREMES = "largest", "smallest", "lowest_contact_force", "peak_stroke", "peak_absorber_force"


@pytest.mark.parametrize("parts", HELD_CASES.values(), ids=HELD_CASES)
def test_without_flights_it_is_the_bilateral_run(parts):
    case = jb.Case(
        jb.Beam(**UNIT, modes=4),
        sensors=[jb.Sensor(0.37), jb.Sensor(0.5, quantity="acceleration")],
        run=jb.Run(1.1, sample_rate=100.0, gravity=G),  # rigid wheels leap off a sagging end
        **parts,
    )
    bilateral, record = (
        jb.simulate(dataclasses.replace(case, contact=contact), tolerance=1e-10)
        for contact in (jb.BilateralContact(), LIFTING)
    )
    assert float(bilateral.lowest_contact_force[: len(case.loads)].min()) > 0
    assert record.flights is not None and not record.flights.wheel.size
    assert bilateral.flights is None
    for name in (
        "coordinates", "rates", "contact_force", "body_displacement", "body_acceleration",
        "largest", "smallest", "peak_deflection", "lowest_contact_force", "stroke",
        "peak_stroke", "peak_absorber_force",
    ):  # fmt: skip
        one, other = (np.asarray(getattr(run, name)) for run in (record, bilateral))
        largest = np.nanmax(np.abs(other), initial=0.0)
        # Extremes are those of polynomials through the points of steps, which differ.
        rounding = 2e-7 if name in EXTREMES else 2e-9
        assert_allclose(one, other, atol=rounding * largest, rtol=1e-12, err_msg=name)
    assert record.verdict.split(";")[0] == bilateral.verdict.split(";")[0]


def test_axles_of_a_half_car_leave_one_after_another():
    """Over a bump at the entry of two spans; one tyre has no damper.

    The numbers are of own equations of the car and four modes of 240 Hermite elements, integrated
    by scipy's DOP853 to 1e-10 from event to event.
    """
    car = jb.vehicles.HalfCar(
        body_mass=16600.0, body_inertia=95765.0, axle_positions=[2.4, -0.3, -2.4],
        axle_masses=[700.0, 800.0, 1100.0], suspension_stiffness=[4e5, 5e5, 1e6],
        suspension_damping=[1e4, 1e4, 2e4], tyre_stiffness=[1.75e6, 2e6, 3.5e6],
        tyre_damping=[3e3, 0.0, 5e3], speed=22.0, start_position=-1.0,
    )  # fmt: skip
    case = jb.Case(
        jb.Beam(40.0, 8e9, 9e3, damping_ratio=0.02, modes=4),
        supports=[jb.Support(20.0)],
        sensors=[jb.Sensor(10.0)],
        loads=[car],
        profile=jb.profiles.BumpProfile(-0.5, 0.5, 0.06),
        contact=LIFTING,
        run=jb.Run(0.8, sample_rate=100.0, gravity=9.81),
    )
    record = jb.simulate(case)
    flights, at = record.flights, [30, 50]
    assert flights.wheel.tolist() == [0, 1, 2]
    lifts = [0.06262400314, 0.18447285742, 0.27544638479]
    assert_allclose(flights.lift_time, lifts, rtol=1e-9, atol=1e-10)
    landings = [0.08120970244, 0.22078735977, 0.32091428424]
    assert_allclose(flights.landing_time, landings, rtol=1e-9, atol=1e-10)
    deflections = [-0.0013938728515, -0.0024474056760]
    assert_allclose(record.deflection[at, 0], deflections, rtol=5e-7)
    bodies = [
        [0.009975945578, 0.000266757669, 0.005797284619, 0.013270477334, 0.047214809962],
        [0.001381971577, -0.002129852133, -0.003058738076, -0.007544163117, 0.003005878464],
    ]
    assert_allclose(record.body_displacement[at], bodies, atol=2e-9)


def test_impulses_of_several_wheels():
    """None pulls, none enters the surface, held ones stay on it; no energy arises."""
    random = np.random.default_rng(5)
    for _ in range(200):
        count = int(random.integers(1, 6))
        shapes = random.standard_normal((count, 3))
        mobility = np.diag(random.uniform(0.1, 3.0, count)) + shapes @ shapes.T
        relative, held = random.standard_normal(count), random.random(count) < 0.2
        impulses = lifting.impulses_of(mobility, relative, held)
        after = relative + mobility @ impulses
        assert_allclose(after[held], 0.0, atol=1e-9)
        assert np.all(impulses[~held] >= 0) and np.all(after[~held] >= -1e-9)
        assert_allclose((impulses * after)[~held], 0.0, atol=1e-8)
        assert impulses @ (relative + after) / 2 <= 1e-9


def test_one_run_only():
    case = lifting_case("two masses")
    sentence = "one run of concrete numbers"
    with pytest.raises(ValueError, match=sentence):
        jb.sweep(case, {"loads.0.speed": [1.0, 2.0]}, progress=False)
    with pytest.raises(ValueError, match=sentence):
        jb.Simulator(case, vary={"loads.0.speed": (0.5, 1.0)})
    with pytest.raises(ValueError, match=sentence):
        jax.grad(lambda v: jb.simulate(jb.replace(case, {"loads.0.speed": v})).smallest[0])(0.9)
    with pytest.raises(ValueError, match=sentence):
        integration_plan(case)
    shaker = jb.PointForce(0.5)
    steered = dataclasses.replace(case, actuators=[shaker], controller=jb.Prescribed(offsets=[1.0]))
    with pytest.raises(ValueError, match=sentence):
        jb.simulate(steered)
    both = jb.UnilateralContact(stiffness=1.0, hertz_stiffness=1.0)
    with pytest.raises(ValueError, match="leave one out"):
        jb.simulate(dataclasses.replace(case, contact=both))


def test_record_of_flights_in_files_and_figures(tmp_path):
    case = lifting_case("two masses")
    record = jb.simulate(case)
    record.save(tmp_path / "run.nc")
    again = jb.read_record(tmp_path / "run.nc")
    assert again.verdict == record.verdict
    for one, other in zip(*map(jax.tree.leaves, (again.flights, record.flights)), strict=True):
        assert_allclose(one, other)
    assert jb.api.content(record)["flights"]["wheel"] == record.flights.wheel.tolist()
    texts = [text.get_text() for axes in record.plot().axes for text in axes.texts]
    assert any("leaves the beam" in text for text in texts)
    nothing = jb.simulate(dataclasses.replace(case, loads=[]))
    assert nothing.flights is None


def test_wheels_without_weight_on_a_level_road_stay():
    """Warnings of NumPy are errors here."""
    case = dataclasses.replace(lifting_case("take-off before the end"), run=jb.Run(0.5, gravity=0))
    record = jb.simulate(case)
    assert not record.flights.wheel.size and not np.any(record.coordinates)


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_mass_of_fig_2_27_flies():
    """Held down, it pulls with many times its weight, and peaks depend on the number of modes."""
    two = with_sensors(two_spans(rigs.load), 0.3, 0.9, duration=0.15)
    values = {"loads.0.mass": 0.261, "loads.0.speed": 1.75 * critical_speed(two)}
    peaks = []
    for modes in (8, 16):
        held = jb.replace(with_modes(two, modes), values)
        bilateral, flying = (
            jb.simulate(dataclasses.replace(held, contact=contact), tolerance=1e-9)
            for contact in (None, LIFTING)
        )
        assert bilateral.lowest_contact_force[0] < -100 * 0.261 * 9.81
        assert flying.lowest_contact_force[0] == 0
        assert_allclose(flying.flights.lift_time[0], bilateral.contact_lost_time[0], rtol=1e-6)
        peaks.append([bilateral.peak_deflection.max(), flying.peak_deflection.max()])
    change = np.abs(np.subtract(*peaks) / peaks[1])
    assert change[0] > 0.2 and change[1] < 0.05


@pytest.mark.filterwarnings("ignore::jaxbeam.model.plausibility.check.PlausibilityWarning")
@pytest.mark.parametrize(("modes", "duration"), [(2, 0.20702), (6, 0.5)])
def test_a_wheel_that_another_throws_up_does_not_land_while_it_rises(modes, duration):
    """A landing wheel throws the other up, slowly: its flight is far shorter than a step."""
    case = jb.Case(
        jb.Beam(
            50.0, 4e9, 4e3, damping_ratio=0.01, modes=modes, shear_stiffness=1e9, rotary_inertia=3e3
        ),
        supports=[jb.Support(25.0)],
        loads=[jb.MovingMass(9000.0, 42.0), jb.MovingMass(3000.0, 42.0, entry_time=0.2)],
        contact=LIFTING,
        run=jb.Run(duration, sample_rate=1000.0),
    )
    flights = jb.simulate(case).flights
    assert flights.wheel[0] == 1 and 1 < flights.wheel.size < 30
    landed = ~np.isnan(flights.landing_time)
    assert np.all(flights.approach_speed[landed] > 0) and np.all(flights.impulse[landed] > 0)


def three_masses(modes=3):
    """Three masses that throw each other up, with impacts ever faster; samples at 1/64."""
    duration = 1.3 / 1.27
    loads = [
        jb.MovingMass(0.13, 1.27),
        jb.MovingMass(0.22, 1.27, entry_time=0.21 / 1.27),
        jb.MovingMass(0.51, 1.27, entry_time=0.42 / 1.27),
    ]
    return jb.Case(
        jb.Beam(**UNIT, modes=modes),
        sensors=[jb.Sensor(0.5)],
        loads=loads,
        contact=LIFTING,
        run=jb.Run(duration, sample_rate=64 / duration, gravity=G),
    )


@pytest.mark.parametrize("modes", [3, 10])
def test_no_impact_gains_energy_and_held_wheels_hardly_pull(modes, monkeypatch):
    """The drive does the work of an impulse on the slope; the others lose."""
    kept, own = [], lifting.run_unilateral

    def keep(case, model, *rest):
        kept.append((model, own(case, model, *rest)))
        return kept[-1][1]

    monkeypatch.setattr(lifting, "run_unilateral", keep)
    jb.simulate(three_masses(modes))
    model, run = kept[-1]
    lost, impulses = [], []
    k = np.pi * np.arange(1, modes + 1)
    for before, after in itertools.pairwise([*run.pieces, run.last]):
        x = 1.27 * after.start - np.array([0.0, 0.21, 0.42])
        slopes = np.sqrt(2.0) * k * np.cos(k * x[:, None]) * before.on_beam[:, None]
        ends = (before.states[-1], before.heights[-1]), (after.states[0], after.heights[0])
        rates = [np.append(q[model.rate_index], e[run.law.rate_index]) for q, e in ends]
        masses = np.append(np.ones(modes), run.law.mass)
        impulse = (masses * (rates[1] - rates[0]))[modes:]
        if np.max(np.abs(impulse)) < 1e-10:
            continue
        by_drive = impulse @ (1.27 * slopes @ before.states[-1][model.coordinate_index])
        lost.append(by_drive - masses @ (rates[1] ** 2 - rates[0] ** 2) / 2)
        impulses.append(impulse)
    assert len(lost) > 15 and min(lost) > 0
    assert -1e-4 * np.max(impulses) < np.min(impulses) < 0  # some were held


def test_too_many_impacts_end_the_run(monkeypatch):
    monkeypatch.setattr(lifting, "MAX_EVENTS", 6)
    monkeypatch.setattr(lifting, "EVENT_SHARE", 1.0)
    with pytest.raises(RuntimeError, match=r"wheel \d leaves and lands more than 6 times within"):
        jb.simulate(three_masses())


def test_impacts_that_follow_each_other_ever_faster_come_to_an_end():
    """Three masses throw each other up; Moreau's time steps approach the run as they shorten."""
    speed, masses = 1.27, np.array([0.13, 0.22, 0.51])
    starts, duration = np.array([0.0, -0.21, -0.42]), 1.3 / 1.27
    record = jb.simulate(three_masses())
    assert 10 < record.flights.wheel.size < 40
    frequencies = np.pi**2 * np.arange(1, 4) ** 2
    x = np.array([0.1, 0.37, 0.5, 0.81])
    shapes = np.sqrt(2.0) * np.sin(np.pi * np.outer(np.arange(1, 4), x))
    deflection, errors = np.asarray(record.at(x)), []
    for every in (25, 100):
        step = duration / (64 * every)
        wheels = masses, masses * G, np.full(3, speed), starts
        steps = moreau_steps(frequencies, 0.02, *wheels, duration, step, every)
        errors.append(np.max(np.abs(steps @ shapes - deflection)) / np.max(np.abs(deflection)))
    assert errors[1] < 3e-4 and errors[1] < errors[0] / 2.5
