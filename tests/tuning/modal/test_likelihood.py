"""Likelihood of spectral matrices: expectation, derivatives and errors against closed forms."""

import numpy as np
import pytest
from scipy.signal import lfilter

from tests.tuning.modal.test_leaving import mode
from tests.tuning.modal.test_modal import ambient
from tuning import ModalSettings, identify_modes
from tuning.modal.identify_modes import chosen_modes
from tuning.modal.likelihood import (
    SpectralModel,
    Start,
    Window,
    _moved,
    _places,
    expectation,
    information,
    refine_modes,
    with_cost,
)


def two_modes():
    """A model of two close modes in three channels, and a window of random matrices."""
    random, bins, rows = np.random.default_rng(0), 40, 3
    values = random.normal(size=(bins, rows, 2)) + 1j * random.normal(size=(bins, rows, 2))
    spectra = np.einsum("bcn,bdn->bcd", values, values.conj()) / 2
    frequencies = np.linspace(2, 4, bins)
    window = Window(frequencies, np.full(bins, 60.0), spectra, np.eye(rows), 2, 0.1)
    background = np.zeros((3, rows, rows))
    background[0], background[1] = np.linalg.cholesky(np.eye(rows) + 0.2), 0.1 * np.eye(rows)
    model = SpectralModel(
        2 * np.pi * np.array([2.8 * (-0.02 + 1j), 3.1 * (-0.03 + 1j)]),
        random.normal(size=(2, rows)),
        np.array([[0.3, 0.0], [0.1, 0.2]]),
        0.2 * random.normal(size=(2, rows)),
        np.array([0.01, -0.02]),
        background,
        window.step,
    )
    return model, window


def test_expected_spectra_are_those_of_the_covariances():
    """Sum over lags of covariances R(l), R(-l) = R(l)^T, times the overlap of two records."""
    model, window = two_modes()
    model = model._replace(background=0 * model.background)
    count, step = int(window.lengths[0]), window.step
    expected = np.zeros((window.frequencies.size, 3, 3), complex)
    for lag in range(count):
        powers = np.exp(model.poles * lag * step)
        covariance = 2 * np.real(np.einsum("k,kc,kd->cd", powers, model.shapes, model.amplitudes))
        turned = np.exp(-2j * np.pi * window.frequencies * lag * step) * (1 - lag / count)
        if lag:
            expected += turned[:, None, None] * covariance
            expected += turned.conj()[:, None, None] * covariance.T
        else:
            expected += (covariance + covariance.T) / 2
    np.testing.assert_allclose(expectation(model, window), expected, rtol=1e-9, atol=1e-9)


def test_the_gradient_is_that_of_differences():
    model, window = two_modes()
    gradient, fisher = information(model, window)
    for place in range(gradient.size):
        step = np.zeros(gradient.size)
        step[place] = 1e-6
        above, below = (with_cost(_moved(model, s * step), window).cost for s in (1, -1))
        assert (above - below) / 2e-6 == pytest.approx(gradient[place], rel=1e-6, abs=1e-5)
    assert np.linalg.eigvalsh(fisher).min() > -1e-6 * np.linalg.eigvalsh(fisher).max()


def found_in(log, poles, shapes):
    """Modes of a log from starts of which none is certain."""
    values = log.values - log.values.mean(axis=0)
    start = Start(poles, shapes, np.full(len(poles), 1.0), np.zeros(len(poles), bool))
    return refine_modes([values], 40.0, start)


def test_deviations_are_those_of_the_estimates():
    """Errors of logs over their stated deviations have an rms of about one."""
    roots = [2 * np.pi * f * (-z + 1j * np.sqrt(1 - z**2)) for f, z in ((3.0, 0.02), (7.0, 0.01))]
    scaled = []
    for seed in range(20):
        found = found_in(ambient(seed), np.array(roots), np.array([[1, 0.7], [0.8, -0.9]]))
        for one, truth in zip(found, roots, strict=True):
            assert one is not None
            error = one.pole - truth
            scaled.append(np.array([error.real, error.imag]) / np.sqrt(np.diag(one.covariance)))
    rms = np.sqrt(np.mean(np.square(scaled), axis=0))
    assert np.all((rms > 0.75) & (rms < 1.25)), rms


def test_what_the_likelihood_does_not_need_is_left_out():
    """Of three poles beside one resonance, and one in noise, the first alone stays."""
    w = 2 * np.pi
    poles = w * np.array(
        [3.0 * (-0.02 + 1j), 3.1 * (-0.02 + 1j), 2.9 * (-0.01 + 1j), 12 * (-0.01 + 1j)]
    )
    found = found_in(ambient(0), poles, np.array([[1, 0.7]] * 4))
    assert [one is not None for one in found] == [True, False, False, False]
    assert found[0].pole.imag == pytest.approx(w * 3.0, rel=0.01)


SHAPES = np.array([[1.0, 0.6, -0.4], [0.7, -1.0, 0.3]])


def two_close_modes(truth, rate=20.0, finer=4, count=6000):
    """Samples of two poles (1/s) in three channels, under forces that are correlated."""
    random, shapes = np.random.default_rng(4), SHAPES
    forces = random.normal(size=(count * finer, 2)) @ np.array([[1.0, 0.5], [0.0, 1.0]])
    values = 0.0
    for pole, shape, force in zip(truth, shapes, forces.T, strict=True):
        z = np.exp(pole / rate / finer)
        motion = lfilter([1.0, -z.real], [1, -2 * z.real, abs(z) ** 2], force)[::finer]
        values = values + np.outer(motion, shape)
    return values + 0.2 * values.std() * random.normal(size=values.shape)


def test_modes_within_a_bandwidth_are_told_by_their_shapes():
    """Two modes 2 % apart, damped by 2 %, which no spectrum shows as two peaks."""
    truth = 2 * np.pi * np.array([3.0, 3.06]) * (-0.02 + 1j)
    values = two_close_modes(truth)
    starts = 2 * np.pi * np.array([2.99, 3.1]) * (-0.012 + 1j)
    start = Start(starts, SHAPES + 0.2, values.var() * np.ones(2), np.array([False, False]))
    found = refine_modes([values], 20.0, start)
    for one, pole, shape in zip(found, truth, SHAPES, strict=True):
        assert one is not None
        deviations = np.sqrt(np.diag(one.covariance))
        error = np.array([one.pole.real - pole.real, one.pole.imag - pole.imag])
        assert np.all(np.abs(error) < 3 * deviations) and deviations[1] < 0.01 * pole.imag
        np.testing.assert_allclose(one.shape, shape / shape[np.argmax(np.abs(shape))], atol=0.25)


def test_a_start_beside_a_certain_mode_may_become_another():
    """As in a planted log: the certain mode keeps its place though the other is as near to it."""
    starts = 2 * np.pi * np.array([2.3026 * (-0.0112 + 1j), 2.2985 * (-0.0096 + 1j)])
    poles = 2 * np.pi * np.array([2.4318 * (-0.0076 + 1j), 2.3030 * (-0.0112 + 1j)])
    assert _places(starts, np.array([True, False]), poles) == [1, 0]
    assert _places(starts, np.array([False, True]), poles) == [0, 1]


# Modes that a user chooses among those found, whatever the criteria.

JUDGED = (
    (mode(2.0, (1.0, 0.5)), ""),
    (mode(2.05, (1.0, -0.5)), "a complex shape"),
    (mode(6.0, (1.0, 0.5)), ""),
)


def test_the_nearest_modes_are_kept_and_no_others():
    kept, others, notes = chosen_modes(JUDGED, [6.1, 2.04], "log")
    assert [one.frequency for one, _ in kept] == [6.0, 2.05] and not any(r for _, r in kept)
    assert [(one.frequency, reason) for one, reason in others] == [(2.0, "not chosen")]
    assert notes == ["2.05 Hz is chosen, though a complex shape"]


@pytest.mark.parametrize(
    ("judged", "frequencies", "message"),
    [
        (JUDGED, [3.0], "log: no pole within 2 % of the chosen 3 Hz; the nearest is 2.05 Hz"),
        ((), [3.0], "within 2 % of the chosen 3 Hz; there are none"),
        (JUDGED, [6.0, 6.05], "6 Hz and 6.05 Hz choose one mode, that of 6 Hz"),
    ],
)
def test_frequencies_that_choose_nothing_or_one_mode_twice(judged, frequencies, message):
    with pytest.raises(ValueError, match=message):
        chosen_modes(judged, frequencies, "log")


def test_poles_that_the_criteria_reject_are_modes_if_they_are_chosen():
    """Numbers of a chosen mode are those that were found; its interval says how certain it is."""
    free = identify_modes(ambient(0))
    assert free.rejected
    rejected, reason = free.rejected[0]
    chosen = [free.frequencies[1], rejected.frequency]
    fit = identify_modes(ambient(0), settings=ModalSettings(choose=chosen))
    np.testing.assert_array_equal(np.sort(fit.frequencies), np.sort(chosen))
    assert f"{rejected.frequency:.4g} Hz is chosen, though {reason}" in str(fit)
    assert f"{free.frequencies[0]:14.4f}  not chosen" in str(fit)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count must be at least 1"),
        ({"order": 3}, "the highest order must be from 4 to 1000, not 3"),
        ({"order": 10**9}, "the highest order must be from 4 to 1000, not 1000000000"),
        ({"force_window": -1.0}, "the force window must last longer than 0 s, not -1 s"),
        ({"choose": [0.0]}, "by frequencies above 0 Hz, not 0 Hz"),
        ({"choose": [3.0], "count": 1}, "leave out count"),
        ({"choose": [3.0], "exclude": [50.0]}, "leave out exclude"),
    ],
)
def test_choices_that_contradict_each_other(options, message):
    with pytest.raises(ValueError, match=message):
        ModalSettings(**options)
