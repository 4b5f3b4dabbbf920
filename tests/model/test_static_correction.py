"""Modes plus residuals against the exact static response; section forces.

Timoshenko beam under a moving force, against its series with both spectra.
"""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.sections import corrected_deflection
from jaxbeam.model.deflection_lines import (
    LoadInfluence,
    influence_line,
    static_deflection_per_command,
)
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.output_rows import sensor_rows, static_correction
from jaxbeam.model.static_correction import (
    Motion,
    bending_moment,
    corrected_history,
    is_supported,
    residual_flexibility,
    residual_port_flexibility,
    shear_force,
)
from tests.differences import central
from tests.loop_as_oracle import as_oracle
from tests.oracles import finite_elements

PLAIN = jb.Case(jb.Beam(0.6, 13.211, 0.812), actuators=[jb.Patch(0.2, 0.35, 1e-3)])
GENERAL = jb.Case(
    jb.Beam(1.3, 2.0, 0.7, ends="clamped-free", modes=4),
    supports=[jb.Support(0.3, 500.0, 0.4, 3.0), jb.Support(0.91)],
    actuators=[
        jb.Patch(0.2, 0.45, 1e-3, 0.5, 200.0, added_mass=0.4, added_rigidity=1.0),
        jb.Shaker(0.7, 300.0, force_per_volt=2.0),
        jb.Patch(0.4, 0.7, 2e-3),
        jb.Electrodynamic(0.55, 0.8, 5e-5, 4.2, mass=0.02, stiffness=900.0, damping=0.5),
        jb.PointForce(1.2),
        jb.SpringDamper(0.11, 800.0),
    ],
)
STEADY = np.array([1e-3 * 0.5 * 200.0, 2.0, 2e-3, 4.2 / 0.8, 1.0, 0.0])
X = np.array([0.0, 0.05, 0.25, 0.33, 0.42, 0.6, 1.0, 1.3])


def oracle_deflections(case: jb.Case, x, derivative: int = 0) -> np.ndarray:
    """Deflections per unit command (actuator, position) by finite elements."""
    beam, deflections = as_oracle(case, elements=1), []
    for actuator, steady in zip(case.actuators, STEADY, strict=True):
        if isinstance(actuator, jb.Patch):
            moments = [(float(actuator.start), float(actuator.end), steady)]
            found = finite_elements.static_deflection(beam, x, patch_moments=moments)
        else:
            force = float(actuator.position), steady
            found = finite_elements.static_deflection(beam, x, [force])
        deflections.append(found)
    return np.array(deflections)


# Exact static deflection per command


def test_slope_curvature_and_third_derivative_of_a_pinned_beam():
    x = np.array([0.1, 0.2, 0.3, 0.35, 0.5])
    over = np.array([0, 1, 1, 0, 0])  # at the ends of the patch, the section to the right
    assert_allclose(
        static_deflection_per_command(PLAIN, x, 2)[0], -1e-3 / 13.211 * over, rtol=1e-12, atol=1e-18
    )
    assert_allclose(static_deflection_per_command(PLAIN, x, 3)[0], 0.0, atol=1e-15)
    slopes = central(lambda y: static_deflection_per_command(PLAIN, y[0])[0], [0.3], 1e-3)
    assert_allclose(static_deflection_per_command(PLAIN, 0.3, 1)[0], slopes[0], rtol=1e-9)


def test_all_actuators_agree_with_finite_elements():
    expected = oracle_deflections(GENERAL, X)
    found = static_deflection_per_command(GENERAL, X)
    assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())
    assert_allclose(found[-1], 0.0, atol=0)


@pytest.mark.parametrize("ends", ["clamped-clamped", "guided-pinned", "free-clamped"])
@pytest.mark.parametrize("supports", [[], [jb.Support(0.4)], [jb.Support(0.5, 2e4, 0.0, 30.0)]])
def test_patch_with_other_ends_and_supports(ends, supports):
    patch = jb.Patch(0.25, 0.55, 1.0, added_mass=0.2, added_rigidity=4.0)
    case = jb.Case(jb.Beam(1.0, 12.0, 0.8, ends=ends), supports, [patch])
    x, beam = np.linspace(0, 1, 9), as_oracle(case, elements=1)
    expected = finite_elements.static_deflection(beam, x, patch_moments=[(0.25, 0.55, 1.0)])
    found = static_deflection_per_command(case, x)[0]
    assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


# Modes plus residual


@pytest.fixture(scope="module")
def model():
    return eqx.filter_jit(modal_model)(GENERAL, mesh_layout(GENERAL))


@pytest.mark.parametrize("derivative", [0, 3])  # section forces, below, use the second
def test_modes_plus_residual_are_exact(model, derivative):
    """The modal part is the equilibrium of the state equations of the model."""
    y = np.array([0.07, 0.5])
    matrix, modes = np.asarray(model.state_matrix[0]), GENERAL.beam.modes
    shapes = np.asarray(model.shapes(X, (derivative,))[0])
    states = -np.linalg.solve(matrix, np.asarray(model.command_matrix))
    modal = (shapes @ states[: 2 * modes : 2]).T
    exact = np.asarray(static_deflection_per_command(GENERAL, X, derivative))
    gains = np.array([one.attachment().static_gain for one in GENERAL.actuators])[:, None]
    found = modal + gains * residual_port_flexibility(GENERAL, X, derivative)
    assert_allclose(found, exact, rtol=0, atol=1e-10 * np.abs(modal).max())
    load_input = np.zeros((len(matrix), y.size))
    load_input[1 : 2 * modes : 2] = -np.asarray(model.shapes(y, (0,))[0]).T
    modal = (shapes @ -np.linalg.solve(matrix, load_input)[: 2 * modes : 2]).T
    exact = influence_line(GENERAL, X, y, derivative)
    found = modal + residual_flexibility(GENERAL, X, y, derivative)
    assert_allclose(found, exact, rtol=0, atol=1e-10 * np.abs(modal).max())


# Section forces


def test_patch_causes_no_moment_in_a_determinate_beam():
    """The active moment balances the bending of the stiffened section."""
    patch = dataclasses.replace(PLAIN.actuators[0], added_rigidity=5.0, added_mass=0.1)
    for ends in ("pinned-pinned", "clamped-free"):
        beam = dataclasses.replace(PLAIN.beam, ends=ends)
        case, x = jb.Case(beam, actuators=[patch]), np.linspace(0.0, 0.6, 13)
        curvature, third = (
            static_deflection_per_command(case, x, 2)[0],
            static_deflection_per_command(case, x, 3)[0],
        )
        assert_allclose(bending_moment(case, x, curvature, [1.0]), 0.0, atol=1e-14)
        assert_allclose(shear_force(case, x, third), 0.0, atol=1e-12)


def test_moment_of_a_patch_on_a_clamped_beam():
    """M = p + q x, with zero deflection and slope at both ends."""
    patch, x = PLAIN.actuators[0], np.linspace(0.0, 0.6, 13)
    case = jb.Case(dataclasses.replace(PLAIN.beam, ends="clamped-clamped"), actuators=[patch])
    length, a, b, active = 0.6, 0.2, 0.35, 1e-3
    # The integrals over the beam of w'', with E I w'' = M - active moment, and of x w'' are zero.
    system = np.array([[length, length**2 / 2], [length**2 / 2, length**3 / 3]])
    p, q = np.linalg.solve(system, active * np.array([b - a, (b**2 - a**2) / 2]))
    found = bending_moment(case, x, static_deflection_per_command(case, x, 2)[0], [1.0])
    assert_allclose(found, p + q * x, rtol=1e-11)
    assert_allclose(
        shear_force(case, x, static_deflection_per_command(case, x, 3)[0]), q, rtol=1e-10
    )


def test_wheels_on_the_ground_do_not_bend_the_beam():
    """A vehicle before the free end of a beam presses on the road."""
    case = jb.Case(
        jb.Beam(10.0, 1e8, 1e3, 0.02, ends="free-clamped", modes=3),
        loads=[jb.Oscillator(100.0, 1e5, 1e3, speed=10.0, start_position=-5.0)],
        run=jb.Run(0.4, 50.0),
    )
    record, x = jb.simulate(case), np.array([0.0, 3.0])
    assert_allclose(record.contact_force, 100.0 * 9.81)
    assert_allclose(corrected_deflection(record, x), 0.0, atol=1e-15)

    def traced(force):
        motion = record.motion._replace(contact_force=force)
        return corrected_history(case, record.modes, motion, x)

    assert_allclose(jax.jit(traced)(record.contact_force), 0.0, atol=1e-15)


@pytest.mark.parametrize("quantity", ["moment", "shear", "curvature"])
@pytest.mark.parametrize("part", ["support", "spring", "mass"])
def test_dampers_and_masses_in_corrected_rows_by_a_long_series(part, quantity):
    """What a damper or a mass at a presses on the modes left out, by the series of a pinned beam.

    -c w'(a) and -m w''(a) times row_i(x) phi_i(a) / k_i, summed over 200 000 modes, in rows and in
    histories; the springs are so weak that the modes are those of the beam.
    """
    length, stiffness, mass, modes = 1.3, 2.0, 0.7, 3
    at, x, size, derivative = 0.52, 0.33, 0.8, 3 if quantity == "shear" else 2
    sensor = jb.Sensor(x, quantity)
    devices = {
        "spring": jb.SpringDamper(at, damping=size),
        "mass": jb.Electrodynamic(at, 1.0, 1e-3, 1e-9, mass=size),
    }
    case = jb.Case(
        jb.Beam(length, stiffness, mass, modes=modes),
        supports=[jb.Support(at, stiffness=1e-9, damping=size)] if part == "support" else [],
        actuators=[devices[part]] if part in devices else [],
        sensors=[sensor],
        loads=[jb.MovingForce(force=1.0, speed=1.0)],
        run=jb.Run(1.0),
    )
    model = modal_model(case, mesh_layout(case), True)
    outputs = sensor_rows(model, case, (sensor,))
    correction = static_correction(model, case, (sensor,), outputs)
    rates, accelerations = correction.rows.rates, correction.rows.accelerations
    found, other = (accelerations, rates) if part == "mass" else (rates, accelerations)
    assert other is None or np.abs(other).max() < 1e-15
    influence = correction.influence.of_forces_at(np.array(at), np.array(at))[0]
    order = np.arange(1, 200_001) * np.pi / length

    def shapes(place):
        return np.sqrt(2 / (mass * length)) * np.sin(order * place)

    waves = order**3 * np.cos(order * x) if derivative == 3 else order**2 * np.sin(order * x)
    terms = -np.sqrt(2 / (mass * length)) * waves * shapes(at) / (stiffness / mass * order**4)
    residual = np.sum(terms[modes:])  # of the derivative of w, in 1/(N m) or 1/(N m^2)
    factor = 1.0 if quantity == "curvature" else stiffness
    scale = np.abs(factor * residual * size)
    assert scale > 1e-3
    # The third derivative converges with the square of the number of modes.
    # That of a load there, per newton upwards, is the same series.
    assert_allclose(influence, factor * residual, rtol=1e-4)
    at_place = np.asarray(model.shapes(np.array(at), (0,))[0])
    assert_allclose(found[0], -factor * residual * size * at_place, rtol=0, atol=1e-4 * scale)

    none = np.zeros((2, modes))
    pushed = np.array([[1.0, 2.0, -3.0], [0.3, 0.0, 0.4]])
    moving = (none, none, pushed) if part == "mass" else (none, pushed, none)
    no_load, no_command = np.full((2, 1), np.nan), np.zeros((2, len(case.actuators)))
    motion = Motion(*moving, no_load, np.zeros((2, 1)), no_command)
    speed = pushed @ np.asarray(model.modes.shapes(np.array(at)))
    history = corrected_history(case, model.modes, motion, x, derivative)
    tolerance = 1e-4 * np.abs(residual * size * speed).max()
    assert_allclose(history, -residual * size * speed, rtol=0, atol=tolerance)


@pytest.mark.parametrize(("near", "expected"), [(0.0, 1.0), (0.5 - 1e-9, 1.0), (1.0, 2.0)])
def test_the_side_of_a_break_beside_another(near, expected):
    """Constants 1, 2 and 3 between breaks 5e-9 of the length apart: the piece next to the first."""
    breaks, values = np.array([0.0, 0.5, 0.5 + 5e-9, 1.0]), np.array([1.0, 2.0, 3.0])
    influence = LoadInfluence(breaks, values[:, None, None])
    assert_allclose(influence.of_forces_at(np.array(0.5), np.array(near)), [expected])


@pytest.mark.parametrize("quantity", ["moment", "shear", "strain", "stress"])
def test_a_patch_at_the_right_end_is_that_at_the_left_one_mirrored(quantity):
    """At both ends and at its inner end; the section there is that with the patch."""

    def peaks(mirror: bool):
        def place(x):
            return 1.0 - x if mirror else x

        start, end = sorted((place(0.7), place(1.0)))
        sizes = {"fibre_distance": 0.01} if quantity == "strain" else {}
        sizes |= {"section_modulus": 1e-6} if quantity == "stress" else {}
        case = jb.Case(
            jb.Beam(1.0, 12.0, 0.8, ends="clamped-clamped", damping_ratio=0.01, modes=6),
            actuators=[jb.Patch(start, end, 1.0, added_mass=0.2, added_rigidity=4.0)],
            sensors=[jb.Sensor(place(x), quantity, **sizes) for x in (1.0, 0.85, 0.5, 0.0)],
            loads=[jb.MovingForce(force=5.0, speed=-2.0 if mirror else 2.0)],
            run=jb.Run(0.6),
        )
        record = jb.simulate(case)
        return np.maximum(np.abs(record.smallest), np.abs(record.largest))

    np.testing.assert_allclose(peaks(True), peaks(False), rtol=1e-6)


LENGTH, RIGIDITY, MASS, FORCE, SPEED = 20.0, 6e9, 1e4, 2e5, 30.0
PLACES, TIMES = np.array([0.5, 4.0, 7.3, 10.0]), np.linspace(0.0, LENGTH / SPEED, 41)


def series(shear_stiffness: float, rotary_inertia: float, terms: int = 6000) -> list[np.ndarray]:
    """Deflection, rotation, curvature and V / E I (time, position), V = -G (w' - phi).

    For each sin(k x) two modes of m, r with the stiffness

    [[G k^2, -G k], [-G k, E I k^2 + G]] of (w, phi) = (W sin k x, P cos k x), G being k G A.
    """
    k = np.arange(1, terms + 1) * np.pi / LENGTH
    stiffness = np.zeros((terms, 2, 2))
    stiffness[:, 0, 0], stiffness[:, 1, 1] = shear_stiffness * k**2, RIGIDITY * k**2
    stiffness[:, 1, 1] += shear_stiffness
    stiffness[:, 0, 1] = stiffness[:, 1, 0] = -shear_stiffness * k
    scale = np.diag([MASS**-0.5, rotary_inertia**-0.5])
    squares, shapes = np.linalg.eigh(scale @ stiffness @ scale)
    drive, w, phi = SPEED * k, 0.0, 0.0
    for spectrum in (0, 1):
        own = np.sqrt(squares[:, spectrum])
        shape = shapes[:, :, spectrum] * [MASS**-0.5, rotary_inertia**-0.5]
        modal = -2 * FORCE / LENGTH * shape[:, 0] / (own**2 - drive**2)
        angles = TIMES[:, None] * drive, TIMES[:, None] * own
        motion = modal * (np.sin(angles[0]) - drive / own * np.sin(angles[1]))
        w, phi = w + shape[:, 0] * motion, phi + shape[:, 1] * motion
    sines, cosines = np.sin(k[:, None] * PLACES), np.cos(k[:, None] * PLACES)
    shear = shear_stiffness * (phi - k * w) @ cosines
    return [w @ sines, phi @ cosines, -(k * phi) @ sines, shear / RIGIDITY]


@pytest.mark.parametrize(
    "shear_stiffness, rotary_inertia", [(5e8, 1e4), (5e9, 1e2), (1e12, 1e4)], ids=str
)
def test_correction_is_nearer_than_the_modes(shear_stiffness, rotary_inertia):
    """Of all fields; of the deflection by four times at every position with 20 modes or more.

    Shear forces jump at the force, so that they are compared a metre away from it.
    """
    fields, errors = series(shear_stiffness, rotary_inertia), {}
    away = np.abs(SPEED * TIMES[:, None] - PLACES) > 1.0
    for modes in (5, 10, 20, 40):
        properties = {"shear_stiffness": shear_stiffness, "rotary_inertia": rotary_inertia}
        beam = jb.Beam(LENGTH, RIGIDITY, MASS, modes=modes, **properties)
        loads = [jb.MovingForce(force=FORCE, speed=SPEED)]
        record = jb.simulate(jb.Case(beam, loads=loads, run=jb.Run(LENGTH / SPEED)), TIMES)
        for order, exact in enumerate(fields):
            raw = (
                np.asarray(record.coordinates)
                @ np.asarray(record.modes.fields(PLACES, (order,))[0]).T
            )
            found = raw, np.asarray(jb.sections.corrected_deflection(record, PLACES, order))
            errors[modes, order] = [
                np.max(np.abs(one - exact) * (away if order == 3 else 1.0), axis=0)
                / np.abs(exact).max()
                for one in found
            ]
            of_modes, corrected = errors[modes, order]
            assert np.max(corrected) < np.max(of_modes), (modes, order)
    for modes in (20, 40):
        of_modes, corrected = errors[modes, 0]
        assert np.all(4 * corrected < of_modes)
    assert np.max(errors[40, 0][1]) < 0.7 * np.max(errors[20, 0][1])


@pytest.mark.parametrize(
    ("ends", "hinges", "supports", "held"),
    [
        ("pinned-pinned", [], [], True),
        ("clamped-free", [], [], True),
        ("pinned-free", [], [jb.Support(0.7)], True),
        ("pinned-free", [], [jb.Support(0.7, stiffness=1e3)], True),
        ("clamped-pinned", [jb.Hinge(0.4)], [], True),
        ("pinned-free", [], [], False),
        ("free-free", [], [jb.Support(0.7)], False),
        ("guided-free", [], [], False),
        ("pinned-pinned", [jb.Hinge(0.4)], [], False),
    ],
)
def test_a_traced_beam_is_held_by_the_kinds_of_its_supports(ends, hinges, supports, held):
    """As counted by hand: two deflections, or one and a slope, and one more for each hinge."""
    case = jb.Case(jb.Beam(1.0, 2.0, 0.5, ends=ends, hinges=hinges), supports)
    found, layout = [], mesh_layout(case)

    @jax.jit
    def traced(rigidity):
        found.append(is_supported(jb.replace(case, {"beam.flexural_rigidity": rigidity}), layout))
        return rigidity

    traced(2.0)
    assert [*found, is_supported(case, layout)] == [held, held]
