"""Convex quadratic programs of fixed size, differentiable.

Every problem is first brought to the least-distance form: with H = L L', minimise |z| subject to
G z <= h, where x = L'^-1 (scale z + z_0), z_0 is the unconstrained minimiser, the rows of G have
length one, and the scale is the largest violation of a limit by z_0. Tolerances then mean the same
for every problem, whatever its units.

Derivatives, forward and reverse, are those of the optimality conditions at the solution (implicit
differentiation), for every method. They are smoothed: slack s and multiplier l of each limit obey
s l = SMOOTHING instead of 0, in the form above. Where a limit is neither active nor inactive, and
the derivative jumps, it is the mean of both sides; elsewhere the smoothing is negligible.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.runtime.arrays import (
    Array,
    any_jax,
    array_namespace,
    block_diag,
    cholesky,
    fori_loop,
    set_at,
    solve,
    solve_triangular,
    while_loop,
    xp,
)

METHODS = ("interior", "hildreth")
SOLVED, INFEASIBLE, UNFINISHED = range(3)
STATUS_TEXT = {
    SOLVED: "solved",
    INFEASIBLE: "no point obeys all limits",
    UNFINISHED: "not solved within the permitted number of steps",
}

TOLERANCE = 1e-12  # of limits, stationarity and complementarity
HILDRETH_TOLERANCE = 1e-13  # the same for Hildreth's procedure, whose last sweeps change little
LIMIT_ROUNDING = 1e-13  # of limits and minimiser; smaller violations are rounding
MAX_DISTANCE = 1e8  # |z| beyond which a problem counts as infeasible
SMOOTHING = 1e-18
MAX_STEPS = 100  # of the interior-point method
STEPS_BEFORE_CENTRING = 20  # after these every other step is a pure centring step
MAX_SWEEPS = 20000  # of Hildreth's procedure
DUAL_REGULARISATION = 2e-12  # of the multipliers in a step, for linearly dependent rows
SINGLE_PRECISION = {  # values of these constants in programs of single precision
    TOLERANCE: 2e-5,
    HILDRETH_TOLERANCE: 1e-6,
    LIMIT_ROUNDING: 1e-6,
    MAX_DISTANCE: 1e4,
    DUAL_REGULARISATION: 1e-7,
}

Rows = Float[Array, "row variable"]


class Solution(NamedTuple):
    """Solution x, multipliers of the limits, status (see `STATUS_TEXT`), and number of iterations.

    x is valid only if the status is `SOLVED`. `steps` are steps of the interior-point method or
    sweeps of Hildreth's procedure; 0 if the unconstrained minimiser is within the limits.
    """

    x: Float[Array, "*batch variable"]
    multipliers: Float[Array, "*batch row"]
    status: Int[Array, " *batch"]
    steps: Int[Array, " *batch"]

    @property
    def solved(self) -> Bool[Array, " *batch"]:
        """Whether the status is `SOLVED`."""
        return self.status == SOLVED


def solve_qp(
    H: Float[Array, "variable variable"],
    f: Float[Array, " variable"],
    M: Rows,
    gamma: Float[Array, " row"],
    method: str = "interior",
) -> Solution:
    """Minimiser of 1/2 x'H x + f'x subject to M x <= gamma, for a positive definite H.

    By the "interior"-point method, or by Hildreth's dual procedure ("hildreth"), eqs (7.22) and
    (7.23) of the thesis, swept until converged. Differentiable (see the module), also under `vmap`.
    Numerical failures do not raise; the status reports them: it is `UNFINISHED` for numbers that
    are not finite and for an H that is not positive definite.

    Raises ValueError for an unknown method.
    """
    if method not in METHODS:
        raise ValueError(f"no method {method!r}; there are {', '.join(METHODS)}")
    solve = _solve if any_jax(H, f, M, gamma) else _solve_concrete
    x, multipliers, status, steps = solve(method, H, f, M, gamma)
    return Solution(x, multipliers, status, steps)


class _LeastDistance(NamedTuple):
    """Problem in the least-distance form of the module."""

    G: Rows
    h: Float[Array, " row"]
    scale: Float[Array, ""]
    row_norms: Float[Array, " row"]
    inverse_factor: Float[Array, "variable variable"]
    unconstrained: Float[Array, " variable"]
    limits_matter: Bool[Array, ""]


def _least_distance(H, f, M, gamma) -> _LeastDistance:
    lib = array_namespace(H, f, M, gamma)
    inverse_factor = solve_triangular(cholesky(H), np.eye(H.shape[0]), lower=True)
    unconstrained = -inverse_factor @ f
    G = M @ inverse_factor.T
    row_norms = lib.sqrt((G**2).sum(axis=1))
    row_norms = lib.where(row_norms > 0, row_norms, 1.0)
    G = G / row_norms[:, None]
    limits = gamma / row_norms
    h = limits - G @ unconstrained
    violation = (-h).max(initial=0.0)
    magnitude = abs(limits).max(initial=0.0) + abs(unconstrained).max()
    limits_matter = ~(violation <= LIMIT_ROUNDING * magnitude) | ~lib.isfinite(magnitude)
    scale = lib.where(limits_matter, violation, 1.0)
    return _LeastDistance(
        G, h / scale, scale, row_norms, inverse_factor, unconstrained, limits_matter
    )


def _solve_concrete(method, H, f, M, gamma):
    problem = _least_distance(H, f, M, gamma)
    solver = {"interior": _interior_point, "hildreth": _hildreth}[method]
    z, multipliers, status, steps = solver(problem.G, problem.h, problem.limits_matter)
    x = problem.inverse_factor.T @ (problem.scale * z + problem.unconstrained)
    return x, problem.scale * multipliers / problem.row_norms, status, steps


_solve = jax.custom_jvp(_solve_concrete, nondiff_argnums=(0,))


@_solve.defjvp
def _solve_jvp(method, primals, tangents):
    """Derivative of H x + f + M'l = 0 and, for each limit, s l = SMOOTHING with s = gamma - M x."""
    H, f, M, gamma = primals
    x, multipliers, status, steps = _solve(method, *primals)
    form = _least_distance(*primals)
    scale, row_norms, inverse_factor = form.scale, form.row_norms, form.inverse_factor
    # In the least-distance form at the solution, which is held fixed: the result is that of x.
    G = M @ inverse_factor.T / row_norms[:, None]
    multiplier, slack = _smoothed_pair(
        multipliers * row_norms / scale, (gamma - M @ x) / (row_norms * scale)
    )
    H_dot, f_dot, M_dot, gamma_dot = tangents
    gradient_change = inverse_factor @ (H_dot @ x + f_dot + M_dot.T @ multipliers)
    limit_change = (gamma_dot - M_dot @ x) / row_norms
    variables = G.shape[1]
    matrix = xp.block([[xp.eye(variables), G.T], [multiplier[:, None] * G, -xp.diag(slack)]])
    change = xp.linalg.solve(matrix, xp.concatenate([-gradient_change, multiplier * limit_change]))
    x_dot = inverse_factor.T @ change[:variables]
    changes = x_dot, change[variables:] / row_norms, _zero_tangent(status), _zero_tangent(steps)
    return (x, multipliers, status, steps), changes


def _smoothed_pair(multiplier, slack):
    """Pair with the same difference and the product SMOOTHING, scaled to the sum one."""
    half = (multiplier - slack) / 2
    root = xp.sqrt(half**2 + SMOOTHING)
    # The smaller of the two from the product, to avoid cancellation.
    large = root + xp.abs(half)
    small = SMOOTHING / large
    multiplier, slack = (xp.where(half > 0, *pair) for pair in ((large, small), (small, large)))
    return multiplier / (large + small), slack / (large + small)


def _zero_tangent(value):
    return xp.zeros(xp.shape(value), jax.dtypes.float0)


def _status(lib, tolerance, error, z, previous_multipliers, multipliers, h, G):
    """Status of an iterate: solved, or infeasible by the growth r of the multipliers.

    A ray r >= 0 with G'r = 0 and h'r < 0 proves infeasibility (Farkas); for other r >= 0 every
    feasible point is at least -h'r / |G'r| away from the origin.
    """
    # XLA's maxima may ignore NaN, so that the error alone is no proof.
    finite = lib.isfinite(z).all() & lib.isfinite(multipliers).all()
    solved = finite & (error <= tolerance * (1 + abs(z).max()))
    ray = lib.maximum(multipliers - previous_multipliers, 0.0)
    min_certificate = MAX_DISTANCE * abs(G.T @ ray).max() + TOLERANCE * ray.sum()
    infeasible = -(h @ ray) > min_certificate
    return lib.where(solved, SOLVED, lib.where(infeasible, INFEASIBLE, UNFINISHED))


def _interior_point(G, h, limits_matter):
    """Mehrotra's predictor-corrector method (SIAM J. Optimization 2, 1992), regularised in l."""
    (rows, variables), lib = G.shape, array_namespace(G, h, limits_matter)
    sizes = lib.maximum(abs(h), 1.0)

    def optimality_errors(z, multipliers, slack):
        stationary, limits = z + G.T @ multipliers, G @ z + slack - h
        # The slack of a limit far away is rounded in proportion.
        worst = lib.maximum(abs(stationary).max(), (abs(limits) / sizes).max())
        return lib.maximum(worst, lib.minimum(multipliers, slack).max()), stationary, limits

    def unfinished(state):
        *_, status, steps = state
        return (status == UNFINISHED) & (steps < MAX_STEPS)

    identity = np.eye(variables)

    def step(state):
        z, multipliers, slack, stationary, limits, _, steps = state
        scaling = 1 / (slack / multipliers + DUAL_REGULARISATION)
        factor = cholesky(identity + (G.T * scaling) @ G)
        inverse_factor = solve_triangular(factor, identity, lower=True)

        def newton(product):
            rest = scaling * (limits - product / multipliers)
            z_change = -inverse_factor.T @ (inverse_factor @ (stationary + G.T @ rest))
            multiplier_change = rest + scaling * (G @ z_change)
            return z_change, multiplier_change, -(product + slack * multiplier_change) / multipliers

        gap = multipliers @ slack
        _, multiplier_change, slack_change = newton(multipliers * slack)
        length = _step_length(lib, multipliers, multiplier_change, slack, slack_change, 1.0)
        affine_gap = (multipliers + length * multiplier_change) @ (slack + length * slack_change)
        centring_step = (steps > STEPS_BEFORE_CENTRING) & (steps % 2 == 0)
        centring_target = lib.where(centring_step, 0.3, (affine_gap / gap) ** 3) * gap / rows
        # The second-order correction is scaled by the step length of the predictor: in full, it
        # makes the method cycle where limits nearly exclude each other. A centring step without it
        # ends the rare cycles that are left.
        second_order = lib.where(centring_step, 0.0, length) * multiplier_change * slack_change
        z_change, multiplier_change, slack_change = newton(
            multipliers * slack + second_order - centring_target
        )
        length = _step_length(lib, multipliers, multiplier_change, slack, slack_change, 0.995)
        z, slack = z + length * z_change, slack + length * slack_change
        next_multipliers = multipliers + length * multiplier_change
        error, stationary, limits = optimality_errors(z, next_multipliers, slack)
        return (
            z,
            next_multipliers,
            slack,
            stationary,
            limits,
            _status(lib, TOLERANCE, error, z, multipliers, next_multipliers, h, G),
            steps + 1,
        )

    start = lib.zeros(variables), lib.ones(rows), lib.maximum(h, 0.0) + 1.0
    _, *residuals = optimality_errors(*start)
    initial_status = lib.where(limits_matter, UNFINISHED, SOLVED), lib.zeros((), int)
    start = (*start, *residuals, *initial_status)
    z, multipliers, *_, status, steps = while_loop(unfinished, step, start)
    return z, lib.where(limits_matter, multipliers, 0.0), status, steps


def _step_length(lib, multipliers, multiplier_change, slack, slack_change, boundary_fraction):
    """Largest step, at most 1, in which no multiplier or slack loses more than a fraction of it."""
    worst = lib.maximum((-multiplier_change / multipliers).max(), (-slack_change / slack).max())
    return lib.where(worst > boundary_fraction, boundary_fraction / worst, 1.0)


def _hildreth(G, h, limits_matter):
    """Hildreth's procedure: coordinate ascent in the multipliers, which stay not negative.

    With rows of length one h_ii = 1, and w_i of eq. (7.23) is l_i + (G z - h)_i at z = -G'l.
    """
    rows, variables = G.shape

    def unfinished(state):
        *_, status, sweeps = state
        return (status == UNFINISHED) & (sweeps < MAX_SWEEPS)

    def sweep(state):
        z, multipliers, _, sweeps = state

        def row(i, iterate):
            z, multipliers = iterate
            updated = xp.maximum(0.0, multipliers[i] + G[i] @ z - h[i])
            return z - G[i] * (updated - multipliers[i]), set_at(multipliers, i, updated)

        _, after = fori_loop(0, rows, row, (z, multipliers))
        z = -G.T @ after
        slack = h - G @ z
        error = xp.maximum(xp.max(-slack), xp.max(xp.minimum(after, slack)))
        status = _status(xp, HILDRETH_TOLERANCE, error, z, multipliers, after, h, G)
        return z, after, status, sweeps + 1

    initial_status = xp.where(limits_matter, UNFINISHED, SOLVED), xp.zeros((), int)
    start = xp.zeros(variables), xp.zeros(rows)
    return while_loop(unfinished, sweep, (*start, *initial_status))


class QuadraticProgram(NamedTuple):
    """Minimise 1/2 x'H x + f'x subject to M x <= gamma."""

    H: Float[Array, "variable variable"]
    f: Float[Array, " variable"]
    M: Float[Array, "row variable"]
    gamma: Float[Array, " row"]

    def within(
        self, rows: Float[Array, "limit variable"], sides: Float[Array, " limit"]
    ) -> "QuadraticProgram":
        """Program with further limits on its variables, or on the first of them."""
        rows = xp.pad(rows, ((0, 0), (0, self.f.shape[0] - rows.shape[1])))
        return self._replace(
            M=xp.concatenate([self.M, rows]), gamma=xp.concatenate([self.gamma, sides])
        )

    def softly_within(
        self,
        rows: Float[Array, "limit variable"],
        sides: Float[Array, " limit"],
        excess: Float[Array, "limit excess"],
        costs: Float[Array, " excess"],
    ) -> "QuadraticProgram":
        """Program with limits rows x - excess e <= sides, and further variables e of cost c e^2."""
        further = excess.shape[1]
        rows = xp.pad(rows, ((0, 0), (0, self.f.shape[0] - rows.shape[1])))
        return QuadraticProgram(
            block_diag(self.H, xp.diag(2 * costs)),
            xp.pad(self.f, (0, further)),
            xp.concatenate(
                [
                    xp.pad(self.M, ((0, 0), (0, further))),
                    xp.concatenate([rows, -excess], axis=1),
                ]
            ),
            xp.concatenate([self.gamma, sides]),
        )


def first_move(
    program: QuadraticProgram, move_maps: Float[Array, "horizon actuator variable"], solver: str
) -> tuple[Float[Array, " actuator"], Bool[Array, ""]]:
    """First move of the solution, and whether there is one."""
    if program.M.shape[0] == 0:
        return move_maps[0] @ -solve(program.H, program.f), xp.ones((), bool)
    solution = solve_qp(*program, solver)
    return move_maps[0] @ solution.x[: move_maps.shape[2]], solution.solved
