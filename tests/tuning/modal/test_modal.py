"""Modes identified from synthetic logs whose modes are known.

Decays are sums of damped cosines. Ambient responses are those of an oscillator to white force,
sampled from its exact recursion at eight times the rate of the log.
"""

import json

import numpy as np
import pytest
import scipy.stats
from scipy.signal import lfilter

from tuning import Log, ModalSettings, identify_modes
from tuning.modal.preprocessing import energy_band, kinetic_band, samples_of
from tuning.modal.result import IdentifiedMode, is_at_edge, rejection_reason

FREQUENCIES = np.array([5.0, 12.0, 13.0])
DAMPING = np.array([0.01, 0.008, 0.012])
SHAPES = np.array([[1, 0.8], [0.5, -0.6], [0.6, 0.4]])
BAND = (1.0, 20.0)


def make_log(values, rate, quantity="acceleration"):
    channels = values.shape[1]
    return Log(
        times=np.arange(len(values)) / rate,
        values=values,
        names=tuple(f"a{i}" for i in range(channels)),
        quantities=(quantity,) * channels,
        units=("?",) * channels,
        source="synthetic",
    )


def root(frequency, damping):
    omega = 2 * np.pi * frequency
    return omega * (-damping + 1j * np.sqrt(1 - damping**2))


def decay(seed, noise=0.05, rate=100.0, release=3.0, hum=0.0, drift=0.1, duration=12.0):
    """Random forcing until `release`, then a free decay of three modes with drift."""
    random = np.random.default_rng(seed)
    times = np.arange(int(duration * rate)) / rate
    values = np.zeros((times.size, 2))
    since = np.maximum(times - release, 0)
    for frequency, damping, shape in zip(FREQUENCIES, DAMPING, SHAPES, strict=True):
        phase = np.exp(1j * random.uniform(0, 2 * np.pi))
        values += np.outer((phase * np.exp(root(frequency, damping) * since)).real, shape)
    forced = times < release
    values[forced] = 1.5 * random.normal(size=(forced.sum(), 2))
    values += 0.05 + drift * np.sin(0.3 * times)[:, None] + noise * random.normal(size=values.shape)
    values += hum * np.cos(2 * np.pi * 16.7 * times + 1)[:, None]
    return make_log(values, rate)


def ambient(seed, duration=200.0, rate=40.0, noise=0.1, finer=8):
    """Deflection of two modes, 3 Hz and 7 Hz, under white forces, with sensor noise."""
    random = np.random.default_rng(seed)
    count = int(duration * rate)
    values = noise * random.normal(size=(count, 2))
    for frequency, damping, shape in ((3.0, 0.02, (1, 0.7)), (7.0, 0.01, (0.8, -0.9))):
        pole = np.exp(root(frequency, damping) / rate / finer)
        force = random.normal(size=finer * (count + 2000))
        response = lfilter([1.0], [1, -2 * pole.real, abs(pole) ** 2], force)[::finer][2000:]
        values += np.outer(response / response.std(), shape)
    return make_log(values, rate, "deflection")


def covered(fit, frequencies, damping):
    """Whether each true value lies in its interval: (mode, [frequency, damping])."""
    assert len(fit.modes) == len(frequencies), str(fit)
    frequency = np.abs(fit.frequencies - frequencies) <= np.ptp(fit.frequency_intervals, 1) / 2
    ratio = np.abs(fit.damping_ratios - damping) <= np.ptp(fit.damping_intervals, 1) / 2
    return np.stack([frequency, ratio], axis=1)


def test_clean_decay_is_exact():
    """Without noise errors are those of rounding, also in a window that truncates the decay."""
    log = decay(0, noise=0.0, drift=0.0)
    fit = identify_modes(log, window=(3.0, 5.0), band=BAND)
    np.testing.assert_allclose(fit.frequencies, FREQUENCIES, rtol=1e-6)
    np.testing.assert_allclose(fit.damping_ratios, DAMPING, rtol=1e-4)


def test_decay_is_found_and_fitted():
    fit = identify_modes(decay(1), band=BAND)
    assert fit.kind == "free decay"
    assert 3.0 <= fit.window[0] < 3.5
    np.testing.assert_allclose(fit.frequencies, FREQUENCIES, rtol=2e-3)
    np.testing.assert_allclose(fit.damping_ratios, DAMPING, rtol=0.2)
    assert np.sum((fit.measured - fit.fitted) ** 2) < 0.1 * np.sum(fit.measured**2)


def test_a_mode_that_moves_counts_however_little_it_accelerates():
    """Its accelerations have a thousandth of the energy, its velocities a sixtieth."""
    t, random = np.arange(2000) / 200.0, np.random.default_rng(0)
    poles = 2 * np.pi * np.array([4.0, 16.0]) * (-0.01 + 1j)
    decays = np.real(np.exp(np.multiply.outer(t, poles)) * [0.0158, 1.0])
    readings = decays.sum(axis=1)[:, None] + 1e-4 * random.normal(size=(t.size, 1))
    fit = identify_modes(make_log(readings, 200.0), window=(0.0, 10.0), band=(3.0, 20.0))
    np.testing.assert_allclose(np.sort(fit.frequencies), [4.0, 16.0], rtol=1e-3)
    assert min(mode.energy_share for mode in fit.modes) < 0.0015


def test_mains_hum_is_no_mode():
    fit = identify_modes(decay(2, hum=0.2), window=(3.0, 9.0), band=BAND)
    np.testing.assert_allclose(fit.frequencies, FREQUENCIES, rtol=2e-3)
    (line,) = fit.lines
    assert line.frequency == pytest.approx(16.7, abs=0.01) and f"{line.frequency:.3f}" in str(fit)
    assert not np.any(np.abs(fit.frequencies - 16.7) < 0.5)


def test_ambient():
    fit = identify_modes(ambient(0))
    assert fit.kind == "ambient"
    assert np.all(covered(fit, [3.0, 7.0], [0.02, 0.01]))
    np.testing.assert_allclose(fit.damping_ratios, [0.02, 0.01], rtol=0.3)


@pytest.mark.parametrize("quantity", ["acceleration", "deflection"])
@pytest.mark.parametrize("pole", [0.0, 0.7])
def test_noise_has_no_modes(quantity, pole):
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(size=(4000, 2))
        log = make_log(lfilter([1.0], [1.0, -pole], noise, axis=0), 100.0, quantity)
        fit = identify_modes(log)
        assert not fit.modes, str(fit)
        assert "no mode is well identified" in str(fit) and fit.to_dict()["mac"] == []


def test_decay_intervals_cover_the_truth():
    """60 logs of three modes each: 90 % to 98 % of the intervals cover the true values."""
    fits = [identify_modes(decay(seed), band=BAND, window=(3.0, 9.5)) for seed in range(60)]
    share = np.mean([covered(fit, FREQUENCIES, DAMPING) for fit in fits], axis=(0, 1))
    assert np.all((share >= 0.90) & (share <= 0.98)), share


@pytest.fixture(scope="module")
def ambient_fits():
    """Fits of 40 logs; for some of them the kind is decided from the log, which takes longest."""
    kinds = [None] * 8 + ["ambient"] * 32
    return [identify_modes(ambient(seed), kind=kind) for seed, kind in enumerate(kinds)]


def test_ambient_intervals_cover_the_truth(ambient_fits):
    """By the binomial distribution, as few of 80 do with a probability of 2 %.

    What poles vary with the order makes the intervals of two modes far apart wider than need be:
    errors are 0.7 to 0.75 of the standard deviations there, as 40 logs of random structures with
    close modes need the width (see the table of planted modes).
    """
    assert all(fit.kind == "ambient" for fit in ambient_fits)
    true = np.array([[3.0, 0.02], [7.0, 0.01]])
    found = np.array([covered(fit, *true.T) for fit in ambient_fits])
    assert np.all(found.sum(axis=(0, 1)) >= scipy.stats.binom.ppf(0.02, found[..., 0].size, 0.95))
    errors = [
        [
            ((mode.frequency - f) / mode.frequency_sd, (mode.damping_ratio - d) / mode.damping_sd)
            for mode, (f, d) in zip(fit.modes, true, strict=True)
        ]
        for fit in ambient_fits
    ]
    assert np.all(np.sqrt(np.mean(np.square(errors), axis=(0, 1))) > 0.6)


def test_modes_do_not_depend_on_how_strong_others_are():
    """A vibration a hundred times as strong, three octaves higher, hides no low mode."""
    quiet = ambient(0, rate=400.0, finer=1)
    random = np.random.default_rng(1)
    pole = np.exp(root(120.0, 0.01) / 400.0)
    high = lfilter([1.0], [1, -2 * pole.real, abs(pole) ** 2], random.normal(size=quiet.times.size))
    values = quiet.values + 100 * np.outer(high / high.std(), [1.0, 0.5])
    fit = identify_modes(make_log(values, 400.0, "deflection"), band=(1.0, 160.0), kind="ambient")
    found = fit.frequencies[fit.frequencies < 20]
    np.testing.assert_allclose(found, [3.0, 7.0], rtol=0.02)


def test_a_strong_line_does_not_end_the_band_below_resonances():
    """Steady shaking at 2 Hz with a hundred times the amplitude of modes at 3 Hz and 7 Hz."""
    quiet = ambient(0, duration=100.0)
    line = 100 * np.cos(2 * np.pi * 2.0 * quiet.times)[:, None]
    fit = identify_modes(make_log(quiet.values + line, 40.0, "deflection"))
    assert fit.lines[0].frequency == pytest.approx(2.0, abs=0.01) and "steady shaking" in str(fit)
    np.testing.assert_allclose(fit.frequencies, [3.0, 7.0], rtol=0.02)


def test_the_band_ends_above_the_twelfth_resonance():
    random, times = np.random.default_rng(0), np.arange(20000) / 1000.0
    tones = 10.0 * np.arange(1, 31)
    values = np.sin(2 * np.pi * np.outer(times, tones) + random.uniform(0, 6, 30)).sum(axis=1)
    values = values + 0.1 * random.normal(size=values.size)
    _, high = kinetic_band((values[:, None],), 1000.0, (1,))
    assert 120 < high < 170


def test_the_band_holds_broad_resonances_of_ragged_spectra():
    """Each has many lines of an average of nine segments, which chance makes ragged."""
    random, values = np.random.default_rng(0), 0.0
    for frequency in (3.0, 11.0, 25.0):
        pole = np.exp(root(frequency, 0.03) / 150.0)
        white = random.normal(size=45_000)
        one = lfilter([1.0], [1, -2 * pole.real, abs(pole) ** 2], white)
        values = values + one / one.std()
    _, high = kinetic_band((values[:, None],), 150.0, (1,))
    assert 25 < high < 40


def test_the_band_holds_what_is_strong_in_a_quiet_channel():
    """A mode at 9 Hz in a channel near a node of the mode at 3 Hz, which shakes the other."""
    random, times = np.random.default_rng(0), np.arange(4000) / 50
    loud, quiet = (np.exp(-0.02 * f * times) * np.cos(2 * np.pi * f * times) for f in (3.0, 9.0))
    values = np.stack([loud, 0.03 * quiet], axis=1)
    values = values + 0.01 * values.std(axis=0) * random.normal(size=values.shape)
    assert kinetic_band((values[:, :1],), 50.0, (1,))[1] < 6.0
    assert 9.5 < kinetic_band((values,), 50.0, (1, 1))[1] < 15.0


def accelerations(duration, noise, decays, rate=100.0):
    """Accelerations of modes at 1.5 and 20 Hz, of which the second moves little."""
    random, finer = np.random.default_rng(2), 8
    values = 0.0
    for frequency, damping, size in ((1.5, 0.01, 1.0), (20.0, 0.01, 0.3)):
        pole, step = root(frequency, damping), 1 / (finer * rate)
        force = np.zeros(int(duration * rate) * finer)
        force[0] = decays
        if not decays:
            force = random.normal(size=force.size)
        state = lfilter([1.0], [1.0, -np.exp(pole * step)], force.astype(complex))
        one = (pole * state).imag[finer // 2 :: finer]  # in phase with the acceleration
        values = values + size * one / one.std()
    values = values + noise * values.std() * random.normal(size=values.size)
    return make_log(values[:, None], rate)


@pytest.mark.parametrize(("duration", "decays"), [(200.0, 0), (20.0, 1)])
def test_the_band_holds_what_dominates_accelerations_and_what_moves_much(duration, decays):
    """A mode at 20 Hz has a twelfth of accelerations, a two-thousandth of the kinetic energy."""
    log = accelerations(duration, 0.05, decays)
    assert kinetic_band((log.values,), 100.0, (2,))[1] < 10.0
    low, high = energy_band((log.values,), 100.0, (2,))
    assert low < 1.5 and 20.0 < high < 40.0
    fit = identify_modes(log)
    assert fit.kind == ("free decay" if decays else "ambient")
    np.testing.assert_allclose(fit.frequencies, [1.5, 20.0], rtol=0.01)
    assert fit.band[1] > 20.0
    # Of velocities both are one.
    velocities = make_log(log.values, 100.0, "velocity")
    assert energy_band((log.values,), 100.0, (1,)) == kinetic_band((log.values,), 100.0, (1,))
    np.testing.assert_allclose(identify_modes(velocities).frequencies, [1.5, 20.0], rtol=0.01)


def test_a_mode_at_the_edge_of_a_band():
    """Within the half-power bandwidth of an end, or in the last 2 % of the band."""
    mode = IdentifiedMode(9.0, 0.01, 0.02, 0.001, 0.5, np.ones(1, complex), np.zeros((2, 2)))
    for low, high, at_edge in ((1, 10, False), (1, 9.17, True), (8.9, 20, True)):
        assert is_at_edge(mode, (float(low), float(high))) is at_edge
    assert not is_at_edge(mode._replace(damping_ratio=0.001), (8.9, 20.0))


@pytest.mark.parametrize(
    ("damping", "sd", "says"),
    [
        (0.044, 0.004, ""),
        (0.044, 0.03, "damping uncertain, 4.4 % +- 5.9 %"),
        (5e-5, 2e-4, "hum:"),
        (-5e-5, 1e-3, "damping uncertain"),
    ],
)
def test_a_mode_is_called_hum_only_if_no_structure_is_damped_as_little(damping, sd, says):
    mode = IdentifiedMode(5.0, 0.001, damping, sd, 0.5, np.ones(1, complex), np.zeros((2, 2)))
    assert rejection_reason(mode, 60.0, (1.0, 20.0)).startswith(says)
    assert bool(rejection_reason(mode, 60.0, (1.0, 20.0))) == bool(says)


def test_energies_are_fractions(ambient_fits):
    """Shares of close modes cancel in part: those beyond 0 and 1 have the nearer of the two."""
    every = [m for fit in ambient_fits for m in (*fit.modes, *(one for one, _ in fit.rejected))]
    assert len(every) > 80 and all(0.0 <= mode.energy_share <= 1.0 for mode in every)


def test_samples_are_left_out_while_a_sensor_settles():
    """Saturated for a second after it is switched on, then an exponential, as AC coupling has."""
    quiet = ambient(0, duration=60.0)
    settling = 500 * np.exp(-np.maximum(quiet.times - 1.0, 0) / 2.0)
    values = np.minimum(quiet.values + settling[:, None], 500.0)
    values[quiet.times < 1.0] = 500.0
    log = make_log(values, 40.0, "deflection")
    samples = samples_of([log], None)
    assert 10 < samples.starts[0] < 30
    assert any("left out, while a sensor settles" in note for note in samples.notes)
    assert samples_of([log], (0.0, 50.0)).starts == (0.0,)  # a window says what is used
    assert samples_of([quiet], None).starts == (0.0,)
    np.testing.assert_allclose(identify_modes(log, band=BAND).frequencies, [3.0, 7.0], rtol=0.02)


def test_a_channel_that_stays_at_one_value_is_left_out():
    """As of a sensor that is not connected; it would have been a node of all modes."""
    alive = decay(0).values
    dead = np.column_stack([alive, np.full(len(alive), 2.5)])
    log, with_dead = make_log(alive, 100.0), make_log(dead, 100.0)
    given = {"band": BAND, "window": (3.2, 9.0)}
    fit = identify_modes(with_dead, **given)
    assert "a2 stays at one value: left out" in fit.notes
    np.testing.assert_array_equal(fit.frequencies, identify_modes(log, **given).frequencies)
    assert fit.shapes.shape[1] == 2
    with pytest.raises(ValueError, match="each channel stays at one value: a2; give others"):
        identify_modes(with_dead, channels=["a2"])


def test_table_json_and_figures_of_a_fit(tmp_path):
    fit = identify_modes(decay(3), band=BAND, window=(3.2, 9.0))
    table = str(fit)
    assert "free decay from" in table and "damping ratio" in table
    result = json.loads(json.dumps(fit.to_dict()))
    assert result["frequencies_hz"] == fit.frequencies.tolist()
    assert result["modes"][0]["damping_95"][0] < result["damping_ratios"][0]
    one = ModalSettings(count=1)
    first = identify_modes(decay(3), band=BAND, window=(3.2, 9.0), settings=one)
    assert first.frequencies == pytest.approx([5], rel=1e-3)
    fit.plot(tmp_path / "decay.png")
    identify_modes(ambient(1, 60.0), band=BAND, kind="ambient").plot(tmp_path / "ambient.png")
    assert (tmp_path / "decay.png").stat().st_size > 10_000
    assert (tmp_path / "ambient.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"window": (2.0, 20.0)}, "the window from 2 s to 20 s is not within the log, 0 s to"),
        ({"window": (3.0, 3.1)}, "10 samples are too few"),
        ({"band": (1.0, 60.0)}, "not within 0 and half the sampling rate, 50 Hz"),
        ({"band": (20.0, 5.0)}, "the band from 20 Hz to 5 Hz must end above where it begins"),
        ({"kind": "forced"}, "kind must be 'free decay' or 'ambient'"),
    ],
)
def test_mistakes(arguments, message):
    with pytest.raises(ValueError, match=message):
        identify_modes(decay(0), **arguments)


@pytest.mark.parametrize(
    ("count", "arguments", "message"),
    [
        (
            64,
            {},
            "27 samples, at the 20.48 Hz that a band to 8 Hz needs, are too few for any",
        ),
        (100, {"order": 60}, r"models of order 60 \(lower ones need fewer\): at least 124"),
        (100, {"order": 60, "method": "data"}, "too few for models of order 60"),
    ],
)
def test_logs_too_short_for_a_method(count, arguments, message):
    noise = np.random.default_rng(0).normal(size=(count, 2))
    log = Log(np.arange(count) / 50, noise, ("v1", "v2"), ("velocity",) * 2, ("m/s",) * 2)
    with pytest.raises(ValueError, match=message):
        settings = ModalSettings(order=arguments.get("order"))
        method = arguments.get("method")
        identify_modes(log, kind="ambient", band=(1.0, 8.0), method=method, settings=settings)


def test_uneven_sampling_is_interpolated():
    log = decay(0, drift=0.0)
    wandering = log.times + 0.004 * np.sin(0.5 * log.times)
    even = log.times
    values = np.stack([np.interp(wandering, even, column) for column in log.values.T], axis=1)
    uneven = Log(wandering, values, log.names, log.quantities, log.units)
    fit = identify_modes(uneven, window=(3.2, 11.0), band=BAND)
    assert any("off an even grid" in note for note in fit.notes)
    np.testing.assert_allclose(fit.frequencies, FREQUENCIES, rtol=3e-3)
