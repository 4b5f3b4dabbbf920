"""Compiling, with settings that suit programs of many small kernels."""

import dataclasses
import functools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Generic, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.runtime import compile_cache

# XLA's newer code generator for CPUs takes twice as long to compile the programs here, and its
# last level of optimisation a third longer; they run no faster for the one, 3 % for the other. In
# the 32 parts into which it would cut a program, a quarter more work is done than in two.
XLA_OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 2,
    "xla_cpu_parallel_codegen_split_count": 2,
}
# For programs that are compiled side by side and leave no core to spare.
PARALLEL_COMPILATION = {"xla_cpu_parallel_codegen_split_count": 1}
# For a program that takes longer to compile well than it will ever run.
LOW_OPTIMISATION = {"xla_backend_optimization_level": 0}

P = ParamSpec("P")
R = TypeVar("R")


def xla_options(**settings: bool | int) -> dict[str, bool | int]:
    """Settings for `jax.jit` and `Lowered.compile` on this machine, some of them set otherwise.

    Those of XLA_FLAGS prevail.
    """
    user_flags, supported = os.environ.get("XLA_FLAGS", ""), _supported_options()
    chosen = supported | {name: value for name, value in settings.items() if name in supported}
    return {name: value for name, value in chosen.items() if name not in user_flags}


class _StaticOutputs(eqx.Module):
    """What a function returns beside arrays."""

    static: Any = eqx.field(static=True)


class Compiled(Generic[P, R]):
    """A function compiled anew for every structure of its arguments; see `compiled`."""

    def __init__(self, function: Callable[P, R], settings: dict[str, bool | int]):
        functools.update_wrapper(self, function)
        self.settings = settings

        def program(arrays, given):
            args, kwargs = _combine(arrays, *given)
            arrays, *rest = _partition(function(*args, **kwargs))  # type: ignore[call-arg]
            return arrays, _StaticOutputs(tuple(rest))

        self._program = program
        self._jitted_inner = jax.jit(_renamed(program, function.__name__), static_argnums=1)

    @functools.cached_property
    def jitted(self):  # at the first call, because to ask for the options starts JAX's machinery
        """The function as JAX compiles it, of arrays and constants apart."""
        return self.jitted_as(self.__name__)

    def jitted_as(self, name: str):
        """The same, as a program of that name."""
        compiler_settings = xla_options(**self.settings)
        return jax.jit(
            _renamed(self._program, name), static_argnums=1, compiler_options=compiler_settings
        )

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        arrays, *rest = _partition((args, kwargs))
        if _is_tracing(arrays):
            arrays, kept = self._jitted_inner(arrays, tuple(rest))
        elif compile_cache.program_folder() and (entry := self._entry(arrays, rest)).cache_path:
            self._compilation(entry, arrays, rest)()
            arrays, kept = entry.program(arrays)
        else:
            arrays, kept = self.jitted(arrays, tuple(rest))
        return _combine(arrays, *kept.static)

    def precompile(self, *args: P.args, **kwargs: P.kwargs) -> Callable[[], Any]:
        """Trace for arguments of the structure and shapes of these; what it returns compiles.

        Calls then need not. Tracing holds Python's lock, compiling leaves it to others. Done once,
        it need not be done again, nor if an earlier process has (`kept_programs`).
        """
        arrays, *rest = _partition((args, kwargs))
        return self._compilation(self._entry(arrays, rest), arrays, rest)

    def _compilation(self, entry, arrays, rest):
        """See `ahead`."""
        if entry.compiled:
            return lambda: None
        if not entry.cached_code:
            lowered = entry.jitted.lower(arrays, tuple(rest))
            return lambda: self._compile(entry, lowered)

        def load_or_compile():
            try:
                entry.program = compile_cache.load_program(
                    entry.cached_code, (arrays,), entry.outputs
                )
                entry.compiled = True
            except jax.errors.JaxRuntimeError:
                self._compile(entry, entry.jitted.lower(arrays, tuple(rest)))

        return load_or_compile

    def _compile(self, entry, lowered):
        program = lowered.compile()
        if entry.cache_path is not None:
            compile_cache.save_program(entry.cache_path, program, lowered.out_info)
            entry.program = program
        entry.compiled = True

    def template(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """What a call would return, with zeros for its numbers: known without compiling."""
        arrays, *rest = _partition((args, kwargs))
        entry = self._entry(arrays, rest)
        outputs = entry.outputs or entry.jitted.eval_shape(arrays, tuple(rest))
        entry.outputs = shapes, kept = outputs
        zeros = [None if leaf is None else np.zeros(leaf.shape, leaf.dtype) for leaf in shapes]
        return _combine(zeros, *kept.static)

    def _entry(self, arrays, rest):
        return _program_entry(self, _signature(arrays, rest))


@dataclasses.dataclass(eq=False)
class _ProgramEntry:
    """What is known of a function for some arguments."""

    function: Compiled
    cache_path: Path | None  # where the program is kept for later processes
    cached_code: bytes  # the program that an earlier process has kept, if there is one
    outputs: tuple[list, _StaticOutputs] | None  # shapes of what it returns
    compiled: bool = False
    program: Any = None  # if it is not found by calling `quick`

    @functools.cached_property
    def jitted(self):
        """What is compiled, with JAX's own cache or to be kept."""
        if self.cache_path is None:
            return self.function.jitted
        # What JAX reads from its own cache cannot be kept once more: no name is used twice.
        return self.function.jitted_as(f"{self.function.__name__}_{os.urandom(8).hex()}")


@functools.cache
def _program_entry(function: Compiled, identity: tuple) -> _ProgramEntry:
    """What is known of a function for some arguments; JAX takes a hundred times as long to tell."""
    cache_path = compile_cache.cache_path(function, identity)
    cached = None if cache_path is None else compile_cache.read_program(cache_path)
    return _ProgramEntry(function, cache_path, *(cached or (b"", None)))


def clear_caches() -> None:
    """Drop all that was compiled in this process: programs of many cases take gigabytes."""
    jax.clear_caches()
    _program_entry.cache_clear()


def compiled(function: Callable[P, R]) -> Compiled[P, R]:
    """Compile a function for the arrays among its arguments, with settings that make that quick.

    As with `equinox.filter_jit`, what is no array is constant. Called within another function that
    is being traced, it becomes part of that one.
    """
    return Compiled(function, {})


def compiled_with(**settings: bool | int) -> Callable[[Callable[P, R]], Compiled[P, R]]:
    """`compiled`, with some settings of XLA of its own."""
    return lambda function: Compiled(function, settings)


def _renamed(program, name: str):
    """A function under the name that it has in what JAX tells of it."""
    program = functools.partial(program)
    program.__name__ = program.__qualname__ = name  # type: ignore[attr-defined]
    return program


def _partition(tree) -> tuple[list, tuple, Any]:
    """Leaves that are arrays, those that are not, each None where it is the other, and the tree."""
    leaves, structure = jax.tree.flatten(tree)
    array_mask = [eqx.is_array(leaf) for leaf in leaves]
    arrays = [leaf if is_array else None for leaf, is_array in zip(leaves, array_mask, strict=True)]
    rest = tuple(
        None if is_array else leaf for leaf, is_array in zip(leaves, array_mask, strict=True)
    )
    return arrays, rest, structure


def _signature(arrays, rest) -> tuple:
    """What tells programs apart: all but the numbers in the arrays, and the mode of precision."""
    shapes = tuple(None if leaf is None else (leaf.shape, leaf.dtype) for leaf in arrays)
    return shapes, *rest, jax.config.jax_enable_x64


def _combine(arrays, rest, structure):
    pairs = zip(arrays, rest, strict=True)
    return jax.tree.unflatten(structure, [b if a is None else a for a, b in pairs])


def _is_tracing(arrays) -> bool:
    """Whether a call with these arrays is part of a function being traced."""
    given = [*arrays, _zero()]  # which is one too, where all that is done is
    return any(isinstance(leaf, jax.core.Tracer) for leaf in given)


_zero = jax.jit(lambda: 0.0)  # a seventh of the time that jnp.zeros takes


@functools.cache
def _supported_options() -> dict[str, bool | int]:
    """The settings that this version of XLA knows; they come and go."""

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
