"""Shapes and types of signatures, checked while testing, at a fraction of jaxtyping's own cost.

The import hook of jaxtyping decorates every function, each time it is defined, also those within
functions that run often, and those without annotations, which leave nothing to check. Its wrapper
binds the arguments first and checks them twice. Here functions without annotations stay as they
are, and the others are checked once by beartype, with names of axes of each call.
"""

import dataclasses
import functools
import inspect

import jaxtyping

_decorated = jaxtyping.jaxtyped
_NAMES_OF_A_CALL = _decorated("context")


def checked(*, typechecker):
    """The decorator that the import hook asks for, of functions, properties and dataclasses."""

    def decorate(decorated):
        if inspect.isclass(decorated):
            init = vars(decorated).get("__init__")
            if dataclasses.is_dataclass(decorated) and init and not hasattr(init, "__wrapped__"):
                decorated.__init__ = decorate(init)
            return decorated
        if isinstance(decorated, property):
            parts = (decorated.fget, decorated.fset, decorated.fdel)
            return property(*(part and decorate(part) for part in parts))
        if isinstance(decorated, classmethod | staticmethod):
            return type(decorated)(decorate(decorated.__func__))
        annotations = getattr(decorated, "__annotations__", None)
        if not annotations:
            return decorated
        computed = "{" in str([*annotations.values()])  # a size, from the arguments
        if computed or inspect.isgeneratorfunction(decorated):
            return _decorated(decorated, typechecker=typechecker)
        return _with_names(typechecker(decorated), decorated)

    return decorate


def _with_names(function, original):
    """A checked function, within whose calls an axis has one size."""

    @functools.wraps(original)
    def call(*arguments, **named):
        with _NAMES_OF_A_CALL:
            return function(*arguments, **named)

    return call


def use() -> None:
    """Let the import hook use `checked`, for the packages that are imported from here on."""
    jaxtyping.jaxtyped = checked  # type: ignore[assignment]
