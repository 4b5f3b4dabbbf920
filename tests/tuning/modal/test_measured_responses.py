"""Frequency responses to measured forces: closed forms of H1, H2, Hv; windows of impacts."""

import numpy as np
import pytest

import tuning
from tests.oracles.planted_structures import FINER, coloured_noise, response
from tests.tuning.modal.test_subspace import small_structure
from tuning import Log

RATE = 40.0


def gain_log(noise_in, noise_out):
    """A response of twice the force, with white noise in both."""
    random = np.random.default_rng(0)
    force, first, second = random.normal(size=(3, 40_000))
    values = np.stack([force + noise_in * first, 2 * force + 2 * noise_out * second], axis=1)
    return Log(
        np.arange(40_000) / RATE, values, ("f", "v1"), ("force", "velocity"), ("N", "m/s"), "gain"
    )


def hammer_log(seed=0, noise=0.02, duration=60.0):
    """Three impacts, a pulse of half a sine, and responses of a structure by finite elements."""
    structure = small_structure(0)
    fine = FINER * RATE
    forces = np.zeros((int(duration * fine), structure.inputs.shape[1]))
    for start in (0.02, 0.35, 0.68):
        first = int(start * len(forces))
        forces[first : first + 8, 0] = np.sin(np.pi * (np.arange(8) + 0.5) / 8)
    values = response(structure, forces, fine)[::FINER]
    values = values + noise * values.std() * coloured_noise(
        np.random.default_rng(seed), values.shape
    )
    # Mean force over a step, so that the pulse has its momentum.
    force = forces[:, 0].reshape(-1, FINER).mean(axis=1)
    log = Log(
        np.arange(len(values)) / RATE,
        np.column_stack([force, values]),
        ("hammer", "v1", "v2"),
        ("force", "velocity", "velocity"),
        ("N", "m/s", "m/s"),
        "hammer",
    )
    return structure, log


@pytest.mark.parametrize(
    ("estimator", "noise_in", "noise_out", "expected"),
    [
        ("H1", 0.0, 0.5, 2.0),
        ("H2", 0.0, 0.5, 2.0 * 1.25),
        ("Hv", 0.0, 0.5, 2.0 * 1.25**0.5),
        ("H1", 0.5, 0.0, 2.0 / 1.25),
        ("H2", 0.5, 0.0, 2.0),
        ("Hv", 0.5, 0.0, 2.0 / 1.25**0.5),
    ],
)
def test_noise_biases_as_theory_says(estimator, noise_in, noise_out, expected):
    found = tuning.modal.measured_responses(
        gain_log(noise_in, noise_out), estimator=estimator, segment=5.0
    )
    values, coherence = found.values[2:-2, 0, 0], found.coherence[2:-2, 0]
    np.testing.assert_allclose(np.mean(values), expected, rtol=0.01)
    np.testing.assert_allclose(np.mean(coherence), 1 / 1.25, atol=0.01)
    # Deviations (Bendat and Piersol): half the power of relative errors is in the magnitude.
    if estimator == "H1" and noise_out:
        spread = np.std(np.abs(values)) / expected
        averages = np.sqrt(found.averages / 399 * 1.5)  # overlap: fewer independent ones
        assert 0.7 < spread / (np.mean(found.deviations[2:-2]) * averages) < 1.4


def test_two_forces_are_told_apart():
    random = np.random.default_rng(1)
    forces = random.normal(size=(20_000, 2)) @ [[1.0, 0.4], [0.0, 1.0]]
    values = np.column_stack([forces, forces @ [2.0, -3.0]])
    log = Log(
        np.arange(20_000) / RATE, values, ("f1", "f2", "v"), ("force", "force", "velocity"),
        ("N", "N", "m/s"), "two",
    )  # fmt: skip
    found = tuning.modal.measured_responses(log)
    expected = np.tile([2.0, -3.0], (found.frequencies.size - 6, 1))
    np.testing.assert_allclose(found.values[3:-3, 0], expected, rtol=1e-6)
    with pytest.raises(ValueError, match="H2 is for one force, not 2; use H1"):
        tuning.modal.measured_responses(log, estimator="H2")


def test_windows_of_impacts(tmp_path):
    structure, log = hammer_log()
    plain = tuning.identify_modes(log, band=(2.0, 11.0))
    windowed = tuning.identify_modes(
        log, band=(2.0, 11.0), settings=tuning.ModalSettings(force_window=0.5)
    )
    for fit in (plain, windowed):
        np.testing.assert_allclose(fit.frequencies, structure.frequencies, rtol=2e-3)
        np.testing.assert_allclose(fit.damping_ratios, structure.damping_ratios, rtol=0.1)
    found = tuning.modal.measured_responses(log, exponential=4.0)
    assert found.averages == 3 and found.decay_rate == 0.25
    w = 2 * np.pi * structure.frequencies[0]
    assert found.true_damping_ratio(structure.frequencies[0], 0.02) == 0.02 - 0.25 / w
    found.plot(tmp_path / "responses.png")
    assert (tmp_path / "responses.png").stat().st_size > 10_000


def test_responses_to_impacts_are_those_of_the_structure():
    structure, log = hammer_log(noise=0.0)
    found = tuning.modal.measured_responses(log, exponential=3.0)
    w = 2 * np.pi * found.frequencies
    expected = 0
    for pole, shape, inputs in zip(
        structure.poles, structure.shapes, structure.inputs[:, 0], strict=True
    ):
        residue = -1j * pole / pole.imag
        s = 1j * w[:, None] - pole + found.decay_rate
        mirrored = 1j * w[:, None] - pole.conjugate() + found.decay_rate
        expected = expected + inputs * shape * (residue / s + residue.conjugate() / mirrored)
    near = np.abs(found.frequencies - structure.frequencies[0]) < 0.2
    # The pulse of the test is coarsely sampled: its size is free, the same for all lines.
    ratio = np.abs(found.values[near, :, 0]) / np.abs(expected[near])
    np.testing.assert_allclose(ratio, np.mean(ratio), rtol=0.03)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"estimator": "H3"}, "estimator must be H1, H2, Hv, not 'H3'"),
        ({"exponential": -1.0}, "the exponential window must last longer than 0 s"),
        ({"exponential": 1.0}, "windows are for impacts of a hammer"),
        ({"segment": 1e9}, "a segment of .* samples is not within"),
        ({"channels": ["v1"], "force": ["v1"]}, "which is no force"),
    ],
)
def test_mistakes(arguments, message):
    with pytest.raises(ValueError, match=message):
        tuning.modal.measured_responses(gain_log(0.0, 0.1), **arguments)
