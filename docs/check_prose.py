"""Check the prose of pages, notebooks and docstrings: `python -m docs.check_prose`.

It has the checks of proselint (clichés, archaisms, malapropisms, redundancy, hedging, wrong
spelling and so on), the words of `docs/words.toml`, each with the word of the field that it stands
for, and words repeated. Code, formulas and tables of numbers are no prose. Prints a line for every
finding, with file and line; the exit status is 1 if there is one.
"""

import ast
import json
import re
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
WORDS = ROOT / "docs" / "words.toml"
PAGES = ("*.md", "docs/**/*.md", "examples/**/*.md")
NOTEBOOKS = "notebooks/*.ipynb"
PACKAGES = ("jaxbeam", "tuning")
GENERATED = (
    "docs/_run",
    "docs/reference/api",
    "docs/reference/commands.md",
    "docs/reference/case_file",
    "docs/tutorials/notebooks",
)
HISTORY = ("CHANGELOG.md",)  # tells of former words
# What proselint finds in text that is right: straight quotes and dots of TOML and of commands,
# roads that are "very good" by ISO 8608, "for every" as if it were "for ever", hyphens after -ly
# as in "poly-reference", and words repeated in upper case or across headings, for which there is
# `REPEATED`.
LEFT_OUT = (
    "typography",
    "annotations",
    "restricted",
    "lexical_illusions",
    "weasel_words.very",
    "misc.phrasal_adjectives",
    "archaism",
)
REPEATED = re.compile(r"\b([A-Za-z]{2,})(?: |\n\s*)\1\b(?![\^(])")
NO_PROSE = re.compile(
    r"^(?P<fence>```+|~~~+).*?^(?P=fence)`*\s*$"  # code and directives
    r"|<!--.*?-->"
    r"|\$\$.*?\$\$|\$[^$\n]+\$"  # formulas
    r"|``.+?``|`[^`]+`"
    r"|(?<=\])\([^)\s]*\)"  # targets of links
    r"|^\s*(?:>>>|\.\.\.) .*?$"  # examples in docstrings
    r"|^:\w[\w-]*:.*?$",  # options of directives
    re.MULTILINE | re.DOTALL,
)


class Text(NamedTuple):
    """Text of one file, or of one docstring or cell in it, from a line on."""

    path: Path
    first_line: int
    text: str


class Finding(NamedTuple):
    """A place in a file and what is wrong there."""

    path: Path
    line: int
    message: str


def texts() -> Iterator[Text]:
    """All prose of the repository: pages, text cells of notebooks, docstrings."""
    for path in sorted({path for pattern in PAGES for path in ROOT.glob(pattern)}):
        if not path.relative_to(ROOT).as_posix().startswith(GENERATED):
            yield Text(path, 1, path.read_text(encoding="utf-8"))
    for path in sorted(ROOT.glob(NOTEBOOKS)):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "markdown":
                yield Text(path, 1, "".join(cell["source"]))
    for path in sorted(path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                doc = ast.get_docstring(node, clean=False)
                if doc is not None:
                    yield Text(path, node.body[0].lineno, doc)


def prose(text: str) -> str:
    """The text with all that is no prose replaced by dots, line by line.

    >>> prose("Set `run.duration` to 2 s.")
    'Set ·············· to 2 s.'
    """
    dotted = NO_PROSE.sub(lambda found: re.sub(r"[^\n]", "·", found.group()), text)
    # Words at the end of a paragraph or cell of a table are not repeated by those of the next one.
    return re.sub(r"\n(?=\s*\n)", "·\n", dotted).replace("|", "·")


def own_findings(text: Text, words: dict[str, str]) -> Iterator[Finding]:
    """Words of `docs/words.toml`, and words repeated."""
    plain = prose(text.text)
    patterns = {rf"(?<![.\w])(?:{word})\b": better for word, better in words.items()}
    if text.path.name in HISTORY:
        patterns = {}
    for pattern, better in {**patterns, REPEATED.pattern: "a word is repeated"}.items():
        for found in re.finditer(pattern, plain):
            line = text.first_line + plain.count("\n", 0, found.start())
            yield Finding(text.path, line, f"{found.group()!r}: {better}")


def proselint_findings(text: Text) -> Iterator[Finding]:
    """Findings of proselint."""
    from proselint.checks import __register__
    from proselint.config import DEFAULT
    from proselint.registry import CheckRegistry
    from proselint.tools import LintFile

    registry = CheckRegistry()
    if not registry.checks:
        registry.register_many(__register__)
    for found in LintFile(str(text.path), prose(text.text)).lint(DEFAULT):
        if not found.check_result.check_path.startswith(LEFT_OUT):
            line = text.first_line + found.pos[0] - 1
            yield Finding(text.path, line, found.check_result.message)


def main() -> int:
    """Print all findings; return 1 if there is one, 0 if not."""
    words = tomllib.loads(WORDS.read_text(encoding="utf-8"))["words"]
    found = [
        finding
        for text in texts()
        for finding in (*own_findings(text, words), *proselint_findings(text))
    ]
    for path, line, message in found:
        print(f"{path.relative_to(ROOT)}:{line}: {message}")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
