"""Quadratic programs solved by qpax, a differentiable solver independent of jaxbeam's.

Its implicit algorithm is used (Arrizabalaga et al., qpax 0.1.4). The explicit one, its default,
keeps slacks and multipliers above 1.5e-8, so that it never meets a smaller tolerance, and in large
batches, where XLA's maxima ignore NaN, its flag says converged for infeasible problems. The flag is
therefore confirmed: solutions must be finite and meet the optimality conditions.
"""

import jax.numpy as jnp
import qpax

RESIDUAL_TOLERANCE = 1e-13  # of qpax, in the least-distance form; solutions are exact to 1e-9
MAX_STEPS = 100
OPTIMALITY_TOLERANCE = 1e-9  # of the optimality conditions


def solve(H, f, M, gamma):
    """Minimiser x of 1/2 x'H x + f'x subject to M x <= gamma, and whether it is confirmed.

    Solved in the least-distance form, in which tolerances mean the same for every problem.
    """
    factor = jnp.linalg.cholesky(H)
    inverse = jnp.linalg.inv(factor)
    unconstrained = -inverse @ f
    G = M @ inverse.T
    norms = jnp.linalg.norm(G, axis=1)
    G = G / norms[:, None]
    violation = gamma / norms - G @ unconstrained
    scale = jnp.maximum(jnp.max(-violation), 0.0)
    active = scale > 0
    h = violation / jnp.where(active, scale, 1.0)
    z, solved = _least_distance(G, h)
    z = jnp.where(active, z, 0.0)
    return inverse.T @ (scale * z + unconstrained), solved | ~active


def _least_distance(G, h):
    """Point z closest to the origin with G z <= h, and whether it is confirmed."""
    variables = G.shape[1]
    no_equalities = jnp.zeros((0, variables)), jnp.zeros(0)
    z, _, multipliers, _, converged, _ = qpax.solve_qp(
        jnp.eye(variables),
        jnp.zeros(variables),
        *no_equalities,
        G,
        h,
        backend="i",
        solver_tol=RESIDUAL_TOLERANCE,
        max_iter=MAX_STEPS,
    )
    stationarity, violation = z + G.T @ multipliers, jnp.maximum(G @ z - h, 0.0)
    complementarity = jnp.minimum(jnp.abs(multipliers), jnp.abs(h - G @ z))
    error = jnp.max(jnp.abs(jnp.concatenate([stationarity, violation, complementarity])))
    finite = jnp.all(jnp.isfinite(z)) & jnp.all(jnp.isfinite(multipliers))
    optimal = error <= OPTIMALITY_TOLERANCE * (1 + jnp.max(jnp.abs(z)))
    return z, (converged == 1) & finite & optimal
