"""p-LSCF: exact data, differences, planted structures."""

import numpy as np
import pytest
import scipy.stats

from experiments.validation.modal_identification import compare, log_of
from tests.oracles.planted_structures import sampled
from tests.tuning.modal.test_subspace import small_structure
from tuning import identify_modes
from tuning.modal.plscf import (
    ImpulseResponses,
    equations,
    fit_fraction,
    frequency_responses,
    output_correlations,
    pole_changes,
    residue_shapes,
)
from tuning.modal.result import mac_matrix

RATE = 100.0
POLES = 2 * np.pi * np.array([3.0, 3.03, 11.0, 25.0]) * (-np.array([0.01, 0.02, 0.005, 0.03]) + 1j)


def modal_responses(random, noise=0.0):
    """Impulse responses of four modes, two of them 1 % apart, at three outputs to two inputs."""
    shapes, participations = random.normal(size=(4, 3)), random.normal(size=(4, 2))
    decays = np.exp(np.multiply.outer(POLES, np.arange(256) / RATE))
    values = np.einsum("rl,ro,ri->loi", decays, shapes, participations).real
    changes = noise * np.abs(values).max() * random.normal(size=(2, *values.shape))
    return ImpulseResponses(values, changes, 1 / RATE), shapes


def test_exact_frequency_responses_have_exact_poles_and_shapes():
    """Though lags are cut off where the modes have decayed by half only."""
    impulses, shapes = modal_responses(np.random.default_rng(0))
    responses = frequency_responses(impulses, (1.0, 45.0))
    fraction = fit_fraction(equations(responses, 6), 4)
    order = np.argsort(np.abs(fraction.poles))
    np.testing.assert_allclose(fraction.poles[order], POLES, rtol=1e-6)
    found = residue_shapes(
        responses.values, responses.z, fraction.roots[order], fraction.left[order].conj()
    )
    for one in (found, fraction.shapes[order]):
        assert np.all(np.diag(mac_matrix(one, shapes + 0j)) > 1 - 1e-9)


def test_poles_of_noise_are_unstable():
    random = np.random.default_rng(1)
    impulses, _ = modal_responses(random)
    noisy = impulses.values + 1e-3 * random.normal(size=impulses.values.shape)
    responses = frequency_responses(impulses._replace(values=noisy), (1.0, 45.0))
    fraction = fit_fraction(equations(responses, 20), 20)
    stable = fraction.poles[fraction.poles.real < 0]
    assert stable.size == POLES.size < fraction.poles.size
    np.testing.assert_allclose(np.sort_complex(np.abs(stable)), np.abs(POLES), rtol=1e-3)


def test_changes_of_poles_agree_with_differences():
    impulses, _ = modal_responses(np.random.default_rng(2), noise=1e-3)
    responses = frequency_responses(impulses, (1.0, 45.0))
    system = equations(responses, 5)
    fraction = fit_fraction(system, 4)
    changes = pole_changes(system, fraction)
    step = 1e-3
    for block in range(2):
        moved = []
        for sign in (-step, step):
            values = responses.values + sign * responses.changes[block]
            other = fit_fraction(equations(responses._replace(values=values), 5), 4).poles
            moved.append([other[np.argmin(np.abs(other - pole))] for pole in fraction.poles])
        expected = (np.array(moved[1]) - np.array(moved[0])) / (2 * step)
        np.testing.assert_allclose(changes[block], expected, rtol=2e-3)


def test_correlations_are_means_of_products():
    random = np.random.default_rng(3)
    values = random.normal(size=(2000, 2))
    found = output_correlations((values,), RATE, 10)
    for lag in (0, 7):
        expected = values[lag : lag + 1984].T @ values[:1984] / 1984
        np.testing.assert_allclose(found.values[lag], expected, atol=5e-3)


def test_modes_of_planted_logs_are_found():
    found = []
    for seed in range(3):
        planted = sampled(small_structure(seed), "ambient", seed, 200.0)
        fit = identify_modes(log_of(planted), band=(2.0, 11.0), method="plscf")
        found.append(compare(fit, planted))
        nearest = mac_matrix(fit.shapes, planted.structure.shapes + 0j).max(axis=1)
        assert np.all(nearest > 0.98)
        assert fit.method == "plscf"
    assert all(seen for one in found for seen in one.found)
    assert not any(one.false_modes for one in found)
    covered = np.concatenate([one.covered for one in found])
    assert np.sum(covered == 0) <= scipy.stats.binom.isf(0.02, covered.size, 0.05), covered


def test_close_modes_are_told_apart():
    """Two modes 1 % apart, in two records taken together."""
    structure = small_structure(0)
    close = structure._replace(
        frequencies=np.array([4.0, 4.04, 9.0]), damping_ratios=np.array([0.004, 0.005, 0.008])
    )
    planted = sampled(close, "ambient", 3, 400.0)
    half = len(planted.values) // 2
    logs = [
        log_of(planted._replace(values=part)) for part in np.split(planted.values[: 2 * half], 2)
    ]
    fit = identify_modes(logs, band=(2.0, 11.0), method="plscf")
    one = compare(fit, planted)
    assert all(one.found) and not one.false_modes


def test_a_method_refuses_what_it_cannot_use():
    log = log_of(sampled(small_structure(0), "ambient", 0, 10.0))
    for method in ("plscf", "covariance"):
        with pytest.raises(ValueError, match="for kind 'free decay' leave the method out"):
            identify_modes(log, method=method, kind="free decay")
    with pytest.raises(ValueError, match="for kind 'ambient' leave the method out"):
        identify_modes(log, method="decay", kind="ambient")
    with pytest.raises(ValueError, match="method 'fdd' is gone"):
        identify_modes(log, method="fdd")
