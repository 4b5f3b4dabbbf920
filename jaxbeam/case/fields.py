"""Field declarations shared by all data classes of a case.

A number of a case is a JAX array leaf, so that it can be traced, batched and differentiated;
names and counts are static. The metadata carries the SI unit and one line of meaning, which
error messages, tables and plots read, so that each is written once.
"""

import functools
import typing

import equinox as eqx
import jax
import jax.extend
import jax.numpy as jnp
import numpy as np


def _as_array(value):
    """Make a float array leaf of a number; leave tracers and placeholders alone."""
    if isinstance(value, int | float | np.ndarray | np.generic):
        return jnp.asarray(np.asarray(value, float))  # half of the time that JAX takes for both
    return jnp.asarray(value, float) if isinstance(value, list | tuple) else value


def _as_optional_array(value):
    return None if value is None else _as_array(value)


# What a number must do, in the words of the error message; `checks` enforces it.
POSITIVE = "be positive"
NOT_NEGATIVE = "not be negative"
ON_BEAM = "lie on the beam"
INCREASING = "increase"


def number(unit: str, meaning: str, constraint: str = "", **options):
    """Declare a number of a case: a differentiable leaf with its SI unit and its meaning.

    With `default=None` the number may be left out; its absence is part of the structure. `constraint`
    is one of the rules above (none: any finite value).
    """
    converter = _as_optional_array if options.get("default", 0.0) is None else _as_array
    metadata = {"unit": unit, "meaning": meaning, "must": constraint}
    return eqx.field(converter=converter, metadata=metadata, **options)


def choice(meaning: str, *allowed: str, **options):
    """Declare a word of a case, one of `allowed` (any word if none is named)."""
    metadata = {"meaning": meaning, "allowed": allowed}
    return eqx.field(static=True, metadata=metadata, **options)


def count(meaning: str, minimum: int = 1, **options):
    """Declare a whole number of a case, `minimum` or more; static, for it may decide shapes."""
    return eqx.field(static=True, metadata={"meaning": meaning, "least": minimum}, **options)


def part(meaning: str, class_or_registry: type | dict[str, type], **options):
    """Declare a part within a part of a case, a table of its own that may be left out.

    `class_or_registry` is its class, or the registry in which its key `class_or_registry` is looked up.
    """
    return eqx.field(
        metadata={"meaning": meaning, "part": class_or_registry}, default=None, **options
    )


def axis_names(field) -> str:
    """The axes in the annotation of a number: "" for one number, "2", "point", "*modes"."""
    return next(iter(typing.get_args(field.type)), field.type).dim_str


@functools.cache
def fits_shape(field, shape: tuple[int, ...]) -> bool:
    """Tell whether a number declared by this field may have this shape."""
    axes = axis_names(field).split()
    if axes and axes[0].startswith("*"):
        return len(shape) <= 1
    sizes = zip(axes, shape, strict=False)
    return len(axes) == len(shape) and all(not a.isdigit() or int(a) == n for a, n in sizes)


def describe_shape(field) -> str:
    """What a number declared by this field consists of, for error messages."""
    axes = axis_names(field).split()
    if not axes:
        return "one number"
    if axes[0].startswith("*"):
        return "one number or a list of numbers"
    if len(axes) == 2:
        return "a list of lists of numbers, all equally long"
    return f"a list of {axes[0]} numbers" if axes[0].isdigit() else "a list of numbers"


def is_concrete(value) -> bool:
    """Tell whether `value` has numbers one can look at now (it is not an abstract tracer)."""
    if not isinstance(value, jax.core.Tracer):
        return True
    try:
        np.asarray(concrete(value))
    except jax.errors.ConcretizationTypeError:
        return False
    return True


def concrete(value) -> np.ndarray:
    """Return the numbers behind `value`, also while it is being differentiated.

    Raises `jax.errors.ConcretizationTypeError` inside `jit` or `vmap`, where there are none yet.
    """
    if isinstance(value, jax.core.Tracer):
        value = jax.extend.core.concrete_or_error(None, value)
    return np.asarray(value, float)
