"""Cases to start from: they are plausible, and run as they are."""

import pytest

from jaxbeam.cli.commands.new import KINDS


@pytest.mark.parametrize("kind", KINDS)
def test_a_starter_case_runs_as_it_is(run, folder, kind):
    assert f"written: {kind}.toml" in run(f"new {kind}")
    assert run(f"check {kind}.toml --json")["warnings"] == []
    found = run(f"simulate {kind}.toml --json")
    assert found["error_estimate"] < 1e-3
    assert all(sensor["smallest"] < sensor["largest"] for sensor in found["sensors"])


def test_a_file_is_not_overwritten(refused, run, folder):
    (folder / "mine.toml").write_text("precious")
    assert "mine.toml exists" in refused("new footbridge -o mine.toml")
    assert (folder / "mine.toml").read_text() == "precious"
    run("new footbridge -o mine.toml --overwrite")
    assert "Footbridge" in (folder / "mine.toml").read_text()
    assert "no case of kind 'bridge'" in refused("new bridge")
