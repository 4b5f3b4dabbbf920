"""Old words of case files, saved cases, addresses and the package: accepted with a warning."""

import json
import subprocess
import sys

import equinox as eqx
import pytest

import jaxbeam as jb
from jaxbeam.case import aliases
from jaxbeam.case.case import addresses, unit_at, value_at
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.kinds import kinds
from jaxbeam.files.case_file import (
    case_from_dict,
    case_to_dict,
    load_case,
    load_controller,
    with_settings,
)
from jaxbeam.simulation.stored_record import record_from_xarray
from jaxbeam.sweeps.specification import specification_from_dict, sweep_specification

BEAM = {"length": 0.6, "flexural_rigidity": 11.68, "mass_per_length": 0.535, "modes": 1}
CASE = {
    "beam": BEAM,
    "actuators": [{"kind": "point", "position": 0.3}],
    "sensors": [{"position": 0.3}],
    "loads": [{"kind": "mass", "mass": 0.3, "speed": 1.0}],
}
LAWS = {
    "passage": {"gates": [-0.2, -0.1], "shares": [0.0, 1.0], "values": [[0.0, 1.0]]},
    "relief": {"readings": [0.0, 1e-3], "values": [[0.0, 1.0]]},
}
IDENTIFIED = {
    "kind": "feedback-scheduled",
    "masses": [0.2, 0.6],
    "gains": [[2e3, 4e3]],
    "period": 0.01,
    "recognition": {"gates": [-0.2, -0.1], "until": 0.3},
}


def present(controller):
    """The table of a controller with its present words."""
    table = {aliases.KEYS.get(key, key): value for key, value in controller.items()}
    return table | {"kind": aliases.KINDS.get(table["kind"], table["kind"])}


def test_present_words_exist():
    assert set(aliases.KINDS.values()) <= set(kinds(AbstractController))
    assert not set(aliases.KINDS) & set(kinds(AbstractController))
    assert set(aliases.NAMES.values()) <= set(jb.__all__)
    assert not set(aliases.NAMES) & set(jb.__all__)


@pytest.mark.parametrize("kind", LAWS)
def test_old_kind_in_a_case_file(kind, tmp_path):
    table = LAWS[kind] | {"kind": kind, "period": 0.01}
    with pytest.warns(FutureWarning, match=f"controller.kind = '{kind}' is called .* now"):
        case = case_from_dict(CASE | {"controller": table})
    assert eqx.tree_equal(case, case_from_dict(CASE | {"controller": present(table)}))
    assert case_to_dict(case)["controller"]["kind"] == aliases.KINDS[kind]


def test_old_key_in_a_case_file(tmp_path):
    path = tmp_path / "case.toml"
    expected = case_from_dict(CASE | {"controller": present(IDENTIFIED)})
    jb.save_case(expected, path)
    text = path.read_text()
    assert "load_identification" in text
    path.write_text(text.replace("load_identification", "recognition"))
    message = "controller.recognition is called load_identification now"
    with pytest.warns(FutureWarning, match=message):
        assert eqx.tree_equal(load_case(path), expected)
    with pytest.warns(FutureWarning, match=message):
        assert eqx.tree_equal(load_controller(path), expected.controller)
    both = present(IDENTIFIED) | IDENTIFIED
    with pytest.raises(ValueError, match=f"{message}; leave one of them out"):
        case_from_dict(CASE | {"controller": both})
    with pytest.raises(ValueError, match="beam has no key 'recognition'"):
        case_from_dict(CASE | {"beam": BEAM | {"recognition": {}}})


def test_old_address():
    case = case_from_dict(CASE | {"controller": present(IDENTIFIED)})
    old, new = "controller.recognition.until", "controller.load_identification.until"
    assert new in addresses(case)
    message = f"{old} is called {new} now"
    with pytest.warns(FutureWarning, match=message):
        changed = jb.replace(case, {old: 0.4})
    assert changed.controller.load_identification.until == 0.4
    with pytest.warns(FutureWarning, match=message):
        assert value_at(changed, old) == 0.4
    with pytest.warns(FutureWarning, match=message):
        assert unit_at(case, old) == unit_at(case, new)
    with pytest.warns(FutureWarning, match=message):
        assert eqx.tree_equal(with_settings(case, {old: 0.4}), changed)


def test_old_words_in_a_saved_record():
    record = jb.simulate(case_from_dict(CASE | {"controller": present(IDENTIFIED)}))
    dataset = record.to_xarray()
    content = json.loads(dataset.attrs["case"])
    content["controller"]["recognition"] = content["controller"].pop("load_identification")
    dataset.attrs["case"] = json.dumps(content)
    with pytest.warns(FutureWarning, match="controller.recognition is called"):
        assert eqx.tree_equal(record_from_xarray(dataset).case, record.case)


def test_old_words_in_a_stored_sweep():
    """A store made before the renaming is continued: the case and the addresses are read."""
    case = case_from_dict(CASE | {"controller": present(IDENTIFIED)})
    old, new = "controller.recognition.until", "controller.load_identification.until"
    settings = {
        "paired": False,
        "histories": False,
        "tolerance": 1e-6,
        "precision": "double",
    }.values()
    expected = sweep_specification(case, {new: [0.3, 0.4]}, *settings)
    content = json.loads(json.dumps(expected.to_dict()))
    controller = content["case"]["controller"]
    controller["recognition"] = controller.pop("load_identification")
    with pytest.warns(FutureWarning, match="controller.recognition is called"):
        specification = specification_from_dict(content)
    assert eqx.tree_equal(specification.case, expected.case)
    with pytest.warns(FutureWarning, match="controller.recognition.until is called"):
        by_old_address = sweep_specification(case, {old: [0.3, 0.4]}, *settings)
    assert by_old_address.axes.keys() == expected.axes.keys()


@pytest.mark.parametrize(("old", "new"), aliases.NAMES.items())
def test_old_name_of_the_package(old, new):
    with pytest.warns(DeprecationWarning, match=f"jaxbeam.{old} is called jaxbeam.{new} now"):
        assert getattr(jb, old) is getattr(jb, new)


def test_unknown_name_of_the_package():
    with pytest.raises(AttributeError, match="no_such_name"):
        jb.no_such_name  # noqa: B018


def test_importing_the_package_does_not_import_jax():
    code = "import sys, jaxbeam; assert 'jax' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_old_keyword_arguments():
    identification = jb.LoadIdentification(gates=[-0.2, -0.1])
    settings = {"masses": [0.2], "gains": [[2e3]], "period": 0.01}
    with pytest.warns(DeprecationWarning, match="recognition=.* is called load_identification"):
        controller = jb.ScheduledFeedback(**settings, recognition=identification)
    assert controller.load_identification is identification
    with pytest.warns(DeprecationWarning, match="reach=.* is called max_delay_periods now"):
        assert jb.Kalman(0.02, 1e-5, reach=3).max_delay_periods == 3
    with pytest.raises(TypeError, match="places is called positions now; leave one out"):
        jb.LQR([1.0], [1.0], places=[0.3], positions=[0.3])
    with pytest.raises(TypeError, match="place_weights"):
        jb.LQR([1.0], [1.0], place_weights=[1.0])
