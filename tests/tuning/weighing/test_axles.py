"""Axle loads and spacings of a vehicle from strain, on rough roads that the fit does not know.

The readings are those of finite elements crossed by a half car in small steps.
"""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from tests.oracles import finite_elements, vehicle_elements
from tests.well_compiled import well_compiled
from tuning import Log, calibrate_influence_lines, model_influence_lines, weigh_axles
from tuning.fit.dataset import make_dataset
from tuning.fit.least_squares import LeastSquares
from tuning.parameters.free import free_parameters, to_unbounded
from tuning.weighing.axles import AxleWeighing, axle_problem, count_axles, errors_of_fit
from tuning.weighing.moses import AxleGeometry, find_geometry, moses

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


def log_of(vehicle, profile=None, speed=SPEED, duration=DURATION, seed=0, step=1e-3, **about):
    run = vehicle_elements.cross(
        BEAM, vehicle, speed, -LEAD, PLACES, duration, profile, step=step, every=5
    )
    strain = -FIBRE * run.moment / RIGIDITY
    values = strain + NOISE * np.random.default_rng(seed).normal(size=strain.shape)
    return Log(run.times, values, ("s0", "s1"), ("strain",) * 2, ("1",) * 2, **about)


@pytest.fixture(scope="module")
def crossings():
    return [log_of(TRUCK, road(seed), seed=seed) for seed in range(ROADS)]


@pytest.fixture(scope="module")
def found(crossings):
    """Moses' method with speed and spacing found in the same readings, on each road."""
    lines, fits = model_influence_lines(case()), []
    for log in crossings:
        geometry = find_geometry(lines, log.times, log.values, SPEEDS, 2)
        fits.append(moses(lines, geometry, log.times, log.values, found=True))
    return fits


def test_static_forces_are_exact_for_a_slow_crossing():
    forces = vehicle_elements.forces([0.0, 3.2, 5.6], [60e3, 95e3, 80e3])
    log = log_of(forces, speed=1.0, duration=36.0, step=4e-3)
    lines = model_influence_lines(case())
    known = AxleGeometry(1.0, LEAD, forces.offsets, LENGTH)
    fit = moses(lines, known, log.times[::2], log.values[::2])
    np.testing.assert_allclose(fit.forces, forces.static_loads, rtol=0.01)
    assert np.all(np.abs(fit.forces - forces.static_loads) < 3.5 * fit.errors)
    geometry = find_geometry(lines, log.times, log.values, (0.5, 3.0), 3)
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
    geometry = find_geometry(lines, log.times, log.values, (3.0, 8.0), 2, both_ways=True)
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
    deviations = np.array([(fit.forces - TRUCK.static_loads) / fit.errors for fit in found])
    assert np.mean(np.abs(deviations) < 2) >= 0.85
    assert np.all(np.abs(deviations) < 3.5)
    widths = np.array([fit.errors / TRUCK.static_loads for fit in found])
    assert np.all(widths < 0.25)


def test_the_fit_is_closer_than_moses_and_its_intervals_cover(crossings, found):
    with well_compiled():
        given, free = axle_problem(case(), crossings[0], found[0])
        dataset = make_dataset(case(), [given])
        parameters = free_parameters(dataset.cases, free, np.abs(given.values).max())
        problem = LeastSquares(dataset, parameters)
        truth = np.array([*TRUCK.static_loads, SPACING, SPEED, LEAD / SPEED, 0.0, 0.0])
        errors, half_widths, lines = [], [], model_influence_lines(case())
        for log, static in zip(crossings, found, strict=True):
            geometry = static.geometry
            start = [*static.forces, geometry.offsets[1], geometry.speed, geometry.entry_time]
            point = to_unbounded(parameters, [*start, 0.0, 0.0])
            solution = problem.solve(log.values[None], start=point)
            errors.append(solution.values - truth)
            dynamic = errors_of_fit(
                lines, [p.address for p in parameters], solution.values, solution.jacobian[0],
                solution.noise[0], log.times, log.values, log.values - solution.predicted[0],
                log.valid,
            )  # fmt: skip
            half_widths.append(dynamic.half_widths)
    errors, half_widths = np.array(errors), np.array(half_widths)
    covered = np.abs(errors) < half_widths
    assert np.mean(covered[:, :2]) >= 0.85, errors[:, :2] / half_widths[:, :2]
    assert np.mean(covered[:, 2]) >= 0.85, errors[:, 2] / half_widths[:, 2]
    share = np.sqrt(np.mean((errors[:, :2] / TRUCK.static_loads) ** 2))
    by_moses = [(fit.forces - TRUCK.static_loads) / TRUCK.static_loads for fit in found]
    assert share < np.sqrt(np.mean(np.square(by_moses)))
    assert share < 0.06


def test_axles_of_a_log_are_weighed_and_reported(crossings):
    weighed = weigh_axles(case(), crossings[0], SPEEDS)
    assert isinstance(weighed, AxleWeighing)
    forces = np.asarray(weighed.load.forces)
    np.testing.assert_allclose(forces, TRUCK.static_loads, rtol=0.1)
    assert str(weighed).startswith("2 axles found\nBIC by number of axles")
    content = weighed.to_dict()
    assert content["bic"].keys() == {"1", "2", "3", "4", "5"}
    assert content["axles"][0]["value"] == forces[0]
    low, high = content["moses"]["axles"][1]["interval_95"]
    assert low < TRUCK.static_loads[1] < high
    assert content["offsets"][0]["value"] == pytest.approx(SPACING, abs=0.6)


def test_axles_are_counted():
    forces, few = vehicle_elements.forces([0.0, 3.2, 5.6], [60e3, 95e3, 80e3]), slice(None, None, 6)
    log = log_of(forces, speed=10.0, duration=4.0, step=2.5e-3)
    found = count_axles(case(), log.times[few], log.values[few], (5.0, 20.0))
    assert found.chosen == 3 and found.bic.keys() == {1, 2, 3, 4, 5}
    assert str(found).endswith("the option `axles` sets another")


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
    with pytest.raises(ValueError, match="at least 5 points, not 3"):
        calibrate_influence_lines(case(), log, points=3)
