"""Load models and combinations against PyCBA, closed forms, sums by hand, and crossings."""

import dataclasses
import json

import numpy as np
import pytest
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.analysis.combinations import combine, combined
from jaxbeam.analysis.load_models import (
    crossing_envelope,
    influence_at,
    load_model,
    load_model_envelope,
)
from jaxbeam.case.library.published import LoadModel, ModelVehicle, load_models
from jaxbeam.cli import main
from tests.modules import ROOT

PYCBA = json.loads((ROOT / "tests" / "data" / "load_models.json").read_text())
BEAM = jb.Beam(20.0, flexural_rigidity=6e9, mass_per_length=9e3, damping_ratio=0.01, modes=3)
SPAN = jb.Case(BEAM)


def two_spans(first: float, second: float) -> jb.Case:
    beam = jb.Beam(first + second, flexural_rigidity=6e9, mass_per_length=9e3)
    return jb.Case(beam, supports=[jb.Support(first)])


def vehicle(spacings, forces, lane: float = 0.0, **spacing) -> LoadModel:
    varied = {"varied": None, "between": None, "choices": ()} | spacing
    one = ModelVehicle("lorry", np.array(spacings), np.array(forces), lane, **varied)
    return LoadModel((one,), 0.0)


@pytest.mark.parametrize("name", PYCBA["vehicles"])
def test_extremes_of_two_spans_are_those_of_pycba(name):
    """Six digits: that program moves the lorry in steps of 0.05 m, in both directions."""
    case, numbers = two_spans(*map(float, PYCBA["spans"])), PYCBA["vehicles"][name]
    lorry = vehicle(numbers["spacings"], 1e3 * np.array(numbers["forces"]))
    moment = load_model_envelope(case, lorry, [25.0])
    assert_allclose(moment.lowest, 1e3 * numbers["support moment"], rtol=2e-6)
    reactions = load_model_envelope(case, lorry, quantity="reaction")
    assert_allclose(reactions.highest, 1e3 * np.array(numbers["reactions"]), rtol=1e-6)


def test_one_axle_and_the_lane_load_on_one_span():
    """P L / 4 and q L^2 / 8 at midspan; P and q L / 2 at the supports; nothing the other way."""
    lorry = vehicle([], [100e3], lane=5e3)
    middle = load_model_envelope(SPAN, lorry, [10.0])
    assert_allclose(middle.highest, 100e3 * 20 / 4 + 5e3 * 400 / 8, rtol=1e-6)
    assert_allclose(middle.lowest, 0.0, atol=1.0)
    ends = load_model_envelope(SPAN, lorry, [0.0, 20.0], quantity="shear")
    assert_allclose(ends.highest[0], 150e3, rtol=1e-6)
    assert_allclose(ends.lowest[1], -150e3, rtol=1e-4)
    factored = load_model_envelope(SPAN, lorry, [10.0], lane=0.0, allowance=0.4)
    assert_allclose(factored.highest, 1.4 * 100e3 * 20 / 4, rtol=1e-6)


def test_the_lane_load_lies_where_it_is_unfavourable():
    """Midspans of two equal spans l: 3 q l^2 / 32 by the own span, -q l^2 / 32 by the other."""
    found = load_model_envelope(two_spans(20.0, 20.0), vehicle([], [0.0], lane=1e3), [10.0])
    assert_allclose(found.highest, 3 * 1e3 * 400 / 32, rtol=1e-5)
    assert_allclose(found.lowest, -1e3 * 400 / 32, rtol=1e-5)


def test_extremes_are_static_peaks_of_the_crossing():
    """The larger of both extremes, in both directions, along a beam of two spans."""
    case, spacings, forces = two_spans(14.0, 9.0), [3.1, 1.2], np.array([60e3, 110e3, 90e3])
    x = np.array([3.0, 7.0, 14.0, 19.0])
    found = load_model_envelope(case, vehicle(spacings, forces), x)
    peaks = []
    for order in (1, -1):
        offsets = np.concatenate([[0.0], np.cumsum(spacings[::order])])
        lorry = jb.Axles(offsets=offsets, forces=forces[::order], speed=1.0)
        loaded = dataclasses.replace(case, loads=(lorry,))
        peaks.append(np.asarray(jb.statics.static_peak(loaded, x, quantity="moment")))
    largest = np.maximum(found.highest, -found.lowest)
    assert_allclose(largest, np.maximum(*peaks), rtol=5e-6)


def test_the_named_place_gives_the_extreme():
    found = load_model_envelope(two_spans(25.0, 35.0), "HL-93", [25.0], lane=0.0, allowance=0.0)
    place = found.at_lowest[0]
    line = influence_at(two_spans(25.0, 35.0), 25.0, "moment")
    forces = next(one for one in load_models()["HL-93"].vehicles if one.name == place.vehicle)
    value = line.at(place.first_axle - place.offsets) @ forces.axle_forces
    assert_allclose(found.lowest[0], value, rtol=1e-9)


def test_the_varied_spacing_is_the_worst():
    """Moment over the inner support, against every spacing in steps of 1 cm."""
    case, model = two_spans(25.0, 35.0), load_models()["HL-93"]
    truck = model.vehicles[0]._replace(lane=0.0)
    found = load_model_envelope(case, LoadModel((truck,), 0.0), [25.0])
    line = influence_at(case, 25.0, "moment")
    lowest = 0.0
    for value in np.arange(4.3, 9.001, 0.01):
        offsets = truck.with_spacing(value)
        for behind in (offsets, -offsets):
            fronts = np.linspace(-10.0, 70.0, 1601)[:, None]
            lowest = min(lowest, float((line.at(fronts - behind) @ truck.axle_forces).min()))
    assert_allclose(found.lowest[0], lowest, rtol=1e-4)
    assert found.lowest[0] <= lowest * (1 - 1e-5)


def test_two_trucks_over_an_inner_support():
    """The hogging moment of two equal spans, -x (L^2 - x^2) / (4 L^2) of a force in one of them.

    Every gap from 15.24 m in steps of 5 cm, front axles in steps of 2.5 cm, both directions.
    """
    span = 30.0

    def line(x):
        x = np.where(x > span, 2 * span - x, x)  # the other span is its mirror image
        return np.where(x > 0, -x * (span**2 - x**2) / (4 * span**2), 0.0)

    forces = 0.9 * 1e3 * np.array([35.0, 145.0, 145.0, 35.0, 145.0, 145.0])
    fronts, lowest = np.arange(0.0, 110.0, 0.025)[:, None], 0.0
    for gap in np.arange(15.24, 45.0, 0.05):
        offsets = np.cumsum([0.0, 4.3, 4.3, gap, 4.3, 4.3])
        for axles in (forces, forces[::-1]):
            lowest = min(lowest, float((line(fronts - offsets) @ axles).min()))
    lane = -0.9 * 9.3e3 * span**2 / 8
    found = load_model_envelope(two_spans(span, span), "HL-93-pair", [span])
    assert_allclose(found.lowest[0], 1.33 * lowest + lane, rtol=2e-5)
    one = load_model_envelope(two_spans(span, span), "HL-93", [span])
    assert found.lowest[0] < one.lowest[0]


def test_choices_of_a_spacing():
    lorry = vehicle([2.0], [50e3, 50e3], varied=0, choices=(2.0, 6.0))
    assert_allclose(load_model_envelope(SPAN, lorry, [10.0]).highest, 100e3 * 4.5, rtol=1e-6)


def test_a_slow_crossing_is_static():
    """Within a per cent for forces at 1 m/s, of the beam's three modes."""
    x = [5.0, 10.0]
    moving = crossing_envelope(SPAN, "HL93-tandem", 1.0, x)
    static = load_model_envelope(SPAN, "HL93-tandem", x)
    assert_allclose(moving.highest, static.highest, rtol=0.01)


def test_trains_of_the_library_are_load_models():
    assert load_model("HSLM-A1").vehicles[0].axle_forces.size == 50
    with pytest.raises(ValueError, match="there is no load model 'HL-39'; .*HL-93"):
        load_model("HL-39")
    with pytest.raises(ValueError, match="lane must be 0 or more, not -1"):
        load_model_envelope(SPAN, "LM1", [10.0], lane=-1.0)
    with pytest.raises(ValueError, match="allowance must be 0 or more, not inf"):
        load_model_envelope(SPAN, "LM1", [10.0], allowance=np.inf)
    with pytest.raises(
        ValueError, match="lane must be in N/m, or a unit of the same kind, not '9 kN'"
    ):
        load_model_envelope(SPAN, "LM1", [10.0], lane="9 kN")
    with pytest.raises(ValueError, match="speed must be in m/s, or a unit of the same kind"):
        crossing_envelope(SPAN, "LM1", "80 km", [10.0])
    with pytest.raises(ValueError, match="a crossing must be above 0 m/s, not 0"):
        crossing_envelope(SPAN, "LM1", 0.0, [10.0])
    with pytest.raises(ValueError, match="EN15528-D2 has masses of its axles"):
        load_model("EN15528-D2")


def test_command(tmp_path, capsys):
    jb.save_case(SPAN, tmp_path / "case.toml")
    command = f"envelope {tmp_path / 'case.toml'} LM1 --at 10"
    table = tmp_path / "out.csv"
    for words in (f"--lane 27kN/m --quantity moment -o {table}", "--quantity reaction --json"):
        with pytest.raises(SystemExit) as ended:
            main(f"{command} {words}".replace("reaction --json", "deflection --json").split())
        assert ended.value.code == 0
    printed = capsys.readouterr().out
    assert "moment at midspan 1" in printed
    assert "MN m" in printed and " 4.17 " in printed
    assert "tandem 8.8-10 m" in printed
    assert "4170000" in table.read_text()


@pytest.mark.parametrize("x", [20.0, 9.3])
@pytest.mark.parametrize("name", ["HL-93", "HL-93-pair", "M1600", "HB45"])
def test_vehicles_stand_with_axles_at_a_hinge(name, x):
    """Spans of 20 m and 15 m with a hinge 4.1 m beyond the support: lines are straight between.

    So that one axle is at a kink at the worst place, for each spacing of a grid that has the worst.
    """
    kinks = np.array([0.0, x, 20.0, 24.1, 35.0])
    over_support = np.array([0.0, 0.0, 0.0, -4.1, 0.0])
    values = over_support * x / 20.0 + [0.0, x * (20.0 - x) / 20.0, 0.0, 0.0, 0.0]
    order = np.unique(kinks, return_index=True)[1]
    kinks, values = kinks[order], values[order]
    expected = [0.0, 0.0]
    for one in load_models()[name].vehicles:
        spacings = one.choices or (None,)
        if one.between is not None:
            low, high = one.between[0], one.between[1] or 35.0
            spacings = [low, *np.arange(np.ceil(20 * low), 20 * high + 1) / 20]
        for sign, i in ((-1.0, 0), (1.0, 1)):
            fine = np.linspace(0.0, 35.0, 350001)
            signed = np.maximum(sign * np.interp(fine, kinks, values), 0)
            lane = one.lane * np.trapezoid(signed, fine)
            for spacing in spacings:
                for behind in one.with_spacing(spacing) * np.array([[1.0], [-1.0]]):
                    fronts = (kinks[:, None] + behind).reshape(-1, 1)
                    found = np.interp(fronts - behind, kinks, sign * values, 0.0, 0.0)
                    axles = (found @ one.axle_forces).max()
                    total = (1 + load_models()[name].allowance) * axles + lane
                    expected[i] = max(expected[i], total)
    beam = jb.Beam(35.0, flexural_rigidity=6e9, mass_per_length=9e3, hinges=[jb.Hinge(24.1)])
    found = load_model_envelope(jb.Case(beam, supports=[jb.Support(20.0)]), name, [x])
    assert_allclose([-found.lowest[0], found.highest[0]], expected, rtol=1e-6, atol=10.0)


def test_hogging_at_the_first_quarter_of_three_spans():
    """Two trucks with any gap, of which one is off the beam: the other is at its own worst place.

    Against fronts in steps of 2 mm for the gap of 30 m, which is as good as any.
    """
    beam = jb.Beam(47.3, flexural_rigidity=5e9, mass_per_length=8e3)
    case = jb.Case(beam, supports=[jb.Support(19.7), jb.Support(33.1)])
    found = load_model_envelope(case, "HL-93-pair", [8.2], lane=0.0, allowance=0.0)
    truck = load_models()["HL-93-pair"].vehicles[0]
    offsets, line = truck.with_spacing(30.0), influence_at(case, 8.2, "moment")
    fronts = np.arange(20.0, 75.0, 0.002)[:, None]
    lowest = min((line.at(fronts - way * offsets) @ truck.axle_forces).min() for way in (1, -1))
    assert_allclose(found.lowest[0], lowest, rtol=1e-7)


PAIR = jb.Case(jb.Beam(20.0, flexural_rigidity=6e9, mass_per_length=9e3, modes=3))
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
    found = combine(PAIR, ACTIONS, FACTORS, [10.0])
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
    lorry = jb.Case(PAIR.beam, loads=[jb.MovingForce(force=1e5, speed=0.5)], run=jb.Run(40.0))
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
        combine(PAIR, actions, factors, [10.0])


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
