"""The laws from sensors alone that are kept: what they are, and that they do what is said."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from experiments import sensed, sensed_search, tuned
from jaxbeam import rigs
from jaxbeam.case import known_case
from jaxbeam.modes import lay_out
from jaxbeam.stability import frozen_poles
from tuning.believing import believing


@pytest.mark.parametrize("rig", ["B", "C"])
def test_laws_that_are_kept_are_those_of_the_search(rig):
    case = jb.load_case(sensed_search.FOLDER / f"{rig}.toml")
    law, start = case.controller, sensed_search.start(rig)
    np.testing.assert_allclose(law.readings, start.readings)
    assert law.values.shape == start.values.shape
    assert np.all((law.values >= -2.5) & (law.values <= 7.5))
    # No command without a load, and all of the bench in the loop.
    assert np.all(np.asarray(law.values)[:, np.asarray(law.readings) == 0.0] == 0.0)
    assert float(law.delay) == 0.02 and float(law.period) == 0.01
    assert all(float(s.noise) == 4e-6 and s.filter.order == 10 for s in case.sensors)


@pytest.mark.parametrize("rig", ["B", "C"])
def test_it_is_proven_on_other_loads_than_it_was_tuned_on(rig):
    trained = sensed_search.training()
    assert {run["loads.0.mass"] for run in trained}.isdisjoint(tuned.MASSES)
    assert {run["loads.0.speed"] for run in trained}.isdisjoint(tuned.SPEEDS[rig])
    assert tuned.ENTRY not in {run["loads.0.entry_time"] for run in trained}
    assert sensed.prepared(rig, rigs.load(rig))[0].run.seed != rigs.load(rig).run.seed


@pytest.mark.slow
def test_a_load_that_was_held_out_comes_near_what_is_possible():
    """From sensors alone, 10 ms later than it knows, against the linear program."""
    real, loads = sensed.prepared("B", rigs.load("B"))
    fastest = {"loads.0.mass": 0.322, "loads.0.speed": 0.95}
    run = next(load for load in loads if fastest.items() <= load.items())
    late = dataclasses.replace(real.controller, delay=np.asarray(0.03))
    case = jb.replace(dataclasses.replace(real, controller=late, run=jb.Run(0.85, 200.0)), run)
    assert 0.85 < jb.bound(case).share(jb.simulate(case, tolerance=1e-4)) < 1.0


def test_without_a_load_it_is_stable_late_and_on_another_beam():
    """On both sides of the bend at rest; the case itself is changed, its law is not."""
    real, _ = sensed.prepared("B", rigs.load("B"))
    for side in (-1, 1):
        law = real.controller
        law = dataclasses.replace(
            law, delay=np.asarray(0.03), readings=law.readings + side * sensed.BESIDE
        )
        case = dataclasses.replace(real, controller=law)
        for factor in (0.9, 1.1):
            believed = {tuned.RIGIDITY: float(case.beam.flexural_rigidity)}
            off = jb.replace(case, {tuned.RIGIDITY: factor * believed[tuned.RIGIDITY]})
            off = believing(off, believed, lay_out(known_case(off)))
            assert frozen_poles(off, np.zeros(1)).largest[0] < 0.0
