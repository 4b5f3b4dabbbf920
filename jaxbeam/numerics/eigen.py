"""The eigenvalue problem of the modes, with derivatives that hold at repeated eigenvalues too."""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

REPEATED_EIGENVALUE_TOLERANCE = 1e-6  # relative: closer modes are treated as a repeated one
RIGID_BODY_EIGENVALUE = (
    1e-10  # in beam units: lower eigenvalues are those of rigid-body modes, zero
)


@jax.custom_jvp
def eigen(stiffness, mass):
    """Solve K x = lambda M x: ascending values, mass-normalised vectors, zero coupling.

    Vectors of (nearly) repeated values have no derivative of their own. Their tangents leave the
    vectors unrotated and appear in the third result instead, the off-diagonal part of X' K X,
    which is zero but has a derivative; whoever uses it gets exact derivatives of the response.
    """
    factor = jnp.linalg.cholesky(stiffness + mass)  # the shift lifts rigid-body modes off zero
    mass_half_solved = solve_triangular(factor, mass, lower=True)
    flexibility = solve_triangular(factor, mass_half_solved.T, lower=True)
    inverse, vectors = jnp.linalg.eigh((flexibility + flexibility.T) / 2)
    vectors = solve_triangular(factor.T, vectors[:, ::-1], lower=False)
    inverse = jnp.maximum(inverse[::-1], jnp.finfo(inverse.dtype).tiny)
    vectors = vectors / jnp.sqrt(jnp.sum(vectors * (mass @ vectors), axis=0))
    # The quotient is right to the square of the error of the vector.
    values = jnp.sum(vectors * (stiffness @ vectors), axis=0)
    values = jnp.where(values > RIGID_BODY_EIGENVALUE, values, 0.0)
    return values, vectors, jnp.zeros_like(mass)


@eigen.defjvp
def _eigen_jvp(primals, tangents):
    values, vectors, coupling = eigen(*primals)
    stiffness, mass = (vectors.T @ tangent @ vectors for tangent in tangents)
    gap = values[None, :] - values[:, None]
    repeated = jnp.abs(gap) <= REPEATED_EIGENVALUE_TOLERANCE * (
        1 + values[None, :] + values[:, None]
    )
    rotation = (stiffness - values[None, :] * mass) / jnp.where(repeated, 1.0, gap)
    rotation = jnp.where(repeated, -mass / 2, rotation)
    coupling_tangent = stiffness - (values[None, :] + values[:, None]) / 2 * mass
    # Zero, but a second derivative sees how the coupling changes.
    rotated_coupling = rotation.T @ coupling + coupling @ rotation
    rotation = rotation + jnp.where(repeated, 0.0, rotated_coupling / jnp.where(repeated, 1.0, gap))
    coupling_tangent = coupling_tangent + rotated_coupling
    diagonal = jnp.diag(coupling_tangent)
    coupling_tangent = jnp.where(repeated, coupling_tangent, 0.0) - jnp.diag(diagonal)
    return (values, vectors, coupling), (diagonal, vectors @ rotation, coupling_tangent)
