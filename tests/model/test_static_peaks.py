"""Static peaks under every kind of load, against closed forms and sums over the wheels by hand."""

import dataclasses

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.fields import kinds
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.model.modes import mesh_layout
from tests.differences import central

LENGTH, RIGIDITY, G, V = 20.0, 6e9, 9.81, 10.0
BRIDGE = jb.Case(
    jb.Beam(LENGTH, RIGIDITY, 9e3, damping_ratio=0.02), sensors=[jb.Sensor(8.0)], run=jb.Run(4.0)
)
X = 8.0


def moment_line(y, x=X):
    """Moment at x of a simply supported beam under 1 N at y."""
    inside = (np.asarray(y) >= 0) & (np.asarray(y) <= LENGTH)
    return np.where(inside, np.minimum(y, x) - np.asarray(y) * x / LENGTH, 0.0)


def shear_line(y, x=X):
    """Shear force right of x under 1 N at y: 1 - y / L beyond x, -y / L before it."""
    inside = (np.asarray(y) >= 0) & (np.asarray(y) <= LENGTH)
    return np.where(inside, (np.asarray(y) > x) - np.asarray(y) / LENGTH, 0.0)


def loaded(*loads) -> jb.Case:
    return dataclasses.replace(BRIDGE, loads=loads)


def peak(case, x=X, quantity="moment", **options) -> float:
    return float(jb.statics.static_peak(case, x, quantity=quantity, **options))


# Loads that stand


def test_a_force_that_stands():
    """F a b / L, F a^2 b^2 / (3 E I L), F b / L at the left support."""
    a, b, force = 8.0, 12.0, 3e5
    case = loaded(jb.VaryingForce(force=force, position=a))
    assert_allclose(peak(case), force * a * b / LENGTH, rtol=1e-9)
    deflection = force * (a * b) ** 2 / (3 * RIGIDITY * LENGTH)
    assert_allclose(jb.statics.static_peak(case, a), deflection, rtol=1e-9)
    assert_allclose(peak(case, 0.0, "reaction"), force * b / LENGTH, rtol=1e-9)
    assert_allclose(peak(case, a, "shear"), force * a / LENGTH, rtol=1e-9)
    assert_allclose(peak(case, a, "shear", side="left"), force * b / LENGTH, rtol=1e-9)
    stress = peak(case, a, "stress", section_modulus=0.5)
    assert_allclose(stress, 2 * force * a * b / LENGTH, rtol=1e-9)


def test_a_line_load_that_stands():
    """From 4 m to 16 m with 1500 N/m in closed form, at midspan: q a (2 L - a) / 8, a = 12 m."""
    load = jb.LineLoad(force_per_length=1.5e3, lengths=12.0, position=16.0, points=400)
    moment, span = 1.5e3 * 12.0 * (2 * LENGTH - 12.0) / 8, LENGTH / 2
    assert_allclose(peak(loaded(load), span), moment, rtol=1e-5)
    late = dataclasses.replace(load, entry_time=3.0)
    assert_allclose(peak(loaded(late), span), moment, rtol=1e-5)
    beyond = jb.LineLoad(force_per_length=1.5e3, lengths=12.0, position=26.0, points=400)
    part = 1.5e3 * 6.0 * 3.0 / 2  # 14 m to 20 m: half of the right reaction times 10 m
    assert_allclose(peak(loaded(beyond), span), part, rtol=1e-5)
    assert peak(loaded(dataclasses.replace(load, position=45.0))) == 0.0


def test_a_step_load_amplifies_twofold():
    """Undamped, one mode: twice the share 2 / (pi^4 / 96) of the mode in the static deflection."""
    beam = jb.Beam(LENGTH, RIGIDITY, 9e3, modes=1)
    force = jb.VaryingForce(force=1e4, position=LENGTH / 2)
    case = jb.Case(beam, loads=[force], run=jb.Run(2.0))
    found = jb.sections.amplification(case, [LENGTH / 2])[0]
    assert_allclose(found, 2 * 96 / np.pi**4, rtol=1e-6)
    line = jb.LineLoad(force_per_length=1e3, lengths=LENGTH, position=LENGTH, points=60)
    found = jb.sections.amplification(dataclasses.replace(case, loads=[line]), [LENGTH / 2])[0]
    assert_allclose(found, 2 * 384 * 4 / (5 * np.pi**5), rtol=2e-4)


def test_a_standing_and_a_travelling_load_add_up():
    """The second enters after the first has left, and again while it stands."""
    lorry = jb.MovingForce(force=2e5, speed=V)
    for entry in (0.5, 5.0):
        machine = jb.VaryingForce(force=1e5, position=12.0, entry_time=entry)
        most = max(2e5 * moment_line(X), 1e5 * moment_line(12.0))
        if entry < 0.8:  # before the lorry is at x
            most = 2e5 * moment_line(X) + 1e5 * moment_line(12.0)
        assert_allclose(peak(loaded(lorry, machine)), most, rtol=1e-9)


# Forces that vary


def test_waves_and_tables():
    """Against a fine sampling of F(t) times the influence line."""
    waves = {"frequencies": [0.7, 3.1], "amplitudes": [4e4, 3e4], "phases": [0.3, 1.0]}
    table = {"force_times": [0.2, 0.9, 1.4], "forces": [0.0, 9e4, -2e4]}
    passage = X / (2 * V)
    t = np.sort(np.append(np.linspace(0.0, 4.0, 400_001), passage + 1e-9))

    def force(t):
        sines = 4e4 * np.sin(2 * np.pi * 0.7 * t + 0.3) + 3e4 * np.sin(2 * np.pi * 3.1 * t + 1.0)
        return 1e5 + sines + np.interp(t, table["force_times"], table["forces"])

    for where, y in (({"position": 12.0}, 12.0 + 0 * t), ({"speed": 2 * V}, 2 * V * t)):
        case = loaded(jb.VaryingForce(force=1e5, **waves, **table, **where))
        for quantity, line in (("moment", moment_line), ("shear", shear_line)):
            expected = np.abs(force(t) * line(y)).max()
            assert_allclose(peak(case, quantity=quantity), expected, rtol=2e-5)
    only_table = loaded(jb.VaryingForce(**table, speed=V))
    expected = np.abs(np.interp(t, *table.values()) * moment_line(V * t)).max()
    assert_allclose(peak(only_table), expected, rtol=1e-6)


def test_a_long_run_is_searched_in_blocks(monkeypatch):
    case = loaded(jb.VaryingForce(force=1e5, frequencies=[5.0], amplitudes=[2e4], speed=V))
    expected = peak(case)
    monkeypatch.setattr("jaxbeam.model.deflection_lines.BLOCK", 100)
    assert_allclose(peak(case), expected, rtol=1e-14)


def test_traced_waves_are_refused_and_constant_forces_are_not():
    layout = mesh_layout(BRIDGE)

    def of_force(load):
        def value(force):
            case = jb.replace(loaded(load), {"loads.0.force": force})
            return jb.statics.static_peak(case, X, layout, quantity="moment")

        return value

    constant = of_force(jb.VaryingForce(force=1e5, position=12.0))
    assert_allclose(jax.grad(constant)(1e5), central(lambda f: constant(f[0]), [1e5], 1.0)[0])
    assert_allclose(jax.jit(constant)(1e5), 1e5 * moment_line(12.0), rtol=1e-9)
    waves = jb.VaryingForce(force=1e5, frequencies=[1.0], amplitudes=[1.0], position=12.0)
    with pytest.raises(ValueError, match="waves needs known numbers of loads, run and length"):
        jax.jit(of_force(waves))(1e5)


# Every kind, by its wheels: distances behind the first (m), and weights (N)

WAGON = jb.vehicles.Wagon(
    4e4, 2e6, 3e3, 4e3, 1e3, 2e6, 1e4, 1e6, 1e4, bogie_distance=14.0, wheelset_distance=2.0,
    speed=V,
)  # fmt: skip
WAGON_AXLE = (4e4 + 2 * 3e3 + 4 * 1e3) / 4 * G
HALF_CAR = jb.vehicles.HalfCar(
    1e4, 3e4, [2.0, -3.0], [500.0, 800.0], [1e5, 1e5], [1e3, 1e3], [1e6, 1e6], [1e3, 1e3],
    speed=V,
)  # fmt: skip
CAR = jb.QuarterCar(1e4, 1e3, 1e5, 1e3, 1e6, 1e3, speed=V)
MANCHESTER_AXLE = (32000.0 + 2 * 2615.0 + 4 * 1813.0) / 4 * G
KINDS = {
    "force": (jb.MovingForce(force=2e5, speed=V), {0.0: 2e5}),
    "mass": (jb.MovingMass(2e4, V), {0.0: 2e4 * G}),
    "oscillator": (jb.Oscillator(2e4, 1e6, wheel_mass=1e3, speed=V), {0.0: 2.1e4 * G}),
    "quarter-car": (CAR, {0.0: 1.1e4 * G}),
    "half-car": (HALF_CAR, {0.0: (6e3 + 500) * G, 5.0: (4e3 + 800) * G}),
    "wagon": (WAGON, {y: WAGON_AXLE for y in (0.0, 2.0, 14.0, 16.0)}),
    "vehicle": (
        jb.vehicles.VehicleLoad(model="quarter-truck", speed=V, count=2, spacing=7.0),
        {0.0: 1.1e4 * G, 7.0: 1.1e4 * G},
    ),
    "train": (
        jb.vehicles.TrainLoad(speed=V, coaches=[jb.vehicles.Coach("manchester-wagon", count=2)]),
        {a + b: MANCHESTER_AXLE for a in (0.0, 25.0) for b in (0.0, 2.56, 19.0, 21.56)},
    ),
    "axles": (
        jb.Axles(offsets=[0.0, 3.0, 4.5], forces=[1e5, 2e5, 1.5e5], speed=V),
        {0.0: 1e5, 3.0: 2e5, 4.5: 1.5e5},
    ),
    "line-load": (
        jb.LineLoad(force_per_length=1e4, lengths=6.0, points=3, speed=V),
        {1.0: 2e4, 3.0: 2e4, 5.0: 2e4},
    ),
    "varying-force": (jb.VaryingForce(force=2e5, speed=V), {0.0: 2e5}),
    "pedestrian": (
        jb.Pedestrian(pace=2.0, weight=800.0, factors=[], speed=1.5),
        {0.0: 800.0},
    ),
    "crowd": (
        jb.Crowd(people=1, length=5.0, pace=2.0, weight=800.0, factors=[], speed=1.5),
        {0.0: 800.0},
    ),
}


def test_every_kind_is_here():
    assert set(KINDS) == set(kinds(AbstractLoad))


@pytest.mark.parametrize("kind", KINDS)
def test_peaks_under_every_kind(kind):
    """Moments are linear between the passages of wheels over x and the ends of the beam."""
    load, wheels = KINDS[kind]
    behind, weights = np.array(list(wheels)), np.array(list(wheels.values()))
    fronts = (np.array([0.0, X, LENGTH])[:, None] + behind).ravel()
    expected = np.abs(moment_line(fronts[:, None] - behind) @ weights).max()
    assert_allclose(peak(loaded(load)), expected, rtol=1e-9)
    fronts = np.sort(np.concatenate([fronts - 1e-9, fronts, fronts + 1e-9]))
    expected = np.abs(shear_line(fronts[:, None] - behind) @ weights).max()
    assert_allclose(peak(loaded(load), quantity="shear"), expected, rtol=1e-8)


def test_a_traced_peak_under_several_wheels_and_its_derivative():
    """By a weight the moment line where its wheel is at the largest moment; by the speed, zero."""
    load, wheels = KINDS["axles"]
    behind, weights = np.array(list(wheels)), np.array(list(wheels.values()))
    layout = mesh_layout(BRIDGE)

    def value(forces, speed):
        case = jb.replace(loaded(load), {"loads.0.forces": forces, "loads.0.speed": speed})
        return jb.statics.static_peak(case, X, layout, quantity="moment")

    lines = moment_line((np.array([0.0, X, LENGTH])[:, None] + behind).reshape(-1, 1) - behind)
    largest = np.argmax(np.abs(lines @ weights))
    found, (by_weights, by_speed) = jax.jit(jax.value_and_grad(value, (0, 1)))(weights, V)
    assert_allclose(found, lines[largest] @ weights, rtol=1e-9)
    assert_allclose(by_weights, lines[largest], rtol=1e-9, atol=1e-12)
    assert_allclose(by_speed, 0.0, atol=1e-9 * found)
