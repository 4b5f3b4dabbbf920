"""Step sizes of a sweep, for errors that are known functions of the step.

Results of trials: a sweep takes over those with its own steps.
"""

import numpy as np
import pytest
from hypothesis import given, strategies as st

import jaxbeam as jb
from jaxbeam.simulation.integrator import native_peaks
from jaxbeam.simulation.sweeps.step_size import (
    LEAST_STATED_ERROR,
    LIMIT_RATIO,
    SAFETY_FACTOR,
    Trials,
    choose_step_sizes,
    log_spaced_sample,
    step_errors,
    stratified_sample,
)

ORDER = 12


def peaks_with_error(unit_steps, order=ORDER, failing=()):
    """Peaks (path, batch, sensor) whose relative error is (step / unit step)^order."""

    def peaks_of(chosen, steps, extra_steps):
        error = (np.asarray(steps) / unit_steps[chosen]) ** order
        peaks = np.repeat((1 + error)[:, None, None] * 1e-3, 2, axis=1)
        peaks[np.isin(chosen, failing)] = np.nan
        return np.repeat(peaks, 3, axis=2)

    return peaks_of


@pytest.mark.parametrize("off", [0.2, 1.0, 5.0])
def test_steps_are_near_the_longest_within_tolerance(off):
    rates = np.geomspace(0.5, 20, 50)
    best = 0.3 / rates**0.7  # steps with a relative error of one
    tolerance = 1e-7
    longest = best * tolerance ** (1 / ORDER)
    steps, _, error = choose_step_sizes(
        peaks_with_error(best), rates, np.ones(50), off * longest, np.full(50, np.inf), 8, tolerance
    )
    assert np.all(steps <= longest * 1.05)
    assert np.all(steps > 0.5 * longest)
    assert 0 < error <= tolerance


def test_steps_stay_below_their_limits():
    rates = np.geomspace(1, 10, 20)
    limits = np.linspace(0.01, 0.02, 20)
    steps, *_ = choose_step_sizes(
        peaks_with_error(np.ones(20)), rates, np.ones(20), np.full(20, 5.0), limits, 4, 1e-6
    )
    assert np.all(steps <= limits) and np.all(steps > 0.95 * limits)


@pytest.mark.parametrize("best", [1.0, 1e-3])
def test_steps_at_their_limit_are_checked_without_search(best):
    """If the step at the limit is too long, the check finds it."""
    measured, rates, limits = [], np.geomspace(1, 10, 20), np.full(20, 0.01)
    peaks = peaks_with_error(np.full(20, best))

    def recorded_peaks(chosen, steps, extra_steps):
        measured.append(steps.max())
        return peaks(chosen, steps, extra_steps)

    steps, _, error = choose_step_sizes(
        recorded_peaks, rates, np.ones(rates.size), LIMIT_RATIO * limits, limits, 4, 1e-6
    )
    assert error <= 1e-6
    if best == 1.0:
        assert np.all(steps == limits) and len(measured) == 1  # the check
    else:
        assert np.all(steps < best) and len(measured) > 1


def test_failed_runs_are_left_out():
    rates = np.geomspace(1, 10, 20)
    all_succeed = peaks_with_error(np.ones(20) * 0.1)
    some_fail = peaks_with_error(np.ones(20) * 0.1, failing=(0, 7))
    settings = (rates, np.ones(20), np.full(20, 0.02), np.full(20, 1.0), 8, 1e-6)
    np.testing.assert_allclose(
        choose_step_sizes(some_fail, *settings)[0], choose_step_sizes(all_succeed, *settings)[0]
    )
    all_fail = peaks_with_error(np.ones(20), failing=range(20))
    steps, _, error = choose_step_sizes(all_fail, *settings)
    assert np.isnan(error) and np.all(steps == 0.02)


def test_sample_shortens_steps_that_are_too_long():
    """Steps meet the tolerance at the rates of the search, not between them."""
    rates = np.geomspace(1, 10, 64)
    measured = np.unique(log_spaced_sample(rates, np.ones(64), 4))
    best = np.where(np.isin(np.arange(64), measured), 0.5, 0.25)
    steps, _, error = choose_step_sizes(
        peaks_with_error(best), rates, np.ones(64), np.full(64, 0.1), np.full(64, np.inf), 4, 1e-6
    )
    assert error <= 1e-6
    assert np.all((steps / best) ** ORDER <= 1e-5)


def test_settled_batches_are_not_measured_again():
    """Only the fastest starts with a step that is too long, and is measured again."""
    rates, unit_steps = np.geomspace(1, 10, 4), np.full(4, 0.1)
    measured, peaks = [], peaks_with_error(unit_steps)

    def recorded_peaks(chosen, steps, extra_steps):
        measured.append(set(np.asarray(chosen).tolist()))
        return peaks(chosen, steps, extra_steps)

    initial_steps = np.full(4, 0.9 * 0.1 * (1e-7 / SAFETY_FACTOR) ** (1 / ORDER))
    initial_steps[-1] *= 2
    choose_step_sizes(
        recorded_peaks, rates, np.ones(rates.size), initial_steps, np.ones(4), 4, 1e-7
    )
    # Steps of all, of the fastest, and of the sample.
    assert measured == [{0, 1, 2, 3}, {3}, {0, 1, 2, 3}]


def test_short_initial_steps_are_lengthened():
    rates, best = np.geomspace(1, 10, 20), np.full(20, 0.1)
    longest = 0.1 * (1e-7 / SAFETY_FACTOR) ** (1 / ORDER)
    steps, _, error = choose_step_sizes(
        peaks_with_error(best), rates, np.ones(20), np.full(20, 0.7 * longest), np.ones(20), 4, 1e-7
    )
    assert np.all(steps > 0.9 * longest) and error <= 1e-7


@pytest.mark.parametrize("off", [0.5, 1.0, 1.3, 3.0])
def test_errors_of_all_runs_are_measured(off):
    """Results are those of the finer runs, each of which is computed once."""
    rates, best = np.geomspace(1, 10, 6), 0.1 * np.array([1.0, 0.9, 0.8, 0.7, 1.1, 1.0])
    computed, peaks = [], peaks_with_error(best)

    def recorded_peaks(chosen, steps, extra_steps):
        computed.append(
            set(zip(*map(np.ndarray.tolist, (chosen, steps, extra_steps)), strict=True))
        )
        return peaks(chosen, steps, extra_steps)

    guesses = np.full(6, off * 0.08 * 1e-7 ** (1 / ORDER))
    given = rates, np.ones(6), guesses, np.ones(6), 4, 1e-7
    steps, extra, error = choose_step_sizes(recorded_peaks, *given, all_measured=True)
    true_errors = (steps / best) ** ORDER
    assert np.all(steps > 0.55 * best * 1e-7 ** (1 / ORDER))
    assert true_errors.max() <= error <= 1e-7
    assert set(zip(range(6), steps.tolist(), extra.tolist(), strict=True)) <= set().union(*computed)
    later = computed[-1] & set().union(*computed[:-1])
    assert len(computed) == 2 or later  # the finer run is the next coarser one


def test_peaks_that_agree_by_chance_do_not_make_the_error_small():
    def measure(chosen, steps, extra_steps):
        return np.ones((len(chosen), 1, 1))

    rates = np.geomspace(1, 10, 3)
    steps = np.full(3, 0.1), np.full(3, 0.01)
    *_, error = choose_step_sizes(measure, rates, rates, *steps, 4, 1e-6, all_measured=True)
    assert error == 0.0  # of the longest steps
    changed = peaks_with_error(np.full(3, 0.1), order=30)
    given = rates, rates, np.full(3, 0.058), np.full(3, 0.1), 4, 1e-6
    *_, error = choose_step_sizes(changed, *given, all_measured=True)
    assert error >= LEAST_STATED_ERROR * 1e-6


def test_no_step_meets_the_tolerance():
    def measure(chosen, steps, extra_steps):
        return np.random.default_rng(int(1e9 * steps[0])).uniform(size=(len(chosen), 1, 1))

    rates = np.geomspace(1, 10, 8)
    with pytest.raises(RuntimeError, match="no time step makes the peaks agree to 1e-06"):
        choose_step_sizes(measure, rates, np.ones(8), np.full(8, 0.1), np.full(8, 1.0), 4, 1e-6)


def test_error_is_the_largest_of_a_batch():
    def measure(chosen, steps, extra_steps):
        peaks = np.ones((len(chosen), 2, 1))
        peaks[:, 1] += steps[:, None]
        return peaks

    error = step_errors(measure, np.arange(2), np.array([0.3, 0.6]))
    np.testing.assert_allclose(error, [0.06 / 1.24, 0.12 / 1.48])


def test_sample_is_even_in_log_crossing_rate():
    """From half a spacing above the slowest to the fastest."""
    rates = np.geomspace(1, 1e7, 71)[np.random.default_rng(1).permutation(71)]
    np.testing.assert_allclose(
        np.log10(rates[log_spaced_sample(rates, np.ones(71), 3)]), [1.2, 4.1, 7.0]
    )
    assert len(log_spaced_sample(np.ones(5), np.ones(5), 3)) == 3


def test_sample_takes_the_heaviest_batches():
    """Of runs of random masses and speeds, whose errors follow the masses."""
    rates, masses = np.geomspace(1, 1e3, 30), np.random.default_rng(2).uniform(size=30)
    groups = np.digitize(np.log10(rates), [1.1667, 2.3333])  # nearest to 0.5, 1.75 and 3
    expected = [np.flatnonzero(groups == i)[masses[groups == i].argmax()] for i in range(3)]
    assert log_spaced_sample(rates, masses, 3).tolist() == expected


@given(st.integers(1, 200), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_one_batch_is_drawn_from_each_quantile(batches, count, seed):
    rates = np.random.default_rng(seed).permutation(np.geomspace(1, 10, batches))
    ranks = np.sort(rates).searchsorted(rates[stratified_sample(rates, count)])
    bounds = np.arange(count + 1) * batches / count
    assert np.all((ranks + 1 > bounds[:-1]) & (ranks < bounds[1:]))
    np.testing.assert_array_equal(stratified_sample(rates, count), stratified_sample(rates, count))


def test_sample_grows_with_the_number_of_batches():
    for batches, sample_size in ((64, 4), (1024, 16), (16384, 64)):
        asked, rates = [], np.geomspace(1, 10, batches)
        measure = peaks_with_error(np.full(batches, 0.1))

        def recorded(chosen, steps, extra_steps, asked=asked, measure=measure):
            asked.append(len(chosen))
            return measure(chosen, steps, extra_steps)

        choose_step_sizes(
            recorded, rates, np.ones(batches), np.full(batches, 0.01), np.ones(batches), 4, 1e-7
        )
        assert asked[-1] == 2 * sample_size  # with coarse and fine steps


def test_between_two_rates_the_shorter_step_holds():
    """Errors in between may be larger than at both rates, so steps are not interpolated."""
    rates = np.geomspace(1, 10, 41)
    measured = np.sort(log_spaced_sample(rates, np.ones(41), 4))
    best = np.full(41, 0.2)
    best[measured[2]] = 0.1
    guesses = np.full(41, 0.02)
    steps, *_ = choose_step_sizes(
        peaks_with_error(best), rates, np.ones(41), guesses, np.ones(41), 4, 1e-7
    )
    near = np.arange(measured[1] + 1, measured[3])
    np.testing.assert_allclose(steps[near], steps[measured[2]])
    assert np.all(steps[[measured[1], measured[3]]] > 1.4 * steps[measured[2]])


CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=2),
    sensors=[jb.Sensor(0.2), jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    run=jb.Run(0.5),
)
OVER = {"loads.0.mass": [0.2, 0.4], "loads.0.speed": np.linspace(1.0, 5.0, 40)}


def test_only_results_with_the_same_steps_are_known():
    trials, results = Trials(), {"peak": np.arange(6.0).reshape(3, 2)}
    trials.add(np.array([4, 7, 9]), np.array([0.1, 0.2, 0.3]), np.array([0, 0, 1]), results)
    latest = {"peak": np.array([[8.0, 9.0]])}
    for step in (0.5, 0.4, 0.3, 0.25):  # as many as are kept, so that the first is forgotten
        trials.add(np.array([7]), np.array([step]), np.array([0]), latest)
    given = (
        np.array([9, 9, 7, 7, 5]),
        np.array([0.3, 0.3, 0.2, 0.4, 0.1]),
        np.array([1, 0, 0, 0, 0]),
    )
    known = trials.has_results(*given)
    assert known.tolist() == [True, False, False, True, False]
    found = trials.completed({"peak": np.full((5, 2), -1.0)}, *given, known)["peak"].tolist()
    assert found == [[4.0, 5.0], [-1.0, -1.0], [-1.0, -1.0], [8.0, 9.0], [-1.0, -1.0]]


@pytest.mark.parametrize("way", ["C", "XLA", "single"])
def test_results_of_trials_are_those_of_stored_sweeps(way, tmp_path, monkeypatch):
    """Sweeps in memory compute fewer batches; stored ones and single precision take over none."""
    native, precision = way == "C", "single" if way == "single" else "double"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if native:
        native_peaks.LIBRARY.build()
    monkeypatch.setattr(native_peaks, "available", lambda: native)
    masks, completed = [], Trials.completed

    def counted(trials, results, batch_indices, steps, extra_steps, known):
        if results:  # of a block, not of a trial
            masks.append(known.sum())
        return completed(trials, results, batch_indices, steps, extra_steps, known)

    monkeypatch.setattr(Trials, "completed", counted)
    given = {"progress": False, "precision": precision}
    in_memory = jb.sweep(CASE, OVER, **given)
    blocks, count = len(masks), sum(masks)
    assert count < 40 and (count == 0) == (precision == "single")
    stored = jb.sweep(CASE, OVER, store=tmp_path / "sweep.zarr", **given)
    # XLA may round otherwise where a batch has another place in its block.
    tolerance = 0 if native else 1e-7
    for name in in_memory:
        np.testing.assert_allclose(in_memory[name], stored[name], tolerance, err_msg=name)
    assert len(masks) == blocks
