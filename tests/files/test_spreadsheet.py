"""Texts that a spreadsheet would run as formulas: written as text, and read back as they were."""

import csv
import re

import hypothesis
import numpy as np
import openpyxl
import pytest
from hypothesis import strategies
from openpyxl.utils.escape import unescape

import jaxbeam as jb
import tuning
from jaxbeam.files.tables import as_text_cell, from_text_cell, write_table

FORMULAS = ["=1+1", "+1", "-1", "@SUM(A1)", "\t=1", "\r=1", "=cmd|' /C calc'!A0", "＝1+1"]
RUNS = re.compile(r"[=+\-@\t\r\n＝＋－＠]")


@hypothesis.given(strategies.text(alphabet="'=+-@\t\rab,\"", max_size=6))
def test_any_text_comes_back_and_begins_no_formula(text):
    cell = as_text_cell(text)
    assert from_text_cell(cell) == text and not RUNS.match(cell)


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
    from jaxbeam.files.export.files import _csv_cell

    assert _csv_cell("=K") == "'=K"
