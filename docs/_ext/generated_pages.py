"""Pages of the reference, written from the code: public names, case file and commands."""

import dataclasses
import importlib
import inspect
import json
from pathlib import Path

from modal_constants import EXPLAINED, table
from plain_docstrings import as_text

import jaxbeam
import jaxbeam.plot
import tuning
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, ON_BEAM, POSITIVE
from jaxbeam.cli.app import COMMANDS, app as commands
from jaxbeam.files.json_schema import Key, json_schema, table_classes, table_keys, tables
from jaxbeam.runtime.printer import TableViews

# Pages of the public names, by the packages in which they are defined; the first that fits.
GROUPS = {
    "beam": ("Beams, supports, sensors and cases", "jaxbeam.case"),
    "loads": ("Loads and vehicles", "jaxbeam.case.loads"),
    "profiles": ("Profiles of the surface", "jaxbeam.case.profiles", "jaxbeam.files.case_file"),
    "actuators": ("Actuators", "jaxbeam.case.actuators"),
    "control": ("Controllers", "jaxbeam.control"),
    "estimation": ("Estimators", "jaxbeam.control.estimation"),
    "model": ("Modes, statics, state spaces and frequency responses", "jaxbeam.model"),
    "runs": (
        "Files, runs and sweeps",
        "jaxbeam.files",
        "jaxbeam.simulation",
        "jaxbeam.simulation.sweeps",
    ),
    "analysis": ("Analysis of runs", "jaxbeam.analysis"),
    "benchmark": ("The benchmark of controllers", "jaxbeam.benchmark"),
    "applications": ("Parts of applications: jaxbeam.api", "jaxbeam.api"),
    "logs": ("Logs and their modes", "tuning.logs", "tuning.modal"),
    "fits": ("Fits, their uncertainty, and weighing", "tuning"),
    "tuning": ("Tuning of controllers", "tuning.control"),
    "plots": ("Figures", "jaxbeam.plot"),
    "interfaces": ("Interfaces for parts of one's own", "interfaces"),
}
INTERFACES = [
    ("jaxbeam.case.loads.base", "AbstractLoad"),
    ("jaxbeam.case.profiles.shapes", "AbstractProfile"),
    ("jaxbeam.case.actuators.base", "AbstractActuator"),
    ("jaxbeam.case.controller", "AbstractController"),
    ("jaxbeam.case.controller", "AbstractStaticController"),
    ("jaxbeam.case.controller", "AbstractSampledLaw"),
    ("jaxbeam.case.controller", "AbstractContinuousLaw"),
    ("jaxbeam.case.controller", "Measurement"),
    ("jaxbeam.case.controller", "ControlStep"),
    ("jaxbeam.case.controller", "AbstractEstimator"),
    ("jaxbeam.model.modes", "Modes"),
    ("jaxbeam.model.state_space", "StateSpace"),
]
BOUNDS = {
    POSITIVE: "> 0",
    NOT_NEGATIVE: "≥ 0",
    ON_BEAM: "0 to length",
    INCREASING: "increasing",
}


# Arguments that docstrings do not explain again (`tests/test_docstrings.py` has their names).
COMMON_ARGUMENTS = """Some arguments mean the same everywhere: ``case`` is a
:py:obj:`Case <jaxbeam.Case>`, ``record`` a :py:obj:`Record <jaxbeam.Record>`, ``fit`` a
:py:obj:`Fit <tuning.Fit>`, ``path`` the path of a file, ``seed`` the seed of random numbers,
``progress`` whether a bar is shown, and ``layout`` the order of the nodes of a beam, which is
needed inside ``jit`` only. Examples read ``case.toml``, the case of the example of
:py:obj:`tune <tuning.tune>`, and ``fit.npz``, the fit of that of
:py:obj:`identify <tuning.identify>`."""


def group_of(module: str) -> str:
    """Page of a name that is defined in a module: that of the longest package that fits."""
    fitting = {
        (len(package), page)
        for page, (_, *packages) in GROUPS.items()
        for package in packages
        if f"{module}.".startswith(f"{package}.")
    }
    return max(fitting)[1]


def public_names() -> dict[str, list[tuple[str, str]]]:
    """Public names by page, each with the module in which it is documented."""
    pages: dict[str, list[tuple[str, str]]] = {page: [] for page in GROUPS}
    for package in (jaxbeam, tuning, jaxbeam.plot):
        for name in sorted(package.__all__, key=str.lower):
            one = getattr(package, name)
            if one is tuning:  # has its own turn
                continue
            if inspect.ismodule(one):
                inner_names = [inner for inner in one.__all__ if inner not in package.__all__]
                found = [(one.__name__, inner) for inner in inner_names]
                pages[group_of(one.__name__)] += found
            else:
                pages[group_of(one.__module__)].append((package.__name__, name))
    pages["interfaces"] = INTERFACES
    return pages


def api_page(title: str, names: list[tuple[str, str]]) -> str:
    """Page with the documentation of some names, in reStructuredText."""
    lines = [title, "=" * len(title), ""]
    for module, name in names:
        one = getattr(importlib.import_module(module), name)
        directive = "autoclass" if inspect.isclass(one) else "autofunction"
        lines += [f".. {directive}:: {module}.{name}"]
        if inspect.isclass(one):
            lines += ["   :members:", "   :exclude-members: validate"]
            if issubclass(one, TableViews):  # with what their views have: tables, files, figures
                lines += ["   :inherited-members: Module"]
        lines += [""]
    return "\n".join(lines)


def api_index(names: dict[str, list[tuple[str, str]]]) -> str:
    """Page that lists all public names with their first lines."""
    lines = ["Functions and classes", "=====================", ""]
    lines += ["All are in ``import jaxbeam as jb`` or ``import tuning`` unless another module is"]
    lines += ['named. Shapes are in signatures, ``Float[Array, "time sensor"]``; all numbers are']
    lines += ["in SI units.", "", COMMON_ARGUMENTS, "", ".. toctree::", "   :hidden:", ""]
    lines += [f"   {page}" for page in names]
    for page, found in names.items():
        title = GROUPS[page][0]
        lines += ["", f":doc:`{title} <{page}>`", "~" * (len(title) + len(page) + 10), ""]
        lines += [".. list-table::", "   :widths: 30 70", "   :class: names", ""]
        for module, name in found:
            one = getattr(importlib.import_module(module), name)
            first = (inspect.getdoc(one) or "").split("\n\n")[0].replace("\n", " ")
            lines += [f"   * - :py:obj:`{name} <{module}.{name}>`", f"     - {as_text(first)}"]
    return "\n".join(lines) + "\n"


def bounds(key: Key) -> str:
    """Bounds of the value of a key, for a cell of a table."""
    if key.is_count:
        return f"≥ {key.field.metadata['minimum']}"
    if key.words and len(key.words) <= 12:
        return ", ".join(f"`{word}`" for word in key.words)
    return BOUNDS.get(key.constraint, "")


def default(key: Key) -> str:
    """Default of a key, for a cell of a table."""
    if key.default is dataclasses.MISSING:
        return "**required**"
    return "" if key.default in (None, "", ()) or key.part_class else f"`{key.default}`"


def key_table(part_class: type) -> list[str]:
    """Table of the keys of a table of a case file, in Markdown."""
    lines = [
        "{.keys}",
        "| key | meaning | value | unit | default | bounds |",
        "|---|---|---|---|---|---|",
    ]
    for key in table_keys(part_class):
        unit = "" if key.unit in ("", "1") else key.unit
        value = "one number" if key.is_number and key.values == "one number" else key.values
        value = "a word" if key.words else value
        cells = [f"`{key.name}`", key.meaning, value, unit, default(key), bounds(key)]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return lines if len(lines) > 3 else ["It has no keys."]


def prose(part_class: type) -> list[str]:
    """Docstring of a class as Markdown; names are in backticks there, too."""
    text = inspect.cleandoc(part_class.__doc__ or "")
    text = text.split(">>> ")[0]
    return [line.replace("*", r"\*").replace("<", r"\<") for line in text.splitlines()]


def case_page(name: str, part_class: type, listed: bool) -> str:
    """Page of a table of a case file, with all of its kinds."""
    header = f"[[{name}]]" if listed else f"[{name}]"
    lines = [f"# `{header}`", ""]
    classes = table_classes(part_class)
    if "" not in classes:
        lines += [*prose(part_class), ""]
        lines += [
            "`kind` is one of " + ", ".join(f"[`{k}`](#{name}-{k})" for k in classes) + ".",
            "",
        ]
    for kind, each in classes.items():
        if kind:
            lines += [f"({name}-{kind})=", f'## `kind = "{kind}"`', ""]
        lines += [*prose(each), "", *key_table(each), ""]
        lines += inner_tables(each, name, level=3 if kind else 2)
    return "\n".join(lines) + "\n"


def inner_tables(part_class: type, name: str, level: int) -> list[str]:
    """Sections for the tables within a table; those of the same class stand once a page."""
    lines = []
    for key in table_keys(part_class):
        if key.part_class is None:
            continue
        inner = f"{name}.{key.name}"
        lines += ["#" * level + (f" `[[{inner}]]`" if key.listed else f" `[{inner}]`"), ""]
        if issubclass(part_class, key.part_class):
            lines += ["Any other kind of this page.", ""]
            continue
        classes = table_classes(key.part_class)
        if "" not in classes:
            lines += [*prose(key.part_class), ""]
        for kind, each in classes.items():
            lines += [f'**`kind = "{kind}"`**', ""] if kind else []
            lines += [*prose(each), "", *key_table(each), ""]
    return lines


def case_index() -> str:
    """Page that lists the tables of a case file."""
    lines = ["# Case file", ""]
    lines += ["A case is a TOML file. Every key is checked; an unknown one is an error that names"]
    lines += ['the nearest known key. Numbers are in SI units, or texts with a unit, `"25 m"`,']
    lines += ['`"30 GN m^2"`. The tables below are printed from the declarations in the code, as']
    lines += ["is the JSON Schema with which editors complete and check case files: write it with"]
    lines += ["`jaxbeam schema`, or [download it](case.schema.json){.external}, and begin the file"]
    lines += ["with the line `#:schema case.schema.json`.", ""]
    lines += ["| table | kinds |", "|---|---|", "| `title` | a text |"]
    for name, (part_class, listed) in tables().items():
        kinds = ", ".join(f"`{kind}`" for kind in table_classes(part_class) if kind)
        header = f"[[{name}]]" if listed else f"[{name}]"
        lines += [f"| [`{header}`]({name}.md) | {kinds} |"]
    lines += ["", "```{toctree}", ":hidden:", "", *tables(), "```"]
    return "\n".join(lines) + "\n"


def command_page() -> str:
    """Page of all commands, from the parser of the command line."""
    lines = ["# Commands", ""]
    lines += ["Printed from the parser of the command line; `jaxbeam COMMAND --help` prints the"]
    lines += ["same. `ADDRESS` is the dotted path of an entry of a case, such as `loads.0.speed`."]
    for title, group in COMMANDS.items():
        lines += ["", f"## {title}", ""]
        for function in group:
            name = function.__name__.replace("_", "-")
            lines += command(name)
            for part in commands[name]:
                if not part.startswith("-"):
                    lines += command(f"{name} {part}")
    return "\n".join(lines) + "\n"


def command(name: str) -> list[str]:
    """Section of one command."""
    one = commands
    for word in name.split():
        one = one[word]
    arguments = [a for a in one.assemble_argument_collection() if a.parameter.show is not False]
    arguments = [a for a in arguments if a.names and not a.names[0].startswith("*")]
    summary, _, more = (one.help or "").partition("Parameters\n")
    documented = parameter_help(more)
    positional = [a for a in arguments if not a.names[0].startswith("-")]
    usage = " ".join(["jaxbeam", name, *(a.names[0] for a in positional), "[OPTIONS]"])
    lines = [f"### `{name}`", "", *inspect.cleandoc(summary).splitlines(), ""]
    lines += ["```text", usage, "```", "", "| argument | meaning |", "|---|---|"]
    for argument in arguments:
        names = [n for n in argument.names if not n.startswith(("--no-", "--empty-"))]
        attribute = argument.field_info.name
        text = argument.parameter.help or documented.get(attribute, "")
        text = " ".join(text.split()).replace("|", "\\|").replace("*", r"\*").replace("<", r"\<")
        default = argument.field_info.default
        said = isinstance(default, bool) or "if left out" in text
        if isinstance(default, int | float | str) and default and not said:
            text += f" Default: {default}."
        lines.append(f"| {', '.join(f'`{n}`' for n in names)} | {text} |")
    return [*lines, ""]


def parameter_help(text: str) -> dict[str, str]:
    """Meaning of each parameter in the section of a docstring."""
    found: dict[str, str] = {}
    name = ""
    lines = inspect.cleandoc(text).splitlines()
    for line in lines:
        if line.strip().startswith("---"):
            continue
        if line and not line.startswith(" "):
            name = line.split(":")[0].strip()
        elif name:
            found[name] = f"{found.get(name, '')} {line.strip()}"
    return found


def constants_page() -> str:
    """Numbers of modal identification."""
    return f"# Constants of modal identification\n\n{EXPLAINED}\n\n{table()}\n"


def write(path: Path, text: str) -> None:
    """Write a page unless it has this text already, so that Sphinx reads only what changed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def _generate(app):
    """Write all pages."""
    reference = Path(app.srcdir) / "reference"
    names = public_names()
    write(reference / "api" / "index.rst", api_index(names))
    for page, found in names.items():
        write(reference / "api" / f"{page}.rst", api_page(GROUPS[page][0], found))
    write(reference / "case_file" / "index.md", case_index())
    for name, (part_class, listed) in tables().items():
        write(reference / "case_file" / f"{name}.md", case_page(name, part_class, listed))
    write(reference / "commands.md", command_page())
    write(reference / "modal_constants.md", constants_page())
    schema = json.dumps(json_schema(), indent=1) + "\n"
    write(reference / "case_file" / "case.schema.json", schema)


def setup(app):
    """Connect to the start of the build."""
    app.connect("builder-inited", _generate)
    return {"parallel_read_safe": True}
