"""Mode shapes: sines, orthonormal, smooth across supports and patches, bounded at high numbers."""

import numpy as np
import pytest
from numpy.polynomial import legendre
from numpy.testing import assert_allclose

from jaxbeam.case.actuators.patch import Patch
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Case
from tests.as_oracle import as_oracle
from tests.differences import central
from tests.oracles.closed_forms import single_span_parameters
from tests.solved_modes import PAIRS, PATCHED, PROPERTIES, parameters, solve, supported_beam


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


def test_a_mirrored_beam_has_mirrored_shapes():
    mirrored = Case(
        Beam(1.3, 2.0, 0.7, ends="free-guided", modes=8),
        [Support(1.0, 500.0, 0.0, 3.0), Support(0.39), Support(0.05, 20.0)],
        [
            Patch(0.85, 1.1, 1.0, added_mass=0.4, added_rigidity=1.0),
            Patch(0.6, 0.9, 1.0, added_mass=0.1, added_rigidity=0.5),
        ],
    )
    first, second = solve(PATCHED), solve(mirrored)
    assert_allclose(first.frequencies, second.frequencies, rtol=1e-12)
    x = np.linspace(0.0, 1.3, 14)
    assert_allclose(np.abs(first.shapes(x)), np.abs(second.shapes(1.3 - x)), atol=1e-9)
