"""The validation page: its checks pass, and errors above their tolerance are marked."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import jaxbeam as jb
from experiments.validation import random_cases
from experiments.validation.__main__ import GROUPS
from experiments.validation.checks import Check, validation_page
from experiments.validation.least_errors import (
    TELLING_GAIN,
    expected_gain,
    least_errors,
    least_errors_of_decays,
    least_errors_of_forced,
    random_response,
    why_unidentifiable,
)
from experiments.validation.modal_methods import PYOMA, ours, pyoma, table
from experiments.validation.modal_setups import HEADER, REFERENCES, assess, planted_setups
from experiments.validation.random_cases import (
    Errors,
    Outcome,
    TooLongError,
    at_most,
    beside_scipy,
    contact_faults,
    draw,
)
from tests.oracles.planted_structures import (
    Planted,
    Structure,
    noise_spectrum,
    random_structure,
    sampled,
)
from tests.tuning.modal.test_ambient import small_structure


@pytest.mark.parametrize(
    ("error", "mark", "count"),
    [(1e-9, "within", 1), (1e-3, "**above**", 0), (float("nan"), "**above**", 0)],
)
def test_page_marks_errors_above_their_tolerance(error, mark, count):
    text = validation_page([("A group", [Check("peaks", "closed form", error, 1e-6)])])
    assert f"**{count} of 1 errors" in text
    assert "## A group" in text
    assert f"| peaks | closed form | {error:.1e} | 1e-06 | {mark} |" in text


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.__name__)
@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_errors_are_within_their_tolerances(group):
    checks = list(group())
    assert checks and all(check.passed for check in checks), checks


# Least errors of planted modes against the law of long data, and what logs do not tell.

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
        return why_unidentifiable(one, 0, least_errors(one, duration), duration)

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
    assert not why_unidentifiable(pair, 1, errors, 300.0, gains[2])
    told = why_unidentifiable(pair, 1, errors, 300.0, abs(gains[0]))
    assert told.startswith("a model without it is as likely but for 0.0")


# Checks of random cases: what is left is taken up again, and what is wrong is told.


def test_cases_that_took_too_long_are_taken_up_again_with_a_longer_limit(tmp_path, monkeypatch):
    """Case i takes i seconds."""
    asked = []

    def check(seed, index, longest, plain):
        asked.append(index)
        seconds = min(index, longest)
        return Outcome(index, modes=3, seconds=seconds, unfinished=index > longest)

    monkeypatch.setattr(random_cases, "check", check)
    file = tmp_path / "outcomes.jsonl"
    for longest, new in ((1.0, [0, 1, 2, 3]), (1.0, []), (2.5, [2, 3])):
        asked.clear()
        outcomes = random_cases.outcomes_of(1, 4, file, longest=longest)
        assert asked == new
    assert [one.unfinished for one in outcomes] == [False, False, False, True]


def test_time_is_over_where_the_code_raises_something_else():
    """As code does that catches all there is."""
    with pytest.raises(TooLongError), at_most(0.01):
        try:
            while True:
                pass
        except Exception:
            raise UnboundLocalError from None


def test_an_error_above_the_stated_one_is_told(capsys):
    good = [Outcome(i, modes=2, stated=4e-8, true=2e-8, by_scipy=2e-8) for i in range(5)]
    bad = Outcome(5, modes=2, stated=4e-8, true=2e-8, by_scipy=5e-8)
    assert not random_cases.broken_laws(good)
    assert random_cases.broken_laws([*good, bad]) == [
        "the true error exceeds the stated one in cases 5"
    ]
    assert random_cases.broken_laws([bad._replace(true=None, by_scipy=None)]) == []
    random_cases.print_outcomes([*good, bad])
    assert "exceeds the stated one in 1 of 6 cases" in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore::jaxbeam.simulation.simulate.ContactLossWarning")
def test_a_wrong_verdict_is_found():
    """A mass that leaves the beam, as it is told and as if it left later."""
    drawn = draw(5, 16)
    record = jb.simulate(drawn.case)
    assert np.isfinite(record.contact_lost_time).any()
    later = dataclasses.replace(record, contact_lost_time=record.contact_lost_time + 0.05)
    (error, right), (_, wrong) = (beside_scipy(drawn, each) for each in (record, later))
    assert error <= record.error_estimate
    assert right == []
    assert any("pulls by" in fault for fault in wrong)


def test_a_dip_within_the_errors_may_be_taken_for_the_loss():
    """A force that only steps' errors make negative at first, and one that never is."""
    times = np.linspace(0.0, 1.0, 101)
    record = SimpleNamespace(
        contact_lost_time=np.array([0.2]), lowest_contact_force=np.array([-1.0]), verdict=""
    )
    dips = np.where(times < 0.2, 5.0, np.where(times < 0.25, 1e-4, 5.0))[:, None]
    wide = Errors(force=1e-3, time=0.3)
    assert not contact_faults(record, times, dips, wide)
    narrow = Errors(force=1e-5, time=0.01)
    assert "presses with 0.0001 N" in contact_faults(record, times, dips, narrow)[0]


# The side-by-side comparison with pyOMA-2.


@pytest.mark.filterwarnings("ignore")
def test_both_programs_find_the_modes_of_a_structure():
    pytest.importorskip("pyoma2")
    planted = sampled(small_structure(0), "ambient", 0, 100.0)
    found = {PYOMA: [pyoma(planted)], "covariance": [ours(planted, "covariance")]}
    for (one,) in found.values():
        assert np.all(np.abs(one.errors) < [0.01, 0.5])
    result = table([planted], found)
    assert [row[1] for row in result.rows] == ["3 of 3", "3 of 3"]
    assert all(len(row) == len(result.header) for row in result.rows)


# The table of modes from several setups.

SEED = 57  # of a structure of three modes and six channels


def test_setups_share_the_references_and_have_all_channels_together():
    structure = random_structure(SEED)
    setups = planted_setups("decay", SEED)
    assert [len(own) for _, own in setups] == [4, 4]
    channels = [own for _, own in setups]
    assert set().union(*channels) == set(range(structure.shapes.shape[1]))
    assert set.intersection(*map(set, channels)) == set(REFERENCES)
    for planted, own in setups:
        np.testing.assert_array_equal(planted.structure.shapes, structure.shapes[:, own])


def test_a_row_of_the_table():
    row = assess("decay", [SEED])
    assert len(row) == len(HEADER)
    found, strong = (int(word) for word in row[1].split(" of "))
    assert found == strong > 1 and row[6] == "0"
    assert float(row[8]) < 0.2
