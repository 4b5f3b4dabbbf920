"""Weighted least squares over the free numbers of a campaign; noise is found on the way."""

import dataclasses
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Bool, Float

from jaxbeam.runtime.compiling import compiled, xla_options
from tuning.fit.loss import check_loss, robust_residual, variance_factor
from tuning.fit.uncertainty.covariance import Uncertainty, autocorrelation_factor, uncertainty
from tuning.parameters.free import FreeParameter

NOISE_ITERATIONS = 2  # of fitting with the noise levels found in the round before
MAX_STEPS = 60
WEAK_PRIOR_WIDTH = (
    2.0  # width of the weak prior around the starts: a factor of e^2, or two typical sizes
)


@runtime_checkable
class RegressionData(Protocol):
    """What a search needs of a campaign: samples, which of them count, and how to predict them.

    `measured` and `mask` (1 or 0) are (log, time, channel); `predictor` makes of addresses a
    function from values at them to such samples, differentiable forward.
    """

    measured: np.ndarray
    mask: np.ndarray

    def predictor(self, addresses: list[str]) -> Callable:
        """Function from the values at the addresses to all samples."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class LeastSquaresSolution:
    """What came out of a search; `noise` is the standard deviation of the residuals.

    `autocorrelation_factor` is the factor by which their autocorrelation raises variances, 1 for white ones;
    `degrees_of_freedom` counts the independent samples that are left over, by which intervals widen;
    `jacobian` the derivatives of the predicted samples with respect to the values; `unbounded` holds
    the search variables of the values.
    """

    values: Float[np.ndarray, " free"]
    unbounded: Float[np.ndarray, " free"]
    predicted: Float[np.ndarray, "log time channel"]
    noise: Float[np.ndarray, "log channel"]
    autocorrelation_factor: Float[np.ndarray, "log channel"]
    degrees_of_freedom: float
    jacobian: Float[np.ndarray, "log time channel free"]
    uncertainty: Uncertainty
    converged: bool


class LeastSquares:
    """Least squares over the free numbers of a campaign, compiled once for any samples.

    Priors of the numbers count as further residuals. `loss` is one of `tuning.fit.loss`.

    Raises ValueError if there are more numbers than samples, or for an unknown loss.
    """

    def __init__(
        self, data: RegressionData, parameters: list[FreeParameter], loss: str = "squares"
    ):
        check_loss(loss)
        if data.mask.sum() < len(parameters):
            raise ValueError(f"{len(parameters)} free numbers need at least as many samples")
        self.data, self.parameters, self.loss = data, parameters, loss
        self.start_point = np.array([number.to_unbounded(number.start) for number in parameters])
        weak_prior_widths = WEAK_PRIOR_WIDTH * np.array(
            [number.unbounded_size for number in parameters]
        )
        predict = data.predictor([number.address for number in parameters])

        def values_at(y):
            return jnp.stack([number.from_unbounded(y[i]) for i, number in enumerate(parameters)])

        def prior_residuals(values):
            return jnp.stack([n.prior.prior_residual(values[i]) for i, n in enumerate(parameters)])

        def linearised(values):
            # One pass gives samples and derivatives (see `Campaign.predictor`).
            samples, push = jax.linearize(predict, values)
            return samples, jax.vmap(push, out_axes=-1)(jnp.eye(values.shape[0]))

        def misfit(z, args):
            scale, weights, measured, free, held = args
            y = jnp.where(free, z * scale, held)
            values = values_at(y)
            residuals = robust_residual(loss, (measured - predict(values)) * weights)
            # What the data cannot see would wander off, and spoil what they can: a prior too weak
            # to move anything they tell holds it near the start (in the next round, near what was
            # found in the round before). It has no part in the errors.
            weak_prior_residuals = (z * scale - held) / weak_prior_widths
            return jnp.concatenate(
                [residuals.ravel(), prior_residuals(values), weak_prior_residuals]
            )

        solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-6)

        def minimise(y, scale, weights, measured, free):
            found = optimistix.least_squares(
                misfit,
                solver,
                y / scale,
                (scale, weights, measured, free, y),
                max_steps=MAX_STEPS,
                throw=False,
            )
            ended = jnp.where(free, found.value * scale, y)
            return ended, found.result == optimistix.RESULTS.successful

        self.from_unbounded, self.prior_residuals = values_at, prior_residuals
        self._values_at = compiled(values_at)
        self._unbounded_slopes = compiled(lambda y: jnp.diag(jax.jacfwd(values_at)(y)))
        self._prior_residuals, self._prior_jacobian = (
            compiled(prior_residuals),
            compiled(jax.jacfwd(prior_residuals)),
        )
        self._linearised_function, self._minimise_function = linearised, minimise
        self._minimise_batch = compiled(jax.vmap(minimise, (0, 0, None, None, None)))

    @functools.cached_property
    def _compiled_programs(self):
        """The two compiled programs: samples with derivatives, and the whole search."""
        count, samples = len(self.parameters), jnp.zeros(self.data.measured.shape)
        point = jnp.zeros(count)
        given = point, point, samples, samples, jnp.zeros(count, bool)
        # Compiling takes most of the time of a small fit: one beside the other, and its tracing.
        # JAX takes up what it has traced before only under the same mesh, and optimistix traces
        # under one that is empty.
        empty = jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ()))
        with ThreadPoolExecutor(1) as pool, empty:
            linear = pool.submit(
                jax.jit(self._linearised_function).lower(point).compile, xla_options()
            )
            minimise = jax.jit(self._minimise_function).lower(*given).compile(xla_options())
            return linear.result(), minimise

    def solve(
        self,
        measured: Float[np.ndarray, "log time channel"],
        *,
        start: Float[np.ndarray, " free"] | None = None,
        included_logs: Bool[np.ndarray, "log"] | None = None,
        free: Bool[np.ndarray, " free"] | None = None,
    ) -> LeastSquaresSolution:
        """Fit the numbers to samples like those of the campaign, from their starts on.

        `start` are other starts (search variables), `included_logs` says which logs count, `free` which
        numbers move. The noise of each channel is guessed first, then found from the residuals.
        Standard errors are those of the linearised fit (0 for what does not move), widened where
        residuals are correlated in time.

        Raises RuntimeError if the search leaves the range in which the case can be simulated.
        """
        y = self.start_point if start is None else start
        free = np.ones(len(self.parameters), bool) if free is None else free
        mask = self.data.mask
        mask = mask if included_logs is None else mask * included_logs[:, None, None]
        noise = self.initial_noise(measured)
        jacobian = None
        for _ in range(NOISE_ITERATIONS):
            scale = self.step_scale(y, noise, mask, jacobian)
            points, found = self.minimise(
                y[None], scale[None], self.weights(noise, mask), measured, free
            )
            y, converged = points[0], found[0]
            values = self.values_at(y)
            predicted, jacobian = self.linearised(values)
            residuals = measured - predicted
            if not np.all(np.isfinite(residuals)):
                raise RuntimeError(
                    "the fit left the range in which the case can be simulated; give its numbers "
                    "bounds"
                )
            noise = self._residual_noise(residuals, mask)
        factors = self._autocorrelation_factors(residuals)
        counts = mask.sum(axis=1)
        independent = np.sum(counts / factors)
        degrees_of_freedom = max(independent - free.sum(), 1.0)
        # Coloured noise is fitted more closely than white noise: its level looks too low.
        noise_correction = (1 - free.sum() / counts.sum()) * independent / degrees_of_freedom
        widened = noise * np.sqrt(factors * max(noise_correction, 1.0))
        found = self._uncertainty(values, jacobian, mask, noise, widened, residuals, free)
        return LeastSquaresSolution(
            values,
            y,
            predicted,
            noise,
            factors,
            degrees_of_freedom,
            jacobian,
            found,
            bool(converged),
        )

    def linearised(self, values):
        """Predicted samples at some values, and their derivatives (log, time, channel, free)."""
        return tuple(map(np.asarray, self._compiled_programs[0](jnp.asarray(values))))

    def values_at(self, y) -> Float[np.ndarray, " free"]:
        """Values of the numbers at a point of the search."""
        return np.asarray(self._values_at(jnp.asarray(y)))

    def step_scale(
        self, y: Float[np.ndarray, " free"], noise, mask=None, jacobian=None
    ) -> Float[np.ndarray, " free"]:
        """Size of steps of the search: a thousand of the standard errors each would have alone.

        In these units all numbers are of one size, and the solver's first damping, one, hardly
        shortens its first step. The `jacobian` at the point need not be known.
        """
        weights = self.weights(noise, mask)
        if jacobian is None:
            _, jacobian = self.linearised(self.values_at(y))
        rows = jacobian * weights[..., None] * np.asarray(self._unbounded_slopes(y))
        strength = np.sqrt(np.sum(rows**2, axis=(0, 1, 2)))
        return 1e3 / np.maximum(strength, max(1e-9 * strength.max(), 1e-300))

    def cost(self, values, noise, measured, mask=None) -> float:
        """Half the sum of squared residuals in standard deviations of the noise, or their loss.

        Priors have their part. Infinite where the case cannot be simulated.
        """
        residuals = (measured - self.linearised(values)[0]) * self.weights(noise, mask)
        squares = jnp.sum(robust_residual(self.loss, jnp.asarray(residuals)) ** 2) + jnp.sum(
            self._prior_residuals(values) ** 2
        )
        return float(squares / 2) if np.isfinite(squares) else np.inf

    def weights(self, noise, mask=None) -> Float[np.ndarray, "log time channel"]:
        """One over the noise for real samples, zero for those that only fill up."""
        return (self.data.mask if mask is None else mask) / noise[:, None, :]

    def initial_noise(self, measured) -> Float[np.ndarray, "log channel"]:
        """Noise guessed from the second differences, which a smooth response hardly has."""
        second_differences = np.abs(np.diff(measured, 2, axis=1))
        mask = self.data.mask
        counts = (mask[:, 2:] * mask[:, 1:-1] * mask[:, :-2]) > 0
        levels = np.array(
            [
                [np.median(second_differences[i, :, c][counts[i, :, c]]) if counts[i, :, c].any() else 0.0
                 for c in range(second_differences.shape[2])]
                for i in range(len(second_differences))
            ]
        )  # fmt: skip
        return np.maximum(1.4826 * levels / np.sqrt(6), self._noise_floor(1e-6))

    def minimise(
        self,
        points: Float[np.ndarray, "start free"],
        scales: Float[np.ndarray, "start free"],
        weights: Float[np.ndarray, "log time channel"],
        measured: Float[np.ndarray, "log time channel"],
        free: Bool[np.ndarray, " free"],
    ) -> tuple[Float[np.ndarray, "start free"], Bool[np.ndarray, " start"]]:
        """Search points from several starts, and which searches converged.

        On an accelerator all go side by side; on a CPU, one after the other takes no longer, and
        needs no further program.
        """
        shared = [jnp.asarray(part) for part in (weights, measured, free)]
        if len(points) > 1 and jax.default_backend() != "cpu":
            found = self._minimise_batch(jnp.asarray(points), jnp.asarray(scales), *shared)
        else:
            pairs = zip(points, scales, strict=True)
            single = [
                self._compiled_programs[1](jnp.asarray(point), jnp.asarray(scale), *shared)
                for point, scale in pairs
            ]
            found = [np.stack(part) for part in zip(*single, strict=True)]
        return np.asarray(found[0]), np.asarray(found[1])

    def _uncertainty(self, values, jacobian, mask, noise, widened, residuals, free) -> Uncertainty:
        """Standard errors and what is unseen, from samples and priors; 0 for what was held."""
        weights = self.weights(widened, mask)
        if self.loss != "squares":
            sized = (residuals * self.weights(noise, mask))[mask > 0]
            weights = weights / np.sqrt(variance_factor(self.loss, sized))
        rows = (jacobian * weights[..., None]).reshape(-1, len(self.parameters))
        if any(number.prior.mean is not None for number in self.parameters):
            rows = np.vstack([rows, self._prior_jacobian(values)])
        free_parameters = [
            (n, n.typical_size_at(float(v))) for n, v in zip(self.parameters, values, strict=True)
        ]
        free_parameters = [
            pair for pair, free_one in zip(free_parameters, free, strict=True) if free_one
        ]
        found = uncertainty(
            [n.address for n, _ in free_parameters],
            rows[:, free],
            np.array([s for _, s in free_parameters]),
        )
        if free.all():
            return found
        errors, correlation = np.zeros(free.size), np.eye(free.size)
        errors[free], correlation[np.ix_(free, free)] = found.errors, found.correlation
        return Uncertainty(errors, correlation, found.unidentifiable)

    def _residual_noise(self, residuals, mask) -> Float[np.ndarray, "log channel"]:
        """Standard deviation of the residuals, for the numbers fitted to them.

        Under a robust loss, the median of their sizes: outliers are not to raise it.
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
        # A log without any weight tells its noise, too, though not to the fit.
        unused = counts == 0
        own = np.sqrt(np.mean(residuals**2, axis=1))
        return np.maximum(np.where(unused, own, noise), self._noise_floor(1e-9))

    def _noise_floor(self, share: float) -> Float[np.ndarray, " channel"]:
        """Least noise of each channel: a share of its range, so that no weight is infinite."""
        return np.maximum(share * np.ptp(self.data.measured, axis=(0, 1)), 1e-300)

    def _autocorrelation_factors(self, residuals) -> Float[np.ndarray, "log channel"]:
        mask = self.data.mask > 0
        return np.array(
            [
                [autocorrelation_factor(part[has[:, i], i]) for i in range(part.shape[1])]
                for part, has in zip(residuals, mask, strict=True)
            ]
        )
