"""Factorisations of traced matrices: under `vmap` on a CPU, one call of LAPACK for each matrix.

jaxlib hands the parts of a batch to the threads that wait for it: on few threads two calls of
batches wait for each other for ever. So no batch reaches LAPACK here. Small systems of a batch are
eliminated together, the rest is a loop; other devices take batches. Derivatives are those of the
equations, in both modes, never those of a factorisation. `xp.linalg` calls these functions for
traced numbers, and their arguments are those of `jax.numpy.linalg`.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

MAX_ELIMINATED_ROWS = 16  # of systems that a batch eliminates together


def _one_matrix_per_call(function: Callable) -> Callable:
    """The function of arrays, which under `vmap` on a CPU is called in a loop."""
    single = jax.custom_batching.custom_vmap(function)

    @single.def_vmap
    def _(_, batched, *args):
        if jax.default_backend() != "cpu":
            axes = [0 if has else None for has in batched]
            result = jax.vmap(function, axes)(*args)
        else:
            shared = [None if has else part for has, part in zip(batched, args, strict=True)]
            mapped = [part for has, part in zip(batched, args, strict=True) if has]

            def element(own):
                own = iter(own)
                return single(*(next(own) if part is None else part for part in shared))

            result = jax.lax.map(element, mapped)
        return result, jax.tree.map(lambda _: True, result)

    def stacked(*args):
        args = [jnp.asarray(part) for part in args]
        stack = args[0].shape[:-2]
        if not stack:
            return single(*args)
        flat = [part.reshape(-1, *part.shape[len(stack) :]) for part in args]
        result = jax.vmap(single)(*flat)
        return jax.tree.map(lambda part: part.reshape(*stack, *part.shape[1:]), result)

    return functools.wraps(function)(stacked)


@jax.custom_batching.custom_vmap
def _solve(matrix, right):
    """Solutions (row, column) for one matrix."""
    return jnp.linalg.solve(matrix, right)


@_solve.def_vmap
def _(count, batched, matrix, right):
    if not batched[0]:  # one factorisation for the columns of all
        rows, columns = right.shape[1:]
        together = jnp.moveaxis(right, 0, 1).reshape(rows, count * columns)
        solution = _solve(matrix, together).reshape(rows, count, columns)
        return jnp.moveaxis(solution, 1, 0), True
    if matrix.shape[-1] <= MAX_ELIMINATED_ROWS:
        right = right if batched[1] else jnp.broadcast_to(right, (count, *right.shape))
        together = jnp.moveaxis(jnp.concatenate([matrix, right], axis=2), 0, -1)
        return jnp.moveaxis(_eliminate(together), -1, 0), True
    if jax.default_backend() != "cpu":
        return jax.vmap(jnp.linalg.solve, (0, 0 if batched[1] else None))(matrix, right), True
    if batched[1]:
        return jax.lax.map(lambda system: _solve(*system), (matrix, right)), True
    return jax.lax.map(lambda own: _solve(own, right), matrix), True


@jax.custom_batching.custom_vmap
def _eliminate(augmented):
    """Solutions (row, column, *batch) by Gauss-Jordan elimination with pivots by row."""
    size = augmented.shape[0]
    rows = jnp.arange(size).reshape(-1, *[1] * (augmented.ndim - 1))

    def step(k, augmented):
        column = jax.lax.dynamic_index_in_dim(augmented, k, 1)
        candidates = jnp.where(rows >= k, jnp.abs(column), -1.0)
        pivot_row = jnp.argmax(candidates, axis=0, keepdims=True)
        pivot = jnp.take_along_axis(augmented, pivot_row, axis=0)
        top = jax.lax.dynamic_index_in_dim(augmented, k, 0)
        swapped = jnp.where(rows == pivot_row, top, augmented)
        pivot = pivot / jax.lax.dynamic_index_in_dim(pivot, k, 1)
        column = jax.lax.dynamic_index_in_dim(swapped, k, 1)
        return jnp.where(rows == k, pivot, swapped - column * pivot)

    return jax.lax.fori_loop(0, size, step, augmented)[:, size:]


@_eliminate.def_vmap
def _(_, __, augmented):
    return jnp.moveaxis(_eliminate(jnp.moveaxis(augmented, 0, -1)), -1, 0), True


def solve(matrix, right) -> Any:
    """Solutions of systems (..., row, column), or of one system (row,)."""
    matrix, right = jnp.asarray(matrix), jnp.asarray(right)
    if right.ndim == 1:
        return solve(matrix, right[:, None])[..., 0]
    stack = jnp.broadcast_shapes(matrix.shape[:-2], right.shape[:-2])
    if stack:
        systems = (
            jnp.broadcast_to(part, (*stack, *part.shape[-2:])).reshape(-1, *part.shape[-2:])
            for part in (matrix, right)
        )
        solutions = jax.vmap(solve)(*systems)
        return solutions.reshape(*stack, *solutions.shape[-2:])
    dtype = jnp.result_type(matrix, right, float)
    matrix, right = matrix.astype(dtype), right.astype(dtype)
    return jax.lax.custom_linear_solve(
        lambda x: matrix @ x,
        right,
        lambda _, b: _solve(matrix, b),
        lambda _, b: _solve(matrix.T, b),
    )


def inv(matrix) -> Any:
    """Inverses of matrices (..., row, row)."""
    return solve(matrix, jnp.eye(matrix.shape[-1]))


@jax.custom_jvp
def inverses(matrix) -> Any:
    """Inverses of well-conditioned matrices (..., row, row), whose derivatives are products."""
    size = matrix.shape[-1]
    if size > MAX_ELIMINATED_ROWS:
        return solve(matrix, jnp.eye(size))
    identity = jnp.broadcast_to(jnp.eye(size), matrix.shape)
    augmented = jnp.moveaxis(jnp.concatenate([matrix, identity], axis=-1), (-2, -1), (0, 1))
    return jnp.moveaxis(_eliminate(augmented), (0, 1), (-2, -1))


@inverses.defjvp
def _(primals, tangents):
    inverse = inverses(*primals)
    return inverse, -inverse @ tangents[0] @ inverse


def solve_triangular(matrix, right, lower: bool, transposed: bool = False) -> Any:
    """Solution of a triangular system (row, column) or (row,), or of that of the transpose.

    Batches are solved by XLA itself, without LAPACK.
    """
    return jax.scipy.linalg.solve_triangular(matrix, right, transposed, lower=lower)


@_one_matrix_per_call
def _tridiagonal(bands, right):
    lower, diagonal, upper = bands
    return jax.lax.linalg.tridiagonal_solve(lower, diagonal, upper, right[:, None])[:, 0]


def solve_tridiagonal(lower, diagonal, upper, right) -> Any:
    """Solution of a tridiagonal system (n,), with n - 1 entries below and above the diagonal."""
    lower, diagonal, upper, right = (
        jnp.asarray(part, float) for part in (lower, diagonal, upper, right)
    )

    def product(x):
        below, above = jnp.append(0.0, lower * x[:-1]), jnp.append(upper * x[1:], 0.0)
        return below + diagonal * x + above

    def solution(below, above, b):
        return _tridiagonal(jnp.stack([jnp.append(0.0, below), diagonal, jnp.append(above, 0)]), b)

    return jax.lax.custom_linear_solve(
        product,
        right,
        lambda _, b: solution(lower, upper, b),
        lambda _, b: solution(upper, lower, b),
    )


@_one_matrix_per_call
def _cholesky(matrix):
    return jnp.linalg.cholesky(matrix, symmetrize_input=False)


@jax.custom_jvp
def cholesky(matrix) -> Any:
    """Lower triangular factor of a symmetric matrix; nan where it is not positive definite."""
    return _cholesky((matrix + jnp.swapaxes(matrix, -1, -2)) / 2)


@cholesky.defjvp
def _(primals, tangents):
    factor = cholesky(*primals)
    (tangent,) = tangents
    half_solved = solve_triangular(factor, (tangent + jnp.swapaxes(tangent, -1, -2)) / 2, True)
    solved = solve_triangular(factor, jnp.swapaxes(half_solved, -1, -2), True)
    share = jnp.tril(jnp.ones(factor.shape[-2:])) - jnp.eye(factor.shape[-1]) / 2
    return factor, factor @ (share * solved)


@_one_matrix_per_call
def _eigh(matrix):
    return tuple(jnp.linalg.eigh(matrix, symmetrize_input=False))


@jax.custom_jvp
def eigh(matrix) -> Any:
    """Ascending eigenvalues and vectors of a symmetric matrix; vectors of distinct values."""
    return _eigh((matrix + jnp.swapaxes(matrix, -1, -2)) / 2)


@eigh.defjvp
def _(primals, tangents):
    values, vectors = eigh(*primals)
    (tangent,) = tangents
    rotated = vectors.mT @ ((tangent + tangent.mT) / 2) @ vectors
    gap = values[..., None, :] - values[..., :, None]
    rotation = jnp.where(gap == 0, 0.0, rotated / jnp.where(gap == 0, 1.0, gap))
    diagonal = jnp.diagonal(rotated, axis1=-2, axis2=-1)
    return (values, vectors), (diagonal, vectors @ rotation)


def eigvalsh(matrix) -> Any:
    """Ascending eigenvalues of a symmetric matrix."""
    return eigh(matrix)[0]


@_one_matrix_per_call
def eig(matrix) -> Any:
    """Eigenvalues and vectors of a matrix, without derivatives."""
    return tuple(jnp.linalg.eig(matrix))


@_one_matrix_per_call
def _svd(matrix):
    return tuple(jnp.linalg.svd(matrix, full_matrices=False))


@jax.custom_jvp
def _singular_values(matrix):
    return _svd(matrix)[1]


@_singular_values.defjvp
def _(primals, tangents):
    left, values, right = _svd(*primals)
    return values, jnp.einsum("...ik,...ij,...kj->...k", left, tangents[0], right)


def svd(matrix, full_matrices: bool = True, compute_uv: bool = True) -> Any:
    """Singular values of a matrix, descending.

    Raises NotImplementedError if its vectors are wanted: they have no derivative here.
    """
    if compute_uv:
        raise NotImplementedError("singular vectors of traced matrices have no derivative here")
    return _singular_values(matrix)


@_one_matrix_per_call
def _pinv(matrix):
    return jnp.linalg.pinv(matrix)


@jax.custom_jvp
def pinv(matrix) -> Any:
    """Pseudo-inverse of a matrix, whose derivative is that at constant rank."""
    return _pinv(matrix)


@pinv.defjvp
def _(primals, tangents):
    (matrix,), (tangent,) = primals, tangents
    inverse = pinv(matrix)
    rows, columns = (jnp.eye(size) for size in matrix.shape[-2:])
    tangent_of_inverse = (
        -inverse @ tangent @ inverse
        + inverse @ inverse.mT @ tangent.mT @ (rows - matrix @ inverse)
        + (columns - inverse @ matrix) @ tangent.mT @ inverse.mT @ inverse
    )
    return inverse, tangent_of_inverse


def lstsq(matrix, right) -> Any:
    """Least-squares solution of least norm (row,) first, as in `jax.numpy.linalg`."""
    return (pinv(matrix) @ right,)


@jax.custom_jvp
def slogdet(matrix) -> Any:
    """Sign and logarithm of the determinant of a matrix."""
    return _slogdet(matrix)


@_one_matrix_per_call
def _slogdet(matrix):
    return tuple(jnp.linalg.slogdet(matrix))


@slogdet.defjvp
def _(primals, tangents):
    sign, logarithm = slogdet(*primals)
    rate = jnp.trace(solve(primals[0], tangents[0]), axis1=-2, axis2=-1)
    return (sign, logarithm), (jnp.zeros_like(sign), rate)


def norm(*args, **kwargs) -> Any:
    """`jax.numpy.linalg.norm` of vectors and Frobenius norms, which need no factorisation."""
    return jnp.linalg.norm(*args, **kwargs)
