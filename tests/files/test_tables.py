"""Tables in files of other programs: read again by those programs, to the last bit."""

import csv
import importlib.util
from pathlib import Path

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.cli.arguments import TABLE_SUFFIXES, check_suffix
from jaxbeam.files.tables import write_table

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
    with pytest.raises(ValueError, match="a table is written to a file of .csv"):
        record.save(tmp_path / "run.txt")
    with pytest.raises(ValueError):
        write_table(tmp_path / "bad.csv", {"a": np.zeros(2), "b": np.zeros(3)})
    assert [found.name for found in tmp_path.iterdir()] == ["run.csv"]


def test_a_missing_package_is_told_before_the_run(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"\.xlsx files need openpyxl, which is not installed"):
        check_suffix(Path("run.xlsx"), ".nc", "a record", TABLE_SUFFIXES)
    check_suffix(Path("run.csv"), ".nc", "a record", TABLE_SUFFIXES)
