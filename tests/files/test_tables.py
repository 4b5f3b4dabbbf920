"""Tables in files of other programs: read again by those programs, to the last bit."""

import csv
import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest
import xarray

import jaxbeam as jb
from jaxbeam.files.endings import RESULTS, TABLES, check_ending
from jaxbeam.files.tables import sweep_columns, write_table

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


def test_csv(record, values, tmp_path):
    record.save(tmp_path / "run.csv")
    with (tmp_path / "run.csv").open(encoding="utf-8", newline="") as file:
        heads, *rows = csv.reader(file)
    assert heads == HEADS == list(record.columns)
    np.testing.assert_array_equal(np.array(rows, float), values)
    assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]


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
