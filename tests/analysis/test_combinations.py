"""Combinations of actions against sums by hand, and effects of a force method on two spans."""

import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.combinations import combine, combined
from jaxbeam.cli import main

SPAN = jb.Case(jb.Beam(20.0, flexural_rigidity=6e9, mass_per_length=9e3, modes=3))
TWO = jb.Case(jb.Beam(40.0, 6e9, 9e3, modes=3), supports=[jb.Support(20.0)])
ACTIONS = {
    "girders": {"uniform": "self-weight"},
    "road": {"uniform": "12 kN/m"},
    "traffic": {"model": "LM1", "lane": "27 kN/m"},
}
FACTORS = {
    "persistent": {"girders": [1.35, 1.0], "road": [1.35, 1.0], "traffic": 1.35},
    "traffic alone": {"traffic": 1.0},
}


def test_design_moment_of_one_span_by_hand():
    """q L^2 / 8 of each load, and 2 * 300 kN at 4.7 m from the supports, as 1.2 m lie between."""
    found = combine(SPAN, ACTIONS, FACTORS, [10.0])
    dead, road = 9e3 * 9.81 * 400 / 8, 12e3 * 400 / 8
    traffic = 600e3 * 4.7 + 27e3 * 400 / 8
    assert_allclose(found.highest[:, 0], [1.35 * (dead + road + traffic), traffic], rtol=1e-6)
    assert_allclose(found.lowest[:, 0], [dead + road, 0.0], rtol=1e-6, atol=1.0)
    assert list(found.columns["highest by"]) == ["persistent"]
    assert list(found.columns["lowest by"]) == ["traffic alone"]


def line_of_two_spans(x: float, load: np.ndarray, length: float = 20.0) -> np.ndarray:
    """Moment at x in the first of two equal spans under 1 N, by the moment at the support.

    M_B = -a (L^2 - a^2) / (4 L^2) of a load at a from the outer support (three moments).
    """
    a = np.where(load <= length, load, 2 * length - load)
    at_support = -a * (length**2 - a**2) / (4 * length**2)
    simple = np.where(load <= x, load * (length - x) / length, x * (length - load) / length)
    return np.where(load <= length, simple, 0.0) + at_support * x / length


@pytest.mark.parametrize("x", [8.0, 20.0])
def test_two_spans_by_superposition(x):
    """Lines, areas and the worst place of two axles by hand; favourable parts get their factor."""
    load = np.linspace(0.0, 40.0, 40001)
    line = line_of_two_spans(x, load)
    step = load[1]
    beside = np.concatenate([line, np.zeros(2000)])
    pairs = 300e3 * (beside + np.concatenate([np.zeros(1200), beside])[: beside.size])
    extremes = {
        name: (
            sign * max(0.0, (sign * pairs).max()) + 27e3 * (sign * line).clip(0).sum() * step * sign
        )
        for name, sign in (("low", -1.0), ("high", 1.0))
    }
    dead = (9e3 * 9.81 + 12e3) * line.sum() * step
    found = combine(TWO, ACTIONS, FACTORS, [x])
    worst = [max(1.35 * dead, dead), min(1.35 * dead, dead)]
    expected = [worst[0] + 1.35 * extremes["high"], worst[1] + 1.35 * extremes["low"]]
    scale = abs(np.array(expected)).max()
    assert_allclose(found.highest[0, 0], expected[0], atol=2e-5 * scale)
    assert_allclose(found.lowest[0, 0], expected[1], atol=2e-5 * scale)


def test_reactions_shear_forces_and_moving_axles():
    """3/8, 5/4 and 3/8 of q L; shear on both sides of the support; a slow axle is a static one."""
    road = {"road": {"uniform": 12e3}}
    reactions = combine(TWO, road, {"one": {"road": 1.0}}, [0.0, 20.0, 40.0], quantity="reaction")
    assert_allclose(reactions.highest[0], 12e3 * 20 * np.array([3 / 8, 5 / 4, 3 / 8]), rtol=1e-5)
    shear = combine(TWO, road, {"one": {"road": 1.0}}, [20.0], quantity="shear")
    assert_allclose(
        [shear.lowest[0, 0], shear.highest[0, 0]], 12e3 * 20 * 5 / 8 * np.array([-1, 1]), rtol=1e-4
    )
    lorry = jb.Case(SPAN.beam, loads=[jb.MovingForce(force=1e5, speed=0.5)], run=jb.Run(40.0))
    moving = combine(lorry, {"lorry": {"loads": "case"}}, {"one": {"lorry": 2.0}}, [10.0])
    assert_allclose(moving.highest[0], 2 * 1e5 * 20 / 4, rtol=2e-3)


@pytest.mark.parametrize(
    ("actions", "factors", "message"),
    [
        ({"a": {}}, {"c": {"a": 1.0}}, "actions.a has one of uniform, model, loads"),
        ({"a": {"model": "LM1", "sped": 3.0}}, {"c": {"a": 1.0}}, "with a model speed, lane or"),
        ({"a": {"uniform": 1.0}}, {}, "nothing to combine"),
        (
            {"a": {"uniform": 1.0}},
            {"c": {"b": 1.0}},
            r"combinations\.c\.b: there is no such action",
        ),
        ({"a": {"uniform": 1.0}}, {"c": {"a": [1, 2, 3]}}, r"a factor, or two"),
        ({"a": {"uniform": "3 kg"}}, {"c": {"a": 1.0}}, r"actions\.a\.uniform must be in N/m"),
        ({"a": {"loads": "all"}}, {"c": {"a": 1.0}}, "the loads of the case as they move"),
        ({"a": {"model": "LM1", "speed": 20, "lane": 0}}, {"c": {"a": 1.0}}, "leave out speed"),
    ],
)
def test_wrong_tables_are_told(actions, factors, message):
    with pytest.raises(ValueError, match=message):
        combine(SPAN, actions, factors, [10.0])


def test_effects_computed_otherwise_are_combined():
    wind = np.array([-3.0]), np.array([1.0])
    low, high = combined({"wind": wind}, {"c": {"wind": [1.5, 0.0]}})
    assert (low, high) == ([[-4.5]], [[1.5]])


def test_design_values_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "case.toml").write_text(
        "[beam]\nlength = 20.0\nflexural_rigidity = 6e9\nmass_per_length = 9e3\n"
    )
    (tmp_path / "actions.toml").write_text(
        '[actions.road]\nuniform = "12 kN/m"\n[actions.traffic]\nmodel = "LM1"\n'
        "[combinations.persistent]\nroad = [1.35, 1.0]\ntraffic = 1.35\n"
    )
    for options in ([], ["--json"]):
        with pytest.raises(SystemExit) as ending:
            main(["combine", "case.toml", "actions.toml", "--quantity", "moment", *options])
        assert ending.value.code == 0
        printed = capsys.readouterr().out
        if not options:
            assert "moment at midspan" in printed and "persistent" in printed
            midspan = next(line for line in printed.splitlines() if "midspan" in line)
            assert midspan.split()[4:6] == ["MN", "m"]
            assert float(midspan.split()[8]) == pytest.approx(6.4395, rel=1e-4)  # by hand below
    found = json.loads(printed)
    at = found["x (m)"].index(10.0)
    expected = 1.35 * (12e3 * 400 / 8 + 600e3 * 4.7 + 27e3 * 400 / 8)
    assert found["highest persistent"][at] == pytest.approx(expected, rel=1e-6)
    (tmp_path / "actions.toml").write_text("[deeds.road]\nuniform = 1.0\n")
    with pytest.raises(SystemExit) as ending:
        main(["combine", "case.toml", "actions.toml"])
    assert ending.value.code == 2 and "[actions.NAME]" in capsys.readouterr().err
