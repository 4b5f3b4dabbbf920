"""Model validation: information criteria, cross-validation and prediction of held-out logs."""

import dataclasses
from collections.abc import Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import refuses_traced
from jaxbeam.runtime.compiling import compiled
from tuning.fit.dataset import make_dataset
from tuning.fit.result import Fit
from tuning.logs.log import Log

MAX_RESIDUAL_RATIO = 1.5  # residuals over the fit's noise, beyond which a log is not predicted


@dataclasses.dataclass(frozen=True)
class ModelCriteria:
    """Information criteria of one of several models of the same logs; lower is better.

    `log_likelihood` (nats) counts independent samples; `weight` is the Akaike weight among the
    models compared.
    """

    name: str
    parameter_count: int
    log_likelihood: float
    aic: float
    bic: float
    weight: float

    def to_dict(self) -> dict:
        """Criteria as plain data for JSON."""
        return {
            "name": self.name,
            "numbers": self.parameter_count,
            "log_likelihood": self.log_likelihood,
            "aic": self.aic,
            "bic": self.bic,
            "weight": self.weight,
        }


def compare_fits(fits: Mapping[str, Fit]) -> list[ModelCriteria]:
    """Information criteria of fits of different models to the same logs, best (BIC) first.

    AIC = 2 k - 2 ln L and BIC = k ln n - 2 ln L with ln L = -n / 2 (ln(2 pi s^2) + 1) summed over
    channels. As residuals may be autocorrelated, n counts independent samples: those of the fit
    with the smallest residuals, the same for all models.

    Raises ValueError for fewer than two fits, and for fits to different samples.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> [model.name for model in tuning.fit.compare_fits({"one": fit, "the same": fit})]
    ['one', 'the same']
    """
    if len(fits) < 2:
        raise ValueError("give at least two fits to compare")
    first, *others = fits.values()
    for other in others:
        same = other.dataset.measured.shape == first.dataset.measured.shape
        if not same or np.any(other.dataset.measured != first.dataset.measured):
            raise ValueError(
                "the fits are of different samples; criteria compare fits of the same samples only"
            )
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
    aic = {name: 2 * k - 2 * log_likelihood for name, (k, log_likelihood) in rows.items()}
    relative_likelihoods = np.exp(-(np.array(list(aic.values())) - min(aic.values())) / 2)
    weights = dict(zip(aic, relative_likelihoods / relative_likelihoods.sum(), strict=True))
    log_count = float(np.log(independent.sum()))
    criteria = [
        ModelCriteria(
            name=name,
            parameter_count=k,
            log_likelihood=log_likelihood,
            aic=aic[name],
            bic=k * log_count - 2 * log_likelihood,
            weight=float(weights[name]),
        )
        for name, (k, log_likelihood) in rows.items()
    ]
    return sorted(criteria, key=lambda model: model.bic)


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOutPrediction:
    """A log predicted by a fit that did not use it.

    `residual_ratio` is the standard deviation of the prediction's residuals over that of the
    fit's: 1 for a model without error, NaN where nothing was measured.
    """

    log: str
    residual_ratio: Float[np.ndarray, " sensor"]

    @property
    def verdict(self) -> str:
        """Whether the log is predicted, in a sentence."""
        worst = float(np.nanmax(self.residual_ratio))
        word = "predicted" if worst < MAX_RESIDUAL_RATIO else "not predicted"
        return f"{self.log}: {word}; residuals are {worst:.3g} times the noise at most"


@refuses_traced("a prediction of logs")
def cross_validate(fit: Fit) -> list[HeldOutPrediction]:
    """Leave-one-out cross-validation: each log predicted by a fit to all others.

    Parameters of the log left out (its speed and entry time, say) stay at their starts, so its
    prediction is only as good as these. Nothing is compiled anew.

    Raises ValueError for a single log.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> for held_out in tuning.fit.cross_validate(fit):
    ...     print(held_out.log, held_out.residual_ratio.round(1))
    2.0 m/s [1.]
    2.5 m/s [1.]
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


@refuses_traced("a prediction of logs")
def predict_held_out(fit: Fit, logs: Sequence[Log]) -> list[HeldOutPrediction]:
    """Logs that the fit did not use, predicted by the fitted case with the loads of each log.

    Raises ValueError as `identify` does for logs that do not match the case.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> for held_out in tuning.fit.predict_held_out(fit, fit.dataset.logs[:1]):
    ...     print(held_out.log, held_out.residual_ratio.round(1))
    2.0 m/s [1.]
    """
    dataset = make_dataset(fit.case, list(logs))
    predict = compiled(dataset.prediction(["run.gravity"]).predict)
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
