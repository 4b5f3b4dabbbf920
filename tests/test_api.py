"""Parts of applications: cases from text, problems as data, plain results, jobs."""

import importlib.metadata
import json
import threading

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.runtime.progress import ProgressBar

BEAM = {"length": 25.0, "flexural_rigidity": 3e10, "mass_per_length": 15e3}
TABLES = {
    "beam": BEAM,
    "sensors": [{"position": 12.5}],
    "loads": [{"kind": "mass", "mass": 30e3, "speed": 25.0}],
    "run": {"duration": 1.5, "sample_rate": 200.0},
}
TEXT = """
[beam]
length = 25.0
flexural_rigidity = 3e10
mass_per_length = 15e3
[[sensors]]
position = 12.5
[[loads]]
kind = "mass"
mass = 30e3
speed = 25.0
[run]
duration = 1.5
sample_rate = 200.0
"""
CART = """
[[bodies]]
name = "cart"
mass = 800.0
position = 0.0
[[axles]]
body = "cart"
position = 0.0
tyre_stiffness = 1e6
"""


def test_files_texts_and_tables_are_the_same_case(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text(TEXT)
    settings = {"loads.0.speed": "90 km/h", "beam.modes": 4}
    cases = [jb.api.load_case(source, settings) for source in (path, TEXT, TABLES)]
    assert str(cases[0]) == str(cases[1]) == str(cases[2])
    assert cases[0].loads[0].speed == pytest.approx(25.0) and cases[0].beam.modes == 4
    assert str(jb.api.load_case(path)) == str(jb.load_case(path))


def test_tables_are_not_changed(tmp_path):
    """Though paths of vehicle files in them are replaced."""
    (tmp_path / "cart.toml").write_text(CART)
    load = {"kind": "vehicle", "model": "cart.toml", "speed": 2.0}
    case = jb.api.load_case({"beam": BEAM, "loads": [load]}, folder=tmp_path)
    assert load["model"] == "cart.toml" and case.loads[0].bodies[0].mass == 800.0


def test_files_outside_of_the_folder_are_refused(tmp_path):
    (tmp_path / "inner").mkdir()
    (tmp_path / "road.csv").write_text("0, 0\n25, 0.01\n")
    tables = TABLES | {"profile": {"kind": "table", "file": "../road.csv"}}
    with pytest.raises(ValueError, match="is not below the folder") as found:
        jb.api.load_case(tables, folder=tmp_path / "inner")
    assert jb.api.problem(found.value).address == "profile.file"


@pytest.mark.parametrize(
    "source, settings, address, line",
    [
        (TABLES, {"loads.0.mass": -1.0}, "loads.0.mass", None),
        (TABLES, {"loads.0.sped": 1.0}, "loads.0.sped", None),
        (TABLES, {"loads.3.speed": 1.0}, "loads.3.speed", None),
        (TABLES, {"beam.length": "3 kg"}, "beam.length", None),
        (TABLES | {"sensors": [{"position": 30.0}]}, {}, "sensors.0.position", None),
        (TABLES | {"sensors": [{"positon": 3.0}]}, {}, "sensors.0.positon", None),
        (TABLES | {"controller": {"kind": "lqr"}}, {}, "controller.state_weight", None),
        (TABLES | {"controller": {"kind": "nothing"}}, {}, "controller.kind", None),
        ({"sensors": []}, {}, None, None),
        (TEXT.replace("12.5", "12,5"), {}, None, 7),
    ],
)
def test_problems_have_the_address_or_the_line(source, settings, address, line):
    with pytest.raises(ValueError) as found:
        jb.api.load_case(source, settings)
    problem = jb.api.problem(found.value)
    assert (problem.address, problem.line) == (address, line), problem
    assert problem.message and "\n" not in problem.message


def test_problems_of_files_name_the_entry_too(tmp_path):
    path = tmp_path / "run.toml"  # whose name is a part of a case
    path.write_text(TEXT.replace("mass = 30e3", "mass = -1.0"))
    with pytest.raises(ValueError) as found:
        jb.api.load_case(path)
    assert jb.api.problem(found.value).address == "loads.0.mass"


def test_contents_are_json_without_loss():
    case = jb.api.load_case(TABLES)
    record = jb.simulate(case)
    runs = jb.sweep(case, {"loads.0.speed": [20.0, 25.0]}, progress=False)
    found = [json.loads(json.dumps(jb.api.content(one))) for one in (record, runs)]
    assert found[0]["peak_deflection"] == record.peak_deflection.tolist()
    assert found[0]["contact_lost_time"] == [None]  # JSON has no NaN
    assert found[1]["values"] == {"loads.0.speed": [20.0, 25.0]}
    assert found[1]["dimensions"] == ["loads.0.speed", "sensor"]
    np.testing.assert_allclose(found[1]["peak_deflection"][1], record.peak_deflection, rtol=1e-4)
    assert json.dumps(jb.api.plain(record.columns))


def test_a_job_returns_and_raises_what_its_work_does():
    assert jb.api.Job(divmod, 7, 2).result(60.0) == (3, 1)
    with pytest.raises(ZeroDivisionError):
        jb.api.Job(divmod, 7, 0).result(60.0)


def test_a_job_is_cancelled_at_the_next_step():
    begun, go_on, seen = threading.Event(), threading.Event(), []

    def work():
        with ProgressBar(5, "step", shown=False) as bar:
            bar.skip(1)
            for i in range(4):
                seen.append(i)
                begun.set()
                go_on.wait(60.0)
                bar.update()

    job = jb.api.Job(work)
    assert begun.wait(60.0) and not job.done
    assert job.progress == (1, 5, "step")
    with pytest.raises(TimeoutError, match="still at work"):
        job.result(0.01)
    job.cancel()
    go_on.set()
    with pytest.raises(jb.api.Cancelled):
        job.result(60.0)
    assert seen == [0] and job.done


def test_a_cancelled_sweep_keeps_its_blocks(tmp_path):
    """And goes on with them to the results of one that was not cancelled."""
    case = jb.api.load_case(TABLES)
    over = {"loads.0.speed": np.linspace(20.0, 30.0, 6).tolist()}
    options = {"store": tmp_path / "runs.zarr", "progress": False, "memory": 2e5}
    job = jb.api.Job(jb.sweep, case, over, **options)
    while job.progress.done < 1 and not job.done:
        threading.Event().wait(0.005)
    job.cancel()
    with pytest.raises(jb.api.Cancelled):
        job.result(120.0)
    again = jb.sweep(case, over, resume=True, **options)
    whole = jb.sweep(case, over, progress=False)
    np.testing.assert_allclose(again.peak_deflection, whole.peak_deflection, rtol=1e-5)


def test_the_version_is_that_of_the_package():
    assert jb.__version__ == importlib.metadata.version("jaxbeam")
