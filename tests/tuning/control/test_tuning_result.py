"""What a tuning says: the metrics that were tuned, and peaks on either side of no control."""

import dataclasses
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from numpy.testing import assert_allclose

import jaxbeam as jb
import tuning
from jaxbeam.case.controller import Measurement
from jaxbeam.control.feedforward import hand_drawn_law
from jaxbeam.model.deflection_lines import influence_line
from tests.tuning.small_rig import GAIN, rig
from tuning.control.run_set import run_case
from tuning.control.tuning_result import (
    HAND_DRAWN,
    RunSetResult,
    TuningResult,
    compare_runs,
    hand_drawn_peaks,
    hand_drawn_sentence,
)


def result(peak_after: float, peak_before: float = 0.9, **objective) -> TuningResult:
    metrics = {"peak": peak_after, "rms": 0.4, "effort": 0.2}
    outcome = RunSetResult(
        "held out",
        ({"loads.0.mass": 0.3},),
        np.array([1e-3]),
        np.array([peak_before * 1e-3]),
        np.array([peak_after * 1e-3]),
        np.array([np.nan]),
        np.zeros(1),
        [0.9, 0.8],
        metrics,
        {"peak": peak_before, "rms": 0.7, "effort": 0.1},
    )
    case = jb.Case(jb.Beam(0.6, 11.68, 0.535), loads=[jb.MovingMass(mass=0.5, speed=1.25)])
    return TuningResult(
        case, [], np.zeros(0), tuning.Objective(**objective), np.zeros((1, 1)), 0, [outcome]
    )


def test_peaks_above_no_control_are_called_so():
    assert "peak 8.8% above no control (10.0% below no control before" in result(1.088).verdict
    assert "peak 8.8% below no control (10.0% before tuning)" in result(0.912).verdict
    assert "peak 8.8% above no control (20.0% before tuning)" in result(1.088, 1.2).verdict


def test_a_run_that_leaves_a_number_shows_that_of_the_case():
    """A speed that only one of two runs sets was printed as nan."""
    two = dataclasses.replace(
        result(0.9).run_sets[0],
        runs=({"loads.0.mass": 0.3}, {"loads.0.speed": 2.5, "profile.seed": 7}),
        uncontrolled_peaks=np.ones(2),
        peaks_before=np.ones(2),
        peaks_after=np.ones(2),
        least_peaks=np.full(2, np.nan),
        saturated_share=np.zeros(2),
    )
    road = jb.profiles.ISO8608Profile("A", seed=3)
    case = dataclasses.replace(result(0.9).case, profile=road)
    own = dataclasses.replace(result(0.9), case=case, run_sets=[two])
    first, second = (line.split()[:3] for line in str(own).splitlines() if "1000.0000" in line)
    assert first == ["0.3", "1.25", "-"] and second == ["0.5", "2.5", "7"]


def test_the_metrics_that_were_tuned_are_shown():
    text = str(result(0.9, weights={"rms": 2.0}, aggregation="mean", limits={"effort": 0.15}))
    lines = text.splitlines()
    start = lines.index("what was tuned, mean of the runs")
    assert lines[start + 1].split() == [
        "metric",
        "weight",
        "limit",
        "held",
        "out",
        "before",
        "after",
    ]
    assert lines[start + 2].split() == ["rms", "2", "-", "0.7", "0.4"]
    assert lines[start + 3].split() == ["effort", "-", "0.15", "0.1", "0.2"]
    assert "peak" not in "".join(lines[start : start + 4])


# Properties of every tuning, on random cases.

CUTOFF, POSITION = "sensors.0.filter.cutoff", "sensors.0.position"
FREE = {GAIN: (-9000.0, 9000.0), CUTOFF: (5.0, 45.0), POSITION: (0.1, 0.5)}

PROBLEMS = {
    "gain": st.floats(-4000.0, 8000.0),
    "rigidity": st.floats(9.0, 16.0),
    "damping": st.floats(0.0, 0.1),
    "position": st.floats(0.15, 0.45),
    "cutoff": st.floats(8.0, 40.0),
    "masses": st.lists(st.floats(0.05, 0.6), min_size=3, max_size=3, unique=True),
    "speeds": st.lists(st.floats(1.3, 2.5), min_size=3, max_size=3),
}


def small(gain, rigidity, damping, position, cutoff) -> jb.Case:
    """A rig of two modes with one sensor behind a filter, under linear feedback."""
    case = rig(jb.Feedback([gain], period=0.01))
    beam = dataclasses.replace(
        case.beam,
        modes=2,
        flexural_rigidity=np.asarray(rigidity),
        damping_ratio=np.asarray(damping),
    )
    sensor = jb.Sensor(position, filter=jb.Filter(cutoff, order=2))
    return dataclasses.replace(case, beam=beam, sensors=(sensor,))


def peak(case: jb.Case, position: float) -> float:
    """Largest deflection (m) at samples, at a position that does not move with the sensor."""
    return float(np.abs(jb.simulate(case).at([position])).max())


def relative_peak(case: jb.Case, position: float) -> float:
    """Peak relative to that of the run without control."""
    return peak(case, position) / peak(dataclasses.replace(case, controller=None), position)


@settings(max_examples=4)
@given(st.fixed_dictionaries(PROBLEMS))
def test_the_objective_never_rises_and_is_that_of_the_saved_case(problem):
    speeds = problem.pop("speeds")
    runs = [
        {"loads.0.mass": mass, "loads.0.speed": speed}
        for mass, speed in zip(problem.pop("masses"), speeds, strict=True)
    ]
    cases = tuning.LoadCases(tuple(runs[:2]), tuple(runs[2:]))
    case = small(**problem)
    tuned = tuning.tune(case, FREE, cases, steps=4, least_peaks=False, progress=False)
    training, held_out = tuned.run_sets
    before, after = training.objective
    assert after <= before
    assert all(low <= value <= high for (low, high), value in
               zip(FREE.values(), tuned.values, strict=True))  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "tuned.toml"
        jb.save_case(tuned.case, file)
        saved = jb.load_case(file)
    # The true objective is that of the saved case, simulated run by run.
    position = float(case.sensors[0].position)
    peaks = [relative_peak(run_case(saved, run), position) for run in cases.training]
    assert after == pytest.approx(max(peaks), rel=1e-3)
    # The same for the held-out run; peaks between samples may be slightly larger.
    saved_run = run_case(saved, cases.held_out[0])
    assert 1 - 1e-3 < held_out.peaks_after[0] / peak(saved_run, position) < 1.02
    below = 1 - held_out.peaks_after[0] / held_out.uncontrolled_peaks[0]
    assert f"worst held out run: peak {below:.1%} below no control" in tuned.verdict


# Controllers over random runs, beside the law drawn by hand.

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
    assert hand_drawn_sentence(outcome, peaks) == (
        "drawn by hand, with no number tuned: worst held-out run: peak 50.0% below no control; of"
        " the attainable reduction at least 66.7%, 66.7% in the mean"
    )
    assert hand_drawn_peaks(dataclasses.replace(CASE, actuators=()), runs) is None


@pytest.mark.parametrize("case", [dataclasses.replace(CASE, loads=())])
def test_errors(case):
    with pytest.raises(ValueError, match="needs a load and an actuator"):
        hand_drawn_law(case)
