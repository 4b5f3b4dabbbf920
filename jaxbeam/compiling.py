"""Compiling, with settings that suit programs of many small kernels."""

import functools
import os
from collections.abc import Callable
from typing import Generic, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

# XLA's newer code generator for CPUs takes twice as long to compile the programs here, and its
# last level of optimisation a third longer; they run no faster for the one, 3 % for the other.
OPTIONS = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 2}

P = ParamSpec("P")
R = TypeVar("R")


def options() -> dict[str, bool | int]:
    """Settings for `jax.jit` and `Lowered.compile` on this machine; those of XLA_FLAGS prevail."""
    given = os.environ.get("XLA_FLAGS", "")
    return {name: value for name, value in _known().items() if name not in given}


class Compiled(Generic[P, R]):
    """A function compiled anew for every structure of its arguments; see `compiled`."""

    def __init__(self, function: Callable[P, R]):
        functools.update_wrapper(self, function)
        self._plain = eqx.filter_jit(function)

    @functools.cached_property
    def _quick(self):  # at the first call, because to ask for the options starts JAX's machinery
        return eqx.filter_jit(self.__wrapped__, compiler_options=options())  # type: ignore[call-overload]

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        chosen = self._plain if _tracing((args, kwargs)) else self._quick
        return chosen(*args, **kwargs)

    def ahead(self, *args: P.args, **kwargs: P.kwargs) -> None:
        """Compile for arguments of the structure and shapes of these: calls then need not."""
        self._quick.lower(*args, **kwargs).compile()


def compiled(function: Callable[P, R]) -> Compiled[P, R]:
    """`equinox.filter_jit` with settings under which XLA compiles faster, where it knows them.

    Called within another function that is being traced, it becomes part of that one.
    """
    return Compiled(function)


def _tracing(given) -> bool:
    """Whether a call with these arguments is part of a function being traced."""
    leaves = [*jax.tree.leaves(given), jnp.zeros(())]  # zeros, too, where all that is done is
    return any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


@functools.cache
def _known() -> dict[str, bool | int]:
    """The settings, if this version of XLA knows them; names of settings come and go."""
    try:
        jax.jit(lambda: jnp.zeros(()), compiler_options=OPTIONS)()
    except (ValueError, RuntimeError):
        return {}
    return OPTIONS
