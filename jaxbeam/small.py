"""Small linear systems, many at a time, spelt out.

A library's factorisation would seek pivots in each of them; that takes longer, to compile as well.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


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
