"""Statics of beams under trains and lorries against numbers that other programs publish.

PyCBA (Caprani, continuous beam analysis, version of commit 89fb9323, its tests `test_inf_lines.py`
and `test_bridge.py`) and KTH BeamDyn (commit 2c83af22, section Validation of its README). Both move
the loads in steps, so that their extremes lie a little below the true ones.
"""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.frozen_loop import NotAffineError, affine_jacobian
from jaxbeam.numerics.stages import exponential_times, propagate
from tests.modules import ROOT

PUBLISHED = json.loads((ROOT / "tests" / "data" / "published_programs.json").read_text())
RIGIDITY = 3e9  # N m^2; forces do not depend on it
ANY_MASS = 1.0


def beam(length: float, **parts) -> jb.Beam:
    return jb.Beam(length, flexural_rigidity=RIGIDITY, mass_per_length=ANY_MASS, **parts)


def influence(case: jb.Case, x: float, load_positions, order: int) -> np.ndarray:
    """Influence line of the moment (order 2) or, right of x, the shear force (order 3)."""
    return RIGIDITY * np.asarray(jb.influence_line(case, x, load_positions, order))


@pytest.fixture(scope="module")
def gerber() -> jb.Case:
    """Clamped at 0 m, hinge at 5 m, supports at 10 and 20 m."""
    hinged = beam(20.0, ends="clamped-pinned", hinges=[jb.Hinge(5.0)])
    return jb.Case(hinged, supports=[jb.Support(10.0)])


@pytest.mark.parametrize(
    ("name", "x", "order"),
    [("shear at 15 m", 15.0, 3), ("reaction at 0 m", 0.0, 3), ("moment at 7.5 m", 7.5, 2)],
)
def test_influence_lines_of_a_gerber_beam(gerber, name, x, order):
    positions = 0.5 * np.arange(41)
    expected = np.array(PUBLISHED["influence lines"][name])
    found = influence(gerber, x, positions, order)
    # A load in the section itself is on either side.
    apart = np.ones(41, bool) if order == 2 else positions != x
    assert_allclose(found[apart], expected[apart], rtol=0, atol=1e-9)


def test_moment_of_a_lorry_on_one_span():
    published = PUBLISHED["M1600"]
    offsets = np.concatenate([[0.0], np.cumsum(published["spacings"])])
    forces = np.full(offsets.size, published["axle"])
    lorry = jb.Axles(offsets=offsets, forces=forces, speed=1.0)
    case = jb.Case(beam(published["length"]), loads=[lorry])
    near = published["at"] + np.linspace(-0.5, 0.5, 21)
    moments = RIGIDITY * np.asarray(jb.statics.static_peak(case, near, derivative=2))
    at_place = RIGIDITY * float(jb.statics.static_peak(case, published["at"], derivative=2))
    assert_allclose(at_place, published["moment"], rtol=2e-4)
    assert at_place >= published["moment"] * (1 - 1e-6)
    assert moments.max() < published["moment"] * (1 + 1e-3)


@pytest.mark.parametrize("i", range(7))
def test_moments_of_the_table_of_a_code(i):
    """Load 300LA of AS 5100.2, whose appendix C rounds to 5 kN m."""
    published = PUBLISHED["300LA"]
    length, expected = published["spans"][i], 1e3 * published["moments"][i]
    spacings, forces = [2.0, 1.7, 1.1, 1.7], [360.0, 300.0, 300.0, 300.0, 300.0]
    for _ in range(9):
        spacings += [7.5, 1.7, 1.1, 1.7]
        forces += 4 * [300.0]
    offsets = np.concatenate([[0.0], np.cumsum(spacings)])
    train = jb.Axles(offsets=offsets, forces=1e3 * np.array(forces), speed=1.0)
    case = jb.Case(beam(float(length)), loads=[train])
    x = length * np.linspace(0.4, 0.6, 21)
    moment = RIGIDITY * np.asarray(jb.statics.static_peak(case, x, derivative=2)).max()
    assert_allclose(moment, expected, rtol=1e-3, atol=5e3)


def test_reactions_under_a_heavy_transport():
    """Extremes over three arrangements, in the same steps of 0.1 m: equal but for rounding."""
    published = PUBLISHED["transport"]
    case = jb.Case(beam(50.0), supports=[jb.Support(25.0)])
    places = 0.1 * np.arange(501)
    first = influence(case, 0.0, places, 3)
    first[0] = 1.0  # on the support itself
    last = first[::-1]
    middle = 1.0 - first - last
    mover, trailer = [3.2, 1.2], [1.8] * 9
    weights = 9.81 * np.concatenate([2 * [6.5, 9.25, 9.25], 20 * [12.0], 2 * [6.5, 9.25, 9.25]])
    vehicles = [mover, mover, trailer, trailer, mover, mover]
    largest, smallest = np.full(3, -np.inf), np.full(3, np.inf)
    for gaps in published["gaps"]:
        spacings = [*vehicles[0]]
        for gap, vehicle in zip(gaps, vehicles[1:], strict=True):
            spacings += [gap, *vehicle]
        behind = np.rint(10 * np.concatenate([[0.0], np.cumsum(spacings)])).astype(int)
        index = np.arange(501 + behind[-1])[:, None] - behind
        on_beam = (index >= 0) & (index < 500)  # it has no load on the last support
        at = np.clip(index, 0, 500)
        sums = [
            np.sum(np.where(on_beam, line[at] * weights, 0.0), 1) for line in (first, middle, last)
        ]
        largest = np.maximum(largest, np.max(sums, axis=1))
        smallest = np.minimum(smallest, np.min(sums, axis=1))
    assert_allclose(largest, published["largest"], rtol=0, atol=1e-6)
    assert_allclose(smallest, published["smallest"], rtol=0, atol=1e-6)


def test_frequencies_and_statics_of_a_railway_bridge():
    published = PUBLISHED["railway bridge"]
    bridge = jb.Beam(25.0, flexural_rigidity=30e9, mass_per_length=15e3, damping_ratio=0.01)
    train = jb.Axles(train="EN15528-D2", count=6, speed=1.0)
    case = jb.Case(bridge, loads=[train], run=jb.Run(1.0, gravity=published["gravity"]))
    frequencies = np.asarray(jb.modes(case).frequencies)
    # Elements of 1.25 m: the third frequency is 4e-5 high.
    assert_allclose(frequencies, published["frequencies"], rtol=6e-5)
    assert_allclose(frequencies[0], published["frequencies"][0], rtol=1e-6)
    # That program divides each axle between the two nodes beside it.
    step, nodes = 1.25, 21
    wagon = np.asarray(train.vehicle(published["gravity"]).offsets)
    axles = (float(train.row_spacing()) * np.arange(6)[:, None] + wagon).ravel()
    place, share = np.divmod(axles / step, 1.0)
    pattern = np.zeros(int(place[-1]) + 2)
    np.add.at(pattern, place.astype(int), 1.0 - share)
    np.add.at(pattern, place.astype(int) + 1, share)
    x = step * np.arange(nodes)
    deflections = -np.asarray(jb.influence_line(case, x, x))
    moments = 30e9 * np.asarray(jb.influence_line(case, x, x, 2))
    weight = 22.5e3 * published["gravity"]
    for lines, name in ((deflections, "deflection"), (moments, "moment")):
        peak = weight * max(np.convolve(lines[:, i], pattern).max() for i in range(nodes))
        assert_allclose(peak, published[name], rtol=1e-6)
    # The largest value at any place of the train is a little above it.
    exact = float(jb.statics.static_peak(case, x=12.5))
    assert published["deflection"] < exact < 1.003 * published["deflection"]


# Derivatives of affine functions by differences, and functions that are not affine.

MATRIX = np.array([[1.0, -3e4], [1e-3, 0.7], [0.0, 2.0]])


def test_jacobian_of_an_affine_function_is_its_matrix():
    found = affine_jacobian(lambda x: MATRIX @ x + 7.0, np.zeros(2))
    np.testing.assert_allclose(found, MATRIX, atol=1e-12)
    assert affine_jacobian(lambda x: np.ones(3), np.zeros(0)).shape == (3, 0)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: x**3,
        lambda x: np.clip(x, -1e3, 1e3),
        lambda x: np.where(np.abs(x) < 1e-3, 0.0, x),
        lambda x: jnp.asarray(x),  # computes with JAX
    ],
)
def test_other_functions_are_refused(function):
    with pytest.raises(NotAffineError):
        affine_jacobian(function, np.zeros(2))


def test_traced_functions_are_differentiated_at_their_point():
    found = jax.jit(lambda x: affine_jacobian(lambda y: y**3, x))(np.array([2.0, 3.0]))
    np.testing.assert_allclose(found, np.diag([12.0, 27.0]))


def test_exponentials_of_stacks_are_those_of_scipy():
    import scipy.linalg

    rng = np.random.default_rng(1)
    matrices = rng.standard_normal((3, 4, 4)) * np.array([1e-3, 1.0, 1.0, 0.0])[:, None]
    matrices *= np.array([1e-2, 1.0, 9.0])[:, None, None]
    found = exponential_times(matrices, np.broadcast_to(np.eye(4), (3, 4, 4)))
    for one, matrix in zip(found, matrices, strict=True):
        np.testing.assert_allclose(one, scipy.linalg.expm(matrix), rtol=1e-11, atol=1e-12)


def test_several_times_are_propagated_at_once():
    def matrix(t):
        t = np.asarray(t)
        zero, one = np.zeros_like(t), np.ones_like(t)
        return np.stack([np.stack([zero, one], -1), np.stack([-40 - 9 * t, zero], -1)], -2)

    times = np.array([0.0, 0.3])
    together = propagate(matrix, times, 0.1, 4, np.broadcast_to(np.eye(2), (2, 2, 2)))
    for one, t in zip(together, times, strict=True):
        np.testing.assert_allclose(one, propagate(matrix, t, 0.1, 4, np.eye(2)), rtol=1e-13)
