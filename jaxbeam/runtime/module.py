"""Base class of immutable objects, which are trees of arrays."""

from typing import TYPE_CHECKING

import equinox as eqx


class Module(eqx.Module):
    """`equinox.Module` whose methods are those of Python, found in a hundredth of the time.

    Those of Equinox are trees of arrays themselves, so that `jax.jit` may be given one; with them
    a run of two loads takes 5 % longer.
    """

    if not TYPE_CHECKING:  # a checker of types takes it for attributes of any name
        __getattribute__ = object.__getattribute__
