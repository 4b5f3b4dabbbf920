"""Envelopes along the beam against closed forms of a slow crossing, and continuous peaks."""

import dataclasses

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.sections import influence_table
from jaxbeam.case.case import replace
from jaxbeam.library.published import trains
from jaxbeam.plot import plot_envelope
from jaxbeam.simulation import record as module
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
    assert 101 <= whole.positions.shape[0] < 200
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


# The extremes along the beam: peaks over piers

SPANS = 25.0, 35.0, 25.0
PIERS = np.cumsum(SPANS)[:2]
CONTINUOUS = jb.Case(
    jb.Beam(sum(SPANS), flexural_rigidity=3e10, mass_per_length=1e4, damping_ratio=0.1, modes=8),
    supports=[jb.Support(x) for x in PIERS],
    loads=[jb.MovingForce(force=3e5, speed=0.5)],
    run=jb.Run(172.0, sample_rate=10.0),
)


def pier_moments(force, y) -> np.ndarray:
    """Moments at both piers under a force at y, by the three-moment equation (Clapeyron)."""
    starts, right = np.concatenate([[0.0], PIERS]), np.zeros(2)
    for i, (start, length) in enumerate(zip(starts, SPANS, strict=True)):
        if start <= y <= start + length:
            a, b = y - start, start + length - y
            if i < 2:
                right[i] -= force * a * (length**2 - a**2) / length
            if i > 0:
                right[i - 1] -= force * b * (length**2 - b**2) / length
    first, middle, last = SPANS
    matrix = [[2 * (first + middle), middle], [middle, 2 * (middle + last)]]
    return np.linalg.solve(matrix, right)


def test_peaks_over_piers_of_a_slow_force():
    """25 and 60 m are on no grid of 101 positions of 85 m: these miss 1.5 to 4 %."""
    record = jb.simulate(CONTINUOUS)
    found = record.envelope("moment")
    moments = np.array([pier_moments(3e5, y) for y in np.linspace(0.0, 85.0, 3401)])
    assert_allclose(found.smallest.min(), moments.min(), rtol=5e-4)
    at_pier = np.isin(found.positions, PIERS)
    assert_allclose(found.smallest[at_pier], moments.min(axis=0), rtol=5e-4)
    assert_allclose(found.largest[at_pier], moments.max(axis=0), rtol=2e-3)
    at_piers = np.asarray(record.bending_moment(PIERS))
    assert_allclose(found.smallest.min(), at_piers.min(), rtol=1e-12)
    grid = record.envelope("moment", np.linspace(0.0, 85.0, 101))
    assert grid.smallest.min() > 0.99 * found.smallest.min()
    dense = record.envelope("moment", np.linspace(30.0, 55.0, 2501))  # in the middle span
    assert_allclose(found.largest.max(), dense.largest.max(), rtol=1e-4)


def test_envelopes_between_samples_have_the_same_extremes():
    """At 20 m/s, from samples and between them, over a pier and in the middle span."""
    case = replace(CONTINUOUS, {"loads.0.speed": 20.0, "run.duration": 5.0})
    case = replace(case, {"run.sample_rate": 1000.0, "beam.damping_ratio": 0.01})
    record = jb.simulate(case).envelope("moment")
    case = replace(case, {"run.sample_rate": 50.0})
    exact = jb.envelope(case, quantity="moment")
    assert_allclose(exact.lowest.min(), record.smallest.min(), rtol=1e-4)
    assert_allclose(exact.highest.max(), record.largest.max(), rtol=2e-4)
    assert set(PIERS) <= set(np.asarray(exact.positions))
    shear = jb.envelope(case, [25.0, 24.99, 25.01], quantity="shear")
    assert_allclose(shear.lowest[0], shear.lowest[1], rtol=1e-3)  # the left side
    assert_allclose(shear.highest[0], shear.highest[2], rtol=1e-3)  # the right side
    assert shear.highest[0] > 10 * shear.highest[1]


# Three bridges whose piers lie between 101 equal positions: there these miss 1.4 to 4 %.

TRUCK = trains()["HL93-truck"]
FAST = replace(CONTINUOUS, {"loads.0.speed": 20.0, "run.duration": 5.0, "run.sample_rate": 200.0})
FAST = replace(FAST, {"beam.damping_ratio": 0.01, "beam.mass_per_length": 15e3})
FAST = dataclasses.replace(FAST, beam=dataclasses.replace(FAST.beam, modes=12))


def test_moments_over_piers_of_a_fast_force():
    """300 kN at 20 m/s: -969.7 kN m over a pier, in envelope, figure, sensors and sweep alike."""
    sensors = [jb.Sensor(x, "moment") for x in PIERS]
    record = jb.simulate(dataclasses.replace(FAST, sensors=sensors))
    found = record.envelope("moment")
    assert_allclose(found.smallest.min(), -969.7e3, rtol=1e-4)
    assert_allclose(found.smallest.min(), np.min(record.bending_moment(PIERS)), rtol=1e-9)
    assert_allclose(np.min(record.extremes.smallest), found.smallest.min(), rtol=1e-4)
    *_, lowest, _, _, _ = plot_envelope(record, "moment").axes[-1].get_lines()
    assert_allclose(np.min(lowest.get_ydata()), found.smallest.min() / 1e6, rtol=1e-9)
    swept = jb.sweep(record.case, {"loads.0.speed": np.array([20.0])}, progress=False)
    peaks = np.max([-record.extremes.smallest, record.extremes.largest], axis=0)
    assert_allclose(swept.peak_moment[0], peaks, rtol=1e-5)


def test_moments_over_piers_of_a_truck():
    """HL-93, its axles by the three-moment equation: -1004.8 kN m, at rest and slowly."""
    x = np.arange(0.0, 95.0, 0.01)
    forces = np.broadcast_to(TRUCK.forces, TRUCK.offsets.shape)
    moments = sum(
        np.array([pier_moments(force, y) * (0.0 <= y <= 85.0) for y in x - offset])
        for force, offset in zip(forces, TRUCK.offsets, strict=True)
    )
    assert_allclose(moments.min(), -1004.8e3, rtol=1e-6)
    case = dataclasses.replace(CONTINUOUS, loads=(jb.Axles(train="HL93-truck", speed=0.5),))
    static = [float(jb.statics.static_peak(case, x, quantity="moment")) for x in PIERS]
    assert_allclose(static, np.abs(moments).max(axis=0), rtol=1e-6)
    table = influence_table(case, ("moment",), tuple(PIERS))
    lines = [[pier_moments(1.0, y)[i] for y in table.positions] for i in (0, 1)]
    assert_allclose(np.asarray(table.values).T, lines, atol=1e-9)
    case = replace(case, {"run.duration": 190.0, "run.sample_rate": 10.0})
    found = jb.simulate(case).envelope("moment")
    assert_allclose(found.smallest.min(), moments.min(), rtol=5e-4)
