"""Small linear systems, many at a time, spelt out.

A library's factorisation would seek pivots in each of them; that takes longer, to compile as well.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

FEW = 12  # terms; XLA calls a library for products, which takes as long as adding these


def solve_small(
    matrix: Float[Array, "row row lane"], right: Float[Array, "row column lane"]
) -> Float[Array, "row column lane"]:
    """Solve systems by halves: few operations, each on all lanes at once.

    No pivots are sought: for matrices that are positive, or the identity plus masses times a
    positive matrix. Linear in the right side, so that it can be transposed.
    """
    return right if matrix.shape[0] == 0 else _solve(matrix, right)[0]


def _solve(matrix, *rights):
    size = matrix.shape[0]
    if size <= 3:
        inverse = _inverse(matrix)
        return tuple(_times(inverse, right) for right in rights)
    half = size // 2
    tops = [matrix[:half, half:], *(right[:half] for right in rights)]
    across, *upper = _solve(matrix[:half, :half], *tops)
    below = matrix[half:, :half]
    rests = [right[half:] - _times(below, top) for right, top in zip(rights, upper, strict=True)]
    lower = _solve(matrix[half:, half:] - _times(below, across), *rests)
    pairs = zip(upper, lower, strict=True)
    return tuple(jnp.concatenate([top - _times(across, end), end]) for top, end in pairs)


def _times(a, b):
    """Product of small matrices (row, row, lane), spelt out."""
    return sum(a[:, k, None] * b[k] for k in range(1, b.shape[0])) + a[:, 0, None] * b[0]


def _inverse(matrix):
    """Inverse of up to three rows, by cofactors."""
    size = matrix.shape[0]
    if size == 1:
        return 1 / matrix
    if size == 2:
        (a, b), (c, d) = matrix
        return jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])]) / (a * d - b * c)
    minors = [
        [
            matrix[i - 2, j - 2] * matrix[i - 1, j - 1]
            - matrix[i - 2, j - 1] * matrix[i - 1, j - 2]
            for i in range(3)
        ]
        for j in range(3)
    ]
    adjugate = jnp.stack([jnp.stack(row) for row in minors])
    return adjugate / jnp.sum(matrix[0] * adjugate[:, 0], axis=0)


def product(
    matrix: Float[Array, "row column"], lanes: Float[Array, "column lane"]
) -> Float[Array, "row lane"]:
    """Product of a matrix with many columns, spelt out where few terms are added."""
    if not 0 < lanes.shape[0] <= FEW:
        return matrix @ lanes
    return _times(matrix[..., None], lanes[:, None])[:, 0]


def solve_any(
    matrix: Float[Array, "row row"], right: Float[Array, "row column"]
) -> Float[Array, "row column"]:
    """Solve a system of any size; under `vmap` many at a time, with the systems as the last axis.

    As `solve_small` without pivots, but by a loop, which compiles quickly for larger matrices too.
    Where a library's factorisations of batches run side by side, their threads may wait for each
    other for ever (jaxlib's hand parts of a batch to the threads that they are waiting on).
    """
    return jax.lax.custom_linear_solve(
        lambda x: matrix @ x,
        right,
        lambda _, b: _eliminated(matrix, b),
        lambda _, b: _eliminated(matrix.T, b),
    )


@jax.custom_batching.custom_vmap
def _eliminated(matrix, right):
    """Gauss and Jordan's elimination of systems (row, column, *lane)."""
    size = matrix.shape[0]
    rows = np.arange(size).reshape(-1, *[1] * (matrix.ndim - 1))

    def step(k, both):
        row = jax.lax.dynamic_index_in_dim(both, k, 0, keepdims=False)
        row = row / jax.lax.dynamic_index_in_dim(row, k, 0)
        column = jax.lax.dynamic_index_in_dim(both, k, 1)
        return jnp.where(rows == k, row, both - column * row)

    both = jnp.concatenate([matrix, right], axis=1)
    return jax.lax.fori_loop(0, size, step, both)[:, size:]


@_eliminated.def_vmap
def _(count, batched, *systems):
    lanes = [
        jnp.moveaxis(part, 0, -1)
        if has
        else jnp.broadcast_to(part[..., None], (*part.shape, count))
        for part, has in zip(systems, batched, strict=True)
    ]
    return jnp.moveaxis(_eliminated(*lanes), -1, 0), True


def times(
    a: Float[Array, "row term _"], b: Float[Array, "term column _"]
) -> Float[Array, "row column lane"]:
    """Products, spelt out where few terms are added, else by a library."""
    if a.shape[2] == 1:
        return jnp.tensordot(a[..., 0], b, 1)
    if b.shape[2] == 1:
        return jnp.moveaxis(jnp.tensordot(a, b[..., 0], ((1,), (0,))), -1, 1)
    return _times(a, b) if b.shape[0] <= FEW else jnp.einsum("ik...,kj...->ij...", a, b)


def turned(matrix: Float[Array, "row column lane"]) -> Float[Array, "column row lane"]:
    """The transposes."""
    return jnp.swapaxes(matrix, 0, 1)


def joined(*parts: Float[Array, "row _ _"]) -> Float[Array, "row column lane"]:
    """Matrices side by side."""
    lanes = lanes_of(parts)
    return jnp.concatenate(
        [jnp.broadcast_to(part, (*part.shape[:2], lanes)) for part in parts], axis=1
    )


def solve_lanes(
    matrix: Float[Array, "row row _"], right: Float[Array, "row column _"]
) -> Float[Array, "row column lane"]:
    """As `solve_any`, with the systems as the last axis."""
    lanes = lanes_of(matrix, right)
    matrix, right = (jnp.broadcast_to(x, (*x.shape[:2], lanes)) for x in (matrix, right))
    return jax.lax.custom_linear_solve(
        lambda x: _times(matrix, x),
        right,
        lambda _, b: _eliminated(matrix, b),
        lambda _, b: _eliminated(turned(matrix), b),
    )


def lanes_of(*args: Any) -> int:
    """How many lanes there are."""
    return max(part.shape[-1] for part in jax.tree.leaves(eqx.filter(args, eqx.is_array)))


def each_lane(function: Callable, *args: Any) -> Any:
    """What a function of arrays without lanes returns for each lane of these.

    What lanes share has a last axis of length one, here and in `in_lanes`.
    """
    arrays, rest = eqx.partition(args, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    axes = [None if leaf.shape[-1] == 1 else -1 for leaf in leaves]
    bare = [leaf[..., 0] if axis is None else leaf for leaf, axis in zip(leaves, axes, strict=True)]

    def alone(*given):
        return function(*eqx.combine(jax.tree.unflatten(structure, given), rest))

    if set(axes) <= {None}:
        return jax.tree.map(lambda part: part[..., None], alone(*bare))
    return jax.vmap(alone, axes, -1)(*bare)


def in_lanes(function: Callable, *args: Any) -> Any:
    """Call a function of trees of arrays (..., lane) with arrays that have no lanes.

    Under `vmap` what is mapped is the lanes: matrices are small, so what is done for an element of
    all of them at once are the long loops. Derivatives are those of a single lane, mapped.
    """
    arrays, rest = eqx.partition(args, eqx.is_array)

    def laid(lanes):
        return function(*eqx.combine(lanes, rest))

    def alone(given):
        found = laid(jax.tree.map(lambda part: part[..., None], given))
        return jax.tree.map(lambda part: part[..., 0], found)

    many = jax.custom_batching.custom_vmap(alone)

    @many.def_vmap
    def _(count, mapped, given):
        def last(part, has):
            return jnp.moveaxis(part, 0, -1) if has else part[..., None]

        def first(part):
            return jnp.moveaxis(jnp.broadcast_to(part, (*part.shape[:-1], count)), -1, 0)

        found = jax.tree.map(first, laid(jax.tree.map(last, given, *mapped)))
        return found, jax.tree.map(lambda _: True, found)

    whole = jax.custom_jvp(lambda given: many(given))
    whole.defjvp(lambda given, rates: jax.jvp(alone, given, rates))
    return whole(arrays)
