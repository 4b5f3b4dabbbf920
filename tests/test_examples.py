"""Examples: their cases are plausible, and run.py finds what the field would expect."""

import runpy

import numpy as np
import pytest

import jaxbeam as jb
from tests.modules import ROOT

NAMES = sorted(path.parent.name for path in (ROOT / "examples").glob("*/case.toml"))


def run(name, tmp_path, **options):
    """What the example returns; it writes its picture."""
    found = runpy.run_path(str(ROOT / "examples" / name / "run.py"))["main"](tmp_path, **options)
    assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    return found


def test_each_example_is_listed_and_has_a_run():
    text = (ROOT / "examples" / "README.md").read_text(encoding="utf-8")
    assert len(NAMES) >= 8
    assert [name for name in NAMES if f"]({name}/case.toml)" not in text] == []
    assert [n for n in NAMES if not (ROOT / "examples" / n / "run.py").exists()] == []


@pytest.mark.parametrize("name", NAMES)
def test_cases_look_right(name):
    assert jb.check(jb.load_case(ROOT / "examples" / name / "case.toml")).warnings == ()


def test_footbridge_is_worst_at_its_natural_frequency(tmp_path):
    peaks = run("footbridge", tmp_path, count=5)
    assert abs(max(peaks, key=peaks.get) - 2.002) < 0.06


def test_railway_bridge_is_worst_at_the_resonance_of_coaches(tmp_path):
    worst = run("railway_bridge", tmp_path, count=26)
    first = np.pi / (2 * 25.0**2) * np.sqrt(3e10 / 15e3)
    assert worst == pytest.approx(18.0 * first, rel=0.02)


def test_crane_runway_bends_as_by_statics(tmp_path):
    """Three equal spans, slow wheels: the middle span sags by less than a simple span would."""
    ratio = run("crane_runway", tmp_path)
    stiffness = 210e9 * 0.097 * 0.283**3 / 12
    simple = 2 * 6000.0 * 9.81 * 6.0**3 / (48 * stiffness)  # both wheels at midspan
    assert 1.5 < ratio * simple / 6.0 < 4.0


def test_linear_guide_rings_by_its_damping(tmp_path):
    settling = run("linear_guide", tmp_path)
    assert 0.3 < settling < 2.0


def test_laboratory_rig_is_almost_static(tmp_path):
    assert 0 < run("laboratory_rig", tmp_path) < 0.02


def test_controlled_rig_attains_a_share(tmp_path):
    assert 0.3 < run("controlled_rig", tmp_path) < 1.0


def test_haunched_bridge_hogs_over_the_pier(tmp_path):
    assert run("haunched_bridge", tmp_path) < -1e6


def test_a_rougher_road_adds_to_the_moment(tmp_path):
    increments = run("road_bridge", tmp_path)
    moments = [increments[road][1] for road in ("smooth", "A", "B", "C")]
    assert moments == sorted(moments) and moments[0] > 0
