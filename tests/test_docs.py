"""Every source that is cited by names and year is in the list of `docs/references.md`."""

import dataclasses
import importlib
import json
import re
import tomllib
import unicodedata
from pathlib import Path
from urllib.parse import parse_qs, urlparse

import numpy as np
import pytest
from PIL import Image

from docs._ext.copied_pages import with_link
from docs.check_prose import WORDS, Text, own_findings, prose, texts
from experiments.benchmarks.__main__ import BENCHMARKS
from jaxbeam.analysis.combinations import combine
from jaxbeam.case.absorbers import Absorber
from jaxbeam.case.actuators.base import AbstractActuator
from jaxbeam.case.beam import Beam, Support
from jaxbeam.case.case import Run
from jaxbeam.case.contact import AbstractContact
from jaxbeam.case.controller import AbstractController, AbstractEstimator
from jaxbeam.case.fields import PACKAGES, import_modules
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.loads.vehicle_parts import VehicleSensor
from jaxbeam.case.loads.vehicles import load_vehicle
from jaxbeam.case.profiles.shapes import AbstractProfile
from jaxbeam.case.sensors import Sensor
from jaxbeam.case.track import Track
from jaxbeam.files.case_file import case_from_dict
from jaxbeam.files.json_schema import tables
from tests.modules import ROOT
from tuning.control.run_set import read_load_cases

NAME = r"(?:(?:de|De|Van|Van der) )*[A-Z][a-z][\w-]+"
# "Peeters and De Roeck 1999", "Neu et al. 2017", "Clarke, Mohtadi and Tuffs, Automatica 23, 1987".
CITATION = re.compile(
    rf"({NAME})(?:, {NAME})*(?:,? and {NAME}| et al\.),?"
    r"(?: \(?|[^.;()|]{0,90}?\b)((?:19|20)\d\d)\b"
)
PLACES = ("jaxbeam", "tuning", "docs/explanation", "docs/howto")


def in_ascii(text: str) -> str:
    """Text in one line without accents; names in docstrings are written so."""
    text = re.sub("[öÖ]h", "oeh", text)  # Doehler
    return " ".join(unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().split())


ENTRIES = [
    in_ascii(entry)
    for entry in re.split(r"\n(?=- )|\n\n", (ROOT / "docs/references.md").read_text("utf-8"))
]


@pytest.mark.parametrize("place", PLACES)
def test_cited_sources_are_listed(place):
    lacking, cited = set(), 0
    for path in sorted((ROOT / place).rglob("*.*")):
        if path.suffix in (".py", ".md", ".toml"):
            for found in CITATION.finditer(in_ascii(path.read_text("utf-8").replace("#", " "))):
                cited += 1
                surname = found[1].split()[-1]
                if not any(surname in entry and found[2] in entry for entry in ENTRIES):
                    lacking.add(f"{path.name}: {found[0]}")
    assert not lacking
    assert cited


def test_every_explanation_names_its_sources():
    """Those about the thesis are about one source."""
    for path in (ROOT / "docs" / "explanation").glob("*.md"):
        if path.stem not in ("index", "thesis"):
            assert "**Sources.**" in path.read_text(encoding="utf-8"), path.name


# Tables of measured or computed numbers on pages are printed by code, none is typed.

# Pages whose tables have numbers in the source, and why.
WRITTEN = {
    "docs/explanation/thesis.md": "written by `experiments.thesis.page`",
}
GENERATED = ("docs/_static/", "docs/reference/api/", "docs/reference/case_file/")
GENERATED = (*GENERATED, "docs/reference/commands.md", "docs/reference/modal_constants.md")
CODE = re.compile(r"^(```+|:::+).*?^\1", re.M | re.S)
MARKED = re.compile(r"<!-- ([\w ]+) -->.*?<!-- end of [\w ]+ -->", re.S)  # written by code
# A cell that is a number, with a unit perhaps; the unit 1 is none.
NUMBER = re.compile(
    r"(?!1$)[<>±-]?\d+(\.\d+)?(e-?\d+)?( ?(%|s|ms|us|µs|MiB|mm|m|Hz|N|times|core hours))?( \(.*\))?"
)
PAGES = [
    page
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if not page.relative_to(ROOT).as_posix().startswith(GENERATED)
]


def number_rows(text: str) -> list[str]:
    """Rows of tables outside code and marks in which a cell is a number."""
    rows = [line for line in MARKED.sub("", CODE.sub("", text)).splitlines() if line[:1] == "|"]
    return [
        row for row in rows if any(NUMBER.fullmatch(cell.strip()) for cell in row.split("|")[2:])
    ]


def test_tables_of_numbers_are_not_typed():
    assert number_rows("| a | 0.05 s |") and not number_rows("```\n| a | 0.05 s |\n```")
    found = {
        page.relative_to(ROOT).as_posix() for page in PAGES if number_rows(page.read_text("utf-8"))
    }
    assert found == set(WRITTEN)


INCLUDED = sorted((ROOT / "docs" / "_static" / "benchmarks").glob("*.md"))


@pytest.mark.parametrize("path", INCLUDED, ids=lambda path: path.stem)
def test_tables_of_benchmarks_are_as_printed(path):
    """They name machine and day, as `--pages` writes them, and a page includes them."""
    text = path.read_text("utf-8")
    assert path.stem in BENCHMARKS
    assert re.match(r"\d+ cores, (load [\d.]+, )?\d{4}-\d\d-\d\d:\n\n", text), text[:80]
    assert any(f"_static/benchmarks/{path.name}" in page.read_text("utf-8") for page in PAGES)


# Thumbnails of the landing page: size, films, high pictures.


def test_a_film_is_shown_by_its_middle_frame_and_a_high_picture_by_its_top(tmp_path):
    pytest.importorskip("sphinx")
    from docs._ext import thumbnails

    frames = [Image.new("RGB", (64, 16), color) for color in ("red", "lime", "blue")]
    frames[0].save(tmp_path / "film.gif", save_all=True, append_images=frames[1:])
    small = thumbnails.thumbnail(tmp_path / "film.gif")
    assert small.size == thumbnails.SIZE
    assert small.getpixel((160, 120)) == (0, 255, 0)
    assert small.getpixel((160, 5)) == (255, 255, 255)  # wide pictures are in the middle
    high = Image.fromarray(np.repeat([[[0] * 3], [[255] * 3]], 50, axis=0).astype(np.uint8))
    high.resize((20, 100)).save(tmp_path / "high.png")
    assert thumbnails.thumbnail(tmp_path / "high.png").getpixel((160, 230)) == (0, 0, 0)


def test_all_pictures_of_the_gallery_have_sections_of_their_own():
    """Twenty, in the order of their numbers."""
    text = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    titles = [line for line in text.splitlines() if line.startswith("## ")]
    assert [title.split(".")[0] for title in titles] == [f"## {n}" for n in range(1, 21)]


# TOML that pages show without running it is read without an error, completed where it is short.

BLOCKS = [
    (f"{toml_page.relative_to(ROOT).as_posix()}-{i}", text)
    for toml_page in sorted((ROOT / "docs").rglob("*.md"))
    for i, text in enumerate(re.findall(r"^```toml\n(.*?)^```", toml_page.read_text(), re.M | re.S))
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
    elif "combinations" in content:
        case = case_from_dict(ABOUT)
        found = combine(case, content["actions"], content["combinations"], [0.5])
        assert np.isfinite(found.highest).all()
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


# Types on the pages of the reference are those of the source.


def test_types_of_properties_are_those_of_the_source():
    pytest.importorskip("sphinx")
    from docs._ext.plain_docstrings import plain_type

    both = ": Float[jaxlib._jax.Array, 'time sensor'] | Float[ndarray, 'time sensor']"
    assert plain_type(both) == ": Float[Array, 'time sensor']"
    number = "Bool[jaxlib._jax.Array, ''] | Bool[ndarray, ''] | generic | None"
    assert plain_type(number) == "Bool[Array, ''] | None"
    assert plain_type("list[str]") == "list[str]"


# Prose of pages, notebooks and docstrings: no words of `docs/words.toml`, none repeated.
#
# `.ci/run` checks it with proselint as well, which is not installed for tests.

LIST = tomllib.loads(WORDS.read_text(encoding="utf-8"))["words"]


def messages(text: str) -> list[str]:
    return [f"{f.line}: {f.message}" for f in own_findings(Text(Path("page.md"), 1, text), LIST)]


def test_pages_notebooks_and_docstrings():
    assert [finding for text in texts() for finding in own_findings(text, LIST)] == []


@pytest.mark.parametrize(
    "text, expected",
    [
        ("A line.\nThe campaign of logs.", ["2: 'campaign': data set"]),
        ("It is is wrong.", ["1: 'is is': a word is repeated"]),
        ("Optimised with scipy.optimize.", []),
        ("We optimize it.", ["1: 'optimize': British spelling: -ise"]),
        ("`campaign`\n\n```toml\ncampaign = 1\n```\n\n[text](campaign.md), $campaign$", []),
        ("# Modes\n\nModes are", []),
    ],
)
def test_findings(text, expected):
    assert messages(text) == expected


def test_what_is_no_prose_keeps_its_lines():
    text = "One.\n\n```python\nx = 1\n```\n\nTwo `code`.\n"
    assert prose(text).count("\n") == text.count("\n")
    assert [len(line.rstrip("·")) for line in prose(text).splitlines()] == [4, 0, 0, 0, 0, 0, 11]


# Notebooks open from a fresh clone: what Binder installs, and the links of the published site.

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


# The names in docs/vocabulary.md exist in case files and in the code.

PARTS = {
    "beam": Beam,
    "supports": Support,
    "absorbers": Absorber,
    "actuators": AbstractActuator,
    "sensors": Sensor,
    "vehicle_sensors": VehicleSensor,
    "loads": AbstractLoad,
    "track": Track,
    "profile": AbstractProfile,
    "contact": AbstractContact,
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
