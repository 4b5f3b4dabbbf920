"""Axle loads and spacings from strain on unknown rough roads, and classes of accuracy.

The readings are those of finite elements crossed by a half car in small steps.
"""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from tests.oracles import finite_elements, vehicle_elements
from tuning import Log
from tuning.weighing import (
    accuracy_class,
    calibrate_influence_lines,
    model_influence_lines,
    relative_errors,
    weigh_axles,
)
from tuning.weighing.axle_fit import CrossingLog
from tuning.weighing.axles import AxleWeighing, find_axles
from tuning.weighing.influence_lines import AxleGeometry, lines_from_dict
from tuning.weighing.weigh import moses

LENGTH, RIGIDITY, DENSITY, DAMPING, FIBRE = 20.0, 1e10, 10000.0, 0.02, -0.5
PLACES, DURATION, SPEED, LEAD = [LENGTH / 2, LENGTH / 4], 2.4, 18.0, 9.0
NOISE, ROADS, SPEEDS = 2e-7, 8, (8.0, 35.0)
TRUCK = vehicle_elements.half_car(15000.0, 40000.0, [1.6, -2.4], [700.0, 1100.0], 9e5, 2e4, 3e6)
SPACING = 4.0
BEAM = finite_elements.Beam(LENGTH, RIGIDITY, DENSITY, damping_ratio=DAMPING, elements=20)


def case() -> jb.Case:
    beam = jb.Beam(
        length=LENGTH, flexural_rigidity=RIGIDITY, mass_per_length=DENSITY,
        damping_ratio=DAMPING, modes=2,
    )  # fmt: skip
    sensors = [jb.Sensor(x, "strain", fibre_distance=FIBRE) for x in PLACES]
    return jb.Case(beam, sensors=sensors, run=jb.Run(duration=DURATION, sample_rate=200.0))


def road(seed: int):
    """Waves of a smooth to average road: heights and slopes with random phases."""
    rng = np.random.default_rng(seed)
    n = np.geomspace(0.05, 2.0, 60)
    amplitude = np.sqrt(2 * 16e-6 * (0.1 / n) ** 2 * np.gradient(n))  # class A of ISO 8608
    phase = rng.uniform(0.0, 2 * np.pi, n.size)

    def surface(x):
        angle = 2 * np.pi * n * np.asarray(x)[..., None] + phase
        return np.cos(angle) @ amplitude, -np.sin(angle) @ (2 * np.pi * n * amplitude)

    return surface


def log_of(
    vehicle, profile=None, speed=SPEED, duration=DURATION, seed=0, step=1e-3, beam=BEAM,
    places=PLACES, **about,
):  # fmt: skip
    run = vehicle_elements.cross(
        beam, vehicle, speed, -LEAD, places, duration, profile, step=step, every=5
    )
    strain = -FIBRE * run.moment / RIGIDITY
    values = strain + NOISE * np.random.default_rng(seed).normal(size=strain.shape)
    return Log(run.times, values, ("s0", "s1"), ("strain",) * 2, ("1",) * 2, **about)


@pytest.fixture(scope="module")
def crossings():
    return [log_of(TRUCK, road(seed), seed=seed) for seed in range(ROADS)]


def search(log, count, speeds=SPEEDS, lines=None, both_ways=False):
    lines = model_influence_lines(case()) if lines is None else lines
    crossing = CrossingLog(log.times, log.values, log.valid)
    return find_axles(lines, crossing, speeds, both_ways, count)[0][count]


@pytest.fixture(scope="module")
def found(crossings):
    """What is found without a guess, and weighed by Moses' method, on each road."""
    starts = [search(log, 2) for log in crossings]
    fits = [
        moses(one.lines, one.geometry, log.times, log.values, found=True)
        for one, log in zip(starts, crossings, strict=True)
    ]
    return starts, fits


def test_static_forces_are_exact_for_a_slow_crossing():
    forces = vehicle_elements.forces([0.0, 3.2, 5.6], [60e3, 95e3, 80e3])
    log = log_of(forces, speed=1.0, duration=36.0, step=4e-3)
    lines = model_influence_lines(case())
    known = AxleGeometry(1.0, LEAD, forces.offsets, LENGTH)
    fit = moses(lines, known, log.times[::2], log.values[::2])
    np.testing.assert_allclose(fit.forces, forces.static_loads, rtol=0.01)
    assert np.all(np.abs(fit.forces - forces.static_loads) < 3.5 * fit.errors)
    geometry = search(log, 3, (0.5, 3.0)).geometry
    assert geometry.speed == pytest.approx(1.0, rel=0.01)
    np.testing.assert_allclose(geometry.offsets, forces.offsets, atol=0.1)


def test_travel_to_the_left_is_the_mirror_image():
    forces = vehicle_elements.forces([0.0, 4.0], [60e3, 95e3])
    log = log_of(forces, speed=5.0, duration=8.0)
    mirrored = dataclasses.replace(
        case(),
        sensors=[dataclasses.replace(s, position=LENGTH - s.position) for s in case().sensors],
    )
    lines = model_influence_lines(mirrored)
    geometry = search(log, 2, (3.0, 8.0), lines, both_ways=True).geometry
    assert geometry.speed == pytest.approx(-5.0, rel=0.02)
    fit = moses(lines, geometry, log.times, log.values, found=True)
    np.testing.assert_allclose(fit.forces, forces.static_loads, rtol=0.06)


def test_calibrated_influence_lines():
    """Those of a slow known vehicle are those of the model, and weigh another vehicle."""
    known = jb.Axles(offsets=[0.0, 4.0], forces=[50e3, 70e3], speed=1.5, entry_time=LEAD / 1.5)
    vehicle = vehicle_elements.forces([0.0, 4.0], [50e3, 70e3])
    log = log_of(vehicle, speed=1.5, duration=24.0, step=5e-3, loads=(known,))
    lines = calibrate_influence_lines(case(), log)
    exact = model_influence_lines(case()).at(lines.positions)
    np.testing.assert_allclose(lines.values, exact, atol=0.03 * exact.max())
    other = vehicle_elements.forces([0.0, 2.0, 5.0], [40e3, 80e3, 60e3])
    weighed = log_of(other, speed=2.0, duration=18.0, step=5e-3)
    geometry = AxleGeometry(2.0, LEAD / 2.0, other.offsets, LENGTH)
    fit = moses(lines, geometry, weighed.times, weighed.values)
    np.testing.assert_allclose(fit.forces, other.static_loads, rtol=0.05)


def test_intervals_of_moses_cover_on_rough_roads(found):
    deviations = np.array([(fit.forces - TRUCK.static_loads) / fit.errors for fit in found[1]])
    assert np.mean(np.abs(deviations) < 2) >= 0.85
    assert np.all(np.abs(deviations) < 3.5)
    widths = np.array([fit.errors / TRUCK.static_loads for fit in found[1]])
    assert np.all(widths < 0.25)


def test_the_fit_is_closer_than_moses_and_its_intervals_cover(crossings, found):
    truth = np.array([*TRUCK.static_loads, SPEED, LEAD / SPEED, SPACING])
    fits = found[0]
    errors = np.array([fit.values - truth for fit in fits])
    half_widths = np.array([fit.half_widths for fit in fits])
    covered = np.abs(errors) < half_widths
    assert np.mean(covered[:, :2]) >= 0.85, errors[:, :2] / half_widths[:, :2]
    assert np.mean(covered[:, 4]) >= 0.85, errors[:, 4] / half_widths[:, 4]
    share = np.sqrt(np.mean((errors[:, :2] / TRUCK.static_loads) ** 2))
    by_moses = [(fit.forces - TRUCK.static_loads) / TRUCK.static_loads for fit in found[1]]
    assert share < np.sqrt(np.mean(np.square(by_moses)))
    assert share < 0.06


def test_axles_of_a_log_are_weighed_and_reported(crossings):
    weighed = weigh_axles(case(), crossings[0], SPEEDS)
    assert isinstance(weighed, AxleWeighing)
    forces = np.asarray(weighed.load.forces)
    np.testing.assert_allclose(forces, TRUCK.static_loads, rtol=0.1)
    assert str(weighed).startswith("2 axles found, at ")
    assert "criterion by number of axles" in str(weighed)
    content = weighed.to_dict()
    assert {"1", "2", "3"} <= content["bic"].keys()
    assert content["axles"][0]["value"] == forces[0]
    low, high = content["moses"]["axles"][1]["interval_95"]
    assert low < TRUCK.static_loads[1] < high
    assert content["offsets"][0]["value"] == pytest.approx(SPACING, abs=0.6)


def test_a_wrong_number_of_axles_is_told(crossings):
    said = "times the variance that noise and dynamic wheel forces give them"
    assert said in str(weigh_axles(case(), crossings[0], SPEEDS, 1))
    assert said not in str(weigh_axles(case(), crossings[0], SPEEDS, 2))


def test_axles_are_counted():
    forces = vehicle_elements.forces([0.0, 3.2, 5.6], [60e3, 95e3, 80e3])
    log = log_of(forces, speed=10.0, duration=4.0, step=2.5e-3)
    found = weigh_axles(case(), log, (5.0, 20.0))
    assert found.fit.forces.size == 3
    assert found.groups == [[0], [1], [2]]
    assert found.fit.gross_weight[0] == pytest.approx(235e3, rel=0.02)


def test_calibrated_lines_serve_every_step_and_are_kept():
    """Ends that the model has not: its lines are a third too large, those calibrated are right."""
    stiff = dataclasses.replace(
        case(), beam=dataclasses.replace(case().beam, flexural_rigidity=7e9)
    )
    vehicle = vehicle_elements.forces([0.0, 4.0], [50e3, 70e3])
    known = jb.Axles(offsets=[0.0, 4.0], forces=[50e3, 70e3], speed=1.5, entry_time=LEAD / 1.5)
    log = log_of(vehicle, speed=1.5, duration=24.0, step=5e-3, loads=(known,))
    lines = calibrate_influence_lines(stiff, [log, log])
    again = lines_from_dict(lines.to_dict())
    np.testing.assert_array_equal(again.values, lines.values)
    other = vehicle_elements.forces([0.0, 3.2, 5.6], [60e3, 95e3, 80e3])
    weighed = log_of(other, speed=5.0, duration=8.0, step=2.5e-3)
    found = weigh_axles(stiff, weighed, (3.0, 8.0), 3, influence_lines=again)
    assert found.fit.gross_weight[0] == pytest.approx(235e3, rel=0.03)
    np.testing.assert_allclose(found.fit.geometry.offsets, other.offsets, atol=0.3)
    with pytest.raises(ValueError, match="these are no calibrated influence lines"):
        lines_from_dict({"format": "other"})


@pytest.mark.parametrize("calibrated", [False, True])
def test_axles_cross_two_spans(calibrated):
    """The first mode has a node at the pier, and the second is as strong."""
    length, places = 2 * LENGTH, [LENGTH / 2, 1.5 * LENGTH]
    pier = finite_elements.Support(LENGTH, 1e12)
    beam = finite_elements.Beam(
        length, RIGIDITY, DENSITY, damping_ratio=DAMPING, elements=40, supports=[pier]
    )
    model = dataclasses.replace(
        case(),
        beam=dataclasses.replace(case().beam, length=length, modes=6),
        sensors=[jb.Sensor(x, "strain", fibre_distance=FIBRE) for x in places],
        supports=[jb.Support(LENGTH, 1e12)],
    )
    lines = None
    if calibrated:
        known = jb.Axles(offsets=[0.0, 4.0], forces=[50e3, 70e3], speed=5.0, entry_time=LEAD / 5.0)
        slow = vehicle_elements.forces([0.0, 4.0], [50e3, 70e3])
        run = log_of(
            slow, speed=5.0, duration=12.0, step=2e-3, beam=beam, places=places, loads=(known,)
        )
        lines = calibrate_influence_lines(model, run)
    other = vehicle_elements.forces([0.0, 4.0, 9.0], [60e3, 90e3, 70e3])
    log = log_of(other, speed=20.0, duration=4.0, beam=beam, places=places)
    fit = weigh_axles(model, log, (10.0, 30.0), 3, influence_lines=lines).fit
    assert fit.geometry.speed == pytest.approx(20.0, rel=2e-3)
    np.testing.assert_allclose(fit.forces, other.static_loads, rtol=0.02)
    assert fit.gross_weight[0] == pytest.approx(220e3, rel=3e-3)


def test_what_cannot_be_weighed(crossings):
    log = crossings[0]
    with pytest.raises(ValueError, match="speeds must be 0 < low < high"):
        weigh_axles(case(), log, (3.0, 2.0), 2)
    with pytest.raises(ValueError, match="the number of axles must be 1 or more, not 0"):
        weigh_axles(case(), log, SPEEDS, 0)
    felt = dataclasses.replace(case(), sensors=[jb.Sensor(5.0, "acceleration")])
    with pytest.raises(ValueError, match="sensors.0 measures acceleration, which has no influence"):
        weigh_axles(felt, log, SPEEDS, 2)
    with pytest.raises(ValueError, match="no load is known; calibration needs a vehicle of known"):
        calibrate_influence_lines(case(), log)
    slow = dataclasses.replace(case(), loads=[jb.MovingForce(force=1.0, speed=1e-3)])
    with pytest.raises(ValueError, match="before the first load has crossed at"):
        calibrate_influence_lines(slow, log)


def sample(count: int, mean: float, deviation: float):
    """Relative errors of this mean and standard deviation (per cent)."""
    draws = np.random.default_rng(0).normal(size=count)
    return (mean + deviation * (draws - draws.mean()) / draws.std(ddof=1)) / 100


def test_accuracy_class_of_a_published_sheet():
    """Example of the sheet of COST 323, in the notebook of OpenWIM/pywim."""
    errors = {
        "gross weight": sample(86, -2.27, 6.09),
        "group of axles": sample(66, 1.00, 8.44),
        "single axle": sample(197, -3.92, 7.66),
        "axle of a group": sample(169, -0.19, 10.07),
    }
    found = accuracy_class(errors, "R2", "I")
    required = [100 * one.required for one in found.criteria]
    np.testing.assert_allclose(required, [92.584, 92.060, 93.704, 93.542], atol=1e-3)
    probability = [100 * one.probability for one in found.criteria]
    np.testing.assert_allclose(probability, [96.276, 93.461, 97.260, 97.902], atol=1e-3)
    assert [one.class_name for one in found.criteria] == ["C(15)"] * 4
    assert found.class_name == "C(15)"
    assert "accuracy class C(15) of COST 323 (test plan R2, environment I)" in str(found)
    # Tolerances of an initial verification are a fifth less: 17.22 % is within 18 %, not 14.4 %.
    assert accuracy_class(errors, "R2", "I", initial=True).class_name == "D+(20)"


@pytest.mark.parametrize(
    (
        "plan",
        "environment",
        "published",
    ),  # of the specification, for 10, 20, 30, 60 and 120 vehicles
    [
        ("r1", "I", [95.0, 97.2, 97.9, 98.4, 98.7]),
        ("r2", "I", [90.0, 94.1, 95.3, 96.4, 97.1]),
        ("R1", "I", [85.0, 90.8, 92.5, 94.2, 95.2]),
        ("R2", "III", [73.0, 82.3, 85.1, 88.1, 89.8]),
    ],
)
def test_required_probabilities(plan, environment, published):
    found = [
        accuracy_class({"gross weight": sample(n, 0.0, 1.0)}, plan, environment)
        .criteria[0]
        .required
        for n in (10, 20, 30, 60, 120)
    ]
    np.testing.assert_allclose(np.array(found), np.array(published) / 100, atol=1.1e-3)


def test_errors_of_weighed_vehicles():
    known = jb.Axles(
        offsets=[0.0, 4.1, 5.45], forces=[70e3, 92e3, 88e3], speed=20.0, entry_time=1.0
    )
    heavier = dataclasses.replace(known, forces=1.1 * np.asarray(known.forces))
    fewer = jb.Axles(offsets=[0.0, 4.8], forces=[70e3, 180e3], speed=20.0)
    errors = relative_errors([(heavier, known), (fewer, known)])
    np.testing.assert_allclose(errors["gross weight"], [0.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(errors["group of axles"], [0.1])
    np.testing.assert_allclose(errors["single axle"], [0.1])
    np.testing.assert_allclose(errors["axle of a group"], [0.1, 0.1])
    with pytest.raises(ValueError, match="needs 5 weighed vehicles or more"):
        accuracy_class(errors)
    with pytest.raises(ValueError, match="know r1, r2, R1, R2, not 'R3'"):
        accuracy_class(errors, "R3")
    assert accuracy_class({"single axle": np.array([0.5, -0.4, 0.6, 0.1, -0.2])}).class_name == "E"
