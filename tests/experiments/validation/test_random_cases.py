"""Checks of random cases: what is left is taken up again, and what is wrong is told."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import jaxbeam as jb
from experiments.validation.random_cases import __main__ as random_cases
from experiments.validation.random_cases.checks import (
    Errors,
    Outcome,
    TooLongError,
    at_most,
    beside_scipy,
    contact_faults,
)
from experiments.validation.random_cases.drawing import draw


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
