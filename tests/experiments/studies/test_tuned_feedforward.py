"""The tuned laws that are kept: what they are, and that they do what is said of them."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from experiments.studies import tune_feedforward, tuned_feedforward
from jaxbeam import rigs


@pytest.mark.parametrize("rig", ["B", "C"])
def test_laws_that_are_kept_are_those_of_the_search(rig):
    law = jb.load_case(tune_feedforward.FOLDER / f"{rig}.toml").controller
    start = tune_feedforward.start(rig)
    assert law.values.shape == start.values.shape
    np.testing.assert_allclose(law.shares, start.shares)
    assert np.all((law.values >= -2.5) & (law.values <= 7.5))
    late = tuned_feedforward.on_bench(law, 0.01)
    assert float(late.lead - law.lead) == pytest.approx(tuned_feedforward.DELAY)
    assert float(late.delay) == pytest.approx(tuned_feedforward.DELAY + 0.01)


@pytest.mark.parametrize("rig", ["B", "C"])
def test_it_is_proven_on_other_loads_than_it_was_tuned_on(rig):
    trained = tune_feedforward.training(rig)
    assert {run["loads.0.mass"] for run in trained}.isdisjoint(tuned_feedforward.MASSES)
    assert {run["loads.0.speed"] for run in trained}.isdisjoint(tuned_feedforward.SPEEDS[rig])
    assert tuned_feedforward.ENTRY not in {run["loads.0.entry_time"] for run in trained}


@pytest.mark.slow
def test_a_load_that_was_held_out_comes_near_what_is_possible():
    """On the bench, with the rig's own beam, against the linear program."""
    law = tuned_feedforward.on_bench(jb.load_case(tune_feedforward.FOLDER / "B.toml").controller)
    case = dataclasses.replace(rigs.load("B"), controller=law, run=jb.Run(0.85, 200.0))
    case = jb.replace(
        case, {"loads.0.mass": 0.42, "loads.0.speed": 0.95, "loads.0.entry_time": 0.054}
    )
    assert 0.93 < jb.bound(case).share(jb.simulate(case, tolerance=1e-4)) < 1.0
