"""Modes of whole records after impacts of unmeasured force, against sums of exponentials."""

import numpy as np
import pytest
from scipy.signal import decimate, lfilter, resample_poly

from experiments.validation.modal_identification import log_of
from tests.oracles.planted_structures import random_structure, sampled
from tuning import Log, identify_modes
from tuning.modal.decay.stretches import Stretch
from tuning.modal.forced.likelihood import linear_fit, refined_poles, whitened
from tuning.modal.forced.significance import criterion, criterion_with
from tuning.modal.impacts.impact_records import (
    FROM_AMBIENT,
    Impact,
    ImpactRecords,
    after_impacts,
    alike,
    from_early_impacts,
    from_rests,
    impact_modes,
    marked_impacts,
    response_in_band,
    with_missed_impacts,
)
from tuning.modal.impacts.whole_log import impacts_left_out
from tuning.modal.preprocessing import Samples
from tuning.modal.result import IdentifiedMode

RATE, BAND, FINER = 40.0, (0.5, 8.0), 8
FREQUENCIES, DAMPING = np.array([0.83, 1.46, 3.7, 6.3]), np.array([0.006, 0.0054, 0.003, 0.012])
POLES = 2 * np.pi * FREQUENCIES * (-DAMPING + 1j * np.sqrt(1 - DAMPING**2))
TIMES = (2.5, 14.9, 27.4, 39.0, 48.1)  # s; the slowest mode falls to 2/3 from one to the next


# Three modes that fall to a third in all of a minute, as sampled at 10 Hz.
SLOW_RATE, SLOW_TIMES = 10.0, (3.9, 15.1, 27.0, 40.3, 50.3)
SLOW_FREQUENCIES, SLOW_DAMPING = np.array([0.91, 1.25, 1.92]), np.array([0.0033, 0.0021, 0.0045])
COLUMNS = ("v1", "v2", "v3"), ("velocity",) * 3, ("m/s",) * 3
SLOW_POLES = 2 * np.pi * SLOW_FREQUENCIES * (-SLOW_DAMPING + 1j * np.sqrt(1 - SLOW_DAMPING**2))


def after(times, noise=0.1, seed=0, channels=3, duration=60.0, poles=POLES, rate=RATE):
    """Velocities of modes after impacts at some times (s), in closed form, with white noise."""
    random = np.random.default_rng(seed)
    shapes = random.normal(size=(poles.size, channels))
    fine = np.arange(int(duration * rate) * FINER) / (rate * FINER)
    values = np.zeros((fine.size, channels))
    for time in times:
        strengths = random.normal(size=poles.size)
        later = fine - time
        free = np.exp(np.multiply.outer(np.maximum(later, 0), poles)) * (later >= 0)[:, None]
        values += free.real @ (strengths[:, None] * shapes)
    values = resample_poly(values, 1, FINER, axis=0)  # without aliases, as sensors do
    return values + noise * values.std() * random.normal(size=values.shape)


def impacts(times):
    return tuple(Impact(0, int(round(time * RATE))) for time in times)


def test_poles_are_those_of_the_vibration():
    """With noise of a thousandth, a hundred times as certain as in logs."""
    found = impact_modes((after(TIMES, 1e-3),), RATE, BAND, impacts(TIMES), POLES)
    assert found is not None and len(found.impacts) == len(TIMES)
    poles = np.array([mode.pole for mode in found.modes])
    nearest = [poles[np.argmin(np.abs(poles - pole))] for pole in POLES]
    assert np.all(np.abs(nearest - POLES) < 1e-3 * np.abs(POLES.real))


@pytest.mark.parametrize("known", [0, 2, 5])
def test_impacts_are_found_where_the_vibration_tells_of_them(known):
    response = response_in_band((after(TIMES),), RATE, BAND)
    found = with_missed_impacts(response, impacts(TIMES[:known]), POLES)
    instants = [impact.sample / RATE for impact in found]
    # An eighth of a period of the highest frequency is not seen in the band.
    assert instants == pytest.approx(TIMES, abs=0.02 + 1 / RATE)


def test_no_impact_is_found_in_a_free_vibration():
    response = response_in_band((after(TIMES[:1])[int(TIMES[0] * RATE) :],), RATE, BAND)
    assert with_missed_impacts(response, (), POLES) == ()


def test_intervals_of_slow_modes_hold():
    """Modes that one impact excites and the next does not find at rest, lacking one pole."""
    inside, known, start = [], impacts(TIMES[1:4]), POLES[[0, 2, 3]]
    logs = [after(TIMES, 0.2, seed) for seed in range(8)]
    every = [impact_modes((values,), RATE, BAND, known, start) for values in logs]
    fits = [found for found in every if found is not None]
    assert len(fits) >= 7  # where a strong mode is not known impacts may be missed: said by None
    for found in fits:
        assert len(found.impacts) == len(TIMES)
        modes = sorted(found.modes, key=lambda mode: mode.frequency)
        assert [mode.frequency for mode in modes] == pytest.approx(FREQUENCIES, rel=0.005)
        for mode, frequency, damping in zip(modes, FREQUENCIES, DAMPING, strict=True):
            inside.append(abs(mode.frequency - frequency) < mode.quantile * mode.frequency_sd)
            inside.append(abs(mode.damping_ratio - damping) < mode.quantile * mode.damping_sd)
    # Of 56 intervals of 95 % eight or more miss the truth with a probability of 1 %.
    assert len(inside) >= 56 and sum(inside) > len(inside) - 8


def test_whole_records_tell_more_than_decays_of_one_length():
    """The slowest mode needs all of the record; the excitation is named, and shares are sums."""
    fit = identify_modes(Log(np.arange(2400) / RATE, after(TIMES), *COLUMNS), band=BAND)
    assert fit.kind == "free decay" and fit.frequencies == pytest.approx(FREQUENCIES, rel=0.001)
    assert "5 impacts, between which records are fitted as a whole" in str(fit)
    widths = np.ptp(fit.damping_intervals, axis=1) / fit.damping_ratios
    assert np.all(widths < 0.2)  # decays side by side miss the third mode
    assert all(0.01 < mode.energy_share < 1.2 for mode in fit.modes)


def slow(seed, noise=0.15):
    return after(SLOW_TIMES, noise, seed, poles=SLOW_POLES, rate=SLOW_RATE)


@pytest.mark.parametrize("seed", [6, 8, 9])
def test_impacts_are_found_where_no_decay_is_seen(seed):
    """Modes that hardly fall from one impact to the next look like ambient vibration."""
    fit = identify_modes(Log(np.arange(600) / SLOW_RATE, slow(seed), *COLUMNS))
    assert fit.kind == "free decay" and fit.method == "decay"
    assert fit.frequencies == pytest.approx(SLOW_FREQUENCIES, rel=0.003)
    assert "5 impacts, between which records are fitted as a whole" in str(fit)
    within = fit.damping_intervals
    assert np.all((within[:, 0] < SLOW_DAMPING) & (within[:, 1] > SLOW_DAMPING))


def test_ambient_vibration_has_no_impacts():
    """White noise in place of impacts, of the same modes for as long."""
    random = np.random.default_rng(3)
    forces = random.normal(size=(6000, SLOW_POLES.size))
    filtered = [
        lfilter([1.0], [1.0, -np.exp(pole / 100)], force).real
        for pole, force in zip(SLOW_POLES, forces.T, strict=True)
    ]
    values = decimate(np.stack(filtered, axis=1) @ random.normal(size=(3, 3)), 10, axis=0)
    values += 0.1 * values.std() * random.normal(size=values.shape)
    fit = identify_modes(Log(np.arange(len(values)) / SLOW_RATE, values, *COLUMNS))
    assert fit.kind == "ambient" and "impacts," not in str(fit)
    assert impact_modes((values,), SLOW_RATE, (0.5, 2.6), (), SLOW_POLES, FROM_AMBIENT) is None


def test_records_begin_at_the_end_of_an_early_rest():
    """The first impact is not sought; no vibration from the start on fits the rest before it."""
    values = slow(0, 0.05)
    found = impact_modes((values,), SLOW_RATE, (0.5, 2.6), (), SLOW_POLES[:2], FROM_AMBIENT)
    assert found is not None
    assert [impact.sample / SLOW_RATE for impact in found.impacts] == pytest.approx(
        SLOW_TIMES, abs=0.6
    )


@pytest.mark.parametrize("louder, begin", [(1.0, 0), (4.0, 40), (0.25, 0)])
def test_a_rest_ends_where_errors_become_less(louder, begin):
    """Noise of another level for the first four seconds of a minute."""
    noise = np.random.default_rng(5).normal(size=(600, 3))
    noise[:40] *= louder
    response = response_in_band((noise,), SLOW_RATE, (0.5, 4.0))
    later = from_rests(ImpactRecords((noise,), (0,), ()), response, response.lines)
    assert later.begins[0] == pytest.approx(begin, abs=4)
    assert len(later.records[0]) == 600 - later.begins[0]
    # Records that begin at an impact have no rest.
    struck = ImpactRecords((noise,), (1,), (Impact(0, 300),))
    assert from_rests(struck, response, response.lines).begins == (1,)


def test_impacts_are_counted_in_samples_of_whole_records():
    records = np.zeros((100, 1)), np.zeros((100, 1))
    struck = ImpactRecords(
        records, (0, 0), (Impact(0, 4), Impact(0, 7), Impact(0, 50), Impact(1, 60))
    )
    later = from_early_impacts(struck)
    assert later.begins == (7, 0) and later.impacts == (Impact(0, 43), Impact(1, 60))
    assert later.every_impact() == (Impact(0, 7), Impact(0, 50), Impact(1, 60))


def test_poles_leave_a_start_that_hardly_decays():
    """Steps are compared with the distance of lines, too: less is not told from nothing."""
    lines = after_impacts(response_in_band((after(TIMES),), RATE, BAND), impacts(TIMES))
    starts = np.append(POLES.imag[:3] * (1j - 1e-6), POLES[3])
    found = refined_poles(lines, starts, np.arange(POLES.size))
    assert np.all(np.abs(found - POLES) < 0.15 * np.abs(POLES.real))


def test_a_crossing_load_is_no_impact():
    planted = sampled(random_structure(1), "crossing", 1, 60.0)
    structure = planted.structure
    damped = np.sqrt(1 - structure.damping_ratios**2)
    poles = 2 * np.pi * structure.frequencies * (-structure.damping_ratios + 1j * damped)
    band = (0.6 * structure.frequencies[0], 1.3 * structure.frequencies[-1])
    assert impact_modes((planted.values,), planted.rate, band, (), poles) is None
    assert "impacts," not in str(identify_modes(log_of(planted)))


def test_one_impact_or_many_are_left_to_decays():
    assert impact_modes((after(TIMES[:1]),), RATE, BAND, impacts(TIMES[:1]), POLES) is None
    many = tuple(Impact(0, 100 * k) for k in range(1, 24))
    assert impact_modes((after(TIMES),), RATE, BAND, many, POLES) is None


def test_a_first_choice_has_the_criterion_of_a_fit_with_the_pole():
    lines = whitened(
        after_impacts(response_in_band((after(TIMES),), RATE, BAND), impacts(TIMES)), POLES
    )
    fit = linear_fit(lines, POLES[:3])
    with_it = criterion(linear_fit(lines, POLES), 4)
    assert criterion_with(lines, fit, 3, complex(POLES[3])) == pytest.approx(with_it, rel=1e-9)


def two_impacts(first=3.0, second=6.0):
    """Samples of a mode of 4 Hz, struck hard at 3 s and softly at another time, and the marks."""
    rate = 100.0
    times = np.arange(1200) / rate
    since = np.maximum(times - np.array([[first], [second]]), 0.0)
    parts = np.exp(-0.8 * since) * np.sin(2 * np.pi * 4.0 * since)
    marks = np.isin(np.arange(times.size), [int(first * rate), int(second * rate)])
    return Samples(((parts[0] + 0.1 * parts[1])[:, None],), (10.0,), rate, ()), (marks,)


@pytest.mark.parametrize(
    ("second", "starts", "said"),
    [
        (6.0, (302, 602), ""),
        (6.0, (602,), "is left out: what follows it is not the free decay that tells most"),
        (4.5, (452,), "is left out: the next impact comes 1.5 s later"),
    ],
)
def test_a_hard_impact_whose_decay_is_not_used_is_named(second, starts, said):
    samples, marks = two_impacts(second=second)
    decays = [Stretch(0, start, start + 250, 2.0) for start in starts]
    found = impacts_left_out(samples, marks, decays, (2.0, 10.0))
    assert found == ([f"the hardest impact, at 13 s, {said}"] if said else [])
    assert impacts_left_out(samples, (np.zeros(1200, bool),), decays, (2.0, 10.0)) == []


def test_marks_of_an_impact_and_its_rebounds_are_one():
    marks = np.zeros(4000, bool)
    for start, stop in ((400, 409), (430, 436), (2000, 2010), (3000, 3500)):
        marks[start:stop] = True
    found = marked_impacts((marks,), 100.0, (1.0, 20.0))
    assert found == (Impact(0, 404), Impact(0, 2004))  # what lasts for seconds is no impact


@pytest.mark.parametrize(
    ("frequency", "shape", "share", "same"),
    [(3.01, (1, 1), 0.5, True), (3.2, (1, 1), 0.5, False), (3.01, (1, -1), 0.5, False),
     (3.01, (1, -1), 0.01, True)],
)  # fmt: skip
def test_modes_are_alike_within_their_bandwidths(frequency, shape, share, same):
    def mode(frequency, shape, share):
        return IdentifiedMode(
            frequency, 1e-4, 0.01, 1e-3, share, np.array(shape, complex), np.eye(4)
        )

    assert alike(mode(frequency, shape, share), mode(3.0, (1, 1), 0.5)) == same
