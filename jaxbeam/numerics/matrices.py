"""Matrices of linear systems: symmetric part, exponential, and generalised eigenvalues."""

import functools
import hashlib
import weakref
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import (
    Array,
    any_jax,
    cond,
    custom_jvp,
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
