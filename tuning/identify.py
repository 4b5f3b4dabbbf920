"""Model identification: numbers of a case from logged runs, by least squares."""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Float

from jaxbeam.case import Case, replace
from tuning.campaign import Campaign, prepare
from tuning.free import OF_LOG, Free, free_numbers, insert
from tuning.logs import Log
from tuning.report import fit_table
from tuning.uncertainty import INTERVAL, colour, uncertainty

ROUNDS = 2  # of fitting with the noise levels found in the round before
MAX_STEPS = 60


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """Result of an identification.

    `values` and `errors` (standard errors) are in SI units in the order of `addresses`; an error
    is infinite where the data cannot tell, and `unseen` says by name in which directions that is.
    `noise` (log, channel) is the standard deviation of the residuals.
    """

    addresses: list[str]
    starts: Float[np.ndarray, " free"]
    values: Float[np.ndarray, " free"]
    errors: Float[np.ndarray, " free"]
    correlation: Float[np.ndarray, "free free"]
    unseen: list[dict[str, float]]
    at_bound: list[str]
    noise: Float[np.ndarray, "log channel"]
    verdict: str
    case: Case
    campaign: Campaign
    fitted: Float[np.ndarray, "log time channel"]

    @property
    def intervals(self) -> Float[np.ndarray, "free 2"]:
        """95 % intervals; infinite where the data cannot tell."""
        reach = INTERVAL * self.errors
        return np.stack([self.values - reach, self.values + reach], axis=1)

    @property
    def cases(self) -> list[Case]:
        """The fitted case of every log, with the loads that crossed."""
        values = dict(zip(self.addresses, self.values, strict=True))
        return [insert(case, i, values) for i, case in enumerate(self.campaign.cases)]

    def __str__(self) -> str:
        return fit_table(self)

    def to_dict(self) -> dict:
        """The fit as plain numbers and words, for JSON; unknown errors are None."""
        numbers = {}
        rows = zip(self.addresses, self.starts, self.values, self.errors, strict=True)
        for (address, start, value, error), interval in zip(rows, self.intervals, strict=True):
            seen = bool(np.isfinite(error))
            numbers[address] = {
                "value": float(value),
                "standard_error": float(error) if seen else None,
                "interval_95": interval.tolist() if seen else None,
                "start": float(start),
                "at_bound": address in self.at_bound,
            }
        correlation = [
            [None if np.isnan(c) else c for c in row] for row in self.correlation.tolist()
        ]
        return {
            "numbers": numbers,
            "correlation": correlation,
            "unseen": self.unseen,
            "noise": self.noise.tolist(),
            "verdict": self.verdict,
        }

    def plot(self):
        """Figure of measured, fitted and residual, one column a log."""
        from jaxbeam.plot import FitPanel, plot_fit

        panels = []
        for i, log in enumerate(self.campaign.logs):
            count = log.times.size
            panels.append(
                FitPanel(
                    title=log.source.rsplit("/", 1)[-1],
                    times=log.times,
                    measured=self.campaign.measured[i, :count],
                    fitted=self.fitted[i, :count],
                    names=[f"sensor {n}" for n in range(self.fitted.shape[2])],
                    unit="m",
                )
            )
        return plot_fit(panels, title=self.case.title)


def identify(
    case: Case,
    logs: Log | Sequence[Log],
    free: dict[str, tuple[float, float] | None] | Sequence[str],
) -> Fit:
    """Fit numbers of a case to logs of runs with known loads.

    `free` names addresses, each with bounds (low, high) or None; a number of one log, such as its
    load's speed, is at `logs.0.loads.0.speed`. Loads are those of the logs, or else the case's.
    The sum of squared residuals over their noise is minimised by bounded Levenberg-Marquardt
    (optimistix) with exact forward derivatives; noise levels of the channels are estimated from
    the residuals. Standard errors follow from the Jacobian, widened where residuals are
    correlated in time; directions the data cannot see are reported by name.

    Raises ValueError for faulty input, and RuntimeError if the simulation cannot follow.
    """
    logs = [logs] if isinstance(logs, Log) else list(logs)
    bounds = dict(free) if isinstance(free, dict) else dict.fromkeys(free)
    campaign = prepare(case, logs)
    reading = float(np.max(np.abs(campaign.measured)))
    numbers = free_numbers(campaign.cases, bounds, reading)
    addresses = [number.address for number in numbers]
    y = jnp.array([number.inward(number.start) for number in numbers])
    noise = first_noise(campaign)
    search = Search(campaign, numbers)
    for _ in range(ROUNDS):
        y, values, predicted, jacobian, verdict = search.run(y, noise)
        residuals = campaign.measured - np.asarray(predicted)
        noise = _noise(campaign, residuals, len(numbers))
    widened = noise * np.sqrt(_colours(campaign, residuals))
    rows = np.asarray(jacobian) * (campaign.real[..., None] / widened[:, None, :])[..., None]
    sizes = np.array([number.size for number in numbers])
    found = uncertainty(addresses, rows.reshape(-1, len(numbers)), sizes)
    by_address = {address: float(v) for address, v in zip(addresses, values, strict=True)}
    return Fit(
        addresses=addresses,
        starts=np.array([number.start for number in numbers]),
        values=np.asarray(values),
        errors=found.errors,
        correlation=found.correlation,
        unseen=found.unseen,
        at_bound=[n.address for n in numbers if n.at_bound(by_address[n.address])],
        noise=noise,
        verdict=verdict,
        case=_fitted_case(case, campaign, by_address),
        campaign=campaign,
        fitted=np.asarray(predicted),
    )


def first_noise(campaign: Campaign) -> Float[np.ndarray, "log channel"]:
    """Noise of each channel guessed from its second differences, which a smooth response lacks."""
    levels = []
    for log, values in zip(campaign.logs, campaign.measured, strict=True):
        bends = np.diff(values[: log.times.size], 2, axis=0)
        levels.append(1.4826 * np.median(np.abs(bends), axis=0) / np.sqrt(6))
    levels = np.array(levels)
    span = np.ptp(campaign.measured, axis=(0, 1))
    return np.maximum(levels, 1e-6 * np.maximum(span, 1e-300))


def _noise(campaign: Campaign, residuals, free: int) -> Float[np.ndarray, "log channel"]:
    """Standard deviation of the residuals, for the numbers fitted to them."""
    counts = campaign.real.sum(axis=1)[:, None]
    lost = free / (counts.sum() * residuals.shape[2])
    squares = np.sum((residuals * campaign.real[..., None]) ** 2, axis=1)
    floor = 1e-9 * np.ptp(campaign.measured, axis=(0, 1))
    return np.maximum(np.sqrt(squares / counts / (1 - lost)), np.maximum(floor, 1e-300))


def _colours(campaign: Campaign, residuals) -> Float[np.ndarray, "log channel"]:
    return np.array(
        [
            [colour(part[: log.times.size, i]) for i in range(part.shape[1])]
            for log, part in zip(campaign.logs, residuals, strict=True)
        ]
    )


class Search:
    """Least squares over the free numbers of a campaign, compiled once for any noise levels."""

    def __init__(self, campaign: Campaign, numbers: list[Free]):
        if campaign.real.sum() * campaign.measured.shape[2] < len(numbers):
            raise ValueError(f"{len(numbers)} free numbers need at least as many samples")
        self._campaign = campaign
        predict = campaign.predictor([number.address for number in numbers])
        measured = jnp.asarray(campaign.measured)

        def values_at(y):
            return jnp.stack([number.outward(y[i]) for i, number in enumerate(numbers)])

        def linearised(values):
            # One pass gives samples and derivatives (see `Campaign.predictor`).
            samples, push = jax.linearize(predict, values)
            return samples, jax.vmap(push, out_axes=-1)(jnp.eye(values.shape[0]))

        def misfit(z, args):
            scale, weights = args
            return ((measured - predict(values_at(z * scale))) * weights).ravel()

        solver = optimistix.LevenbergMarquardt(rtol=1e-8, atol=1e-6)

        def minimise(y, scale, weights):
            found = optimistix.least_squares(
                misfit, solver, y / scale, (scale, weights), max_steps=MAX_STEPS, throw=False
            )
            return found.value * scale, found.result

        self._values_at = eqx.filter_jit(values_at)
        self._slopes = eqx.filter_jit(lambda y: jnp.diag(jax.jacfwd(values_at)(y)))
        self._linearised = eqx.filter_jit(linearised)
        self._minimise = eqx.filter_jit(minimise)

    def run(self, y, noise):
        """Minimise the squared residuals over the noise (log, channel) from a search point on.

        Returns the search point, the values, the predicted samples, their derivatives by the
        values, and a sentence on how it ended. Raises RuntimeError if it leaves the range in which
        the case can be simulated.
        """
        weights = self._campaign.real[..., None] / noise[:, None, :]
        # In units of a thousand of the standard errors that each would have alone, all numbers
        # are of one size, and the solver's first damping, one, hardly shortens its first step.
        _, jacobian = self._linearised(self._values_at(y))
        rows = np.asarray(jacobian) * weights[..., None] * np.asarray(self._slopes(y))
        strength = np.sqrt(np.sum(rows**2, axis=(0, 1, 2)))
        scale = jnp.asarray(1e3 / np.maximum(strength, 1e-9 * strength.max()))
        y, result = self._minimise(y, scale, jnp.asarray(weights))
        values = self._values_at(y)
        if not np.all(np.isfinite(values)):
            raise RuntimeError(
                "the fit left the range in which the case can be simulated; give its numbers bounds"
            )
        ended = result == optimistix.RESULTS.successful
        verdict = (
            "converged" if ended else f"not converged after {MAX_STEPS} steps: start elsewhere"
        )
        return y, values, *self._linearised(values), verdict


def _fitted_case(case: Case, campaign: Campaign, values: dict[str, float]) -> Case:
    """The case with what was fitted; the loads of a single log become its own."""
    if len(campaign.logs) == 1:
        fitted = insert(campaign.cases[0], 0, values)
        return replace(fitted, {"run.duration": case.run.duration})
    shared = {address: v for address, v in values.items() if not OF_LOG.fullmatch(address)}
    return replace(case, {a: v for a, v in shared.items() if not a.startswith("loads.")})
