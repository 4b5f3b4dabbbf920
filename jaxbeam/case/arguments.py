"""Arguments of public functions: each is of the class that its function declares.

Numbers are left to the functions, which know their units and ranges.
"""

import functools
import inspect
import operator
import os
import reprlib
import types
import typing
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from jaxbeam.runtime.printer import counted

F = typing.TypeVar("F", bound=Callable)
OWN_PACKAGES = ("jaxbeam.", "tuning.")
MAKERS = {  # how a newcomer comes by an object of a class
    "Case": "make one of parts by jaxbeam.Case(beam, ...), of a file by jaxbeam.load_case(path)",
    "Layout": "jaxbeam.model.modes.mesh_layout(case) returns one",
    "Log": "tuning.read_log(path) reads one",
    "LoadCases": "make one by tuning.LoadCases(training, held_out) or tuning.full_grid(values)",
    "Fit": "tuning.identify makes one, tuning.load_fit(path) reads one",
    "ModalEstimates": "tuning.identify_modes(log) finds them",
    "Record": "jaxbeam.simulate(case) makes one, jaxbeam.read_record(path) reads one",
    "Objective": "a function of your own, of the values by address, is added to it as `penalty`",
}
SHORT_REPR = reprlib.Repr()  # shortens wrong values, which error messages quote
SHORT_REPR.maxstring, SHORT_REPR.maxlist, SHORT_REPR.maxdict = 80, 10, 10
WORDS = {bool: "True or False", int: "a whole number", str: "a word", type(None): "None"}


def checks_classes(function: F) -> F:
    """Decorator of a public function: its arguments are first compared with what it declares.

    The function raises TypeError for the first argument of another class, in one sentence.
    """

    @functools.wraps(function)
    def checked(*args, **kwargs):
        check_call(function, args, kwargs)
        return function(*args, **kwargs)

    return typing.cast(F, checked)


def check_call(function: Callable, arguments: tuple, keywords: Mapping[str, Any]) -> None:
    """Compare all arguments of a call with the classes that its function declares.

    Raises TypeError for the first of another class; of one too many the function itself says so.
    """
    signature = _signature(function)
    try:
        given = signature.bind(*arguments, **keywords).arguments
    except TypeError:
        return
    for name, value in given.items():
        declared = signature.parameters[name].annotation
        if not fits(value, declared):
            raise TypeError(wrong_class(name, value, declared))


@functools.cache
def _signature(function: Callable) -> inspect.Signature:
    return inspect.signature(function)


def fits(value: Any, declared: Any) -> bool:
    """Whether a value is of a declared class; True for numbers and classes of other packages.

    A list of objects has to be long enough for a tuple of so many, and each of its class.
    """
    origin, parts = typing.get_origin(declared), typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        return any(fits(value, part) for part in parts)
    if origin in (Sequence, tuple, list):
        if parts in ((float,), (float, Ellipsis)):
            return True
        if isinstance(value, str | Mapping | Iterator) or not hasattr(value, "__iter__"):
            return False
        if origin is tuple and Ellipsis not in parts:
            return isinstance(value, Collection) and len(value) == len(parts)
        return all(fits(one, parts[0]) for one in value) if _is_checked(parts[0]) else True
    if origin in (Mapping, dict):
        own = parts[1:] if _is_mapping(parts[-1]) else ()
        return isinstance(value, Mapping) and all(fits(one, *own) for one in value.values() if own)
    if origin is Callable:
        return callable(value)
    if declared is int:
        return _is_whole(value)
    if declared is Mapping:
        return isinstance(value, Mapping)
    if declared is bool:
        return isinstance(value, bool | np.bool_)
    if declared in (str, type(None)) or _is_own(declared):
        return isinstance(value, declared)
    return isinstance(value, str | os.PathLike) if declared is os.PathLike else True


def _is_checked(declared: Any) -> bool:
    return declared is str or _is_own(declared)


def _is_own(declared: Any) -> bool:
    return isinstance(declared, type) and declared.__module__.startswith(OWN_PACKAGES)


def _is_mapping(declared: Any) -> bool:
    return typing.get_origin(declared) in (Mapping, dict) or declared is Mapping


def _is_whole(value: Any) -> bool:
    try:
        operator.index(value)
    except TypeError:
        return False
    return True


def wrong_class(name: str, value: Any, declared: Any) -> str:
    """What an argument takes, what it was given, and how to come by the first class that fits."""
    classes = [part for part in (declared, *typing.get_args(declared)) if _is_own(part)]
    hints = [MAKERS[one.__name__] for one in classes if one.__name__ in MAKERS]
    hint = f"; {hints[0]}" if hints else ""
    if declared in classes:
        return f"a {_name(declared)} is needed, not a {type(value).__name__}{hint}"
    return f"{name} takes {_description(declared)}, not {describe_value(value)}{hint}"


def _name(own: type) -> str:
    return f"{own.__module__.partition('.')[0]}.{own.__name__}"


def _description(declared: Any) -> str:
    """A declared class in words."""
    origin, parts = typing.get_origin(declared), typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(map(_description, parts)))
    if origin is tuple and Ellipsis not in parts:
        return f"a list of {counted(len(parts), 'number')}"
    if origin in (Sequence, tuple, list):
        return f"a list of {_name(parts[0])}" if _is_own(parts[0]) else "a list"
    if origin in (Mapping, dict) and _is_mapping(parts[-1]):
        return "a mapping of mappings, as {'name': {'key': ...}}"
    if origin in (Mapping, dict):
        return "a mapping by names or addresses, as {'beam.length': ...}"
    if origin is Callable:
        return "a function"
    if _is_own(declared):
        return f"a {_name(declared)}"
    return WORDS.get(declared, "a path" if declared is os.PathLike else "a number")


def describe_value(value: Any) -> str:
    """A wrong value as error messages quote it."""
    if isinstance(value, str | bool | int | float | list | dict):
        return SHORT_REPR.repr(value)
    if hasattr(value, "dtype"):
        return f"an array of {value.dtype}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIO' else 'a'} {name}"
