"""Field declarations shared by all data classes of a case, and the kinds of a family."""

import dataclasses
import functools
import importlib
import importlib.util
import pkgutil
import re
import typing
from collections.abc import Callable, Iterator
from importlib.abc import InspectLoader

import equinox as eqx
import jax
import jax.extend
import numpy as np

from jaxbeam.case.reading.units import in_si
from jaxbeam.runtime.arrays import any_traced, not_differentiated, xp

F = typing.TypeVar("F", bound=Callable)


def _as_array(unit: str, meaning: str):
    """Converter of a number to a float array; tracers and placeholders of JAX stay as they are.

    Quantities with units, as "25 m", become numbers in the SI unit.
    """

    def convert(value):
        if isinstance(value, str | list | tuple) and _has_text(value):
            value = in_si(value, unit, meaning)
        if isinstance(value, int | float | np.ndarray | np.generic | list | tuple):
            return xp.asarray(value, float)
        return value

    return convert


def _has_text(value) -> bool:
    return isinstance(value, str) or any(isinstance(entry, str | list) for entry in value)


# Constraints of numbers, phrased to follow "must" in error messages; see `declared_checks`.
POSITIVE = "be positive"
NOT_NEGATIVE = "not be negative"
ON_BEAM = "lie on the beam"
INCREASING = "increase"
PROBABILITY = "lie from 0 to below 1"


def number(unit: str, meaning: str, constraint: str = "", **options):
    """Field for a number of a case: a differentiable leaf with its SI unit and its meaning.

    With `default=None` the number may be left out; its absence is part of the tree's structure. A
    text with a unit, as "25 m", is converted to the SI unit. `constraint` is one of the above;
    without one any finite value is allowed.
    """
    converter = _as_array(unit, meaning)
    metadata = {"unit": unit, "meaning": meaning, "constraint": constraint}
    return eqx.field(converter=converter, metadata=metadata, **options)


def choice(meaning: str, *allowed: str, **options):
    """Field for a word of a case, one of `allowed`; any word if none is named."""
    metadata = {"meaning": meaning, "allowed": allowed}
    return eqx.field(static=True, metadata=metadata, **options)


def count(meaning: str, minimum: int = 1, **options):
    """Field for a whole number of a case, `minimum` or more; static, as shapes may depend on it."""
    return eqx.field(static=True, metadata={"meaning": meaning, "minimum": minimum}, **options)


def part(meaning: str, part_class: type, **options):
    """Field for a part within a part of a case, a table of its own that may be left out.

    `part_class` is its class; or an abstract class, of which the table's `kind` names a subclass.
    """
    return eqx.field(metadata={"meaning": meaning, "part": part_class}, default=None, **options)


def parts(meaning: str, part_class: type, **options):
    """Field for any number of parts of one class, each a table of a list; () if left out."""
    metadata = {"meaning": meaning, "parts": part_class}
    return eqx.field(converter=tuple, metadata=metadata, default=(), **options)


def axis_names(field) -> str:
    """Axes in the annotation of a number: "" for one number, "2", "point", "*modes"."""
    return next(iter(typing.get_args(field.type)), field.type).dim_str


@functools.cache
def fits_shape(field, shape: tuple[int, ...]) -> bool:
    """Whether the declaration of a number allows a shape."""
    axes = axis_names(field).split()
    if axes and axes[0].startswith("*"):
        return len(shape) <= 1
    sizes = zip(axes, shape, strict=False)
    return len(axes) == len(shape) and all(not a.isdigit() or int(a) == n for a, n in sizes)


def describe_shape(field) -> str:
    """Shape that the declaration of a number asks for, as a phrase for error messages."""
    axes = axis_names(field).split()
    if not axes:
        return "one number"
    if axes[0].startswith("*"):
        return "one number or a list of numbers"
    if len(axes) == 2:
        return "a list of lists of numbers, all equally long"
    return f"a list of {axes[0]} numbers" if axes[0].isdigit() else "a list of numbers"


def is_concrete(value) -> bool:
    """Whether a value has numbers: it is not traced by `jit` or `vmap`."""
    if not isinstance(value, jax.core.Tracer):
        return True
    try:
        np.asarray(concrete(value))
    except jax.errors.ConcretizationTypeError:
        return False
    return True


def all_concrete(tree) -> bool:
    """Whether all numbers of a tree are concrete, not traced by `jit` or `vmap`."""
    return all(map(is_concrete, jax.tree.leaves(tree)))


def deciding(value, what: str):
    """A number by which a law decides at samples; its derivatives raise an error.

    They would be zero, except for jumps where a sample comes to be decided otherwise.
    """
    reason = (
        f"{what} decides at samples, so that commands jump with it and it has no derivative:"
        " compare several values"
    )
    return not_differentiated(value, reason)


class TracedNumberError(jax.errors.ConcretizationTypeError):
    """Error of a number that must be concrete but is traced by a transformation."""

    def __init__(self, what: str, why: str):
        sentence = (
            f"{what} is traced by jax.jit, vmap or another transformation and must be a concrete"
            f" number: {why}"
        )
        TypeError.__init__(self, sentence)


OUTSIDE = "call it outside jit, vmap and grad"


def refuse_traced(what: str, instead: str, *trees) -> None:
    """Raises ValueError if numbers of some trees are traced by JAX.

    The sentence says that `what` can be neither differentiated nor compiled, as it computes with
    NumPy, and what to do `instead`. Data classes that are no trees are searched, too.
    """
    if any_traced(trees) or any(map(_holds_traced, jax.tree.leaves(trees))):
        raise ValueError(f"{what} can be neither differentiated nor compiled: {instead}")


def _holds_traced(leaf) -> bool:
    if not dataclasses.is_dataclass(leaf) or isinstance(leaf, type):
        return False
    leaves = jax.tree.leaves(dict(vars(leaf)))
    return any_traced(leaves) or any(map(_holds_traced, leaves))


def refuses_traced(what: str, instead: str = OUTSIDE) -> Callable[[F], F]:
    """Decorator that refuses traced arguments; its error names `what` the function returns."""

    def decorated(function: F) -> F:
        @functools.wraps(function)
        def refusing(*args, **kwargs):
            refuse_traced(what, instead, args, kwargs)
            return function(*args, **kwargs)

        return typing.cast(F, refusing)

    return decorated


def concrete(
    value, what: str = "a number of the case", why: str = "shapes, checks or steps depend on it"
) -> np.ndarray:
    """A value as an array of floats, also while it is differentiated (`grad`, `jvp`).

    Raises TracedNumberError if it is traced by `jit` or `vmap`; the error names `what` it is, and
    `why` it must be concrete.
    """
    if isinstance(value, jax.core.Tracer):
        try:
            value = jax.extend.core.concrete_or_error(None, value)
        except jax.errors.ConcretizationTypeError:
            raise TracedNumberError(what, why) from None
    return np.asarray(value, float)


PACKAGES = ("jaxbeam.case", "jaxbeam.control", "jaxbeam.estimation")  # with parts of cases
_DECLARATION = re.compile(r'^    kind: ClassVar\[str\] = "(.+)"', re.MULTILINE)


def module_names(package_name: str) -> Iterator[str]:
    """Names of all modules of a package and of the packages in it, which are imported."""
    package = importlib.import_module(package_name)
    for module in pkgutil.walk_packages(package.__path__, f"{package_name}."):
        yield module.name


def import_modules(package_name: str) -> None:
    """Import all modules of a package and of the packages in it."""
    for name in module_names(package_name):
        importlib.import_module(name)


@functools.cache
def _modules_by_kind() -> dict[str, list[str]]:
    """Modules of PACKAGES by the kinds that their sources declare.

    A module without a source is imported, so that its classes exist.
    """
    modules: dict[str, list[str]] = {}
    for name in (name for package in PACKAGES for name in module_names(package)):
        spec = importlib.util.find_spec(name)
        loader = spec and spec.loader
        source = loader.get_source(name) if isinstance(loader, InspectLoader) else None
        if source is None:
            importlib.import_module(name)
        for kind in _DECLARATION.findall(source or ""):
            modules.setdefault(kind, []).append(name)
    return modules


def kind_of(part_class: type) -> str | None:
    """The `kind` that a class itself declares, or None; a kind is not inherited."""
    kind = vars(part_class).get("kind")
    return kind if isinstance(kind, str) else None


def find_kind(family: type, kind: str) -> type | None:
    """The class of a kind below an abstract class, or None; raises as `kinds`."""
    for name in _modules_by_kind().get(kind, ()):
        importlib.import_module(name)
    return _imported_kinds(family).get(kind)


def kinds(family: type) -> dict[str, type]:
    """Classes below an abstract class by their kinds, in alphabetical order.

    A class defined again, as in a notebook, takes the place of the former one. Raises TypeError if
    two classes declare the same kind.
    """
    for package in PACKAGES:
        import_modules(package)
    return _imported_kinds(family)


def _imported_kinds(family: type) -> dict[str, type]:
    classes: dict[str, type] = {}
    for part_class in _subclasses(family):
        kind = kind_of(part_class)
        if kind is None:
            continue
        other = classes.get(kind, part_class)
        if _full_name(other) != _full_name(part_class):
            raise TypeError(
                f"the kind {kind!r} is declared by both {_full_name(other)} and"
                f" {_full_name(part_class)}: give one of them another kind"
            )
        classes[kind] = part_class
    return dict(sorted(classes.items()))


def _subclasses(part_class: type) -> list[type]:
    """All subclasses in order of their definition, level by level."""
    direct = part_class.__subclasses__()
    return direct + [deeper for each in direct for deeper in _subclasses(each)]


def _full_name(part_class: type) -> str:
    return f"{part_class.__module__}.{part_class.__qualname__}"
