"""Natural frequencies by characteristic equations, the Wittrick-Williams count, finite elements.

Accuracy reached (relative): 1e-14 for the first dozen modes, 1e-13 for 50.
"""

import equinox as eqx
import hypothesis
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, strategies as st
from numpy.polynomial import legendre
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.actuators.base import Patch
from jaxbeam.case.beam import END_CONDITIONS, Beam, Support
from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.model.modes import Modes, mesh_layout, modes
from tests.differences import central
from tests.loop_as_oracle import as_oracle
from tests.oracles.closed_forms import (
    exact_frequencies,
    single_span_parameters,
    two_span_parameters,
)
from tests.oracles.finite_elements import assemble

# Beams whose modes are tested, and their modes by one compiled program.

PROPERTIES = {"flexural_rigidity": 11.68, "mass_per_length": 0.535}
PAIRS = [f"{left}-{right}" for left in END_CONDITIONS for right in END_CONDITIONS]
PATCHED = Case(
    Beam(1.3, 2.0, 0.7, ends="guided-free", modes=8),
    [Support(0.3, 500.0, 0.4, 3.0), Support(0.91), Support(1.25, 20.0)],
    [
        Patch(0.2, 0.45, 1e-3, added_mass=0.4, added_rigidity=1.0),
        Patch(0.4, 0.7, 1e-3, added_mass=0.1, added_rigidity=0.5),
    ],
)


@eqx.filter_jit
def _modes(case, layout):
    return modes(case, layout)


def solve(case: Case) -> Modes:
    """Modes of a case by one compiled program, faster than operation by operation."""
    return _modes(case, mesh_layout(case))


def parameters(case: Case, span: float) -> np.ndarray:
    """k times a length, of each mode of a beam of 11.68 N m^2 and 0.535 kg/m."""
    return (0.535 / 11.68 * np.asarray(solve(case).stiffness)) ** 0.25 * span


def supported_beam(stiffness, rotational_stiffness=0.0) -> Case:
    """Pinned beam on one support with a spring (N/m) and a rotational spring (N m/rad)."""
    return Case(
        Beam(1.2, **PROPERTIES, modes=12), [Support(0.5, stiffness, 0.0, rotational_stiffness)]
    )


def assert_frequencies(case: Case, rtol: float = 1e-12) -> None:
    """Assert the frequencies of the Wittrick-Williams count, rigid-body modes included."""
    expected = exact_frequencies(as_oracle(case), case.beam.modes)
    assert_allclose(solve(case).angular_frequencies, expected, rtol=rtol)


@pytest.mark.parametrize("ends", PAIRS)
def test_single_spans_obey_their_characteristic_equations(ends):
    found = parameters(Case(Beam(0.6, **PROPERTIES, ends=ends, modes=12)), 0.6)
    assert_allclose(found, single_span_parameters(ends, 12), rtol=1e-13)


@pytest.mark.parametrize("ratio", [0.5, 0.3714, 0.0593, 0.8007])
def test_two_spans_obey_the_three_moment_condition(ratio):
    found = parameters(Case(Beam(1.2, **PROPERTIES, modes=12), [Support(1.2 * ratio)]), 1.2)
    assert_allclose(found, two_span_parameters(ratio, 12), rtol=1e-12)


TABLE = [  # k times the length of a span; source: independent reference tables
    (1, "clamped-free", [1.8751041, 4.6940911, 7.8547574, 10.9955407, 14.1371684]),
    (1, "free-free", [0.0, 0.0, 4.7300407, 7.8532046, 10.9956078, 14.1371655, 17.2787597]),
    (2, "pinned-pinned", [3.141593, 3.926602, 6.283185, 7.068583]),
    (3, "pinned-pinned", [3.141593, 3.556408, 4.297530, 6.283185, 6.707596, 7.429541]),
    (4, "pinned-pinned", [3.141593, 3.393231, 3.926602, 4.463324, 6.283185]),
    (5, "pinned-pinned", [3.141593, 3.309052, 3.700360, 4.152944, 4.550434]),
    (6, "pinned-pinned", [3.141593, 3.260535, 3.556408, 3.926602, 4.297530, 4.601418]),
    (2, "clamped-clamped", [3.926602, 4.730041]),
    (3, "clamped-pinned", [3.260535, 3.926602, 4.601418]),
]


@pytest.mark.parametrize(("spans", "ends", "expected"), TABLE)
def test_equal_spans_have_the_printed_parameters(spans, ends, expected):
    supports = [Support(0.6 * i) for i in range(1, spans)]
    case = Case(Beam(0.6 * spans, **PROPERTIES, ends=ends, modes=len(expected)), supports)
    assert_allclose(parameters(case, 0.6), expected, rtol=0, atol=6e-7)


def test_an_elastic_support_ranges_from_none_to_a_rigid_one():
    for stiffness in (0.0, 1.0, 1e3, 1e5, 1e8, 1e12, 1e16):
        assert_frequencies(supported_beam(stiffness))


def test_rotational_springs_range_from_none_to_a_clamp():
    def with_rotational_spring(stiffness):
        supports = [Support(0.0, rotational_stiffness=stiffness)]
        return Case(Beam(1.2, **PROPERTIES, modes=12), supports)

    for stiffness in (0.0, 1e3, 1e16):
        assert_frequencies(with_rotational_spring(stiffness))
        assert_frequencies(supported_beam(None, stiffness))


def test_bonded_patches_have_the_frequencies_and_shapes_of_finite_elements():
    assert_frequencies(PATCHED)
    model = assemble(as_oracle(PATCHED, 300))
    omega, vectors = model.modes(8)
    found = solve(PATCHED)
    assert_allclose(found.angular_frequencies, omega, rtol=1e-6)
    x = np.linspace(0.0, 1.3, 40)
    expected = np.array([model.shape(position) @ vectors for position in x])
    expected *= np.sign(expected[0])
    assert_allclose(found.shapes(x), expected, rtol=0, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("supports", "actuators"),
    [
        ([Support(0.0), Support(1.2, 3e3)], []),  # at the ends, one of them pinned already
        ([Support(0.3, 1e4)], [Patch(0.3, 0.5, 1.0, added_mass=0.3, added_rigidity=9.0)]),
        ([], [Patch(0.0, 1.2, 1.0, added_mass=0.3)]),  # all along
        ([Support(0.6), Support(0.6 + 1e-6)], []),  # nearly a clamp
        ([Support(0.6, 1e5), Support(0.612, 1e5)], []),
        ([Support(0.4), Support(0.4, 50.0, 0.0, 7.0)], []),  # two things at one position
    ],
    ids=["ends", "edge", "all along", "close", "close springs", "same position"],
)
def test_degenerate_layouts(supports, actuators):
    assert_frequencies(Case(Beam(1.2, **PROPERTIES, modes=6), supports, actuators))


@st.composite
def random_beams(draw) -> Case:
    """One interior support of any kind and perhaps a patch, at whole percents of the length."""
    at, start = draw(st.integers(5, 95)), draw(st.integers(0, 45))
    spring = draw(st.none() | st.floats(-3, 12).map(lambda e: 10.0**e))
    support = Support(0.013 * at, spring, 0.0, draw(st.sampled_from([0.0, 3.0, 1e9])))
    patch = Patch(0.013 * start, 0.65, 1.0, added_mass=0.3, added_rigidity=draw(st.floats(0, 50)))
    patches = draw(st.sampled_from([[], [patch]]))
    return Case(
        Beam(1.3, **PROPERTIES, ends=draw(st.sampled_from(PAIRS)), modes=5), [support], patches
    )


@given(random_beams())
@hypothesis.settings(max_examples=6)
def test_random_beams_have_exact_frequencies(case):
    # The oracle returns zero for frequencies below a thousandth of the unit.
    expected = exact_frequencies(as_oracle(case), 5)
    unit = np.sqrt(float(solve(case).stiffness_unit))
    assert_allclose(solve(case).angular_frequencies, expected, rtol=1e-9, atol=1e-3 * unit)


@pytest.mark.parametrize("solved", [jb.modes, jb.state_space])
def test_an_invalid_case_is_refused(solved):
    weak = jb.Beam(1.0, -11.0, 0.5)
    with pytest.raises(ValueError, match=r"beam.flexural_rigidity must be positive"):
        solved(Case(weak))
    beam = jb.Beam(1.0, 11.0, 0.5)
    with pytest.raises(ValueError, match=r"sensors.0.position .*2"):
        solved(Case(beam, sensors=[jb.Sensor(2.0)]))


def test_modes_of_a_case_that_only_its_controller_could_refuse():
    """A filter that is above half the sampling rate of the controller is none of the plant's."""
    beam, filter_ = jb.Beam(1.0, 11.0, 0.5), jb.Filter(100.0)
    case = Case(beam, sensors=[jb.Sensor(0.5, filter=filter_)], run=jb.Run(1.0, 50.0))
    with pytest.raises(ValueError, match=r"sensors\.0\.filter"):
        jb.simulate(case)
    assert jb.modes(case).frequencies.size == 3 and jb.state_space(case).at(0.0).A.shape == (6, 6)


# Mode shapes: sines, orthonormal, smooth across supports and patches, bounded at high numbers.


@pytest.mark.parametrize("derivative", [0, 1, 2, 3])
def test_shapes_of_pinned_beams_are_sines(derivative):
    x, n = np.linspace(0.0, 0.6, 41), np.arange(1, 7)
    wave = n * np.pi / 0.6
    found = solve(Case(Beam(0.6, **PROPERTIES, modes=6))).shapes(x, derivative)
    expected = np.sqrt(2 / (0.535 * 0.6)) * np.imag(
        np.exp(1j * np.outer(x, wave)) * (1j * wave) ** derivative
    )
    assert_allclose(found, expected, rtol=0, atol=1e-10 * np.abs(expected).max())


def products(case: Case) -> np.ndarray:
    """Mass matrix of the modes, by Gauss quadrature over each segment."""
    found, beam = solve(case), as_oracle(case)
    t, weights = legendre.leggauss(40)
    mass_matrix = 0.0
    for left, right in zip(found.nodes[:-1], found.nodes[1:], strict=True):
        x = (left + right) / 2 + (right - left) / 2 * t
        over = [p.mass_per_length for p in beam.patches if p.start < float(x[20]) < p.end]
        density = beam.mass_per_length + sum(over)
        shape = np.asarray(found.shapes(x))
        mass_matrix = mass_matrix + density * (right - left) / 2 * shape.T @ (
            weights[:, None] * shape
        )
    return np.asarray(mass_matrix)


@pytest.mark.parametrize(
    "case",
    [
        PATCHED,
        supported_beam(1e4),
        supported_beam(None),
        Case(Beam(0.6, **PROPERTIES, ends="free-free", modes=6)),
    ],
    ids=["patched", "spring", "two spans", "free"],
)
def test_shapes_are_orthonormal_and_continuous(case):
    found = solve(case)
    assert_allclose(products(case), np.eye(case.beam.modes), atol=1e-11)
    for node in found.nodes[1:-1]:
        before, after = (found.shape_derivatives(node + d, (0, 1)) for d in (-1e-9, 1e-9))
        # A shape changes by its slope times 2e-9 m, far below the tolerance.
        assert_allclose(before, after, rtol=0, atol=1e-6 * np.abs(after).max())
    for support in case.supports:
        if support.stiffness is None:
            assert np.abs(found.shapes(support.position)).max() < 1e-10


def test_derivatives_of_shapes_are_their_slopes():
    found = solve(PATCHED)
    for x in (0.1, 0.33, 0.8, 1.28):
        for order in (1, 2, 3):
            slope = central(lambda y, n=order - 1: found.shapes(y[0], n), [x], 1e-3)[:, 0]
            exact = found.shapes(x, order)
            assert_allclose(exact, slope, rtol=0, atol=1e-8 * np.abs(exact).max())


@pytest.mark.parametrize("ends", PAIRS)
def test_shapes_are_positive_near_the_left_end(ends):
    found = solve(Case(Beam(0.6, **PROPERTIES, ends=ends, modes=12)))
    assert np.all(found.shapes(0.01) > 0)


def test_fifty_modes_stay_exact_and_bounded():
    """The shapes of a cantilever reach 2 at its tip, where hyperbolic functions would overflow."""
    case = Case(Beam(1.2, **PROPERTIES, ends="clamped-free", modes=50))
    assert_allclose(parameters(case, 1.2), single_span_parameters("clamped-free", 50), rtol=1e-12)
    shapes = np.asarray(solve(case).shapes(np.linspace(0.0, 1.2, 2001))) * np.sqrt(0.535 * 1.2)
    assert_allclose(np.abs(shapes).max(axis=0), 2.0, rtol=1e-6)
    assert_allclose(np.abs(shapes[-1]), 2.0, rtol=1e-8)


# Derivatives of frequencies and shapes, at repeated and crossing frequencies too.

BY_SECTION = Case(
    Beam(
        1.3,
        width=0.1,
        height=0.003,
        youngs_modulus=7e10,
        density=2700.0,
        ends="pinned-clamped",
        modes=4,
        damping_ratio=0.02,
    ),
    [Support(0.5, 3e3, 0.0, 2.0), Support(0.9)],
    [Patch(0.2, 0.35, 1.0, added_mass=0.4, added_rigidity=9.0)],
)
NUMBERS = [
    "beam.length", "beam.width", "beam.height", "beam.youngs_modulus", "beam.density",
    "beam.damping_ratio", "supports.0.position", "supports.0.stiffness",
    "supports.0.rotational_stiffness", "supports.1.position", "actuators.0.start",
    "actuators.0.end", "actuators.0.added_mass", "actuators.0.added_rigidity",
]  # fmt: skip


BOTH, REVERSE = (jax.jacfwd, jax.jacrev), (jax.jacrev,)


def assert_derivatives(function, size: int, jacobians=REVERSE, floor: float = 0.0) -> None:
    """Automatic derivatives against central differences, at zero, each result on its scale.

    Reverse mode is the transpose of forward mode: where it is right, both are. Results below
    `floor` times the largest, which are rounding errors, are on that scale.
    """
    expected = central(function, np.zeros(size), 1e-3)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    scale = np.maximum(scale, floor * scale.max())
    scale = np.where(scale > 0, scale, 1.0)
    for jacobian in jacobians:
        found = jax.jit(jacobian(function))(jnp.zeros(size))
        assert_allclose(found / scale, expected / scale, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("case", "numbers", "jacobians"),
    [
        (BY_SECTION, NUMBERS, BOTH),
        (
            Case(Beam(1.2, **PROPERTIES, ends="clamped-free", modes=5), [Support(0.7)]),
            ["beam.length", "beam.flexural_rigidity", "beam.mass_per_length"],
            REVERSE,
        ),
    ],
    ids=["section", "rigidity"],
)
def test_derivatives_of_frequencies_and_shapes_in_every_number(case, numbers, jacobians):
    layout, x = mesh_layout(case), jnp.array([0.1, 0.62, 1.0])
    start = np.array([float(value_at(case, address)) for address in numbers])

    @jax.jit
    def quantities(change):
        changed = replace(case, dict(zip(numbers, start * (1 + change), strict=True)))
        found = modes(changed, layout)
        shapes = found.shape_derivatives(x, (0, 1, 2))
        return jnp.concatenate([found.stiffness, found.damping, shapes.ravel()])

    assert_derivatives(quantities, len(numbers), jacobians)


def flexibility(found: Modes, x) -> jax.Array:
    """Dynamic flexibility psi(x)' (s^2 + s D + K)^-1 psi(x), the same for all bases of modes."""
    s = jnp.sqrt(found.stiffness_unit)
    stiffness = jnp.diag(found.stiffness) + found.coupling
    damping = jnp.diag(found.damping) + found.damping_coupling
    dynamic = s**2 * jnp.eye(stiffness.shape[0]) + s * damping + stiffness
    shapes = found.shapes(x)
    return (shapes @ jnp.linalg.solve(dynamic, shapes.T))[jnp.triu_indices(x.shape[0])]


def crossing(**damping) -> Case:
    """A pinned beam whose midspan spring lifts the first mode into the second.

    The second has its node there. At its wavenumber b = 2 pi / L the deflection at midspan under
    a unit force is (tan(b L / 2) - tanh(b L / 2)) / (4 E I b^3), and the spring cancels it.
    """
    wave = 2 * np.pi / 1.2
    spring = 4 * 11.68 * wave**3 / np.tanh(np.pi)
    return Case(Beam(1.2, **PROPERTIES, modes=6, **damping), [Support(0.6, spring)])


def decoupled(**damping) -> Case:
    """Two equal spans, each clamped at the common support by a very stiff spring."""
    return Case(
        Beam(1.2, **PROPERTIES, modes=6, **damping), [Support(0.6, rotational_stiffness=1e12)]
    )


FREE = Case(
    Beam(1.2, **PROPERTIES, ends="free-free", modes=6, damping_ratio=0.05),
    actuators=[Patch(0.2, 0.5, 1.0, added_mass=0.2, added_rigidity=3.0)],
)
REPEATED = {
    "crossing": (
        crossing(damping_ratio=0.1),
        ["supports.0.position", "supports.0.stiffness", "beam.length"],
    ),
    "decoupled": (decoupled(damping_ratio=0.1), ["supports.0.position", "beam.length"]),
    "rayleigh": (
        decoupled(rayleigh_damping=[0.3, 1e-4]),
        ["supports.0.position", "beam.mass_per_length"],
    ),
    "free": (FREE, ["beam.length", "actuators.0.start", "actuators.0.added_mass"]),
}


def response(case: Case, numbers: list[str]):
    """The flexibility as a function of relative changes of some numbers."""
    layout, x = mesh_layout(case), jnp.array([0.13, 0.45, 0.8])
    start = np.array([float(value_at(case, address)) for address in numbers])

    @jax.jit
    def function(change):
        changed = replace(case, dict(zip(numbers, start * (1 + change), strict=True)))
        return flexibility(modes(changed, layout), x)

    return function


@pytest.mark.parametrize("name", REPEATED)
def test_responses_have_derivatives_where_frequencies_are_repeated(name):
    case, numbers = REPEATED[name]
    assert bool(solve(case).has_repeated)
    # Through the stiff spring a span responds with 1e-11 of the response of the driven one.
    assert_derivatives(response(case, numbers), len(numbers), floor=1e-4)


@pytest.mark.parametrize("case", [crossing(), decoupled()], ids=["crossing", "decoupled"])
def test_second_derivatives_where_frequencies_are_repeated(case):
    """Undamped: a damping ratio goes with the root of the stiffness, right to first order only."""
    numbers = ["supports.0.position", "beam.length"]
    function = response(case, numbers)
    slope = jax.jit(jax.jacfwd(function))
    found = jax.jit(jax.jacfwd(jax.jacfwd(function)))(jnp.zeros(len(numbers)))
    expected = central(lambda p: slope(p).reshape(-1), np.zeros(len(numbers)), 1e-3)
    scale = np.abs(expected).max()
    assert_allclose(found.reshape(expected.shape), expected, rtol=0, atol=1e-6 * scale)


def test_derivatives_of_a_free_beam_by_springs_of_zero_stiffness():
    """Rigid-body modes at zero: one-sided differences, for a stiffness cannot be negative."""
    case = Case(Beam(1.2, **PROPERTIES, ends="free-free", modes=5), [Support(0.3, 0.0, 0.0, 0.0)])
    layout, x = mesh_layout(case), jnp.array([0.13, 0.8])

    @jax.jit
    def function(stiffness):
        springs = {
            "supports.0.stiffness": stiffness[0],
            "supports.0.rotational_stiffness": stiffness[1],
        }
        return flexibility(modes(replace(case, springs), layout), x)

    found = jax.jit(jax.jacfwd(function))(jnp.zeros(2))
    for i, h in enumerate((1e-3, 1e-3)):
        values = [np.asarray(function(n * h * jnp.eye(2)[i])) for n in range(4)]
        expected = (-11 * values[0] + 18 * values[1] - 9 * values[2] + 2 * values[3]) / (6 * h)
        assert_allclose(found[:, i], expected, rtol=1e-6)


def test_a_dataset_of_shapes_reaches_from_end_to_end():
    """The first mode of two equal spans is that of a pinned span, once up and once down."""
    length, rigidity, density = 24.0, 5e9, 8e3
    beam = Beam(length, rigidity, density, damping_ratio=0.02, modes=2)
    found = modes(Case(beam, supports=[Support(length / 2)], run=jb.Run(1.0))).to_xarray(9)
    x, wave = np.linspace(0.0, length, 9), 2 * np.pi / length
    assert_allclose(found.position, x, rtol=1e-15)
    sine = np.sqrt(2 / (density * length)) * np.sin(wave * x)
    assert_allclose(found["shape"][:, 0], sine, rtol=0, atol=1e-9 * np.abs(sine).max())
    assert_allclose(
        found.frequency[0], wave**2 * np.sqrt(rigidity / density) / (2 * np.pi), rtol=1e-9
    )
    assert_allclose(found.damping_ratio, 0.02, rtol=1e-9)
    assert found.mode.values.tolist() == [1, 2]
