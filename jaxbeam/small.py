"""Small linear systems, many at a time, spelt out.

A library's factorisation would seek pivots in each of them; that takes longer, to compile as well.
"""

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
