"""The laws from sensors alone that are kept: what they are, and that they do what is said."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from experiments.studies import sensor_feedback, tune_sensor_feedback, tuned_feedforward
from jaxbeam import rigs
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.case.case import known_case
from jaxbeam.model.modes import lay_out
from tuning.control.fixed_design import with_fixed_design


@pytest.mark.parametrize("rig", ["B", "C"])
def test_laws_that_are_kept_are_those_of_the_search(rig):
    case = jb.load_case(tune_sensor_feedback.FOLDER / f"{rig}.toml")
    law, start = case.controller, tune_sensor_feedback.start(rig)
    np.testing.assert_allclose(law.readings, start.readings)
    assert law.values.shape == start.values.shape
    assert np.all((law.values >= -2.5) & (law.values <= 7.5))
    # No command without a load, and all of the bench in the loop.
    assert np.all(np.asarray(law.values)[:, np.asarray(law.readings) == 0.0] == 0.0)
    assert float(law.delay) == 0.02 and float(law.period) == 0.01
    assert all(float(s.noise) == 4e-6 and s.filter.order == 10 for s in case.sensors)


@pytest.mark.parametrize("rig", ["B", "C"])
def test_it_is_proven_on_other_loads_than_it_was_tuned_on(rig):
    trained = tune_sensor_feedback.training(rig)
    assert {run["loads.0.mass"] for run in trained}.isdisjoint(tuned_feedforward.MASSES)
    assert {run["loads.0.speed"] for run in trained}.isdisjoint(tuned_feedforward.SPEEDS[rig])
    assert tuned_feedforward.ENTRY not in {run["loads.0.entry_time"] for run in trained}
    assert sensor_feedback.prepared(rig, rigs.load(rig))[0].run.seed != rigs.load(rig).run.seed


@pytest.mark.slow
def test_a_load_that_was_held_out_comes_near_what_is_possible():
    """From sensors alone, 10 ms later than it knows, against the linear program."""
    real, loads = sensor_feedback.prepared("B", rigs.load("B"))
    fastest = {"loads.0.mass": 0.322, "loads.0.speed": 0.95}
    run = next(load for load in loads if fastest.items() <= load.items())
    late = dataclasses.replace(real.controller, delay=np.asarray(0.03))
    case = jb.replace(dataclasses.replace(real, controller=late, run=jb.Run(0.85, 200.0)), run)
    assert 0.85 < jb.bound(case).share(jb.simulate(case, tolerance=1e-4)) < 1.0


def off(rig, side, factor, more=0.01, run=None):
    """The rig, its beam off by a factor, under the law as it was, late and bent to one side."""
    real, _ = sensor_feedback.prepared(rig, rigs.load(rig))
    real = dataclasses.replace(real, beam=dataclasses.replace(real.beam, modes=3))
    law = real.controller
    law = dataclasses.replace(
        law,
        delay=np.asarray(sensor_feedback.DELAY + more),
        readings=law.readings + side * sensor_feedback.BESIDE,
    )
    case = jb.replace(dataclasses.replace(real, controller=law), run or {})
    believed = {tuned_feedforward.RIGIDITY: float(case.beam.flexural_rigidity)}
    changed = jb.replace(
        case, {tuned_feedforward.RIGIDITY: factor * believed[tuned_feedforward.RIGIDITY]}
    )
    return with_fixed_design(changed, believed, lay_out(known_case(changed)))


@pytest.mark.parametrize("rig", ["B", "C"])
def test_without_a_load_it_is_stable_late_and_on_another_beam(rig):
    """On both sides of the bend at rest; the case itself is changed, its law is not."""
    for side in (-1, 1):
        for factor in (0.9, 1.1):
            assert frozen_poles(off(rig, side, factor), np.zeros(1)).largest_real_part[0] < 0.0


@pytest.mark.slow
def test_it_stays_stable_as_loads_leave_a_softer_beam():
    """On two spans, 10 ms late: near the far end, where the law is steep and the beam rings."""
    run = {"loads.0.mass": 0.322, "loads.0.speed": 0.95, "loads.0.entry_time": 0.0}
    times = 1.2 / 0.95 * np.linspace(0.85, 0.99, 8)
    for side in (-1, 1):
        assert frozen_poles(off("C", side, 0.9, run=run), times).largest_real_part.max() < 0.0


def test_corners_of_the_bench():
    """15 ms and the filter of the other rig, the case otherwise as it is."""
    assert set(sensor_feedback.corners("B").values()) == {
        (0.015, 10.0),
        (0.01, 20.0),
        (0.015, 20.0),
    }
    real, _ = sensor_feedback.prepared("C", rigs.load("C"))
    assert {float(s.filter.cutoff) for s in sensor_feedback.filtered(real, 10.0).sensors} == {10.0}
