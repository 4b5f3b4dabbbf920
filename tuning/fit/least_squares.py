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

from jaxbeam.runtime.compiling import compiled, options
from tuning.fit.loss import check_loss, shaped, widening
from tuning.fit.uncertainty.covariance import Uncertainty, colour, uncertainty
from tuning.parameters.free import Free

ROUNDS = 2  # of fitting with the noise levels found in the round before
MAX_STEPS = 60
LEASH = 2.0  # width of the weak prior around the starts: a factor of e^2, or two typical sizes


@runtime_checkable
class Samples(Protocol):
    """What a search needs of a campaign: samples, which of them count, and how to predict them.

    `measured` and `real` (1 or 0) are (log, time, channel); `predictor` makes of addresses a
    function from values at them to such samples, differentiable forward.
    """

    measured: np.ndarray
    real: np.ndarray

    def predictor(self, addresses: list[str]) -> Callable:
        """Function from the values at the addresses to all samples."""
        ...


@dataclasses.dataclass(frozen=True, eq=False)
class Estimate:
    """What came out of a search; `noise` is the standard deviation of the residuals.

    `colour` is the factor by which their autocorrelation raises variances, 1 for white ones;
    `freedom` counts the independent samples that are left over, by which intervals widen;
    `jacobian` the derivatives of the predicted samples with respect to the values; `point` holds
    the search variables of the values.
    """

    values: Float[np.ndarray, " free"]
    point: Float[np.ndarray, " free"]
    predicted: Float[np.ndarray, "log time channel"]
    noise: Float[np.ndarray, "log channel"]
    colour: Float[np.ndarray, "log channel"]
    freedom: float
    jacobian: Float[np.ndarray, "log time channel free"]
    uncertainty: Uncertainty
    converged: bool


class Search:
    """Least squares over the free numbers of a campaign, compiled once for any samples.

    Priors of the numbers count as further residuals. `loss` is one of `tuning.fit.loss`.

    Raises ValueError if there are more numbers than samples, or for an unknown loss.
    """

    def __init__(self, campaign: Samples, numbers: list[Free], loss: str = "squares"):
        check_loss(loss)
        if campaign.real.sum() < len(numbers):
            raise ValueError(f"{len(numbers)} free numbers need at least as many samples")
        self.campaign, self.numbers, self.loss = campaign, numbers, loss
        self.start = np.array([number.inward(number.start) for number in numbers])
        width = LEASH * np.array([number.search_size for number in numbers])
        predict = campaign.predictor([number.address for number in numbers])

        def values_at(y):
            return jnp.stack([number.outward(y[i]) for i, number in enumerate(numbers)])

        def pulls(values):
            return jnp.stack([n.belief.pull(values[i]) for i, n in enumerate(numbers)])

        def linearised(values):
            # One pass gives samples and derivatives (see `Campaign.predictor`).
            samples, push = jax.linearize(predict, values)
            return samples, jax.vmap(push, out_axes=-1)(jnp.eye(values.shape[0]))

        def misfit(z, args):
            scale, weights, measured, free, held = args
            y = jnp.where(free, z * scale, held)
            values = values_at(y)
            residuals = shaped(loss, (measured - predict(values)) * weights)
            # What the data cannot see would wander off, and spoil what they can: a prior too weak
            # to move anything they tell holds it near the start (in the next round, near what was
            # found in the round before). It has no part in the errors.
            leash = (z * scale - held) / width
            return jnp.concatenate([residuals.ravel(), pulls(values), leash])

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

        self.outward, self.pulls = values_at, pulls
        self._values_at = compiled(values_at)
        self._slopes = compiled(lambda y: jnp.diag(jax.jacfwd(values_at)(y)))
        self._pulls, self._push = compiled(pulls), compiled(jax.jacfwd(pulls))
        self._linear, self._minimise = linearised, minimise
        self._side_by_side = compiled(jax.vmap(minimise, (0, 0, None, None, None)))

    @functools.cached_property
    def _programs(self):
        """The two compiled programs: samples with derivatives, and the whole search."""
        count, samples = len(self.numbers), jnp.zeros(self.campaign.measured.shape)
        point = jnp.zeros(count)
        given = point, point, samples, samples, jnp.zeros(count, bool)
        # Compiling takes most of the time of a small fit: one beside the other, and its tracing.
        # JAX takes up what it has traced before only under the same mesh, and optimistix traces
        # under one that is empty.
        empty = jax.sharding.use_abstract_mesh(jax.sharding.AbstractMesh((), ()))
        with ThreadPoolExecutor(1) as pool, empty:
            linear = pool.submit(jax.jit(self._linear).lower(point).compile, options())
            minimise = jax.jit(self._minimise).lower(*given).compile(options())
            return linear.result(), minimise

    def estimate(
        self,
        measured: Float[np.ndarray, "log time channel"],
        *,
        start: Float[np.ndarray, " free"] | None = None,
        use: Bool[np.ndarray, "log"] | None = None,
        free: Bool[np.ndarray, " free"] | None = None,
    ) -> Estimate:
        """Fit the numbers to samples like those of the campaign, from their starts on.

        `start` are other starts (search variables), `use` says which logs count, `free` which
        numbers move. The noise of each channel is guessed first, then found from the residuals.
        Standard errors are those of the linearised fit (0 for what does not move), widened where
        residuals are correlated in time.

        Raises RuntimeError if the search leaves the range in which the case can be simulated.
        """
        y = self.start if start is None else start
        free = np.ones(len(self.numbers), bool) if free is None else free
        real = self.campaign.real
        real = real if use is None else real * use[:, None, None]
        noise = self.first_noise(measured)
        jacobian = None
        for _ in range(ROUNDS):
            scale = self.scale(y, noise, real, jacobian)
            points, found = self.minimise(
                y[None], scale[None], self.weights(noise, real), measured, free
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
            noise = self._noise(residuals, real)
        colours = self._colours(residuals)
        counts = real.sum(axis=1)
        independent = np.sum(counts / colours)
        freedom = max(independent - free.sum(), 1.0)
        # Coloured noise is fitted more closely than white noise: its level looks too low.
        lost = (1 - free.sum() / counts.sum()) * independent / freedom
        widened = noise * np.sqrt(colours * max(lost, 1.0))
        found = self._uncertainty(values, jacobian, real, noise, widened, residuals, free)
        return Estimate(
            values, y, predicted, noise, colours, freedom, jacobian, found, bool(converged)
        )

    def linearised(self, values):
        """Predicted samples at some values, and their derivatives (log, time, channel, free)."""
        return tuple(map(np.asarray, self._programs[0](jnp.asarray(values))))

    def values_at(self, y) -> Float[np.ndarray, " free"]:
        """Values of the numbers at a point of the search."""
        return np.asarray(self._values_at(jnp.asarray(y)))

    def scale(
        self, y: Float[np.ndarray, " free"], noise, real=None, jacobian=None
    ) -> Float[np.ndarray, " free"]:
        """Size of steps of the search: a thousand of the standard errors each would have alone.

        In these units all numbers are of one size, and the solver's first damping, one, hardly
        shortens its first step. The `jacobian` at the point need not be known.
        """
        weights = self.weights(noise, real)
        if jacobian is None:
            _, jacobian = self.linearised(self.values_at(y))
        rows = jacobian * weights[..., None] * np.asarray(self._slopes(y))
        strength = np.sqrt(np.sum(rows**2, axis=(0, 1, 2)))
        return 1e3 / np.maximum(strength, max(1e-9 * strength.max(), 1e-300))

    def cost(self, values, noise, measured, real=None) -> float:
        """Half the sum of squared residuals in standard deviations of the noise, or their loss.

        Priors have their part. Infinite where the case cannot be simulated.
        """
        residuals = (measured - self.linearised(values)[0]) * self.weights(noise, real)
        squares = jnp.sum(shaped(self.loss, jnp.asarray(residuals)) ** 2) + jnp.sum(
            self._pulls(values) ** 2
        )
        return float(squares / 2) if np.isfinite(squares) else np.inf

    def weights(self, noise, real=None) -> Float[np.ndarray, "log time channel"]:
        """One over the noise for real samples, zero for those that only fill up."""
        return (self.campaign.real if real is None else real) / noise[:, None, :]

    def first_noise(self, measured) -> Float[np.ndarray, "log channel"]:
        """Noise guessed from the second differences, which a smooth response hardly has."""
        bends = np.abs(np.diff(measured, 2, axis=1))
        real = self.campaign.real
        counts = (real[:, 2:] * real[:, 1:-1] * real[:, :-2]) > 0
        levels = np.array(
            [
                [np.median(bends[i, :, c][counts[i, :, c]]) if counts[i, :, c].any() else 0.0
                 for c in range(bends.shape[2])]
                for i in range(len(bends))
            ]
        )  # fmt: skip
        return np.maximum(1.4826 * levels / np.sqrt(6), self._floor(1e-6))

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
            found = self._side_by_side(jnp.asarray(points), jnp.asarray(scales), *shared)
        else:
            pairs = zip(points, scales, strict=True)
            single = [
                self._programs[1](jnp.asarray(point), jnp.asarray(scale), *shared)
                for point, scale in pairs
            ]
            found = [np.stack(part) for part in zip(*single, strict=True)]
        return np.asarray(found[0]), np.asarray(found[1])

    def _uncertainty(self, values, jacobian, real, noise, widened, residuals, free) -> Uncertainty:
        """Standard errors and what is unseen, from samples and priors; 0 for what was held."""
        weights = self.weights(widened, real)
        if self.loss != "squares":
            sized = (residuals * self.weights(noise, real))[real > 0]
            weights = weights / np.sqrt(widening(self.loss, sized))
        rows = (jacobian * weights[..., None]).reshape(-1, len(self.numbers))
        if any(number.belief.mean is not None for number in self.numbers):
            rows = np.vstack([rows, self._push(values)])
        moved = [(n, n.size_at(float(v))) for n, v in zip(self.numbers, values, strict=True)]
        moved = [pair for pair, free_one in zip(moved, free, strict=True) if free_one]
        found = uncertainty(
            [n.address for n, _ in moved], rows[:, free], np.array([s for _, s in moved])
        )
        if free.all():
            return found
        errors, correlation = np.zeros(free.size), np.eye(free.size)
        errors[free], correlation[np.ix_(free, free)] = found.errors, found.correlation
        return Uncertainty(errors, correlation, found.unseen)

    def _noise(self, residuals, real) -> Float[np.ndarray, "log channel"]:
        """Standard deviation of the residuals, for the numbers fitted to them.

        Under a robust loss, the median of their sizes: outliers are not to raise it.
        """
        counts = real.sum(axis=1)
        left = max(1 - len(self.numbers) / counts.sum(), 1e-9)
        squares = np.sum((residuals * real) ** 2, axis=1)
        noise = np.sqrt(squares / np.maximum(counts, 1) / left)
        if self.loss != "squares":
            sizes = np.where(real > 0, np.abs(residuals), np.nan)
            some = counts > 0
            sizes = np.where(some[:, None, :], sizes, 0.0)
            noise = 1.4826 * np.nanmedian(sizes, axis=1) / np.sqrt(left)
        # A log without any weight tells its noise, too, though not to the fit.
        unused = counts == 0
        own = np.sqrt(np.mean(residuals**2, axis=1))
        return np.maximum(np.where(unused, own, noise), self._floor(1e-9))

    def _floor(self, share: float) -> Float[np.ndarray, " channel"]:
        """Least noise of each channel: a share of its range, so that no weight is infinite."""
        return np.maximum(share * np.ptp(self.campaign.measured, axis=(0, 1)), 1e-300)

    def _colours(self, residuals) -> Float[np.ndarray, "log channel"]:
        real = self.campaign.real > 0
        return np.array(
            [
                [colour(part[has[:, i], i]) for i in range(part.shape[1])]
                for part, has in zip(residuals, real, strict=True)
            ]
        )
