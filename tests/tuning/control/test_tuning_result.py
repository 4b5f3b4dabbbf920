"""What a tuning says: the metrics that were tuned, and peaks on either side of no control."""

import numpy as np

import jaxbeam as jb
import tuning
from tuning.control.tuning_result import RunSetResult, TuningResult


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
    case = jb.Case(jb.Beam(0.6, 11.68, 0.535))
    return TuningResult(
        case, [], np.zeros(0), tuning.Objective(**objective), np.zeros((1, 1)), 0, [outcome]
    )


def test_peaks_above_no_control_are_called_so():
    assert "peak 8.8% above no control (10.0% below no control before" in result(1.088).verdict
    assert "peak 8.8% below no control (10.0% before tuning)" in result(0.912).verdict
    assert "peak 8.8% above no control (20.0% before tuning)" in result(1.088, 1.2).verdict


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
