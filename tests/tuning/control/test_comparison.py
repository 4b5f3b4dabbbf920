"""Controllers over random runs, beside the law drawn by hand."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.hand_drawn import hand_drawn_law
from jaxbeam.case.controller import Measurement
from jaxbeam.model.deflection_lines import influence_line
from tuning.control.tuning_result import (
    HAND_DRAWN,
    RunSetResult,
    beside_hand_drawn,
    compare_runs,
    hand_drawn_peaks,
)

CASE = jb.Case(
    jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.03, modes=1),
    actuators=[jb.PointForce(0.3, limits=[-2.0, 5.0])],
    sensors=[jb.Sensor(0.3)],
    loads=[jb.MovingMass(mass=0.4, speed=2.0, entry_time=0.1)],
    run=jb.Run(0.5, 100.0),
)
REST = Measurement(np.zeros(1), np.zeros(2), np.zeros(1))


def test_drawn_from_limit_to_limit():
    """Up where the load is: one span always, the second of two downwards from the first."""
    weak = dataclasses.replace(CASE, actuators=(jb.PointForce(0.3, limits=[-0.2, 1.0]),))
    law = hand_drawn_law(weak, period=0.004, delay=0.002)
    table = np.interp([0.0, 0.2, 0.5, 0.9, 1.0], law.shares, law.values[0])
    assert_allclose(table, [0.0, 1.0, 1.0, 1.0, 0.0], atol=1e-12)
    assert_allclose(law.lead, 0.004)
    spans = dataclasses.replace(
        CASE, supports=(jb.Support(0.3),), actuators=(jb.PointForce(0.15, limits=[-0.2, 1.0]),)
    )
    values = hand_drawn_law(spans).values[0]
    assert values[5] == 1.0 and values[15] == -0.2


def test_drawn_without_limits():
    """The place under the load is lifted by what the load deflects it: W at the actuator itself."""
    free = dataclasses.replace(CASE, actuators=(jb.PointForce(0.3),))
    law = hand_drawn_law(free)
    assert_allclose(np.interp(0.5, law.shares, law.values[0]), 0.4 * 9.81, rtol=1e-9)
    ratio = influence_line(free, 0.15, 0.15) / influence_line(free, 0.15, 0.3)
    assert_allclose(np.interp(0.25, law.shares, law.values[0]), 0.4 * 9.81 * ratio, rtol=1e-9)


def test_gate_errors_delay_the_table():
    """Both gates farther by d: the load is taken to be d behind where it is."""
    law = hand_drawn_law(CASE)
    late = dataclasses.replace(law, gate_errors=[0.02, 0.02])
    plant = jb.state_space(CASE)
    on_time, delayed = (one.design_law(plant) for one in (law, late))
    for t in (0.15, 0.2, 0.31):
        found = delayed.step((), REST, np.asarray(t + 0.01)).command
        assert_allclose(found, on_time.step((), REST, np.asarray(t)).command, atol=1e-9)


def test_runs_change_loads_plant_delay_and_gates_but_not_the_design():
    law = jb.LQR([1e4, 1.0], [1e-2], period=0.02)
    run = {
        "loads.0.mass": 0.3,
        "beam.flexural_rigidity": 13.0,
        "controller.delay": 0.004,
        "controller.gate_errors.0": 0.01,
    }
    (found,) = compare_runs(CASE, {"lqr": law}, [run])
    assert list(found.metrics) == ["lqr", HAND_DRAWN]
    assert found.case.beam.flexural_rigidity == 13.0 and found.case.loads[0].mass == 0.3
    cases = [record.case for record in found.records.values()]
    assert all(case.controller.delay == 0.004 for case in cases)
    assert all(case.controller.nominal_plant.case.beam.flexural_rigidity == 12.0 for case in cases)
    assert_allclose(cases[1].controller.gate_errors, [0.01, 0.0])
    assert all(metrics.share < 1.001 for metrics in found.metrics.values())


def test_law_by_hand_beside_a_tuning():
    """Its peaks are those of simulations, and shares those of the runs of the tuning."""
    runs = {"loads.0.mass": 0.3}, {"loads.0.mass": 0.4}
    peaks = hand_drawn_peaks(CASE, runs)
    law = hand_drawn_law(dataclasses.replace(CASE, controller=None))
    found = [
        jb.simulate(jb.replace(dataclasses.replace(CASE, controller=law), run)).peak_deflection[0]
        for run in runs
    ]
    assert_allclose(peaks, found, rtol=1e-9)
    none = np.full(2, np.nan)
    outcome = RunSetResult("held-out", runs, 2 * peaks, none, none, peaks / 2, none, [1.0, 1.0])
    assert beside_hand_drawn(outcome, peaks) == (
        "drawn by hand, with no number tuned: worst held-out run: peak 50.0% below no control; of"
        " the attainable reduction at least 66.7%, 66.7% in the mean"
    )
    assert hand_drawn_peaks(dataclasses.replace(CASE, actuators=()), runs) is None


@pytest.mark.parametrize("case", [dataclasses.replace(CASE, loads=())])
def test_errors(case):
    with pytest.raises(ValueError, match="needs a load and an actuator"):
        hand_drawn_law(case)
