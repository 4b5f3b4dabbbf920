"""Whether a fitted model may be believed: its residuals, its rivals, and logs it has not seen."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from jaxbeam.runtime.compiling import compiled
from tuning.fit.dataset import make_dataset
from tuning.fit.uncertainty.covariance import autocorrelation_factor
from tuning.logs.log import Log

if TYPE_CHECKING:
    from tuning.fit.identify import Fit

LJUNG_BOX_LAGS = 20  # of the autocorrelation that the whiteness test looks at
WHITENESS_SIGNIFICANCE = (
    0.01  # probability of residuals at least so coloured by chance, below which it is said
)
MIN_TIME_SHIFT_SD = 4.0  # standard errors that a time shift must have to be told
MAX_RESIDUAL_RATIO = 1.5  # how much larger than in the fit residuals of unseen logs may be


def whiteness_p_value(residual: Float[np.ndarray, " time"]) -> float:
    """Probability that white noise looks at least so coloured: the test of Ljung and Box (1978).

    Q = n (n + 2) sum r_k^2 / (n - k) over the first lags k, against chi-square.
    """
    centred = residual - residual.mean()
    count, power = centred.size, float(centred @ centred)
    lags = np.arange(1, min(LJUNG_BOX_LAGS, count // 4) + 1)
    if power == 0.0 or not lags.size:
        return 1.0
    correlations = np.array([centred[:-k] @ centred[k:] for k in lags]) / power
    statistic = count * (count + 2) * np.sum(correlations**2 / (count - lags))
    return float(chi2.sf(statistic, lags.size))


@dataclasses.dataclass(frozen=True)
class ChannelResiduals:
    """Residuals of one sensor in one log: level, whiteness, and how late the readings seem.

    `noise` is in the SI unit of the sensor, `p_value` that of `whiteness_p_value`, `autocorrelation_factor` the factor
    by which correlation raises variances, `time_shift` the delay (s) of the log against the model with
    its standard error.
    """

    log: int
    sensor: int
    noise: float
    p_value: float
    autocorrelation_factor: float
    time_shift: float
    time_shift_sd: float


def residual_remarks(found: Sequence[ChannelResiduals], logs: Sequence[Log]) -> list[str]:
    """What is to be said of residuals, in a sentence each; nothing if all is well."""
    remarks = []
    for i, log in enumerate(logs):
        coloured = [c for c in found if c.log == i and c.p_value < WHITENESS_SIGNIFICANCE]
        if coloured:
            factors = ", ".join(
                f"{c.autocorrelation_factor:.2g} at sensor {c.sensor}" for c in coloured
            )
            remarks.append(
                f"{log.source}: residuals are no white noise, so the model misses something and "
                f"its intervals are unreliable: widened for it (variances times {factors}), they "
                "cannot make up for values that are put off"
            )
        for c in found:
            if c.log == i and abs(c.time_shift) > MIN_TIME_SHIFT_SD * c.time_shift_sd:
                what = "late" if c.time_shift > 0 else "early"
                remarks.append(
                    f"{log.source}: sensor {c.sensor} seems {1e3 * abs(c.time_shift):.3g} ms {what} "
                    f"(+- {2e3 * c.time_shift_sd:.2g} ms): free its delay, or check its clock"
                )
    return remarks


def channel_residuals(fit: Fit) -> list[ChannelResiduals]:
    """Look at the residuals of each sensor in each log.

    A delay d of the readings leaves d times the rate of the fitted reading, to first order; it is
    regressed on that rate.
    """
    found = []
    for i, (residuals, fitted) in enumerate(zip(fit.residuals, fit.fitted, strict=True)):
        rates = -np.gradient(fitted, fit.dataset.times[i], axis=0)
        for j in range(residuals.shape[1]):
            has = np.isfinite(residuals[:, j])
            if not has.any():
                continue
            residual, rate = residuals[has, j], rates[has, j]
            strength = max(float(rate @ rate), 1e-300)
            shift = float(residual @ rate) / strength
            remaining = residual - shift * rate
            found.append(
                ChannelResiduals(
                    log=i,
                    sensor=j,
                    noise=float(fit.noise[i, j]),
                    p_value=whiteness_p_value(residual),
                    autocorrelation_factor=float(fit.autocorrelation_factor[i, j]),
                    time_shift=shift,
                    time_shift_sd=float(
                        remaining.std() * np.sqrt(autocorrelation_factor(remaining) / strength)
                    ),
                )
            )
    return found


@dataclasses.dataclass(frozen=True)
class ModelCriteria:
    """One of several models of the same logs: criteria in nats doubled, lower is better.

    `log_likelihood` counts independent samples; `weight` is that of Akaike among the rivals.
    """

    name: str
    parameter_count: int
    log_likelihood: float
    aic: float
    bic: float
    weight: float


def compare_fits(fits: Mapping[str, Fit]) -> list[ModelCriteria]:
    """Information criteria of fits of different models to the same logs, best (BIC) first.

    AIC = 2 k - 2 ln L and BIC = k ln n - 2 ln L with ln L = -n / 2 (ln(2 pi s^2) + 1) summed over
    channels. As residuals may be coloured, n counts independent samples: those of the fit with the
    least residuals, the same for all.

    Raises ValueError for fewer than two fits, and fits to other samples.
    """
    if len(fits) < 2:
        raise ValueError("give at least two fits to compare")
    first, *others = fits.values()
    for other in others:
        same = other.dataset.measured.shape == first.dataset.measured.shape
        if not same or np.any(other.dataset.measured != first.dataset.measured):
            raise ValueError("the fits are of other samples; criteria only compare the same")
    counts = first.dataset.mask.sum(axis=1)
    squares = {
        name: np.nansum(fit.residuals**2, axis=1) / np.maximum(counts, 1)
        for name, fit in fits.items()
    }
    has = counts > 0
    best = min(fits, key=lambda name: np.sum(counts[has] * np.log(squares[name][has] + 1e-300)))
    independent = (counts / fits[best].autocorrelation_factor)[has]
    rows = {}
    for name, fit in fits.items():
        level = np.log(2 * np.pi * (squares[name][has] + 1e-300)) + 1
        rows[name] = len(fit.parameters), float(-np.sum(independent * level) / 2)
    aic = {name: 2 * k - 2 * likely for name, (k, likely) in rows.items()}
    relative_likelihoods = np.exp(-(np.array(list(aic.values())) - min(aic.values())) / 2)
    weights = dict(zip(aic, relative_likelihoods / relative_likelihoods.sum(), strict=True))
    criteria = [
        ModelCriteria(
            name,
            k,
            likely,
            aic[name],
            k * float(np.log(independent.sum())) - 2 * likely,
            float(weights[name]),
        )
        for name, (k, likely) in rows.items()
    ]
    return sorted(criteria, key=lambda rival: rival.bic)


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOutPrediction:
    """A log predicted by a fit that did not use it.

    `residual_ratio` (sensor,) is the standard deviation of what is left over that of the noise in the
    fit: one is perfect, NaN where nothing was measured.
    """

    log: str
    residual_ratio: Float[np.ndarray, " sensor"]

    @property
    def verdict(self) -> str:
        """One sentence."""
        worst = float(np.nanmax(self.residual_ratio))
        word = "predicted" if worst < MAX_RESIDUAL_RATIO else "not predicted"
        return f"{self.log}: {word}; residuals are {worst:.3g} times the noise at most"


def cross_validate(fit: Fit) -> list[HeldOutPrediction]:
    """Leave out one log after the other, fit the rest, and predict the one left out.

    Numbers of the log left out stay at their starts (its speed and entry time, say), so logs with
    such numbers count only as well as these are known. Nothing is compiled anew.

    Raises ValueError for a single log.
    """
    dataset = fit.dataset
    count = len(dataset.logs)
    if count < 2:
        raise ValueError("to leave one log out there must be at least two")
    found = []
    for i, log in enumerate(dataset.logs):
        use = np.arange(count) != i
        solution = fit.least_squares.solve(dataset.measured, included_logs=use)
        noise = np.sqrt(np.nanmean(np.where(use[:, None], fit.noise, np.nan) ** 2, axis=0))
        parts = dataset.measured[i], solution.predicted[i], dataset.mask[i]
        found.append(_held_out_prediction(log.source, *parts, noise))
    return found


def predict_held_out(fit: Fit, logs: Sequence[Log]) -> list[HeldOutPrediction]:
    """Predict logs that the fit has not seen with the fitted case, and their own loads.

    Raises ValueError as `identify` does for logs that do not match the case.
    """
    dataset = make_dataset(fit.case, list(logs))
    predict = compiled(dataset.predictor(["run.gravity"]))
    predicted = np.asarray(predict(jnp.asarray([float(fit.case.run.gravity)])))
    noise = np.sqrt(np.nanmean(fit.noise**2, axis=0))
    return [
        _held_out_prediction(log.source, dataset.measured[i], predicted[i], dataset.mask[i], noise)
        for i, log in enumerate(dataset.logs)
    ]


def _held_out_prediction(source, measured, predicted, mask, noise) -> HeldOutPrediction:
    counts = mask.sum(axis=0)
    squares = np.sum(((measured - predicted) * mask) ** 2, axis=0) / np.maximum(counts, 1)
    return HeldOutPrediction(source, np.where(counts > 0, np.sqrt(squares) / noise, np.nan))
