"""Notebooks open from a fresh clone: what Binder installs, and the links of the published site."""

import json
import tomllib
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import pytest

from docs._ext.copied_pages import with_link
from tests.modules import ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def test_binder_installs_the_package_on_a_python_that_it_supports():
    lines = (ROOT / ".binder" / "requirements.txt").read_text(encoding="utf-8").splitlines()
    assert [line for line in lines if not line.startswith("#")] == ["."]
    version = (ROOT / ".binder" / "runtime.txt").read_text().strip().removeprefix("python-")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert f"Programming Language :: Python :: {version}" in project["classifiers"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_published_notebooks_begin_with_a_link_to_themselves(path: Path):
    text = path.read_text(encoding="utf-8")
    found = json.loads(with_link(text, path.name, "owner/beams"))
    before = json.loads(text)["cells"]
    assert [found["cells"][0], *found["cells"][2:]] == before
    assert before[0]["source"][0].startswith("# ")
    link = urlparse(found["cells"][1]["source"][0].split("](")[1].split(")")[0])
    assert link.hostname == "mybinder.org" and link.path.startswith("/v2/gh/owner/beams/")
    (target,) = parse_qs(link.query)["labpath"]
    assert (ROOT / target).samefile(path)
