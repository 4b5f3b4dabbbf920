"""What is public says what it is, and what it raises."""

import ast
import importlib
import inspect

import pytest

from tests.modules import module_files, parse

FILES = module_files()


def public(nodes, *kinds):
    """The definitions of some kinds among syntax nodes whose names are public."""
    return [n for n in nodes if isinstance(n, kinds) and not n.name.startswith("_")]


def raised(function: ast.FunctionDef) -> set[str]:
    """Names of the exceptions that a function raises itself; '' where only a value is named."""
    calls = [n.exc for n in ast.walk(function) if isinstance(n, ast.Raise) and n.exc is not None]
    names = [ast.unparse(c.func if isinstance(c, ast.Call) else c) for c in calls]
    return {name if name.endswith(("Error", "Exception")) else "" for name in names}


@pytest.mark.parametrize("name", FILES)
def test_modules_functions_and_classes_are_documented(name):
    tree = parse(FILES[name])
    assert not tree.body or ast.get_docstring(tree), f"{name} says nothing about itself"
    for node in public(tree.body, ast.FunctionDef, ast.ClassDef):
        assert ast.get_docstring(node), f"{name}.{node.name} has no docstring"


@pytest.mark.parametrize("name", FILES)
def test_methods_are_documented_where_they_are_introduced(name):
    """A method that fulfils an interface inherits the docstring of the interface."""
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
