"""Weighted least squares over the free numbers of a campaign; noise is found on the way."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float

from jaxbeam.compiling import compiled, options
from tuning.campaign import Campaign
from tuning.free import Free
from tuning.uncertainty import Uncertainty, colour, uncertainty

ROUNDS = 2  # of fitting with the noise levels found in the round before
MAX_STEPS = 60
LEASH = 2.0  # width of the weak prior around the starts: a factor of e^2, or two typical sizes


@dataclasses.dataclass(frozen=True, eq=False)
class Estimate:
    """What came out of a search; `noise` is the standard deviation of the residuals."""

    values: Float[np.ndarray, " free"]
    predicted: Float[np.ndarray, "log time channel"]
    noise: Float[np.ndarray, "log channel"]
    uncertainty: Uncertainty
    converged: bool


class Search:
    """Least squares over the free numbers of a campaign, compiled once for any samples.

    Raises ValueError if there are more numbers than samples.
    """

    def __init__(self, campaign: Campaign, numbers: list[Free]):
        if campaign.real.sum() < len(numbers):
            raise ValueError(f"{len(numbers)} free numbers need at least as many samples")
        self.campaign, self.numbers = campaign, numbers
        self._start = jnp.array([number.inward(number.start) for number in numbers])
        start, width = self._start, LEASH * jnp.array([number.search_size for number in numbers])
        predict = campaign.predictor([number.address for number in numbers])

        def values_at(y):
            return jnp.stack([number.outward(y[i]) for i, number in enumerate(numbers)])

        def linearised(values):
            # One pass gives samples and derivatives (see `Campaign.predictor`).
            samples, push = jax.linearize(predict, values)
            return samples, jax.vmap(push, out_axes=-1)(jnp.eye(values.shape[0]))

        def misfit(z, args):
            scale, weights, measured = args
            y = z * scale
            residuals = (measured - predict(values_at(y))) * weights
            # What the data cannot see would wander off, and spoil what they can: a prior too weak
            # to move anything they tell holds it near the start. It has no part in the errors.
            return jnp.append(residuals.ravel(), (y - start) / width)

        solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-6)

        def minimise(y, scale, weights, measured):
            found = optimistix.least_squares(
                misfit,
                solver,
                y / scale,
                (scale, weights, measured),
                max_steps=MAX_STEPS,
                throw=False,
            )
            return found.value * scale, found.result == optimistix.RESULTS.successful

        self._values_at = compiled(values_at)
        self._slopes = compiled(lambda y: jnp.diag(jax.jacfwd(values_at)(y)))
        # Compiling takes most of the time of a small fit: both at once, each on its own core.
        point, samples = jnp.zeros(len(numbers)), jnp.zeros(campaign.measured.shape)
        lowered = (
            jax.jit(linearised).lower(point),
            jax.jit(minimise).lower(point, point, samples, samples),
        )
        with ThreadPoolExecutor(2) as pool:
            self._linearised, self._minimise = pool.map(
                lambda program: program.compile(options()), lowered
            )

    def estimate(self, measured: Float[np.ndarray, "log time channel"]) -> Estimate:
        """Fit the numbers to samples like those of the campaign, from their starts on.

        The noise of each channel is guessed first, then found from the residuals. Standard errors
        are those of the linearised fit, widened where residuals are correlated in time. Raises
        RuntimeError if the search leaves the range in which the case can be simulated.
        """
        y = self._start
        noise = self._first_noise(measured)
        for _ in range(ROUNDS):
            y, converged = self._search(y, noise, measured)
            values = self._values_at(y)
            predicted, jacobian = self._linearised(values)
            residuals = measured - np.asarray(predicted)
            if not np.all(np.isfinite(residuals)):
                raise RuntimeError(
                    "the fit left the range in which the case can be simulated; give its numbers "
                    "bounds"
                )
            noise = self._noise(residuals)
        weights = self._weights(noise * np.sqrt(self._colours(residuals)))
        found = uncertainty(
            [number.address for number in self.numbers],
            (np.asarray(jacobian) * weights[..., None]).reshape(-1, len(self.numbers)),
            np.array([n.size_at(float(v)) for n, v in zip(self.numbers, values, strict=True)]),
        )
        return Estimate(np.asarray(values), np.asarray(predicted), noise, found, bool(converged))

    def _search(self, y: Float[Array, " free"], noise, measured):
        """Search point of the least squares for these noise levels, and whether it converged."""
        weights = self._weights(noise)
        # In units of a thousand of the standard errors that each would have alone, all numbers
        # are of one size, and the solver's first damping, one, hardly shortens its first step.
        _, jacobian = self._linearised(self._values_at(y))
        rows = np.asarray(jacobian) * weights[..., None] * np.asarray(self._slopes(y))
        strength = np.sqrt(np.sum(rows**2, axis=(0, 1, 2)))
        scale = 1e3 / np.maximum(strength, max(1e-9 * strength.max(), 1e-300))
        return self._minimise(y, jnp.asarray(scale), jnp.asarray(weights), jnp.asarray(measured))

    def _weights(self, noise) -> Float[np.ndarray, "log time channel"]:
        """One over the noise for real samples, zero for those that only fill up."""
        return self.campaign.real / noise[:, None, :]

    def _first_noise(self, measured) -> Float[np.ndarray, "log channel"]:
        """Noise guessed from the second differences, which a smooth response hardly has."""
        levels = []
        for log, values in zip(self.campaign.logs, measured, strict=True):
            bends = np.diff(values[: log.times.size], 2, axis=0)
            levels.append(1.4826 * np.median(np.abs(bends), axis=0) / np.sqrt(6))
        return np.maximum(np.array(levels), self._floor(1e-6))

    def _noise(self, residuals) -> Float[np.ndarray, "log channel"]:
        """Standard deviation of the residuals, for the numbers fitted to them."""
        counts = self.campaign.real.sum(axis=1)
        left = max(1 - len(self.numbers) / counts.sum(), 1e-9)
        squares = np.sum((residuals * self.campaign.real) ** 2, axis=1)
        return np.maximum(np.sqrt(squares / np.maximum(counts, 1) / left), self._floor(1e-9))

    def _floor(self, share: float) -> Float[np.ndarray, " channel"]:
        """Least noise of each channel: a share of its range, so that no weight is infinite."""
        return np.maximum(share * np.ptp(self.campaign.measured, axis=(0, 1)), 1e-300)

    def _colours(self, residuals) -> Float[np.ndarray, "log channel"]:
        return np.array(
            [
                [colour(part[: log.times.size, i]) for i in range(part.shape[1])]
                for log, part in zip(self.campaign.logs, residuals, strict=True)
            ]
        )
