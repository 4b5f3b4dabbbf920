"""Frequencies of beams that are not uniform: references, closed forms, shooting, derivatives."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.beam import rayleigh_coefficients
from jaxbeam.case.case import replace, value_at
from jaxbeam.model.elements import find_layout
from jaxbeam.model.modes import mesh_layout, safe_sqrt
from jaxbeam.model.transfer_matrices import critical_axial_force
from tests.differences import central
from tests.modules import ROOT
from tests.oracles.closed_forms import ShootingBeam

REFERENCES = {
    case["case"]: case
    for case in json.loads((ROOT / "tests" / "data" / "beams.json").read_text())["cases"]
}
UNIT = {"length": 1.0, "flexural_rigidity": 1.0, "mass_per_length": 1.0}
ENDS = {
    "ss": "pinned-pinned",
    "clamped_free": "clamped-free",
    "clamped(thick)-free": "clamped-free",
}
STEPPED = [jb.Segment(0.5, 1.0, 1.0), jb.Segment(0.5, 0.4, 0.7)]
TAPERED = [jb.Segment(None, [1.0, -1.5, 0.75, -0.125], [1.0, -0.5])]
FIXED = [jb.Segment(None, 1.0, 1.0)]

# A beam of everything at once.
EVERYTHING = jb.Case(
    jb.Beam(
        length=10.0,
        modes=4,
        ends="clamped-pinned",
        shear_stiffness=3e3,
        rotary_inertia=0.3,
        foundation_stiffness=2.0,
        axial_force=-3.0,
        segments=[
            jb.Segment(4.0, [1e3, -300.0], [10.0, -2.0]),
            jb.Segment(None, [700.0, 100.0], 8.0, shear_stiffness=[2e3, 100.0]),
        ],
        hinges=[jb.Hinge(6.0, 200.0)],
    ),
    supports=[jb.Support(7.5, stiffness=300.0, mass=2.0)],
)
NUMBERS = [
    "beam.length", "beam.shear_stiffness", "beam.rotary_inertia", "beam.foundation_stiffness",
    "beam.axial_force", "beam.segments.0.length", "beam.segments.0.flexural_rigidity.1",
    "beam.segments.0.mass_per_length.1", "beam.segments.1.shear_stiffness.0",
    "beam.hinges.0.position", "beam.hinges.0.rotational_stiffness", "supports.0.mass",
]  # fmt: skip


def frequencies(supports=(), **beam) -> np.ndarray:
    return np.asarray(jb.modes(jb.Case(jb.Beam(**beam), supports)).angular_frequencies)


@pytest.mark.parametrize("ends", ["ss", "clamped-clamped", "clamped-free", "clamped-pinned"])
def test_timoshenko_reference(ends):
    reference = REFERENCES["6a-timoshenko-frequencies-hL0.1"]
    found = frequencies(
        **UNIT,
        modes=5,
        ends=ENDS.get(ends, ends),
        shear_stiffness=5 / 6 / 2.6 * 1200,
        rotary_inertia=0.01 / 12,
    )
    assert_allclose(np.sqrt(found), reference["outputs"]["lambda_"][ends], rtol=5e-10)


@pytest.mark.parametrize(
    ("name", "segments", "tolerance"),
    [
        ("6c-stepped-frequencies", STEPPED, 1e-9),
        ("6c-tapered-frequencies-0.5", TAPERED, 1e-8),
        ("6d-winkler", FIXED, 5e-9),
    ],
)
def test_reference(name, segments, tolerance):
    """To the nine digits that the references have."""
    foundation = 500.0 if name == "6d-winkler" else None
    for ends, expected in REFERENCES[name]["outputs"]["omega"].items():
        if ends == "rule":
            continue
        found = frequencies(
            length=1.0,
            modes=4,
            ends=ENDS.get(ends, ends),
            segments=segments,
            foundation_stiffness=foundation,
        )
        assert_allclose(found, expected, rtol=tolerance, err_msg=ends)


def test_taper_by_height():
    """Of a rectangular section, the depth alone gives stiffness and mass."""
    by_height = frequencies(
        length=1.0, modes=4, width=1.0, youngs_modulus=12.0, density=1.0,
        segments=[jb.Segment(height=[1.0, -0.5])],
    )  # fmt: skip
    assert_allclose(by_height, frequencies(length=1.0, modes=4, segments=TAPERED), rtol=1e-12)


@pytest.mark.parametrize(
    ("ends", "critical"),
    [
        ("pinned-pinned", np.pi**2),
        ("clamped-clamped", 4 * np.pi**2),
        ("clamped-free", np.pi**2 / 4),
        ("clamped-pinned", 4.493409457909064**2),  # tan k = k
    ],
)
def test_buckling(ends, critical):
    """Euler's loads are refused, and named; shy of them the first frequency is nearly zero."""
    assert frequencies(**UNIT, ends=ends, axial_force=-critical * (1 - 1e-9))[0] < 1e-2
    with pytest.raises(ValueError, match=rf"beam.axial_force is .* buckles at -{critical:.6g} N"):
        frequencies(**UNIT, ends=ends, axial_force=-critical * (1 + 1e-9))
    with pytest.raises(ValueError, match="any compression"):
        frequencies(**UNIT, ends="free-free", axial_force=-1.0)


def test_rotary_inertia_alone():
    """Rayleigh's beam on two pins: omega^2 (1 + r k^2) = k^4."""
    k = np.arange(1, 5) * np.pi
    found = frequencies(**UNIT, modes=4, rotary_inertia=0.01)
    assert_allclose(found, k**2 / np.sqrt(1 + 0.01 * k**2), rtol=1e-12)


def test_a_spring_in_a_hinge():
    """Of two cantilevers that meet: symmetric modes have no shear there, and M = -2 k w'."""
    spring, half = 3.0, 0.5
    hinge = jb.Hinge(0.5, rotational_stiffness=spring)
    found = frequencies(**UNIT, ends="clamped-clamped", modes=4, hinges=[hinge])
    b = np.sqrt(found[[0, 2]])
    # w = cosh bx - cos bx - a (sinh bx - sin bx) of half the beam
    a = (np.sinh(b * half) - np.sin(b * half)) / (np.cosh(b * half) + np.cos(b * half))
    curvature = np.cosh(b * half) + np.cos(b * half) - a * (np.sinh(b * half) + np.sin(b * half))
    slope = np.sinh(b * half) + np.sin(b * half) - a * (np.cosh(b * half) - np.cos(b * half))
    assert_allclose((b * curvature + 2 * spring * slope) / (b * np.cosh(b * half)), 0.0, atol=1e-9)
    assert_allclose(found[[1, 3]], np.array([3.926602312047919, 7.068582745628732]) ** 2 / half**2)


def test_bearing_mass():
    """A mass on a spring at the free end of a clamped beam: Rayleigh's equation of the tip."""
    spring, mass = 20.0, 0.7
    found = frequencies(
        [jb.Support(1.0, stiffness=spring, mass=mass)], **UNIT, ends="clamped-free", modes=4
    )
    k = np.sqrt(found)
    stiffness = (1 + np.cosh(k) * np.cos(k)) * k**3
    tip = np.cosh(k) * np.sin(k) - np.sinh(k) * np.cos(k)
    residual = (stiffness + (spring - mass * k**4) * tip) / (k**3 * np.cosh(k))
    assert_allclose(residual, 0, atol=1e-9)


def test_a_stiff_and_a_soft_half():
    """Eight modes, most in the soft half: roots of the exact transfer matrix of both."""
    halves = jb.Segment(0.5, 1.0, 1.0), jb.Segment(0.5, 1e-2, 1.0)
    found = frequencies(length=1.0, segments=halves, modes=8)

    def at_the_end(omega):
        transfer = np.eye(4)  # of deflection, slope, moment, shear force
        for rigidity in (1.0, 1e-2):
            rates = np.diag([1.0, 1 / rigidity, 1.0], 1)
            rates[3, 0] = omega**2
            transfer = scipy.linalg.expm(0.5 * rates) @ transfer
        return np.linalg.det(transfer[np.ix_([0, 2], [1, 3])])

    roots = [scipy.optimize.brentq(at_the_end, 0.99 * omega, 1.01 * omega) for omega in found]
    assert_allclose(found, roots, rtol=1e-6)  # of the determinant, which loses ten digits


@pytest.mark.parametrize("ends", ["clamped-pinned", "free-guided", "clamped-free"])
def test_shooting(ends):
    """Taper, shear, rotary inertia, foundation and tension at once, with a step."""
    segments = [
        jb.Segment(0.8, [3.0, -1.0], [2.0, -0.5], shear_stiffness=[90.0, -30.0]),
        jb.Segment(None, [1.5, 0.5, 0.5], 1.1, shear_stiffness=40.0, rotary_inertia=[0.01, 0.01]),
    ]
    found = frequencies(
        length=1.5,
        ends=ends,
        modes=4,
        segments=segments,
        shear_stiffness=1.0,
        rotary_inertia=0.02,
        foundation_stiffness=7.0,
        axial_force=2.0,
    )

    def piecewise(first, second):
        return lambda x: first(x / 0.8) if x < 0.8 else second((x - 0.8) / 0.7)

    beam = ShootingBeam(
        1.5,
        piecewise(lambda s: 3 - s, lambda s: 1.5 + 0.5 * s + 0.5 * s**2),
        piecewise(lambda s: 2 - 0.5 * s, lambda s: 1.1),
        piecewise(lambda s: 1 / (90 - 30 * s), lambda s: 1 / 40),
        piecewise(lambda s: 0.02, lambda s: 0.01 + 0.01 * s),
        foundation=7.0,
        axial=2.0,
        ends=ends,
        breaks=[0.8],
    )
    assert_allclose(found, [beam.frequency_near(omega) for omega in found], rtol=1e-9)


def test_steep_taper():
    """A depth that falls to a tenth, against shooting."""
    taper = [1.0, -2.7, 2.43, -0.729]  # (1 - 0.9 s)^3
    found = frequencies(
        length=1.0, modes=5, ends="clamped-free", segments=[jb.Segment(None, taper, [1.0, -0.9])]
    )
    beam = ShootingBeam(
        1.0, lambda x: (1 - 0.9 * x) ** 3, lambda x: 1 - 0.9 * x, ends="clamped-free"
    )
    assert_allclose(found, [beam.frequency_near(omega) for omega in found], rtol=1e-9)


def test_derivatives_of_frequencies_and_fields():
    layout, x = mesh_layout(EVERYTHING), 3.3
    scales = np.array([float(value_at(EVERYTHING, name)) for name in NUMBERS])

    def results(relative):
        case = replace(EVERYTHING, dict(zip(NUMBERS, scales * (1 + relative), strict=True)))
        modes = jb.modes(case, layout)
        fields = modes.fields(x + 0 * relative[0], (0, 1, 2, 3))
        return jnp.concatenate([modes.frequencies, fields.reshape(-1)])

    expected = central(results, np.zeros(len(NUMBERS)), 1e-3)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    found = jax.jit(jax.jacrev(results))(jnp.zeros(len(NUMBERS)))
    assert_allclose(found / scale, expected / scale, rtol=1e-6, atol=1e-8)


def test_derivatives_without_rotary_inertia():
    """Shear without rotary inertia has massless functions, whose derivatives stay finite."""
    case = jb.Case(jb.Beam(**UNIT, modes=3, shear_stiffness=50.0))
    layout = mesh_layout(case)

    def results(relative):
        return jb.modes(
            replace(case, {"beam.shear_stiffness": 50 * (1 + relative[0])}), layout
        ).frequencies

    found = jax.jit(jax.jacrev(results))(jnp.zeros(1))
    assert_allclose(found, central(results, np.zeros(1), 1e-2), rtol=1e-7)


def bad_beams():
    yield {**UNIT, "hinges": [jb.Hinge(0.0)]}, "hinges.0 is at an end"
    yield {**UNIT, "hinges": [jb.Hinge(0.5), jb.Hinge(0.5)]}, "hinges.1 is at the position"
    yield {**UNIT, "hinges": [jb.Hinge(1.5)]}, "hinges.0.position must lie on the beam"
    yield {**UNIT, "shear_stiffness": 0.0}, "shear_stiffness must be positive"
    yield {"length": 1.0, "segments": [jb.Segment(0.4, 1.0, 1.0)]}, "add up to 0.4 m"
    yield {"length": 1.0, "segments": [jb.Segment(None, 1.0)]}, "mass_per_length is missing"
    yield {"length": 1.0, "segments": [jb.Segment(None, [1.0, -1.0], 1.0)]}, "must be positive all"
    yield {"length": 1.0, "segments": [*FIXED, *FIXED]}, "segments.0.length is missing"
    yield (
        {"length": 1.0, "segments": [jb.Segment(1.0, 1.0, 1.0), *FIXED]},
        "leave nothing of beam.length",
    )
    yield (
        {"length": 1.0, "segments": [jb.Segment(0.5, 1.0, 1.0, shear_stiffness=9.0), *FIXED]},
        r"segments.1.shear_stiffness is missing",
    )


@pytest.mark.parametrize(("beam", "message"), list(bad_beams()))
def test_bad_beams(beam, message):
    with pytest.raises(ValueError, match=message):
        jb.simulate(jb.Case(jb.Beam(**beam)))


def test_bad_loads_and_bearings():
    mass = jb.MovingMass(mass=1.0, times=[0.0, 1.0, 2.0], positions=[0.0, 0.8, 0.2])
    with pytest.raises(ValueError, match="loads.0.positions turn round: a mass that is rigidly"):
        jb.simulate(jb.Case(jb.Beam(**UNIT, hinges=[jb.Hinge(0.5)]), loads=[mass]))
    with pytest.raises(ValueError, match="supports.0.mass would have no effect"):
        jb.simulate(jb.Case(jb.Beam(**UNIT), supports=[jb.Support(0.5, mass=1.0)]))


def test_both_branches_of_timoshenko():
    """Two pins: a omega^4 - (1 + k^2 (r + 1 / kGA)) omega^2 + k^4 = 0, and pure shear at k = 0."""
    shear, rotary = 384.615384615, 0.01 / 12
    k = np.arange(1, 30) * np.pi
    a, b = rotary / shear, 1 + k**2 * (rotary + 1 / shear)
    root = np.sqrt(b**2 - 4 * a * k**4)
    squares = np.concatenate([(b - root) / (2 * a), (b + root) / (2 * a), [shear / rotary]])
    found = frequencies(**UNIT, modes=24, shear_stiffness=shear, rotary_inertia=rotary)
    assert_allclose(found, np.sqrt(np.sort(squares))[:24], rtol=1e-10)


@pytest.mark.parametrize("shear", [5.0, 50.0])
def test_buckling_with_shear(shear):
    """Engesser's load: P_E / (1 + P_E / kGA)."""
    critical = np.pi**2 / (1 + np.pi**2 / shear)
    case = jb.Case(jb.Beam(**UNIT, shear_stiffness=shear, axial_force=-1.0))
    assert_allclose(critical_axial_force(case, find_layout(case)), -critical, rtol=1e-10)


# Damping by material, hysteretic and Rayleigh damping.

BRIDGE = {"flexural_rigidity": 1e10, "mass_per_length": 1e4, "modes": 4}


def ratios(supports=(), **beam):
    return jb.modes(jb.Case(jb.Beam(**BRIDGE, **beam), supports)).damping_ratios


@pytest.mark.parametrize(
    ("material", "span", "expected"),
    [
        ("steel", 30.0, 0.005),
        ("steel", 12.0, 0.005 + 0.00125 * 8),
        ("composite", 20.0, 0.005),
        ("prestressed-concrete", 10.0, 0.017),
        ("reinforced-concrete", 15.0, 0.0185),
        ("filler-beam", 40.0, 0.015),
    ],
)
def test_material(material, span, expected):
    """Table 6.6 of EN 1991-2, in per cent: 0.5 + 0.125 (20 - L), 1 or 1.5 + 0.07 (20 - L)."""
    assert_allclose(ratios(length=span, material=material), expected, rtol=1e-12)


def test_the_longest_span_counts():
    found = ratios(
        [jb.Support(18.0), jb.Support(6.0, stiffness=1e9)], length=22.0, material="steel"
    )
    assert_allclose(found, 0.005 + 0.00125 * 8, rtol=1e-12)


def test_loss_factor():
    assert_allclose(ratios(length=20.0, loss_factor=0.03), 0.015, rtol=1e-12)


def test_loss_factors_of_segments():
    """Of a uniform pinned beam the part up to a has the share a/L - sin(2 n pi a/L) / (2 n pi)."""
    n, share = np.arange(1, 5), 0.3
    energy = share - np.sin(2 * n * np.pi * share) / (2 * n * np.pi)
    segments = jb.Segment(6.0, loss_factor=0.1), jb.Segment(loss_factor=0.02)
    found = ratios(length=20.0, segments=segments)
    assert_allclose(found, (0.1 * energy + 0.02 * (1 - energy)) / 2, rtol=1e-9)
    found = ratios(length=20.0, segments=[segments[0], jb.Segment()], loss_factor=0.02)
    assert_allclose(found, (0.1 * energy + 0.02 * (1 - energy)) / 2, rtol=1e-9)
    found = ratios(length=20.0, segments=[jb.Segment(6.0), jb.Segment(loss_factor=0.02)])
    assert_allclose(found, 0.01 * (1 - energy), rtol=1e-9)


def test_loss_of_soft_shear_and_springs():
    """Equal loss in bending and shear is that of the whole; a spring without loss takes its share.

    A stiff beam on two equal springs moves as a rigid body: its strain energy is nearly none.
    """
    segments = [jb.Segment(6.0, loss_factor=0.04), jb.Segment(loss_factor=0.04)]
    found = ratios(length=20.0, segments=segments, shear_stiffness=1e8, rotary_inertia=3e3)
    assert_allclose(found, 0.02, rtol=1e-9)
    springs = [jb.Support(x, stiffness=1e4) for x in (0.0, 20.0)]
    found = ratios(springs, length=20.0, segments=segments, ends="free-free")
    assert found[0] < 1e-5 and found[1] < 1e-5 and 0.0199 < found[2] < 0.02


def test_rayleigh_coefficients():
    """The coefficients give the ratios at the first and the third frequency of a bridge."""
    first, _, third, _ = jb.modes(jb.Case(jb.Beam(20.0, **BRIDGE))).frequencies
    coefficients = rayleigh_coefficients([first, third], [0.01, 0.02])
    found = ratios(length=20.0, rayleigh_damping=np.asarray(coefficients))
    assert_allclose(found[[0, 2]], [0.01, 0.02], rtol=1e-10)
    with pytest.raises(ValueError, match="must differ"):
        rayleigh_coefficients([2.0, 2.0], [0.01, 0.02])


def test_bad_damping():
    for beam, message in (
        ({"material": "wood"}, "beam.material cannot be 'wood'"),
        ({"material": "steel", "damping_ratio": 0.01}, "both damping_ratio and material"),
        ({"loss_factor": 0.1, "rayleigh_damping": [0.1, 0.1]}, "both rayleigh_damping and loss"),
        (
            {"material": "steel", "segments": [jb.Segment(loss_factor=0.1)]},
            "both material and segments.0.loss_factor",
        ),
    ):
        with pytest.raises(ValueError, match=message):
            jb.simulate(jb.Case(jb.Beam(20.0, **BRIDGE, **beam)))


# Settlement of supports: closed forms, and equal settlements, which do not bend the beam.

TWO_SPANS = jb.Case(jb.Beam(4.0, 6.0, 1.0), [jb.Support(2.0)])


def test_middle_support():
    """Simply supported over both spans, lowered midway: w = -s, M = 3 E I s / l^2, w' = 0."""
    found = [jb.statics.settlement_response(TWO_SPANS, [0.1], 2.0, order) for order in range(3)]
    assert_allclose(found, [-0.1, 0.0, 3 * 0.1 / 4], atol=1e-12)
    x = 0.8  # of a cubic: w = -s (3 z - z^3) / 2, z = x / l
    assert_allclose(jb.statics.settlement_response(TWO_SPANS, [0.1], x), -0.1 * (1.2 - 0.4**3) / 2)
    third = -0.1 * -6 / 2 / 8
    assert_allclose(jb.statics.settlement_response(TWO_SPANS, [0.1], x, 3), third)


def test_elastic_support():
    """A spring k whose foot settles by s pulls with a stiffness in series with 48 E I / L^3."""
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0), [jb.Support(2.0, stiffness=5.0)])
    beam = 48 * 6.0 / 4.0**3
    expected = -0.1 * 5.0 / (5.0 + beam)
    assert_allclose(jb.statics.settlement_response(case, [0.1], 2.0), expected, rtol=1e-11)


def test_middle_support_of_a_beam_that_is_soft_in_shear():
    """It is pulled down with R = s / (L^3 / 48 E I + L / 4 kGA), so that M = R L / 4."""
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0, shear_stiffness=9.0), [jb.Support(2.0)])
    force = 0.1 / (4.0**3 / (48 * 6.0) + 4.0 / (4 * 9.0))
    assert_allclose(6.0 * jb.statics.settlement_response(case, [0.1], 2.0, 2), force, rtol=1e-11)
    x = np.array([1.0, 3.0])
    assert_allclose(
        6.0 * jb.statics.settlement_response(case, [0.1], x, 3), [force / 2, -force / 2]
    )


def test_a_clamped_end_settles_with_a_support_on_it():
    """M = 6 E I s / L^2 at both ends, V = 12 E I s / L^3, and -s/2 midway."""
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0, ends="clamped-clamped"), [jb.Support(4.0)])
    moment = 6 * 6.0 * 0.1 / 4.0**2
    x = np.array([0.0, 4.0])
    assert_allclose(
        6.0 * jb.statics.settlement_response(case, [0.1], x, 2), [-moment, moment], rtol=1e-11
    )
    assert_allclose(6.0 * jb.statics.settlement_response(case, [0.1], 1.0, 3), 2 * moment / 4.0)
    assert_allclose(jb.statics.settlement_response(case, [0.1], 2.0), -0.05, rtol=1e-11)


@pytest.mark.parametrize("beam", [{}, {"shear_stiffness": 9.0, "axial_force": 4.0}])
def test_rigid_motion(beam):
    """Supports that settle by the same amount do not bend the beam."""
    supports = [jb.Support(0.0), jb.Support(1.5), jb.Support(4.0, stiffness=1e3)]
    case = jb.Case(jb.Beam(4.0, 6.0, 1.0, ends="free-free", **beam), supports)
    x = np.linspace(0.1, 3.9, 7)
    found = jb.statics.settlement_response(case, [0.2, 0.2, 0.2], x)
    assert_allclose(found, -0.2, rtol=1e-10)


def test_bad_settlements():
    with pytest.raises(ValueError, match="one for each of the 1 supports"):
        jb.statics.settlement_response(TWO_SPANS, [0.1, 0.2], 1.0)


def test_a_rigid_mode_has_derivatives():
    """The square root of a frequency of zero had none."""
    slopes = jax.vmap(jax.grad(safe_sqrt))(jnp.array([-1e-9, 0.0, 4.0]))
    assert_allclose(slopes, [0.0, 0.0, 0.25], rtol=1e-15)
