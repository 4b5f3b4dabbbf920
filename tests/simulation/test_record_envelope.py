"""Envelopes along the beam against closed forms of a slow crossing, and continuous peaks."""

import dataclasses

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.case.case import replace
from jaxbeam.simulation import record_envelope as module
from jaxbeam.simulation.integration_plan import integration_plan

BEAM = jb.Beam(length=30.0, flexural_rigidity=3e10, mass_per_length=1e4, damping_ratio=0.1)
SLOW = jb.Case(
    dataclasses.replace(BEAM, modes=3),
    loads=[jb.MovingForce(force=1e5, speed=0.25)],
    run=jb.Run(121.0, sample_rate=20.0),
)
X = np.linspace(0.0, 30.0, 21)


@pytest.fixture(scope="module")
def slow():
    return jb.simulate(SLOW)


def test_moments_of_a_slow_force(slow):
    """Largest P x (L - x) / L with the force at x, smallest zero."""
    found = slow.envelope("moment", X)
    expected = 1e5 * X * (30 - X) / 30
    assert_allclose(found.largest, expected, rtol=0, atol=1e-3 * expected.max())
    assert_allclose(found.smallest, 0.0, atol=1e-3 * expected.max())
    inner = slice(2, -2)
    assert_allclose(found.largest_load_position[inner, 0], X[inner], atol=0.05)
    assert_allclose(found.largest_time, 4 * found.largest_load_position[:, 0], rtol=1e-9)
    stress = slow.envelope("stress", X, section_modulus=-0.5)
    assert_allclose(stress.smallest, -found.largest / 0.5, rtol=1e-12)


def test_shear_on_both_sides_of_a_slow_force(slow):
    """P (1 - x / L) with the force just right of x, -P x / L with the force just left of it."""
    found = slow.envelope("shear", X)
    assert_allclose(found.largest[1:], 1e5 * (1 - X / 30)[1:], rtol=0, atol=1e3)
    assert_allclose(found.smallest[:-1], -1e5 * (X / 30)[:-1], rtol=0, atol=1e3)


def test_coincident_shear_of_the_largest_moment(slow):
    """With the force at x its shear forces there are P (1 - x / L) and -P x / L: the larger."""
    found = slow.envelope("moment", X, coincident="shear")
    share = X[2:-2] / 30
    expected = 1e5 * np.maximum(share, 1 - share)
    assert_allclose(np.abs(found.largest_coincident[2:-2]), expected, rtol=0, atol=1e3)
    assert list(found.columns)[-1] == "shear (N) at largest"
    assert found.to_xarray()["largest_coincident"].attrs["units"] == "N"


def test_deflections_are_those_between_samples_nearly():
    case = dataclasses.replace(
        SLOW, loads=[jb.MovingMass(mass=2e4, speed=25.0)], run=jb.Run(2.0, sample_rate=1000.0)
    )
    found, exact = jb.simulate(case).envelope("deflection", X), jb.envelope(case, X)
    size = np.abs(exact.lowest).max()
    assert_allclose(found.smallest, exact.lowest, rtol=0, atol=1e-4 * size)
    assert_allclose(found.largest, exact.highest, rtol=0, atol=1e-4 * size)


def test_positions_in_parts_and_traced_numbers(slow, monkeypatch):
    whole = slow.envelope("moment")
    assert whole.positions.shape == (101,)
    times = np.linspace(0, 120, 41)
    plan = integration_plan(SLOW, times)

    def largest(force):
        changed = replace(SLOW, {"loads.0.force": force})
        return jb.simulate(changed, times, plan).envelope("moment", X[5:8]).largest

    value, slope = jax.jit(lambda force: jax.jvp(largest, (force,), (1.0,)))(1e5)
    assert_allclose(slope, value / 1e5, rtol=1e-9)  # linear in the force
    monkeypatch.setattr(module, "MAX_ENTRIES", 20_000)
    parts = slow.envelope("moment")
    for one, other in zip(*map(jax.tree.leaves, (parts, whole)), strict=True):
        assert_allclose(one, other, rtol=1e-10, atol=1e-6)
