"""The eigenvalue problem of the modes, with derivatives that hold at repeated eigenvalues too."""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

SAME_EIGENVALUE = 1e-6  # relative: closer modes are treated as a repeated one
RIGID_BODY = 1e-10  # in beam units: lower eigenvalues are those of rigid-body modes, zero


@jax.custom_jvp
def eigen(stiffness, mass):
    """Solve K x = lambda M x: ascending values, mass-normalised vectors, zero coupling.

    Vectors of (nearly) repeated values have no derivative of their own. Their tangents leave the
    vectors unrotated and appear in the third result instead, the off-diagonal part of X' K X,
    which is zero but has a derivative; whoever uses it gets exact derivatives of the response.
    """
    factor = jnp.linalg.cholesky(stiffness + mass)  # the shift lifts rigid-body modes off zero
    half = solve_triangular(factor, mass, lower=True)
    flexibility = solve_triangular(factor, half.T, lower=True)
    inverse, vectors = jnp.linalg.eigh((flexibility + flexibility.T) / 2)
    vectors = solve_triangular(factor.T, vectors[:, ::-1], lower=False)
    inverse = jnp.maximum(inverse[::-1], jnp.finfo(inverse.dtype).tiny)
    vectors = vectors / jnp.sqrt(jnp.sum(vectors * (mass @ vectors), axis=0))
    # The quotient is right to the square of the error of the vector.
    values = jnp.sum(vectors * (stiffness @ vectors), axis=0)
    values = jnp.where(values > RIGID_BODY, values, 0.0)
    return values, vectors, jnp.zeros_like(mass)


@eigen.defjvp
def _eigen_jvp(primals, tangents):
    values, vectors, none = eigen(*primals)
    stiffness, mass = (vectors.T @ tangent @ vectors for tangent in tangents)
    gap = values[None, :] - values[:, None]
    near = jnp.abs(gap) <= SAME_EIGENVALUE * (1 + values[None, :] + values[:, None])
    turn = (stiffness - values[None, :] * mass) / jnp.where(near, 1.0, gap)
    turn = jnp.where(near, -mass / 2, turn)
    couple = stiffness - (values[None, :] + values[:, None]) / 2 * mass
    # Zero, but a second derivative sees how the coupling changes.
    twist = turn.T @ none + none @ turn
    turn = turn + jnp.where(near, 0.0, twist / jnp.where(near, 1.0, gap))
    couple = couple + twist
    diagonal = jnp.diag(couple)
    couple = jnp.where(near, couple, 0.0) - jnp.diag(diagonal)
    return (values, vectors, none), (diagonal, vectors @ turn, couple)
