"""Linear algebra: matrices of linear systems, and many small matrices at once, batch axis last.

Of single matrices there are the symmetric part, the exponential and generalised eigenvalues.
Products and eliminations are unrolled, without pivoting: at these sizes a call of a library takes
longer than the arithmetic, and longer to compile.
"""

import functools
import hashlib
import weakref
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import (
    Array,
    any_jax,
    cond,
    custom_jvp,
    fori_loop,
    scan,
    solve,
    solve_triangular,
    stop_gradient,
    xp,
)

Square = Float[Array, "state state"]
InputMatrix = Float[Array, "state input"]
InputWeight = Float[Array, "input input"]
MAX_NORM = 5.37  # of a matrix whose exponential is its Pade approximant (13, 13), in doubles
MAX_SQUARINGS = 40
PADE = np.array(
    [
        64764752532480000,
        32382376266240000,
        7771770303897600,
        1187353796428800,
        129060195264000,
        10559470521600,
        670442572800,
        33522128640,
        1323241920,
        40840800,
        960960,
        16380,
        182,
        1,
    ],
    float,
)  # coefficients of its numerator, from the constant on


def symmetric_part(
    matrix: Float[Array, "*batch state state"],
) -> Float[Array, "*batch state state"]:
    """Symmetric part of a matrix, which removes rounding from one that is symmetric."""
    return (matrix + matrix.mT) / 2


def expm(matrix: Square) -> Square:
    """Exponential of a matrix by scaling, its Pade approximant (13, 13), and squaring.

    Higham, SIAM J. Matrix Anal. Appl. 26 (2005). The scaling of JAX (0.10 to 0.12) leaves a norm of
    up to twice the bound of the approximant: errors of 1e-8 where it should be 1e-15. That of scipy
    takes 0.1 s to import.
    """
    norm_of_columns = stop_gradient(xp.max(xp.sum(xp.abs(matrix), axis=0)))
    squarings = xp.ceil(xp.log2(xp.maximum(norm_of_columns / MAX_NORM, 1.0)))
    scaled = matrix / 2**squarings
    second = scaled @ scaled
    fourth = second @ second
    powers = xp.stack([np.eye(len(matrix)), second, fourth, fourth @ second])

    def polynomial(terms):
        low = xp.tensordot(terms[:4], powers, 1)
        return low + powers[3] @ xp.tensordot(terms[4:], powers[1:4], 1)

    half_even, half_odd = polynomial(PADE[::2]), scaled @ polynomial(PADE[1::2])
    root = solve(half_even - half_odd, half_even + half_odd)

    def square(root, step):
        return cond(step < squarings, lambda r: r @ r, lambda r: r, root), None

    return scan(square, root, np.arange(MAX_SQUARINGS))[0]


REPEATED_EIGENVALUE_TOLERANCE = 1e-6  # relative: closer eigenvalues are treated as repeated
MASSLESS = 1e-20  # fraction of the mass in a vector, below which that is rounding
RIGID_BODY_EIGENVALUE = 1e-10  # in beam units: eigenvalues below are zero, of rigid-body modes


@custom_jvp
def eigen(stiffness, mass):
    """Ascending eigenvalues and mass-normalised eigenvectors X of K x = lambda M x, and coupling.

    Vectors of (nearly) repeated values have no derivative of their own: their tangents do not
    rotate them. The coupling, the off-diagonal part of X' K X, is zero and carries the derivative
    instead; a model that includes it has exact derivatives of its response.
    """
    if any_jax(stiffness, mass):
        return _solution(stiffness, mass)
    stiffness, mass = (np.ascontiguousarray(matrix) for matrix in (stiffness, mass))
    return _cached_solution(_MatrixKey(stiffness), _MatrixKey(mass))


class _MatrixKey:
    """Key of a cache for a concrete matrix, to which it holds a weak reference."""

    def __init__(self, matrix: np.ndarray):
        self.reference = weakref.ref(matrix)
        self.content = matrix.dtype.str, matrix.shape, hashlib.sha256(matrix).digest()

    def __hash__(self) -> int:
        return hash(self.content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _MatrixKey) and self.content == other.content


@functools.lru_cache(maxsize=2)  # a run asks some five times for the modes of one beam
def _cached_solution(stiffness: _MatrixKey, mass: _MatrixKey) -> tuple[Any, ...]:
    """`eigen` of concrete matrices, cached; read-only arrays."""
    parts = _solution(stiffness.reference(), mass.reference())
    for part in parts:
        part.setflags(write=False)
    return parts


def _solution(stiffness, mass):
    """`eigen` without its derivative."""
    factor = xp.linalg.cholesky(stiffness + mass)  # shifted: rigid-body modes are not singular
    inverse, vectors = xp.linalg.eigh(_flexibility(factor, mass))
    vectors = solve_triangular(factor.T, vectors[:, ::-1], lower=False)
    inverse = xp.maximum(inverse[::-1], xp.finfo(inverse.dtype).tiny)
    squares = xp.sum(vectors * (mass @ vectors), axis=0)
    # Vectors without mass, of infinite frequency, stay finite; of the others nothing changes.
    vectors = vectors / xp.sqrt(xp.maximum(squares, MASSLESS))
    # The error of Rayleigh's quotient is that of the vector squared.
    values = xp.sum(vectors * (stiffness @ vectors), axis=0)
    values = xp.where(values > RIGID_BODY_EIGENVALUE, values, 0.0)
    return values, vectors, xp.broadcast_to(xp.zeros((), mass.dtype), mass.shape)


def _flexibility(factor, mass):
    """L^-1 M L^-T of the factor L: symmetric, with the eigenvalues 1 / (1 + lambda)."""
    half = solve_triangular(factor, mass, lower=True)
    flexibility = solve_triangular(factor, half.T, lower=True)
    return (flexibility + flexibility.T) / 2


@eigen.defjvp
def _eigen_jvp(primals, tangents):
    values, vectors, coupling = eigen(*primals)
    stiffness, mass = (vectors.T @ tangent @ vectors for tangent in tangents)
    gap = values[None, :] - values[:, None]
    repeated = xp.abs(gap) <= REPEATED_EIGENVALUE_TOLERANCE * (
        1 + values[None, :] + values[:, None]
    )
    rotation = (stiffness - values[None, :] * mass) / xp.where(repeated, 1.0, gap)
    rotation = xp.where(repeated, -mass / 2, rotation)
    coupling_tangent = stiffness - (values[None, :] + values[:, None]) / 2 * mass
    # Zero, but with a derivative, which second derivatives need.
    rotated_coupling = rotation.T @ coupling + coupling @ rotation
    rotation = rotation + xp.where(repeated, 0.0, rotated_coupling / xp.where(repeated, 1.0, gap))
    coupling_tangent = coupling_tangent + rotated_coupling
    diagonal = xp.diag(coupling_tangent)
    coupling_tangent = xp.where(repeated, coupling_tangent, 0.0) - xp.diag(diagonal)
    return (values, vectors, coupling), (diagonal, vectors @ rotation, coupling_tangent)


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
