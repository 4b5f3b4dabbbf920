"""Free decays of planted structures: found between impacts, and fitted together."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from experiments.validation.modal_identification import compare, log_of
from tests.oracles.planted_structures import Structure, random_structure, response, sampled
from tuning import Log, identify_modes
from tuning.modal.decay import modes as decay_modes
from tuning.modal.decay.excitation import Impact, impacts_left_out, marked_impacts
from tuning.modal.decay.stretches import (
    Stretch,
    excited_samples,
    free_decays,
    or_most_informative,
    stacked,
    until_soft_impact,
)
from tuning.modal.harmonics import harmonic_lines
from tuning.modal.preprocessing import Samples, kinetic_band, prepare, strongest_frequency


def structure(damping=(0.01, 0.03, 0.008)):
    """Three modes in two channels, by finite elements but for frequencies and damping."""
    whole = random_structure(1)
    frequencies = np.array([4.0, 6.0, 9.0])
    return Structure(frequencies, np.array(damping), whole.shapes[:3, :2], whole.inputs[:3])


@pytest.mark.parametrize(
    ("kind", "duration"), [("impacts", 40.0), ("decay", 15.0), ("crossing", 30.0)]
)
def test_modes_of_planted_decays(kind, duration):
    """All strong modes, no false one, and truths within the intervals, for several excitations."""
    found = []
    for seed in range(3):
        planted = sampled(structure(), kind, seed, duration)
        fit = identify_modes(log_of(planted))
        assert fit.kind == "free decay" and len(fit.windows) >= (2 if kind == "impacts" else 1)
        found.append(compare(fit, planted))
    assert all(seen for one in found for seen in one.found)
    assert not any(one.false_modes for one in found)
    covered = np.concatenate([one.covered for one in found])
    # Of 12 to 18 intervals of 95 %, four or more miss the truth with a probability of 1 %.
    assert covered.size >= 12 and covered.sum() >= covered.size - 3, covered


def struck(times, rate=800.0, duration=10.0):
    """Velocities of heavily damped modes under impacts at some times (s), finely sampled."""
    random = np.random.default_rng(0)
    forces = np.zeros((int(duration * rate), 4))
    for time in times:
        contact = np.sin(np.pi * np.arange(1, 5) / 5)  # 5 ms
        forces[int(time * rate) : int(time * rate) + 4, random.integers(4)] = contact
    planted = structure((0.03, 0.03, 0.02))
    clean = response(planted, forces, rate)
    return planted, clean + 0.02 * clean.std() * random.normal(size=clean.shape)


def test_instants_of_impacts_whatever_the_band():
    times = (1.0, 2.7, 3.9, 6.1, 8.0)
    _, values = struck(times)
    marks = excited_samples(values, 800.0, 1 / 6.0)
    instants = np.flatnonzero(marks) / 800
    assert np.all(np.min(np.abs(instants[:, None] - times), axis=1) < 0.02)
    assert np.all(np.min(np.abs(instants[:, None] - times), axis=0) < 0.02)
    decays = free_decays((marks,), (values,), 800.0, 6.0)
    np.testing.assert_allclose([one.start / 800 for one in decays], times[:5], atol=0.02)


def test_decays_after_impacts_in_quick_succession_are_used_together():
    planted, values = struck((1.0, 2.7, 3.9, 6.1, 8.0))
    log = log_of(planted_log := sampled(planted, "decay", 0, 10.0))
    log = type(log)(
        np.arange(len(values)) / 800, values, log.names, log.quantities, log.units, "struck"
    )
    for band in (None, (2.0, 12.0)):
        fit = identify_modes(log, band=band)
        assert fit.kind == "free decay" and len(fit.windows) == 5
        np.testing.assert_allclose(fit.frequencies, planted_log.structure.frequencies, rtol=5e-3)
        np.testing.assert_allclose(fit.damping_ratios, [0.03, 0.03, 0.02], rtol=0.1)


@pytest.mark.parametrize("seed", [512, 518])
def test_a_record_that_begins_with_an_impact_is_a_decay(seed):
    """Close modes beat, or the decay is over within a tenth of the record."""
    planted = sampled(random_structure(seed), "decay", seed, 20.0)
    quiet, velocities = (np.zeros(len(planted.values), bool),), (1,) * planted.values.shape[1]
    band = kinetic_band((planted.values,), planted.rate, velocities)
    prepared = prepare((planted.values,), (0.0,), planted.rate, band)
    frequency = strongest_frequency(prepared.records, prepared.rate, velocities, band)
    (found,) = free_decays(quiet, prepared.records, prepared.rate, frequency)
    assert found.start == 0


@pytest.mark.parametrize(
    ("shift", "impacts"), [(0.0, [1.0]), (0.01, [1.0]), (0.01, [1.0, 0.7]), (0.04, [1.0])]
)
def test_what_nonlinearity_adds_is_no_mode(shift, impacts):
    """Cubic stiffness raises the first frequency by 1 or 4 %: the response has a part that decays
    as the cube of the rest, three times as fast, and may have more energy than the rest."""
    times, omega, damping = np.arange(1500) / 100, 2 * np.pi * 3.7, 0.008

    def slope(_, state):
        force = omega**2 * (state[0] + 8 / 3 * shift * state[0] ** 3)
        return [state[1], -2 * damping * omega * state[1] - force]

    values, state = [], np.zeros(2)
    for impact in impacts:
        start = [state[0] + impact, state[1]]
        solved = solve_ivp(slope, (0, 15), start, t_eval=times, rtol=1e-7, atol=1e-9)
        state = solved.y[:, -1]
        values.append(np.outer(solved.y[0], [1.0, 0.7]))
    values = np.concatenate(values)
    values = values + 0.02 * np.random.default_rng(0).normal(size=values.shape)
    times = np.arange(len(values)) / 100
    log = Log(times, values, ("d1", "d2"), ("deflection",) * 2, ("m",) * 2)
    fit = identify_modes(log, band=(1.0, 12.0))
    assert len(fit.windows) == len(impacts)
    assert fit.kind == "free decay" and fit.frequencies == pytest.approx([3.7], rel=0.005)
    assert ("nonlinearity" in str(fit)) == (shift > 0)


@pytest.mark.parametrize(("power", "is_mode"), [(1, True), (3, False)])
def test_a_fast_decay_beside_a_slow_one_grows_as_its_cube_or_is_a_mode(power, is_mode):
    """After three impacts of different strength at one place, close modes keep their proportion."""
    times, random = np.arange(1500) / 100, np.random.default_rng(0)
    slow = np.exp((-0.2 + 2j * np.pi * 3.7) * times)
    fast = np.exp((-0.6 + 2j * np.pi * 3.76) * times + 1j)
    impacts = [1.0, 0.5, 0.7]
    values = np.concatenate(
        [(impact * slow + 0.4 * impact**power * fast).real for impact in impacts]
    )
    values += 0.01 * random.normal(size=values.size)
    fit = identify_modes(one_channel(np.arange(values.size) / 100, values), band=(1.0, 12.0))
    assert len(fit.windows) == 3
    assert fit.frequencies == pytest.approx([3.7, 3.76] if is_mode else [3.7], rel=0.005)
    assert ("nonlinearity" in str(fit)) != is_mode


def test_a_lightly_damped_decay_is_no_harmonic_line():
    times = np.arange(2000) / 100
    noise = 0.05 * np.random.default_rng(0).normal(size=(2000, 1))
    decay = np.exp(-0.04 * times)[:, None] * np.cos(2 * np.pi * 3.3 * times)[:, None]
    assert harmonic_lines(noise + decay, 100.0, (1.0, 40.0)) == ()


def test_band_of_a_pair_that_fills_an_octave_and_of_a_short_decay():
    """Eleven seconds resolve the pair in few bins; the highest mode lasts for a tenth of these."""
    times = np.arange(1100) / 100
    parts = [(2.5, 0.002, 1.0), (2.75, 0.004, 1.0), (20.0, 0.02, 2.0)]
    values = sum(
        size * np.exp(-2 * np.pi * f * z * times) * np.cos(2 * np.pi * f * times)
        for f, z, size in parts
    )
    low, high = kinetic_band((values[:, None],), 100.0, (1,))
    assert low < 2.4 and 21.0 < high < 40.0


def test_all_of_many_decays_are_used():
    """Principal combinations of ten decays in eight channels: 24 columns of the same poles."""
    random = np.random.default_rng(0)
    modes = np.exp(np.multiply.outer(np.arange(200) / 50.0, np.array([-0.3 + 20j, -0.5 + 33j])))
    shapes = random.normal(size=(2, 8))
    records = tuple(
        np.real((modes * np.exp(1j * random.normal(size=2))) @ shapes) for _ in range(10)
    )
    columns, used = stacked(records, tuple(Stretch(i, 0, 200, 2.0) for i in range(10)))
    assert len(used) == 10 and columns.shape == (200, 24)
    basis = np.concatenate([modes.real, modes.imag], axis=1)
    fitted = basis @ np.linalg.lstsq(basis, columns, rcond=None)[0]
    np.testing.assert_allclose(columns, fitted, atol=1e-9)
    energy, whole = np.sum(columns**2), sum(np.sum(record**2) for record in records)
    assert 0.95 * whole < energy <= 1.001 * whole


def test_one_long_decay_is_used_alone_where_short_ones_tell_little():
    """Twenty seconds after a hard impact, and a second after each of five feeble ones."""
    random, times = np.random.default_rng(0), np.arange(2000) / 100
    record = 1e-3 * random.normal(size=(2600, 1))
    record[:2000, 0] += np.exp(-0.2 * times) * np.cos(20 * times)
    taps = [Stretch(0, 2000 + 100 * i, 2100 + 100 * i, 2.0) for i in range(5)]
    feeble = 0.02 * np.exp(-2 * times[:100]) * np.cos(20 * times[:100])
    for tap in taps:
        record[tap.start : tap.stop, 0] += feeble
    long = Stretch(0, 0, 2000, 4.0)
    columns, used = stacked((record,), (long, *taps))
    assert used == (long,) and columns.shape == (2000, 1)
    columns, used = stacked((record,), tuple(taps))
    assert used == tuple(taps) and columns.shape == (100, 5)


def test_the_method_says_whether_a_log_is_a_decay():
    log = log_of(sampled(random_structure(932), "decay", 932, 30.0))
    chosen = identify_modes(log)
    named, other = (identify_modes(log, method=method) for method in (chosen.method, "covariance"))
    assert chosen.method == "decay" and named.kind == "free decay"
    np.testing.assert_array_equal(named.frequencies, chosen.frequencies)
    assert (other.kind, other.method) == ("ambient", "covariance")


def test_a_decay_after_a_strong_excitation_counts():
    """One channel of a planted structure, whose decay holds a tenth of the energy of the log."""
    planted = sampled(random_structure(933), "crossing", 933, 60.0)
    fit = identify_modes(log_of(planted))
    assert fit.kind == "free decay", str(fit)
    np.testing.assert_allclose(fit.frequencies, planted.structure.frequencies[:2], rtol=2e-3)


def test_a_part_that_forces_still_act_in_after_three_cuts_is_no_decay(monkeypatch):
    """Unless the user says that it is one."""
    log = log_of(sampled(structure(), "decay", 0, 15.0))
    assert identify_modes(log).kind == "free decay"

    def later(decays, *_, **__):
        cuts.append(decays[0].start)
        return (decays[0]._replace(start=decays[0].start + 20), *decays[1:])

    cuts: list[int] = []
    monkeypatch.setattr(decay_modes, "without_excitation", later)
    assert identify_modes(log).kind == "ambient"
    assert cuts == [0, 20, 40, 60] * (len(cuts) // 4)  # of each band that is tried
    assert identify_modes(log, kind="free decay").kind == "free decay"


def test_a_mode_of_ambient_response_that_falls_by_chance_is_no_decay():
    """Its fit had six poles without damping beside the mode, and lacked the other mode."""
    planted = sampled(random_structure(2212), "ambient", 2212, 300.0)
    fit = identify_modes(log_of(planted))
    one = compare(fit, planted)
    assert fit.kind == "ambient" and not one.missed and not one.false_modes


@pytest.mark.parametrize(("soft_impact", "stops_before"), [(5.0, 5.0), (None, 10.0)])
def test_a_decay_ends_where_an_impact_too_soft_to_be_found_adds_to_it(soft_impact, stops_before):
    """Neither do the beats of close modes end it, which make the energy rise ten times."""
    times = np.arange(2000) / 200
    decays = [
        size * np.exp(-0.3 * times) * np.sin(2 * np.pi * f * times + 1)
        for f, size in ((8.0, 1.0), (8.4, 0.7))
    ]
    record = np.sum(decays, axis=0)
    if soft_impact is not None:
        late = times - soft_impact
        record += np.where(late > 0, np.exp(-0.3 * late) * np.sin(2 * np.pi * 8.0 * late), 0)
    marks = np.zeros(times.size, bool)
    marks[1] = True
    found, *others = free_decays((marks,), (record[:, None],), 200.0, 8.2)
    assert stops_before - 1.0 < found.stop / 200 <= stops_before
    # The soft impact begins another decay, a cycle or two later.
    instants = [] if soft_impact is None else [soft_impact + 1.5 / 8.2]
    np.testing.assert_allclose([one.start / 200 for one in others], instants, atol=1 / 8.2)
    until = until_soft_impact(record[:, None], 50) / 200
    assert stops_before - 1.0 < until <= stops_before


def test_noise_long_after_a_decay_is_no_part_of_it():
    """Two modes, of which the weaker lasts longer, in noise for twenty times as long."""
    times = np.arange(60_000) / 200
    record = np.random.default_rng(0).normal(scale=0.03, size=(times.size, 2))
    for frequency, rate, size in ((8.0, 1.0, 1.0), (11.0, 0.3, 0.1)):
        record += size * (np.exp(-rate * times) * np.sin(2 * np.pi * frequency * times))[:, None]
    marks = np.zeros(times.size, bool)
    marks[1] = True
    (found,) = free_decays((marks,), (record,), 200.0, 8.0)
    assert 3 / 0.3 < found.stop / 200 < 8 / 0.3


@pytest.mark.parametrize("first", [0.5, 1.0])
def test_the_first_of_several_impacts_may_be_the_softest(first):
    """By the energy alone, which is the first to tell of a structure at rest."""
    times = np.arange(6000) / 100
    record = 0.01 * np.random.default_rng(0).normal(size=times.size)
    for impact, size in ((4.0, first), (22.0, 1.0), (41.0, 1.0)):
        since = np.maximum(times - impact, 0.0)
        record += size * np.exp(-0.3 * since) * np.sin(2 * np.pi * 4.0 * since)
    found = free_decays((np.zeros(times.size, bool),), (record[:, None],), 100.0, 4.0)
    assert [one.start / 100 for one in found] == pytest.approx([4.0, 22.0, 41.0], abs=0.5)


def test_noise_between_hard_impacts_is_no_soft_impact():
    """Energy is that of two cycles of a fast mode, of few samples: that of noise varies."""
    times, impacts = np.arange(5000) / 80, np.array([3.0, 18.0, 33.0, 48.0])
    since = np.maximum(times - impacts[:, None], 0.0)
    motion = np.sum(np.exp(-1.0 * since) * np.sin(2 * np.pi * 20.3 * since), axis=0)
    marks = np.isin(np.arange(times.size), np.round(impacts * 80))
    for seed in range(6):
        noise = 0.02 * np.random.default_rng(seed).normal(size=times.size)
        found = free_decays((marks,), ((motion + noise)[:, None],), 80.0, 20.3)
        assert [one.start / 80 for one in found] == pytest.approx(impacts.tolist(), abs=0.1)


@pytest.mark.parametrize("rest", [0.0, 2.0])
def test_the_rest_before_an_impact_that_was_not_found_is_no_part_of_its_decay(rest):
    times = np.arange(6000) / 200 - rest
    decay = np.where(times >= 0, np.exp(-0.5 * times) * np.cos(2 * np.pi * 8.0 * times), 0.0)
    record = decay + np.random.default_rng(0).normal(scale=0.01, size=times.size)
    # The log has twice the samples of the band.
    (found,) = free_decays((np.zeros(2 * times.size, bool),), (record[:, None],), 200.0, 8.0)
    assert rest <= found.start / 400 <= rest + 2 / 8.0


def test_the_energy_tells_of_impacts_but_makes_none_of_ambient_vibration():
    """A mode of 4 Hz after three impacts in noise, and under forces: its energy rises, too."""
    times, ratio, count = np.arange(3000) / 50, 0.01, 0
    since = times - np.array([[4.0], [22.0], [41.0]])
    decays = np.exp(-2 * np.pi * 4 * ratio * since) * np.sin(2 * np.pi * 4 * since)
    random = np.random.default_rng(0)
    noise = 0.02 * random.normal(size=times.size)
    fit = identify_modes(one_channel(times, np.where(since > 0, decays, 0.0).sum(axis=0) + noise))
    assert [round(start) for start, _ in fit.windows] == [4, 22, 41]
    assert [mode.frequency for mode in fit.modes] == pytest.approx([4.0], rel=1e-3)
    pole = np.exp(2 * np.pi * 4 * (1j - ratio) / 50)
    for seed in range(12):
        forces = np.random.default_rng(seed).normal(size=times.size)
        log = one_channel(times, np.real(lfilter([1.0], [1.0, -pole], forces)))
        unmarked = (np.zeros(times.size, bool),)
        count += len(free_decays(unmarked, (log.values,), 50.0, 4.0)) > 1
        assert len(identify_modes(log).windows) == 1
    assert count  # the energy alone does not tell


def one_channel(times, values):
    """A log of one acceleration."""
    return Log(times, values[:, None], ("a",), ("acceleration",), ("m/s^2",))


def test_a_mode_of_impacts_at_equal_intervals_is_no_harmonic_line():
    """Four impacts, two too soft to be found: in phase, the decays of one mode look like a line."""
    planted = sampled(random_structure(930), "impacts", 930, 60.0)
    fit = identify_modes(log_of(planted))
    assert not fit.lines and "subtracted" not in str(fit)
    one = compare(fit, planted)
    assert not one.missed and not one.false_modes


@pytest.mark.parametrize("seed", [1114, 1126])
def test_decays_before_a_soft_impact_count_too(seed):
    """Of four impacts one or three are too soft; the last of them is where the free end begins."""
    planted = sampled(random_structure(seed), "impacts", seed, 60.0)
    fit = identify_modes(log_of(planted))
    one = compare(fit, planted)
    assert len(fit.windows) > 1 and not one.missed and not one.false_modes


@pytest.mark.parametrize(
    ("kind", "seed", "duration"),
    [
        ("decay", 1316, 20.0),  # a strongly damped pole at the edge of the band
        ("decay", 1416, 20.0),  # its energy falls to a quarter, on the way up and down
        ("crossing", 1411, 60.0),  # two nepers after the load has left, a quarter of the energy
        ("crossing", 1480, 60.0),  # 12.3 Hz, gone within 0.4 s of the end of the crossing
        ("impacts", 1606, 60.0),  # a mode with three times the decay rate of a weaker one beside it
        ("decay", 2022, 20.0),  # most energy is gone within two cycles of the slowest mode
        ("impacts", 1824, 60.0),  # four impacts in noise, of which the errors of one stand out
        ("impacts", 1310, 60.0),  # a pair within its bandwidth, with a fifth of the energy in one
        ("impacts", 2548, 60.0),  # four impacts in noise, of which only the energy tells
        ("impacts", 2814, 60.0),  # the first with half the energy; a mode of three times the rate
        (
            "impacts",
            2929,
            60.0,
        ),  # hard impacts, between which the noise of a channel rises and falls
        ("impacts", 2680, 60.0),  # poles in noise that cancel each other
    ],
)
def test_all_strong_modes_of_decays_that_fall_little_or_have_weak_partners(kind, seed, duration):
    planted = sampled(random_structure(seed), kind, seed, duration)
    fit = identify_modes(log_of(planted))
    one = compare(fit, planted)
    assert fit.kind == "free decay" and not one.missed and not one.false_modes, str(fit)
    assert one.covered.sum() >= one.covered.size - 2


def rattling_impact(seed, rattle, noise):
    """Accelerations of three neighbouring sensors after an impact at 1 s, and the modes' ranges.

    Amplitudes follow da/dt = -(l + m a) a from 1 on, damping ratios falling from twice the last
    ones, frequencies rising by 1 %. Parts rattle sixty times a second, by up to the amplitude.
    """
    random, rate = np.random.default_rng(seed), 800.0
    times = np.arange(int(10 * rate)) / rate
    since = np.maximum(times - 1.0, 0.0)
    values = np.zeros((times.size, 3))
    shapes = [1.0, 1.1, 1.2], [1.5, 1.35, 1.1], [2.0, 2.3, 1.8]
    parts = tuple(zip((11.9, 17.4, 26.1), (0.01, 0.008, 0.004), shapes, strict=True))
    for f, z, shape in parts:
        decay = 2 * np.pi * f * z
        amplitude = 1 / (2 * np.exp(decay * since) - 1)
        phase = 2 * np.pi * f * since - 0.01 / z * np.log(2 - np.exp(-decay * since))
        values += np.outer((since > 0) * amplitude * np.sin(phase), shape)
    values += np.outer(np.abs(times - 1.0) < 1.5 / rate, [10.0, 6.0, 3.0])
    knocks = random.normal(size=values.shape) * (random.random(values.shape) < 60 / rate)
    values += rattle * knocks * ((since > 0) * amplitude)[:, None]
    ranges = [((0.99 * f, f), (z, 2 * z)) for f, z, _ in parts]
    return values + noise * random.normal(size=values.shape), rate, ranges


@pytest.mark.parametrize(("rattle", "noise"), [(1.0, 0.003), (2.0, 0.01)])
@pytest.mark.parametrize("seed", [10, 11, 12])
def test_the_own_decay_of_an_impact_is_used_though_parts_rattle_in_it(seed, rattle, noise):
    values, rate, ranges = rattling_impact(seed, rattle, noise)
    names, quantities, units = ("a1", "a2", "a3"), ("acceleration",) * 3, ("m/s2",) * 3
    fit = identify_modes(Log(np.arange(len(values)) / rate, values, names, quantities, units))
    assert fit.kind == "free decay" and 1.0 <= fit.windows[0][0] < 1.1
    for frequencies, dampings in ranges:
        mode = min(fit.modes, key=lambda one: abs(one.frequency - np.mean(frequencies)))
        for value, sd, (low, high) in (
            (mode.frequency, mode.frequency_sd, frequencies),
            (mode.damping_ratio, mode.damping_sd, dampings),
        ):
            assert low - mode.quantile * sd < value < high + mode.quantile * sd


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
        (6.0, (602,), "is left out: what follows it is not the free decay with most information"),
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


def test_decays_that_are_left_tell_more_than_that_of_the_hardest_impact():
    """Each alone, by energy above noise times nepers: a hundred times as much after the first."""
    samples, _ = two_impacts()
    first, second = (Stretch(0, start, start + 250, 2.0) for start in (302, 602))
    slow = second._replace(fall=1e4)  # nepers
    for rest, impacts, expected in (
        ((second,), (first, second), (first,)),
        ((second,), (second,), (second,)),  # something may act in the first
        ((second,), (), (second,)),
        ((first, second), (first, second), (first, second)),
        ((slow,), (first, slow), (slow,)),
    ):
        found = or_most_informative(rest, impacts, samples.records, 1.0, 25.0)
        assert found == expected
