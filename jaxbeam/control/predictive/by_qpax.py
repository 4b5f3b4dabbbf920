"""The quadratic program by qpax, a differentiable solver of others: a second mind beside our own.

Of its two algorithms the implicit one is used (Arrizabalaga et al., qpax 0.1.4). The explicit one,
its default, keeps slacks and multipliers above 1.5e-8, so that it never meets a tolerance below
that, and in large batches, where XLA's maxima pass over NaN, calls infeasible problems converged,
with NaN for a solution. Its flag is therefore not taken on trust: what it returns must be finite
and meet the conditions of optimality, too.
"""

import importlib
import importlib.util

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

QPAX_TOLERANCE = (
    1e-13  # of qpax's residuals, in the one form of `qp`; solutions are then right to 1e-9
)
MAX_STEPS = 100
OPTIMALITY_TOLERANCE = (
    1e-9  # error of the conditions of optimality with which a solution is believed
)


def is_installed() -> bool:
    """Whether the package is there."""
    return importlib.util.find_spec("qpax") is not None


def least_distance(
    G: Float[Array, "row variable"], h: Float[Array, " row"]
) -> tuple[Float[Array, " variable"], Float[Array, " row"], Bool[Array, ""], Int[Array, ""]]:
    """The z nearest to the origin with G z <= h, multipliers, whether it is proven, and steps.

    Proven is what qpax flags as converged and the conditions of optimality confirm. Raises
    ImportError, saying what to install, if qpax is missing.
    """
    if not is_installed():
        raise ImportError("qpax is not installed; install it with: pip install 'qpax>=0.1.4'")
    qpax = importlib.import_module("qpax")

    rows, variables = G.shape
    no_equalities = jnp.zeros((0, variables)), jnp.zeros(0)
    z, slack, multipliers, _, converged, steps = qpax.solve_qp(
        jnp.eye(variables),
        jnp.zeros(variables),
        *no_equalities,
        G,
        h,
        backend="i",
        solver_tol=QPAX_TOLERANCE,
        max_iter=MAX_STEPS,
    )
    stationarity, violation = z + G.T @ multipliers, jnp.maximum(G @ z - h, 0.0)
    complementarity = jnp.minimum(jnp.abs(multipliers), jnp.abs(h - G @ z))
    error = jnp.max(jnp.abs(jnp.concatenate([stationarity, violation, complementarity])))
    finite = jnp.all(jnp.isfinite(z)) & jnp.all(jnp.isfinite(multipliers))
    solved = (converged == 1) & finite & (error <= OPTIMALITY_TOLERANCE * (1 + jnp.max(jnp.abs(z))))
    return z, jnp.maximum(multipliers, 0.0), solved, steps
