"""Generalised symmetric eigenvalue problem, with derivatives valid at repeated eigenvalues too."""

import functools
import hashlib
import weakref
from typing import Any

import numpy as np

from jaxbeam.runtime.arrays import any_jax, custom_jvp, solve_triangular, xp

REPEATED_EIGENVALUE_TOLERANCE = 1e-6  # relative: closer eigenvalues are treated as repeated
MASSLESS = 1e-20  # share of the mass in a vector: of less, there is only rounding
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
    return _known_solution(_Known(stiffness), _Known(mass))


class _Known:
    """A matrix of known numbers that has a hash, and is not kept longer than by others."""

    def __init__(self, matrix: np.ndarray):
        self.reference = weakref.ref(matrix)
        self.content = matrix.dtype.str, matrix.shape, hashlib.sha256(matrix).digest()

    def __hash__(self) -> int:
        return hash(self.content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Known) and self.content == other.content


@functools.lru_cache(maxsize=2)  # a run asks some five times for the modes of one beam
def _known_solution(stiffness: _Known, mass: _Known) -> tuple[Any, ...]:
    """`eigen` of known numbers; read-only arrays."""
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
