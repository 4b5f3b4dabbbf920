"""Interactive figures of records: pages in one file, without a request to anywhere."""

import json
import re

import numpy as np
import pytest

import jaxbeam as jb

CASE = jb.Case(
    jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, modes=1),
    sensors=[jb.Sensor(0.3, name="mid</script>"), jb.Sensor(0.2), jb.Sensor(0.3, "velocity")],
    loads=[jb.MovingForce(force=1.0, speed=2.0)],
    run=jb.Run(0.3),
    title="a < b",
)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "run.html"
    record = jb.simulate(CASE)
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
