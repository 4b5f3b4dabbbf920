"""Fields of the parts of a case: their declarations, the kinds of a family, and checks by them.

Checks are of type, shape, unit and range of each field. Numbers traced by `jit` or `vmap` are
skipped. Rules that concern several fields of a part are in its method `validate(address)`; those
that several parts share are here.
"""

import dataclasses
import difflib
import functools
import importlib
import importlib.util
import inspect
import pkgutil
import re
import typing
from collections.abc import Callable, Iterable, Iterator
from importlib.abc import InspectLoader
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.extend
import numpy as np
from jaxtyping import Float

from jaxbeam.case.arguments import check_call, describe_value
from jaxbeam.case.former_words import KINDS, WORDS
from jaxbeam.case.toml_file import check_count, check_entries, check_length, in_si
from jaxbeam.runtime.arrays import Array, any_traced, not_differentiated, xp

F = typing.TypeVar("F", bound=Callable)


def _as_array(unit: str, meaning: str):
    """Converter of a number to a float array; tracers and placeholders of JAX stay as they are.

    Quantities with units, as "25 m", become numbers in the SI unit.
    """

    def convert(value):
        """The number. Raises ValueError for rows that are not equally long."""
        if isinstance(value, str | list | tuple) and _has_text(value):
            value = in_si(value, unit, meaning)
        listed = isinstance(value, int | float | np.ndarray | np.generic | list | tuple)
        if not listed or not is_real(value):
            return value
        try:
            return xp.asarray(value, float)
        except ValueError:
            raise ValueError(
                f"{meaning}: give numbers in rows that are equally long, not"
                f" {describe_value(value)}"
            ) from None

    return convert


def is_real(value: Any) -> bool:
    """Whether a value, or each entry of a list, can be real: no text, complex number or object."""
    if isinstance(value, list | tuple):
        return all(map(is_real, value))
    if hasattr(value, "dtype"):
        return np.dtype(value.dtype).kind in "biuf"
    return isinstance(value, int | float)


def real_numbers(name: str, value: Any, unit: str, what: str = "numbers") -> Any:
    """A number, or nested lists of them, as a float array; texts as "25 m" are converted.

    `what` says what the argument called `name` holds, in a SI `unit`. Raises ValueError for text
    without a unit, complex numbers, and whatever else is no number.
    """
    converted = in_si(value, unit, name)
    try:
        return xp.asarray(np.nan if converted is None else converted, float)
    except (TypeError, ValueError):
        pass
    in_units = "" if unit in ("", "1") else f" in {unit}"
    raise ValueError(f"{name} takes {what}{in_units}, not {describe_value(value)}")


def _has_text(value) -> bool:
    return isinstance(value, str) or any(isinstance(entry, str | list) for entry in value)


# Constraints of numbers, phrased to follow "must" in error messages.
POSITIVE = "be positive"
NOT_NEGATIVE = "not be negative"
ON_BEAM = "lie on the beam"
INCREASING = "increase"
PROBABILITY = "lie from 0 to below 1"

OF_QUANTITY = "unit of quantity"  # unit of the entries of a sensor that are in that of its quantity


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
            f" number: {why}; keep it out of the transformation"
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
    """Decorator that refuses arguments that are traced, or of other classes than declared.

    Its errors are a ValueError that names `what` the function returns, and a TypeError.
    """

    def decorated(function: F) -> F:
        @functools.wraps(function)
        def refusing(*args, **kwargs):
            check_call(function, args, kwargs)
            refuse_traced(what, instead, args, kwargs)
            return function(*args, **kwargs)

        return typing.cast(F, refusing)

    return decorated


def concrete(
    value, what: str = "a number of the case", why: str = "shapes, checks or steps depend on it"
) -> np.ndarray:
    """A value as an array of floats, also while it is differentiated (`grad`, `jvp`).

    Raises TracedNumberError if it is traced by `jit` or `vmap`; the error names `what` it is, and
    `why` it must be concrete. Raises ValueError for complex numbers, texts and other objects.
    """
    if not is_real(value):
        raise ValueError(f"{what} must be a real number, not {describe_value(value)}")
    if isinstance(value, jax.core.Tracer):
        try:
            value = jax.extend.core.concrete_or_error(None, value)
        except jax.errors.ConcretizationTypeError:
            raise TracedNumberError(what, why) from None
    return np.asarray(value, float)


PACKAGES = ("jaxbeam.case", "jaxbeam.control")  # with parts of cases
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


# Sizes of numbers: products and quotients of three do not overflow. What must be positive divides.
SMALLEST, LARGEST = 1e-100, 1e100
POSITION_TOLERANCE = 1e-9  # of the length: 3 * 0.2 is still on a beam of 0.6 m


def check_on_beam(name: str, positions: Any, length: Float[Array, ""]) -> None:
    """Validate positions on a beam of a length (all in m); traced numbers are skipped.

    Raises ValueError with the name.
    """
    if not (is_concrete(positions) and is_concrete(length)):
        return
    end, numbers = float(concrete(length)), concrete(positions, name)
    outside = ~(
        (numbers >= -POSITION_TOLERANCE * end) & (numbers <= (1 + POSITION_TOLERANCE) * end)
    )
    if outside.any():
        given = float(numbers[outside].flat[0])
        unit = ": is it in m, not in mm?" if 0 < given / 1000 <= end else ""
        raise ValueError(f"{name} must {ON_BEAM}, between 0 and {end:g} m; it is {given:g} m{unit}")


def suggestion(word: str, allowed: Iterable[str]) -> str:
    """End of an error message about an unknown word: the nearest allowed one, or all of them."""
    allowed = list(allowed)
    if not isinstance(word, str):
        return f"it may be {', '.join(allowed)}"
    if WORDS.get(word) in allowed:
        return f"it is called {WORDS[word]!r} now"
    kind, options = KINDS.get(word, (None, ""))
    if kind in allowed:
        return f"it is kind {kind!r} with {options} now"
    nearest = difflib.get_close_matches(word, allowed, n=1)
    return f"did you mean {nearest[0]!r}?" if nearest else f"it may be {', '.join(allowed)}"


def missing_error(address: str, field: dataclasses.Field) -> ValueError:
    """Error for a field that is left out and has no default."""
    return ValueError(f"{address} is missing; give the {field.metadata['meaning']}{in_unit(field)}")


def check_fields(address: str, part: Any) -> None:
    """Validate the fields of a part by their declarations; raises ValueError with the address."""
    values = vars(part)  # attributes of a module take many times as long to get
    for field in dataclasses.fields(part):
        check_field(f"{address}.{field.name}", values[field.name], field)


def check_field(address: str, value: Any, field: dataclasses.Field) -> None:
    """Validate a value by the declaration of its field; raises ValueError with the address."""
    if "unit" in field.metadata:
        _check_number(address, value, field)
    elif "minimum" in field.metadata:
        minimum = field.metadata["minimum"]
        if value is None and field.default is None:
            return
        if not isinstance(value, int) or isinstance(value, bool) or value < minimum:
            raise ValueError(
                f"{address} must be a whole number, {minimum} or more; it is"
                f" {describe_value(value)}"
            )
        check_count(address, value)
    elif "part" in field.metadata:
        part_class = field.metadata["part"]
        if value is not None and not isinstance(value, part_class):
            members = kinds(part_class).values() if inspect.isabstract(part_class) else [part_class]
            names = " or ".join(member.__name__ for member in members)
            raise ValueError(
                f"{address} holds {describe_value(value)}; it takes a table of its own, in Python a"
                f" {names}"
            )
        if value is not None:
            check_fields(address, value)
    elif "parts" in field.metadata:
        check_length(address, len(value))
        for i, one in enumerate(value):
            if not isinstance(one, field.metadata["parts"]):
                name = field.metadata["parts"].__name__
                raise ValueError(
                    f"{address}.{i} holds {describe_value(one)}; it takes a table of its own, in"
                    f" Python a {name}"
                )
            check_fields(f"{address}.{i}", one)
    elif "meaning" in field.metadata:
        if not isinstance(value, str):
            raise ValueError(f"{address} must be a word in quotes, not {describe_value(value)}")
        allowed = field.metadata["allowed"]
        if allowed and value not in allowed:
            raise ValueError(
                f"{address} cannot be {describe_value(value)}; {suggestion(value, allowed)}"
            )


def validate_direct_or_derived(
    address: str,
    part: Any,
    direct: str,
    exclusive_sources: tuple[str, ...],
    shared_sources: tuple[str, ...] = (),
) -> str | None:
    """Error of a property that is not given by exactly one of two ways, or None.

    The property is given by the field `direct`, or derived from all of the sources.
    `shared_sources` serve other properties too, so they may be given together with `direct`.
    """
    if getattr(part, direct) is not None:
        for name in exclusive_sources:
            if getattr(part, name) is not None:
                return (
                    f"{address}.{direct} and {address}.{name} contradict each other; leave one out"
                )
        return None
    sources = (*shared_sources, *exclusive_sources)
    absent = [name for name in sources if getattr(part, name) is None]
    if not absent:
        return None
    verb = "is" if len(absent) == 1 else "are"
    which = "" if len(absent) == len(sources) else f" (of which {', '.join(absent)} {verb} missing)"
    return (
        f"{address}.{direct} is missing; give it, or all of {', '.join(sources[:-1])} and"
        f" {sources[-1]}{which}"
    )


def validate_exactly_one(address: str, part: Any, first: str, second: str) -> str | None:
    """Error of two fields of which both or none are given, or None."""
    given = [name for name in (first, second) if getattr(part, name) is not None]
    if len(given) == 1:
        return None
    if given:
        return f"{address} has both {first} and {second}; leave one out"
    return f"{address} has neither {first} nor {second}; give one of them"


def _check_number(address: str, value: Any, field: dataclasses.Field) -> None:
    if value is None:
        if field.default is not None:
            raise missing_error(address, field)
        return
    numbers = isinstance(value, jax.Array | np.ndarray | np.generic | float | int)
    if not numbers or not is_real(value):
        raise ValueError(f"{address} must be {describe_shape(field)}, not {describe_value(value)}")
    if not fits_shape(field, np.shape(value)):
        shape = np.shape(value)
        given = f"an array of shape {shape}" if shape else "one number"
        raise ValueError(f"{address} must be {describe_shape(field)}, not {given}")
    check_entries(address, value)
    if not is_concrete(value):
        return
    numbers = np.atleast_1d(concrete(value))
    if _all_allowed(numbers, field.metadata["constraint"]):
        return
    names = [f"{address}.{i}" for i in range(numbers.size)] if np.ndim(value) else [address]
    constraint, unit = field.metadata["constraint"], _unit_suffix(field)
    for name, x in zip(names, numbers.flat, strict=True):
        if not np.isfinite(x):
            raise ValueError(f"{name} must be a finite number; it is {x}")
        if (
            (constraint == POSITIVE and x <= 0)
            or (constraint == NOT_NEGATIVE and x < 0)
            or (constraint == PROBABILITY and not 0 <= x < 1)
        ):
            raise ValueError(f"{name} must {constraint}; it is {x:g}{unit}")
        if abs(x) > LARGEST or (constraint == POSITIVE and x < SMALLEST):
            bound = f"at most {LARGEST:g}" if abs(x) > LARGEST else f"at least {SMALLEST:g}"
            raise ValueError(f"the size of {name} must be {bound}{unit}; it is {x:g}{unit}")
    if constraint == INCREASING:
        _check_increasing(names, numbers, unit)


def _all_allowed(numbers: np.ndarray, constraint: str) -> bool:
    """Whether all numbers of a list satisfy a constraint and are not too large."""
    if not np.all(np.abs(numbers) <= LARGEST):  # also not if one is NaN
        return False
    if constraint == POSITIVE:
        return bool(np.all(numbers >= SMALLEST))
    if constraint == PROBABILITY:
        return bool(np.all((numbers >= 0) & (numbers < 1)))
    if constraint == NOT_NEGATIVE:
        return bool(np.all(numbers >= 0))
    return constraint != INCREASING or not np.any(numbers[1:] <= numbers[:-1])


def _check_increasing(names: list[str], numbers: np.ndarray, unit: str) -> None:
    not_increasing = np.flatnonzero(numbers[1:] <= numbers[:-1])  # differences may overflow
    if not_increasing.size:
        i = not_increasing[0] + 1
        raise ValueError(
            f"{names[i]} must be above the entry before it;"
            f" {numbers[i]:g}{unit} follows {numbers[i - 1]:g}{unit}"
        )


def _unit_suffix(field: dataclasses.Field) -> str:
    """Unit of a field as it follows a number, with a space before it."""
    unit = field.metadata.get("unit", "1")
    return "" if unit in ("1", OF_QUANTITY) else f" {unit}"


def in_unit(field: dataclasses.Field) -> str:
    """Unit of a field in words, such as " in N/m"; empty where it has none."""
    return f" in{_unit_suffix(field)}" if _unit_suffix(field) else ""


if TYPE_CHECKING:  # a type checker takes the fields of a module for its arguments
    ExplainsArguments = type
else:

    class ExplainsArguments(type(eqx.Module)):
        """Metaclass of parts whose errors of arguments say what each number is."""

        def __call__(cls, *args, **arguments):
            """Raises TypeError for arguments that are missing or unknown."""
            try:
                return super().__call__(*args, **arguments)
            except TypeError:
                explanation = _explanation(cls, args, arguments)
                if explanation is None:
                    raise
            raise TypeError(explanation)


def _explanation(part_class: type, args: tuple, arguments: dict) -> str | None:
    """Sentence about the first unknown, or all missing arguments; None without any."""
    fields = {field.name: field for field in dataclasses.fields(part_class) if field.init}
    for name in arguments:
        if name not in fields:
            return f"{part_class.__name__} has no {name}; {suggestion(name, fields)}"
    positional = [name for name, field in fields.items() if not field.kw_only]
    given = {*positional[: len(args)], *arguments}
    missing = [
        f"{name}, the {field.metadata['meaning']}{in_unit(field)}"
        for name, field in fields.items()
        if name not in given and _is_required(field)
    ]
    if not missing:
        return None
    them = "it" if len(missing) == 1 else "them"
    return f"{part_class.__name__} lacks {'; '.join(missing)}: give {them}"


def _is_required(field: dataclasses.Field) -> bool:
    return field.default is field.default_factory is dataclasses.MISSING
