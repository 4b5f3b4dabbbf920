"""Sweeps, comparisons and fits of the page, without a browser."""

import time
import tomllib

import numpy as np
import pytest

import jaxbeam as jb
from tests.cli.page.conftest import RIG, SHAKER, decay
from tests.modules import ROOT

SPEED = {"address": "loads.0.speed", "from": "1.8 km/h", "to": 1.5, "count": 4}
MASS = {"address": "loads.0.mass", "from": 0.1, "to": "400 g", "count": 3}
PEAK = "first span peak deflection (m)"


def finished(workspace, number, seconds=300):
    """The last state of work."""
    end = time.monotonic() + seconds
    while not (state := workspace.job(number))["done"]:
        assert time.monotonic() < end
        time.sleep(0.05)
    return state


def test_a_map_is_the_sweep_of_the_library(workspace):
    state = finished(workspace, workspace.start_sweep(RIG, [SPEED, MASS]))
    found = np.array([row[PEAK] for row in state["seen"]["found"]])
    over = {"loads.0.speed": np.linspace(0.5, 1.5, 4), "loads.0.mass": np.linspace(0.1, 0.4, 3)}
    runs = jb.sweep(jb.api.load_case(RIG), over, progress=False)
    expected = runs.peak_deflection.isel(sensor=0).transpose("loads.0.mass", "loads.0.speed")
    np.testing.assert_allclose(found, expected.values, rtol=2e-3)
    assert workspace.job("1", known=2)["seen"]["found"] == state["seen"]["found"][2:]


def test_the_words_of_a_sweep_compute_it_again(workspace, rig, monkeypatch):
    state = finished(workspace, workspace.start_sweep(RIG, [SPEED]))
    words = workspace.job("1", name="rig.toml")["seen"]["words"]
    assert words["command"] == "jaxbeam sweep rig.toml --over loads.0.speed=0.5:1.5:4 --plot"
    monkeypatch.chdir(rig.parent)
    names: dict = {}
    exec(words["python"], names)
    peaks = names["runs"].peak_deflection.values[:, 0]
    np.testing.assert_allclose(state["seen"]["found"][0][PEAK], peaks, rtol=1e-9)


def test_words_are_swept_row_by_row(workspace):
    text = workspace.library_text("railway-bridge")
    trains = {"address": "loads.0.train", "words": "HSLM-A1, HSLM-A2"}
    speeds = {"address": "loads.0.speed", "from": "100 km/h", "to": "120 km/h", "count": 2}
    sweep = finished(workspace, workspace.start_sweep(text, [trains, speeds]))["seen"]
    assert (sweep["rows"], sweep["columns"]) == ("loads.0.train", "loads.0.speed")
    assert [len(row["midspan peak deflection (m)"]) for row in sweep["found"]] == [2, 2]


def test_a_sweep_is_stopped_and_keeps_the_rows_that_are_known(workspace):
    many = MASS | {"count": 2000}
    number = workspace.start_sweep(RIG, [SPEED, many])
    while not workspace.job(number)["seen"]["found"]:
        time.sleep(0.02)
    workspace.cancel(number)
    state = finished(workspace, number)
    assert state["problem"]["message"] == "stopped"
    assert 0 < len(state["seen"]["found"]) < 2000


@pytest.mark.parametrize(
    "axes, sentence",
    [
        ([], "over one or two addresses"),
        ([SPEED, SPEED], "are the same"),
        ([SPEED | {"count": 1}], "from 2 to"),
        ([SPEED | {"count": 10**9}], "from 2 to"),
        ([SPEED | {"count": 5000}, MASS | {"count": 5000}], "at most"),
        ([SPEED | {"from": "fast"}], "loads.0.speed: from"),
        ([{"address": "loads.0.train", "words": " , "}], "separated by commas"),
        ([SPEED | {"address": "loads.0.speeed"}], "loads.0.speed"),
    ],
)
def test_axes_that_make_no_map_are_refused(workspace, axes, sentence):
    with pytest.raises(ValueError, match=sentence):
        workspace.start_sweep(RIG, axes)


def test_what_goes_wrong_in_work_is_its_problem(workspace):
    state = finished(workspace, workspace.start_comparison(RIG, []))
    assert "at least one controller" in state["problem"]["message"]
    with pytest.raises(ValueError, match="no longer known"):
        workspace.job("77")


def test_controllers_of_the_folder_are_compared(workspace):
    text = (ROOT / "examples/controlled_rig/case.toml").read_text()
    other = text.replace("gains = [4000.0]", "gains = [2000.0]")
    workspace.save("softer.toml", other)
    assert workspace.controllers() == ["softer.toml"]
    found = finished(workspace, workspace.start_comparison(text, ["softer.toml"]))["result"]
    peaks = {row["name"]: row["peak"] for row in found["rows"]}
    record = jb.simulate(jb.api.load_case(other))
    assert peaks["softer"] == pytest.approx(float(record.peak_deflection[0]), rel=1e-6)
    assert found["bound"] <= peaks["this case"] < peaks["softer"] < found["uncontrolled"]
    assert f"{found['bound']:.6g} m" in found["headline"]


def test_a_comparison_without_a_bound_says_why(workspace):
    found = finished(workspace, workspace.start_comparison(SHAKER, []))["result"]
    with pytest.raises(ValueError, match="bound the voltage") as refused:
        jb.bound(jb.api.load_case(SHAKER))
    reason = str(refused.value).removesuffix(": leave them out")
    assert found["bound"] is None and list(found["runs"]) == ["without", "this case"]
    assert f"no least achievable peak, as {reason}" in found["headline"]


def test_a_tuning_lowers_its_objective(workspace):
    text = (ROOT / "examples/controlled_rig/case.toml").read_text()
    free = {"controller.gains.0": [1000.0, 9000.0]}
    number = workspace.start_tuning(text, free, "loads.0.mass", 0.2, 4)
    state = finished(workspace, number)
    result = state["result"]
    assert len(result["history"]) == 4 and state["progress"][:2] == [4, 4]
    assert result["history"][-1] < result["history"][0]
    assert state["seen"]["settings"] == result["settings"]
    np.testing.assert_array_equal(state["seen"]["history"], result["history"])
    masses = [run["loads.0.mass"] for run in result["runs"]["training"]["cases"]]
    assert masses == pytest.approx([0.32, 0.4, 0.48])


def test_a_dropped_log_is_shown_as_read_and_fitted(workspace):
    demo = ROOT / "jaxbeam/case/library/demo"
    for name in ("log_1.toml", "log_1.csv"):
        found = workspace.take_log(name, (demo / name).read_bytes())
    (log,) = found["logs"]
    assert [one["unit"] for one in log["channels"]] == ["mm"] * 3 and log["loads"] == ["mass"]
    assert log["source"] == "log_1.csv" and log["rate"] == pytest.approx(1000.0)
    free = {
        "beam.flexural_rigidity": ["10 N m^2", "14 N m^2"],
        "beam.damping_ratio": None,
        "actuators.0.stiffness": None,
        "logs.*.loads.0.speed": None,
        "logs.*.loads.0.entry_time": None,
    }
    number = workspace.start_fit((demo / "rig.toml").read_text(), ["log_1.csv"], free)
    state = finished(workspace, number)
    result, seen = state["result"], state["seen"]
    own = result["numbers"]["beam.flexural_rigidity"]
    assert seen["misfits"][-1] < 1e-2 * seen["misfits"][0]
    assert seen["numbers"]["beam.flexural_rigidity"] == pytest.approx(own["value"], rel=1e-6)
    assert "runs" not in workspace.job(number, len(seen["misfits"]))["seen"]
    truth = tomllib.loads((demo / "truth.toml").read_text())["beam.flexural_rigidity"]
    assert abs(own["value"] - truth) < abs(own["start"] - truth)
    assert len(result["runs"][0]["fitted"]) == 3
    assert not any("/" in remark.split("standard")[0] for remark in result["remarks"])


def test_modes_of_a_log_are_found_and_chosen(workspace, tmp_path):
    path = decay(tmp_path)
    workspace.take_log(path.name, path.read_bytes())
    result = finished(workspace, workspace.start_modes([path.name], None, []))["result"]
    assert [mode["frequency_hz"] for mode in result["modes"]] == pytest.approx([4, 11], rel=2e-3)
    signs = [np.sign(np.prod(mode["shape_real"])) for mode in result["modes"]]
    assert signs == [1, -1] and result["poles"]
    peak = np.argmax(result["spectrum"]["amplitudes"])
    assert result["spectrum"]["frequencies"][peak] == pytest.approx(4, abs=0.1)
    number = workspace.start_modes([path.name], [1.0, 30.0], [11.0])
    (only,) = finished(workspace, number)["result"]["modes"]
    assert only["frequency_hz"] == pytest.approx(11, rel=2e-3)
    with pytest.raises(ValueError, match="drop a log"):
        workspace.start_modes([], None, [])


def test_columns_and_units_of_a_log_are_told_by_hand(workspace):
    rows = "\n".join(f"{i / 100},{i % 7},{i % 5}" for i in range(50))
    found = workspace.take_log("bare.csv", rows.encode())
    assert found["logs"] == [] and found["problem"]["message"].startswith("bare.csv, line 1")
    (log,) = workspace.read_log("bare.csv", "time [s], a1 [g], -")["logs"]
    assert log["channels"] == [{"name": "a1", "quantity": "acceleration", "unit": "g"}]
    assert workspace.log("bare.csv")[0].values[1, 0] == pytest.approx(9.80665)
    (log,) = workspace.read_log("bare.csv", "-, w [mm], s [mm]", "0.2 kHz")["logs"]
    assert log["rate"] == pytest.approx(200.0) and len(log["channels"]) == 2
    assert (
        "rate takes a number"
        in pytest.raises(ValueError, workspace.read_log, "bare.csv", "", "fast").value.args[0]
    )
    again = workspace.take_log("bare.csv", rows.encode())
    assert again["problem"] is not None


def test_a_fit_is_stopped(workspace):
    demo = ROOT / "jaxbeam/case/library/demo"
    for name in ("log_1.toml", "log_1.csv"):
        workspace.take_log(name, (demo / name).read_bytes())
    free = {"beam.flexural_rigidity": None, "beam.damping_ratio": None}
    number = workspace.start_fit((demo / "rig.toml").read_text(), ["log_1.csv"], free)
    while not workspace.job(number)["seen"]["misfits"]:
        time.sleep(0.02)
    workspace.cancel(number)
    assert finished(workspace, number)["problem"]["message"] == "stopped"


@pytest.mark.parametrize("name", ["../log.csv", "a/b.csv", ".csv", "log.exe", "", "a\0.csv"])
def test_names_that_no_log_has_are_refused(workspace, name):
    with pytest.raises(ValueError, match="is no log"):
        workspace.take_log(name, b"time [s],w [m]\n0,0\n")


def test_a_log_that_was_not_given_is_asked_for(workspace):
    with pytest.raises(ValueError, match="drop it on the page again"):
        workspace.start_fit(RIG, ["../rig.toml"], {"beam.length": None})
    with pytest.raises(ValueError, match="a log and a free number"):
        workspace.start_fit(RIG, [], {})
