"""Docstrings: all that is public has one, with arguments, exceptions and examples that run."""

import ast
import doctest
import importlib
import inspect
import re
import shutil
from collections.abc import Iterator

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


def undocumented(name: str) -> Iterator[str]:
    """Sentences on what is public in a module and has no docstring, or one that lacks an exception.

    A method may inherit its docstring.
    """
    tree, module = parse(FILES[name]), None
    if tree.body and not ast.get_docstring(tree):
        yield f"{name} has no docstring"
    for node in public(tree.body, ast.FunctionDef, ast.ClassDef):
        overloaded = any(ast.unparse(one) == "overload" for one in node.decorator_list)
        if not overloaded and not ast.get_docstring(node):
            yield f"{name}.{node.name} has no docstring"
    for node in public(tree.body, ast.ClassDef):
        for method in public(node.body, ast.FunctionDef):
            module = module or importlib.import_module(name.removesuffix(".__init__"))
            if not inspect.getdoc(getattr(getattr(module, node.name), method.name)):
                yield f"{name}.{node.name}.{method.name} has no docstring"
    for function in public(ast.walk(tree), ast.FunctionDef):
        text = ast.get_docstring(function) or ""
        for error in raised(function):
            if "aises" not in text or error not in text:
                yield f"the docstring of {name}.{function.name} should say: Raises {error or '...'}"


def test_what_is_public_is_documented_with_what_it_raises():
    assert [sentence for name in FILES for sentence in undocumented(name)] == []


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_examples_in_docstrings_print_what_they_show(name, tmp_path, monkeypatch):
    """In a folder with the case and the fit that examples read."""
    shutil.copytree(ROOT / "tests" / "data" / "examples", tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    results = doctest.testmod(importlib.import_module(name.removesuffix(".__init__")))
    assert results.attempted and not results.failed


# What these arguments are is the same everywhere; the site says it once, above all functions.
COMMON_ARGUMENTS = {"case", "path", "record", "fit", "progress", "seed", "layout"}
PUBLIC = {
    f"{package.__name__}.{name}": getattr(package, name)
    for package in (jaxbeam, tuning)
    for name in package.__all__
}
PUBLIC |= {
    f"{name}.{inner}": getattr(module, inner)
    for name, module in PUBLIC.items()
    if inspect.ismodule(module)
    for inner in module.__all__
}
PUBLIC_FUNCTIONS = {
    name: inspect.unwrap(one)
    for name, one in PUBLIC.items()
    if callable(one) and not inspect.isclass(one)
}
PUBLIC_CLASSES = {name: one for name, one in PUBLIC.items() if inspect.isclass(one)}


def words_of(docstring: str) -> set[str]:
    """Words of a docstring, and of those of the public functions that it refers to in backticks."""
    words = set(re.findall(r"\w+", docstring))
    for name in re.findall(r"`(?:\w+\.)*(\w+)`", docstring):
        found = (one for key, one in PUBLIC_FUNCTIONS.items() if key.endswith(f".{name}"))
        other = next(found, None)
        words |= set(re.findall(r"\w+", inspect.getdoc(other) or "")) if other else set()
    return words


def test_public_functions_document_every_argument():
    """By its name, also in the plural, in the docstring or one that it refers to."""
    missing = {}
    for name, function in PUBLIC_FUNCTIONS.items():
        words = words_of(inspect.getdoc(function) or "")
        arguments = set(inspect.signature(function).parameters) - COMMON_ARGUMENTS
        missing[name] = {a for a in arguments if not {a, f"{a}s", a.removesuffix("s")} & words}
    assert {name: arguments for name, arguments in missing.items() if arguments} == {}


def test_public_functions_have_types_of_arguments_and_results():
    signatures = {name: inspect.signature(one) for name, one in PUBLIC_FUNCTIONS.items()}
    empty = inspect.Signature.empty
    assert [name for name, one in signatures.items() if one.return_annotation is empty] == []


def test_what_is_public_has_an_example():
    """`test_examples_in_docstrings_print_what_they_show` runs it."""
    docstrings = {name: inspect.getdoc(function) for name, function in PUBLIC_FUNCTIONS.items()}
    docstrings |= {name: one.__doc__ for name, one in PUBLIC_CLASSES.items()}
    assert [name for name, text in docstrings.items() if ">>> " not in (text or "")] == []
