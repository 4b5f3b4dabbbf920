"""Runs of beams that are not uniform, or settled: references, finite elements, statics, sweeps."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp

import jaxbeam as jb
from jaxbeam.analysis.sections import corrected_deflection
from jaxbeam.case.beam import rigidity
from jaxbeam.case.case import replace
from jaxbeam.case.loads.vehicles import Oscillator
from jaxbeam.case.profiles.shapes import RampProfile
from jaxbeam.model.deflection_lines import static_deflection_per_command
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.static_correction import Motion, corrected_history
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.stored_record import record_from_xarray
from tests.differences import central
from tests.modules import ROOT
from tests.oracles import finite_elements as fe
from tests.oracles.closed_forms import ShootingBeam
from tests.oracles.section_elements import crossing, modes

REFERENCES = {
    case["case"]: case["outputs"]
    for case in json.loads((ROOT / "tests" / "data" / "beams.json").read_text())["cases"]
}
UNIT = {"length": 1.0, "flexural_rigidity": 1.0, "mass_per_length": 1.0}
CUBE = [1.0, -1.5, 0.75, -0.125]  # (1 - s / 2)^3
TAPERED = [jb.Segment(None, CUBE, [1.0, -0.5])]


def smallest(beam: jb.Beam, speed: float) -> tuple[float, float]:
    """Smallest statically corrected deflection midway under a unit force, and its time over T."""
    case = jb.Case(beam, loads=[jb.MovingForce(force=1.0, speed=speed)], run=jb.Run(1 / speed))
    shares = np.linspace(0, 1, 4001)
    record = jb.simulate(case, times=shares / speed)
    deflection = corrected_deflection(record, 0.5)
    i = np.argmin(deflection)
    return float(deflection[i]), shares[i]


def test_force_on_a_timoshenko_beam():
    beam = jb.Beam(**UNIT, modes=60, shear_stiffness=96.15384615384615, rotary_inertia=0.01 / 3)
    expected = REFERENCES["6b-moving-force-timoshenko-hL0.2-a0.3"]
    assert_allclose(smallest(beam, 0.3 * np.pi)[0], expected["w_min"], rtol=3e-6)
    static = jb.influence_line(jb.Case(beam), 0.5, 0.5)
    assert_allclose(static, expected["static_mid"], rtol=3e-8)  # to the digits of the reference


def test_force_on_a_tapered_beam():
    expected = REFERENCES["6c-moving-force-tapered"]
    found, share = smallest(jb.Beam(length=1.0, modes=12, segments=TAPERED), 0.5)
    assert_allclose(found, expected["w_min"], rtol=8e-6)  # accuracy of the reference
    assert_allclose(share, expected["t"] * 0.5, atol=2e-4)


@pytest.mark.parametrize("foundation", [100, 1000])
@pytest.mark.parametrize("ratio", ["0.3", "0.6"])
def test_force_on_a_foundation(foundation, ratio):
    expected = REFERENCES["6d-winkler"]["moving"][f"kf{foundation}_v{ratio}pi"]
    beam = jb.Beam(**UNIT, modes=40, foundation_stiffness=foundation)
    found, share = smallest(beam, float(ratio) * np.pi)
    assert_allclose(found, expected["w_min"], rtol=3e-6)
    assert_allclose(share, expected["t_over_T"], atol=2e-4)


def complete_beam(**others) -> jb.Beam:
    """Tapered Timoshenko beam on a foundation, in tension."""
    segments = [jb.Segment(None, CUBE, [1.0, -0.5], shear_stiffness=[90.0, -45.0])]
    return jb.Beam(
        length=1.0,
        modes=8,
        shear_stiffness=90.0,
        rotary_inertia=0.003,
        foundation_stiffness=40.0,
        axial_force=3.0,
        segments=segments,
        **others,
    )


COMPLETE = ShootingBeam(
    1.0,
    lambda x: (1 - x / 2) ** 3,
    lambda x: 1 - x / 2,
    lambda x: 1 / (90 - 45 * x),
    lambda x: 0.003,
    foundation=40.0,
    axial=3.0,
    ends="clamped-pinned",
)


@pytest.mark.parametrize("mass", [0.0, 0.4])
def test_load_against_finite_elements(mass):
    load = jb.MovingMass(mass=mass, speed=0.7) if mass else jb.MovingForce(force=2.0, speed=0.7)
    gravity = 2.0 / mass if mass else 9.81
    case = jb.Case(
        complete_beam(ends="clamped-pinned"), loads=[load], run=jb.Run(1 / 0.7, gravity=gravity)
    )
    times = np.linspace(0, 1 / 0.7, 57)
    record = jb.simulate(case, times=times)
    coarse, fine = (modes(COMPLETE, 8, elements) for elements in (80, 160))
    frequencies = (4 * fine[0] - coarse[0]) / 3  # Richardson's extrapolation
    assert_allclose(record.modes.angular_frequencies, frequencies, rtol=2e-6)
    first, second = (crossing(*found, times, 0.7, 2.0, mass, 0.5) for found in (coarse, fine))
    expected = (4 * second - first) / 3
    found = record.at(0.5, "deflection")
    assert_allclose(found, expected, rtol=0, atol=5e-6 * np.abs(expected).max())


def test_hinge_and_bearing_against_finite_elements():
    """A force over a hinge with a spring, and over an elastic bearing that has a mass."""
    case = jb.Case(
        jb.Beam(**UNIT, modes=6, ends="clamped-pinned", hinges=[jb.Hinge(0.4, 0.5)]),
        supports=[jb.Support(0.7, stiffness=300.0, mass=0.2)],
        loads=[jb.MovingForce(force=2.0, speed=0.7)],
        run=jb.Run(1 / 0.7),
    )
    times = np.linspace(0, 1 / 0.7, 57)
    record = jb.simulate(case, times=times)
    plain = ShootingBeam(1.0, lambda x: 1.0, lambda x: 1.0, ends="clamped-pinned")
    frequencies, nodes, shapes = modes(plain, 6, 100, ((70, 300.0, 0.2),), ((40, 0.5),))
    assert_allclose(record.modes.angular_frequencies, frequencies, rtol=1e-6)
    fine = [np.interp(0.55, nodes, shape) for shape in shapes.T]
    assert_allclose(np.abs(record.modes.shapes(0.55)), np.abs(fine), rtol=0, atol=2e-3)
    # A spline on each side of the hinge.
    expected = _crossing_with_hinge(frequencies, nodes, shapes, times, 0.7, 2.0, 0.55)
    found = record.at(0.55, "deflection")
    assert_allclose(found, expected, rtol=0, atol=1e-5 * np.abs(expected).max())
    moment = record.bending_moment(0.4)
    jump = record.at(0.4 + 1e-9, "rotation") - record.at(0.4 - 1e-9, "rotation")
    # The moment is corrected, the rotation is not: with the correction of the rotation they agree.
    corrected = corrected_deflection(record, 0.4 + 1e-9, 1) - corrected_deflection(
        record, 0.4 - 1e-9, 1
    )
    assert_allclose(moment, 0.5 * corrected, atol=1e-6 * np.abs(moment).max())
    assert np.abs(jump).max() > 0.01


def _crossing_with_hinge(frequencies, nodes, shapes, times, speed, weight, x):
    from scipy.integrate import solve_ivp
    from scipy.interpolate import CubicSpline

    sides = [CubicSpline(nodes[:41], shapes[:41]), CubicSpline(nodes[40:], shapes[40:])]

    def row(place):
        return sides[int(place > 0.4)](place)

    def rate(t, state):
        force = -weight * row(min(speed * t, 1.0))
        return np.concatenate([state[6:], -(frequencies**2) * state[:6] + force])

    solution = solve_ivp(
        rate, (0, times[-1]), np.zeros(12), "DOP853", times, rtol=1e-10, atol=1e-13, max_step=0.01
    )
    return row(x) @ solution.y[:6]


def test_equilibrium():
    """Forces, and moments about the left end, of the whole beam add up to zero at every instant.

    Reactions, load, foundation and inertia; the axial force pulls at the heights of the ends, and
    sections have rotary inertia.
    """
    case = jb.Case(
        complete_beam(ends="free-pinned"),
        supports=[jb.Support(0.0, stiffness=200.0, mass=0.3), jb.Support(0.6)],
        loads=[jb.MovingForce(force=2.0, speed=0.7)],
        run=jb.Run(1 / 0.7),
    )
    times = np.linspace(0, 1 / 0.7, 16)[1:-1]
    record = jb.simulate(case, times=times)
    points, weights = np.polynomial.legendre.leggauss(40)
    reactions = np.asarray(record.reactions)
    total = np.sum(reactions, axis=1) - 2.0
    moment = reactions @ np.asarray(record.support_positions) - 2.0 * 0.7 * times
    moment += 3.0 * (corrected_deflection(record, 0.0) - corrected_deflection(record, 1.0))
    for i, place in enumerate(0.7 * times):
        edges = np.sort([0.0, 0.6, place, 1.0])
        halves = np.diff(edges)[:, None] / 2
        x = (edges[:-1, None] + (points + 1) * halves).ravel()
        now = Motion(*(part[i : i + 1] for part in record.motion))
        deflection = corrected_history(case, record.modes, now, x)[0]
        acceleration = record.modes.shapes(x) @ record.accelerations[i]
        load = 40.0 * deflection + (1 - x / 2) * acceleration
        rotary = 0.003 * record.modes.fields(x, (1,))[0] @ record.accelerations[i]
        total[i] -= np.sum((weights * halves).ravel() * load)
        moment[i] -= np.sum((weights * halves).ravel() * (load * x + rotary))
    # The reaction on the ground includes the inertia of the bearing.
    bearing = 0.3 * np.asarray(record.at(0.0, "acceleration"))
    assert_allclose(total - bearing, 0, atol=1e-8)
    assert_allclose(moment, 0, atol=1e-8)


@pytest.mark.parametrize("kept", [True, False])
def test_section_forces_of_a_record_from_a_file(tmp_path, kept):
    """Also from files of releases that did not keep the rotations of a Timoshenko beam."""
    case = jb.Case(
        complete_beam(ends="clamped-pinned"),
        loads=[jb.MovingForce(force=2.0, speed=0.7)],
        run=jb.Run(1 / 0.7, sample_rate=10.0),
    )
    record = jb.simulate(case)
    dataset = record.to_xarray()
    assert_allclose(dataset["reaction"].sel(support=1.0), record.reactions[:, 1])
    if kept:
        record.save(tmp_path / "record.nc")
        found = jb.read_record(tmp_path / "record.nc")
    else:
        former = dataset.drop_vars(["mode_rotation_series", "reaction"])
        found = record_from_xarray(former)
    assert_allclose(found.bending_moment(0.4), record.bending_moment(0.4), rtol=1e-12)
    assert_allclose(found.shear_force(0.4), record.shear_force(0.4), rtol=1e-12)
    assert_allclose(found.reactions, record.reactions, rtol=1e-12)


def test_static_closed_forms():
    """Shear flexibility adds P x (L - x) / (L kGA); tension that of a beam-column."""
    force = 7.0
    shear = jb.Case(jb.Beam(**UNIT, shear_stiffness=25.0))
    assert_allclose(jb.influence_line(shear, 0.3, 0.3), -((0.3 * 0.7) ** 2) / 3 - 0.21 / 25)
    tension = jb.Case(jb.Beam(**UNIT, axial_force=force))
    a = np.sqrt(force)
    expected = -1 / (4 * force) * (1 - np.tanh(a / 2) / (a / 2))
    assert_allclose(jb.influence_line(tension, 0.5, 0.5), expected, rtol=1e-11)
    long = jb.Case(jb.Beam(60.0, 1.0, 1.0, foundation_stiffness=4.0))  # beta = 1 / m
    found = [float(jb.influence_line(long, 30.0, 30.0, derivative=d)) for d in (0, 2)]
    assert_allclose(found, [-1 / 8, 1 / 4], rtol=1e-11)  # Hetenyi: P beta / 2 k, P / 4 beta


def test_influence_lines_are_reciprocal_and_derive():
    """Fields of order 0, 1, 2 by differences; the moment is E I phi' of a stepped beam."""
    beam = complete_beam(ends="clamped-pinned")
    case, y, step = jb.Case(beam, [jb.Support(0.7)]), np.array([0.2, 0.85]), 1e-4
    line = jb.influence_line(case, y, y)
    assert_allclose(line, np.transpose(line), rtol=1e-11)

    def at(x, order):
        return np.asarray(jb.influence_line(case, x, y, derivative=order))

    slope = (at(0.4 + step, 1) - at(0.4 - step, 1)) / (2 * step)
    assert_allclose(slope, at(0.4, 2), rtol=1e-7)

    def moment(x):
        return float(rigidity(beam, beam.segments[0], np.array(x))) * at(x, 2)

    shear = (moment(0.4 + step) - moment(0.4 - step)) / (2 * step)
    expected = float(rigidity(beam, beam.segments[0], np.array(0.4))) * at(0.4, 3)
    assert_allclose(shear, expected, rtol=1e-7)


def test_gradient_of_a_peak_and_sweep():
    """With a mass that rolls over a hinge; accelerations are swept, too."""
    case = jb.Case(
        complete_beam(ends="clamped-pinned", hinges=[jb.Hinge(0.4, 2.0)]),
        sensors=[jb.Sensor(0.5)],
        loads=[jb.MovingMass(mass=0.4, speed=0.7)],
        run=jb.Run(1 / 0.7),
    )
    assert not native_peaks.supports(case)
    names = ["beam.axial_force", "beam.rotary_inertia", "beam.hinges.0.position"]
    start, layout, times = np.array([3.0, 0.003, 0.4]), mesh_layout(case), np.linspace(0, 1, 9)

    def deflections(relative):
        changed = replace(case, dict(zip(names, start * (1 + relative), strict=True)))
        return jnp.asarray(jb.simulate(changed, times=times).deflection)[-1]

    assert layout.parts
    found = jax.jacfwd(deflections)(jnp.zeros(3))
    assert_allclose(found, central(deflections, np.zeros(3), 1e-3), rtol=1e-5)
    case = dataclasses.replace(case, sensors=[*case.sensors, jb.Sensor(0.2, "acceleration")])
    swept = jb.sweep(case, {"beam.axial_force": [-3.0, 3.0], "beam.shear_stiffness": [90.0]})
    record = jb.simulate(case)
    single = np.maximum(record.largest, -record.smallest)
    for i, quantity in enumerate(("deflection", "acceleration")):
        peaks = swept[f"peak_{quantity}"].values[1, 0]
        assert_allclose(peaks[i], single[i], rtol=1e-6)


def test_patch_and_oscillator_on_a_hinged_timoshenko_beam():
    """A patch turns sections: its static effect is that of two couples, by reciprocity."""
    patch = jb.Patch(start=0.2, end=0.35, moment_per_volt=2.0)
    case = jb.Case(
        jb.Beam(**UNIT, modes=30, shear_stiffness=30.0, ends="clamped-pinned"),
        actuators=[patch],
        loads=[Oscillator(mass=0.3, stiffness=40.0, damping=0.1, speed=0.7)],
        run=jb.Run(1 / 0.7),
    )
    rotation = [float(jb.influence_line(case, x, 0.6, derivative=1)) for x in (0.2, 0.35)]
    found = static_deflection_per_command(case, 0.6)
    assert_allclose(found, [-2.0 * (rotation[0] - rotation[1])], rtol=1e-11)
    modal = jb.modes(case).fields(0.2, (1,))[0] - jb.modes(case).fields(0.35, (1,))[0]
    steady = 2.0 * np.sum(modal * jb.modes(case).shapes(0.6) / jb.modes(case).stiffness)
    assert_allclose(found[0], steady, atol=2e-3 * np.abs(rotation[0]))  # of 30 modes
    assert np.all(np.isfinite(jb.simulate(case).deflection))


# Runs on settled supports: closed forms, finite elements, equilibrium.

EI, SPAN, DROP = 6.0, 2.0, 0.02
UNLOADED = jb.Case(
    jb.Beam(2 * SPAN, EI, 1.0),
    supports=[jb.Support(SPAN, settlement=DROP)],
    sensors=[jb.Sensor(1.0), jb.Sensor(1.0, "moment")],
    run=jb.Run(0.01),
)


def test_locked_in_forces_of_two_spans():
    """M = 3 E I s / l^2 over the support, which is relieved by 6 E I s / l^3, the ends by half."""
    record = jb.simulate(UNLOADED)
    moment = 3 * EI * DROP / SPAN**2
    assert_allclose(record.bending_moment([1.0, 2.0])[0], [moment / 2, moment], rtol=1e-11)
    assert_allclose(record.at(2.0, "stress", section_modulus=0.5)[0], 2 * moment, rtol=1e-11)
    for side, sign in (("left", 1), ("right", -1)):
        assert_allclose(record.shear_force(2.0, side)[0], sign * moment / SPAN, rtol=1e-11)
    expected = np.array([1.0, -2.0, 1.0]) * moment / SPAN
    assert_allclose(record.reactions[0], expected, rtol=1e-11)
    assert_allclose(record.envelope("moment", np.array([2.0])).largest, moment, rtol=1e-11)
    assert not np.any(record.deflection) and not np.any(record.extremes.largest)
    assert not np.any(record.sensor_values)


def rolled_over(case: jb.Case, times, modes: int):
    """Deflection at 1 m, and contact force, of one mass that rolls over finite elements.

    It follows W = w_s + w. In static equilibrium w_s the foot of the spring pulls with -k s.
    """
    beam, (support,), (load,) = case.beam, case.supports, case.loads
    place, k = float(support.position), float(support.stiffness)
    model = fe.assemble(fe.Beam(4.0, EI, 1.0, beam.ends, [fe.Support(place, k)], elements=160))
    omega, shapes = model.modes(modes)
    settled, free = np.zeros(len(model.mass)), model.free
    pull = -k * float(support.settlement) * model.shape(place)
    settled[free] = np.linalg.solve(model.stiffness[np.ix_(free, free)], pull[free])
    mass, speed = float(load.mass), float(load.speed)

    def accelerations(t, q, rates):
        nodal = [model.shape(speed * t, n) for n in range(3)]
        rows = [row @ shapes for row in nodal]
        convective = 2 * speed * rows[1] @ rates
        convective += speed**2 * (rows[2] @ q + nodal[2] @ settled)
        inner = -(omega**2) * q
        force = mass * (rows[0] @ inner + convective + 9.81) / (1 + mass * rows[0] @ rows[0])
        return inner - rows[0] * force, force

    def rate(t, state):
        q, rates = np.split(state, 2)
        return np.concatenate([rates, accelerations(t, q, rates)[0]])

    state = np.zeros(2 * modes)
    found = solve_ivp(rate, (0, times[-1]), state, "DOP853", times, rtol=1e-8, atol=1e-11).y.T
    q, rates = np.split(found, 2, axis=1)
    forces = [accelerations(*parts)[1] for parts in zip(times, q, rates, strict=True)]
    return q @ (model.shape(1.0) @ shapes), np.array(forces)


def test_mass_on_a_settled_beam_against_finite_elements():
    """Its contact force has m v^2 w_s''."""
    case = jb.Case(
        jb.Beam(2 * SPAN, EI, 1.0, modes=6),
        supports=[jb.Support(SPAN, stiffness=30.0, settlement=0.15)],
        loads=[jb.MovingMass(mass=0.2, speed=3.0)],
        run=jb.Run(4 / 3.0),
    )
    times = np.linspace(0, 4 / 3.0, 41)[1:-1]
    record = jb.simulate(case, times=times)
    level = jb.simulate(replace(case, {"supports.0.settlement": 0.0}), times=times)
    deflection, force = rolled_over(case, times, 6)
    scale = np.abs(record.contact_force - level.contact_force).max()
    assert scale > 0.08 * 0.2 * 9.81
    assert_allclose(record.contact_force[:, 0], force, rtol=0, atol=1e-3 * scale)
    scale = np.abs(record.at(1.0) - level.at(1.0)).max()
    assert_allclose(record.at(1.0), deflection, rtol=0, atol=1e-3 * scale)


@pytest.mark.parametrize(
    "others",
    [{}, {"shear_stiffness": 90.0, "axial_force": -2.0, "foundation_stiffness": 3.0}],
)
def test_equilibrium_on_settled_supports(others):
    """Reactions, foundation and settled forces balance at once, about both ends, at rest."""
    case = jb.Case(
        jb.Beam(4.0, EI, 1.0, ends="clamped-free", **others),
        supports=[jb.Support(1.0, settlement=0.1), jb.Support(3.0, 50.0, settlement=-0.2)],
        run=jb.Run(0.01),
    )
    record = jb.simulate(case)
    reaction = float(np.sum(record.reactions[0]))
    if others:
        points, weights = np.polynomial.legendre.leggauss(12)
        for start, end in ((0.0, 1.0), (1.0, 3.0), (3.0, 4.0)):
            x = (start + end) / 2 + (end - start) / 2 * points
            w = jb.statics.settlement_response(case, [0.1, -0.2], x)
            reaction -= float(weights @ w) * 3.0 * (end - start) / 2
    assert_allclose(reaction, 0.0, atol=1e-10 * np.abs(record.reactions).max())


def test_vehicle_on_a_tilted_beam():
    """One span tilts without bending: a ramp of the surface. Equal settlements change nothing."""

    def force(left, right, profile=None):
        case = jb.Case(
            jb.Beam(4.0, EI, 1.0, ends="free-free"),
            [jb.Support(0.0, settlement=left), jb.Support(4.0, settlement=right)],
            loads=[Oscillator(0.3, 40.0, 0.5, speed=3.0, entry_time=0.1)],
            run=jb.Run(2.0, sample_rate=50.0),
            profile=profile,
        )
        record = jb.simulate(case)
        assert_allclose(record.reactions[0], 0.0, atol=1e-12)
        assert_allclose(record.body_displacement[0], -left, atol=1e-12)
        return np.asarray(record.contact_force)

    level, ramp = force(0.0, 0.0), RampProfile(0.0, 4.0, -0.1)
    assert_allclose(force(0.1, 0.1), level, rtol=0, atol=1e-10)
    found = force(0.0, 0.1)
    assert_allclose(found, force(0.0, 0.0, ramp), rtol=0, atol=1e-9)
    assert np.abs(found - level).max() > 0.2


def test_sweep_of_settlement():
    """Peaks are those of single runs; a settled beam does not use the compiled C integrator."""
    case = jb.Case(
        jb.Beam(2 * SPAN, EI, 1.0, modes=1),
        supports=[jb.Support(SPAN, settlement=0.1)],
        sensors=[jb.Sensor(1.0)],
        loads=[jb.MovingMass(mass=0.3, speed=3.0)],
    )
    found = jb.sweep(case, over={"supports.0.settlement": [0.0, 0.1]})
    single = [jb.simulate(replace(case, {"supports.0.settlement": s})) for s in (0.0, 0.1)]
    expected = np.array([record.peak_deflection for record in single])
    assert_allclose(found.peak_deflection, expected, rtol=1e-5)


def test_a_mechanism_cannot_settle():
    case = jb.Case(jb.Beam(4.0, EI, 1.0, ends="pinned-free"), [jb.Support(0.0, settlement=0.1)])
    with pytest.raises(ValueError, match="do not hold the beam in place"):
        jb.simulate(case)
