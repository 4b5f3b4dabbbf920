"""Docstrings: all that is public has one, with arguments, exceptions and examples that run."""

import ast
import doctest
import importlib
import inspect
import re
import shutil

import pytest

import jaxbeam
import tuning
from tests.modules import ROOT, module_files, parse

FILES = module_files()
EXAMPLES = {name for name, path in FILES.items() if ">>> " in path.read_text(encoding="utf-8")}


def public(nodes, *kinds):
    """Definitions of some kinds among syntax nodes, with public names."""
    return [n for n in nodes if isinstance(n, kinds) and not n.name.startswith("_")]


def raised(function: ast.FunctionDef) -> set[str]:
    """Names of the exceptions that a function raises itself; "" for a variable that is raised."""
    calls = [n.exc for n in ast.walk(function) if isinstance(n, ast.Raise) and n.exc is not None]
    names = [ast.unparse(c.func if isinstance(c, ast.Call) else c) for c in calls]
    return {name if name.endswith(("Error", "Exception")) else "" for name in names}


@pytest.mark.parametrize("name", FILES)
def test_what_is_public_is_documented_with_what_it_raises(name):
    """Modules, functions, classes and methods; a method may inherit its docstring."""
    tree, module = parse(FILES[name]), None
    assert not tree.body or ast.get_docstring(tree), f"{name} has no docstring"
    for node in public(tree.body, ast.FunctionDef, ast.ClassDef):
        overloaded = any(ast.unparse(one) == "overload" for one in node.decorator_list)
        assert overloaded or ast.get_docstring(node), f"{name}.{node.name} has no docstring"
    for node in public(tree.body, ast.ClassDef):
        for method in public(node.body, ast.FunctionDef):
            module = module or importlib.import_module(name.removesuffix(".__init__"))
            attribute = getattr(getattr(module, node.name), method.name)
            assert inspect.getdoc(attribute), f"{name}.{node.name}.{method.name}: no docstring"
    for function in public(ast.walk(tree), ast.FunctionDef):
        text = ast.get_docstring(function) or ""
        for error in raised(function):
            assert "aises" in text and error in text, (
                f"the docstring of {name}.{function.name} should say: Raises {error or '...'}"
            )


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_examples_in_docstrings_print_what_they_show(name, tmp_path, monkeypatch):
    """In a folder with the fit that examples read."""
    shutil.copy(ROOT / "tests" / "data" / "release_0_2_0" / "fit.npz", tmp_path)
    monkeypatch.chdir(tmp_path)
    results = doctest.testmod(importlib.import_module(name.removesuffix(".__init__")))
    assert results.attempted and not results.failed


# What these arguments are is the same everywhere; the site says it once, above all functions.
COMMON_ARGUMENTS = {"case", "path", "record", "fit", "progress", "seed", "layout"}
PUBLIC_FUNCTIONS = {
    f"{package.__name__}.{name}": inspect.unwrap(getattr(package, name))
    for package in (jaxbeam, tuning)
    for name in package.__all__
    if callable(getattr(package, name)) and not inspect.isclass(getattr(package, name))
}
PUBLIC_CLASSES = {
    f"{package.__name__}.{name}": getattr(package, name)
    for package in (jaxbeam, tuning)
    for name in package.__all__
    if inspect.isclass(getattr(package, name))
}


def words_of(docstring: str) -> set[str]:
    """Words of a docstring, and of those of the public functions that it refers to in backticks."""
    words = set(re.findall(r"\w+", docstring))
    for name in re.findall(r"`(?:\w+\.)*(\w+)`", docstring):
        other = PUBLIC_FUNCTIONS.get(f"jaxbeam.{name}") or PUBLIC_FUNCTIONS.get(f"tuning.{name}")
        words |= set(re.findall(r"\w+", inspect.getdoc(other) or "")) if other else set()
    return words


@pytest.mark.parametrize("name", PUBLIC_FUNCTIONS)
def test_public_functions_document_every_argument(name):
    """By its name, also in the plural, in the docstring or one that it refers to."""
    function = PUBLIC_FUNCTIONS[name]
    words = words_of(inspect.getdoc(function) or "")
    arguments = set(inspect.signature(function).parameters) - COMMON_ARGUMENTS
    missing = {a for a in arguments if not {a, f"{a}s", a.removesuffix("s")} & words}
    assert missing == set()


@pytest.mark.parametrize("name", PUBLIC_FUNCTIONS)
def test_public_functions_have_types_of_arguments_and_results(name):
    signature = inspect.signature(PUBLIC_FUNCTIONS[name])
    assert signature.return_annotation is not inspect.Signature.empty


@pytest.mark.parametrize("name", sorted(PUBLIC_FUNCTIONS))
def test_public_functions_have_an_example(name):
    """`test_examples_in_docstrings_print_what_they_show` runs it."""
    assert ">>> " in (inspect.getdoc(PUBLIC_FUNCTIONS[name]) or "")


@pytest.mark.parametrize("name", sorted(PUBLIC_CLASSES))
def test_public_classes_have_an_example(name):
    assert ">>> " in (PUBLIC_CLASSES[name].__doc__ or "")
