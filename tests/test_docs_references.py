"""Every source that is cited by names and year is in the list of `docs/references.md`."""

import re
import unicodedata

import pytest

from tests.modules import ROOT

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
        if path.stem not in ("index", "thesis", "thesis_changes"):
            assert "**Sources.**" in path.read_text(encoding="utf-8"), path.name
