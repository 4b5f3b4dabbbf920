"""Compilation of functions by XLA, with options for programs of many small kernels."""

import functools
import os
from collections.abc import Callable
from typing import Any, Generic, ParamSpec, TypeVar, overload

import equinox as eqx
import jax
import jax.extend
import jax.flatten_util
import jax.numpy as jnp
import numpy as np

from jaxbeam.runtime.interpreter import InterpretedProgram, compile_cost, run_cost

# XLA's newer code generator for CPUs takes twice as long to compile the programs here, and its
# last level of optimisation a third longer; they run no faster for the one, 3 % for the other.
# Code generation in 32 parts, the default, does a quarter more work than in two.
XLA_OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 2,
    "xla_cpu_parallel_codegen_split_count": 2,
}
# For programs that are compiled at the same time, on all cores.
PARALLEL_COMPILATION = {"xla_cpu_parallel_codegen_split_count": 1}
# For programs whose run time is less than the compile time that optimisation costs.
LOW_OPTIMISATION = {"xla_backend_optimization_level": 0}

KEPT_PROGRAMS = 64  # kept programs of functions of traced numbers
MAX_SLOPES = 2**24  # entries of all derivatives that are computed with the values

P = ParamSpec("P")
R = TypeVar("R")


def xla_options(**settings: bool | int) -> dict[str, bool | int]:
    """Compiler options for `jax.jit` and `Lowered.compile`: XLA_OPTIONS changed by `settings`.

    Options that this version of XLA does not have, or that XLA_FLAGS sets, are left out.
    """
    user_flags, supported = os.environ.get("XLA_FLAGS", ""), _supported_options()
    chosen = supported | {name: value for name, value in settings.items() if name in supported}
    return {name: value for name, value in chosen.items() if name not in user_flags}


class _StaticOutputs(eqx.Module):
    """Outputs of a function that are not arrays, and their tree structure."""

    static: Any = eqx.field(static=True)


class Compiled(Generic[P, R]):
    """Function with a compiled program for each structure of its arguments; see `compiled`."""

    def __init__(self, function: Callable[P, R], settings: dict[str, bool | int]):
        functools.update_wrapper(self, function)
        self.settings = settings

        def program(arrays, static):
            args, kwargs = _combine(arrays, *static)
            arrays, *rest = _partition(function(*args, **kwargs))  # type: ignore[call-arg]
            return arrays, _StaticOutputs(tuple(rest))

        self._program = program
        # For calls within another program, which has its own compiler options.
        self._jitted_inner = jax.jit(_renamed(program, function.__name__), static_argnums=1)

    @functools.cached_property
    def jitted(self):  # at the first call, since `xla_options` starts XLA
        """`jax.jit` of the function of (arrays, static arguments)."""
        options = xla_options(**self.settings)
        program = _renamed(self._program, self.__name__)
        return jax.jit(program, static_argnums=1, compiler_options=options)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        arrays, *rest = _partition((args, kwargs))
        program = self._jitted_inner if _is_tracing(arrays) else self.jitted
        arrays, outputs = program(arrays, tuple(rest))
        return _combine(arrays, *outputs.static)

    def precompile(self, *args: P.args, **kwargs: P.kwargs) -> Callable[[], Any]:
        """Trace for arguments of this structure, and return a function that compiles.

        Tracing holds Python's global lock, compiling does not, so the latter may run in a thread.
        Calls with such arguments then do neither.
        """
        arrays, *rest = _partition((args, kwargs))
        done, signature = _compiled_signatures(self), _signature(arrays, rest)
        if signature in done:
            return lambda: None
        lowered = self.jitted.lower(arrays, tuple(rest))

        def compile_program():
            lowered.compile()
            done.add(signature)

        return compile_program

    def template(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Outputs of a call with zeros for numbers, found without compilation."""
        arrays, *rest = _partition((args, kwargs))
        shapes, outputs = self.jitted.eval_shape(arrays, tuple(rest))
        zeros = [None if leaf is None else np.zeros(leaf.shape, leaf.dtype) for leaf in shapes]
        return _combine(zeros, *outputs.static)


@functools.cache
def _compiled_signatures(function: Compiled) -> set[tuple]:
    """Signatures of the arguments for which a function was precompiled."""
    return set()


def clear_caches() -> None:
    """Free all programs compiled in this process; those of many cases take gigabytes."""
    jax.clear_caches()
    _program_of.cache_clear()
    _compiled_signatures.cache_clear()


@overload
def compiled(function: Callable[P, R], **settings: bool | int) -> Compiled[P, R]: ...


@overload
def compiled(**settings: bool | int) -> Callable[[Callable[P, R]], Compiled[P, R]]: ...


def compiled(function: Any = None, **settings: bool | int) -> Any:
    """Compile a function of arrays and static arguments with `xla_options(**settings)`.

    A decorator, with or without settings. As with `equinox.filter_jit`, arguments that are not
    arrays are static: a program is compiled for each of their values. Called while another function
    is traced, the function becomes part of that program.
    """
    if function is None:
        return lambda function: Compiled(function, settings)
    return Compiled(function, settings)


def compiled_if_traced(function: Callable[P, R]) -> Callable[P, R]:
    """Decorator: compute in NumPy from concrete numbers; compile what depends on traced ones.

    The function and all that it calls use `jaxbeam.runtime.arrays`. Concrete arrays of JAX are
    passed as arrays of NumPy. Where some numbers are traced, only the operations that depend on
    them become a program; results that depend on none of them are arrays of NumPy.
    """

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        arrays, *rest = _partition((args, kwargs))
        traced = [i for i, leaf in enumerate(arrays) if isinstance(leaf, jax.core.Tracer)]
        concrete = [
            None if leaf is None or i in traced else np.asarray(leaf)
            for i, leaf in enumerate(arrays)
        ]

        def compute(*numbers):
            leaves = list(concrete)
            for i, number in zip(traced, numbers, strict=True):
                leaves[i] = number
            args, kwargs = _combine(leaves, *rest)
            with np.errstate(all="ignore"):  # as compiled code, which yields inf and nan
                return function(*args, **kwargs)  # type: ignore[call-arg]

        if not traced:
            return compute()
        return _compile_traced(compute, [arrays[i] for i in traced], function.__name__)

    return call


def _compile_traced(compute: Callable, numbers: list, name: str) -> Any:
    """Value of a function of traced numbers; operations that depend on them become a program."""
    outputs: Any = None

    def traced_outputs(*numbers):
        nonlocal outputs
        leaves, structure = jax.tree.flatten(compute(*numbers))
        outputs = [None if isinstance(leaf, jax.Array) else leaf for leaf in leaves], structure
        return [leaf for leaf in leaves if isinstance(leaf, jax.Array)]

    closed = jax.make_jaxpr(traced_outputs)(*numbers)
    equations = _Equations(closed.jaxpr)
    outs = [out.aval for out in closed.jaxpr.outvars]
    entries = sum(out.size for out in outs) * sum(map(np.size, numbers))
    has_complex = any(jnp.issubdtype(out.dtype, jnp.complexfloating) for out in outs)
    if _differentiated(numbers) and not has_complex and entries <= MAX_SLOPES:
        found = _by_slopes(equations, closed.consts, name, 0, numbers)
    else:
        found = _mapped(equations, closed.consts, name, numbers)
    found = iter(found)
    leaves, structure = outputs
    return structure.unflatten([next(found) if leaf is None else leaf for leaf in leaves])


def _differentiated(numbers: list) -> bool:
    """Whether numbers are real, and differentiated outside of `jit`, so that they are concrete."""
    try:
        for number in numbers:
            jax.extend.core.concrete_or_error(None, number)
    except jax.errors.ConcretizationTypeError:
        return False
    return all(map(_is_real, numbers))


def _mapped(equations: "_Equations", constants, name: str, numbers: list) -> list:
    """Values of a program; under `vmap` outside of `jit` a program is compiled for the batch."""

    def inside(numbers):
        return _program_of(equations, name, 0, False)(constants, numbers)

    if any(not hasattr(n, "batch_dim") or isinstance(n.val, jax.core.Tracer) for n in numbers):
        return inside(numbers)
    values = jax.custom_batching.custom_vmap(inside)

    @values.def_vmap
    def _(_, batched, numbers):
        mapped = tuple(0 if is_batched else None for is_batched in batched[0])
        outermost = not _is_tracing(numbers)  # of nested `vmap`, the others are within its program
        found = _program_of(equations, name, 0, outermost, mapped)(constants, numbers)
        return found, [True] * len(found)

    return values(numbers)


def _by_slopes(equations: "_Equations", constants, name: str, order: int, numbers: list) -> list:
    """Values of a program with a rule of derivatives: values and slopes by forward mode.

    Values and slopes have a program each, with compiler options, which a program inside `jax.grad`
    cannot have, and none for the reverse pass. An `order` above zero is that of the derivatives of
    the values.
    """

    @jax.custom_jvp
    def values(numbers):
        return run(order, numbers)

    @values.defjvp
    def _(primals, tangents):
        outputs = _by_slopes(equations, constants, name, order + 1, *primals)
        *found, slopes = map(_without_batch, outputs)
        leaves, structure = jax.tree.flatten(found)
        along = iter(_along(slopes, *tangents))
        none = (np.zeros(leaf.shape, jax.dtypes.float0) for leaf in leaves)
        rates = [
            next(along) if _is_real(leaf) else zero for leaf, zero in zip(leaves, none, strict=True)
        ]
        return found, structure.unflatten(rates)

    def run(order, numbers):
        inside = _is_tracing(numbers)
        return _program_of(equations, name, order, not inside)(constants, numbers)

    return values(numbers)


def _without_batch(value):
    """Value that a `vmap` of other numbers has wrapped, so that it is concrete under `jacfwd`."""
    while hasattr(value, "batch_dim") and value.batch_dim is None:
        value = value.val
    return value


@jax.jit
def _along(slopes, tangents):
    """Derivatives of values along tangents, from `slopes` (number, ...) by the flat numbers."""
    vector = jnp.concatenate([jnp.ravel(part) for part in tangents])
    return [jnp.tensordot(vector, slope, 1) for slope in slopes]


def _is_real(array) -> bool:
    return jnp.issubdtype(array.dtype, jnp.floating)


@functools.lru_cache(maxsize=KEPT_PROGRAMS)
def _program_of(
    equations: "_Equations",
    name: str,
    order: int,
    with_options: bool,
    mapped: tuple[int | None, ...] = (),
) -> Callable:
    """Function of constants and numbers under `jax.jit`, from its equations.

    With an `order` above zero the last output are the slopes of the real outputs, (number, ...).
    `mapped` are the batch axes of the numbers, empty without a batch. `with_options` it is a
    program of its own with compiler options, compiled when this becomes cheaper than NumPy.
    """

    def program(constants, numbers):
        def values(numbers):
            return jax.core.eval_jaxpr(equations.jaxpr, constants, *numbers)

        for _ in range(order):
            values = _with_slopes(values)
        return (jax.vmap(values, (list(mapped),)) if mapped else values)(numbers)

    options = {"compiler_options": xla_options()} if with_options else {}
    jitted = jax.jit(_renamed(program, name), **options)
    return _InterpretedFirst(jitted) if with_options else jitted


class _InterpretedFirst:
    """Function under `jax.jit` that is computed in NumPy until compilation would be cheaper."""

    def __init__(self, jitted):
        self.jitted, self.spent, self.traced, self.program = jitted, 0.0, None, None

    def __call__(self, *args):
        if self.traced is None:
            self.traced = self.jitted.trace(*args)
            self.cost = run_cost(self.traced.jaxpr.jaxpr)
            self.price = compile_cost(self.traced.jaxpr.jaxpr)
        self.spent += self.cost
        if self.spent > self.price:
            return self.jitted(*args)
        self.program = self.program or InterpretedProgram(self.traced.jaxpr)
        found = self.program(*jax.tree.leaves(args))
        structure = jax.tree.structure(self.traced.out_info)
        return structure.unflatten(map(jnp.asarray, found))


def _with_slopes(values: Callable) -> Callable:
    """Function of numbers that also returns the slopes of its real values."""

    def both(numbers):
        vector, unravel = jax.flatten_util.ravel_pytree(numbers)

        def real(vector):
            leaves, structure = jax.tree.flatten(values(unravel(vector)))
            return list(filter(_is_real, leaves)), structure.unflatten(leaves)

        def push(direction):
            _, slopes, found = jax.jvp(real, (vector,), (direction,), has_aux=True)
            return slopes, found

        slopes, found = jax.vmap(push, out_axes=(0, None))(jnp.eye(vector.size))
        return [*found, slopes]

    return both


class _Equations:
    """Equations of a program, equal to others with the same text."""

    def __init__(self, jaxpr):
        self.jaxpr, self.text = jaxpr, str(jaxpr)

    def __hash__(self):
        return hash(self.text)

    def __eq__(self, other):
        return self.text == other.text


def _renamed(program, name: str):
    """Function under another name, which its program has in profiles and logs."""
    program = functools.partial(program)
    program.__name__ = program.__qualname__ = name  # type: ignore[attr-defined]
    return program


def _partition(tree) -> tuple[list, tuple, Any]:
    """Leaves that are arrays, other leaves, and structure; None in place of leaves left out."""
    leaves, structure = jax.tree.flatten(tree)
    array_mask = [eqx.is_array(leaf) for leaf in leaves]
    arrays = [leaf if is_array else None for leaf, is_array in zip(leaves, array_mask, strict=True)]
    rest = tuple(
        None if is_array else leaf for leaf, is_array in zip(leaves, array_mask, strict=True)
    )
    return arrays, rest, structure


def _combine(arrays, rest, structure):
    """Inverse of `_partition`."""
    pairs = zip(arrays, rest, strict=True)
    return jax.tree.unflatten(structure, [b if a is None else a for a, b in pairs])


def _signature(arrays, rest) -> tuple:
    """Shapes and dtypes of arrays, other arguments, tree structure and precision mode."""
    shapes = tuple(None if leaf is None else (leaf.shape, leaf.dtype) for leaf in arrays)
    return shapes, *rest, jax.config.jax_enable_x64


def _is_tracing(arrays) -> bool:
    """Whether a call with these arrays is part of a function being traced."""
    given = [*arrays, _zero()]  # a tracer where everything is traced, as under jax.jit
    return any(isinstance(leaf, jax.core.Tracer) for leaf in given)


_zero = jax.jit(lambda: 0.0)  # a seventh of the time that jnp.zeros takes


@functools.cache
def _supported_options() -> dict[str, bool | int]:
    """XLA_OPTIONS that this version of XLA supports."""

    def supports(settings):
        try:
            jax.jit(lambda: jnp.zeros(()), compiler_options=settings)()
        except (ValueError, RuntimeError):
            return False
        return True

    every = XLA_OPTIONS.items()
    return (
        XLA_OPTIONS
        if supports(XLA_OPTIONS)
        else dict(item for item in every if supports(dict([item])))
    )
