"""The names in docs/vocabulary.md exist in case files and in the code."""

import dataclasses
import importlib
import re

import pytest

from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.actuators.base import AbstractActuator
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Run
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.estimator import AbstractEstimator
from jaxbeam.case.fields import PACKAGES, import_modules
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.loads.planar.vehicle_parts import VehicleSensor
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.sensors import Sensor
from tests.modules import ROOT

PARTS = {
    "beam": Beam,
    "supports": Support,
    "absorbers": Absorber,
    "actuators": AbstractActuator,
    "sensors": Sensor,
    "vehicle_sensors": VehicleSensor,
    "loads": AbstractLoad,
    "profile": AbstractProfile,
    "controller": AbstractController,
    "controller.estimator": AbstractEstimator,
    "run": Run,
}
LINES = (ROOT / "docs" / "vocabulary.md").read_text(encoding="utf-8").splitlines()
ROWS = [re.split(r"(?<!\\)\|", line)[1:-1] for line in LINES if line.startswith("| ")][2:]
ADDRESSES = sorted({name for row in ROWS for name in re.findall(r"`([^`]+)`", row[4])})
NAMES = sorted({name for row in ROWS for name in re.findall(r"`([^`]+)`", row[5])})


for _package in PACKAGES:
    import_modules(_package)


def subclasses(base: type) -> set[type]:
    """A class and all classes derived from it."""
    return {base}.union(*map(subclasses, base.__subclasses__()))


def resolved(name: str):
    """Module, class, function or attribute of a dotted name."""
    module, _, attribute = name.rpartition(".")
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError:
        owner = resolved(module)
        if attribute in getattr(owner, "__annotations__", {}):
            return None
        return getattr(owner, attribute)


def test_every_row_has_six_columns():
    assert len(ROWS) > 50
    assert {len(row) for row in ROWS} == {6}


@pytest.mark.parametrize("address", ADDRESSES)
def test_case_files_have_these_entries(address):
    table, _, key = re.sub(r"\.\d+", "", address).rpartition(".")
    if not table:
        assert key in PARTS
        return
    for package in PACKAGES:
        import_modules(package)
    fields = {f.name for one in subclasses(PARTS[table]) for f in dataclasses.fields(one)}
    assert key in fields | {"kind"}


@pytest.mark.parametrize("name", NAMES)
def test_the_code_has_these_names(name):
    resolved(name if name.startswith("tuning.") else f"jaxbeam.{name}")
