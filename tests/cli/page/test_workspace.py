"""The open case and its results, without any web."""

import dataclasses
import json
import re
import tomllib
from importlib import resources

import hypothesis
import numpy as np
import pytest
from hypothesis import strategies as st

import jaxbeam as jb
from jaxbeam.cli.page import views
from jaxbeam.cli.page.workspace import PREVIEW_TOLERANCE, changed
from tests.cli.page.conftest import RIG
from tests.modules import ROOT
from tests.tuning.modal.test_modal import ambient
from tuning import identify_modes


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


FOLLOWING_TRUCK = (
    '\n[[loads]]\nkind = "vehicle"\nmodel = "truck-5-axle"\nspeed = 20.0\nentry_time = 1.0\n'
)


def test_contact_forces_that_are_given_have_no_history(workspace):
    """Of a train of constant forces none; of three trucks the first twelve wheels of fifteen."""
    bridge = (ROOT / "examples/road_bridge/case.toml").read_text(encoding="utf-8")
    words, _ = views.pictures(workspace.record(f"{bridge}{2 * FOLLOWING_TRUCK}"))
    assert (len(words["shownWheels"]), words["hiddenWheels"]) == (12, 3)
    train = bridge.replace('kind = "vehicle"', 'kind = "axles"')
    words, arrays = views.pictures(
        workspace.record(train.replace('model = "truck-5-axle"', 'train = "HSLM-A1"'))
    )
    assert words["shownWheels"] == [] and arrays["contact"].shape[1] == 0


# Changes of the text of a case: what is not changed stays as it was.

CASES = sorted(
    [*ROOT.glob("examples/*/case.toml"), *ROOT.glob("jaxbeam/case/library/rigs/*.toml")]
    + [*ROOT.glob("jaxbeam/files/starters/*.toml")]
)


CASE = jb.api.load_case(RIG)


def case_of(text):
    return jb.api.load_case(text)


@pytest.mark.parametrize("path", CASES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_a_text_without_changes_is_the_same_to_the_byte(path):
    text = path.read_text(encoding="utf-8")
    assert changed(text, []) == text


@pytest.mark.parametrize("path", CASES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_only_the_line_of_the_number_changes(path):
    text = path.read_text(encoding="utf-8")
    case = jb.load_case(path)
    length = float(case.beam.length)
    new = changed(text, [{"set": "beam.length", "to": 1.25 * length}], case).splitlines()
    different = [i for i, (a, b) in enumerate(zip(text.splitlines(), new, strict=True)) if a != b]
    assert len(different) == 1
    comment = text.splitlines()[different[0]].partition("#")[2]
    assert new[different[0]].partition("#")[2] == comment
    value = jb.api.load_case("\n".join(new), folder=path.parent).beam.length
    assert float(value) == pytest.approx(1.25 * length, rel=1e-12)


def test_a_quantity_keeps_its_unit():
    new = changed(RIG, [{"set": "loads.0.speed", "to": 2.0}], case_of(RIG))
    assert 'speed = "7.2 km/h"' in new
    assert float(case_of(new).loads[0].speed) == pytest.approx(2.0, rel=1e-12)


@hypothesis.given(st.floats(1e-3, 1e3))
def test_a_quantity_is_the_number_that_was_asked_for(speed):
    new = changed(RIG, [{"set": "loads.0.speed", "to": speed}], CASE)
    quantity = tomllib.loads(new)["loads"][0]["speed"]
    assert quantity.endswith(" km/h")
    assert float(quantity.split()[0]) / 3.6 == pytest.approx(speed, rel=1e-11)


def test_entries_are_added_and_removed():
    new = changed(
        RIG,
        [
            {"set": "sensors.1", "to": {"position": 0.9, "quantity": "moment"}},
            {"set": "actuators.0", "to": {"kind": "point", "position": 0.3, "limits": [-1.0, 1.0]}},
            {"set": "controller", "to": {"kind": "feedback", "gains": [1.0]}},
            {"set": "beam.segments.0", "to": {"length": 0.5}},
            {"remove": "supports.0"},
            {"remove": "sensors.0.name"},
        ],
    )
    content = tomllib.loads(new)
    assert content["sensors"] == [{"position": 0.3}, {"position": 0.9, "quantity": "moment"}]
    assert content["actuators"][0]["kind"] == "point" and "supports" not in content
    assert content["controller"]["gains"] == [1.0]
    assert content["beam"]["segments"] == [{"length": 0.5}]
    assert "# A rig of two spans" in new and "# kg/m" in new
    assert case_of(changed(new, [{"remove": "beam.segments"}])).controller is not None


def test_all_entries_removed_leave_no_empty_list():
    assert "actuators" not in changed(
        changed(RIG, [{"set": "actuators.0", "to": {"kind": "point", "position": 0.3}}]),
        [{"remove": "actuators.0"}],
    )


@pytest.mark.parametrize(
    "change",
    [
        {"set": "sensors.5", "to": {"position": 0.1}},
        {"set": "sensors.x", "to": 1.0},
        {"set": "beam.length.0", "to": 1.0},
        {"remove": "beam.nothing"},
        {"remove": "loads.3"},
        {"remove": "nowhere.0.position"},
    ],
)
def test_a_place_that_is_not_there_is_named(change):
    address = change.get("set") or change["remove"]
    with pytest.raises(ValueError, match=address):
        changed(RIG, [change])


def test_text_that_is_not_toml_is_refused():
    with pytest.raises(ValueError, match="not valid TOML"):
        changed("[beam", [])


def test_starters_are_read_as_text():
    folder = resources.files("jaxbeam") / "files" / "starters"
    for one in folder.iterdir():
        assert case_of(one.read_text(encoding="utf-8")).title


# Interactive figures of records: pages in one file, without a request to anywhere.

PAGE_CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=1),
    sensors=[jb.Sensor(0.3, name="mid</script>"), jb.Sensor(0.2), jb.Sensor(0.3, "velocity")],
    loads=[jb.MovingForce(force=1.0, speed=2.0)],
    run=jb.Run(0.3),
    title="a < b",
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "run.html"
    record = jb.simulate(PAGE_CASE)
    record.to_html(path)
    return record, path


def test_the_page_has_the_histories(written):
    record, path = written
    text = path.read_text(encoding="utf-8")
    assert text.count("</script>") == 1 and "a &lt; b" in text
    data = json.loads(re.search(r"^const DATA = (.*);$", text, re.MULTILINE)[1])
    assert [(one["title"], one["unit"]) for one in data["panels"]] == [
        ("deflection", "m"), ("velocity", "m/s"), ("force", "N"),
    ]  # fmt: skip
    series = data["panels"][0]["series"]
    assert [one["name"] for one in series] == ["mid</script>", "sensor 1"]
    np.testing.assert_allclose(series[1]["y"], record.deflection[:, 1], rtol=1e-5)
    with pytest.raises(FileExistsError):
        record.to_html(path)
    with pytest.raises(ValueError, match=r"written to a \.html file"):
        record.to_html(path.with_suffix(".svg"))


def test_a_browser_draws_it_without_requests(written, browser):
    requests, wrong = [], []
    page = browser.new_page()
    page.on("request", lambda request: requests.append(request.url))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.on("console", lambda line: wrong.append(line.text) if line.type == "error" else None)
    page.goto(written[1].as_uri())
    page.wait_for_function("document.querySelectorAll('canvas').length === 3")
    page.locator("canvas").first.hover()
    page.wait_for_function("document.querySelector('output').textContent.includes('sensor 1')")
    page.close()
    assert wrong == [] and requests == [written[1].as_uri()]


def test_modes_are_chosen_by_clicks_on_a_page_without_requests(tmp_path, browser):
    fit, path = identify_modes(ambient(0)), tmp_path / "log.html"
    fit.to_html(path)
    data = json.loads(re.search(r"^const DATA = (.*);$", path.read_text(), re.MULTILINE)[1])
    found = np.array(data["frequencies"])[data["chosen"]]
    np.testing.assert_allclose(found, fit.frequencies, rtol=0.01)
    requests, wrong, page = [], [], browser.new_page()
    page.on("request", lambda request: requests.append(request.url))
    page.on("pageerror", lambda error: wrong.append(str(error)))
    page.goto(path.as_uri())
    assert page.locator("circle").count() == len(data["orders"])
    command = page.locator("output").text_content()
    assert command.endswith("--choose " + ",".join(f"{one:.6g}" for one in found))
    page.evaluate(f"document.querySelector('[data-pole=\"{data['chosen'][0]}\"]').dispatchEvent("
                  "new MouseEvent('click'))")  # fmt: skip
    left = page.locator("output").text_content()
    assert left.endswith("--choose " + ",".join(f"{one:.6g}" for one in found[1:]))
    other = next(i for i, stable in enumerate(data["stable"]) if not stable)
    page.evaluate(f"document.querySelector('[data-pole=\"{other}\"]').dispatchEvent("
                  "new MouseEvent('click'))")  # fmt: skip
    assert f"{data['frequencies'][other]:.6g}" in page.locator("output").text_content()
    assert page.locator("tbody tr").count() == len(found)
    page.close()
    assert wrong == [] and requests == [path.as_uri()]
    with pytest.raises(FileExistsError):
        fit.to_html(path)
    with pytest.raises(ValueError, match="have no stabilisation diagram; choose --method cov"):
        dataclasses.replace(fit, diagrams=()).to_html(tmp_path / "other.html")
