"""The choice of time steps, on errors that are known."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from jaxbeam.sweeps.step_size import (
    LIMIT_RATIO,
    SAFETY_FACTOR,
    choose_step_sizes,
    log_spaced_sample,
    step_errors,
    stratified_sample,
)

ORDER = 12


def task(paces, best, order=ORDER, failing=()):
    """A measure whose relative error is (step / best)^order: peaks (task, lane, sensor)."""

    def measure(chosen, steps, more=0):
        error = (np.asarray(steps) / best[chosen]) ** order
        peaks = np.repeat((1 + error)[:, None, None] * 1e-3, 2, axis=1)
        peaks[np.isin(chosen, failing)] = np.nan
        return np.repeat(peaks, 3, axis=2)

    return measure


@pytest.mark.parametrize("off", [0.2, 1.0, 5.0])
def test_steps_meet_the_tolerance_and_waste_little(off):
    paces = np.geomspace(0.5, 20, 50)
    best = 0.3 / paces**0.7  # steps at which the error is one
    tolerance = 1e-7
    longest = best * tolerance ** (1 / ORDER)
    steps, error = choose_step_sizes(
        task(paces, best), paces, off * longest, np.full(50, np.inf), 8, tolerance
    )
    assert np.all(steps <= longest * 1.05)
    assert np.all(steps > 0.5 * longest)
    assert 0 < error <= tolerance


def test_limits_are_kept():
    paces = np.geomspace(1, 10, 20)
    limits = np.linspace(0.01, 0.02, 20)
    steps, _ = choose_step_sizes(task(paces, np.ones(20)), paces, np.full(20, 5.0), limits, 4, 1e-6)
    assert np.all(steps <= limits) and np.all(steps > 0.95 * limits)


@pytest.mark.parametrize("best", [1.0, 1e-3])
def test_steps_far_below_their_guess_are_checked_but_not_searched(best):
    """Where a limit rules, a search has nothing to find; if it is too long, the check tells."""
    tried, paces, limits = [], np.geomspace(1, 10, 20), np.full(20, 0.01)
    measure = task(paces, np.full(20, best))

    def watched(chosen, steps, more=0):
        tried.append(steps.max())
        return measure(chosen, steps)

    steps, error = choose_step_sizes(watched, paces, LIMIT_RATIO * limits, limits, 4, 1e-6)
    assert error <= 1e-6
    if best == 1.0:
        assert np.all(steps == limits) and len(tried) == 2  # coarse and fine, of the check
    else:
        assert np.all(steps < best) and len(tried) > 2


def test_failed_runs_do_not_decide():
    paces = np.geomspace(1, 10, 20)
    good = task(paces, np.ones(20) * 0.1)
    bad = task(paces, np.ones(20) * 0.1, failing=(0, 7))
    settings = (paces, np.full(20, 0.02), np.full(20, 1.0), 8, 1e-6)
    np.testing.assert_allclose(
        choose_step_sizes(bad, *settings)[0], choose_step_sizes(good, *settings)[0]
    )
    nothing = task(paces, np.ones(20), failing=range(20))
    steps, error = choose_step_sizes(nothing, *settings)
    assert error == 0 and np.all(steps == 0.02)


def test_a_wrong_measure_is_found_on_the_random_few():
    """Steps are good at the paces that were tried, too long between them: they are shortened."""
    paces = np.geomspace(1, 10, 64)
    tried = np.unique(log_spaced_sample(paces, 4))
    best = np.where(np.isin(np.arange(64), tried), 0.5, 0.25)
    steps, error = choose_step_sizes(
        task(paces, best), paces, np.full(64, 0.1), np.full(64, np.inf), 4, 1e-6
    )
    assert error <= 1e-6
    assert np.all((steps / best) ** ORDER <= 1e-5)


def test_settled_runs_are_not_measured_again():
    """The quickest alone starts with a step that is too long: it alone is tried again."""
    paces, best = np.geomspace(1, 10, 4), np.full(4, 0.1)
    tried, measure = [], task(paces, best)

    def watched(chosen, steps, more=0):
        tried.append(set(np.asarray(chosen).tolist()))
        return measure(chosen, steps)

    guesses = np.full(4, 0.9 * 0.1 * (1e-7 / SAFETY_FACTOR) ** (1 / ORDER))
    guesses[-1] *= 2
    choose_step_sizes(watched, paces, guesses, np.ones(4), 4, 1e-7)
    # Twice each, coarse and fine: all of them, the quickest, and the random few at the end.
    assert tried == [{0, 1, 2, 3}] * 2 + [{3}] * 2 + [{0, 1, 2, 3}] * 2


def test_a_guess_that_is_good_but_short_is_made_longer():
    paces, best = np.geomspace(1, 10, 20), np.full(20, 0.1)
    longest = 0.1 * (1e-7 / SAFETY_FACTOR) ** (1 / ORDER)
    steps, error = choose_step_sizes(
        task(paces, best), paces, np.full(20, 0.7 * longest), np.ones(20), 4, 1e-7
    )
    assert np.all(steps > 0.9 * longest) and error <= 1e-7 / SAFETY_FACTOR


def test_no_step_will_do():
    def measure(chosen, steps, more=0):
        return np.random.default_rng(int(1e9 * steps[0])).uniform(size=(len(chosen), 1, 1))

    paces = np.geomspace(1, 10, 8)
    with pytest.raises(RuntimeError, match="no time step makes the peaks agree to 1e-06"):
        choose_step_sizes(measure, paces, np.full(8, 0.1), np.full(8, 1.0), 4, 1e-6)


def test_error_is_that_of_the_worst_lane():
    def measure(chosen, steps, more=0):
        peaks = np.ones((len(chosen), 2, 1))
        peaks[:, 1] += steps[:, None]
        return peaks

    error = step_errors(measure, np.arange(2), np.array([0.3, 0.6]))
    np.testing.assert_allclose(error, [0.06 / 1.24, 0.12 / 1.48])


def test_spread_is_even_in_log_pace():
    """From half a gap above the slowest to the quickest."""
    paces = np.geomspace(1, 1e7, 71)[np.random.default_rng(1).permutation(71)]
    np.testing.assert_allclose(np.log10(paces[log_spaced_sample(paces, 3)]), [1.2, 4.1, 7.0])
    assert len(log_spaced_sample(np.ones(5), 3)) == 3


@given(st.integers(1, 200), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_one_is_drawn_from_each_part(tasks, count, seed):
    paces = np.random.default_rng(seed).permutation(np.geomspace(1, 10, tasks))
    ranks = np.sort(paces).searchsorted(paces[stratified_sample(paces, count)])
    edges = np.arange(count + 1) * tasks / count
    assert np.all((ranks + 1 > edges[:-1]) & (ranks < edges[1:]))
    np.testing.assert_array_equal(stratified_sample(paces, count), stratified_sample(paces, count))


def test_the_more_tasks_the_more_are_tried():
    for tasks, tried in ((64, 4), (1024, 16), (16384, 64)):
        asked, paces = [], np.geomspace(1, 10, tasks)
        measure = task(paces, np.full(tasks, 0.1))

        def watched(chosen, steps, more=0, asked=asked, measure=measure):
            asked.append(len(chosen))
            return measure(chosen, steps)

        choose_step_sizes(watched, paces, np.full(tasks, 0.01), np.ones(tasks), 4, 1e-7)
        assert asked[-1] == tried


def test_between_two_paces_the_shorter_step_holds():
    """Runs between may be worse than both, so nothing is interpolated."""
    paces = np.geomspace(1, 10, 41)
    measured = np.sort(log_spaced_sample(paces, 4))
    best = np.full(41, 0.2)
    best[measured[2]] = 0.1
    guesses = np.full(41, 0.02)
    steps, _ = choose_step_sizes(task(paces, best), paces, guesses, np.ones(41), 4, 1e-7)
    near = np.arange(measured[1] + 1, measured[3])
    np.testing.assert_allclose(steps[near], steps[measured[2]])
    assert np.all(steps[[measured[1], measured[3]]] > 1.4 * steps[measured[2]])
