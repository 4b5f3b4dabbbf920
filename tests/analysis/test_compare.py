"""Comparison of controllers: metrics against the records, the picture, the command."""

import dataclasses
import json

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
import scipy.signal
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.compare import (
    Comparison,
    PerformanceMetrics,
    compare,
    metrics_over_cases,
    worst_comparison,
)
from jaxbeam.analysis.stability import LOAD_POSITIONS, stability_margin
from jaxbeam.cli import main
from jaxbeam.files.case_file import load_controller
from jaxbeam.plot import plot_comparison
from tests.case.test_actuators import LOOPS, PERIOD, by_its_equations, crossing, shaker
from tests.loop_as_oracle import span_of
from tests.plot.figures import words

CASE = """
title = "one span, one patch"
[beam]
length = 0.6
flexural_rigidity = 13.211
mass_per_length = 0.812
damping_ratio = 0.03
modes = 2
[[actuators]]
kind = "patch"
start = 0.2575
end = 0.3425
moment_per_volt = 8.292e-4
correction = 0.32
amplifier_gain = 200.0
limits = [-2.5, 7.5]
[[sensors]]
position = 0.3
[[loads]]
kind = "mass"
mass = 0.509
speed = 2.0
[run]
duration = 0.4
sample_rate = 500.0
"""
LOW_GAIN = """
[controller]
kind = "feedback"
gains = [2000.0]
period = 0.01
"""
UNSTABLE = """
[controller]
kind = "feedback"
gains = [-8000.0]
period = 0.01
"""
OPEN_LOOP = """
[controller]
kind = "prescribed"
offsets = [1.0]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Folder with a case that has a controller, and two files of controllers."""
    path = tmp_path_factory.mktemp("compare")
    (path / "weak.toml").write_text(CASE + LOW_GAIN)
    (path / "wild.toml").write_text(UNSTABLE)
    (path / "constant.toml").write_text(OPEN_LOOP)
    return path


@pytest.fixture(scope="module")
def comparison(folder):
    case = jb.load_case(folder / "weak.toml")
    return compare(case, {"weak": case.controller, "wild": load_controller(folder / "wild.toml")})


def test_metrics_match_the_records(comparison):
    assert list(comparison.records) == list(comparison.metrics) == ["weak", "wild"]
    assert comparison.case.controller is None
    assert comparison.uncontrolled.case.controller is None
    for name, record in comparison.records.items():
        metrics, deflection = comparison.metrics[name], np.asarray(record.deflection)[:, 0]
        assert metrics.peak == record.peak_deflection[0]
        assert_allclose(metrics.rms**2, np.mean(deflection**2), rtol=1e-12)
        assert metrics.after_exit == np.max(np.abs(deflection[np.asarray(record.times) > 0.3]))
        assert metrics.saturated.shape == metrics.effort.shape == (1,)
        assert_allclose(metrics.effort[0], np.trapezoid(record.command[:, 0] ** 2, record.times))
        reduction = comparison.bound.uncontrolled - metrics.peak
        attainable = comparison.bound.uncontrolled - comparison.bound.peak
        assert_allclose(metrics.share, reduction / attainable, rtol=1e-12)
    assert 0 < comparison.metrics["weak"].share < 1
    assert comparison.metrics["wild"].share < 0
    assert comparison.metrics["wild"].saturated[0] > 0.1 > comparison.metrics["weak"].saturated[0]
    assert comparison.bound.share(comparison.optimal) > 0.99


def critical_gain(case: jb.Case, position: float) -> float:
    """Gain at which the sampled loop turns unstable with the mass stationary at a position (m)."""
    span, mass, period = span_of(case), 0.509, 0.01
    n, under, output = span.modes, span.shapes(position), span.shapes(0.3)
    forces = 8.292e-4 * 0.32 * 200.0 * (span.shapes(0.2575, 1) - span.shapes(0.3425, 1))
    mobility = np.linalg.inv(np.eye(n) + mass * np.outer(under, under))
    damping = np.diag(2 * 0.03 * span.frequencies)
    lower = -mobility @ np.hstack([np.diag(span.frequencies**2), damping])
    A = np.vstack([np.hstack([np.zeros((n, n)), np.eye(n)]), lower])
    B, C = np.append(np.zeros(n), mobility @ forces)[:, None], np.append(output, np.zeros(n))[None]
    system = scipy.signal.cont2discrete((A, B, C, np.zeros((1, 1))), period)
    transition, force_response = np.asarray(system[0]), np.asarray(system[1])

    def excess(gain):
        return np.abs(np.linalg.eigvals(transition - gain * force_response @ C)).max() - 1

    return scipy.optimize.brentq(excess, 0.0, 2e4)


def test_margin_is_the_smallest_over_stationary_positions(comparison):
    gains = [
        critical_gain(comparison.records["weak"].case, x)
        for x in np.linspace(0, 0.6, LOAD_POSITIONS)
    ]
    assert_allclose(
        comparison.metrics["weak"].stability_margin.gain, min(gains) / 2000.0, rtol=1e-9
    )
    assert 0 < comparison.metrics["weak"].stability_margin.delay < 0.01
    assert comparison.metrics["weak"].stability_margin.obstacle == ""


def test_loops_without_a_margin_name_the_obstacle(comparison, folder):
    slow = dataclasses.replace(comparison.case.sensors[0], sampling_period=jnp.asarray(0.02))
    open_loop = load_controller(folder / "constant.toml")
    for changes, obstacle in (
        ({"controller": open_loop}, "do not depend on readings"),
        ({"controller": jb.MPC(4, 2, 1e-9, period=0.01)}, "not linear at its limits"),
        (
            {"controller": comparison.records["weak"].case.controller, "sensors": (slow,)},
            "sensors.0.sampling_period must be the controller's",
        ),
    ):
        missing = stability_margin(dataclasses.replace(comparison.case, **changes))
        assert np.isnan(missing.gain) and np.isnan(missing.delay)
        assert obstacle in missing.obstacle


def test_picture_names_every_run(comparison):
    figure = plot_comparison(comparison)
    written = words(figure)
    for part in ("no control", "weak", "wild", "optimal commands", "limit 7.50", "command (V)"):
        assert part in written
    assert f"({comparison.metrics['weak'].share:.0%})" in written
    top = figure.axes[0]
    lines = {line.get_label(): line.get_ydata() for line in top.get_lines()}
    assert_allclose(lines["weak"], 1e3 * comparison.records["weak"].deflection[:, 0])
    assert any(np.allclose(y, -1e3 * comparison.bound.peak) for y in lines.values() if len(y) == 2)


def test_picture_marks_diverging_controllers(comparison):
    diverged = jnp.full(comparison.uncontrolled.deflection.shape[:1] + (2,), jnp.nan)
    unknown = jnp.full(1, jnp.nan)
    parts = {"coordinates": diverged, "peak_deflection": unknown, "peak_time": unknown}
    record = dataclasses.replace(comparison.records["wild"], **parts)
    diverging = dataclasses.replace(comparison, records={"wild": record})
    assert "wild diverges" in words(plot_comparison(diverging))


def test_comparison_needs_a_controller(comparison):
    with pytest.raises(ValueError, match="give at least one controller"):
        compare(comparison.case, {})


def test_invalid_controller_is_named(comparison):
    with pytest.raises(ValueError, match="two: controller.gains must list one gain for each of 1"):
        compare(comparison.case, {"two": jb.Feedback([1.0, 2.0], period=0.01)})


def run(line: str, folder, monkeypatch, capsys) -> tuple[int, str, str]:
    monkeypatch.chdir(folder)
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    printed = capsys.readouterr()
    return ended.value.code, printed.out, printed.err


def test_command_prints_and_draws(comparison, folder, monkeypatch, capsys):
    line = "compare weak.toml --controllers wild.toml constant.toml"
    code, printed, errors = run(f"{line} -o out.png", folder, monkeypatch, capsys)
    assert code == 0, errors
    assert f"below {comparison.bound.peak:.6g} m" in printed
    assert f"{comparison.metrics['weak'].share:.1%}" in printed
    assert "constant: every load presses on the beam throughout" in printed
    assert f"wild: {comparison.loop_summary('wild')}; every load presses on the beam" in printed
    assert f"{comparison.metrics['weak'].stability_margin.gain:.3g}" in printed
    assert "no margin of constant: commands that do not depend on readings close no loop" in printed
    assert (folder / "out.png").read_bytes().startswith(b"\x89PNG")
    code, printed, errors = run(f"{line} --json --period 0.02", folder, monkeypatch, capsys)
    assert code == 0, errors
    answer = json.loads(printed)
    assert answer["held_for"] == 0.02
    assert answer["least_peak"] >= comparison.bound.peak * (1 - 1e-6)
    assert answer["controllers"]["weak"]["peak"] == comparison.metrics["weak"].peak
    assert answer["controllers"]["wild"]["stability_margin"]["gain"] is None  # infinite


def test_metrics_over_several_load_cases(comparison, folder, monkeypatch, capsys):
    line = "compare weak.toml --over loads.0.mass=0.3,0.509"
    code, printed, errors = run(f"{line} --json", folder, monkeypatch, capsys)
    assert code == 0, errors
    answer = json.loads(printed)
    light, heavy = (case["controllers"]["weak"] for case in answer["cases"])
    assert [case["values"] for case in answer["cases"]] == [
        {"loads.0.mass": 0.3},
        {"loads.0.mass": 0.509},
    ]
    assert heavy["peak"] == pytest.approx(comparison.metrics["weak"].peak, rel=1e-6)
    summary = answer["over_all"]["weak"]
    assert summary["peak"] == max(light["peak"], heavy["peak"])
    assert summary["worst_share"] == min(light["share"], heavy["share"])
    assert summary["mean_share"] == pytest.approx((light["share"] + heavy["share"]) / 2)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "compare weak.toml --over loads.0.mass=0.1,0.2 -o out.png",
            "a picture shows one load case: leave out -o or --over",
        ),
        ("compare weak.toml --over loads.0.mass=-0.1", "loads.0.mass must not be negative"),
        ("compare bare.toml", "bare.toml has no controller; name some with --controllers FILE"),
        (
            "compare weak.toml --controllers bare.toml",
            "bare.toml: has no controller; write a table",
        ),
        (
            "compare bare.toml --controllers ./weak.toml weak.toml",
            "two controllers are called weak",
        ),
        ("compare weak.toml --controllers none.toml", "cannot read the case file none.toml"),
        ("compare weak.toml --controllers odd.toml", "odd.toml: controller must be one table"),
        (
            "compare weak.toml -o out.gif",
            "a picture is written to a .png file; call it out.png, or .svg, .pdf",
        ),
    ],
)
def test_errors_are_named(folder, monkeypatch, capsys, line, message):
    (folder / "bare.toml").write_text(CASE)
    (folder / "odd.toml").write_text("controller = 1")
    code, printed, errors = run(line, folder, monkeypatch, capsys)
    assert (code, printed) == (2 if "leave out -o" in message else 1, "")
    assert message in errors


@pytest.mark.parametrize(
    ("peaks", "shares", "worst", "least"),
    [
        ([1.0, 2.0, 3.0], [0.9, 0.2, 0.5], 1, 0.2),
        ([1.0, np.nan, 3.0], [0.9, np.nan, 0.2], 1, np.nan),  # it diverges
        ([1.0, 2.0, 3.0], [0.9, np.nan, 0.2], 2, 0.2),  # nothing can be attained
        ([1.0, np.nan, np.nan], [np.nan, np.nan, np.nan], 1, np.nan),
        ([1.0], [np.nan], 0, np.nan),
    ],
)
def test_the_worst_run_is_the_one_that_is_named(peaks, shares, worst, least):
    comparisons = []
    for peak, share in zip(peaks, shares, strict=True):
        metrics = PerformanceMetrics(peak, 0.0, 0.0, np.zeros(1), np.zeros(1), share, None, ())
        comparison = object.__new__(Comparison)
        object.__setattr__(comparison, "metrics", {"law": metrics})
        comparisons.append(comparison)
    assert worst_comparison(comparisons, "law") == worst
    assert_allclose(metrics_over_cases(comparisons)["law"].worst_share, least)


def test_limits_of_a_voltage_leave_the_bound_out(tmp_path, monkeypatch, capsys):
    """The run without control by scipy: the loop keeps the current at zero as far as it can."""
    limits, law = [-0.2, 0.3], jb.Feedback([1e3], period=PERIOD)
    case = crossing(shaker(LOOPS["current"], limits=limits), controller=law)
    found = compare(case, {"law": law})
    times = np.asarray(found.uncontrolled.times)
    expected, *_ = by_its_equations(LOOPS["current"], times, 0.0, limits)
    deflection = found.uncontrolled.deflection[:, 0]
    assert_allclose(deflection, expected, atol=1e-6 * np.abs(expected).max())
    assert found.metrics["law"].peak == jb.simulate(case).peak_deflection[0]
    assert found.bound is None and found.optimal is None
    assert "no least achievable peak, as actuators.0.limits bound the voltage" in found.headline
    assert "optimal commands" not in words(plot_comparison(found))
    jb.save_case(case, tmp_path / "case.toml")
    code, shown, _ = run("compare case.toml", tmp_path, monkeypatch, capsys)
    assert code == 0
    assert found.headline in shown and f"{found.metrics['law'].peak:.6g}" in shown
    _, shown, _ = run("compare case.toml --json", tmp_path, monkeypatch, capsys)
    answer = json.loads(shown)
    assert answer["least_peak"] is None and answer["headline"] == found.headline
    light = compare(jb.replace(case, {"loads.0.mass": 0.05}), {"law": law})
    assert light.metrics["law"].peak < found.metrics["law"].peak
    assert worst_comparison([light, found], "law") == 1
