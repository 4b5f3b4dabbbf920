"""Imports: a package imports only those above it in ORDER, and no modules import in a circle."""

import ast
import functools
import graphlib
import itertools
import tomllib
from collections.abc import Iterator, Mapping

from tests.modules import PACKAGES, ROOT, module_files, parse

# A package imports only those in lines above its own. A name stands for all modules within it that
# no longer name here covers. One import may point down: methods of results that are called `plot`
# or `plot_...` forward to `jaxbeam.plot`.
ORDER = """
jaxbeam.runtime  jaxbeam.case.library
jaxbeam.case
jaxbeam.numerics
jaxbeam.model
jaxbeam.simulation.integrator  jaxbeam.control.estimation
jaxbeam.control
jaxbeam.files
jaxbeam.case.library.rigs  jaxbeam.simulation
jaxbeam.simulation.sweeps  jaxbeam.export
jaxbeam.analysis
jaxbeam.plot  jaxbeam.benchmark
jaxbeam  jaxbeam.api
tuning.checkpoint
tuning.logs
tuning.parameters  tuning.modal
tuning.fit
tuning.weighing  tuning.control  tuning.monitoring
tuning
jaxbeam.tuning
experiments.thesis  experiments.demo
experiments.studies
experiments.benchmarks
experiments.validation  experiments
jaxbeam.cli.page
jaxbeam.cli
jaxbeam.__main__
"""


def ranks(order: str) -> dict[str, int]:
    """Line number of each package of an order."""
    return {name: level for level, line in enumerate(order.split("\n")) for name in line.split()}


RANKS = ranks(ORDER)
FILES = module_files()


def package(module: str) -> str:
    """The entry of ORDER that covers a module: the longest that it begins with."""
    if module == "jaxbeam.__init__":
        return "jaxbeam"
    parts = module.split(".")
    names = [".".join(parts[:end]) for end in range(len(parts), 1, -1)]
    entry = next((name for name in names if name in RANKS), None)
    entry = entry or (parts[0] if parts[0] in RANKS and len(parts) <= 2 else None)
    assert entry, f"give the package of {module} a place in ORDER of tests/test_imports.py"
    return entry


def plot_methods(tree: ast.AST) -> Iterator[ast.FunctionDef]:
    """Methods of classes called `plot` or `plot_...`."""
    for owner in ast.walk(tree):
        for node in owner.body if isinstance(owner, ast.ClassDef) else ():
            if isinstance(node, ast.FunctionDef) and node.name.split("_")[0] == "plot":
                yield node


def imported(tree: ast.AST, files: Mapping[str, object]) -> Iterator[tuple[str, int]]:
    """Modules of PACKAGES that a syntax tree imports, anywhere in it, and the line numbers.

    Without those of methods that forward to `jaxbeam.plot`.
    """
    forwarding = {id(node) for method in plot_methods(tree) for node in ast.walk(method)}
    for node in ast.walk(tree):
        if id(node) in forwarding and getattr(node, "module", "") == "jaxbeam.plot":
            continue
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            # `from package import name` may mean the module package.name
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            names = [
                name if name in files or f"{name}.__init__" in files else str(node.module)
                for name in inner
            ]
        else:
            continue
        for name in names:
            if name.split(".")[0] in PACKAGES:
                yield name if name in files else f"{name}.__init__", node.lineno


def violations(imports: Mapping[str, set[str]]) -> list[str]:
    """Sentences on imports of packages that are not above in ORDER."""
    sentences = []
    for module, others in imports.items():
        for other in others:
            here, there = package(module), package(other)
            if here != there and not RANKS[there] < RANKS[here]:
                sentences.append(f"{module} imports {other}, which is not above it in ORDER")
    return sentences


def circle(imports: Mapping[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle; empty without one."""
    try:
        graphlib.TopologicalSorter(imports).prepare()
    except graphlib.CycleError as error:
        return error.args[1]
    return []


@functools.cache
def imports() -> dict[str, set[str]]:
    """Modules that each module imports."""
    return {
        module: {name for name, _ in imported(parse(path), FILES)} - {module}
        for module, path in FILES.items()
    }


def test_packages_import_only_those_above_them():
    assert violations(imports()) == []


def test_no_circles():
    assert circle(imports()) == []


def test_violations_and_circles_are_found():
    assert violations({"jaxbeam.case.beam": {"jaxbeam.model.modes"}})
    assert violations({"jaxbeam.control.lqr": {"jaxbeam.simulation.sweeps.sweep"}})
    assert not violations({"jaxbeam.model.modes": {"jaxbeam.case.beam"}})
    code = "if TYPE_CHECKING:\n    from jaxbeam.model.modes import Modes\n"
    assert {name for name, _ in imported(ast.parse(code), FILES)} == {"jaxbeam.model.modes"}
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"a"}})


def test_only_methods_called_plot_may_forward_to_figures():
    code = "class Result:\n    def {}(self):\n        from {} import plot_record\n"
    for name, package_name, found in (
        ("plot", "jaxbeam.plot", set()),
        ("plot_envelope", "jaxbeam.plot", set()),
        ("draw", "jaxbeam.plot", {"jaxbeam.plot.__init__"}),
        ("plot", "jaxbeam.simulation.sweeps", {"jaxbeam.simulation.sweeps.__init__"}),
    ):
        tree = ast.parse(code.format(name, package_name))
        assert {module for module, _ in imported(tree, FILES)} == found


def test_experiments_are_imported_only_when_a_command_needs_them():
    for module, path in FILES.items():
        if package(module).startswith("experiments"):
            continue
        tree = parse(path)
        eager = [node for node in tree.body if not isinstance(node, ast.FunctionDef)]
        names = itertools.chain.from_iterable(imported(node, FILES) for node in eager)
        imported_experiments = [name for name, _ in names if name.startswith("experiments")]
        assert not imported_experiments, (
            f"{module} imports {imported_experiments} outside a function"
        )


def test_only_the_validation_page_imports_the_tests():
    """Its references are the independent sources of the tests, which the wheel does not have."""
    importing_modules = {
        module
        for module, path in FILES.items()
        for node in ast.walk(parse(path))
        if isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "tests"
    }
    assert importing_modules and all(
        module.startswith("experiments.validation.") for module in importing_modules
    )


def test_shapes_are_checked_in_every_package_but_runtime():
    """`pyproject.toml` names packages and modules; `jaxbeam.runtime` is left out for its speed."""
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    (option,) = [one for one in options["addopts"] if one.startswith("--jaxtyping-packages=")]
    checked = option.partition("=")[2].split(",")
    names = {".".join(module.split(".")[:2]) for module in FILES if module.startswith("jaxbeam.")}
    expected = names - {"jaxbeam.runtime", "jaxbeam.tuning", "jaxbeam.__init__", "jaxbeam.__main__"}
    assert sorted(checked) == sorted([*expected, "tuning", "beartype.beartype"])
