"""TOML that pages show without running it is read without an error, completed where it is short."""

import re
import tomllib

import pytest

from jaxbeam.case.loads.planar.vehicle import load_vehicle
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.files.json_schema import tables
from tests.modules import ROOT
from tuning.control.load_cases import read_load_cases

BLOCKS = [
    (f"{page.relative_to(ROOT).as_posix()}-{i}", text)
    for page in sorted((ROOT / "docs").rglob("*.md"))
    for i, text in enumerate(re.findall(r"^```toml\n(.*?)^```", page.read_text(), re.M | re.S))
]
# What a block may leave out.
ABOUT = {
    "beam": {"length": 0.6, "flexural_rigidity": 13.2, "mass_per_length": 0.8},
    "actuators": [{"kind": "point", "position": 0.3}],
    "sensors": [{"position": 0.3}],
    "loads": [{"kind": "mass", "mass": 0.3, "speed": 1.0}],
    "run": {"duration": 1.0},
}


@pytest.mark.parametrize("text", [text for _, text in BLOCKS], ids=[name for name, _ in BLOCKS])
def test_blocks_are_read(tmp_path, text):
    content = tomllib.loads(text)
    path = tmp_path / "block.toml"
    path.write_text(text, encoding="utf-8")
    if "training" in content:
        found = read_load_cases(path)
        assert found.training and bool(found.held_out) == ("held_out" in content)
    elif "bodies" in content:
        assert load_vehicle(path).axles
    else:
        assert set(content) <= {"title", *tables()}
        completed = ABOUT | content
        if set(content.get("controller", {})) == {"estimator"}:
            completed["controller"] = {"kind": "lqr", "state_weight": [1.0] * 6} | content[
                "controller"
            ]
            completed["controller"] |= {"command_weight": [1.0], "period": 0.002}
        if "beam" in content:
            completed["beam"] = content["beam"]
            if "youngs_modulus" not in content["beam"]:
                completed["beam"] = ABOUT["beam"] | content["beam"]
        case_from_dict(completed)
