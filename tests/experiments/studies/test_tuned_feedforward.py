"""The tuned feedforward laws in the repository: bounds, held-out loads, and their performance."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from experiments.studies import tune_feedforward, tuned_feedforward
from experiments.studies.loads import held_out_loads, training_loads
from jaxbeam import rigs


@pytest.mark.parametrize("rig", ["B", "C"])
def test_stored_laws_have_the_breakpoints_and_limits_of_the_search(rig):
    law = jb.load_case(tune_feedforward.FOLDER / f"{rig}.toml").controller
    start = tune_feedforward.initial_law(rig)
    assert law.values.shape == start.values.shape
    np.testing.assert_allclose(law.shares, start.shares)
    assert np.all((law.values >= -2.5) & (law.values <= 7.5))
    late = tuned_feedforward.with_bench_delay(law, 0.01)
    assert float(late.lead - law.lead) == pytest.approx(tuned_feedforward.DELAY)
    assert float(late.delay) == pytest.approx(tuned_feedforward.DELAY + 0.01)


@pytest.mark.parametrize("rig", ["B", "C"])
@pytest.mark.parametrize("number", ["mass", "speed", "entry_time"])
def test_held_out_loads_are_not_among_the_training_loads(rig, number):
    address = f"loads.0.{number}"
    training = {load[address] for load in training_loads(tune_feedforward.SPEEDS[rig])}
    assert training.isdisjoint({load[address] for load in held_out_loads(rig)})


def test_peak_of_a_held_out_load_is_near_the_least_achievable():
    """On the bench, with the rig's own beam, against the linear program."""
    stored = jb.load_case(tune_feedforward.FOLDER / "B.toml").controller
    law = tuned_feedforward.with_bench_delay(stored)
    case = dataclasses.replace(rigs.load("B"), controller=law, run=jb.Run(0.85, 200.0))
    case = jb.replace(
        case, {"loads.0.mass": 0.42, "loads.0.speed": 0.95, "loads.0.entry_time": 0.054}
    )
    assert 0.93 < jb.bound(case).share(jb.simulate(case, tolerance=1e-4)) < 1.0
