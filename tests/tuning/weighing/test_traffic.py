"""A table of vehicles over time: planted trucks of finite elements, alone and together."""

import csv
import dataclasses
import datetime
import json

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.cli import main
from jaxbeam.files.case_file import save_case
from tests.oracles import planted_trucks
from tests.tuning.weighing.test_weigh import case_of, log_of
from tuning import Log
from tuning.weighing import (
    InfluenceLines,
    TrafficSettings,
    calibrate_influence_lines,
    weigh_axles,
    weigh_logs,
    weigh_vehicles,
)
from tuning.weighing.influence_lines import AxleGeometry
from tuning.weighing.traffic import is_beside
from tuning.weighing.vehicles import axles_of_pulses, pulse_times

BRIDGE = planted_trucks.BRIDGES[0]
STEP, SEED, DETECTORS = planted_trucks.STEP * planted_trucks.EVERY, 31, {"d0": 4.0, "d1": 16.0}
SPEEDS = 8.0, 35.0
# Axles, direction, time (s) at which the first axle enters: alone, meeting, one behind the other.
ALONE = ((2, 1, 4.0), (5, -1, 10.0))
TOGETHER = ((3, 1, 16.0), (4, -1, 16.7), (5, 1, 24.0), (2, 1, 26.2))


def traffic(plan, duration: float, seed: int = SEED):
    """Times, strains, pulses of detectors, and the trucks by their times of entry."""
    rng = np.random.default_rng(seed)
    surface = planted_trucks.road("A", rng)
    times = STEP * np.arange(round(duration / STEP))
    strain, pulses = np.zeros((times.size, 2)), 0.03 * rng.normal(size=(times.size, 2))
    trucks = []
    for axles, way, start in plan:
        truck = planted_trucks.draw_truck(rng, axles)
        truck = dataclasses.replace(truck, speed=way * truck.speed)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(planted_trucks, "NOISE", 0.0)  # that of the log is added below
            passage = planted_trucks.cross(BRIDGE, truck, "A", surface, rng)
        speed = abs(truck.speed)
        first = round((start - planted_trucks.LEAD / speed) / STEP)
        strain[first : first + len(passage.times)] += passage.strain
        entry = times[first] + planted_trucks.LEAD / speed
        trucks.append((entry, truck))
        for own, place in zip(pulses.T, DETECTORS.values(), strict=True):
            travelled = place if way > 0 else BRIDGE.length - place
            for at in entry + (travelled + truck.offsets) / speed:
                own += np.exp(-(((times - at) * speed / 0.3) ** 2))
    strain += 0.04 * strain.std() * rng.normal(size=strain.shape)
    return times, strain, pulses, trucks


def logged(plan, duration: float) -> tuple[Log, list]:
    times, strain, pulses, trucks = traffic(plan, duration)
    names = ("s0", "s1", *DETECTORS)
    columns = names, ("strain",) * 2 + ("voltage",) * 2, ("1", "1", "V", "V")
    return Log(times, np.hstack([strain, pulses]), *columns, start="2026-03-29T23:59:55"), trucks


def without_detectors(log: Log) -> Log:
    columns = log.names[:2], log.quantities[:2], log.units[:2]
    return Log(log.times, log.values[:, :2], *columns, source="tuesday")


@pytest.fixture(scope="module")
def lines():
    known, _ = planted_trucks.site(0, "A", (), SEED)
    return calibrate_influence_lines(case_of(BRIDGE), [log_of(one, known=True) for one in known])


def check(vehicles, trucks, gross: float, axles: float):
    assert len(vehicles) == len(trucks)
    for one, (entry, truck) in zip(vehicles, trucks, strict=True):
        assert one.time == pytest.approx(entry, abs=0.03)
        assert one.speed == pytest.approx(truck.speed, rel=0.015)
        assert one.gross_weight == pytest.approx(truck.loads.sum(), rel=gross)
        np.testing.assert_allclose(one.forces, truck.loads, rtol=axles)
        np.testing.assert_allclose(one.offsets, truck.offsets, atol=0.15)
        assert one.groups == [len(group) for group in truck.groups]


def test_vehicles_that_meet_and_follow_are_weighed_by_detectors(lines):
    log, trucks = logged((*ALONE, *TOGETHER), 32.0)
    settings = TrafficSettings(SPEEDS, detectors=DETECTORS)
    found = weigh_vehicles(case_of(BRIDGE), log, settings, lines)
    check(found.vehicles, trucks, 0.03, 0.15)
    held = [
        np.abs(np.array(one.forces) - truck.loads) < one.force_half_widths
        for one, (_, truck) in zip(found.vehicles, trucks, strict=True)
    ]
    assert np.mean(np.concatenate(held)) >= 0.85
    assert found.vehicles[0].stamp.startswith("2026-03-29T23:59:5")
    assert found.vehicles[1].stamp.startswith("2026-03-30T00:00:0")
    assert found.verdict.startswith("6 vehicles, 4 from the left and 2 from the right, of ")
    table = found.columns
    assert table["class"].tolist() == ["1-1", "1-1-3", "1-2", "1-1-2", "1-1-3", "1-1"]
    assert np.isnan(table["axle 3 (kN)"][0]) and table["direction"][1] == "left"


def test_vehicles_one_by_one_are_weighed_by_strain_alone(lines):
    log, trucks = logged(ALONE, 14.0)
    settings = TrafficSettings(SPEEDS)
    clock = dataclasses.replace(without_detectors(log), start="23:59:55.000")
    found = weigh_vehicles(case_of(BRIDGE), clock, settings, lines)
    check(found.vehicles, trucks, 0.03, 0.15)
    assert [one.stamp[:5] for one in found.vehicles] == ["23:59", "00:00"]


def test_vehicles_side_by_side_are_doubted_without_detectors(lines):
    """Two trucks in two lanes, 1 m apart: strains do not tell which axle is of which."""
    log, trucks = logged(((2, 1, 4.0), (3, 1, 4.05)), 8.0)
    found = weigh_vehicles(case_of(BRIDGE), without_detectors(log), TrafficSettings(SPEEDS), lines)
    assert found.vehicles and all(one.doubt for one in found.vehicles)
    together = sum(one.gross_weight for one in found.vehicles)
    assert together == pytest.approx(sum(truck.loads.sum() for _, truck in trucks), rel=0.05)


@pytest.mark.parametrize(
    ("speed", "start", "beside"), [(21, 1.3, True), (21, 1.6, False), (-20, 1.0, False)]
)
def test_a_vehicle_is_beside_one_that_enters_while_it_enters(speed, start, beside):
    """One of 10 m at 20 m/s enters for half a second, from 1 s on."""
    offsets = np.array([0.0, 10.0])
    one, other = (
        AxleGeometry(float(v), at, offsets, 30.0) for v, at in ((20, 1.0), (speed, start))
    )
    assert is_beside(one, [one, other]) is beside
    assert is_beside(other, [one, other]) is beside
    assert not is_beside(one, [one])


@pytest.mark.parametrize(("middle", "told"), [(5.0, False), (4.0, True)])
def test_directions_are_told_by_lines_without_symmetry(middle, told):
    """A truck from the right, by the triangular line of one sensor and noise of 1 %."""
    lines = InfluenceLines(np.array([0.0, middle, 10.0]), np.array([[0.0], [-1e-8], [0.0]]))
    times = np.arange(600) / 100
    travelled = 20.0 * (times - 3.0)
    readings = 5e4 * lines.at(10.0 - travelled) + 8e4 * lines.at(13.5 - travelled)
    readings += 1e-5 * np.random.default_rng(1).normal(size=readings.shape)
    case = jb.Case(jb.Beam(10.0, 1e9, 1e3), sensors=[jb.Sensor(middle)], run=jb.Run(6.0, 100.0))
    log = Log(times, readings, ("w",), ("deflection",), ("m",), "monday", (0,))
    found = weigh_vehicles(case, log, TrafficSettings((10.0, 30.0)), lines)
    assert [one.speed > 0 for one in found.vehicles] == [not told]
    assert found.vehicles[0].gross_weight == pytest.approx(130e3, rel=0.02)
    remark = "the sensors read the same of vehicles from either end"
    assert any(remark in one for one in found.problems) is not told


def test_vehicles_that_meet_are_weighed_by_strain_alone(lines):
    log, trucks = logged(TOGETHER[:2], 20.0)
    settings = TrafficSettings(SPEEDS)
    found = weigh_vehicles(case_of(BRIDGE), without_detectors(log), settings, lines)
    check(found.vehicles, trucks, 0.03, 0.15)


def test_pulses_of_vehicles_that_overtake_and_meet():
    """Trains of pulses are told apart by their delays, whatever their order."""
    truth = [(20.0, [0.0, 4.0, 5.3]), (-15.0, [0.0, 3.6]), (25.0, [0.0, 5.0])]
    entries = 1.0, 1.1, 1.4
    times = np.arange(0.0, 5.0, 1e-3)
    signals = np.zeros((2, times.size))
    for (speed, offsets), entry in zip(truth, entries, strict=True):
        for signal, place in zip(signals, (4.0, 16.0), strict=True):
            travelled = place if speed > 0 else 20.0 - place
            for at in entry + (travelled + np.array(offsets)) / abs(speed):
                signal += np.exp(-(((times - at) / 0.01) ** 2))
    pulses = tuple(pulse_times(times, signal, 0.02) for signal in signals)
    found = axles_of_pulses(pulses, (4.0, 16.0), (8.0, 35.0), 20.0)
    assert [round(one.speed) for one in found] == [20, -15, 25]
    for one, (_, offsets), entry in zip(found, truth, entries, strict=True):
        np.testing.assert_allclose(one.offsets, offsets, atol=0.05)
        assert one.entry_time == pytest.approx(entry, abs=0.01)
    assert axles_of_pulses((np.zeros(0), np.ones(1)), (4.0, 16.0), (8.0, 35.0), 20.0) == []


def crossed(noise: float) -> tuple[InfluenceLines, Log]:
    """Lines of moments of a hinged beam, and axles of 60 and 90 kN, 4 m apart, at 20 m/s from 5 s.

    They are superposed, each where it is.
    """
    length, places, times = BRIDGE.length, np.array([7.0, 12.0]), np.arange(0.0, 10.0, 0.01)

    def moments(x):
        x = np.clip(x, 0.0, length)[:, None]
        return 1e-9 * np.minimum(x * (length - places), places * (length - x)) / length

    readings = 6e4 * moments(20 * (times - 5)) + 9e4 * moments(20 * (times - 5) - 4)
    readings += noise * np.random.default_rng(3).normal(size=readings.shape)
    points = np.union1d(np.linspace(0.0, length, 41), places)
    columns = ("s0", "s1"), ("strain",) * 2, ("1", "1")
    return InfluenceLines(points, moments(points)), Log(times, readings, *columns)


def spoilt(log: Log, how: str) -> Log:
    """A log with a sensor that is dead or masked, or with masked samples of 1 (no unit)."""
    values, valid = log.values.copy(), np.ones(log.values.shape, bool)
    if how == "dead":
        values[:, 1] = 3e-5
    elif how == "masked sensor":
        valid[:, 1] = False
    elif how == "masked samples":
        for samples in (slice(100, 110), slice(540, 550)):
            values[samples], valid[samples] = 1.0, False
    return dataclasses.replace(log, values=values, valid=valid)


@pytest.mark.parametrize("how", ["whole", "dead", "masked sensor", "masked samples"])
def test_what_sensors_do_not_tell_is_left_out(how):
    lines, log = crossed(5e-7)
    found = weigh_vehicles(case_of(BRIDGE), spoilt(log, how), TrafficSettings(SPEEDS), lines)
    (one,) = found.vehicles
    assert not found.problems and not one.doubt
    assert one.gross_weight == pytest.approx(150e3, abs=max(2 * one.gross_half_width, 300.0))
    np.testing.assert_allclose(one.forces, [6e4, 9e4], rtol=5e-3)
    assert one.time == pytest.approx(5.0, abs=5e-3)
    single = weigh_axles(case_of(BRIDGE), spoilt(log, how), SPEEDS, influence_lines=lines)
    assert single.fit.gross_weight[0] == pytest.approx(150e3, rel=3e-3)


def test_readings_without_noise_and_none_that_vary():
    lines, log = crossed(0.0)
    (one,) = weigh_vehicles(case_of(BRIDGE), log, TrafficSettings(SPEEDS), lines).vehicles
    np.testing.assert_allclose(one.forces, [6e4, 9e4], rtol=1e-4)
    dead = dataclasses.replace(log, values=np.ones((1000, 2)))
    assert weigh_vehicles(case_of(BRIDGE), dead, TrafficSettings(SPEEDS), lines).problems == ()
    with pytest.raises(ValueError, match="log: no sensor has valid readings that vary"):
        weigh_axles(case_of(BRIDGE), dead, SPEEDS, influence_lines=lines)
    silent = np.hstack([log.values, np.zeros((1000, 2))])
    columns = ("s0", "s1", "d0", "d1"), ("strain",) * 2 + ("voltage",) * 2, ("1", "1", "V", "V")
    settings = TrafficSettings(SPEEDS, detectors=DETECTORS)
    found = weigh_vehicles(case_of(BRIDGE), Log(log.times, silent, *columns), settings, lines)
    assert "no vehicle is told by the detectors at these speeds" in found.problems[0]


def test_logs_of_other_descriptions_are_weighed_again(tmp_path, monkeypatch):
    lines, log = crossed(5e-7)
    write(tmp_path / "one.csv", dataclasses.replace(log, names=("s0", "s1")))

    def weighed(*names):
        files = [tmp_path / name for name in names]
        settings = TrafficSettings(SPEEDS)
        return weigh_logs(case_of(BRIDGE), files, tmp_path / "store.jsonl", settings, lines)

    assert weighed("one.csv").vehicles[0].speed == pytest.approx(20.0, rel=1e-3)
    order = [f"[columns.s{i}]\nsensor = {1 - i}\n" for i in range(2)]
    (tmp_path / "one.toml").write_text("\n".join(order))
    monkeypatch.setattr("tuning.weighing.traffic.vehicles_in", lambda *_: [])
    found = weighed("one.csv", "other.csv")
    assert found.vehicles == () and "no vehicle explains" in found.problems[0]
    assert "other.csv" in found.problems[1]


def test_sensors_of_the_wrong_sign_are_named(monkeypatch):
    """The weight times the line's area over the speed is the integral of a reading."""
    lines, log = crossed(5e-7)
    monkeypatch.setattr("tuning.weighing.traffic.vehicles_in", lambda *_: [])
    for signs, turned in (([1, 1], []), ([1, -1], [1]), ([-1, -1], [0, 1])):
        drift = 1e-6 * log.times[:, None]
        other = dataclasses.replace(log, values=log.values * signs + drift)
        found = weigh_vehicles(case_of(BRIDGE), other, TrafficSettings(SPEEDS), lines).problems
        said = [one for one in found if "with the sign opposite to its influence line" in one]
        assert [f"sensors.{i} reads" in one for i, one in zip(turned, said, strict=True)] == [
            True
        ] * len(turned)


def test_copies_count_once_and_vehicles_are_in_the_order_of_dates(tmp_path):
    lines, log = crossed(5e-7)
    for name, day in (("a.csv", 2), ("b.csv", 1), ("c.csv", 2)):
        begin = datetime.datetime(2026, 10, day)
        stamps = [(begin + datetime.timedelta(seconds=t)).isoformat() for t in log.times.tolist()]
        rows = (
            f"{stamp},{s0:.9g},{s1:.9g}"
            for stamp, (s0, s1) in zip(stamps, log.values.tolist(), strict=True)
        )
        (tmp_path / name).write_text("\n".join(["time,s0 [1],s1 [1]", *rows]))
    paths = [tmp_path / name for name in ("a.csv", "b.csv", "c.csv")]
    settings = TrafficSettings(SPEEDS)
    found = weigh_logs(case_of(BRIDGE), paths, tmp_path / "store.jsonl", settings, lines)
    assert [one.file for one in found.vehicles] == ["b.csv", "a.csv"]
    assert found.problems == (f"{paths[2]} is a copy of {paths[0]}: its vehicles count once",)


def write(path, log: Log, rows=slice(None)):
    heads = [f"{name} [{'1' if name[0] == 's' else 'V'}]" for name in log.names]
    table = np.column_stack([log.times, log.values])[rows]
    lines = [",".join(["time [s]", *heads]), *(",".join(f"{x:.9g}" for x in row) for row in table)]
    path.write_text("\n".join(lines))


def test_a_stopped_weighing_goes_on(lines, tmp_path, monkeypatch):
    """Passings in the store are not weighed again, also if its last line is broken off."""
    log, trucks = logged(ALONE, 14.0)
    write(tmp_path / "monday.csv", log)
    settings, store = TrafficSettings(SPEEDS, detectors=DETECTORS), tmp_path / "store.jsonl"

    def weighed():
        return weigh_logs(case_of(BRIDGE), [tmp_path / "monday.csv"], store, settings, lines)

    found = weighed()
    check(found.vehicles, trucks, 0.03, 0.15)
    whole = store.read_text()
    head, first, *_ = whole.splitlines()
    for broken in ("", "\n"):
        store.write_text("\n".join([head, first, first[:50]]) + broken)
        assert weighed().columns["time (s)"].tolist() == found.columns["time (s)"].tolist()
        assert store.read_text().count('"vehicles"') == 2
    monkeypatch.setattr("tuning.weighing.traffic.vehicles_in", None)
    assert weighed().verdict == found.verdict
    for other, reading in ((TrafficSettings((5.0, 30.0)), {}), (settings, {"missing": "mask"})):
        with pytest.raises(
            ValueError, match="was made with another case, other lines, settings or"
        ):
            weigh_logs(case_of(BRIDGE), [], store, other, lines, **reading)
    absent = [tmp_path / f"{day}.csv" for day in ("friday", "saturday")]
    with pytest.raises(ValueError, match="friday.csv.*; none of the 2 logs can be weighed"):
        weigh_logs(case_of(BRIDGE), absent, store, settings, lines)
    store.write_text("other\n")
    with pytest.raises(ValueError, match="is no store of vehicles: give another name"):
        weighed()


def test_what_is_passed_over_is_said(lines):
    """A vehicle on the bridge as the log begins, and samples that are missing."""
    log, _ = logged(ALONE, 14.0)
    late = (log.times > 4.5) & (log.times < 8.0)
    cut = dataclasses.replace(
        without_detectors(log), times=log.times[late], values=log.values[late, :2], valid=None
    )
    settings = TrafficSettings(SPEEDS)
    found = weigh_vehicles(case_of(BRIDGE), cut, settings, lines)
    assert found.problems[0].startswith(
        "tuesday, 4.50 s: the log begins or ends while it is on the bridge"
    )
    gap = (log.times < 10.5) | (log.times > 10.6)
    cut = dataclasses.replace(
        without_detectors(log), times=log.times[gap], values=log.values[gap, :2], valid=None
    )
    only = dataclasses.replace(
        cut, times=cut.times[cut.times > 7], values=cut.values[cut.times > 7], valid=None
    )
    found = weigh_vehicles(case_of(BRIDGE), only, settings, lines)
    assert "samples are missing while it is on the bridge: not weighed" in found.problems[0]
    assert found.verdict == "no vehicle is found"
    with pytest.raises(ValueError, match="no channel 'd0' for a detector of axles"):
        settings = TrafficSettings(SPEEDS, detectors=DETECTORS)
        weigh_vehicles(case_of(BRIDGE), only, settings, lines)
    for detectors in ({"d0": 4.0}, {"d0": 4.0, "d1": 4.0}, {"d0": 4.0, "d1": np.nan}):
        with pytest.raises(ValueError, match="two detectors of axles at two positions.*d0 at 4 m"):
            TrafficSettings(SPEEDS, detectors=detectors)
    for weight in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="the least weight must be a positive number of N"):
            TrafficSettings(SPEEDS, least_weight=weight)
    with pytest.raises(ValueError, match="speeds must be 0 < low < high"):
        TrafficSettings((3.0, 2.0))


def test_command_weighs_a_folder(lines, tmp_path, capsys):
    log, trucks = logged(ALONE, 14.0)
    folder = tmp_path / "day"
    folder.mkdir()
    write(folder / "1.csv", log, slice(0, round(8.0 / STEP)))
    write(folder / "2.csv", log, slice(round(8.0 / STEP), None))
    save_case(case_of(BRIDGE), tmp_path / "bridge.toml")
    (tmp_path / "lines.json").write_text(json.dumps(lines.to_dict()))
    table, store = tmp_path / "vehicles.csv", tmp_path / "store.jsonl"
    words = [
        "weigh", "traffic", str(tmp_path / "bridge.toml"), str(folder), "--speeds", "8:35",
        "--calibration", str(tmp_path / "lines.json"), "--detectors", "d0=4,d1=16",
        "--store", str(store), "-o", str(table), "--json",
    ]  # fmt: skip
    with pytest.raises(SystemExit) as ended:
        main(words)
    printed = capsys.readouterr()
    assert ended.value.code == 0, printed.err
    content = json.loads(printed.out)
    assert [one["class"] for one in content["vehicles"]] == ["1-1", "1-1-3"]
    with table.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["log"] for row in rows] == ["1.csv", "2.csv"]
    for row, (_, truck) in zip(rows, trucks, strict=True):
        assert float(row["gross weight (kN)"]) == pytest.approx(truck.loads.sum() / 1e3, rel=0.03)
    with pytest.raises(SystemExit) as ended:
        main([*words[:8], "--detectors", "d0:4,d1=16"])
    assert ended.value.code == 2
    assert "--detectors takes NAME=POSITION,NAME=POSITION in m" in capsys.readouterr().err
