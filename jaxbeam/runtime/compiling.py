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
OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_backend_optimization_level": 2,
    "xla_cpu_parallel_codegen_split_count": 2,
}
# For programs that are compiled side by side and leave no core to spare.
SIDE_BY_SIDE = {"xla_cpu_parallel_codegen_split_count": 1}
# For a program that takes longer to compile well than it will ever run.
ROUGHLY = {"xla_backend_optimization_level": 0}

P = ParamSpec("P")
R = TypeVar("R")


def options(**settings: bool | int) -> dict[str, bool | int]:
    """Settings for `jax.jit` and `Lowered.compile` on this machine, some of them set otherwise.

    Those of XLA_FLAGS prevail.
    """
    given, known = os.environ.get("XLA_FLAGS", ""), _known()
    chosen = known | {name: value for name, value in settings.items() if name in known}
    return {name: value for name, value in chosen.items() if name not in given}


class _Kept(eqx.Module):
    """What a function returns beside arrays."""

    rest: Any = eqx.field(static=True)


class Compiled(Generic[P, R]):
    """A function compiled anew for every structure of its arguments; see `compiled`."""

    def __init__(self, function: Callable[P, R], settings: dict[str, bool | int]):
        functools.update_wrapper(self, function)
        self.settings = settings

        def program(arrays, given):
            args, kwargs = _together(arrays, *given)
            arrays, *rest = _apart(function(*args, **kwargs))  # type: ignore[call-arg]
            return arrays, _Kept(tuple(rest))

        self._program = program
        self._plain = jax.jit(_named(program, function.__name__), static_argnums=1)

    @functools.cached_property
    def quick(self):  # at the first call, because to ask for the options starts JAX's machinery
        """The function as JAX compiles it, of arrays and constants apart."""
        return self.called(self.__name__)

    def called(self, name: str):
        """The same, as a program of that name."""
        chosen = options(**self.settings)
        return jax.jit(_named(self._program, name), static_argnums=1, compiler_options=chosen)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        arrays, *rest = _apart((args, kwargs))
        if _tracing(arrays):
            arrays, kept = self._plain(arrays, tuple(rest))
        elif compile_cache.folder() and (state := self._state(arrays, rest)).place:
            self._prepared(state, arrays, rest)()
            arrays, kept = state.program(arrays)
        else:
            arrays, kept = self.quick(arrays, tuple(rest))
        return _together(arrays, *kept.rest)

    def ahead(self, *args: P.args, **kwargs: P.kwargs) -> Callable[[], Any]:
        """Trace for arguments of the structure and shapes of these; what it returns compiles.

        Calls then need not. Tracing holds Python's lock, compiling leaves it to others. Done once,
        it need not be done again, nor if an earlier process has (`kept_programs`).
        """
        arrays, *rest = _apart((args, kwargs))
        return self._prepared(self._state(arrays, rest), arrays, rest)

    def _prepared(self, state, arrays, rest):
        """See `ahead`."""
        if state.compiled:
            return lambda: None
        if not state.code:
            lowered = state.quick.lower(arrays, tuple(rest))
            return lambda: self._compile(state, lowered)

        def restore():
            try:
                state.program = compile_cache.load(state.code, (arrays,), state.returns)
                state.compiled = True
            except jax.errors.JaxRuntimeError:
                self._compile(state, state.quick.lower(arrays, tuple(rest)))

        return restore

    def _compile(self, state, lowered):
        program = lowered.compile()
        if state.place is not None:
            compile_cache.write(state.place, program, lowered.out_info)
            state.program = program
        state.compiled = True

    def blank(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """What a call would return, with zeros for its numbers: known without compiling."""
        arrays, *rest = _apart((args, kwargs))
        state = self._state(arrays, rest)
        returns = state.returns or state.quick.eval_shape(arrays, tuple(rest))
        state.returns = shapes, kept = returns
        zeros = [None if leaf is None else np.zeros(leaf.shape, leaf.dtype) for leaf in shapes]
        return _together(zeros, *kept.rest)

    def _state(self, arrays, rest):
        return _state_of(self, _identity(arrays, rest))


@dataclasses.dataclass(eq=False)
class _State:
    """What is known of a function for some arguments."""

    function: Compiled
    place: Path | None  # where the program is kept for later processes
    code: bytes  # the program that an earlier process has kept, if there is one
    returns: tuple[list, _Kept] | None  # shapes of what it returns
    compiled: bool = False
    program: Any = None  # if it is not found by calling `quick`

    @functools.cached_property
    def quick(self):
        """What is compiled, with JAX's own cache or to be kept."""
        if self.place is None:
            return self.function.quick
        # What JAX reads from its own cache cannot be kept once more: no name is used twice.
        return self.function.called(f"{self.function.__name__}_{os.urandom(8).hex()}")


@functools.cache
def _state_of(function: Compiled, identity: tuple) -> _State:
    """What is known of a function for some arguments; JAX takes a hundred times as long to tell."""
    place = compile_cache.place(function, identity)
    kept = None if place is None else compile_cache.read(place)
    return _State(function, place, *(kept or (b"", None)))


def forget() -> None:
    """Drop all that was compiled in this process: programs of many cases take gigabytes."""
    jax.clear_caches()
    _state_of.cache_clear()


def compiled(function: Callable[P, R]) -> Compiled[P, R]:
    """Compile a function for the arrays among its arguments, with settings that make that quick.

    As with `equinox.filter_jit`, what is no array is constant. Called within another function that
    is being traced, it becomes part of that one.
    """
    return Compiled(function, {})


def compiled_with(**settings: bool | int) -> Callable[[Callable[P, R]], Compiled[P, R]]:
    """`compiled`, with some settings of XLA of its own."""
    return lambda function: Compiled(function, settings)


def _named(program, name: str):
    """A function under the name that it has in what JAX tells of it."""
    program = functools.partial(program)
    program.__name__ = program.__qualname__ = name  # type: ignore[attr-defined]
    return program


def _apart(tree) -> tuple[list, tuple, Any]:
    """Leaves that are arrays, those that are not, each None where it is the other, and the tree."""
    leaves, structure = jax.tree.flatten(tree)
    are = [eqx.is_array(leaf) for leaf in leaves]
    arrays = [leaf if is_array else None for leaf, is_array in zip(leaves, are, strict=True)]
    rest = tuple(None if is_array else leaf for leaf, is_array in zip(leaves, are, strict=True))
    return arrays, rest, structure


def _identity(arrays, rest) -> tuple:
    """What tells programs apart: all but the numbers in the arrays, and the mode of precision."""
    shapes = tuple(None if leaf is None else (leaf.shape, leaf.dtype) for leaf in arrays)
    return shapes, *rest, jax.config.jax_enable_x64


def _together(arrays, rest, structure):
    pairs = zip(arrays, rest, strict=True)
    return jax.tree.unflatten(structure, [b if a is None else a for a, b in pairs])


def _tracing(arrays) -> bool:
    """Whether a call with these arrays is part of a function being traced."""
    given = [*arrays, _nought()]  # which is one too, where all that is done is
    return any(isinstance(leaf, jax.core.Tracer) for leaf in given)


_nought = jax.jit(lambda: 0.0)  # a seventh of the time that jnp.zeros takes


@functools.cache
def _known() -> dict[str, bool | int]:
    """The settings that this version of XLA knows; they come and go."""

    def knows(settings):
        try:
            jax.jit(lambda: jnp.zeros(()), compiler_options=settings)()
        except (ValueError, RuntimeError):
            return False
        return True

    every = OPTIONS.items()
    return OPTIONS if knows(OPTIONS) else dict(item for item in every if knows(dict([item])))
