"""Monitoring against planted histories: effects of temperature, false alarms, loss of rigidity.

Frequencies of planted histories are sums in closed form. Logs of the command are ambient responses
of oscillators that scipy integrates.
"""

import json
import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import scipy.signal
from numpy.testing import assert_allclose

from tuning.logs.reading import version_of
from tuning.monitoring.history import (
    AnalysisSettings,
    LogModes,
    ModeHistory,
    analyse,
    read_conditions,
    read_history,
    tracks_of,
    with_conditions,
)
from tuning.monitoring.monitor import monitor, monitored

FREQUENCIES = np.array([2.1, 5.9, 6.4])  # Hz
SHAPES = np.array([[0.6, 1.0, 0.7], [1.0, 0.1, -0.9], [0.8, -0.9, 0.7]])
PER_KELVIN, SCATTER = -2e-3, 2e-3


def history(seed, logs=200, loss=0.0, first=150, missing=0.1, swap=False) -> ModeHistory:
    """A year with -0.2 %/K, scatter of 0.2 %, and a loss of rigidity from a log on."""
    rng = np.random.default_rng(seed)
    year = 2 * np.pi * np.arange(logs) / 130
    warm = 12 + 11 * np.sin(year) + 4 * rng.normal(size=logs)
    entries = []
    for i in range(logs):
        stiffer = np.sqrt(1 - loss) if i >= first else 1.0
        scale = stiffer * (1 + PER_KELVIN * (warm[i] - 12))
        found = FREQUENCIES * scale * (1 + SCATTER * rng.normal(size=3))
        if swap:  # the second and third cross
            found[1] *= 1 + 0.2 * i / logs
        shapes = SHAPES + 0.03 * rng.normal(size=SHAPES.shape)
        here = rng.random(3) > missing
        phases = np.exp(1j * rng.uniform(0, 2 * np.pi, 3))[:, None]
        parts = found[here], 1e-3 * found[here], np.full(here.sum(), 0.01), (shapes * phases)[here]
        entries.append(LogModes(f"{i:03d}.csv", "", "", *parts, {"T (°C)": warm[i]}))
    return ModeHistory(tuple(entries), {})


def test_effects_of_temperature_are_found():
    found = monitored(history(1), baseline=100)
    assert len(found.tracks) == 3 and found.chart is not None
    for own in found.chart.regressions:
        (effect,) = own.effects
        assert effect.half_width < 2e-4
        assert effect.slope == pytest.approx(PER_KELVIN, abs=3 * effect.half_width / 1.96)
        assert own.deviation == pytest.approx(SCATTER, rel=0.25)
    assert found.chart.since is None and "no alarm in the last" in found.verdict
    assert "% per T (°C)" in str(found)


@pytest.mark.parametrize("baseline", [50, 100])
def test_false_alarms_are_rare(baseline):
    """Less than 1 % of the logs of 24 unchanged structures, though a year is not seen."""
    alarms = [monitored(history(seed), baseline=baseline).chart.alarm for seed in range(24)]
    assert np.mean(np.array(alarms)[:, baseline:]) < 0.01


@pytest.mark.parametrize("seed", range(10))
def test_a_loss_of_rigidity_of_one_per_cent_is_found(seed):
    found = monitored(history(seed, loss=0.01), baseline=100)
    assert found.chart.since is not None and 150 <= found.chart.since <= 158
    for value, half in found.chart.change(found.chart.since):
        assert value == pytest.approx(np.sqrt(0.99) - 1, abs=1.6 * half) and half < 2e-3
    assert f"ALARM since {found.chart.since:03d}.csv" in found.verdict


def test_a_large_change_has_a_finite_statistic():
    found = monitored(history(2, loss=0.08, missing=0.5), baseline=100)
    known = found.chart.statistic[~np.isnan(found.chart.statistic)]
    assert found.chart.since in (150, 151, 152) and np.all(np.isfinite(known))


def test_modes_that_jump_farther_than_they_are_followed_are_an_alarm():
    found = monitored(history(2, loss=0.4, missing=0.0), baseline=100)
    assert len(found.come_and_gone) == 1 and "ALARM: " in found.verdict
    assert found.come_and_gone[0].count("is not found after 149.csv") == 3
    assert found.come_and_gone[0].count("is found since 150.csv only") == 3
    assert monitored(history(2), baseline=100).come_and_gone == []


def test_intervals_of_a_change_hold():
    inside = []
    for seed in range(25):
        found = monitored(history(seed, loss=0.02), baseline=100)
        for value, half in found.chart.change(150):
            inside.append(abs(value - (np.sqrt(0.98) - 1)) <= half)
    assert 0.9 <= np.mean(inside) <= 0.99


def test_modes_that_cross_are_told_apart_by_their_shapes():
    entries = history(3, swap=True).entries
    second, third = tracks_of(entries)[1:]
    # The second ends above the third.
    tracks = sorted((second, third), key=lambda one: one.frequencies[~np.isnan(one.frequencies)][0])
    last = [one.frequencies[~np.isnan(one.frequencies)][-1] for one in tracks]
    assert len(tracks_of(entries)) == 3 and last[0] > last[1]


def test_modes_are_born_and_end():
    entries = list(history(4, missing=0.0).entries)
    for i, entry in enumerate(entries):
        kept = [0, 1, 2] if 40 <= i < 120 else [0, 2]
        names = "frequencies", "frequency_sds", "damping_ratios", "shapes"
        entries[i] = entry._replace(**{name: getattr(entry, name)[kept] for name in names})
    found = tracks_of(entries)
    assert [(one.born, one.last, one.ended) for one in found] == [
        (0, 199, False), (40, 119, True), (0, 199, False)
    ]  # fmt: skip


def with_shapes(entry, shapes, channels):
    return entry._replace(shapes=shapes, channels=channels)


@pytest.mark.parametrize("kind", ["in another order", "one lost", "renamed", "one new"])
def test_channels_are_known_by_their_names(kind):
    """Of the planted history with named channels, of which those after the hundredth log differ."""
    entries = []
    for i, one in enumerate(history(3).entries):
        named = with_shapes(one, one.shapes, ("a", "b", "c"))
        if i >= 100 and kind == "in another order":
            named = with_shapes(one, one.shapes[:, ::-1], ("c", "b", "a"))
        if i >= 100 and kind == "one lost":
            named = with_shapes(one, one.shapes[:, :2], ("a", "b"))
        if i >= 100 and kind == "renamed":
            named = with_shapes(one, one.shapes, ("x", "y", "z"))
        if i >= 100 and kind == "one new":
            wide = np.column_stack([0.7 * one.shapes[:, 0], one.shapes])
            named = with_shapes(one, wide, ("n", "a", "b", "c"))
        entries.append(named)
    found, exact = tracks_of(entries), tracks_of(history(3).entries)
    assert len(found) == 3
    for one, other in zip(found, exact, strict=True):
        assert_allclose(one.frequencies, other.frequencies)


def test_a_sensor_that_is_turned_is_told_from_a_change_of_the_structure():
    """Shapes change, frequencies do not; a loss of a fifth of the rigidity is no such case."""
    turned = [
        one if i < 120 else one._replace(shapes=one.shapes * [1, 1, -1])
        for i, one in enumerate(history(4).entries)
    ]
    said = "(shapes have changed, not frequencies: has a sensor been turned?)"
    assert said in monitored(ModeHistory(tuple(turned), {}), baseline=100).verdict
    lost = monitored(history(4, loss=0.2), baseline=100).verdict
    assert "ALARM" in lost and said not in lost
    assert "50 logs after the baseline, as 150.csv, tell nothing, without the modes of" in lost


def test_logs_without_the_temperature_are_told():
    """The logger of temperatures fails after the baseline; the chart would be silent for ever."""
    planted = history(5, loss=0.05)
    entries = [
        one if i < 120 else one._replace(conditions={}) for i, one in enumerate(planted.entries)
    ]
    verdict = monitored(ModeHistory(tuple(entries), {}), baseline=100).verdict
    assert "80 logs after the baseline, as 120.csv, tell nothing, T (°C) being unknown" in verdict


def test_a_temperature_of_a_failed_sensor_is_none():
    """-9999 in one log of the baseline would hide the effect of the temperature."""
    entries = list(history(6, loss=0.01).entries)
    for i in (20, 120):
        entries[i] = entries[i]._replace(conditions={"T (°C)": -9999.0})
    found = monitored(ModeHistory(tuple(entries), {}), baseline=100)
    assert found.chart is not None and found.chart.since is not None
    assert np.isnan(found.chart.statistic[[20, 120]]).all()
    for own in found.chart.regressions:
        assert own.effects[0].slope == pytest.approx(PER_KELVIN, abs=3e-4)


def test_a_log_without_a_date_among_others_is_told():
    entries = history(7).entries
    dated = [one._replace(start=f"2026-10-01T00:{i // 60:02}:00") for i, one in enumerate(entries)]
    dated[3] = dated[3]._replace(start="")
    verdict = monitored(ModeHistory(tuple(dated), {}), baseline=100).verdict
    assert "the order is that of names, as 003.csv has no date" in verdict


def write_log(path, seed, warm, loss=0.0, seconds=120.0, rate=50.0):
    """An ambient log of three channels, with its temperature in a column."""
    rng = np.random.default_rng(seed)
    count = int(seconds * rate)
    total = np.zeros((count, 3))
    for frequency, shape in zip(FREQUENCIES[:2], SHAPES, strict=False):
        w = 2 * np.pi * frequency * np.sqrt(1 - loss) * (1 + PER_KELVIN * (warm - 12))
        system = scipy.signal.lti([1.0, 0.0, 0.0], [1.0, 2 * 0.01 * w, w**2])
        fine = np.arange(4 * count) / (4 * rate)
        total += scipy.signal.lsim(system, rng.normal(size=fine.size), fine)[1][::4, None] * shape
    total += 0.02 * total.std() * rng.normal(size=total.shape)
    rows = np.column_stack([np.arange(count) / rate, total, np.full(count, warm)])
    head = "time [s],a1 [m/s^2],a2 [m/s^2],a3 [m/s^2],T [°C]"
    np.savetxt(path, rows, "%.6g", ",", header=head, comments="")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bridge")
    for i in range(4):
        write_log(folder / f"log{i + 1}.csv", i, 10.0 + i)
    (folder / "broken.csv").write_text("nothing\n")
    return folder


def test_only_new_logs_are_analysed(logs, tmp_path, monkeypatch):
    store = tmp_path / "modes.json"
    found = analyse(logs, store, AnalysisSettings(band=(1.0, 10.0)))
    assert [entry.file for entry in found.entries][-4:] == [f"log{i}.csv" for i in range(1, 5)]
    assert found.entries[0].problem and not found.entries[-1].problem
    assert dict(found.entries[-1].conditions) == {"T (°C)": 13.0}
    again = read_history(store)
    for one, other in zip(found.entries, again.entries, strict=True):
        assert_allclose(one.shapes, other.shapes)
        assert one.to_dict() == other.to_dict()

    def refuse(*_):
        raise AssertionError("a log was analysed again")

    monkeypatch.setattr("tuning.monitoring.history.entry_of", refuse)
    assert analyse(logs, store, AnalysisSettings(band=(1.0, 10.0))).entries[-1].file == "log4.csv"
    description = logs / "log2.toml"
    description.write_text("rate = 50\n")
    with pytest.raises(AssertionError, match="a log was analysed again"):
        analyse(logs, store, AnalysisSettings(band=(1.0, 10.0)))
    description.unlink()
    with pytest.raises(ValueError, match="was made with another band"):
        analyse(logs, store, AnalysisSettings(band=(1.0, 12.0)))
    with pytest.raises(FileNotFoundError, match="no log in .* that matches 'none"):
        analyse(logs, store, AnalysisSettings(pattern="none*"))
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(ValueError, match="is no history of modes"):
        read_history(tmp_path / "other.json")
    (tmp_path / "table.csv").write_text("log,rain\nunknown.csv,1\n")
    with pytest.raises(ValueError, match="names no log of the folder"):
        monitored(found, read_conditions(tmp_path / "table.csv"))
    (tmp_path / "table.csv").write_text("log,rain\nlog1.csv,much\n")
    with pytest.raises(ValueError, match="line 2: a condition is no number"):
        monitor(logs, tmp_path / "unwritten.json", conditions=tmp_path / "table.csv")
    assert not (tmp_path / "unwritten.json").exists()  # before any work
    with pytest.raises(FileNotFoundError, match="there is no folder .*nowhere to write"):
        monitor(logs, tmp_path / "nowhere" / "modes.json")


def planted_modes(path, _):
    """Modes of a file that holds their frequency, instead of an analysis."""
    frequency = np.array([float(path.read_text())])
    parts = frequency, 1e-3 * frequency, 0.01 * np.ones(1), np.ones((1, 1), complex)
    return LogModes(path.name, version_of(path), "", *parts, channels=("a",))


def test_logs_that_are_moved_away_renamed_or_copied(tmp_path, monkeypatch):
    """The baseline stays; a log counts once."""
    monkeypatch.setattr("tuning.monitoring.history.entry_of", planted_modes)
    folder, store = tmp_path / "bridge", tmp_path / "modes.json"
    folder.mkdir()
    for i in range(6):
        (folder / f"{i}.csv").write_text(f"{2 + 0.1 * i}")
    analyse(folder, store)
    (folder / "0.csv").unlink()
    (folder / "1.csv").rename(folder / "1b.csv")
    (folder / "5b.csv").write_text((folder / "5.csv").read_text())
    (folder / "6.csv").write_text("2.6")
    found = {one.file: one for one in analyse(folder, store).entries}
    assert list(found) == ["0.csv", "1b.csv", *(f"{i}.csv" for i in range(2, 6)), "5b.csv", "6.csv"]
    assert found["5b.csv"].problem == "it is a copy of 5.csv" and not found["5b.csv"].channels
    assert [one.frequencies.tolist() for one in found.values() if not one.problem] == [
        [pytest.approx(2 + 0.1 * i)] for i in range(7)
    ]
    other = tmp_path / "other"
    other.mkdir()
    (other / "7.csv").write_text("2.7")
    with pytest.raises(ValueError, match=r"modes.json has logs of another folder than .*other"):
        analyse(other, store)


def test_logs_of_one_name_in_several_folders(tmp_path, monkeypatch):
    """A folder a day, each with a run1.csv; conditions by the path, or by the name."""
    monkeypatch.setattr("tuning.monitoring.history.entry_of", planted_modes)
    for day in range(1, 4):
        (tmp_path / f"logs/day{day}").mkdir(parents=True)
        (tmp_path / f"logs/day{day}/run1.csv").write_text(f"{day}")
    found = analyse(tmp_path / "logs", tmp_path / "s.json", AnalysisSettings(pattern="**/*.csv"))
    assert [one.file for one in found.entries] == [f"day{day}/run1.csv" for day in range(1, 4)]
    assert [one.frequencies[0] for one in found.entries] == [1, 2, 3]
    (tmp_path / "table.csv").write_text("log,T\nday2/run1.csv,7\n")
    known = with_conditions(found, read_conditions(tmp_path / "table.csv"))
    assert [dict(one.conditions) for one in known.entries] == [{}, {"T": 7.0}, {}]


def end_itself(path, _):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_is_ended_from_outside(tmp_path, monkeypatch):
    """As by the system for want of memory."""
    monkeypatch.setattr("tuning.monitoring.history.entry_of", end_itself)
    for i in range(2):
        (tmp_path / f"{i}.csv").write_text("")
    with pytest.raises(ChildProcessError, match="ended from outside, .* with fewer processes"):
        analyse(tmp_path, tmp_path / "modes.json", processes=2)


def order_of(starts: dict[str, str], folder, monkeypatch) -> list[str]:
    """Names of logs in the order of a history: of logs that start so, "?" one that is not read."""
    for name in starts:
        (folder / name).write_text("")

    def entry(path, _):
        start = starts[path.name]
        return LogModes(path.name, "", start.strip("?"), problem="unread" if "?" in start else "")

    monkeypatch.setattr("tuning.monitoring.history.entry_of", entry)
    return [one.file for one in analyse(folder, folder / "modes.json").entries]


def test_logs_are_in_the_order_of_their_instants(tmp_path, monkeypatch):
    """The clock goes back at 03:00+02:00, so that 02:10+01:00 comes after 02:40+02:00."""
    day = "2026-10-25T"
    starts = {"a.csv": f"{day}02:10:00+01:00", "b.csv": f"{day}02:40:00+02:00"}
    starts |= {"c.csv": f"{day}00:20:00.500000+00:00"}
    assert order_of(starts, tmp_path, monkeypatch) == ["c.csv", "b.csv", "a.csv"]


def test_times_of_day_are_no_dates(tmp_path, monkeypatch):
    """Names tell the day, of which a clock without a date says nothing."""
    starts = {
        "day 1.csv": "23:50:00.000",
        "day 2.csv": "12:00:00.000",
        "day 10.csv": "00:10:00.000",
    }
    assert order_of(starts, tmp_path, monkeypatch) == list(starts)


def test_logs_that_are_not_read_keep_their_place(tmp_path, monkeypatch):
    """They count neither before all others, where they would move the baseline, nor after."""
    starts = {f"{i}.csv": f"2026-10-0{i}T00:00:00" for i in range(1, 10)} | {"4.csv": "?"}
    assert order_of(starts, tmp_path, monkeypatch) == list(starts)


def test_the_date_of_a_log_that_is_not_analysed_is_kept(tmp_path):
    """Of three samples, which are too few for modes."""
    rows = [f"2026-10-25 10:00:0{i},{i}.5" for i in range(3)]
    (tmp_path / "short.csv").write_text("\n".join(["time,a [m/s^2]", *rows]))
    (entry,) = analyse(tmp_path, tmp_path / "modes.json").entries
    assert entry.problem and entry.start == "2026-10-25T10:00:00"


@pytest.mark.parametrize("seed", [0])
def test_command_finds_a_loss_of_rigidity(tmp_path, seed):
    """Sixty logs of two minutes, the last fifteen with three per cent less."""
    folder, rng = tmp_path / "logs", np.random.default_rng(seed)
    folder.mkdir()
    for i in range(60):
        loss = 0.03 if i >= 45 else 0.0
        write_log(folder / f"{i:02d}.csv", 1000 * seed + i, 12 + 6 * rng.normal(), loss)
    command = [sys.executable, "-m", "jaxbeam", "monitor", "logs", "--band", "1:10", "--json"]
    command += ["--baseline", "40", "--plot", "-o", "modes.csv"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    found = json.loads(ended.stdout)
    assert "45.csv" <= found["since"] <= "50.csv"
    assert found["effects"]["mode 1"]["T (°C)"][0] == pytest.approx(PER_KELVIN, abs=6e-4)
    assert (tmp_path / "modes.png").exists() and (tmp_path / "logs.modes.json").exists()
