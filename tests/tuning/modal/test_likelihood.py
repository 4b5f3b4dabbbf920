"""Likelihood of periodograms: expectation, derivatives and errors against closed forms."""

import numpy as np
import pytest

from tests.tuning.modal.test_modal import ambient
from tuning.modal.likelihood import _columns, _Window, refine_poles


def test_expected_periodogram_is_that_of_the_covariances():
    """Sum over lags of covariance times overlap, and derivatives by the pole by differences."""
    count, step, pole = 60, 0.1, -0.3 + 2j * np.pi * 2.2
    frequencies = np.linspace(0.5, 4.5, 11)
    window = _Window(frequencies, np.full(11, float(count)), np.ones((1, 11)), step)
    columns, slopes = _columns(np.array([pole]), window)
    lags = np.arange(count)
    for column, amplitude in zip(columns[:2], (1.0, 1.0j), strict=True):
        covariance = np.real(amplitude * np.exp(pole * lags * step)) * (1 - lags / count)
        phases = np.cos(2 * np.pi * np.multiply.outer(frequencies, lags) * step)
        expected = 2 * phases @ covariance - covariance[0]
        np.testing.assert_allclose(column, expected, rtol=1e-9, atol=1e-9)
    for slope, change in zip(slopes[0], (-1e-6, 1e-6j), strict=True):
        moved = [_columns(np.array([pole + s * change]), window)[0][:2] for s in (1, -1)]
        np.testing.assert_allclose(slope, (moved[0] - moved[1]) / 2e-6, rtol=1e-5, atol=1e-5)


def test_deviations_are_those_of_the_estimates():
    """Errors of 30 logs over their stated deviations have an rms of about one."""
    roots = [2 * np.pi * f * (-z + 1j * np.sqrt(1 - z**2)) for f, z in ((3.0, 0.02), (7.0, 0.01))]
    scaled = []
    for seed in range(30):
        log = ambient(seed)
        found = refine_poles(
            [log.values - log.values.mean(axis=0)], 40.0, np.array(roots),
            np.array([[1, 0.7], [0.8, -0.9]]), np.array([False, False]),
        )  # fmt: skip
        for one, truth in zip(found, roots, strict=True):
            assert one is not None
            error = one.pole - truth
            scaled.append(np.array([error.real, error.imag]) / np.sqrt(np.diag(one.covariance)))
    rms = np.sqrt(np.mean(np.square(scaled), axis=0))
    assert np.all((rms > 0.8) & (rms < 1.25)), rms


def test_what_the_likelihood_does_not_need_is_left_out():
    """Of three poles beside one resonance, and one in noise, the first alone stays."""
    log, w = ambient(0), 2 * np.pi
    poles = w * np.array(
        [3.0 * (-0.02 + 1j), 3.1 * (-0.02 + 1j), 2.9 * (-0.01 + 1j), 12 * (-0.01 + 1j)]
    )
    shapes = np.array([[1, 0.7]] * 4)
    values = log.values - log.values.mean(axis=0)
    found = refine_poles([values], 40.0, poles, shapes, np.zeros(4, bool))
    assert [one is not None for one in found] == [True, False, False, False]
    assert found[0].pole.imag == pytest.approx(w * 3.0, rel=0.01)
