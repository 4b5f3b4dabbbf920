"""Modes that a user chooses among those found, whatever the criteria."""

import numpy as np
import pytest

from tests.tuning.modal.test_leaving import mode
from tests.tuning.modal.test_modal import ambient
from tuning import ModalSettings, identify_modes
from tuning.modal.arguments import chosen_modes

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
        ({"order": 3}, "the highest order must be at least 4, not 3"),
        ({"force_window": -1.0}, "the force window must last longer than 0 s, not -1 s"),
        ({"choose": [0.0]}, "by frequencies above 0 Hz, not 0 Hz"),
        ({"choose": [3.0], "count": 1}, "leave out count"),
        ({"choose": [3.0], "exclude": [50.0]}, "leave out exclude"),
    ],
)
def test_choices_that_contradict_each_other(options, message):
    with pytest.raises(ValueError, match=message):
        ModalSettings(**options)
