"""The open case and its results, without any web."""

import numpy as np
import pytest

import jaxbeam as jb
from jaxbeam.app import views
from jaxbeam.app.workspace import PREVIEW_TOLERANCE
from tests.app.conftest import RIG


def test_a_model_has_tables_scene_and_numbers(workspace):
    model = workspace.model(RIG)
    assert model["problem"] is None
    assert model["tables"]["loads"][0]["speed"] == "3.6 km/h"
    assert model["numbers"]["loads.0.speed"] == {
        "value": 1.0,
        "unit": "m/s",
        "words": "speed of the load",
    }
    assert model["scene"]["supports"] == [{"position": 0.6, "elastic": False}]


def test_what_is_wrong_is_told_with_its_place(workspace):
    problem = workspace.model(RIG.replace("mass = 0.4", "mass = -0.4"))["problem"]
    assert problem["address"] == "loads.0.mass" and "negative" in problem["message"]
    problem = workspace.model(RIG.replace("duration = 1.3", "duration = 1.3 s"))["problem"]
    assert problem["line"] == RIG.splitlines().index("duration = 1.3") + 1


def test_a_record_is_that_of_the_library(workspace, rig):
    record = workspace.record(RIG)
    expected = jb.simulate(jb.load_case(rig))
    np.testing.assert_array_equal(record.sensor_values, expected.sensor_values)
    assert workspace.record(RIG) is record


@pytest.mark.parametrize("address", ["loads.0.speed", "loads.0.mass", "beam.flexural_rigidity"])
@pytest.mark.parametrize("factor", [0.5, 1.3, 2.0])
def test_a_preview_is_the_run_within_its_tolerance(workspace, address, factor):
    case = jb.api.load_case(RIG)
    value = factor * float(jb.addresses(case)[address])
    ranges = {address: [value / factor / 2, 2 * value / factor]}
    preview = workspace.preview(RIG, {address: value}, ranges)
    record = jb.simulate(jb.replace(case, {address: value}), np.asarray(preview.times))
    scale = np.abs(record.deflection).max()
    assert np.abs(preview.deflection - record.deflection).max() < PREVIEW_TOLERANCE * scale


def test_a_preview_beyond_its_range_or_of_another_order_is_computed_all_the_same(workspace):
    for values in ({"loads.0.speed": 3.0}, {"supports.0.position": 0.2}):
        preview = workspace.preview(RIG, values, {"loads.0.speed": [0.5, 2.0]})
        expected = jb.simulate(jb.replace(jb.api.load_case(RIG), values))
        assert float(preview.peak_deflection[0]) == pytest.approx(
            float(expected.peak_deflection[0]), rel=2 * PREVIEW_TOLERANCE
        )


def test_simulators_are_shared_by_cases_that_differ_in_the_moved_number(workspace):
    ranges, first = {"loads.0.speed": [0.5, 2.0]}, jb.api.load_case(RIG)
    other = jb.replace(first, {"loads.0.speed": 1.2})
    heavy = jb.replace(first, {"loads.0.mass": 0.1})
    found = [workspace.simulator(one, {"loads.0.speed": 1.0}, ranges) for one in (first, other)]
    assert found[0] is found[1]
    assert workspace.simulator(heavy, {"loads.0.speed": 1.0}, ranges) is not found[0]


def test_pictures_are_those_of_the_record(workspace):
    record = workspace.record(RIG)
    words, arrays = views.pictures(record)
    assert arrays["beam"].shape == (arrays["frameTimes"].size, arrays["x"].size)
    at_sensor = np.argmin(np.abs(arrays["x"] - 0.3))
    frames = np.searchsorted(record.times, arrays["frameTimes"])
    np.testing.assert_allclose(
        arrays["beam"][:, at_sensor], record.deflection[frames, 0], atol=1e-12
    )
    on_beam = np.isfinite(arrays["wheelPositions"][:, 0])
    np.testing.assert_allclose(
        arrays["wheelPositions"][on_beam, 0], arrays["frameTimes"][on_beam], rtol=1e-9, atol=1e-12
    )
    assert words["extremes"]["smallest"][0] == pytest.approx(float(record.smallest[0]))


def test_a_vehicle_is_drawn_from_its_parts(workspace):
    text = workspace.library_text("road-bridge")
    scene = views.scene(jb.api.load_case(text))
    vehicle = next(load["vehicle"] for load in scene["loads"] if load["vehicle"])
    assert len(vehicle["parts"]) >= vehicle["wheels"] // 2
    assert all(len(part["height"]) == vehicle["dofs"] for part in vehicle["parts"])
    record = jb.simulate(jb.replace(jb.api.load_case(text), {"run.duration": 0.2}))
    words, arrays = views.pictures(record)
    assert arrays["saturated"].shape[1] == len(scene["actuators"])
    assert arrays["bodies"].shape[1] == len(words["bodies"])


def test_vehicles_of_the_library_have_their_masses_and_parts():
    found = {one["name"]: one for one in views.vehicles()}
    assert found["truck-5-axle"]["mass"] == pytest.approx(40e3, rel=1e-3)
    for one in found.values():
        assert len(one["positions"]) == one["vehicle"]["wheels"]


def test_envelopes_are_those_of_the_record(workspace):
    found = views.envelopes(workspace.record(RIG))
    expected = workspace.record(RIG).envelope("moment")
    np.testing.assert_array_equal(found["moment"][2], expected.largest)


def test_files_are_saved_whole_and_not_over_the_changes_of_others(workspace, rig):
    opened = workspace.read("rig.toml")
    saved = workspace.save("rig.toml", RIG + "# more\n", opened["mark"])
    assert rig.read_text() == RIG + "# more\n"
    rig.write_text(RIG + "# by someone else\n")
    with pytest.raises(FileExistsError, match=r"rig\.toml"):
        workspace.save("rig.toml", RIG, saved["mark"])
    with pytest.raises(FileExistsError):
        workspace.save("rig.toml", RIG)
    assert workspace.save("other.toml", RIG)["name"] in workspace.files()


@pytest.mark.parametrize(
    "name", ["../a.toml", "/etc/passwd", "a/b.toml", "..", "", "a.txt", ".a.toml", "a\0.toml"]
)
def test_places_outside_the_folder_are_refused(workspace, name):
    for act in (workspace.read, lambda name: workspace.save(name, RIG)):
        with pytest.raises(ValueError, match="no place for a case"):
            act(name)


def test_links_out_of_the_folder_are_refused(workspace, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside") / "secret.toml"
    outside.write_text("title = 'secret'")
    (workspace.folder / "link.toml").symlink_to(outside)
    with pytest.raises(ValueError, match="no place for a case"):
        workspace.read("link.toml")


def test_files_that_a_text_names_are_below_the_folder(workspace):
    text = RIG + '[profile]\nkind = "table"\nfile = "/etc/passwd"\n'
    assert "not below the folder" in workspace.model(text)["problem"]["message"]


def test_every_case_to_start_from_is_right(workspace):
    for one in workspace.library():
        model = workspace.model(workspace.library_text(one["name"]))
        assert model["problem"] is None and model["scene"]["length"] > 0
    with pytest.raises(ValueError, match="no case 'X'"):
        workspace.library_text("X")


def test_absorbers_are_parts_that_swing_and_no_wheels_of_loads(workspace):
    text = RIG + "\n[[absorbers]]\nposition = 0.3\nmass = 0.02\nfrequency = 8.0\n"
    text += "damping_ratio = 0.1\n"
    record = workspace.record(text)
    words, arrays = views.pictures(record)
    assert workspace.model(text)["scene"]["absorbers"] == [{"position": 0.3}]
    assert words["shownWheels"] == [0] and len(words["crossing"]) == 1
    np.testing.assert_array_equal(arrays["strokes"], record.stroke)
    frames = np.searchsorted(record.times, arrays["frameTimes"])
    swing = arrays["bodies"][:, -1] - record.at(0.3)[frames]
    np.testing.assert_allclose(swing, record.stroke[frames, 0], atol=1e-12)
