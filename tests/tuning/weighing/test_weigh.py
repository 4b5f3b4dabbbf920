"""Weighing in motion, from logs of modal equations that share no code with jaxbeam."""

import dataclasses

import numpy as np
import pytest
import scipy.signal

import jaxbeam as jb
from tests.oracles import finite_elements, modal_equations, planted_trucks, vehicle_elements
from tests.oracles.crossing import GRAVITY, Load
from tests.oracles.planted_trucks import (
    FIBRE as PLANTED_FIBRE,
    LEAD as PLANTED_LEAD,
    Bridge,
    Passage,
)
from tests.tuning.fit.test_identify import deviations, log_of as weighed_log_of, one_span
from tuning import Log, identify, weigh
from tuning.weighing import calibrate_influence_lines, weigh_axles
from tuning.weighing.influence_lines import UnitForce
from tuning.weighing.weigh import MatchingPursuit

SPAN = modal_equations.Span(0.6, 11.68, 0.535, modes=3, damping_ratio=0.03)
TIMES = np.arange(301) / 250
CASE = one_span(duration=1.2, rate=250.0)


def crossing(loads, noise=1e-5):
    clean = modal_equations.respond(SPAN, loads, (0.15, 0.3), TIMES).deflection
    return weighed_log_of(TIMES, clean + noise * np.random.default_rng(0).normal(size=clean.shape))


TWO = [Load(0.5, 1.2, 0.1), Load(0.3, -1.6, 0.5)]


def test_matching_pursuit_is_close_without_dynamics():
    pursuit = MatchingPursuit(CASE, crossing(TWO), (0.8, 2.5), both_ways=True)
    match = pursuit.find(2)
    parameters = sorted([float(n.mass), float(n.speed), float(n.entry_time)] for n in match.loads)
    np.testing.assert_allclose(parameters, [[0.3, -1.6, 0.5], [0.5, 1.2, 0.1]], atol=0.05)
    assert match.residual_rms < 0.2 < 0.5 * pursuit.find(1).residual_rms


def test_two_loads_that_meet_on_the_beam():
    weighed = weigh(CASE, crossing(TWO), (0.8, 2.5))
    truth = {
        "loads.0.mass": 0.5, "loads.0.speed": 1.2, "loads.0.entry_time": 0.1,
        "loads.1.mass": 0.3, "loads.1.speed": -1.6, "loads.1.entry_time": 0.5,
        "sensors.0.offset": 0.0, "sensors.1.offset": 0.0,
    }  # fmt: skip
    assert len(weighed.loads) == 2
    assert weighed.load_counts == []  # the residuals are white noise
    assert np.all(np.abs(deviations(weighed.fit, truth)) < 3.5)
    assert weighed.fit.errors[0] < 0.01 and weighed.fit.errors[3] < 0.01  # kg
    assert str(weighed).startswith("2 loads found\nthe model explains the logs: ")
    assert weighed.to_dict()["loads"][1]["mass"]["value"] == pytest.approx(0.3, rel=0.02)


def test_logs_and_cases_that_cannot_be_weighed():
    log = crossing(TWO)
    with pytest.raises(ValueError, match="speeds must be 0 < low < high"):
        weigh(CASE, log, (2.0, 1.0))
    with pytest.raises(ValueError, match="weighing needs a sensor on the beam; the case has none"):
        weigh(dataclasses.replace(CASE, sensors=()), log, (1.0, 2.0))
    free = dataclasses.replace(CASE.beam, ends="free-free")
    with pytest.raises(ValueError, match="rigid body"):
        weigh(dataclasses.replace(CASE, beam=free), log, (1.0, 2.0))
    upwards = dataclasses.replace(log, values=np.abs(log.values))
    with pytest.raises(ValueError, match="no load is found in it at these speeds"):
        weigh(CASE, upwards, (1.0, 2.0))


# Strain gauges and accelerometers weigh, and fits have the cusp of strain under an axle.
#
# The readings are those of finite elements in small steps; the load is a mass on a stiff spring.

LENGTH, RIGIDITY, DENSITY, DAMPING = 20.0, 1e10, 8000.0, 0.02
MASS, SPEED, LEAD, FIBRE = 8000.0, 12.0, 3.6, -0.5  # kg, m/s, m, m
PLACES = [LENGTH / 2, LENGTH / 4]
CUTOFF, ORDER = 20.0, 4  # Hz, of the filter before the accelerometer's samples
STEP, EVERY = 5e-4, 10
NOISE = {"strain": 3e-7, "acceleration": 0.005}


def case(*quantities, modes=4) -> jb.Case:
    """Bridge with a sensor of each quantity, at midspan and then at the quarter point."""
    beam = jb.Beam(
        length=LENGTH, flexural_rigidity=RIGIDITY, mass_per_length=DENSITY,
        damping_ratio=DAMPING, modes=modes,
    )  # fmt: skip
    sensors = [
        jb.Sensor(x, quantity, fibre_distance=FIBRE)
        if quantity == "strain"
        else jb.Sensor(x, quantity, filter=jb.Filter(CUTOFF, ORDER, realisation="analogue"))
        for x, quantity in zip(PLACES, quantities, strict=False)
    ]
    load = jb.MovingMass(mass=MASS, speed=SPEED, entry_time=LEAD / SPEED)
    return jb.Case(beam, sensors=sensors, loads=[load], run=jb.Run(duration=2.5, sample_rate=200.0))


@pytest.fixture(scope="module")
def readings():
    one = np.ones((1, 1))
    mass = vehicle_elements.Vehicle(
        MASS * one, 0 * one, 0 * one, one, np.array([1e9]), np.array([1e6]), np.zeros(1),
        np.array([MASS * GRAVITY]),
    )  # fmt: skip
    beam = finite_elements.Beam(LENGTH, RIGIDITY, DENSITY, damping_ratio=DAMPING, elements=20)
    run = vehicle_elements.cross(beam, mass, SPEED, -LEAD, PLACES, 2.5, step=STEP)
    low_pass = scipy.signal.butter(ORDER, CUTOFF, fs=1 / STEP, output="sos")
    filtered = scipy.signal.sosfilt(low_pass, run.acceleration, axis=0)[::EVERY]
    # The axis sags towards the fibre below it: M / (E I) times its distance.
    strain = -FIBRE * run.moment / RIGIDITY
    return run.times[::EVERY], {"strain": strain[::EVERY], "acceleration": filtered}


def quantity_log(readings, *quantities) -> Log:
    times, histories = readings
    rng = np.random.default_rng(0)
    columns = [histories[name][:, i] for i, name in enumerate(quantities)]
    values = [
        c + NOISE[n] * rng.normal(size=c.size) for c, n in zip(columns, quantities, strict=True)
    ]
    units = {"strain": "1", "acceleration": "m/s^2"}
    return Log(
        times, np.stack(values, 1), quantities, quantities, tuple(units[n] for n in quantities)
    )


@pytest.mark.parametrize("quantity", ["strain", "acceleration"])
def test_the_pursuit_finds_a_load_by_one_sensor(readings, quantity):
    log = quantity_log(readings, quantity)
    (load,) = MatchingPursuit(case(quantity), log, (6.0, 25.0), both_ways=False).find(1).loads
    assert float(load.mass) == pytest.approx(MASS, rel=0.1)
    assert float(load.speed) == pytest.approx(SPEED, rel=0.05)
    assert float(load.entry_time) == pytest.approx(LEAD / SPEED, abs=0.05)


def test_readings_of_a_unit_force_are_those_of_a_simulation():
    sensors = [
        jb.Sensor(7.0, "acceleration"), jb.Sensor(7.0, "velocity"), jb.Sensor(9.0, "deflection"),
        jb.Sensor(8.0, "moment"),
    ]  # fmt: skip
    slow = jb.MovingForce(force=1.0, speed=-0.5, entry_time=1.0)
    fast = dataclasses.replace(slow, speed=np.array(-30.0))
    own = dataclasses.replace(case(), sensors=sensors)
    for load, compared, duration in ((fast, slice(0, 2), 2.5), (slow, slice(2, 4), 40.0)):
        times = np.linspace(0.0, duration, 501)
        run = jb.Run(duration=duration)
        record = jb.simulate(dataclasses.replace(own, loads=[load], run=run), times)
        expected = np.asarray(record.measured)[:, compared]
        unit_force = UnitForce(own, duration)
        found = unit_force.readings(float(load.speed), times - 1.0)[:, compared]
        error = np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0)
        assert np.all(error < 0.02), error


def test_strain_gauge_and_accelerometer_weigh(readings):
    names = "strain", "acceleration"
    weighed = weigh(case(*names), quantity_log(readings, *names), (6.0, 25.0), 1, both_ways=False)
    fit = weighed.fit
    truth = {
        "loads.0.mass": MASS, "loads.0.speed": SPEED, "loads.0.entry_time": LEAD / SPEED,
        "sensors.0.offset": 0.0, "sensors.1.offset": 0.0,
    }  # fmt: skip
    deviations = (fit.values - [truth[address] for address in fit.addresses]) / fit.errors
    assert np.all(np.abs(deviations) < 3.5), dict(zip(fit.addresses, deviations, strict=True))
    assert fit.errors[0] < 0.01 * MASS
    assert weighed.to_dict()["loads"][0]["mass"]["value"] == pytest.approx(MASS, rel=0.02)


def test_a_fit_of_strain_has_the_cusp_under_the_axle(readings):
    """With two modes, whose sums are 10 % low at the peak, the rigidity is right."""
    own = case("strain", modes=2)
    start = dataclasses.replace(own, beam=dataclasses.replace(own.beam, flexural_rigidity=9e9))
    fit = identify(start, quantity_log(readings, "strain"), ["beam.flexural_rigidity"])
    assert fit.values[0] == pytest.approx(RIGIDITY, rel=0.005)
    peak = np.abs(fit.fitted[0, :, 0]).max()
    assert peak == pytest.approx(np.abs(readings[1]["strain"][:, 0]).max(), rel=0.01)
    modes = jb.simulate(own).coordinates @ jb.modes(own).fields(LENGTH / 2, (2,))[0]
    assert np.abs(-FIBRE * modes).max() < 0.95 * peak  # without the correction


# Trucks of finite elements on rough roads, weighed by lines that known trucks calibrated.

SPEEDS = 8.0, 35.0
SEED = 2  # settings were chosen on the trucks of seed 1


def case_of(bridge: Bridge) -> jb.Case:
    """What a user would write down: hinged ends, and a rigidity a fifth too low."""
    beam = jb.Beam(
        length=bridge.length, flexural_rigidity=0.8 * bridge.rigidity,
        mass_per_length=bridge.density, damping_ratio=0.02, modes=6,
    )  # fmt: skip
    sensors = [jb.Sensor(x, "strain", fibre_distance=PLANTED_FIBRE) for x in bridge.places]
    return jb.Case(beam, sensors=sensors, run=jb.Run(duration=3.0, sample_rate=200.0))


def log_of(passage: Passage, known: bool = False) -> Log:
    truck = passage.truck
    loads = jb.Axles(
        offsets=truck.offsets, forces=truck.loads, speed=truck.speed,
        entry_time=PLANTED_LEAD / abs(truck.speed),
    )  # fmt: skip
    about = {"loads": (loads,)} if known else {}
    columns = ("s0", "s1"), ("strain",) * 2, ("1",) * 2
    return Log(passage.times, passage.strain, *columns, **about)


def weighed(bridge: int, road_class: str, trucks: tuple[int, ...]):
    """Each truck with what is found of it, its number of axles known."""
    known, passages = planted_trucks.site(bridge, road_class, trucks, SEED)
    case = case_of(planted_trucks.BRIDGES[bridge])
    lines = calibrate_influence_lines(case, [log_of(one, known=True) for one in known])
    for one in passages:
        count = len(one.truck.loads)
        yield one.truck, weigh_axles(case, log_of(one), SPEEDS, count, influence_lines=lines)


def errors(found):
    """Relative errors of gross weights, groups and axles, and which are within intervals."""
    gross, groups, axles, held = [], [], [], []
    for truck, weighing in found:
        fit = weighing.fit
        half = fit.half_widths
        gross.append(fit.gross_weight[0] / truck.loads.sum() - 1)
        groups += [fit.group_weight(g)[0] / truck.loads[g].sum() - 1 for g in truck.groups]
        axles += list(fit.forces / truck.loads - 1)
        held += list(np.abs(fit.forces - truck.loads) < half[: truck.loads.size])
    return tuple(np.array(part) for part in (np.abs(gross), np.abs(groups), np.abs(axles), held))


def test_three_trucks_are_weighed():
    gross, groups, axles, _ = errors(weighed(0, "A", (2, 3, 5)))
    assert np.all(gross < 0.03), gross
    assert np.all(groups < 0.08), groups
    assert np.all(axles < 0.15), axles


@pytest.mark.parametrize("road_class", ["A", "B", "C"])
def test_trucks_of_two_bridges_are_weighed(road_class):
    """Ten of the thirty trucks; all are within the limits on roads of class A and B.

    On those of class C the places of the axles are uncertain, which dynamic wheel forces of a fifth
    of the static ones hide. Of 60 trucks of the seeds 1 to 6 there, 93 % have their gross weight
    within 3 %, 85 % of the groups are within 8 %, 95 % of the axles within 15 %, and 95 % of the
    intervals hold. At the true speed and places 96 % of the groups are within 8 %: to come closer,
    axles must be detected by other sensors. Of single trucks two groupings of the axles are equally
    likely (criteria 1.6 apart), and rounding decides: at the wrong one three axles in 40 are lost.
    """
    found = [pair for bridge in (0, 1) for pair in weighed(bridge, road_class, (2, 3, 4, 5, 6))]
    gross, groups, axles, held = errors(found)
    least = {"A": [0.95, 0.95, 0.9], "B": [0.95, 0.95, 0.9], "C": [0.7, 0.8, 0.8]}[road_class]
    assert np.mean(gross < 0.03) >= 0.95, gross
    assert np.all([np.mean(groups < 0.08), np.mean(axles < 0.15), np.mean(held)] >= np.array(least))


def test_a_run_repeated_at_one_speed_tells_little_more_of_the_lines():
    """Dynamic wheel forces repeat at the same places: only other speeds average them out."""
    known, _ = planted_trucks.site(0, "A", ())
    case = case_of(planted_trucks.BRIDGES[0])
    logs = [log_of(one, known=True) for one in known]

    def error(chosen):
        lines = calibrate_influence_lines(case, chosen)
        return float(np.sqrt(np.sum(lines.deviations.sum(axis=(1, 2)) ** 2)))

    once, thrice, other = error(logs[1:2]), error([logs[1]] * 3), error(logs[:3])
    assert 0.7 * once < thrice < 1.3 * once
    assert other < 0.8 * thrice
