"""The examples of docs/vehicles.md are read, and the names in it are those of the library."""

import re
import tomllib

from jaxbeam.case.loads.planar.vehicle import check_vehicle, load_vehicle, vehicle_names
from jaxbeam.case.validation import check_case
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.vehicles.library import trains
from tests.modules import ROOT

TEXT = (ROOT / "docs" / "vehicles.md").read_text(encoding="utf-8")
KINDS, FILE, SENSORS = re.findall(r"^```toml\n(.*?)^```", TEXT, re.M | re.S)
BEAM = {"length": 25.0, "flexural_rigidity": 4.8e10, "mass_per_length": 18358.0}


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
