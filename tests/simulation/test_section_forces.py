"""Section forces and reactions: references, equilibrium, gradients, and both sides of jumps."""

import dataclasses
import json
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.simulation.integration_plan import integration_plan
from tests.modules import ROOT

REFERENCES = json.loads((ROOT / "tests" / "data" / "sections.json").read_text())["cases"]
UNIT = {"flexural_rigidity": 1.0, "mass_per_length": 1.0}


def reference_run(reference) -> tuple[jb.Record, np.ndarray]:
    """Record of a mass of a reference case with 20 modes, and the indices of its instants."""
    given = reference["parameters"]
    spans = 2 if given["beam"]["type"] == "two equal spans" else 1
    duration = spans / given["speed"]
    case = jb.Case(
        jb.Beam(length=float(spans), damping_ratio=given["beam"]["zeta"], modes=20, **UNIT),
        supports=[jb.Support(1.0)] if spans == 2 else [],
        loads=[jb.MovingMass(mass=given["mass"], speed=given["speed"])],
        run=jb.Run(duration, gravity=given["weight"] / given["mass"]),
    )
    shares = np.linspace(0, 1, 101)
    record = jb.simulate(case, times=shares * duration)
    return record, np.searchsorted(shares, np.array(given["t_over_T"]) - 1e-9)


@pytest.fixture(scope="module", params=REFERENCES, ids=lambda reference: reference["case"])
def crossing(request):
    return request.param, *reference_run(request.param)


def accuracy(reference, name: str) -> float:
    """Larger difference of the two independent methods behind a reference, of the largest."""
    stated = reference["accuracy"]
    family = {"M": "M", "F": "F"}.get(name[0], "RA")
    other = {"M": "M_load"}.get(family, name)
    return max(stated["FE_rel"][family], stated["richardson_change_rel_to_max"][other])


def assert_like(reference, name: str, found, instants=slice(None)):
    """Agreement at the instants, relative to the largest force or moment of the reference."""
    outputs = reference["outputs"]
    expected = np.array(outputs[name]["at"])
    size = outputs["M_load" if name[0] == "M" else "F"]["max"]
    tolerance = accuracy(reference, name) * size
    assert_allclose(found[instants], expected[instants], rtol=0, atol=tolerance, err_msg=name)


def test_contact_force_and_moments_of_a_moving_mass(crossing):
    reference, record, at = crossing
    assert_like(reference, "F", np.asarray(record.contact_force)[at, 0])
    for x in reference["parameters"]["xs"]:
        assert_like(reference, f"M_{x:g}", np.asarray(record.bending_moment(x))[at])
    under_load = np.asarray(record.load_position)[at, 0]
    moments = np.asarray(record.bending_moment(under_load))[at]
    assert_like(reference, "M_load", np.diag(moments))
    if "MB" in reference["outputs"]:
        assert_like(reference, "MB", np.asarray(record.bending_moment(1.0))[at])


def test_shear_before_and_after_a_moving_mass(crossing):
    reference, record, at = crossing
    x = np.asarray(record.load_position)[at, 0]
    before = np.diag(np.asarray(record.shear_force(x, "left"))[at])
    after = np.diag(np.asarray(record.shear_force(x, "right"))[at])
    assert_like(reference, "V_before", before)
    # At the inner support the reference is left of it, ours right of load and support.
    elsewhere = np.abs(x - 1.0) > 1e-9
    assert_like(reference, "V_after", after, elsewhere)
    force = np.asarray(record.contact_force)[at, 0]
    assert_allclose((before - after)[elsewhere], force[elsewhere], rtol=1e-9)


def test_reactions_under_a_moving_mass(crossing):
    """Inner reactions of the reference (RB) contradict its own equilibrium by 3 %: not compared."""
    reference, record, at = crossing
    found = np.asarray(record.reactions)[at]
    assert_allclose(record.support_positions, np.arange(found.shape[1]), atol=1e-12)
    assert_like(reference, "RA", found[:, 0])
    assert_like(reference, "RC", found[:, -1])


# Equilibrium


def imbalances(record: jb.Record, x, weights) -> np.ndarray:
    """Sums of forces on the beam, and of their moments about x = 0, (2, time).

    Reactions, contact forces, support dampers within the reactions, inertia and damping of the
    modes by quadrature along the beam, patches without commands. Patches and bearings add mass.
    """
    case, modes = record.case, record.modes
    density = np.full(x.shape, float(case.beam.linear_density))
    for actuator in case.actuators:
        patch = actuator.section_stiffening()
        if patch is not None:
            density += float(patch.mass_per_length) * ((patch.start < x) & (x < patch.end))
    damping = np.asarray(record.rates) * np.asarray(modes.damping) @ np.asarray(modes.shapes(x)).T
    inertia = (np.asarray(record.at(x, "acceleration")) + damping) * density * weights
    position = np.nan_to_num(np.asarray(record.load_position))
    force, reactions = np.asarray(record.contact_force), np.asarray(record.reactions)
    held_at = np.asarray(record.support_positions)
    for support in case.supports:
        if support.mass is not None:
            mass, x = float(support.mass), np.append(x, support.position)
            bearing = mass * np.asarray(record.at(x[-1:], "acceleration"))
            inertia = np.hstack([inertia, bearing])
    sums = reactions.sum(axis=1) - force.sum(axis=1) - inertia.sum(axis=1)
    moments = reactions @ held_at - np.sum(force * position, axis=1) - inertia @ x
    return np.array([sums, moments])


LOADS = (
    jb.MovingMass(mass=0.2, speed=0.8),
    jb.MovingMass(mass=0.1, speed=-0.6, entry_time=0.3),
    jb.MovingForce(force=0.7, speed=1.1, entry_time=0.5),
)
BEAM = jb.Beam(length=2.0, damping_ratio=0.02, modes=6, **UNIT)
CASES = {
    "two spans": jb.Case(BEAM, supports=[jb.Support(0.9)]),
    "overhang": jb.Case(dataclasses.replace(BEAM, ends="pinned-free"), supports=[jb.Support(1.3)]),
    "elastic, damped": jb.Case(
        dataclasses.replace(BEAM, ends="free-free"),
        supports=[
            jb.Support(0.0, stiffness=300.0),
            jb.Support(0.8, stiffness=80.0, damping=2.0),
            jb.Support(2.0, stiffness=1e11),
        ],
    ),
    "pulled": jb.Case(dataclasses.replace(BEAM, axial_force=3.0), supports=[jb.Support(0.9)]),
    "heavy bearing": jb.Case(BEAM, supports=[jb.Support(0.8, stiffness=80.0, mass=0.3)]),
    "patch": jb.Case(
        BEAM, actuators=[jb.Patch(0.5, 0.9, 1e-3, added_mass=0.1, added_rigidity=0.5)]
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_equilibrium_at_every_instant(name):
    """Vertical forces, and moments about the left end where nothing clamps, to 1e-8 of a weight."""
    case = dataclasses.replace(
        CASES[name], loads=LOADS, run=jb.Run(3.0, sample_rate=100.0, gravity=5.0)
    )
    record = jb.simulate(case)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    edges = np.unique([0.0, 0.5, 0.8, 0.9, 1.3, 2.0])
    half = np.diff(edges)[:, None] / 2
    x = (edges[:-1, None] + half * (1 + nodes)).ravel()
    found = imbalances(record, x, (half * weights).ravel())
    assert np.abs(found).max() < 1e-8
    assert np.abs(record.reactions).max() > 0.5


def test_reaction_of_an_elastic_support_is_its_own_force():
    """k w + c w' of the corrected deflection; a stiff spring carries what a rigid support does."""
    case = dataclasses.replace(
        CASES["elastic, damped"], loads=LOADS, run=jb.Run(2.0, sample_rate=100.0, gravity=5.0)
    )
    record = jb.simulate(case)
    pushed = jb.sections.corrected_deflection(record, np.array([0.0, 0.8]))
    expected = -np.array([300.0, 80.0]) * pushed - np.array([0.0, 2.0]) * record.at(
        np.array([0.0, 0.8]), "velocity"
    )
    assert_allclose(record.reactions[:, :2], expected, rtol=0, atol=1e-8)
    stiff = dataclasses.replace(CASES["two spans"], supports=[jb.Support(0.9, stiffness=1e11)])
    rigid, elastic = (
        jb.simulate(dataclasses.replace(one, loads=LOADS, run=case.run)).reactions
        for one in (CASES["two spans"], stiff)
    )
    assert_allclose(elastic, rigid, rtol=0, atol=1e-6 * np.abs(rigid).max())


# A force that stands still


def standing(x: float, beam: jb.Beam, **parts) -> jb.Record:
    """Record of a downward force of 2 N that has stood at x until all vibration is damped away."""
    load = jb.MovingForce(force=2.0, times=[0.0, 9.0], positions=[x, x])
    beam = dataclasses.replace(beam, damping_ratio=0.7, modes=3)
    return jb.simulate(jb.Case(beam, loads=[load], run=jb.Run(8.0), **parts), np.array([7.0, 8.0]))


@pytest.mark.parametrize("a", [0.3, 1.0, 1.6])
def test_a_force_standing_on_two_spans(a):
    """Clapeyron's three moments: M_B = -P a (L^2 - a^2) / (4 L^2) for a force on the first span."""
    beam = jb.Beam(length=2.0, **UNIT)
    record = standing(a, beam, supports=[jb.Support(1.0)])
    near = min(a, 2.0 - a)
    at_support = -2 * near * (1 - near**2) / 4
    loaded, other = 2 * (1 - near) + at_support, at_support
    ends = [loaded, other] if a <= 1 else [other, loaded]
    reactions = [ends[0], 2 - sum(ends), ends[1]]
    assert_allclose(record.reactions[-1], reactions, rtol=0, atol=1e-9)
    assert_allclose(record.bending_moment(1.0)[-1], at_support, rtol=0, atol=1e-9)
    inner = record.shear_force(1.0, "right") - record.shear_force(1.0, "left")
    weight_there = 2.0 if a == 1.0 else 0.0
    assert_allclose(inner[-1], reactions[1] - weight_there, rtol=0, atol=1e-8)


@pytest.mark.parametrize("controlled", [False, True])
def test_a_force_on_a_support_takes_no_shorter_steps(controlled):
    """It deflects nothing, so that no step meets a tolerance relative to the deflection."""
    parts: dict = {}
    if controlled:
        parts["actuators"] = [jb.Shaker(0.4, 0.0, 0.0, 1.0)]
        parts["sensors"], parts["controller"] = [jb.Sensor(0.5)], jb.Feedback([1.0], period=0.1)
    beam = jb.Beam(length=2.0, damping_ratio=0.05, modes=3, **UNIT)
    beside, on = (
        integration_plan(
            jb.Case(
                beam,
                supports=[jb.Support(1.0)],
                loads=[jb.MovingForce(force=2.0, times=[0.0, 9.0], positions=[x, x])],
                run=jb.Run(1.0, sample_rate=10.0),
                **parts,
            )
        ).substeps
        for x in (0.9, 1.0)
    )
    assert on <= beside


def test_sides_other_than_left_and_right_are_refused():
    record = standing(0.5, jb.Beam(length=1.0, **UNIT))
    with pytest.raises(ValueError, match="side must be 'left' or 'right' of x, not 'top'"):
        record.shear_force(0.5, "top")


# Truncation


def moving_force_moment(x, y, ratio: float, modes: int, derivative: int) -> np.ndarray:
    """d^k w / dx^k under a unit force moving on an undamped pinned span with E I = m = L = 1.

    Closed form with all modes up to `modes`, the last ones of which respond as in statics: mode n
    of frequency (n pi)^2 is driven at n pi v; `ratio` is v / pi (Fryba, Vibration of solids and
    structures under moving loads, 1999, section 1.3).
    """
    n = np.arange(1, modes + 1)
    y = np.asarray(y)
    drive, omega = n * np.pi * ratio * np.pi, (n * np.pi) ** 2
    time = y[:, None] / (ratio * np.pi)
    q = (np.sin(drive * time) - drive / omega * np.sin(omega * time)) / (omega**2 - drive**2)
    quasi = np.sin(n * np.pi * y[:, None]) / omega**2
    shape = {2: -np.sin(n * np.pi * x), 3: -np.cos(n * np.pi * x)}[derivative]
    dynamic = -2 * (q - quasi) @ (shape * (n * np.pi) ** derivative)
    static = np.where(x < y, (1 - y) * x, (1 - x) * y) if derivative == 2 else (x < y) - y
    return dynamic + static


def test_order_of_truncation():
    """Away from the load sums of n modes have errors like n^-2 (M) and n^-1 (V).

    Under the load M has n^-1. Corrected, n^-2.5 and n^-1.5 remain: the entry of the force sets off
    free vibration of the truncated modes, n^-3 (M) and n^-2 (V) each and of unlike phases.
    """
    ratio, x = 0.2, 0.31
    times = np.linspace(0, 1, 81)[1:-1] / (ratio * np.pi)
    y = times * ratio * np.pi
    away = np.abs(y - x) > 0.12
    errors = {}
    for count in (4, 8, 16, 32):
        case = jb.Case(
            jb.Beam(length=1.0, modes=count, **UNIT),
            loads=[jb.MovingForce(force=1.0, speed=ratio * np.pi)],
            run=jb.Run(1 / (ratio * np.pi)),
        )
        record = jb.simulate(case, times)
        for derivative, corrected in ((2, record.bending_moment(x)), (3, record.shear_force(x))):
            exact = moving_force_moment(x, y, ratio, 3000, derivative)
            modal = np.tensordot(record.coordinates, record.modes.shapes(x, derivative), 1)
            for name, found in (("modal", modal), ("corrected", corrected)):
                error = np.abs(np.asarray(found) - exact)
                errors.setdefault((name, derivative), []).append(np.sqrt(np.mean(error[away] ** 2)))
        record = jb.simulate(case, np.array([0.2, 0.5]) / (ratio * np.pi))
        modal = np.tensordot(record.coordinates, record.modes.shapes(0.5, 2), 1)[1]
        exact = moving_force_moment(0.5, [0.5], ratio, 3000, 2)[0]
        errors.setdefault("under", []).append(abs(modal - exact))
    orders = {k: -np.polyfit(np.log([4, 8, 16, 32]), np.log(v), 1)[0] for k, v in errors.items()}
    assert_allclose(orders["modal", 2], 2.0, atol=0.4)
    assert_allclose(orders["modal", 3], 1.0, atol=0.4)
    assert_allclose(orders["under"], 1.0, atol=0.3)
    assert_allclose(orders["corrected", 2], 2.5, atol=0.4)
    assert_allclose(orders["corrected", 3], 1.5, atol=0.5)
    assert np.all(np.array(errors["corrected", 2]) < 0.06 * np.array(errors["modal", 2]))


def test_stated_error_of_truncation():
    """Peaks of 16 modes differ by at most 1.5 times what is stated with 4 and 8 modes."""
    sensors = [
        jb.Sensor(0.5),
        jb.Sensor(0.5, "moment"),
        jb.Sensor(0.3, "strain", fibre_distance=-0.1),
        jb.Sensor(0.5, "velocity"),
        jb.Sensor(0.5, "acceleration"),
        jb.Sensor(0.0, "rotation"),
    ]
    beam = jb.Beam(length=2.0, damping_ratio=0.01, **UNIT)
    loads = [jb.MovingMass(mass=0.2, speed=1.0)]
    case = jb.Case(beam, [jb.Support(1.0)], (), sensors, loads, run=jb.Run(2.4))

    def run(modes):
        record = jb.simulate(dataclasses.replace(case, beam=dataclasses.replace(beam, modes=modes)))
        return record, np.maximum(-np.asarray(record.smallest), np.asarray(record.largest))

    _, exact = run(16)
    stated = []
    for modes in (4, 8):
        record, peaks = run(modes)
        stated.append(np.asarray(record.truncation_errors))
        others = np.arange(6) != 4  # accelerations under a mass converge slowly: a convention
        assert np.all(np.abs(peaks / exact - 1)[others] < 1.5 * stated[-1][others])
    assert np.all(stated[0] < [0.02, 0.06, 0.09, 0.4, 0.6, 0.06])
    assert np.all(stated[1] < [0.003, 0.004, 0.003, 0.02, 0.2, 0.02])
    assert stated[1][4] > 10 * stated[1][0]


def test_stated_error_of_truncation_of_a_damped_beam_by_scipy():
    """The three highest of four modes less their static part, which damping enters by its sign."""
    length, rigidity, mass, ratio, force, speed = 2.0, 3.0, 1.5, 0.4, 5.0, 2.5
    beam = jb.Beam(length, rigidity, mass, ratio, modes=4)
    sensors = [jb.Sensor(0.7, "moment")]
    loads = [jb.MovingForce(force=force, speed=speed)]
    duration = length / speed
    case = jb.Case(beam, sensors=sensors, loads=loads, run=jb.Run(duration, sample_rate=200.0))
    record = jb.simulate(case, tolerance=1e-9)

    n = np.arange(2, 5)
    wavenumber = n * np.pi / length
    omega = wavenumber**2 * np.sqrt(rigidity / mass)

    def rates(t, state):
        q, dq = np.split(state, 2)
        pushed = -2 * force / (mass * length) * np.sin(wavenumber * speed * t)
        return np.concatenate([dq, pushed - 2 * ratio * omega * dq - omega**2 * q])

    times = np.asarray(record.times)
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-12}
    states = solve_ivp(rates, (0.0, duration), np.zeros(6), t_eval=times, **options).y
    static = -2 * force / (mass * length) * np.sin(np.outer(wavenumber * speed, times))
    dynamic = states[:3] - static / omega[:, None] ** 2
    changes = rigidity * (wavenumber**2 * np.sin(wavenumber * 0.7)) @ dynamic
    expected = np.abs(changes).max() / np.abs(record.sensor_values).max()
    assert_allclose(record.truncation_errors[0], expected, rtol=1e-6)


@pytest.mark.parametrize("modes", [3, 6])
def test_strain_under_a_slow_axle_is_right_with_three_modes(modes):
    """P L / 4 at midspan to 1e-3, where the sum of three modes is 10 % low."""
    beam = jb.Beam(30.0, 3e10, 1e4, 0.02, modes=modes)
    sensors = [
        jb.Sensor(15.0, "strain", fibre_distance=-0.8),
        jb.Sensor(15.0, "moment"),
        jb.Sensor(15.0, "stress", section_modulus=0.5),
        jb.Sensor(15.0, "curvature"),
        jb.Sensor(10.0, "shear"),
        jb.Sensor(0.0, "rotation"),
    ]
    loads = [jb.MovingForce(force=1e5, speed=0.25)]
    case = jb.Case(beam, sensors=sensors, loads=loads, run=jb.Run(121.0, sample_rate=10.0))
    record = jb.simulate(case)
    middle = 60 * 10  # the sample at which the load is at midspan
    moment, rotation = 1e5 * 30 / 4, -1e5 * 30**2 / (16 * 3e10)
    strain = 0.8 * moment / 3e10
    expected = [strain, moment, moment / 0.5, moment / 3e10, 0.5e5, rotation]
    assert_allclose(record.measured[middle, :5], expected[:5], rtol=1e-3)
    assert_allclose(record.measured[middle, 5], expected[5], rtol=1e-2)  # not corrected: n^-3
    modal = np.asarray(record.coordinates)[middle] @ np.asarray(record.modes.shapes(15.0, 2))
    assert modal * 3e10 < (0.91 if modes == 3 else 0.94) * moment
    assert_allclose(record.extremes.largest[1], moment, rtol=1e-3)


SPAN, FORCE, STIFFNESS = 20.0, 300e3, 20e9


def two_spans(speed: float, sides=("left", "right"), **changes) -> jb.Case:
    """Two equal spans under a force, with shear sensors on sides of the pier."""
    case = jb.Case(
        jb.Beam(2 * SPAN, STIFFNESS, 10e3, damping_ratio=0.02, modes=8),
        supports=[jb.Support(SPAN)],
        sensors=[jb.Sensor(SPAN, "shear", side=side) for side in sides],
        loads=[jb.MovingForce(force=FORCE, speed=speed)],
        run=jb.Run(duration=2 * SPAN / speed, sample_rate=200 * speed / SPAN),
    )
    return dataclasses.replace(case, **changes)


def test_shear_beside_a_pier_under_a_slow_force():
    """Left of the pier R_1 - P <= 0 before it, M / L <= 0 behind it; right of it the mirror image.

    Of a force at a from an outer end M = P a (L^2 - a^2) / (4 L^2), at most P L / (6 sqrt(3)).
    """
    case = two_spans(0.2)
    record, swept = jb.simulate(case), jb.sweep(case, {"loads.0.speed": [0.2]})
    low, high = jb.envelope(case, x=[SPAN], quantity="shear")
    beyond = FORCE / (6 * np.sqrt(3))
    assert_allclose(record.smallest, [-FORCE, 0.0], atol=2e-3 * FORCE)
    assert_allclose(record.largest, [0.0, FORCE], atol=2e-3 * FORCE)
    assert_allclose(swept["peak_shear"][0], [FORCE, FORCE], rtol=2e-3)
    assert_allclose([low[0], high[0]], [record.smallest[0], record.largest[1]], rtol=1e-6)
    for i, side in enumerate(case.sensors):
        at_pier = record.shear_force(SPAN, side.side)
        assert_allclose(record.sensor_values[:, i], at_pier, atol=1e-9 * FORCE)
        assert_allclose(record.at(SPAN, "shear") if i else at_pier, at_pier)
        assert_allclose(jb.statics.static_peak(case, SPAN, quantity="shear", side=side.side), FORCE)
    behind = np.asarray(record.load_position)[:, 0] > SPAN + 0.1
    assert np.min(record.sensor_values[behind, 0]) == pytest.approx(-beyond, rel=1e-2)


def test_sides_of_fast_crossings_are_the_same_in_sweeps():
    case = two_spans(35.0)
    record, swept = jb.simulate(case), jb.sweep(case, {"loads.0.speed": [20.0, 35.0]})
    largest = np.maximum(-record.smallest, record.largest)
    assert abs(largest[0] / largest[1] - 1) > 1e-2
    assert_allclose(swept["peak_shear"][1], largest, rtol=1e-6)
    grid = record.envelope("shear", np.array([SPAN]))
    assert_allclose(grid.smallest, np.min(record.sensor_values), rtol=1e-6)
    assert_allclose(grid.largest, np.max(record.sensor_values), rtol=1e-6)


def test_rows_beside_a_pier_mirror_each_other():
    """Modes of two equal spans are even or odd, and their third derivatives odd or even."""
    rows = np.asarray(jb.state_space(two_spans(35.0)).unloaded.C)[:, :8]
    signs = np.where(np.arange(8) % 2, -1.0, 1.0)
    assert_allclose(rows[0], signs * rows[1], atol=1e-6 * np.max(np.abs(rows)))


def test_rotations_beside_a_hinge():
    """A force at the hinge of a Gerber beam: its cantilever bends, the rest turns rigidly."""
    length, at = 10.0, 4.0
    case = jb.Case(
        jb.Beam(length, 2e8, 1e3, modes=20, ends="clamped-pinned", hinges=[jb.Hinge(at)]),
        sensors=[jb.Sensor(at, "rotation", side=side) for side in ("left", "right")],
        loads=[jb.VaryingForce(force=1e4, position=at)],
        run=jb.Run(duration=1.0, sample_rate=2000.0),
    )
    slopes = [-1e4 * at**2 / 2 / 2e8, 1e4 * at**3 / 3 / 2e8 / (length - at)]
    record = jb.simulate(case)
    for i, (sensor, slope) in enumerate(zip(case.sensors, slopes, strict=True)):
        static = jb.statics.static_peak(case, at, quantity="rotation", side=sensor.side)
        assert static == pytest.approx(abs(slope), rel=1e-9)
        values = np.asarray(record.sensor_values)[:, i]
        assert np.sign(values[np.argmax(np.abs(values))]) == np.sign(slope)
        assert 1.5 < np.max(np.abs(values)) / abs(slope) < 2.5  # a step load


def test_curvatures_beside_a_change_of_section():
    """The moment is the same on both sides, the curvature in the ratio of the stiffnesses."""
    beam = jb.Beam(
        20.0,
        mass_per_length=1e3,
        modes=6,
        segments=[jb.Segment(8.0, flexural_rigidity=2e9), jb.Segment(12.0, flexural_rigidity=6e9)],
    )
    names = [(q, s) for q in ("curvature", "moment") for s in ("left", "right")]
    case = jb.Case(
        beam,
        sensors=[jb.Sensor(8.0, quantity, side=side) for quantity, side in names],
        loads=[jb.MovingForce(force=1e5, speed=10.0)],
        run=jb.Run(duration=2.0),
    )
    left, right, moment, same = np.asarray(jb.simulate(case).sensor_values).T
    assert_allclose(left, 3 * right, atol=1e-6 * np.max(np.abs(left)))
    assert_allclose(moment, 2e9 * left, atol=1e-6 * np.max(np.abs(moment)))
    assert_allclose(moment, same, atol=1e-6 * np.max(np.abs(moment)))


def test_a_side_without_effect_is_refused():
    case = two_spans(35.0, sensors=[jb.Sensor(SPAN, side="left")])
    with pytest.raises(ValueError, match=r"sensors\.0\.side would have no effect on .* deflection"):
        jb.simulate(case)


@pytest.mark.parametrize(
    ("quantity", "changes", "name"),
    [
        ("shear", {}, r"supports\.0"),
        ("moment", {"supports": [jb.Support(SPAN, rotational_stiffness=1e9)]}, r"supports\.0"),
        ("shear", {"supports": [], "actuators": [jb.PointForce(SPAN)]}, r"actuators\.0"),
        (
            "curvature",
            {
                "beam": jb.Beam(
                    2 * SPAN,
                    mass_per_length=10e3,
                    segments=[jb.Segment(SPAN, flexural_rigidity=f * STIFFNESS) for f in (1, 2)],
                )
            },
            "a change of section",
        ),
        (
            "rotation",
            {"beam": jb.Beam(2 * SPAN, STIFFNESS, 10e3, hinges=[jb.Hinge(SPAN)]), "supports": []},
            r"beam\.hinges\.0",
        ),
    ],
)
def test_a_side_that_is_not_named_is_told(quantity, changes, name):
    def warnings(**sensor):
        sensors = [jb.Sensor(SPAN, quantity, **sensor), jb.Sensor(SPAN / 2, quantity)]
        found = jb.check(two_spans(20.0, **changes | {"sensors": sensors})).warnings
        return [one for one in found if one.startswith("sensors")]

    sentence = rf"sensors\.0\.side: the {quantity} jumps at {name}, at 20 m"
    (told,) = warnings()
    assert re.match(sentence, told)
    assert not warnings(side="left")
    assert not warnings(side="right")
