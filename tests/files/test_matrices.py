"""Files of state-space matrices, read back by the programs that they are for."""

import csv
import json

import numpy as np
import pytest
import scipy.io
from numpy.testing import assert_array_equal

import jaxbeam as jb
from jaxbeam.cli import main
from jaxbeam.files.matrices import write_state_space


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
