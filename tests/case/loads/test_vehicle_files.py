"""Vehicles of files, of the library and of tables in a case: read, written, changed, refused."""

import re
import tomllib

import equinox as eqx
import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.case.library.published import trains
from jaxbeam.case.loads.vehicles import check_vehicle, load_vehicle, vehicle_names
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import (
    case_from_dict,
    case_to_dict,
    load_case,
    save_case,
    with_settings,
)
from tests.modules import ROOT

GRAVITY = np.float64(9.81)
BEAM = {"length": 25.0, "flexural_rigidity": 4.8e10, "mass_per_length": 18358.0}
CART = """
title = "Cart"
source = "measured"
[[bodies]]
name = "cart"
mass = 800.0
inertia = 500.0
[[axles]]
body = "cart"
position = 1.5
tyre_stiffness = 2.0e5
[[axles]]
body = "cart"
position = -1.5
tyre_stiffness = 2.0e5
"""


def case_of(**load):
    """Case with a load of the kind "vehicle"."""
    return case_from_dict({"beam": BEAM, "loads": [{"kind": "vehicle", "speed": 20.0} | load]})


@pytest.mark.parametrize("name", vehicle_names())
def test_every_vehicle_of_the_library_stands_and_has_a_source(name):
    vehicle = load_vehicle(name)
    check_vehicle(vehicle)
    assert "commit" in vehicle.source and vehicle.title
    model = vehicle.model(GRAVITY)
    masses = sum(body.mass for body in vehicle.bodies) + sum(axle.mass for axle in vehicle.axles)
    assert np.sum(model.static_loads) == pytest.approx(masses * GRAVITY, rel=1e-12)
    assert np.all(model.natural_frequencies() > 0.5)
    assert np.all(model.natural_frequencies() < 20.0)


# Weight per wheelset (t) by hand from the tables of the sources, and length of the wagon (m).
WAGONS = {
    "manchester-wagon": ((32 + 2 * 2.615 + 4 * 1.813) / 4, 25.0),
    "ice3-coach": ((47.8 + 2 * 3.5 + 4 * 1.8) / 4, 24.775),
    "ice3-middle-coach": ((41.2 + 2 * 3.5 + 4 * 1.8) / 4, 24.775),
    "shinkansen-s300": ((41.75 + 2 * 3.04 + 4 * 1.78) / 4, 25.0),
}


@pytest.mark.parametrize("name", WAGONS)
def test_wagons_of_the_library(name):
    axle_load, spacing = WAGONS[name]
    load = jb.vehicles.VehicleLoad(model=name, count=3, speed=50.0)
    assert load.validate("loads.0") is None
    np.testing.assert_allclose(load.vehicle(GRAVITY).static_loads, 1e3 * axle_load * GRAVITY)
    np.testing.assert_allclose(load.spacings(), spacing * np.arange(3))


def test_truck_of_five_axles_has_the_published_static_loads():
    """As printed by VBI-2D, kN."""
    loads = jb.vehicles.VehicleLoad(model="truck-5-axle", speed=20.0).vehicle(GRAVITY).static_loads
    np.testing.assert_allclose(loads / 1e3, [55.162, 105.278, 78.252, 77.320, 76.387], atol=6e-4)


def test_case_names_a_vehicle_of_the_library(tmp_path):
    case = case_of(model="truck-5-axle")
    assert case_to_dict(case)["loads"][0].keys() == {
        "kind", "speed", "entry_time", "deceleration", "count", "model"
    }  # fmt: skip
    assert jb.addresses(case)["loads.0.bodies.1.mass"] == 31450.0
    save_case(case, tmp_path / "case.toml")
    assert eqx.tree_equal(load_case(tmp_path / "case.toml"), case)
    assert 'model = "truck-5-axle"' in (tmp_path / "case.toml").read_text()


def test_changed_numbers_of_a_vehicle_are_written(tmp_path):
    case = jb.replace(case_of(model="truck-5-axle"), {"loads.0.bodies.1.mass": 30000.0})
    save_case(case, tmp_path / "case.toml")
    again = load_case(tmp_path / "case.toml")
    assert eqx.tree_equal(again, case)
    assert "[[loads.bodies]]" in (tmp_path / "case.toml").read_text()
    assert again.loads[0].bodies[1].mass == 30000.0


def test_settings_reach_the_numbers_and_the_model():
    case = case_of(model="truck-5-axle")
    changed = with_settings(case, {"loads.0.axles.2.tyre_stiffness": 3e6})
    assert changed.loads[0].axles[2].tyre_stiffness == 3e6
    assert changed.loads[0].axles[1].tyre_stiffness == 3.5e6
    wagon = with_settings(changed, {"loads.0.model": "ice3-coach", "loads.0.count": 2})
    assert eqx.tree_equal(wagon, case_of(model="ice3-coach", count=2))


def test_path_of_a_vehicle_file_is_relative_to_the_case_file(tmp_path, monkeypatch):
    (tmp_path / "cases" / "carts").mkdir(parents=True)
    (tmp_path / "cases" / "carts" / "cart.toml").write_text(CART)
    (tmp_path / "cases" / "case.toml").write_text(
        "[beam]\nlength = 25.0\nflexural_rigidity = 4.8e10\nmass_per_length = 18358.0\n"
        '[[loads]]\nkind = "vehicle"\nmodel = "carts/cart.toml"\nspeed = 20.0\n'
    )
    monkeypatch.chdir(tmp_path)
    case = load_case("cases/case.toml")
    assert case.loads[0].bodies[0].name == "cart"
    save_case(case, "elsewhere.toml")
    (tmp_path / "cases" / "carts" / "cart.toml").unlink()
    assert eqx.tree_equal(load_case("elsewhere.toml"), case)


def test_vehicle_stands_in_the_case_itself(tmp_path):
    text = CART.replace('title = "Cart"\nsource = "measured"\n', "").replace("[[", "[[loads.")
    (tmp_path / "case.toml").write_text(
        "[beam]\nlength = 25.0\nflexural_rigidity = 4.8e10\nmass_per_length = 18358.0\n"
        '[[loads]]\nkind = "vehicle"\nspeed = 20.0\n' + text
    )
    load = load_case(tmp_path / "case.toml").loads[0]
    (tmp_path / "cart.toml").write_text(CART)
    assert eqx.tree_equal(load.planar_vehicle().axles, load_vehicle(tmp_path / "cart.toml").axles)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "mass = 800.0",
            "mas = 800.0",
            "cart.toml: bodies.0 has no key 'mas'; did you mean 'mass'",
        ),
        ("mass = 800.0", "", "cart.toml: bodies.0.mass is missing; give the mass in kg"),
        ("mass = 800.0", "mass = -8.0", "cart.toml: bodies.0.mass must be positive; it is -8 kg"),
        ("mass = 800.0", 'mass = "a"', "cart.toml: bodies.0.mass must be one number"),
        ("[[bodies]]", "[bodies]", r"cart.toml: bodies must be a list of tables; write \[\[bodies"),
        ('title = "Cart"', "wheels = 3", "cart.toml: has no key 'wheels'"),
        ("position = -1.5", "position = 1.0", "cart.toml: axle 2 of the vehicle would|axle 1 of"),
        ("[[bodies]]", "[[bodies", "cart.toml: not valid TOML"),
    ],
)
def test_wrong_files_are_refused_in_one_sentence(tmp_path, old, new, message):
    (tmp_path / "cart.toml").write_text(CART.replace(old, new, 1))
    with pytest.raises(ValueError) as error:
        load_vehicle(str(tmp_path / "cart.toml"))
    assert re.search(message, str(error.value)), error.value


@pytest.mark.parametrize(
    ("load", "message"),
    [
        ({"model": "truck-5-axl"}, "loads.0.model: there is no vehicle .*mean 'truck-5-axle'"),
        ({}, "loads.0 has neither model nor bodies; name a vehicle"),
        ({"model": "truck-5-axle", "count": 2}, "loads.0.spacing is missing"),
        ({"model": "ice3-coach", "count": 2, "spacing": 19.0}, "exceed the wheelbase of the vehic"),
        ({"model": "half-truck", "hinges": [{"first": "body", "second": "van", "position": 0}]},
         "loads.0.hinges.0.second cannot be 'van'"),
    ],
)  # fmt: skip
def test_wrong_loads_are_refused(load, message):
    from jaxbeam.case.validation import check_case

    with pytest.raises(ValueError, match=message):
        check_case(case_of(**load))


def test_missing_file_is_named():
    with pytest.raises(OSError, match="cannot read the vehicle file none.toml: no such file"):
        case_of(model="none.toml")


# The examples of docs/vehicles.md are read, and the names in it are those of the library.

TEXT = (ROOT / "docs" / "vehicles.md").read_text(encoding="utf-8")
KINDS, FILE, TRACK, SENSORS = re.findall(r"^```toml\n(.*?)^```", TEXT, re.M | re.S)


def test_loads_of_the_page_are_valid():
    case = case_from_dict({"beam": BEAM, **tomllib.loads(KINDS)})
    check_case(case)
    assert {load.kind for load in case.loads} == {
        "oscillator", "quarter-car", "half-car", "wagon", "axles", "varying-force", "pedestrian",
        "crowd", "vehicle", "line-load", "train"
    }  # fmt: skip


def test_sensors_of_the_page_are_valid():
    loads = [one for one in tomllib.loads(KINDS)["loads"] if one["kind"] == "quarter-car"]
    case = case_from_dict({"beam": BEAM, "loads": loads, **tomllib.loads(SENSORS)})
    check_case(case)
    assert case.vehicle_sensors[0].body == "axle"


def test_track_of_the_page_is_valid():
    content = tomllib.loads(TRACK)
    case = case_from_dict({**content, "beam": BEAM | {"length": 24.0} | content["beam"]})
    check_case(case)
    assert case.track.layered and float(case.track.approach) == 30.0


def test_vehicle_file_of_the_page_is_valid(tmp_path):
    (tmp_path / "vehicle.toml").write_text(FILE)
    vehicle = load_vehicle(tmp_path / "vehicle.toml")
    check_vehicle(vehicle)
    assert vehicle.springs and vehicle.hinges


def test_library_of_the_page_is_complete():
    listed = TEXT[TEXT.index("## Library") :]
    families = ("HSLM-A", "EN15528-")
    names = [n for n in (*vehicle_names(), *trains()) if not n.startswith(families)]
    assert [name for name in names if name not in listed] == []
