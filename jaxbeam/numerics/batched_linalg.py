"""Linear algebra of many small matrices at once, batch axis last.

Products and eliminations are unrolled, without pivoting: at these sizes a call of a library takes
longer than the arithmetic, and longer to compile.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, any_jax, fori_loop, xp

MAX_UNROLLED_TERMS = 12  # of a sum that takes as long as the call of a library for the product


def solve_small(
    matrix: Float[Array, "row row batch"], right: Float[Array, "row column batch"]
) -> Float[Array, "row column batch"]:
    """Solutions of systems by block elimination in halves: few operations on the whole batch.

    For matrices that need no pivoting: positive definite ones, or the identity plus masses times a
    positive definite one. Linear in the right side, so that it can be transposed.
    """
    if matrix.shape[0] == 0:
        return right
    return _block_eliminate(matrix, right)[0] if any_jax(matrix, right) else _solve(matrix, right)


def _solve(matrix, right):
    """Solutions of systems of concrete numbers by NumPy, batch axis last."""
    batch_first = (np.moveaxis(part, -1, 0) for part in (matrix, right))
    return np.moveaxis(np.linalg.solve(*batch_first), 0, -1)


def _block_eliminate(matrix, *rights):
    """Solutions for several right sides by block elimination, batch axis last."""
    size = matrix.shape[0]
    if size <= 3:
        inverse = _cofactor_inverse(matrix)
        return tuple(_unrolled_matmul(inverse, right) for right in rights)
    half = size // 2
    upper_right_sides = [matrix[:half, half:], *(right[:half] for right in rights)]
    upper_coupling, *upper_solutions = _block_eliminate(matrix[:half, :half], *upper_right_sides)
    lower_coupling = matrix[half:, :half]
    lower_right_sides = [
        right[half:] - _unrolled_matmul(lower_coupling, top)
        for right, top in zip(rights, upper_solutions, strict=True)
    ]
    lower_solutions = _block_eliminate(
        matrix[half:, half:] - _unrolled_matmul(lower_coupling, upper_coupling), *lower_right_sides
    )
    pairs = zip(upper_solutions, lower_solutions, strict=True)
    return tuple(
        xp.concatenate([top - _unrolled_matmul(upper_coupling, end), end]) for top, end in pairs
    )


def _unrolled_matmul(a, b):
    """Product (row, column, batch) of small matrices as an unrolled sum."""
    return sum(a[:, k, None] * b[k] for k in range(1, b.shape[0])) + a[:, 0, None] * b[0]


def _cofactor_inverse(matrix):
    """Inverse of matrices of up to three rows, by cofactors."""
    size = matrix.shape[0]
    if size == 1:
        return 1 / matrix
    if size == 2:
        (a, b), (c, d) = matrix
        return xp.stack([xp.stack([d, -b]), xp.stack([-c, a])]) / (a * d - b * c)
    minors = [
        [
            matrix[i - 2, j - 2] * matrix[i - 1, j - 1]
            - matrix[i - 2, j - 1] * matrix[i - 1, j - 2]
            for i in range(3)
        ]
        for j in range(3)
    ]
    adjugate = xp.stack([xp.stack(row) for row in minors])
    return adjugate / xp.sum(matrix[0] * adjugate[:, 0], axis=0)


def matvec(
    matrix: Float[Array, "row column"], vectors: Float[Array, "column batch"]
) -> Float[Array, "row batch"]:
    """Product of one matrix with a batch of vectors, unrolled where the sums are short."""
    if not (0 < vectors.shape[0] <= MAX_UNROLLED_TERMS and any_jax(matrix, vectors)):
        return matrix @ vectors
    return _unrolled_matmul(matrix[..., None], vectors[:, None])[:, 0]


def solve_unpivoted(
    matrix: Float[Array, "row row"], right: Float[Array, "row column"]
) -> Float[Array, "row column"]:
    """Solution of a system of any size without pivoting; under `vmap` the batch axis is last.

    By a loop, which compiles quickly for larger matrices too, unlike `solve_small`. LAPACK's
    factorisations of batches may deadlock where several run at the same time: jaxlib hands parts of
    a batch to the threads that wait for it.
    """
    if not any_jax(matrix, right):
        return xp.linalg.solve(matrix, right)
    return jax.lax.custom_linear_solve(
        lambda x: matrix @ x,
        right,
        lambda _, b: _gauss_jordan(matrix, b),
        lambda _, b: _gauss_jordan(matrix.T, b),
    )


def solve_each(
    matrix: Float[Array, "row row batch"], right: Float[Array, "row column batch"]
) -> Float[Array, "batch row column"]:
    """`solve_unpivoted` of each system of a batch; the batch axis of the solutions is the first."""
    if not any_jax(matrix, right):
        return np.moveaxis(_solve(matrix, right), -1, 0)
    return jax.vmap(solve_unpivoted, -1)(matrix, right)


@jax.custom_batching.custom_vmap
def _gauss_jordan(matrix, right):
    """Solutions of systems (row, column, *batch) by Gauss-Jordan elimination."""
    size = matrix.shape[0]
    rows = np.arange(size).reshape(-1, *[1] * (matrix.ndim - 1))

    def step(k, augmented_matrix):
        row = jax.lax.dynamic_index_in_dim(augmented_matrix, k, 0, keepdims=False)
        row = row / jax.lax.dynamic_index_in_dim(row, k, 0)
        column = jax.lax.dynamic_index_in_dim(augmented_matrix, k, 1)
        return xp.where(rows == k, row, augmented_matrix - column * row)

    augmented_matrix = xp.concatenate([matrix, right], axis=1)
    return fori_loop(0, size, step, augmented_matrix)[:, size:]


@_gauss_jordan.def_vmap
def _(count, batched, *systems):
    systems = [
        xp.moveaxis(part, 0, -1) if has else xp.broadcast_to(part[..., None], (*part.shape, count))
        for part, has in zip(systems, batched, strict=True)
    ]
    return xp.moveaxis(_gauss_jordan(*systems), -1, 0), True


def matmul(
    a: Float[Array, "row term _"], b: Float[Array, "term column _"]
) -> Float[Array, "row column batch"]:
    """Products of matrices, unrolled where the sums are short, else by a library."""
    if a.shape[2] == 1:
        return xp.tensordot(a[..., 0], b, 1)
    if b.shape[2] == 1:
        return xp.moveaxis(xp.tensordot(a, b[..., 0], ((1,), (0,))), -1, 1)
    return (
        _unrolled_matmul(a, b)
        if b.shape[0] <= MAX_UNROLLED_TERMS
        else xp.einsum("ik...,kj...->ij...", a, b)
    )


def transpose(matrix: Float[Array, "row column batch"]) -> Float[Array, "column row batch"]:
    """Transposes of matrices."""
    return xp.swapaxes(matrix, 0, 1)


def hstack(*parts: Float[Array, "row _ _"]) -> Float[Array, "row column batch"]:
    """Matrices with equal rows, concatenated along the columns."""
    batch_size = batch_size_of(parts)
    return xp.concatenate(
        [xp.broadcast_to(part, (*part.shape[:2], batch_size)) for part in parts], axis=1
    )


def solve_batch(
    matrix: Float[Array, "row row _"], right: Float[Array, "row column _"]
) -> Float[Array, "row column batch"]:
    """`solve_unpivoted` of a batch, batch axis last."""
    batch_size = batch_size_of(matrix, right)
    matrix, right = (xp.broadcast_to(x, (*x.shape[:2], batch_size)) for x in (matrix, right))
    if not any_jax(matrix, right):
        return _solve(matrix, right)
    return jax.lax.custom_linear_solve(
        lambda x: _unrolled_matmul(matrix, x),
        right,
        lambda _, b: _gauss_jordan(matrix, b),
        lambda _, b: _gauss_jordan(transpose(matrix), b),
    )


def batch_size_of(*args: Any) -> int:
    """Length of the batch axis, the last of all arrays; shared ones have length one."""
    return max(part.shape[-1] for part in jax.tree.leaves(eqx.filter(args, eqx.is_array)))


def vmap_last_axis(function: Callable, *args: Any) -> Any:
    """Map a function over the last axis of all arrays in its arguments; results get it last too.

    Arrays whose last axis has length one are shared.
    """
    arrays, rest = eqx.partition(args, eqx.is_array)
    leaves, structure = jax.tree.flatten(arrays)
    axes = [None if leaf.shape[-1] == 1 else -1 for leaf in leaves]
    unbatched = [
        leaf[..., 0] if axis is None else leaf for leaf, axis in zip(leaves, axes, strict=True)
    ]

    def unbatched_function(*given):
        return function(*eqx.combine(jax.tree.unflatten(structure, given), rest))

    if set(axes) <= {None}:
        return jax.tree.map(lambda part: part[..., None], unbatched_function(*unbatched))
    return jax.vmap(unbatched_function, axes, -1)(*unbatched)


def batch_axis_last(function: Callable, *args: Any) -> Any:
    """Call a function of arrays (..., batch) with unbatched arrays.

    Under `vmap` the mapped axis becomes the batch axis, so that the inner loops run over the batch,
    which is longer than the matrices. Derivatives are those of a batch of one, mapped.
    """
    arrays, rest = eqx.partition(args, eqx.is_array)
    arrays = jax.tree.map(jnp.asarray, arrays)  # custom_vmap takes no constants of NumPy

    def call(batched):
        return function(*eqx.combine(batched, rest))

    def unbatched_function(given):
        result = call(jax.tree.map(lambda part: part[..., None], given))
        return jax.tree.map(lambda part: part[..., 0], result)

    mapped_function = jax.custom_batching.custom_vmap(unbatched_function)

    @mapped_function.def_vmap
    def _(count, mapped, given):
        def to_last(part, is_mapped):
            return xp.moveaxis(part, 0, -1) if is_mapped else part[..., None]

        def to_first(part):
            return xp.moveaxis(xp.broadcast_to(part, (*part.shape[:-1], count)), -1, 0)

        result = jax.tree.map(to_first, call(jax.tree.map(to_last, given, *mapped)))
        return result, jax.tree.map(lambda _: True, result)

    differentiable_function = jax.custom_jvp(lambda given: mapped_function(given))
    differentiable_function.defjvp(lambda given, rates: jax.jvp(unbatched_function, given, rates))
    return differentiable_function(arrays)
