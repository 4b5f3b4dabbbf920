"""Compiling, with settings that suit programs of many small kernels."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

# XLA's newer code generator for CPUs takes twice as long to compile the programs here, and they
# run no faster for it.
OPTIONS = {"xla_cpu_use_fusion_emitters": False}

P = ParamSpec("P")
R = TypeVar("R")


def options() -> dict[str, bool]:
    """Settings for `jax.jit` and `Lowered.compile` on this machine."""
    return OPTIONS if _known() else {}


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """`equinox.filter_jit` with settings under which XLA compiles faster, where it knows them.

    Called within another function that is being traced, it becomes part of that one.
    """
    plain = eqx.filter_jit(function)

    @functools.cache
    def quick():  # at the first call, because to ask for the options starts the machinery of JAX
        return eqx.filter_jit(function, compiler_options=options())  # type: ignore[call-overload]

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        chosen = plain if _tracing((args, kwargs)) else quick()
        return chosen(*args, **kwargs)

    return call


def _tracing(given) -> bool:
    """Whether a call with these arguments is part of a function being traced."""
    leaves = [*jax.tree.leaves(given), jnp.zeros(())]  # zeros, too, where all that is done is
    return any(isinstance(leaf, jax.core.Tracer) for leaf in leaves)


@functools.cache
def _known() -> bool:
    """Whether this version of XLA knows the settings; names of settings come and go."""
    try:
        jax.jit(lambda: jnp.zeros(()), compiler_options=OPTIONS)()
    except (ValueError, RuntimeError):
        return False
    return True
