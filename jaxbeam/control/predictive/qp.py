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

from jaxbeam.control.predictive.by_qpax import nearest

METHODS = ("interior", "hildreth", "qpax")
SOLVED, INFEASIBLE, UNFINISHED = range(3)
WORDS = {
    SOLVED: "solved",
    INFEASIBLE: "no point obeys all limits",
    UNFINISHED: "not solved within the permitted number of steps",
}

TOLERANCE = 1e-12  # of limits, stationarity and complementarity
CREEP = 1e-13  # the same for Hildreth's procedure, whose last sweeps change little
ROUNDING = 1e-13  # share of limits and minimiser by which a limit may be passed and not be felt
FARTHEST = 1e8  # distance beyond which no point within the limits is looked for
SMOOTHING = 1e-18
STEPS = 100  # of the interior-point method, at most
PATIENCE = 20  # steps after which every other one is calm
SWEEPS = 20000  # of Hildreth's procedure
DAMPING = 1e-12  # of the multipliers in a step, so that dependent rows do no harm

Rows = Float[Array, "row variable"]


class Solution(eqx.Module):
    """A solution, the multipliers of the limits, the verdict (see `WORDS`), and the effort.

    Where the verdict is not `SOLVED`, x is not to be used. `steps` are those of the interior-point
    method or the sweeps of Hildreth's procedure, 0 if no limit is felt.
    """

    x: Float[Array, "*batch variable"]
    multipliers: Float[Array, "*batch row"]
    verdict: Int[Array, " *batch"]
    steps: Int[Array, " *batch"]

    @property
    def solved(self) -> Bool[Array, " *batch"]:
        """Whether x solves the problem."""
        return self.verdict == SOLVED


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
    x, multipliers, verdict, steps = _solve(method, H, f, M, gamma)
    return Solution(x, multipliers, verdict, steps)


class _Nearest(NamedTuple):
    """The problem in its one form: which z with G z <= h is nearest to the origin; see above."""

    G: Rows
    h: Float[Array, " row"]
    unit: Float[Array, ""]
    length: Float[Array, " row"]
    inverse: Float[Array, "variable variable"]
    centre: Float[Array, " variable"]
    felt: Bool[Array, ""]


def _nearest(H, f, M, gamma) -> _Nearest:
    lower = jnp.linalg.cholesky(H)
    inverse = jax.scipy.linalg.solve_triangular(lower, jnp.eye(H.shape[0]), lower=True)
    centre = -inverse @ f
    G = M @ inverse.T
    length = jnp.sqrt(jnp.sum(G**2, axis=1))
    length = jnp.where(length > 0, length, 1.0)
    G = G / length[:, None]
    h = gamma / length - G @ centre
    beyond = jnp.max(-h, initial=0.0)
    size = jnp.max(jnp.abs(gamma / length), initial=0.0) + jnp.max(jnp.abs(centre))
    felt = ~(beyond <= ROUNDING * size) | ~jnp.isfinite(size)
    unit = jnp.where(felt, beyond, 1.0)
    return _Nearest(G, h / unit, unit, length, inverse, centre, felt)


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solve(method, H, f, M, gamma):
    problem = _nearest(H, f, M, gamma)
    search = {"interior": _interior, "hildreth": _hildreth, "qpax": _by_qpax}[method]
    z, multipliers, verdict, steps = search(problem.G, problem.h, problem.felt)
    x = problem.inverse.T @ (problem.unit * z + problem.centre)
    return x, problem.unit * multipliers / problem.length, verdict, steps


@_solve.defjvp
def _solve_jvp(method, primals, tangents):
    """Derivative of H x + f + M'l = 0 and, for each limit, s l = SMOOTHING with s = gamma - M x."""
    H, f, M, gamma = primals
    x, multipliers, verdict, steps = _solve(method, *primals)
    unit, length, inverse = (getattr(_nearest(*primals), n) for n in ("unit", "length", "inverse"))
    # In the one form, of which the change of L is no concern: the form is frozen.
    G = M @ inverse.T / length[:, None]
    weight, slack = _smoothed(multipliers * length / unit, (gamma - M @ x) / (length * unit))
    H_dot, f_dot, M_dot, gamma_dot = tangents
    pull = inverse @ (H_dot @ x + f_dot + M_dot.T @ multipliers)
    shift = (gamma_dot - M_dot @ x) / length
    variables = G.shape[1]
    matrix = jnp.block([[jnp.eye(variables), G.T], [weight[:, None] * G, -jnp.diag(slack)]])
    change = jnp.linalg.solve(matrix, jnp.concatenate([-pull, weight * shift]))
    x_dot = inverse.T @ change[:variables]
    changes = x_dot, change[variables:] / length, _no_change(verdict), _no_change(steps)
    return (x, multipliers, verdict, steps), changes


def _smoothed(multiplier, slack):
    """The pair with the same difference whose product is SMOOTHING, scaled to add up to one."""
    half = (multiplier - slack) / 2
    reach = jnp.sqrt(half**2 + SMOOTHING)
    # The smaller of the two from the product: the difference would lose its digits.
    large = reach + jnp.abs(half)
    small = SMOOTHING / large
    multiplier, slack = (jnp.where(half > 0, *pair) for pair in ((large, small), (small, large)))
    return multiplier / (large + small), slack / (large + small)


def _no_change(value):
    return jnp.zeros(jnp.shape(value), jax.dtypes.float0)


def _verdict(tolerance, error, z, before, after, h, G):
    """Solved, or proven to have no point, by the way in which the multipliers grow.

    A ray r >= 0 with G'r = 0 and h'r < 0 proves it (Farkas); any other shows that whatever is
    within the limits is at least -h'r / |G'r| away from the origin.
    """
    # XLA's maxima may pass over NaN, so that the error alone does not tell.
    finite = jnp.all(jnp.isfinite(z)) & jnp.all(jnp.isfinite(after))
    solved = finite & (error <= tolerance * (1 + jnp.max(jnp.abs(z))))
    ray = jnp.maximum(after - before, 0.0)
    least = FARTHEST * jnp.max(jnp.abs(G.T @ ray)) + TOLERANCE * jnp.sum(ray)
    nothing = -(h @ ray) > least
    return jnp.where(solved, SOLVED, jnp.where(nothing, INFEASIBLE, UNFINISHED))


def _interior(G, h, felt):
    """Mehrotra's predictor-corrector method (SIAM J. Optimization 2, 1992), damped in l."""
    rows, variables = G.shape

    def errors(z, weight, slack):
        stationary, limits = z + G.T @ weight, G @ z + slack - h
        worst = jnp.maximum(jnp.max(jnp.abs(stationary)), jnp.max(jnp.abs(limits)))
        return jnp.maximum(worst, jnp.max(jnp.minimum(weight, slack))), stationary, limits

    def goes_on(state):
        *_, verdict, steps = state
        return (verdict == UNFINISHED) & (steps < STEPS)

    def step(state):
        z, weight, slack, _, steps = state
        _, stationary, limits = errors(z, weight, slack)
        firm = 1 / (slack / weight + DAMPING)
        factor = jnp.linalg.cholesky(jnp.eye(variables) + (G.T * firm) @ G)

        def newton(product):
            rest = firm * (limits - product / weight)
            z_change = jax.scipy.linalg.cho_solve((factor, True), -stationary - G.T @ rest)
            weight_change = rest + firm * (G @ z_change)
            return z_change, weight_change, -(product + slack * weight_change) / weight

        gap = weight @ slack
        _, weight_change, slack_change = newton(weight * slack)
        length = _feasible(weight, weight_change, slack, slack_change, 1.0)
        left = (weight + length * weight_change) @ (slack + length * slack_change)
        calm = (steps > PATIENCE) & (steps % 2 == 0)
        centre = jnp.where(calm, 0.3, (left / gap) ** 3) * gap / rows
        # The predictor's own error counts only as far as the predictor can be followed: taken in
        # full, it makes the method cycle where limits nearly exclude each other. A calm step
        # without it ends the rare cycles that are left.
        curved = jnp.where(calm, 0.0, length) * weight_change * slack_change
        z_change, weight_change, slack_change = newton(weight * slack + curved - centre)
        length = _feasible(weight, weight_change, slack, slack_change, 0.995)
        z, slack = z + length * z_change, slack + length * slack_change
        after = weight + length * weight_change
        error, *_ = errors(z, after, slack)
        return z, after, slack, _verdict(TOLERANCE, error, z, weight, after, h, G), steps + 1

    start = jnp.zeros(variables), jnp.ones(rows), jnp.maximum(h, 0.0) + 1.0
    begin = jnp.where(felt, UNFINISHED, SOLVED), jnp.zeros((), int)
    z, weight, _, verdict, steps = jax.lax.while_loop(goes_on, step, (*start, *begin))
    return z, jnp.where(felt, weight, 0.0), verdict, steps


def _feasible(weight, weight_change, slack, slack_change, share):
    """The step, at most 1, that takes weights and slacks this share of the way to zero."""
    worst = jnp.maximum(jnp.max(-weight_change / weight), jnp.max(-slack_change / slack))
    return jnp.where(worst > share, share / worst, 1.0)


def _hildreth(G, h, felt):
    """Hildreth's procedure: one multiplier after the other is made optimal, and never negative.

    With rows of length one h_ii = 1, and w_i of eq. (7.23) is l_i + (G z - h)_i at z = -G'l.
    """
    rows, variables = G.shape

    def goes_on(state):
        *_, verdict, sweeps = state
        return (verdict == UNFINISHED) & (sweeps < SWEEPS)

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
        return z, after, _verdict(CREEP, error, z, weight, after, h, G), sweeps + 1

    begin = jnp.where(felt, UNFINISHED, SOLVED), jnp.zeros((), int)
    start = jnp.zeros(variables), jnp.zeros(rows)
    return jax.lax.while_loop(goes_on, sweep, (*start, *begin))


def _by_qpax(G, h, felt):
    z, weight, believed, steps = nearest(G, h)
    verdict = jnp.where(~felt | believed, SOLVED, UNFINISHED)
    z, weight = jnp.where(felt, z, 0.0), jnp.where(felt, weight, 0.0)
    return z, weight, verdict, jnp.where(felt, steps, 0)
