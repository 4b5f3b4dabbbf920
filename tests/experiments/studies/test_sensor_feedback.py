"""The tuned laws from sensors alone in the repository: bounds, held-out loads, and stability."""

import dataclasses

import numpy as np
import pytest

import jaxbeam as jb
from experiments.studies import sensor_feedback, tune_sensor_feedback
from experiments.studies.held_out import RIGIDITY
from experiments.studies.loads import held_out_loads, training_loads
from jaxbeam import rigs
from jaxbeam.analysis.stability import frozen_poles
from jaxbeam.case.case import concrete_case
from jaxbeam.model.modes import mesh_layout
from tuning.control.objective import with_fixed_design


@pytest.mark.parametrize("rig", ["B", "C"])
def test_stored_laws_have_the_breakpoints_and_limits_of_the_search(rig):
    case = jb.load_case(tune_sensor_feedback.FOLDER / f"{rig}.toml")
    law, start = case.controller, tune_sensor_feedback.initial_law(rig)
    np.testing.assert_allclose(law.readings, start.readings)
    assert law.values.shape == start.values.shape
    assert np.all((law.values >= -2.5) & (law.values <= 7.5))
    # No command without a load, and the whole bench in the loop.
    assert np.all(np.asarray(law.values)[:, np.asarray(law.readings) == 0.0] == 0.0)
    assert float(law.delay) == 0.02 and float(law.period) == 0.01
    assert all(float(s.noise) == 4e-6 and s.filter.order == 10 for s in case.sensors)


@pytest.mark.parametrize("rig", ["B", "C"])
@pytest.mark.parametrize("number", ["mass", "speed", "entry_time"])
def test_held_out_loads_are_not_among_the_training_loads(rig, number):
    address = f"loads.0.{number}"
    changes = tune_sensor_feedback.plant_changes(rig)
    training = training_loads(tune_sensor_feedback.SPEEDS, changes)
    held_out = {load[address] for load in held_out_loads(rig)}
    assert {load[address] for load in training}.isdisjoint(held_out)


@pytest.mark.parametrize("rig", ["B", "C"])
def test_held_out_noise_has_another_seed(rig):
    bench = sensor_feedback.bench_case(rig, rigs.load(rig))
    assert bench.run.seed != tune_sensor_feedback.with_noise_and_filters(rig, bench).run.seed


def test_peak_of_a_held_out_load_is_near_the_least_achievable():
    """From sensors alone, with 10 ms more delay than designed for, against the linear program."""
    bench = sensor_feedback.bench_case("B", rigs.load("B"))
    fastest = {"loads.0.mass": 0.322, "loads.0.speed": 0.95}
    run = next(load for load in held_out_loads("B") if fastest.items() <= load.items())
    late = dataclasses.replace(bench.controller, delay=np.asarray(0.03))
    case = jb.replace(dataclasses.replace(bench, controller=late, run=jb.Run(0.85, 200.0)), run)
    assert 0.85 < jb.bound(case).share(jb.simulate(case, tolerance=1e-4)) < 1.0


def changed_plant(rig, side, factor, run=None):
    """The rig with another rigidity, the law as designed but 10 ms late and shifted to one side."""
    bench = sensor_feedback.bench_case(rig, rigs.load(rig))
    bench = dataclasses.replace(bench, beam=dataclasses.replace(bench.beam, modes=3))
    law = dataclasses.replace(
        bench.controller,
        delay=np.asarray(tune_sensor_feedback.DELAY + 0.01),
        readings=bench.controller.readings + side * tune_sensor_feedback.READING_OFFSET,
    )
    case = jb.replace(dataclasses.replace(bench, controller=law), run or {})
    design = {RIGIDITY: float(case.beam.flexural_rigidity)}
    plant = jb.replace(case, {RIGIDITY: factor * design[RIGIDITY]})
    return with_fixed_design(plant, design, mesh_layout(concrete_case(plant)))


@pytest.mark.parametrize("rig", ["B", "C"])
def test_loop_without_a_load_is_stable_with_more_delay_and_another_rigidity(rig):
    """With either slope of the table at rest; the plant is changed, the law is not."""
    for side in (-1, 1):
        for factor in (0.9, 1.1):
            poles = frozen_poles(changed_plant(rig, side, factor), np.zeros(1))
            assert poles.largest_real_part[0] < 0.0


def test_loop_is_stable_as_loads_leave_a_softer_beam():
    """On two spans, 10 ms late, near the far end, where the law is steep and the beam vibrates."""
    run = {"loads.0.mass": 0.322, "loads.0.speed": 0.95, "loads.0.entry_time": 0.0}
    times = 1.2 / 0.95 * np.linspace(0.85, 0.99, 8)
    for side in (-1, 1):
        poles = frozen_poles(changed_plant("C", side, 0.9, run=run), times)
        assert poles.largest_real_part.max() < 0.0


def test_untuned_conditions_have_the_longest_period_or_the_filter_of_the_other_rig():
    assert set(sensor_feedback.untuned_conditions("B").values()) == {
        (0.015, 10.0),
        (0.01, 20.0),
    }
    bench = sensor_feedback.bench_case("C", rigs.load("C"))
    changed = sensor_feedback.with_cutoff(bench, 10.0)
    assert {float(s.filter.cutoff) for s in changed.sensors} == {10.0}
