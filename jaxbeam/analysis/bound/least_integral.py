"""Least integral of the squared deflection over all commands within the limits, eq. (3.2).

The thesis states this problem, bounded input and a criterion without the input, and leaves it for
that of eq. (3.3), as its commands jump. The deflection is affine in the held commands u
(`input_influence`), so that the integral is a convex quadratic function of them,

    J(u) = integral of w(t)'Q w(t) dt,    u_min <= u_k <= u_max,   |u_k - u_(k-1)| <= rate * period,

and its least value that of a quadratic program. (3.2) is half of J.
"""

import numpy as np
import scipy  # loads its parts on first use
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.analysis.bound.bound import InputInfluence, checked_influence, held_command_limits
from jaxbeam.case.case import Case
from jaxbeam.case.controller import commanded
from jaxbeam.control.feedforward import Prescribed
from jaxbeam.numerics.qp import STATUS_TEXT, solve_qp
from jaxbeam.runtime.arrays import Module
from jaxbeam.runtime.printer import counted
from jaxbeam.simulation.record import Record

REGULARISATION = 1e-10  # on squared commands, of the largest effect of one: some have no effect
GAP_TOLERANCE = 1e-6  # of the integral without commands, between the commands and their proof


class LeastIntegral(Module):
    """Least integral of the weighted squared deflection of a case, and commands that attain it.

    `integral` (m^2 s) is that of the `commands`, which start at `times` (s) and are held over
    `period` (s); no commands within the limits make it smaller than `proven`. `uncontrolled` is the
    integral without commands, at the `positions` (m) with the `weights`, by the trapezoidal rule at
    times at most `spacing` (s) apart. `share_at_limits` is the fraction of commands at a limit: all
    but a few, "bang-bang", where limits are tight; `driven` actuators are those that take any.
    """

    integral: float
    proven: float
    uncontrolled: float
    positions: Float[np.ndarray, " position"]
    weights: Float[np.ndarray, " position"]
    times: Float[np.ndarray, " hold"]
    commands: Float[np.ndarray, "hold actuator"]
    share_at_limits: float
    period: float
    spacing: float
    driven: tuple[int, ...]

    @property
    def reduction(self) -> float:
        """Attainable reduction as a fraction of the integral without commands, 0 to 1."""
        return 1 - self.integral / self.uncontrolled

    def of_record(self, record: Record) -> float:
        """The integral (m^2 s) of a run, over its samples by the trapezoidal rule."""
        w = np.asarray(record.at(self.positions))
        return float(np.trapezoid(w**2 @ self.weights, np.asarray(record.times)))

    def controller(self) -> Prescribed:
        """Open-loop controller with the commands of those actuators that take any."""
        end = self.times[-1] + self.period
        commands = self.commands[:, np.array(self.driven, int)]
        values = np.concatenate([commands, commands[-1:]]).T
        offsets = np.zeros(len(self.driven))
        times = np.append(self.times, end)
        return Prescribed(offsets=offsets, period=self.period, times=times, values=values)


def least_integral(
    case: Case,
    positions: ArrayLike | None = None,
    period: float | None = None,
    spacing: float | None = None,
    weights: ArrayLike | None = None,
) -> LeastIntegral:
    """Least integral of the squared deflection over all commands within the limits, eq. (3.2).

    The deflections are those at the sensors, or at given `positions` (m), with `weights`, the
    diagonal of Q, 1 if left out. Commands are held over `period` (s), as in `bound`, which has the
    least peak; the integral is over the run, with the deflection every `spacing` (s).

    Raises ValueError as `bound`, for actuators without limits, and for weights that are negative or
    not one a position; RuntimeError if the quadratic program fails.

    >>> import jaxbeam as jb
    >>> from jaxbeam.analysis.bound.least_integral import least_integral
    >>> case = jb.Case(
    ...     jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 1.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ...     run=jb.Run(0.3),
    ... )
    >>> best = least_integral(case, period=0.02)
    >>> print(f"{best.reduction:.0%} of the integral, at most")
    43% of the integral, at most
    """
    influence, positions, period, spacing = checked_influence(case, positions, period, spacing)
    given = np.ones(positions.size) if weights is None else np.asarray(weights, float)
    if given.shape != positions.shape or not np.all(given >= 0) or not np.any(given):
        raise ValueError(
            f"weights must list {counted(positions.size, 'number')}, not negative and not all"
            f" zero, one a position; they are {given.tolist()}"
        )
    low, high, change = held_command_limits(case, period)
    for i, actuator in enumerate(case.actuators):
        if actuator.accepts_commands and not np.all(np.isfinite([low[i], high[i]])):
            raise ValueError(f"actuators.{i}.limits must be given: the criterion bounds the input")
    H, f, constant = _quadratic(influence, given)
    commands = _solve(H, f, low, high, change, influence.response.shape[2:])
    flat = commands.ravel()
    integral = flat @ H @ flat + 2 * f @ flat + constant
    proven = integral - _gap(2 * (H @ flat + f), commands, low, high, change)
    if not integral - proven <= GAP_TOLERANCE * constant:
        raise RuntimeError(
            "the quadratic program of the least integral was solved to"
            f" {(integral - proven) / constant:.1e} only; hold commands for longer"
        )
    at_limits = np.minimum(commands - low, high - commands) <= 1e-6 * (high - low)
    return LeastIntegral(
        integral=float(integral),
        proven=float(proven),
        uncontrolled=float(constant),
        positions=positions,
        weights=given,
        times=influence.hold_times,
        commands=commands,
        share_at_limits=float(np.mean(at_limits)),
        period=period,
        spacing=spacing,
        driven=commanded(case.actuators),
    )


def _quadratic(influence: InputInfluence, weights):
    """H, f and c of the integral as a quadratic form u'H u + 2 f'u + c of the commands u."""
    intervals = np.diff(influence.times)
    trapezoid = (np.append(intervals, 0.0) + np.append(0.0, intervals)) / 2
    size = int(np.prod(influence.response.shape[2:]))
    H, f, constant = np.zeros((size, size)), np.zeros(size), 0.0
    for row, weight in zip(influence.deflection_rows, weights, strict=True):
        unforced = influence.unforced @ row
        response = np.einsum("m,tmka->tka", row, influence.response).reshape(-1, size)
        weighted = weight * trapezoid
        H += response.T @ (weighted[:, None] * response)
        f += response.T @ (weighted * unforced)
        constant += weighted @ unforced**2
    return H, f, constant


def _solve(H, f, low, high, change, shape) -> Float[np.ndarray, "hold actuator"]:
    """Commands of the least integral, in units in which H is one at most on its diagonal."""
    holds, actuators = shape
    size = holds * actuators
    scale = np.sqrt(np.max(np.diag(H)))
    M, gamma = [], []

    def limit(rows, bounds):
        bounded = np.isfinite(bounds)
        M.append(rows[bounded])
        gamma.append(bounds[bounded])

    identity = np.eye(size)
    difference = identity - np.eye(size, k=-actuators)
    for rows, lower, upper in ((identity, low, high), (difference, -change, change)):
        limit(rows, np.tile(upper, holds))
        limit(-rows, -np.tile(lower, holds))
    solution = solve_qp(
        H / scale**2 + REGULARISATION * np.eye(size),
        f / scale,
        np.concatenate(M),
        np.concatenate(gamma) * scale,
    )
    if not solution.solved:
        text = STATUS_TEXT[int(solution.status)]
        raise RuntimeError(f"the quadratic program of the least integral failed: {text}")
    commands = np.asarray(solution.x).reshape(shape) / scale
    changes = np.clip(np.diff(commands, axis=0, prepend=0.0), -change, change)
    return np.clip(np.cumsum(changes, axis=0), low, high)


def _gap(gradient, commands, low, high, change) -> float:
    """Duality gap of convex minimisation: -min of gradient'(v - u) over the commands v allowed."""
    holds, actuators = commands.shape
    gradient = gradient.reshape(commands.shape)
    least = np.where(gradient > 0, low, high)
    if np.any(np.isfinite(change)):
        limits = np.tile(np.stack([low, high], axis=1), (holds, 1))
        difference = np.eye(commands.size) - np.eye(commands.size, k=-actuators)
        rows = np.concatenate([difference, -difference])
        rates = np.tile(np.where(np.isfinite(change), change, 1e30), 2 * holds)
        unit = np.max(np.abs(gradient))
        found = scipy.optimize.linprog(gradient.ravel() / unit, rows, rates, bounds=limits)
        least = found.x.reshape(commands.shape)
    # Commands without effect, as those of springs, may have no limits.
    return float(-np.sum(gradient * np.where(gradient == 0, 0.0, least - commands)))
