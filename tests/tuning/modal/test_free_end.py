"""Where the free end of a record begins: forces on planted modes to an instant, then none."""

import numpy as np
import pytest
from scipy.signal import lfilter

from experiments.validation.modal_identification import compare, log_of
from tests.oracles.planted_structures import random_structure, sampled
from tuning.modal.decay.free_end import free_end
from tuning.modal.identify_modes import identify_modes

RATE, CYCLE, COUNT = 20.0, 7.0, 1200


def forced(forces, noise=0.1, seed=0):
    """Two channels of modes of 2.7 and 2.9 Hz under forces, with white noise."""
    clean = 0.0
    for frequency, ratio, shape in ((2.7, 0.03, (1.0, 0.6)), (2.9, 0.008, (0.8, -1.0))):
        pole = np.exp(2 * np.pi * frequency * (-ratio + 1j) / RATE)
        clean = clean + np.multiply.outer(np.real(lfilter([1.0], [1.0, -pole], forces)), shape)
    random = np.random.default_rng(100 + seed)
    return clean + noise * np.std(clean) * random.normal(size=clean.shape)


def white(seed, until=COUNT):
    """White forces to a sample."""
    return np.random.default_rng(seed).normal(size=COUNT) * (np.arange(COUNT) < until)


@pytest.mark.parametrize("seed", range(6))
def test_the_free_end_begins_where_forces_end(seed):
    found = free_end(forced(white(seed, until=600), seed=seed), CYCLE, 1.0)
    assert found is not None
    step = COUNT // 60  # the end begins one or two of them late, lest it begins early
    assert 600 - step <= found <= 600 + 2 * step


@pytest.mark.parametrize("seed", range(4))
def test_lasting_forces_and_noise_have_no_free_end(seed):
    assert free_end(forced(white(seed), seed=seed), CYCLE, 1.0) is None
    noise = np.random.default_rng(seed).normal(size=(COUNT, 2))
    assert free_end(noise, CYCLE, 1.0) is None


def test_the_free_end_of_what_follows_a_blow():
    """One that begins with the blow is known; forces after it are not."""
    record = forced(white(1, until=600), seed=1)
    step = COUNT // 60
    for since, known in ((0, False), (200, False), (590, True)):
        found = free_end(record, CYCLE, 1.0, since)
        assert (found is None) == known
        assert known or 600 - step <= found <= 600 + 2 * step


def test_the_free_end_is_found_within_cycles():
    """A mode that decays within four cycles, and one of half its energy that lasts."""
    late = []
    for seed in range(8):
        found = free_end(forced(white(20 + seed, until=600), noise=0.03, seed=seed), CYCLE, 1.0)
        late.append((found - 600) / CYCLE)
    assert np.median(np.abs(late)) < 2.0, late


def test_steady_hum_is_no_decay():
    """A load that leaves, but a hum that stays, of nearly all the energy that is left."""
    hum = np.cos(2 * np.pi * 3.3 * np.arange(COUNT) / RATE)[:, None] * [1.0, 1.0]
    noise = np.random.default_rng(0).normal(size=(COUNT, 2))
    loud = np.where(np.arange(COUNT) < 600, 3.0, 1.0)[:, None]
    assert free_end(hum + 0.2 * loud * noise, CYCLE, 1.0) is None


def test_a_decay_from_the_beginning_has_no_forces_before_it():
    forces = np.zeros(COUNT)
    forces[0] = 1.0
    assert free_end(forced(forces), CYCLE, 1.0) is None


def test_records_without_noise_or_vibration_are_no_trouble():
    forces = np.zeros(COUNT)
    forces[0] = 1.0
    clean = forced(forces, noise=0.0)
    assert free_end(clean, CYCLE, 1.0) is None
    assert free_end(np.zeros((COUNT, 2)), CYCLE, 1.0) is None
    one_dead = forced(white(1, until=600)) * [1.0, 0.0]
    assert free_end(one_dead, CYCLE, 1.0) in range(560, 681)


@pytest.mark.parametrize("seed", [967, 971])
def test_close_modes_after_a_load_that_excites_little_at_a_time(seed):
    """Planted by finite elements: errors of prediction do not tell when the load has left."""
    planted = sampled(random_structure(seed), "crossing", seed, 60.0)
    fit = identify_modes(log_of(planted))
    compared = compare(fit, planted)
    assert fit.kind == "free decay"
    assert all(compared.found)
    assert not compared.false_modes
