"""Shapes and types of signatures, checked while testing, at a fraction of jaxtyping's own cost.

The import hook of jaxtyping decorates every function, each time it is defined, also those within
functions that run often, and those without annotations, which leave nothing to check. Its wrapper
binds the arguments first and checks them twice. Here functions without annotations stay as they
are, and the others are checked once by beartype, with names of axes of each call; of functions that
a test calls at each step of its runs, the first calls and then one of each hundred.
"""

import collections
import dataclasses
import functools
import inspect
import typing

import jaxtyping

_decorated = jaxtyping.jaxtyped
_NAMES_OF_A_CALL = _decorated("context")
ALL_CHECKED = 50  # calls of a function by one test, after which one of SOME_CHECKED is
SOME_CHECKED = 100
calls: collections.Counter = collections.Counter()  # of each function; each test begins anew


def checked(*, typechecker):
    """The decorator that the import hook asks for, of functions, properties and dataclasses."""

    def decorate(decorated):
        if inspect.isclass(decorated):
            init = vars(decorated).get("__init__")
            if dataclasses.is_dataclass(decorated) and init and not hasattr(init, "__wrapped__"):
                decorated.__init__ = decorate(init)  # type: ignore[attr-defined]
            return decorated
        if isinstance(decorated, property):
            parts = (decorated.fget, decorated.fset, decorated.fdel)
            return property(*(part and decorate(part) for part in parts))
        if isinstance(decorated, classmethod | staticmethod):
            return type(decorated)(decorate(decorated.__func__))
        annotations = [*getattr(decorated, "__annotations__", {}).values()]
        if not annotations:
            return decorated
        # Generators, sizes computed from arguments, and names of types that are imported later.
        if (
            inspect.isgeneratorfunction(decorated)
            or "{" in str(annotations)
            or any(map(_names_a_type, annotations))
        ):
            return _decorated(decorated, typechecker=typechecker)
        return _with_names(typechecker(decorated), decorated)

    return decorate


def _names_a_type(annotation) -> bool:
    """Whether an annotation is, or has in its brackets, a type by its name."""
    if isinstance(annotation, list | tuple):
        return any(map(_names_a_type, annotation))
    if isinstance(annotation, str | typing.ForwardRef):
        return True
    literal = typing.get_origin(annotation) is typing.Literal
    return not literal and any(map(_names_a_type, typing.get_args(annotation)))


def _with_names(function, original):
    """A checked function, within whose calls an axis has one size."""

    @functools.wraps(original)
    def call(*arguments, **named):
        calls[original] = count = calls[original] + 1
        if count > ALL_CHECKED and count % SOME_CHECKED:
            return original(*arguments, **named)
        with _NAMES_OF_A_CALL:
            return function(*arguments, **named)

    return call


def use() -> None:
    """Let the import hook use `checked`, for the packages that are imported from here on."""
    jaxtyping.jaxtyped = checked  # type: ignore[assignment]
