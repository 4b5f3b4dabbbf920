"""Nonlinear least squares: residuals, loss, and steps of Levenberg and Marquardt.

Each loss is half the square of `robust_residual(r)`, so that least squares minimises any of them; r
is a residual over the standard deviation of the noise.

Multi-start search: a fit searched from several points, and the distinct minima found.

Covariance, confidence intervals and unidentifiable directions of a least-squares fit. All follow
from the singular values of the fit's Jacobian.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import norm, qmc, t as student

from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.progress import found_so_far
from tuning.checkpoint import NO_CHECKPOINT, Checkpoint
from tuning.parameters import FreeParameter, SamplePrediction, to_unbounded

# All but LEAST_PARTICIPATION are in typical sizes of the parameters.
UNIDENTIFIABLE_SD = 0.5  # standard error beyond which a direction counts as unidentifiable
LEAST_PARTICIPATION = 0.1  # component of a unit direction above which an address is part of it
UNBOUNDED_SD = 1e4  # standard error given to a direction without any effect
REPORTED_CHANGE = 0.1  # largest change with which an unidentifiable direction is reported


@dataclasses.dataclass(frozen=True)
class Uncertainty:
    """Standard errors, correlation and unidentifiable directions, in the order of the addresses.

    Errors (SI) are infinite, and correlations NaN, where a parameter is not identifiable. Each
    entry of `unidentifiable` is a dictionary from address to change (SI): made together, these
    changes leave the readings as good as they are.
    """

    errors: Float[np.ndarray, " parameter"]
    correlation: Float[np.ndarray, "parameter parameter"]
    unidentifiable: list[dict[str, float]]


def autocorrelation(series: Float[np.ndarray, " time"], lag: int) -> float:
    """Autocorrelation about zero, at a lag of so many samples."""
    return float(series[:-lag] @ series[lag:]) / float(series @ series)


def autocorrelation_factor(residuals: Float[np.ndarray, " time"]) -> float:
    """Factor by which a residual's autocorrelation raises variances: 1 + 2 sum of correlations.

    Summed over the first lags, up to where the correlation falls below its own scatter,
    1 / sqrt(n). Exact for slow changes of the reading, too large for fast ones (Box and Jenkins,
    Time Series Analysis, section 2.1.5).
    """
    if residuals.size < 2:
        return 1.0
    centred = residuals - residuals.mean()
    if float(centred @ centred) == 0.0:
        return 1.0
    factor = 1.0
    limit = 1 / np.sqrt(centred.size)
    for lag in range(1, centred.size // 4):
        correlation = autocorrelation(centred, lag)
        if correlation < limit:
            break
        factor += 2 * correlation
    return factor


def t_quantile(degrees_of_freedom: float) -> float:
    """Half width of a 95 % interval in standard errors: Student's quantile, 1.96 in the limit.

    `degrees_of_freedom` is the number of independent samples less that of the parameters.
    """
    return float(student.ppf(0.975, degrees_of_freedom))


def confidence_intervals(
    values: Float[np.ndarray, " parameter"],
    errors: Float[np.ndarray, " parameter"],
    degrees_of_freedom: float,
) -> Float[np.ndarray, "parameter 2"]:
    """95 % intervals of values with their standard errors; infinite for infinite errors."""
    half = t_quantile(degrees_of_freedom) * errors
    return np.stack([values - half, values + half], axis=1)


def uncertainty(
    addresses: list[str],
    jacobian: Float[np.ndarray, "residual parameter"],
    sizes: Float[np.ndarray, " parameter"],
) -> Uncertainty:
    """Uncertainty of values from the Jacobian of residuals in units of their standard deviation.

    The covariance is the inverse of J' J, by the singular directions of J in typical `sizes`.
    Directions whose standard error exceeds `UNIDENTIFIABLE_SD` are unidentifiable: addresses that
    are part of one are named and have no standard error, and so have all whose own exceeds it.
    """
    _, strength, directions = np.linalg.svd(np.linalg.qr(jacobian * sizes, mode="r"))
    # Columns in exact proportion leave a strength of rounding size.
    spread = np.full(len(addresses), UNBOUNDED_SD)
    strong = strength > strength.max(initial=0.0) * 1e-9
    spread[: strength.size][strong] = np.minimum(1 / strength[strong], UNBOUNDED_SD)
    deviations = np.abs(directions) * spread[:, None]
    errors = np.sqrt(np.sum(deviations**2, axis=0))
    covariance = (directions.T * spread**2) @ directions
    correlation = covariance / np.outer(errors, errors)
    unidentifiable = spread > UNIDENTIFIABLE_SD
    participates = unidentifiable[:, None] & (
        (np.abs(directions) > LEAST_PARTICIPATION) | (deviations > UNIDENTIFIABLE_SD)
    )
    without_error = participates.any(axis=0) | (errors > UNIDENTIFIABLE_SD)
    changes = []
    for direction, takes_part in zip(
        directions[unidentifiable], participates[unidentifiable], strict=True
    ):
        change = direction * sizes * REPORTED_CHANGE / direction[np.abs(direction).argmax()]
        changes.append({addresses[i]: float(change[i]) for i in np.flatnonzero(takes_part)})
    return Uncertainty(
        np.where(without_error, np.inf, errors * sizes),
        np.where(without_error[:, None] | without_error[None, :], np.nan, correlation),
        changes,
    )


LOSSES = ("squares", "soft-l1", "huber")
HUBER_THRESHOLD = 1.345  # 95 % of the efficiency of squares for normal noise


def check_loss(loss: str) -> None:
    """Raises ValueError for an unknown loss."""
    if loss not in LOSSES:
        raise ValueError(f"a loss is one of {', '.join(LOSSES)}, not {loss!r}")


def robust_residual(loss: str, residual: Float[Array, "*any"]) -> Float[Array, "*any"]:
    """Residual f whose half square f^2 / 2 is the loss.

    soft-l1: f^2 / 2 = sqrt(1 + r^2) - 1; Huber: f^2 / 2 = k |r| - k^2 / 2 beyond k.
    """
    if loss == "soft-l1":
        return residual * xp.sqrt(2 / (1 + xp.sqrt(1 + residual**2)))
    if loss == "huber":
        clipped = xp.maximum(xp.abs(residual), HUBER_THRESHOLD)
        return xp.where(
            xp.abs(residual) <= HUBER_THRESHOLD,
            residual,
            xp.sign(residual) * xp.sqrt(2 * HUBER_THRESHOLD * clipped - HUBER_THRESHOLD**2),
        )
    return residual


def robust_slope(loss: str, residual: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Derivative of `robust_residual` by the residual, in NumPy.

    It is psi(r) / f with psi the derivative of the loss: r / sqrt(1 + r^2) for soft-l1, k sign(r)
    beyond k for Huber.
    """
    size = np.abs(robust_residual(loss, residual))
    with np.errstate(invalid="ignore", divide="ignore"):
        if loss == "soft-l1":
            return np.where(size > 0, np.abs(residual) / np.sqrt(1 + residual**2) / size, 1.0)
        if loss == "huber":
            return np.where(np.abs(residual) > HUBER_THRESHOLD, HUBER_THRESHOLD / size, 1.0)
    return np.ones_like(residual)


def variance_factor(loss: str, residuals: Float[np.ndarray, " sample"]) -> float:
    """Factor by which variances of a robust fit exceed those of linearised least squares.

    E[psi^2] / E[psi']^2 with psi the derivative of the loss (Huber, Robust Statistics, section
    6.3), for residuals over the standard deviation of the noise.
    """
    if loss == "soft-l1":
        root = np.sqrt(1 + residuals**2)
        influence, stiffness = residuals / root, 1 / root**3
    elif loss == "huber":
        influence = np.clip(residuals, -HUBER_THRESHOLD, HUBER_THRESHOLD)
        stiffness = np.abs(residuals) <= HUBER_THRESHOLD
    else:
        return 1.0
    return float(np.mean(influence**2) / np.mean(stiffness) ** 2)


# Least decrease, over the predicted one, of an accepted step, and of one after which damping falls.
ACCEPTED_DECREASE, GOOD_DECREASE = 0.01, 0.99
# Predicted decrease, over the sum of squares, that may be rounding of the residuals.
NEGLIGIBLE_DECREASE = 1e-11
LESS_DAMPING, MORE_DAMPING = 1 / 3.5, 4.0  # factors of the damping after good and rejected steps


class Minimum(NamedTuple):
    """Point at which a search ended, and whether it converged there."""

    point: Float[np.ndarray, " variable"]
    converged: bool


def levenberg_marquardt(
    linearised: Callable,
    start: Float[np.ndarray, " variable"],
    rtol: float,
    atol: float,
    max_steps: int,
) -> Minimum:
    """Minimum of half the sum of squared residuals, from a start.

    `linearised` maps a point to residuals (residual,) and their derivatives (residual, variable).
    A step d minimises |r + J d|^2 + damping |d|^2, the damping is 1 at first; with a trust region
    as Gould et al. (4OR 3, 2005) chose it for it. Converged once an accepted step changes no
    variable and no residual by more than atol + rtol times its size, or the next promises a
    relative decrease below NEGLIGIBLE_DECREASE. Points at which residuals are not finite are
    rejected.
    """
    point, damping = start, 1.0
    residuals, jacobian = linearised(start)
    # Of residuals and derivatives only their products matter: those of the triangular factor.
    factor = _factor(residuals, jacobian)
    for _ in range(max_steps - 1):
        if not np.all(np.isfinite(factor)):
            break
        change = _damped_step(factor, damping)
        predicted = (np.sum((factor @ np.append(change, 1.0)) ** 2) - _squares(factor)) / 2
        if damping <= 1 and -predicted <= NEGLIGIBLE_DECREASE * _squares(factor):
            return Minimum(point, True)
        trial_residuals, jacobian = linearised(point + change)
        trial_factor = _factor(trial_residuals, jacobian)
        decrease = (_squares(trial_factor) - _squares(factor)) / 2
        if not decrease <= ACCEPTED_DECREASE * predicted:
            damping *= MORE_DAMPING
            continue
        if decrease < GOOD_DECREASE * predicted and predicted < 0:
            damping *= LESS_DAMPING
        point, factor = point + change, trial_factor
        moved = np.abs(change) / (atol + rtol * np.abs(point))
        changed = np.abs(trial_residuals - residuals) / (atol + rtol * np.abs(trial_residuals))
        if max(moved.max(), changed.max()) < 1:
            return Minimum(point, True)
        residuals = trial_residuals
    return Minimum(point, False)


def _factor(residuals, jacobian):
    """Triangular factor of the matrix (derivatives, residuals); not finite if they are not."""
    both = np.column_stack([jacobian, residuals])
    if not np.all(np.isfinite(both)):
        return np.full((both.shape[1],) * 2, np.nan)
    return np.linalg.qr(both, mode="r")


def _squares(factor) -> float:
    """Sum of squared residuals."""
    return float(np.sum(factor[:, -1] ** 2))


def _damped_step(factor, damping):
    """Step that minimises |r + J d|^2 + damping |d|^2."""
    size = factor.shape[1] - 1
    matrix = np.vstack([factor[:, :-1], np.sqrt(damping) * np.eye(size)])
    return np.linalg.lstsq(matrix, np.append(-factor[:, -1], np.zeros(size)), rcond=None)[0]


NOISE_ITERATIONS = 2  # fits, each with the noise levels that the one before has estimated
MAX_STEPS = 60  # steps of one fit
RTOL, ATOL = 1e-8, 1e-6  # of search variables and residuals, at which a fit has converged
KEPT_POINTS = 3  # number of points whose samples and derivatives are cached
WEAK_PRIOR_WIDTH = 2.0  # standard deviation in search variables: e^2, or two typical sizes


@runtime_checkable
class RegressionData(Protocol):
    """Interface of the data of a fit: samples and a model that predicts them.

    `measured` and `mask` (1 for samples that count, else 0) are (log, time, channel).
    """

    measured: np.ndarray
    mask: np.ndarray

    def prediction(self, addresses: list[str]) -> SamplePrediction:
        """All samples as a function of values at the addresses."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class LeastSquaresSolution:
    """Solution of a least-squares problem.

    `unbounded` are the search variables of the values; `noise` the standard deviation of the
    residuals; `autocorrelation_factor` the factor by which their autocorrelation raises variances,
    1 for white ones; `degrees_of_freedom` the number of independent samples left; `jacobian` the
    derivatives of the predicted samples with respect to the values.
    """

    values: Float[np.ndarray, " parameter"]
    unbounded: Float[np.ndarray, " parameter"]
    predicted: Float[np.ndarray, "log time channel"]
    noise: Float[np.ndarray, "log channel"]
    autocorrelation_factor: Float[np.ndarray, "log channel"]
    degrees_of_freedom: float
    jacobian: Float[np.ndarray, "log time channel parameter"]
    uncertainty: Uncertainty
    converged: bool


class SearchPoint(NamedTuple):
    """A point that a search has tried: values of its parameters, samples that they predict.

    `problem` is the `LeastSquares` that is searched in; `misfit` is half the sum of squared
    residuals over their noise (or their loss), of measured samples alone.
    """

    problem: Any
    values: Float[np.ndarray, " parameter"]
    predicted: Float[np.ndarray, "log time channel"]
    misfit: float


class LeastSquares:
    """Least-squares problem in the free parameters of a dataset, compiled once for any samples.

    Priors of the parameters count as further residuals. `loss` is one of the losses above. Each
    `SearchPoint` is reported to those `following` (jaxbeam.runtime.progress).

    Raises ValueError if there are more parameters than samples, or for an unknown loss.
    """

    def __init__(
        self, data: RegressionData, parameters: list[FreeParameter], loss: str = "squares"
    ):
        check_loss(loss)
        if data.mask.sum() < len(parameters):
            raise ValueError(f"{len(parameters)} free parameters need at least as many samples")
        self.data, self.parameters, self.loss = data, parameters, loss
        self.start_point = to_unbounded(parameters, [p.start for p in parameters])
        weak_prior_widths = WEAK_PRIOR_WIDTH * np.array([p.unbounded_size for p in parameters])

        def values_at(y):
            return xp.stack([p.from_unbounded(y[i]) for i, p in enumerate(parameters)])

        def prior_residuals(values):
            return xp.stack([p.prior.prior_residual(values[i]) for i, p in enumerate(parameters)])

        self.from_unbounded, self.prior_residuals = values_at, prior_residuals
        self.weak_prior_widths = weak_prior_widths
        self._prediction = data.prediction([p.address for p in parameters])
        self._evaluated = {}

    def solve(
        self,
        measured: Float[np.ndarray, "log time channel"],
        *,
        start: Float[np.ndarray, " parameter"] | None = None,
        included_logs: Bool[np.ndarray, "log"] | None = None,
        free: Bool[np.ndarray, " parameter"] | None = None,
    ) -> LeastSquaresSolution:
        """Fit to samples of the shape of the dataset's.

        `start` are search variables to start from (the parameters' own starts if left out),
        `included_logs` the logs that count, `free` the parameters that move. The noise of each
        channel is estimated from second differences first, then from the residuals. Standard errors
        are those of the linearised fit (0 for held parameters), widened for autocorrelation.

        Raises RuntimeError if the case cannot be simulated at the fitted values.
        """
        y = self.start_point if start is None else start
        free = np.ones(len(self.parameters), bool) if free is None else free
        mask = self.data.mask
        mask = mask if included_logs is None else mask * included_logs[:, None, None]
        noise = self.initial_noise(measured)
        jacobian = None
        for _ in range(NOISE_ITERATIONS):
            scale = self.step_scale(y, noise, mask, jacobian)
            y, converged = self.minimise(y, scale, self.weights(noise, mask), measured, free)
            values = self.values_at(y)
            predicted, jacobian = self.linearised(values)
            residuals = measured - predicted
            if not np.all(np.isfinite(residuals)):
                raise RuntimeError(
                    "the fit left the range in which the case can be simulated; give its "
                    "parameters bounds"
                )
            noise = self._residual_noise(residuals, mask)
        factors = self._autocorrelation_factors(residuals)
        counts = mask.sum(axis=1)
        independent = np.sum(counts / factors)
        degrees_of_freedom = max(independent - free.sum(), 1.0)
        # Autocorrelated noise is fitted more closely than white noise: its level looks too low.
        noise_correction = (1 - free.sum() / counts.sum()) * independent / degrees_of_freedom
        widened = noise * np.sqrt(factors * max(noise_correction, 1.0))
        found = self._uncertainty(values, jacobian, mask, noise, widened, residuals, free)
        return LeastSquaresSolution(
            values=values,
            unbounded=y,
            predicted=predicted,
            noise=noise,
            autocorrelation_factor=factors,
            degrees_of_freedom=degrees_of_freedom,
            jacobian=jacobian,
            uncertainty=found,
            converged=converged,
        )

    def linearised(self, values):
        """Predicted samples at values, and their derivatives (log, time, channel, parameter).

        Those of the last points are kept: searches begin and end at points already computed.
        """
        key = np.asarray(values, float).tobytes()
        found = self._evaluated.pop(key, None)
        if found is None:
            found = self._prediction.linearised(np.asarray(values, float))
        self._evaluated[key] = found
        while len(self._evaluated) > KEPT_POINTS:
            del self._evaluated[next(iter(self._evaluated))]
        return found

    def values_at(self, y) -> Float[np.ndarray, " parameter"]:
        """Values of the parameters at search variables."""
        return np.asarray(self.from_unbounded(np.asarray(y)))

    def _slopes(self, y) -> Float[np.ndarray, " parameter"]:
        """Derivatives of the values by the search variables."""
        return np.array([p.slope(float(v)) for p, v in zip(self.parameters, y, strict=True)])

    def _prior_jacobian(self, values) -> Float[np.ndarray, "parameter parameter"]:
        """Derivatives of the residuals of the priors by the values."""
        pairs = zip(self.parameters, values, strict=True)
        return np.diag([p.prior.residual_slope(float(value)) for p, value in pairs])

    def step_scale(
        self, y: Float[np.ndarray, " parameter"], noise, mask=None, jacobian=None
    ) -> Float[np.ndarray, " parameter"]:
        """Unit of each search variable: a thousand times the standard error it would have alone.

        In these units all parameters are of one size, and the solver's initial damping, one, hardly
        shortens its first step. The `jacobian` at the point is computed if left out.
        """
        weights = self.weights(noise, mask)
        if jacobian is None:
            _, jacobian = self.linearised(self.values_at(y))
        rows = jacobian * weights[..., None] * self._slopes(y)
        strength = np.sqrt(np.sum(rows**2, axis=(0, 1, 2)))
        return 1e3 / np.maximum(strength, max(1e-9 * strength.max(), 1e-300))

    def cost(self, values, noise, measured) -> float:
        """Half the sum of squared residuals over their noise (or their loss), priors included.

        Infinite where the case cannot be simulated.
        """
        residuals = (measured - self.linearised(values)[0]) * self.weights(noise)
        squares = np.sum(robust_residual(self.loss, residuals) ** 2) + np.sum(
            self.prior_residuals(np.asarray(values)) ** 2
        )
        return float(squares / 2) if np.isfinite(squares) else np.inf

    def weights(self, noise, mask=None) -> Float[np.ndarray, "log time channel"]:
        """One over the noise for measured samples, zero for padding."""
        return (self.data.mask if mask is None else mask) / noise[:, None, :]

    def initial_noise(self, measured) -> Float[np.ndarray, "log channel"]:
        """Noise estimated from second differences, in which a smooth response hardly shows."""
        second_differences = np.abs(np.diff(measured, 2, axis=1))
        mask = self.data.mask
        counted = (mask[:, 2:] * mask[:, 1:-1] * mask[:, :-2]) > 0

        def median(log, channel):
            own = second_differences[log, counted[log, :, channel], channel]
            return np.median(own) if own.size else 0.0

        logs, _, channels = measured.shape
        levels = np.array([[median(i, c) for c in range(channels)] for i in range(logs)])
        return np.maximum(1.4826 * levels / np.sqrt(6), self._noise_floor(1e-6))

    def minimise(
        self,
        point: Float[np.ndarray, " parameter"],
        scale: Float[np.ndarray, " parameter"],
        weights: Float[np.ndarray, "log time channel"],
        measured: Float[np.ndarray, "log time channel"],
        free: Bool[np.ndarray, " parameter"],
    ) -> tuple[Float[np.ndarray, " parameter"], bool]:
        """Search variables at the minimum found from a point, and whether the search converged."""

        start = point / scale

        def linearised(z):
            # At the start exactly the point, whose samples are already computed.
            y = point if z is start else np.where(free, z * scale, point)
            values, slopes = self.values_at(y), self._slopes(y) * np.where(free, scale, 0.0)
            samples, jacobian = self.linearised(values)
            residuals = (measured - samples) * weights
            rows = -jacobian * (robust_slope(self.loss, residuals) * weights)[..., None]
            # A weak Gaussian prior around the start (in the second fit, around the result of the
            # first) keeps unidentifiable directions bounded; it is left out of standard errors.
            weak_prior_residuals = (z * scale - point) / self.weak_prior_widths
            of_samples = robust_residual(self.loss, residuals).ravel()
            found_so_far(SearchPoint(self, values, samples, float(np.sum(of_samples**2) / 2)))
            parts = of_samples, self.prior_residuals(values)
            return np.concatenate([*parts, weak_prior_residuals]), np.vstack(
                [
                    rows.reshape(-1, len(slopes)) * slopes,
                    self._prior_jacobian(values) * slopes,
                    np.diag(scale / self.weak_prior_widths),
                ]
            )

        with np.errstate(all="ignore"):  # of points that cannot be simulated
            found = levenberg_marquardt(linearised, start, RTOL, ATOL, MAX_STEPS)
        return np.where(free, found.point * scale, point), found.converged

    def _uncertainty(self, values, jacobian, mask, noise, widened, residuals, free) -> Uncertainty:
        """Uncertainty from samples and priors; standard errors of held parameters are 0."""
        weights = self.weights(widened, mask)
        if self.loss != "squares":
            sized = (residuals * self.weights(noise, mask))[mask > 0]
            weights = weights / np.sqrt(variance_factor(self.loss, sized))
        rows = (jacobian * weights[..., None]).reshape(-1, len(self.parameters))
        if any(p.prior.mean is not None for p in self.parameters):
            rows = np.vstack([rows, self._prior_jacobian(values)])
        moving = [
            (p.address, p.typical_size_at(float(value)))
            for p, value, moves in zip(self.parameters, values, free, strict=True)
            if moves
        ]
        found = uncertainty(
            [address for address, _ in moving], rows[:, free], np.array([s for _, s in moving])
        )
        if free.all():
            return found
        errors, correlation = np.zeros(free.size), np.eye(free.size)
        errors[free], correlation[np.ix_(free, free)] = found.errors, found.correlation
        return Uncertainty(errors, correlation, found.unidentifiable)

    def _residual_noise(self, residuals, mask) -> Float[np.ndarray, "log channel"]:
        """Standard deviation of the residuals, corrected for the number of parameters.

        Under a robust loss it is estimated from the median of their sizes, which outliers leave as
        it is.
        """
        counts = mask.sum(axis=1)
        free_share = max(1 - len(self.parameters) / counts.sum(), 1e-9)
        squares = np.sum((residuals * mask) ** 2, axis=1)
        noise = np.sqrt(squares / np.maximum(counts, 1) / free_share)
        if self.loss != "squares":
            sizes = np.where(mask > 0, np.abs(residuals), np.nan)
            some = counts > 0
            sizes = np.where(some[:, None, :], sizes, 0.0)
            noise = 1.4826 * np.nanmedian(sizes, axis=1) / np.sqrt(free_share)
        # A log without any weight in the fit has a noise of its own.
        unused = counts == 0
        own = np.sqrt(np.mean(residuals**2, axis=1))
        return np.maximum(np.where(unused, own, noise), self._noise_floor(1e-9))

    def _noise_floor(self, fraction: float) -> Float[np.ndarray, " channel"]:
        """Lower limit of the noise, a fraction of each channel's range: weights stay finite."""
        return np.maximum(fraction * np.ptp(self.data.measured, axis=(0, 1)), 1e-300)

    def _autocorrelation_factors(self, residuals) -> Float[np.ndarray, "log channel"]:
        mask = self.data.mask > 0
        return np.array(
            [
                [autocorrelation_factor(own[has]) for own, has in zip(log.T, valid.T, strict=True)]
                for log, valid in zip(residuals, mask, strict=True)
            ]
        )


STARTS_PER_BLOCK = 8  # starts between two checkpoints
SAME_MINIMUM_DISTANCE = 1e-2  # typical sizes; values closer than that belong to one minimum


@dataclasses.dataclass(frozen=True, eq=False)
class LocalMinimum:
    """A minimum of the misfit, and the number of starts that led to it.

    `cost` is half the sum of weighted squares, `unbounded` the search variables of the values.
    """

    cost: float
    values: Float[np.ndarray, " parameter"]
    unbounded: Float[np.ndarray, " parameter"]
    starts: int
    converged: bool


def draw_start_points(
    parameters: Sequence[FreeParameter], count: int, seed: int
) -> Float[np.ndarray, "start parameter"]:
    """Search points: the parameters' own starts first, then a Latin hypercube.

    Between two bounds the draws are even on the parameter's scale; without, they scatter around
    its own start by about its typical size.
    """
    own = np.array([[p.to_unbounded(p.start) for p in parameters]])
    if count == 1:
        return own
    draws = qmc.LatinHypercube(len(parameters), rng=np.random.default_rng(seed)).random(count - 1)
    columns = []
    for i, parameter in enumerate(parameters):
        if np.isfinite(parameter.high - parameter.low):
            columns.append(parameter.unbounded_at_fraction(np.clip(draws[:, i], 1e-3, 1 - 1e-3)))
        else:
            width = WEAK_PRIOR_WIDTH / 2 * parameter.unbounded_size
            columns.append(own[0, i] + width * norm.ppf(draws[:, i]))
    return np.concatenate([own, np.stack(columns, axis=1)])


def multi_start(
    least_squares: LeastSquares,
    measured: Float[np.ndarray, "log time channel"],
    count: int,
    seed: int,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> list[LocalMinimum]:
    """Minima found from `count` starts, lowest first.

    All searches take the noise estimated from the samples, so that their costs compare. Searches
    that end in values with which the case cannot be simulated are left out. The checkpoint is
    written after each block of starts; a search that finds one goes on from there, to the same
    result.

    Raises ValueError for a checkpoint that is damaged or of another search, and RuntimeError if
    the case cannot be simulated at any of the ends.
    """
    starts = draw_start_points(least_squares.parameters, count, seed)
    noise = least_squares.initial_noise(measured)
    found = checkpoint.load() or {
        "points": np.empty((0, starts.shape[1])),
        "converged": np.empty(0, bool),
    }
    weights, free = least_squares.weights(noise), np.ones(len(least_squares.parameters), bool)
    while len(found["points"]) < count:
        block = starts[len(found["points"]) :][:STARTS_PER_BLOCK]
        scales = np.array([least_squares.step_scale(point, noise) for point in block])
        scales = np.where(np.isfinite(scales), scales, 1.0)
        ends = [
            least_squares.minimise(point, scale, weights, measured, free)
            for point, scale in zip(block, scales, strict=True)
        ]
        points, converged = zip(*ends, strict=True)
        found = {
            "points": np.concatenate([found["points"], points]),
            "converged": np.concatenate([found["converged"], converged]),
        }
        checkpoint.save(found)
    return _distinct_minima(least_squares, measured, noise, found)


def _distinct_minima(least_squares: LeastSquares, measured, noise, found) -> list[LocalMinimum]:
    """Local minima of the ends of searches; ends at the same values are one minimum."""
    sizes = np.array([parameter.typical_size for parameter in least_squares.parameters])
    values = [least_squares.values_at(point) for point in found["points"]]
    costs = np.array([least_squares.cost(value, noise, measured) for value in values])
    minima: list[LocalMinimum] = []
    for i in np.argsort(costs, kind="stable"):
        if not np.isfinite(costs[i]):
            continue
        converged = bool(found["converged"][i])
        for j, minimum in enumerate(minima):
            if np.all(np.abs(minimum.values - values[i]) < SAME_MINIMUM_DISTANCE * sizes):
                minima[j] = dataclasses.replace(
                    minimum,
                    starts=minimum.starts + 1,
                    converged=minimum.converged or converged,
                )
                break
        else:
            point = found["points"][i]
            minima.append(LocalMinimum(float(costs[i]), values[i], point, 1, converged))
    if not minima:
        raise RuntimeError(
            "no start led to values with which the case can be simulated: begin closer to the"
            " logs, or give the free parameters narrower bounds"
        )
    return minima
