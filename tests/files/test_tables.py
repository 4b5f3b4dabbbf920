"""Tables in files of other programs: read again by those programs, to the last bit."""

import csv
import dataclasses
import importlib.util
import json
import re
from pathlib import Path

import hypothesis
import numpy as np
import openpyxl
import pytest
import scipy.io
import xarray
from hypothesis import strategies
from matplotlib.figure import Figure
from numpy.testing import assert_array_equal
from openpyxl.utils.escape import unescape

import jaxbeam as jb
import tuning
from jaxbeam.cli import main
from jaxbeam.files.netcdf import write_netcdf
from jaxbeam.files.report import (
    ReportFigure,
    ReportSection,
    ReportTable,
    check_report_folder,
    html,
    markdown,
    write_report,
)
from jaxbeam.files.tables import (
    as_text_cell,
    from_text_cell,
    sweep_columns,
    write_state_space,
    write_table,
)
from jaxbeam.runtime.output_file import RESULTS, TABLES, check_ending

CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535),
    sensors=[
        jb.Sensor(position=0.3, name="midspan"),
        jb.Sensor(position=0.15, quantity="acceleration"),
    ],
    loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    run=jb.Run(duration=0.4, sample_rate=100.0),
)
HEADS = [
    "time (s)",
    "midspan deflection (m)",
    "sensor 1 acceleration (m/s^2)",
    "load 0 contact force (N)",
]


@pytest.fixture(scope="module")
def record():
    return jb.simulate(CASE)


@pytest.fixture(scope="module")
def values(record):
    return np.column_stack([record.times, record.sensor_values, record.contact_force])


def test_matlab(record, values, tmp_path):
    import scipy.io

    record.save(tmp_path / "run.mat")
    content = scipy.io.loadmat(tmp_path / "run.mat", simplify_cells=True)
    assert list(content["columns"]) == HEADS
    np.testing.assert_array_equal(content["values"], values)


def test_parquet(record, values, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    record.save(tmp_path / "run.parquet")
    table = parquet.read_table(tmp_path / "run.parquet")
    assert table.column_names == HEADS
    np.testing.assert_array_equal(np.column_stack([c.to_numpy() for c in table.columns]), values)


def test_excel(record, values, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    record.save(tmp_path / "run.xlsx")
    heads, *rows = openpyxl.load_workbook(tmp_path / "run.xlsx").active.values
    assert list(heads) == HEADS
    # Sixteen digits are written, of the seventeen that some numbers need.
    np.testing.assert_allclose(np.array(rows, float), values, rtol=1e-15)


def test_files_are_not_replaced_nor_left_half_written(record, tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("precious")
    with pytest.raises(FileExistsError, match="exists already"):
        record.save(path)
    assert path.read_text() == "precious"
    record.save(path, overwrite=True)
    assert path.read_text().startswith("time (s),")
    with pytest.raises(
        ValueError, match="a record is written to a .nc file; call it .*.nc, or .zarr"
    ):
        record.save(tmp_path / "run.txt")
    with pytest.raises(ValueError):
        write_table(tmp_path / "bad.csv", {"a": np.zeros(2), "b": np.zeros(3)})
    assert [found.name for found in tmp_path.iterdir()] == ["run.csv"]


def test_a_missing_package_is_told_before_the_run(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ImportError, match=r"\.xlsx files need openpyxl, which is not installed"):
        check_ending(Path("run.xlsx"), "a record")
    check_ending(Path("run.csv"), "a record")


RESULTS_BY_NAME = {
    "record": lambda: jb.simulate(CASE),
    "modes": lambda: jb.modes(CASE),
    "response": lambda: jb.frequency_response(CASE, [1.0, 2.0, 5.0]),
    "envelope": lambda: jb.simulate(CASE).envelope("moment", np.linspace(0, 0.6, 5)),
    "sweep": lambda: jb.sweep(CASE, {"loads.0.speed": [1.0, 2.0]}, progress=False),
}


@pytest.mark.parametrize("name", RESULTS_BY_NAME)
def test_every_result_is_written_to_every_ending(name, tmp_path):
    """Datasets are read again as they are, columns of tables to the last bit."""
    result = RESULTS_BY_NAME[name]()
    is_sweep = name == "sweep"
    dataset = result if is_sweep else result.to_xarray()
    columns = sweep_columns(result) if is_sweep else result.columns
    for ending in RESULTS:
        path = tmp_path / f"out{ending}"
        jb.save(result, path)
        with pytest.raises(FileExistsError, match="exists already"):
            jb.save(result, path)
        jb.save(result, path, overwrite=True)
    assert {path.name for path in tmp_path.iterdir()} == {f"out{ending}" for ending in RESULTS}
    for found in (
        xarray.open_dataset(tmp_path / "out.nc", engine="scipy"),
        xarray.open_zarr(tmp_path / "out.zarr", consolidated=False),
    ):
        with found:
            for variable in dataset.variables:
                if dataset[variable].size:
                    np.testing.assert_array_equal(found[variable], dataset[variable])
                    units = dataset[variable].attrs.get("units")
                    assert found[variable].attrs.get("units") == units
    heads, *rows = csv.reader((tmp_path / "out.csv").read_text(encoding="utf-8").splitlines())
    assert heads == list(columns)
    np.testing.assert_array_equal(np.array(rows, float).T, list(columns.values()))
    if not is_sweep:
        assert list(result.to_dataframe()) == list(columns)[1:]


def test_a_record_is_restored_from_zarr(record, tmp_path):
    record.save(tmp_path / "run.zarr")
    again = jb.read_record(tmp_path / "run.zarr")
    np.testing.assert_array_equal(again.deflection, record.deflection)
    np.testing.assert_array_equal(again.peak_deflection, record.peak_deflection)


def test_rows_of_a_sweep_of_words_and_numbers(tmp_path):
    """A row for each run: the swept values in words with units, peaks and their times."""
    import scipy.io

    case = jb.replace(CASE, {"beam.flexural_rigidity": 1e8, "beam.mass_per_length": 535.0})
    case = dataclasses.replace(case, loads=[jb.Axles(train="HL93-tandem", speed=2.0)])
    over = {"loads.0.train": ["HL93-tandem", "LM71-axles"], "loads.0.speed": [2.0, 4.0, 8.0]}
    found = jb.sweep(case, over, progress=False)
    columns = sweep_columns(found)
    assert list(columns)[:3] == ["train", "speed of the train (m/s)", "midspan peak deflection (m)"]
    assert list(columns["train"]) == 3 * ["HL93-tandem"] + 3 * ["LM71-axles"]
    np.testing.assert_array_equal(columns["speed of the train (m/s)"], 2 * [2.0, 4.0, 8.0])
    peaks = found["peak_deflection"].isel(sensor=0).values.ravel()
    np.testing.assert_array_equal(columns["midspan peak deflection (m)"], peaks)
    times = found["peak_time"].isel(sensor=1).values.ravel()
    np.testing.assert_array_equal(columns["time of sensor 1 peak acceleration (s)"], times)
    for ending in TABLES:
        jb.save(found, tmp_path / f"out{ending}")
    content = scipy.io.loadmat(tmp_path / "out.mat", simplify_cells=True)
    assert content["text_columns"] == "train" and content["texts"][4] == "LM71-axles"
    assert content["values"].shape == (6, len(columns) - 1)
    with pytest.raises(ValueError, match="not a sweep of jaxbeam"):
        sweep_columns(found.drop_vars("failed"))


# Files of labelled variables, beside those that xarray writes.

PARTS = (
    {
        "deflection": (("time", "sensor"), np.arange(6.0).reshape(3, 2), {"units": "m"}),
        "shape": (("mode", "time"), np.array([[1.0, np.nan, -2.0]]), {"long_name": "Ä"}),
        "count": (("time",), np.arange(3, dtype=np.int32), {}),
        "scale": ((), np.array(2.5), {"units": "1"}),
    },
    {
        "time": ("time", np.array([0.0, 0.1, 0.2]), {"units": "s"}),
        "sensor": ("sensor", np.array(["0: deflection", "1: µ"])),
        "frequency": ("mode", np.array([12.5]), {"units": "Hz"}),
    },
    {"title": "", "remark": "m²", "error": 1.5e-9, "steps": 12},
)


def test_xarray_reads_the_dataset_and_would_have_written_the_same_file(tmp_path):
    ours, theirs = tmp_path / "ours.nc", tmp_path / "theirs.nc"
    write_netcdf(ours, *PARTS)
    dataset = xarray.Dataset(*PARTS)
    dataset.to_netcdf(theirs, engine="scipy")
    xarray.testing.assert_identical(xarray.load_dataset(ours, engine="scipy"), dataset)
    raw, expected = (
        xarray.load_dataset(path, engine="scipy", decode_cf=False) for path in (ours, theirs)
    )
    xarray.testing.assert_identical(raw, expected)
    assert all(raw[name].dtype == expected[name].dtype for name in expected.variables)


def test_variables_without_entries_are_left_out(tmp_path):
    path = tmp_path / "file.nc"
    empty = {"force": (("time", "load"), np.zeros((3, 0)), {})}
    write_netcdf(path, PARTS[0] | empty, *PARTS[1:])
    read = xarray.load_dataset(path, engine="scipy")
    assert "force" not in read and "load" not in read.sizes


# Texts that a spreadsheet would run as formulas: written as text, and read back as they were.

FORMULAS = [
    "=1+1",
    "+1",
    "-1",
    "@SUM(A1)",
    "\t=1",
    "\r=1",
    "=cmd|' /C calc'!A0",
    "＝1+1",
    "a;=1+1",
    "a\n@b",
]
SEPARATORS = "[;\t\r\n]"  # of cells, where the comma is the decimal mark
RUNS = re.compile(r"[=+\-@\t\r\n＝＋－＠]")


@hypothesis.given(strategies.text(alphabet="'=+-@\t\rab,;\"", max_size=6))
def test_any_text_comes_back_and_begins_no_formula(text):
    cell = as_text_cell(text)
    assert from_text_cell(cell) == text and not any(map(RUNS.match, re.split(SEPARATORS, cell)))


def rows_of(path):
    if path.suffix == ".csv":
        with path.open(encoding="utf-8", newline="") as file:
            return list(csv.reader(file))
    sheet = openpyxl.load_workbook(path).active
    assert not any(cell.data_type == "f" for row in sheet.iter_rows() for cell in row)
    return [
        [unescape(cell) if isinstance(cell, str) else cell for cell in row]
        for row in sheet.iter_rows(values_only=True)
    ]


@pytest.mark.parametrize("ending", ["csv", "xlsx"])
@pytest.mark.parametrize("text", FORMULAS)
def test_tables_hold_no_formulas(tmp_path, text, ending):
    path = tmp_path / f"run.{ending}"
    write_table(path, {text: np.array([-1.0, 2.0]), "word": np.array([text, "ok"], object)})
    heads, first, _ = rows_of(path)
    assert from_text_cell(heads[0]) == text and not RUNS.match(heads[0])
    assert from_text_cell(first[1]) == text and not RUNS.match(first[1])
    assert float(first[0]) == -1.0  # a number stays one


@pytest.mark.parametrize("ending", ["csv", "xlsx"])
@pytest.mark.parametrize("name", ["=cmd", "+a", "-b", "@c"])
def test_names_of_sensors_come_back_from_files(tmp_path, name, ending):
    case = jb.Case(
        jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535),
        sensors=[jb.Sensor(0.3, name=name)],
        loads=[jb.MovingForce(force=5.0, speed=2.0)],
        run=jb.Run(0.01),
    )
    path = tmp_path / f"run.{ending}"
    jb.save(jb.simulate(case), path)
    assert not any(RUNS.match(head) for head in rows_of(path)[0])
    log = tuning.read_log(path, columns=[f"{name} deflection"])
    assert log.names == (f"{name} deflection",)


def test_gains_hold_no_formulas():
    from jaxbeam.export.gain_files import _csv_cell

    assert _csv_cell("=K") == "'=K"


# Files of state-space matrices, read back by the programs that they are for.


def case() -> jb.Case:
    return jb.Case(
        jb.Beam(0.6, 11.68, 0.535, 0.03, modes=2),
        actuators=[jb.PointForce(0.22)],
        sensors=[jb.Sensor(0.3)],
        loads=[jb.MovingMass(mass=0.3, speed=1.0)],
    )


def test_each_format_has_all_digits_names_and_units(tmp_path):
    system = jb.state_space(case()).at(0.3)
    for suffix in (".mat", ".npz", ".json", ".csv"):
        write_state_space(system, tmp_path / f"plant{suffix}")
    matlab = scipy.io.loadmat(tmp_path / "plant.mat", squeeze_me=True, chars_as_strings=True)
    with np.load(tmp_path / "plant.npz") as file:
        numpy = dict(file)
    text = json.loads((tmp_path / "plant.json").read_text())
    for name in "ABCD":
        expected = getattr(system, name)
        for found in (matlab[name], numpy[name], text[name]):
            assert_array_equal(np.reshape(found, expected.shape), expected)
    assert text["inputs"] == ["command_0", "load_0"] and text["inputs_units"] == ["N", "N"]
    with open(tmp_path / "plant.csv", encoding="utf-8", newline="") as file:
        heads, *rows = csv.reader(file)
    assert heads[1] == "q_1 (m kg^0.5)" and rows[-1][0] == "sensor_0_deflection (m)"
    numbers = np.array([row[1:] for row in rows], float)
    expected = np.block([[system.A, system.B], [system.C, system.D]])
    assert_array_equal(numbers, expected)
    with pytest.raises(FileExistsError, match="exists already"):
        write_state_space(system, tmp_path / "plant.csv")
    with pytest.raises(ValueError, match=".mat, .npz, .json, .csv"):
        write_state_space(system, tmp_path / "plant.txt")


def test_the_command_prints_and_writes_the_sampled_plant(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    jb.save_case(case(), "case.toml")
    with pytest.raises(SystemExit) as ended:
        main(["state-space", "case.toml", "--period", "0.01", "-o", "plant.npz", "--json"])
    assert ended.value.code == 0
    expected = jb.state_space(case()).unloaded.discretize(0.01)
    with np.load("plant.npz") as found:
        assert_array_equal(found["A"], expected.A)
    assert json.loads(capsys.readouterr().out)["period"] == 0.01


# Reports in Markdown, HTML and plain text, and the files written.

TABLE = ReportTable(("load", "peak"), [("1 < 2", "good"), ("3", "bad")], {"good": "green"}.get)
SECTIONS = [
    ReportSection("", ["Preface & more."]),
    ReportSection("Peaks", [TABLE], level=3),
    ReportSection("Figure", [ReportFigure("drawn", Figure()), ReportFigure("elsewhere")]),
]


def test_markdown():
    assert markdown("Title", SECTIONS) == "\n".join(
        [
            "# Title", "", "Preface & more.", "", "### Peaks", "", "| load | peak |",
            "| --- | --- |", "| 1 < 2 | good |", "| 3 | bad |", "", "## Figure", "",
            "![drawn](drawn.png)", "", "![elsewhere](elsewhere.png)", "",
        ]
    )  # fmt: skip


def test_html_escapes_words_and_gives_cells_their_class():
    page = html("Title & co", SECTIONS, ".green { color: green }")
    assert "<h1>Title &amp; co</h1><p>Preface &amp; more.</p><h3>Peaks</h3>" in page
    assert '<tr><td>1 &lt; 2</td><td class="green">good</td></tr>' in page
    assert '<img src="drawn.png" alt="drawn">' in page and ".green { color: green }" in page


def test_only_figures_that_are_given_are_saved(tmp_path):
    write_report(tmp_path / "new" / "report", "Title", SECTIONS)
    written = {path.name for path in (tmp_path / "new" / "report").iterdir()}
    assert written == {"report.md", "report.html", "drawn.png"}


def test_a_folder_with_files_is_kept(tmp_path):
    (tmp_path / "other.txt").touch()
    with pytest.raises(FileExistsError, match="is not empty; choose another, or overwrite it"):
        write_report(tmp_path, "Title", SECTIONS)
    assert len(list(tmp_path.iterdir())) == 1
    check_report_folder(tmp_path, overwrite=True)
    check_report_folder(tmp_path / "none", overwrite=False)
