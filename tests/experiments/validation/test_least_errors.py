"""Least errors of planted modes against the law of long data, and what logs do not tell."""

import numpy as np
import pytest

from experiments.validation.expected_gain import expected_gain
from experiments.validation.least_errors import (
    TELLING_GAIN,
    least_errors,
    least_errors_of_decays,
    least_errors_of_forced,
    random_response,
    why_untold,
)
from tests.oracles.planted_structures import Planted, Structure, noise_spectrum

RATE = 20.0


def planted(frequencies, damping, noise=1e-3, lines=()):
    """A structure of two channels and two exciters; samples do not matter."""
    count = len(frequencies)
    shapes = np.array([[1.0, 0.5], [0.5, -1.0]])[:count]
    structure = Structure(np.array(frequencies), np.array(damping), shapes, shapes)
    return Planted(structure, np.zeros((1, 2)), RATE, np.ones(count), lines, noise)


@pytest.mark.parametrize("damping", [0.005, 0.02])
def test_least_errors_of_one_mode_are_those_of_long_data(damping):
    """Au (2014), uncertainty law of ambient modal identification, long data and a wide band."""
    frequency, duration = 4.0, 2000.0
    found = least_errors(planted([frequency], [damping]), duration)
    cycles = frequency * duration
    expected = frequency * np.sqrt(damping / (2 * np.pi * cycles))
    assert found.frequencies[0] == pytest.approx(expected, rel=0.1)
    expected = damping / np.sqrt(2 * np.pi * damping * cycles)
    assert found.damping_ratios[0] == pytest.approx(expected, rel=0.1)


def test_least_errors_of_measured_forces_fall_with_the_noise():
    forces = np.random.default_rng(0).normal(size=(2000, 1))
    errors = [
        least_errors_of_forced(planted([4.0, 4.5], [0.01, 0.02], noise), forces).damping_ratios
        for noise in (1.0, 0.1)
    ]
    np.testing.assert_allclose(errors[0], 10 * errors[1], rtol=1e-3)


@pytest.mark.parametrize("count", [1, 3])
def test_least_errors_of_decays_are_those_of_a_damped_sinusoid(count):
    """Known law: variances of s and w are 16 sigma^2 s^3 / (rate |a|^2) in each of equal decays."""
    one = planted([4.0], [0.01])
    pole, amplitude, samples = one.structure.poles[0], 0.3 - 0.4j, 1000
    decay = (amplitude * np.exp(pole * np.arange(samples) / RATE)).real
    parts = np.tile(np.multiply.outer(decay, one.structure.shapes[0]), (count, 1))[None]
    decays = tuple((samples * i, samples * (i + 1)) for i in range(count))
    found = least_errors_of_decays(one._replace(parts=parts, decays=decays))
    level = 1e-6 * noise_spectrum(abs(pole) / RATE)
    energy = count * abs(amplitude) ** 2 * np.sum(one.structure.shapes[0] ** 2)
    expected = np.sqrt(16 * level * -(pole.real**3) / (RATE * energy))
    assert found.frequencies[0] == pytest.approx(expected / (2 * np.pi), rel=0.03)
    assert found.damping_ratios[0] == pytest.approx(expected / abs(pole), rel=0.03)


def test_why_a_log_does_not_tell_a_mode():
    def why(frequencies, damping, noise=1e-3, lines=(), duration=300.0):
        one = planted(frequencies, damping, noise, lines)
        return why_untold(one, 0, least_errors(one, duration), duration)

    assert why([4.0, 6.0], [0.01, 0.01]) == ""
    assert "damping ratio" in why([4.0, 6.0], [0.01, 0.01], noise=1e4)
    assert "from a harmonic" in why([4.0, 6.0], [0.01, 0.01], lines=(4.001,))
    assert "from another" in why([4.0, 4.02], [0.05, 0.05], noise=0.3, duration=60.0)


def test_noise_has_unit_variance():
    angles = np.linspace(-np.pi, np.pi, 20_001)
    assert np.mean(noise_spectrum(angles)) == pytest.approx(1.0, rel=1e-2)


def test_the_expected_gain_is_the_mean_of_likelihood_ratios():
    """Of a weak mode alone, whose spectra are known with and without it."""
    one, duration = planted([4.0], [0.02], noise=0.3), 200.0
    response = random_response(one, duration)
    matrices = [response.spectra(unknowns) for unknowns in (response.unknowns, np.zeros((0, 6)))]
    random = np.random.default_rng(0)
    parts = random.normal(size=(2, 500, *matrices[0].shape[:2])) / np.sqrt(2)
    values = np.einsum("bcd,rbd->rbc", np.linalg.cholesky(matrices[0]), parts[0] + 1j * parts[1])
    costs = [
        np.linalg.slogdet(matrix)[1]
        + np.einsum("rbc,bcd,rbd->rb", values.conj(), np.linalg.inv(matrix), values).real
        for matrix in matrices
    ]
    ratios = np.sum(response.weights * (costs[1] - costs[0]), axis=1)
    error = 4 * ratios.std() / np.sqrt(len(ratios))
    assert expected_gain(one, 0, duration) == pytest.approx(ratios.mean(), abs=error)
    assert error < 0.1 * ratios.mean()


def test_nothing_is_gained_from_a_mode_that_another_can_be():
    """Two modes of one pole and one shape respond like one; a little apart, they differ."""
    gains = []
    for apart in (0.0, 0.01, 0.2):
        pair = planted([4.0, 4.0 + apart], [0.02, 0.02])
        shapes = np.tile(pair.structure.shapes[:1], (2, 1))
        pair = pair._replace(structure=pair.structure._replace(shapes=shapes))
        gains.append(expected_gain(pair, 1, 300.0))
    assert abs(gains[0]) < 0.05
    assert gains[0] < TELLING_GAIN < gains[2] and gains[1] < gains[2]
    pair = planted([4.0, 4.2], [0.02, 0.02])
    errors = least_errors(pair, 300.0)
    assert not why_untold(pair, 1, errors, 300.0, gains[2])
    told = why_untold(pair, 1, errors, 300.0, abs(gains[0]))
    assert told.startswith("a model without it is as likely but for 0.0")
