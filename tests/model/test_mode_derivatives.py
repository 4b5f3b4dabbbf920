"""Derivatives of frequencies and shapes, at repeated and crossing frequencies too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from jaxbeam.case.actuators.patch import Patch
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.model.modes import Modes, mesh_layout, modes
from tests.differences import central
from tests.solved_modes import PROPERTIES, solve

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
