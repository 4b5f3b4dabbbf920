"""Modes of ambient vibration: stochastic subspaces, and the likelihood of spectral matrices."""

import numpy as np
import pytest
import scipy.stats
from scipy.signal import lfilter

from experiments.validation.modal_identification import compare, log_of
from tests.oracles.planted_structures import Structure, random_structure, sampled
from tests.tuning.modal.test_excitation import mode
from tests.tuning.modal.test_modal import ambient
from tuning import ModalSettings, identify_modes
from tuning.modal.ambient import Candidate, mode_of_chain, with_usual_spread, without_duplicates
from tuning.modal.harmonics import (
    DOUBTFUL_SDS,
    STEADY_SDS,
    Line,
    fundamental,
    harmonic_lines,
    steadiness,
    without_lines,
)
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
from tuning.modal.result import IdentifiedMode, mac_matrix, normalised, phase_collinearity
from tuning.modal.subspace import (
    MIN_CHAIN_ORDERS,
    Chain,
    Poles,
    Spread,
    block_rows,
    decompose,
    poles_of_order,
    spreads,
)

# Subspace identification of structures by finite elements, beside pyOMA-2.


def free_response(times):
    """Two channels of two damped modes, without noise, and their poles."""
    poles = 2 * np.pi * np.array([3.0, 3.03]) * (-np.array([0.01, 0.02]) + 1j)
    shapes = np.array([[1.0, 0.5], [0.4, -1.0]])
    return np.real(np.exp(np.multiply.outer(times, poles)) @ shapes), poles, shapes


@pytest.mark.parametrize("data_driven", [False, True])
def test_poles_and_shapes_of_a_noiseless_decay_are_exact(data_driven):
    """The covariances of a decay obey the equations of the method, whatever its length."""
    values, poles, shapes = free_response(np.arange(300) / 20)
    subspace = decompose((values,), 20.0, 20, data_driven)
    found = poles_of_order(subspace, 4)
    order = np.argsort(found.frequencies)
    # The data-driven weight is computed with a relative accuracy of 1e-10 of its eigenvalues.
    rtol = 1e-3 if data_driven else 1e-7
    np.testing.assert_allclose(found.poles[order], poles, rtol=rtol)
    assert np.all(np.diag(mac_matrix(found.shapes[order], shapes + 0j)) > 1 - 1e-5)


def test_first_order_uncertainty_agrees_with_differences():
    """The change of a pole for a small change of one block is that of a perturbed matrix."""
    random = np.random.default_rng(0)
    values, _, _ = free_response(np.arange(2000) / 20)
    values = values + 1e-3 * random.normal(size=values.shape)
    subspace = decompose((values[:1000], values[1000:]), 20.0, 12)
    pole = poles_of_order(subspace, 4).poles[:1]
    (own,) = spreads(subspace, 4, pole)
    matrix = (subspace.left[:, : subspace.values.size] * subspace.values) @ subspace.right.T
    step, shifts = 1e-4, []
    for block in subspace.rotated:
        change = subspace.left @ block @ subspace.right.T
        moved = []
        for sign in (-step, step):
            left, sizes, right = np.linalg.svd(matrix + sign * change)
            one = subspace._replace(left=left, values=sizes, right=right.T)
            others = poles_of_order(one, 4).poles
            moved.append(others[np.argmin(np.abs(others - pole))])
        shifts.append((np.abs(moved[1]) - np.abs(moved[0])) / (2 * np.pi * 2 * step))
    assert np.sqrt(own.covariance[0, 0]) == pytest.approx(np.linalg.norm(shifts), rel=1e-4)


def small_structure(seed):
    """Three modes in two channels."""
    whole = random_structure(1)
    frequencies, damping = np.array([4.0, 6.0, 9.0]), np.array([0.01, 0.015, 0.008])
    return Structure(frequencies, damping, whole.shapes[:3, :2], whole.inputs[:3])


def test_close_modes_are_found_in_a_short_log():
    found = []
    for seed in range(2):
        structure = small_structure(seed)
        close = structure.frequencies * np.array([1.0, 4.12 / 6.0, 1.0])
        planted = sampled(structure._replace(frequencies=close), "ambient", seed, 200.0)
        found.append(compare(identify_modes(log_of(planted), band=(2.0, 11.0)), planted))
    assert all(seen for one in found for seen in one.found)
    assert not any(one.false_modes for one in found)


@pytest.mark.parametrize(("kind", "count"), [("ambient", 2), ("motor", 8)])
def test_modes_and_lines_of_planted_logs_are_found(kind, count):
    """As `experiments.validation.modal_identification` does it; intervals cover the truth."""
    found = []
    for seed in range(count):
        planted = sampled(small_structure(seed), kind, seed, 200.0)
        fit = identify_modes(log_of(planted), band=(2.0, 11.0))
        found.append(compare(fit, planted))
        if kind == "motor":
            lines = [line.frequency for line in fit.lines]
            inside = [line for line in planted.lines if line < 11.0]
            np.testing.assert_allclose(lines, inside, atol=0.01)
    assert all(seen for one in found for seen in one.found)
    assert not any(one.false_modes for one in found)
    covered = np.concatenate([one.covered for one in found])
    # So many or more of the intervals of 95 % miss the truth with a probability of 2 %.
    allowed = scipy.stats.binom.isf(0.02, covered.size, 0.05)
    assert covered.size == 6 * count and np.sum(covered == 0) <= allowed, covered


@pytest.mark.parametrize("seed", [0, 3])
def test_as_good_as_another_program(seed):
    """Modes that pyOMA-2 finds at a fixed order of the same log are found, as accurately."""
    ssi = pytest.importorskip("pyoma2.functions.ssi")
    planted = sampled(small_structure(seed), "ambient", seed, 200.0)
    fit = identify_modes(log_of(planted), band=(2.0, 11.0))
    values = planted.values - planted.values.mean(axis=0)
    hankel, _ = ssi.build_hank(Y=values.T, Yref=values.T, br=40, method="cov", calc_unc=False)
    observability, states, outputs, _ = ssi.SSI_fast(hankel, 40, 20)
    frequencies = ssi.SSI_poles(observability, states, outputs, 20, 1 / planted.rate)[0]
    theirs = np.asarray(frequencies)[:, -1]
    for truth in planted.structure.frequencies:
        own = np.min(np.abs(fit.frequencies / truth - 1))
        assert own < max(3 * np.nanmin(np.abs(theirs / truth - 1)), 5e-3)


def test_a_line_is_found_and_subtracted():
    times = np.arange(4000) / 100
    random = np.random.default_rng(0)
    noise = random.normal(size=(4000, 1))
    line = 0.6 * np.cos(2 * np.pi * 7.123 * times + 0.4)[:, None]
    (found,) = harmonic_lines(noise + line, 100.0, (1.0, 40.0))
    assert found.frequency == pytest.approx(7.123, abs=1e-3)
    assert found.share == pytest.approx(0.18 / 1.18, rel=0.2)
    rest = without_lines(noise + line, 100.0, (found.frequency,))
    np.testing.assert_allclose(rest, noise, atol=0.15)
    assert harmonic_lines(noise, 100.0, (1.0, 40.0)) == ()


def test_the_fundamental_of_harmonics():
    """Lines of a shaker at multiples of 4.646 Hz, one missing, and one line of another machine."""
    lines = tuple(Line(f, 0.1) for f in (4.64, 9.515, 13.93, 18.581, 23.232))
    assert fundamental(lines, 100.0, 2000) == pytest.approx(4.646, abs=0.002)
    assert fundamental(lines[:2], 100.0, 2000) is None
    assert fundamental((Line(3.1, 0.2), Line(7.7, 0.1), Line(11.2, 0.1)), 100.0, 2000) is None


def test_complexity_and_normalisation_of_shapes():
    shapes = np.array([[1j, -0.5j, 0.2j], [1.0, 1j, -1.0]])
    np.testing.assert_allclose(phase_collinearity(shapes)[0], 1.0)
    assert phase_collinearity(shapes)[1] < 0.2
    np.testing.assert_allclose(normalised(shapes[:1])[0], [1, -0.5, 0.2], atol=1e-12)


def test_lines_of_a_shaker_are_no_modes():
    """Harmonics near and between the natural frequencies are named; none is a mode."""
    for seed in range(2):
        planted = sampled(small_structure(seed), "shaken", seed, 100.0)
        fit = identify_modes(log_of(planted), band=(2.0, 11.0))
        named = [line.frequency for line in fit.lines]
        assert abs(planted.lines[0] - named[0]) < 0.01 and "steady shaking" in str(fit)
        for line in planted.lines:
            assert not np.any(np.abs(fit.frequencies - line) < 0.01)
        assert not compare(fit, planted).false_modes, str(fit)


def test_an_envelope_tells_a_line_that_wanders_from_a_resonance():
    random = np.random.default_rng(3)
    rate, count = 50.0, 15_000
    phase = np.cumsum(0.02 * random.normal(size=count)) + 2 * np.pi * 4.0 * np.arange(count) / rate
    line = np.cos(phase)[:, None] + 0.1 * random.normal(size=(count, 1))
    assert steadiness(line, rate, 4.0, 0.01) > 2 * STEADY_SDS
    pole = np.exp(2 * np.pi * 4.0 * (-0.01 + 1j) / rate)
    driven = lfilter([1.0], [1, -2 * pole.real, abs(pole) ** 2], random.normal(size=(count, 1)), 0)
    assert steadiness(driven, rate, 4.0, 0.01) < DOUBTFUL_SDS
    assert steadiness(driven[:300], rate, 4.0, 0.01) < DOUBTFUL_SDS


def test_random_vibration_is_seldom_taken_for_a_line():
    """Of records over 22 decay times one in a hundred is doubtful, one in two thousand a line."""
    random = np.random.default_rng(5)
    rate, frequency, damping = 20.0, 4.0, 0.003
    count, runs = int(22 * rate / (2 * np.pi * damping * frequency)), 1000
    root = np.exp(2 * np.pi * frequency * (-damping + 1j) / rate)
    forces = random.normal(size=(2 * count, runs))
    driven = lfilter([1.0], [1, -2 * root.real, abs(root) ** 2], forces, axis=0)[count:]
    found = np.array(
        [steadiness(driven[:, i : i + 1], rate, frequency, damping) for i in range(runs)]
    )
    assert 3 < np.sum(found > DOUBTFUL_SDS) < 20
    assert np.sum(found > STEADY_SDS) < 3


def test_a_mode_that_is_steady_by_chance_is_named():
    """The lowest mode of this structure vibrates more steadily than half a percent of such do."""
    planted = sampled(random_structure(1229), "ambient", 1229, 300.0)
    fit = identify_modes(log_of(planted))
    near = np.flatnonzero(np.abs(fit.frequencies - planted.structure.frequencies[0]) < 0.02)
    assert near.size == 1 and "more steadily than 99 of 100" in str(fit)
    assert f"--exclude {fit.frequencies[near[0]]:.4g}]" in str(fit)


def test_poles_whose_intervals_overlap_are_told_apart_by_the_likelihood():
    """A pair in one channel, 2 % apart, whose poles scatter with the order by half of that."""
    planted = sampled(random_structure(2421), "ambient", 2421, 300.0)
    fit = identify_modes(log_of(planted))
    pair = zip(
        planted.structure.frequencies[2:4], planted.structure.damping_ratios[2:4], strict=True
    )
    for frequency, damping in pair:
        near = min(fit.modes, key=lambda mode: abs(mode.frequency - frequency))
        assert abs(near.frequency - frequency) < 2 * near.frequency_sd < 0.1
        assert abs(near.damping_ratio - damping) < 2 * near.damping_sd


@pytest.mark.parametrize("kind", ["ambient", "motor"])
def test_a_broad_mode_is_not_taken_for_the_background_of_a_narrow_one(kind):
    """In one channel, a tenth below it; a background of second degree is nearly as likely."""
    planted = sampled(random_structure(2820), kind, 2820, 300.0)
    one = compare(identify_modes(log_of(planted)), planted)
    assert not one.missed and not one.false_modes


def test_what_a_pole_varies_with_the_order_adds_to_its_uncertainty():
    """Of sixteen orders the lowest vary least from block to block, and are biased."""
    frequencies = np.where(np.arange(16) < 2, 5.0, 5.1)
    values = 2 * np.pi * frequencies * (-0.01 + 1j * np.sqrt(1 - 0.01**2))
    shapes = np.ones((16, 2), complex)
    poles = Poles(2 * np.arange(1, 17), values, shapes, np.full(16, 0.5))
    spread = {
        k: Spread((1 + 0.1 * k) * np.diag([1e-4, 1e-6]), shapes[k], np.zeros((4, 4)), 23.0)
        for k in range(16)
    }
    chain = Chain(np.arange(16), 8)
    mode = with_usual_spread(mode_of_chain(poles, chain, spread, np.ones(2)), poles, chain, spread)
    assert mode.frequency == pytest.approx(5.0)
    # Six of the better eight orders have it 0.1 Hz higher.
    assert mode.frequency_sd == pytest.approx(np.sqrt(1.2e-4 + 6 / 8 * 0.1**2))
    assert mode.damping_sd == pytest.approx(np.sqrt(1.2e-6))


def identified(frequency, frequency_sd, damping_ratio, damping_sd):
    """A mode of two channels, whose shape is that of all."""
    shape, covariance = np.array([1.0, 0.4 + 0j]), np.zeros((4, 4))
    return IdentifiedMode(
        frequency, frequency_sd, damping_ratio, damping_sd, 0.2, shape, covariance, 2.0
    )


@pytest.mark.parametrize(
    ("first", "second", "kept"),
    [
        # Intervals overlap, 0.3 % apart and within half of the half-power bandwidth: one mode.
        ((154.44, 0.22, 0.0109, 0.0010), (154.92, 0.14, 0.0165, 0.0008), 1),
        # One per cent apart, and told apart by their intervals.
        ((4.0, 0.004, 0.02, 0.002), (4.04, 0.004, 0.01, 0.001), 2),
        # One per cent apart, lightly damped: two peaks, though the intervals overlap.
        ((4.0, 0.015, 0.004, 0.0004), (4.04, 0.015, 0.008, 0.0004), 2),
    ],
)
def test_poles_that_are_not_told_apart_are_one_mode(first, second, kept):
    candidates = [Candidate(identified(*numbers), "", 10) for numbers in (first, second)]
    found = without_duplicates(candidates)
    assert len(found) == kept
    if kept == 1:
        assert found[0].mode.frequency == 154.92, "that of the smaller uncertainty of damping"


def test_one_channel_has_orders_enough_to_be_stable():
    """Two thirds of the rows are the highest order, every second one is tried, six make a chain."""
    assert 2 * block_rows(13.7, 1.8, 1, 823) // 3 // 2 > MIN_CHAIN_ORDERS
    assert block_rows(13.7, 1.8, 1, 64) == 8
    assert block_rows(100.0, 2.0, 8, 30_000) == 30


def test_a_method_refuses_what_it_cannot_use():
    log = log_of(sampled(small_structure(0), "ambient", 0, 10.0))
    for method in ("plscf", "covariance"):
        with pytest.raises(ValueError, match="for kind 'free decay' leave the method out"):
            identify_modes(log, method=method, kind="free decay")
    with pytest.raises(ValueError, match="for kind 'ambient' leave the method out"):
        identify_modes(log, method="decay", kind="ambient")
    with pytest.raises(ValueError, match="measured forces, and none is in N; without them use"):
        identify_modes(log, method="plscf")
    with pytest.raises(ValueError, match="for kind 'ambient' use 'covariance' or 'data'"):
        identify_modes(log, method="plscf", kind="ambient")
    with pytest.raises(ValueError, match="method 'fdd' is gone"):
        identify_modes(log, method="fdd")


# Likelihood of spectral matrices: expectation, derivatives and errors against closed forms.


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
