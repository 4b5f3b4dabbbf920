"""Derivatives of functions that are affine, by their values: known numbers need no compiler."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, any_jax, xp

STEP = 2.0**20  # of each argument; exact in floating point, and far above the value at zero
TRIAL_SIZES = 1e-6, 1.0, 1e6  # of random arguments at which an affine function is one
ROUNDING = 1e-9  # relative


class NotAffineError(ValueError):
    """A function of known numbers is not affine, so that its derivatives need JAX."""


def affine_jacobian(
    function: Callable, point: Float[Array, " argument"]
) -> Float[Array, "value argument"]:
    """Derivatives of a function (argument,) -> (value,) by its argument.

    Where it is traced those at the point, by JAX. Of known numbers, differences, which are exact
    for an affine function. Raises NotAffineError for any other, and for one that computes with JAX.
    """
    start = function(np.zeros(point.shape))
    if any_jax(point, start):
        if any_jax(point) or isinstance(start, jax.core.Tracer):
            return jax.jacfwd(function)(point)
        raise NotAffineError
    size = point.shape[0]
    if not start.size:
        none: Any = np.zeros((0, size))
        return none
    with np.errstate(all="ignore"):
        columns: list[Any] = [(function(STEP * unit) - start) / STEP for unit in np.eye(size)]
        matrix: Any = np.stack(columns, axis=1) if size else np.zeros((start.shape[0], 0))
        if not all(is_affine(function, matrix, start, scale) for scale in TRIAL_SIZES):
            raise NotAffineError
    return matrix


def is_affine(
    function: Callable,
    matrix: Float[np.ndarray, "value argument"],
    start: Float[np.ndarray, " value"],
    scale: float = 1.0,
) -> bool:
    """Whether a function of known numbers is start + matrix @ argument at a random argument.

    Two affine functions agree there if and only if, but for rounding, they are the same.
    """
    trial = scale * random_argument(matrix.shape[1])
    terms = np.abs(matrix) @ np.abs(trial) + np.abs(start)
    return bool(np.all(np.abs(function(trial) - start - matrix @ trial) <= ROUNDING * terms))


@functools.cache
def random_argument(size: int) -> Float[np.ndarray, " argument"]:
    """Numbers of a normal distribution, always the same."""
    return np.random.default_rng(0).standard_normal(size)


def apply(
    matrix: Float[Array, "*time after before"], values: Float[Array, "before *column"]
) -> Float[Array, "after *column"]:
    """Product of a matrix and a vector or columns; of one matrix for each time, and the columns of
    the first time, those of the second and so on."""
    if matrix.ndim == 2:
        return matrix @ values
    groups = values.reshape(values.shape[0], matrix.shape[0], -1)
    products = matrix @ xp.moveaxis(groups, 1, 0)
    return xp.moveaxis(products, 0, 1).reshape(matrix.shape[1], -1)
