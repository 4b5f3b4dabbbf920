"""Small dense quadratic programs,  min 1/2 x'H x + f'x  subject to  M x <= gamma,  H positive.

Every problem is first brought to one form: with H = L L' it asks for the point nearest to the
origin among those with G z <= h, where x = L'^-1 (unit z + z_0), z_0 is the minimiser without
limits, the rows of G have length one and the unit is the most that z_0 is beyond any limit. In it
tolerances mean the same for every problem, whatever its units.

Derivatives, forward and in reverse, are those of the conditions of optimality at the solution
(implicit differentiation), whichever method found it. There they are smoothed: slack s and
multiplier l of each limit obey s l = SMOOTHING instead of 0, in the units above. So where a limit
is neither active nor idle, and the derivative jumps, it is the mean of both sides; elsewhere the
smoothing is not felt.
"""

from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxbeam.control.predictive.by_qpax import least_distance

METHODS = ("interior", "hildreth", "qpax")
SOLVED, INFEASIBLE, UNFINISHED = range(3)
STATUS_TEXT = {
    SOLVED: "solved",
    INFEASIBLE: "no point obeys all limits",
    UNFINISHED: "not solved within the permitted number of steps",
}

TOLERANCE = 1e-12  # of limits, stationarity and complementarity
HILDRETH_TOLERANCE = 1e-13  # the same for Hildreth's procedure, whose last sweeps change little
LIMIT_ROUNDING = (
    1e-13  # share of limits and minimiser by which a limit may be passed and not be felt
)
MAX_DISTANCE = 1e8  # distance beyond which no point within the limits is looked for
SMOOTHING = 1e-18
MAX_STEPS = 100  # of the interior-point method, at most
STEPS_BEFORE_CENTRING = 20  # steps after which every other one is calm
MAX_SWEEPS = 20000  # of Hildreth's procedure
DUAL_REGULARISATION = 1e-12  # of the multipliers in a step, so that dependent rows do no harm

Rows = Float[Array, "row variable"]


class Solution(eqx.Module):
    """A solution, the multipliers of the limits, the verdict (see `STATUS_TEXT`), and the effort.

    Where the verdict is not `SOLVED`, x is not to be used. `steps` are those of the interior-point
    method or the sweeps of Hildreth's procedure, 0 if no limit is felt.
    """

    x: Float[Array, "*batch variable"]
    multipliers: Float[Array, "*batch row"]
    status: Int[Array, " *batch"]
    steps: Int[Array, " *batch"]

    @property
    def solved(self) -> Bool[Array, " *batch"]:
        """Whether x solves the problem."""
        return self.status == SOLVED


def solve_qp(
    H: Float[Array, "variable variable"],
    f: Float[Array, " variable"],
    M: Rows,
    gamma: Float[Array, " row"],
    method: str = "interior",
) -> Solution:
    """The x that minimises 1/2 x'H x + f'x subject to M x <= gamma, for a positive definite H.

    By an interior-point method, or by Hildreth's dual procedure, eqs (7.22) and (7.23) of the
    thesis, swept until it has converged, or by the package qpax (see `by_qpax`), which takes what
    is infeasible for `UNFINISHED`. Differentiable (see the module), and to be batched by `vmap`;
    never raises for what the numbers do: look at the verdict. An H that is not positive definite
    and numbers that are not finite leave it `UNFINISHED`.

    Raises ValueError for an unknown method, ImportError for qpax where it is not installed.
    """
    if method not in METHODS:
        raise ValueError(f"no method {method!r}; there are {', '.join(METHODS)}")
    x, multipliers, status, steps = _solve(method, H, f, M, gamma)
    return Solution(x, multipliers, status, steps)


class _LeastDistance(NamedTuple):
    """The problem in its one form: which z with G z <= h is nearest to the origin; see above."""

    G: Rows
    h: Float[Array, " row"]
    scale: Float[Array, ""]
    row_norms: Float[Array, " row"]
    inverse_factor: Float[Array, "variable variable"]
    unconstrained: Float[Array, " variable"]
    limits_matter: Bool[Array, ""]


def _least_distance(H, f, M, gamma) -> _LeastDistance:
    factor = jnp.linalg.cholesky(H)
    inverse_factor = jax.scipy.linalg.solve_triangular(factor, jnp.eye(H.shape[0]), lower=True)
    unconstrained = -inverse_factor @ f
    G = M @ inverse_factor.T
    row_norms = jnp.sqrt(jnp.sum(G**2, axis=1))
    row_norms = jnp.where(row_norms > 0, row_norms, 1.0)
    G = G / row_norms[:, None]
    h = gamma / row_norms - G @ unconstrained
    violation = jnp.max(-h, initial=0.0)
    magnitude = jnp.max(jnp.abs(gamma / row_norms), initial=0.0) + jnp.max(jnp.abs(unconstrained))
    limits_matter = ~(violation <= LIMIT_ROUNDING * magnitude) | ~jnp.isfinite(magnitude)
    scale = jnp.where(limits_matter, violation, 1.0)
    return _LeastDistance(
        G, h / scale, scale, row_norms, inverse_factor, unconstrained, limits_matter
    )


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solve(method, H, f, M, gamma):
    problem = _least_distance(H, f, M, gamma)
    solver = {"interior": _interior, "hildreth": _hildreth, "qpax": _by_qpax}[method]
    z, multipliers, status, steps = solver(problem.G, problem.h, problem.limits_matter)
    x = problem.inverse_factor.T @ (problem.scale * z + problem.unconstrained)
    return x, problem.scale * multipliers / problem.row_norms, status, steps


@_solve.defjvp
def _solve_jvp(method, primals, tangents):
    """Derivative of H x + f + M'l = 0 and, for each limit, s l = SMOOTHING with s = gamma - M x."""
    H, f, M, gamma = primals
    x, multipliers, status, steps = _solve(method, *primals)
    scale, row_norms, inverse_factor = (
        getattr(_least_distance(*primals), n) for n in ("unit", "length", "inverse")
    )
    # In the one form, of which the change of L is no concern: the form is frozen.
    G = M @ inverse_factor.T / row_norms[:, None]
    multiplier, slack = _smoothed_pair(
        multipliers * row_norms / scale, (gamma - M @ x) / (row_norms * scale)
    )
    H_dot, f_dot, M_dot, gamma_dot = tangents
    gradient_change = inverse_factor @ (H_dot @ x + f_dot + M_dot.T @ multipliers)
    limit_change = (gamma_dot - M_dot @ x) / row_norms
    variables = G.shape[1]
    matrix = jnp.block([[jnp.eye(variables), G.T], [multiplier[:, None] * G, -jnp.diag(slack)]])
    change = jnp.linalg.solve(
        matrix, jnp.concatenate([-gradient_change, multiplier * limit_change])
    )
    x_dot = inverse_factor.T @ change[:variables]
    changes = x_dot, change[variables:] / row_norms, _zero_tangent(status), _zero_tangent(steps)
    return (x, multipliers, status, steps), changes


def _smoothed_pair(multiplier, slack):
    """The pair with the same difference whose product is SMOOTHING, scaled to add up to one."""
    half = (multiplier - slack) / 2
    root = jnp.sqrt(half**2 + SMOOTHING)
    # The smaller of the two from the product: the difference would lose its digits.
    large = root + jnp.abs(half)
    small = SMOOTHING / large
    multiplier, slack = (jnp.where(half > 0, *pair) for pair in ((large, small), (small, large)))
    return multiplier / (large + small), slack / (large + small)


def _zero_tangent(value):
    return jnp.zeros(jnp.shape(value), jax.dtypes.float0)


def _status(tolerance, error, z, previous_multipliers, multipliers, h, G):
    """Solved, or proven to have no point, by the way in which the multipliers grow.

    A ray r >= 0 with G'r = 0 and h'r < 0 proves it (Farkas); any other shows that whatever is
    within the limits is at least -h'r / |G'r| away from the origin.
    """
    # XLA's maxima may pass over NaN, so that the error alone does not tell.
    finite = jnp.all(jnp.isfinite(z)) & jnp.all(jnp.isfinite(multipliers))
    solved = finite & (error <= tolerance * (1 + jnp.max(jnp.abs(z))))
    ray = jnp.maximum(multipliers - previous_multipliers, 0.0)
    min_certificate = MAX_DISTANCE * jnp.max(jnp.abs(G.T @ ray)) + TOLERANCE * jnp.sum(ray)
    infeasible = -(h @ ray) > min_certificate
    return jnp.where(solved, SOLVED, jnp.where(infeasible, INFEASIBLE, UNFINISHED))


def _interior(G, h, limits_matter):
    """Mehrotra's predictor-corrector method (SIAM J. Optimization 2, 1992), damped in l."""
    rows, variables = G.shape

    def optimality_errors(z, weight, slack):
        stationary, limits = z + G.T @ weight, G @ z + slack - h
        worst = jnp.maximum(jnp.max(jnp.abs(stationary)), jnp.max(jnp.abs(limits)))
        return jnp.maximum(worst, jnp.max(jnp.minimum(weight, slack))), stationary, limits

    def unfinished(state):
        *_, verdict, steps = state
        return (verdict == UNFINISHED) & (steps < MAX_STEPS)

    def step(state):
        z, weight, slack, _, steps = state
        _, stationary, limits = optimality_errors(z, weight, slack)
        scaling = 1 / (slack / weight + DUAL_REGULARISATION)
        factor = jnp.linalg.cholesky(jnp.eye(variables) + (G.T * scaling) @ G)

        def newton(product):
            rest = scaling * (limits - product / weight)
            z_change = jax.scipy.linalg.cho_solve((factor, True), -stationary - G.T @ rest)
            weight_change = rest + scaling * (G @ z_change)
            return z_change, weight_change, -(product + slack * weight_change) / weight

        gap = weight @ slack
        _, weight_change, slack_change = newton(weight * slack)
        length = _step_length(weight, weight_change, slack, slack_change, 1.0)
        affine_gap = (weight + length * weight_change) @ (slack + length * slack_change)
        centring_step = (steps > STEPS_BEFORE_CENTRING) & (steps % 2 == 0)
        centring_target = jnp.where(centring_step, 0.3, (affine_gap / gap) ** 3) * gap / rows
        # The predictor's own error counts only as far as the predictor can be followed: taken in
        # full, it makes the method cycle where limits nearly exclude each other. A calm step
        # without it ends the rare cycles that are left.
        second_order = jnp.where(centring_step, 0.0, length) * weight_change * slack_change
        z_change, weight_change, slack_change = newton(
            weight * slack + second_order - centring_target
        )
        length = _step_length(weight, weight_change, slack, slack_change, 0.995)
        z, slack = z + length * z_change, slack + length * slack_change
        next_multipliers = weight + length * weight_change
        error, *_ = optimality_errors(z, next_multipliers, slack)
        return (
            z,
            next_multipliers,
            slack,
            _status(TOLERANCE, error, z, weight, next_multipliers, h, G),
            steps + 1,
        )

    start = jnp.zeros(variables), jnp.ones(rows), jnp.maximum(h, 0.0) + 1.0
    initial_status = jnp.where(limits_matter, UNFINISHED, SOLVED), jnp.zeros((), int)
    z, weight, _, verdict, steps = jax.lax.while_loop(unfinished, step, (*start, *initial_status))
    return z, jnp.where(limits_matter, weight, 0.0), verdict, steps


def _step_length(weight, weight_change, slack, slack_change, boundary_share):
    """The step, at most 1, that takes weights and slacks this share of the way to zero."""
    worst = jnp.maximum(jnp.max(-weight_change / weight), jnp.max(-slack_change / slack))
    return jnp.where(worst > boundary_share, boundary_share / worst, 1.0)


def _hildreth(G, h, limits_matter):
    """Hildreth's procedure: one multiplier after the other is made optimal, and never negative.

    With rows of length one h_ii = 1, and w_i of eq. (7.23) is l_i + (G z - h)_i at z = -G'l.
    """
    rows, variables = G.shape

    def unfinished(state):
        *_, verdict, sweeps = state
        return (verdict == UNFINISHED) & (sweeps < MAX_SWEEPS)

    def sweep(state):
        z, weight, _, sweeps = state

        def row(i, now):
            z, weight = now
            better = jnp.maximum(0.0, weight[i] + G[i] @ z - h[i])
            return z - G[i] * (better - weight[i]), weight.at[i].set(better)

        _, after = jax.lax.fori_loop(0, rows, row, (z, weight))
        z = -G.T @ after
        slack = h - G @ z
        error = jnp.maximum(jnp.max(-slack), jnp.max(jnp.minimum(after, slack)))
        return z, after, _status(HILDRETH_TOLERANCE, error, z, weight, after, h, G), sweeps + 1

    initial_status = jnp.where(limits_matter, UNFINISHED, SOLVED), jnp.zeros((), int)
    start = jnp.zeros(variables), jnp.zeros(rows)
    return jax.lax.while_loop(unfinished, sweep, (*start, *initial_status))


def _by_qpax(G, h, limits_matter):
    z, multipliers, solved, steps = least_distance(G, h)
    verdict = jnp.where(~limits_matter | solved, SOLVED, UNFINISHED)
    z, multipliers = jnp.where(limits_matter, z, 0.0), jnp.where(limits_matter, multipliers, 0.0)
    return z, multipliers, verdict, jnp.where(limits_matter, steps, 0)
