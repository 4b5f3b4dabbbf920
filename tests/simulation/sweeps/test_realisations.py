"""Intervals of fractiles and means over realisations, against sums of binomials and simulation."""

import dataclasses
import math

import numpy as np
import pytest
import scipy

import jaxbeam as jb
from jaxbeam.plot import plot_realisations
from jaxbeam.simulation.sweeps import sweep as sweeps
from jaxbeam.simulation.sweeps.realisations import (
    interval_ranks,
    least_count,
    realisation_statistics,
    realisations,
    static_peaks,
)


def below(rank: int, count: int, level: float) -> float:
    """Probability that fewer than `rank` of the values are below the fractile."""
    terms = (math.comb(count, k) * level**k * (1 - level) ** (count - k) for k in range(rank))
    return math.fsum(terms)


@pytest.mark.parametrize("level", [0.5, 0.9, 0.95])
@pytest.mark.parametrize("count", [5, 30, 72, 100, 317])
def test_ranks_by_sums_of_binomials(count, level):
    """Each side misses at most 2.5 %, and one rank further inward would miss more."""
    low, high = interval_ranks(count, level)
    assert below(low, count, level) <= 0.025 < below(low + 1, count, level)
    assert 1 - below(high, count, level) <= 0.025 < 1 - below(high - 1, count, level)
    closed = low >= 1 and high <= count
    assert closed == (count >= least_count(level))


def test_coverage_of_a_skew_distribution():
    """Of exponential values, whose 90 % fractile is ln 10, in 400 repeats of 60."""
    values = np.random.default_rng(4).exponential(size=(60, 400))
    found = realisation_statistics(values, 0.9)
    inside = np.mean((found["low"] <= np.log(10)) & (np.log(10) <= found["high"]))
    assert 0.93 <= inside <= 0.99
    mean = np.mean((found["mean_low"] <= 1) & (found["mean_high"] >= 1))
    assert 0.90 <= mean <= 0.98


def test_mean_fractile_and_need():
    values = np.random.default_rng(1).normal(10.0, 1.0, (200, 2))
    values[150:, 1] = np.nan  # failed runs
    found = realisation_statistics(values, 0.95)
    assert found["count"].tolist() == [200, 150]
    own = values[:150, 1]
    interval = scipy.stats.ttest_1samp(own, 0.0).confidence_interval(0.95)
    assert found["mean_low"][1] == pytest.approx(interval.low, rel=1e-12)
    assert found["mean_high"][1] == pytest.approx(interval.high, rel=1e-12)
    assert found["fractile"][1] == np.quantile(own, 0.95)
    assert found["needed"][0] == 0
    wide = realisation_statistics(values[:, 0], 0.95, precision=0.001)
    half = (wide["high"] - wide["low"]) / 2
    expected = math.ceil(200 * (half / (0.001 * wide["fractile"])) ** 2) - 200
    assert wide["needed"] == expected
    few = realisation_statistics(values[:40, 0], 0.95)
    assert few["high"] == np.inf and few["needed"] == 32
    assert np.isnan(realisation_statistics(np.full(3, np.nan), 0.5)["mean"])


@pytest.mark.parametrize(("largest", "needed"), [(0.0, 0.0), (1.0, np.inf)])
def test_fractiles_of_zero(largest, needed):
    """As of the deflection of a support, or a limit that is passed in few runs.

    Of 100 values the bounds of the fractile are the 90th and the 100th.
    """
    values = np.append(np.zeros(99), largest)
    found = realisation_statistics(values, 0.95)
    assert (found["fractile"], found["low"], found["high"]) == (0.0, 0.0, largest)
    assert found["needed"] == needed


ROUGH = jb.Case(
    jb.Beam(20.0, 4e9, 8e3, damping_ratio=0.02, modes=3),
    sensors=[jb.Sensor(10.0), jb.Sensor(7.0, quantity="moment")],
    loads=[
        jb.QuarterCar(
            body_mass=4000.0,
            axle_mass=600.0,
            suspension_stiffness=4e5,
            suspension_damping=1e4,
            tyre_stiffness=1.5e6,
            speed=20.0,
        ),
        jb.MovingMass(mass=500.0, speed=20.0, entry_time=0.2),
    ],
    profile=jb.profiles.ISO8608Profile("B", seed=0, highest_wavenumber=2.0),
    run=jb.Run(1.6, sample_rate=100.0),
)


def relative_difference(first, second) -> float:
    names = "peak_deflection", "peak_moment"
    return max(float(np.nanmax(np.abs(first[name] / second[name] - 1))) for name in names)


def test_seeds_as_runs_of_a_batch_and_one_by_one(c_integrator, monkeypatch):
    """Profiles of their own in C, with vehicles that all share, against a sweep of each seed."""
    over = {"profile.seed": range(1, 11), "loads.0.speed": [18.0, 23.0]}
    together = jb.sweep(ROUGH, over, progress=False)
    some = {"profile.seed": [2, 9], "loads.0.speed": [18.0, 23.0]}
    monkeypatch.setattr(sweeps, "_computed_together", lambda parts, bar: [])
    alone = jb.sweep(ROUGH, some, progress=False)
    assert together["profile.seed"].values.tolist() == list(range(1, 11))
    found = together.sel({"profile.seed": [2, 9]})
    assert relative_difference(found, alone) < 1e-7
    np.testing.assert_allclose(found.peak_time, alone.peak_time, atol=1e-4)
    assert found.cases.values.tolist() == alone.cases.values.tolist()


def test_stated_errors_of_twenty_profiles(c_integrator):
    """Against a tenth of the tolerance: all together, and each with its own statement."""
    seeds, speed = range(20), {"loads.0.speed": [22.0]}
    exact = jb.sweep(ROUGH, {"profile.seed": seeds} | speed, tolerance=1e-8, progress=False)
    found = jb.sweep(ROUGH, {"profile.seed": seeds} | speed, progress=False)
    assert relative_difference(found, exact) < min(1.5 * found.error_estimate, 1e-7)
    for seed in seeds:
        profile = dataclasses.replace(ROUGH.profile, seed=seed)
        one = jb.sweep(dataclasses.replace(ROUGH, profile=profile), speed, progress=False)
        error = relative_difference(one, exact.sel({"profile.seed": seed}))
        assert error < min(1.5 * one.error_estimate, 1e-7)


def test_sweep_over_seeds_and_figure():
    """Amplification is one under a load that is slow, on a surface that is smooth."""
    case = jb.Case(
        jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.05, modes=3),
        sensors=[jb.Sensor(10.0, name="midspan"), jb.Sensor(5.0, "moment")],
        loads=[jb.MovingMass(mass=2000.0, speed=2.0)],
        profile=jb.profiles.ISO8608Profile("A", seed=0, scale=1e-4, highest_wavenumber=0.5),
        run=jb.Run(10.5, sample_rate=50.0),
    )
    over = {"profile.seed": [1, 2, 3], "loads.0.speed": [2.0, 2.2]}
    swept = jb.sweep(case, over, progress=False, tolerance=1e-4)
    found = realisations(swept, "profile.seed", 0.5)
    assert found.peak_deflection.dims == ("statistic", "loads.0.speed", "sensor")
    static = static_peaks(case, over)
    for i, name in enumerate(("peak_deflection", "peak_moment")):
        fractile = found[name].sel(statistic="fractile").values[:, i]
        np.testing.assert_allclose(fractile / static[i], 1.0, atol=0.02)
    assert np.isnan(static_peaks(case, ["beam.length"])).all()
    assert np.isnan(static_peaks(dataclasses.replace(case, loads=()), over)).all()
    shown = plot_realisations(swept.isel({"loads.0.speed": [0]}), "profile.seed", 0.5)
    assert shown.axes[0].get_xlabel().startswith("peak deflection, midspan")
    with pytest.raises(ValueError, match="select a value of loads"):
        plot_realisations(swept, "profile.seed")
    with pytest.raises(ValueError, match="is not swept"):
        realisations(swept, "profile.scale")
    with pytest.raises(ValueError, match="level and confidence"):
        realisations(swept, "profile.seed", 1.5)
