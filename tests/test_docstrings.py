"""Docstrings: every public module, class, function and method has one, with its exceptions."""

import ast
import doctest
import importlib
import inspect

import pytest

from tests.modules import module_files, parse

FILES = module_files()


def public(nodes, *kinds):
    """Definitions of some kinds among syntax nodes, with public names."""
    return [n for n in nodes if isinstance(n, kinds) and not n.name.startswith("_")]


def raised(function: ast.FunctionDef) -> set[str]:
    """Names of the exceptions that a function raises itself; "" for a variable that is raised."""
    calls = [n.exc for n in ast.walk(function) if isinstance(n, ast.Raise) and n.exc is not None]
    names = [ast.unparse(c.func if isinstance(c, ast.Call) else c) for c in calls]
    return {name if name.endswith(("Error", "Exception")) else "" for name in names}


@pytest.mark.parametrize("name", FILES)
def test_modules_functions_and_classes_are_documented(name):
    tree = parse(FILES[name])
    assert not tree.body or ast.get_docstring(tree), f"{name} has no docstring"
    for node in public(tree.body, ast.FunctionDef, ast.ClassDef):
        overloaded = any(ast.unparse(one) == "overload" for one in node.decorator_list)
        assert overloaded or ast.get_docstring(node), f"{name}.{node.name} has no docstring"


@pytest.mark.parametrize("name", FILES)
def test_methods_are_documented_where_they_are_declared(name):
    """A method that implements an interface inherits its docstring."""
    module = None
    for node in public(parse(FILES[name]).body, ast.ClassDef):
        for method in public(node.body, ast.FunctionDef):
            module = module or importlib.import_module(name.removesuffix(".__init__"))
            attribute = getattr(getattr(module, node.name), method.name)
            assert inspect.getdoc(attribute), f"{name}.{node.name}.{method.name}: no docstring"


@pytest.mark.parametrize("name", FILES)
def test_docstrings_say_what_is_raised(name):
    for function in public(ast.walk(parse(FILES[name])), ast.FunctionDef):
        text = ast.get_docstring(function) or ""
        for error in raised(function):
            assert "aises" in text and error in text, (
                f"the docstring of {name}.{function.name} should say: Raises {error or '...'}"
            )


@pytest.mark.parametrize(
    "name", [name for name, path in FILES.items() if ">>> " in path.read_text(encoding="utf-8")]
)
def test_examples_in_docstrings_print_what_they_show(name):
    results = doctest.testmod(importlib.import_module(name.removesuffix(".__init__")))
    assert results.attempted and not results.failed
