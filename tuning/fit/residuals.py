"""Residuals of a fit, sensor by sensor: whiteness, autocorrelation and time shift."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from tuning.fit.uncertainty.covariance import autocorrelation, autocorrelation_factor

LJUNG_BOX_LAGS = 20  # lags of the autocorrelation in the whiteness test
WHITENESS_SIGNIFICANCE = 0.01  # p-value below which residuals are called autocorrelated
MIN_TIME_SHIFT_SD = 4.0  # standard errors beyond which a time shift is reported


@dataclasses.dataclass(frozen=True)
class ChannelResiduals:
    """Residuals of one sensor in one log.

    `noise` is their standard deviation in the SI unit of the sensor; `p_value` that of
    `whiteness_p_value`; `autocorrelation_factor` the factor by which autocorrelation raises
    variances; `time_shift` (s) the delay of the log against the model, with its standard error.
    """

    log: int
    sensor: int
    noise: float
    p_value: float
    autocorrelation_factor: float
    time_shift: float
    time_shift_sd: float


def whiteness_p_value(residual: Float[np.ndarray, " time"]) -> float:
    """p-value of the whiteness test of Ljung and Box (1978).

    Q = n (n + 2) sum r_k^2 / (n - k) over the first lags k, against chi-square.
    """
    centred = residual - residual.mean()
    count = centred.size
    lags = range(1, min(LJUNG_BOX_LAGS, count // 4) + 1)
    if float(centred @ centred) == 0.0 or not lags:
        return 1.0
    correlations = np.array([autocorrelation(centred, lag) for lag in lags])
    statistic = count * (count + 2) * np.sum(correlations**2 / (count - np.array(lags)))
    return float(chi2.sf(statistic, len(lags)))


def channel_residuals(
    times: Float[np.ndarray, "log time"],
    fitted: Float[np.ndarray, "log time channel"],
    residuals: Float[np.ndarray, "log time channel"],
    noise: Float[np.ndarray, "log channel"],
    autocorrelation_factors: Float[np.ndarray, "log channel"],
) -> list[ChannelResiduals]:
    """Residuals of each sensor in each log that has it; samples that are NaN are left out.

    A delay d of the readings leaves d times the rate of the fitted reading, to first order; the
    time shift is the regression of the residuals on minus that rate.
    """
    found = []
    for i, log_residuals in enumerate(residuals):
        rates = -np.gradient(fitted[i], times[i], axis=0)
        for j in range(residuals.shape[2]):
            has = np.isfinite(log_residuals[:, j])
            if not has.any():
                continue
            residual, rate = log_residuals[has, j], rates[has, j]
            strength = max(float(rate @ rate), 1e-300)
            shift = float(residual @ rate) / strength
            remaining = residual - shift * rate
            found.append(
                ChannelResiduals(
                    log=i,
                    sensor=j,
                    noise=float(noise[i, j]),
                    p_value=whiteness_p_value(residual),
                    autocorrelation_factor=float(autocorrelation_factors[i, j]),
                    time_shift=shift,
                    time_shift_sd=float(
                        remaining.std() * np.sqrt(autocorrelation_factor(remaining) / strength)
                    ),
                )
            )
    return found


def residual_remarks(
    channels: Sequence[ChannelResiduals], sources: Sequence[str], names: Sequence[str]
) -> list[str]:
    """Sentences on autocorrelated residuals and on time shifts; none if all is well.

    `sources` are the names of the logs, `names` those of the channels.
    """
    remarks = []
    for i, source in enumerate(sources):
        own = [channel for channel in channels if channel.log == i]
        coloured = [channel for channel in own if channel.p_value < WHITENESS_SIGNIFICANCE]
        if coloured:
            factors = ", ".join(
                f"{c.autocorrelation_factor:.2g} at {names[c.sensor]}" for c in coloured
            )
            remarks.append(
                f"{source}: residuals are no white noise, so the model misses something and its "
                f"intervals are unreliable: widened for autocorrelation (variances times "
                f"{factors}), but not for bias"
            )
        for c in own:
            if abs(c.time_shift) > MIN_TIME_SHIFT_SD * c.time_shift_sd:
                what = "late" if c.time_shift > 0 else "early"
                remarks.append(
                    f"{source}: {names[c.sensor]} seems {1e3 * abs(c.time_shift):.3g} ms {what} "
                    f"(+- {2e3 * c.time_shift_sd:.2g} ms): free its delay, or check its clock"
                )
    return remarks
