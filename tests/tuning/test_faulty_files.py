"""Files of load cases and descriptions of logs that are wrong in kind: one sentence each."""

import pytest

import jaxbeam as jb
from tuning.control.load_cases import read_load_cases
from tuning.logs.description import read_description

LOAD_CASES = {
    "training = 163315.8": "training must be a table",
    '[training]\n"loads.0.mass" = 5': "training.loads.0.mass must be a list of numbers",
    '[training]\n"loads.0.mass" = [nan]': "training.loads.0.mass must be a list of numbers",
    f'[training]\n"loads.0.mass" = [1{"0" * 400}]': "training.loads.0.mass must be a list",
    f'[training]\n"loads.0.mass" = [1, 2]\ndraws = {"9" * 300}': "training.draws must be a whole",
    '[training]\n"loads.0.mass" = [1, 2]\nseed = -1': "training.seed must be a whole number",
    "[training]\ndraws = 3": "training.draws needs ranges",
    "held_out = [1]": "held_out must be a table",
    f"training = {'[' * 200}{']' * 200}": "nested more than 32 deep",
    f"training = {'[' * 5000}": "not valid TOML",
    "[trainings]": r"there is no table \[trainings\]",
}
DESCRIPTIONS = {
    "runs = 3": "runs must be a table",
    "[runs]\nfast = 5e-324": "runs.fast must be a table",
    "[runs.fast]\nloads = {}": "runs.fast.loads must be a list of tables",
    "columns = [1]": "columns must be a table",
    "[columns]\na = 3": "columns.a: give a unit",
    "[columns.a]\nsensor = 1.5": "columns.a.sensor must be a whole number",
    f"[columns.a]\nposition = {'9' * 400}": "columns.a.position must be a number in m",
    f'[[loads]]\nkind = "mass"\nspeed = 1.0\nmass = {"9" * 400}': "loads.0.mass must be one number",
    "loads = 5": "loads must be a list of tables",
    "time = 3": "time must be a word in quotes",
    "colums = 1": "unknown key colums; did you mean",
}


@pytest.mark.parametrize("text", LOAD_CASES)
def test_faulty_load_cases(tmp_path, text):
    path = tmp_path / "cases.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=LOAD_CASES[text]) as error:
        read_load_cases(path)
    assert str(error.value).startswith(f"{path}: ")
    assert len(str(error.value)) < 300 + len(str(path))


@pytest.mark.parametrize("text", DESCRIPTIONS)
def test_faulty_description(tmp_path, text):
    path = tmp_path / "log.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=DESCRIPTIONS[text]) as error:
        read_description(tmp_path / "log.csv")
    assert str(error.value).startswith(f"{path}: ")
    assert len(str(error.value)) < 300 + len(str(path))


def test_load_cases_with_units(tmp_path):
    """In SI units; a unit of another kind, or an address that does not exist, is refused."""
    path, beam = tmp_path / "loads.toml", jb.Beam(25.0, 3e10, 1.5e4)
    case = jb.Case(beam, loads=[jb.MovingForce(force=1e5, speed=20.0)])
    path.write_text('[training]\n"loads.0.speed" = ["36 km/h", "72 km/h"]\n"loads.0.force" = [1]\n')
    runs = read_load_cases(path, case).training
    assert [run["loads.0.speed"] for run in runs] == pytest.approx([10.0, 20.0])
    with pytest.raises(ValueError, match="must be a list of numbers"):
        read_load_cases(path)
    for address, message in (
        ("loads.0.mass", "no number at address 'loads.0.mass'"),
        ("loads.0.force", "training.loads.0.force.0 must be in N"),
    ):
        path.write_text(f'[training]\n"{address}" = ["36 km/h"]\n')
        with pytest.raises(ValueError, match=message):
            read_load_cases(path, case)
