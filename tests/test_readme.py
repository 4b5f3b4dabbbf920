"""Commands, options, modules, files and links in README and docs exist."""

import ast
import contextlib
import importlib.util
import re
import runpy
import shlex

import numpy as np
import pytest

import jaxbeam as jb
from experiments.thesis.reproduction import experiments
from jaxbeam.cli.app import COMMANDS, RENAMED_OPTIONS, app, refuse_former_words
from tests.modules import ROOT

# Not the pages that a build of the site writes among its sources.
WRITTEN = ("docs/reference/api/", "docs/reference/case_file/")
WRITTEN = (*WRITTEN, "docs/reference/commands.md", "docs/reference/modal_constants.md")
PAGES = [
    ROOT / "README.md",
    ROOT / "examples" / "README.md",
    *(
        page
        for page in sorted((ROOT / "docs").rglob("*.md"))
        if not page.relative_to(ROOT).as_posix().startswith(WRITTEN)
    ),
]
TEXT = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in PAGES}


def command_lines(program: str) -> list[str]:
    """Lines of code blocks that call a program, continued lines joined, without comments."""
    found = re.findall(
        r"^(?:```|:::)(\S*)[^\n]*\n(.*?)^(?:```|:::)$", "\n".join(TEXT.values()), re.M | re.S
    )
    blocks = [text for kind, text in found if kind in ("", "console", "{run-command}")]
    blocks = [text for text in blocks if ":fails:" not in text]
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [re.sub(r"\s+#.*", "", line) for line in lines if line.startswith(f"{program} ")]


def spans() -> list[str]:
    """Texts in backticks outside code blocks."""
    prose = re.sub(r"^```.*?^```", "", "\n".join(TEXT.values()), flags=re.M | re.S)
    return re.findall(r"`([^`]+)`", prose)


def options_of_commands() -> set[str]:
    """Options of all commands."""
    names = {one.__name__.replace("_", "-") for group in COMMANDS.values() for one in group}
    commands = [app[name] for name in names]
    commands += [one[part] for one in commands for part in one if not part.startswith("-")]
    arguments = [a for one in commands for a in one.assemble_argument_collection()]
    return {option for argument in arguments for option in argument.names}


@pytest.mark.parametrize("line", command_lines("jaxbeam"))
def test_commands_are_accepted(capsys, line):
    words = shlex.split(line)[1:]
    refuse_former_words(words)
    app.parse_args(words, exit_on_error=False, print_error=False)
    assert capsys.readouterr().err == ""


def captions() -> list[str]:
    """Commands below the pictures of the gallery that are stored with the site."""
    found = re.findall(r"^```console\n(jaxbeam .+?)\n```", TEXT["docs/gallery.md"], re.M | re.S)
    return [" ".join(command.replace("\\\n", " ").split()) for command in found]


@pytest.mark.parametrize("command", captions())
def test_stored_pictures_are_drawn_by_a_command(command):
    """It is accepted, its files are in the repository, its experiment exists."""
    name, *words = shlex.split(command)[1:]
    app.parse_args([name, *words], exit_on_error=False, print_error=False)
    if name == "reproduce":
        assert words[0] in experiments()
    files = [word for word in words if "/" in word]
    assert all(list(ROOT.glob(file)) for file in files)


def test_every_stored_picture_of_the_gallery_has_its_command():
    pictures = re.findall(r"\(?figures/\w+\.(?:png|gif)", TEXT["docs/gallery.md"])
    assert len(pictures) == len(captions()) > 3


def test_options_exist():
    named = {option for span in spans() for option in re.findall(r"(?<![\w-])--[a-z][\w-]*", span)}
    modules = {
        "--quick",
        "--list",
        "--pages",
        "--modes",
        "--keep",
        "--extra",
        "--group",
        "--with",
    }  # of benchmarks and of uv
    assert named - modules <= options_of_commands()


def test_commands_in_sentences_exist():
    named = {span.split()[1] for span in spans() if re.match(r"jaxbeam \w", span)}
    assert named <= {name for name in app if not name.startswith("-")}


def test_modules_exist():
    modules = set(re.findall(r"python -m ([\w.]+)", "\n".join(TEXT.values())))
    assert modules >= {"experiments.benchmarks"}
    for module in modules:
        assert importlib.util.find_spec(module), module


@pytest.mark.parametrize("name", TEXT)
def test_links_lead_to_files(name):
    targets = re.findall(r"\]\((?!http)([^)#\s]+)(?:#[^)]*)?\)", TEXT[name])
    paths = [(ROOT / name).parent.joinpath(target).resolve() for target in targets]
    paths = [path.relative_to(ROOT).as_posix() for path in paths]
    written = (*WRITTEN, "docs/tutorials/notebooks/")
    assert [p for p in paths if not (ROOT / p).exists() and not p.startswith(written)] == []


def test_files_in_sentences_exist():
    paths = [
        span for span in spans() if re.fullmatch(r"(jaxbeam|tuning|experiments|tests)/.*", span)
    ]
    assert [path for path in paths if not (ROOT / path).exists()] == []


def same_words(shown: str, printed: str) -> bool:
    """Whether two lines have the same words, and numbers that agree to two per cent."""

    def agree(a: str, b: str) -> bool:
        try:
            x, y = float(a.rstrip("%")), float(b.rstrip("%"))
        except ValueError:
            return a == b
        return abs(x - y) <= 0.02 * abs(x)

    pairs = list(zip(shown.split(), printed.split(), strict=False))
    return len(shown.split()) == len(printed.split()) and all(agree(*pair) for pair in pairs)


@pytest.mark.parametrize("title", ["Three jobs in Python", "Gradients of your own objective"])
def test_code_prints_what_readme_shows(title, capsys, monkeypatch):
    """Lines are shown in their order; dots stand for those left out."""
    monkeypatch.chdir(ROOT)
    section = TEXT["README.md"].split(f"## {title}")[1]
    code = re.search(r"```python\n(.*?)```", section, re.S)
    shown = re.search(r"```text\n(.*?)```", section, re.S)
    assert code and shown
    exec(code[1], {})
    printed = iter(capsys.readouterr().out.splitlines())
    for line in shown[1].splitlines():
        if line != "...":
            error = "estimated error" in line  # its size varies between machines
            words = line.split("; estimated")[0] if error else line
            assert any(
                same_words(words, one.split("; estimated")[0] if error else one) for one in printed
            ), f"README shows, but the code does not print: {line}"


SPEED_ROWS = {
    "in C": "jaxbeam native",
    "in XLA": "jaxbeam",
    "by numba": "numba, parallel over runs",
    "by diffrax": "diffrax, vmapped",
    "by scipy": "scipy DOP853, scaled",
}


def test_speeds_are_those_that_the_benchmark_printed():
    """README has the seconds of three modes of `docs/_static/benchmarks/sweep.md`."""
    printed = (ROOT / "docs" / "_static" / "benchmarks" / "sweep.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([a-z][^|]*) \| ([0-9.e+]+) \|", printed, re.M)
    first = {name: float(value) for name, value in reversed(rows)}
    found = re.findall(r"([0-9.]+) s\s+((?:in|by) \w+)", TEXT["README.md"])
    shown = {name: float(value) for value, name in found}
    assert shown == {name: first[row] for name, row in SPEED_ROWS.items()}


def texts_of(package: str) -> list[tuple[str, str]]:
    """Names of the files of a package, and texts in them: messages, docstrings, annotations."""
    return [
        (path.relative_to(ROOT).as_posix(), node.value)
        for path in (ROOT / package).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]


def is_there(name: str) -> bool:
    """Whether a dotted name, as jb.ride.weighted_rms, is that of a module or of what it has."""
    first, *parts = name.split(".")
    found = importlib.import_module({"jb": "jaxbeam"}.get(first, first))
    for part in parts:
        if hasattr(found, "__path__") and not hasattr(found, part):
            with contextlib.suppress(ModuleNotFoundError):
                importlib.import_module(f"{found.__name__}.{part}")
        fields = getattr(found, "__dataclass_fields__", ())  # those without a default
        if part in fields or part in getattr(found, "__annotations__", ()):
            return True
        if not hasattr(found, part):
            return False
        found = getattr(found, part)
    return True


@pytest.mark.parametrize("package", ["jaxbeam", "tuning"])
def test_messages_and_docstrings_name_options_and_functions_that_exist(package):
    options = options_of_commands() | {"--help"}
    options |= {former for table in RENAMED_OPTIONS.values() for former in table}
    unknown, count = [], 0
    for file, text in texts_of(package):
        named = re.findall(r"(?<![\w-])--[a-z][a-z0-9-]*", text)
        dotted = re.findall(r"(?<![\w./])(?:jb|jaxbeam|tuning)(?:\.[A-Za-z_]\w*)+", text)
        dotted = [name for name in dotted if not name.endswith((".py", ".exe", ".toml"))]
        count += len(named) + len(dotted)
        unknown += [(file, one) for one in named if one not in options]
        unknown += [(file, one) for one in dotted if not is_there(one)]
    assert count > 100
    assert not unknown


@pytest.mark.parametrize("page", [page for page in TEXT if "CHANGELOG" not in page])
def test_functions_that_pages_name_exist(page):
    """But for those of a picture's address."""
    named = set(re.findall(r"(?<![\w./])(?:jb|jaxbeam|tuning)(?:\.[A-Za-z_]\w*)+", TEXT[page]))
    named = {name for name in named if not name.endswith((".py", ".toml", ".md", ".svg"))}
    assert sorted(name for name in named if not is_there(name)) == []


# Examples: their cases are plausible, and run.py finds what the field would expect.

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
