"""Commands, options, modules, files and links in README and docs exist."""

import importlib.util
import re
import shlex

import pytest

from jaxbeam.cli.app import COMMANDS, app, current_words
from tests.modules import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXT = {page.name: page.read_text(encoding="utf-8") for page in PAGES}


def command_lines(program: str) -> list[str]:
    """Lines of code blocks that call a program, continued lines joined, without comments."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", "\n".join(TEXT.values()), re.M | re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [re.sub(r"\s+#.*", "", line) for line in lines if line.startswith(f"{program} ")]


def spans() -> list[str]:
    """Texts in backticks outside code blocks."""
    prose = re.sub(r"^```.*?^```", "", "\n".join(TEXT.values()), flags=re.M | re.S)
    return re.findall(r"`([^`]+)`", prose)


def options_of_commands() -> set[str]:
    """Options of all commands."""
    names = {one.__name__.replace("_", "-") for group in COMMANDS.values() for one in group}
    arguments = [a for name in names for a in app[name].assemble_argument_collection()]
    return {option for argument in arguments for option in argument.names}


@pytest.mark.parametrize("line", command_lines("jaxbeam"))
def test_commands_are_accepted(capsys, line):
    words = shlex.split(line)[1:]
    app.parse_args(list(current_words(words)), exit_on_error=False, print_error=False)
    assert capsys.readouterr().err == "", "no old words"


def test_options_exist():
    named = {option for span in spans() for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", span)}
    modules = {"--quick", "--modes", "--keep", "--extra"}  # of benchmarks and of uv
    assert named - modules <= options_of_commands()


def test_commands_in_sentences_exist():
    named = {span.split()[1] for span in spans() if re.match(r"jaxbeam \w", span)}
    assert named <= {name for name in app if not name.startswith("-")}


def test_modules_exist():
    modules = set(re.findall(r"python -m ([\w.]+)", "\n".join(TEXT.values())))
    assert modules >= {"experiments.benchmarks"}
    for module in modules:
        assert importlib.util.find_spec(module), module


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files(page):
    targets = re.findall(r"\]\((?!http)([^)#]+)\)", TEXT[page.name])
    assert [target for target in targets if not (page.parent / target).exists()] == []


def test_files_in_sentences_exist():
    paths = [
        span for span in spans() if re.fullmatch(r"(jaxbeam|tuning|experiments|tests)/.*", span)
    ]
    assert [path for path in paths if not (ROOT / path).exists()] == []
