"""Model identification: numbers of a case from logged runs, by least squares."""

import dataclasses
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import known
from jaxbeam.case.sensors import QUANTITIES
from tuning.checkpoint import fingerprint
from tuning.fit.dataset import Dataset, make_dataset
from tuning.fit.least_squares import MAX_STEPS, LeastSquares, LeastSquaresSolution
from tuning.fit.loss import check_loss
from tuning.fit.multi_start import LocalMinimum, multi_start
from tuning.fit.summary import fit_table
from tuning.fit.uncertainty.covariance import t_quantile
from tuning.logs.log import Log
from tuning.parameters.free import LOG_ADDRESS, FreeParameter, free_parameters, with_values
from tuning.parameters.prior import Prior


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """Result of an identification, in SI units and the order of `parameters`.

    An error (standard error) is infinite where the data cannot tell; `unidentifiable` says by name why:
    each entry holds changes that, made together, leave the readings as good as they are. `noise`
    is the standard deviation of the residuals, NaN for a sensor that a log lacks. `case` has the
    fitted numbers; with several logs, those of one log (`logs.1.loads.0.speed`) have no place in
    it, but in `cases`, one for each log. `autocorrelation_factor` is the factor by which the residuals'
    autocorrelation raises variances, and has widened the intervals, and `degrees_of_freedom` the number
    of independent samples left; `minima` are those found
    where there were several starts, lowest first.
    """

    parameters: list[FreeParameter]
    values: Float[np.ndarray, " free"]
    errors: Float[np.ndarray, " free"]
    correlation: Float[np.ndarray, "free free"]
    unidentifiable: list[dict[str, float]]
    noise: Float[np.ndarray, "log channel"]
    verdict: str
    case: Case
    dataset: Dataset
    fitted: Float[np.ndarray, "log time channel"]
    autocorrelation_factor: Float[np.ndarray, "log channel"]
    degrees_of_freedom: float
    least_squares: LeastSquares
    minima: tuple[LocalMinimum, ...] = ()

    @property
    def residuals(self) -> Float[np.ndarray, "log time channel"]:
        """Measured minus fitted, NaN where nothing was measured."""
        dataset = self.dataset
        return np.where(dataset.mask > 0, dataset.measured - self.fitted, np.nan)

    @property
    def addresses(self) -> list[str]:
        """Addresses of the free numbers."""
        return [number.address for number in self.parameters]

    @property
    def start_values(self) -> Float[np.ndarray, " free"]:
        """The values from which the search began."""
        return np.array([number.start for number in self.parameters])

    @property
    def cases(self) -> list[Case]:
        """The fitted case of each log, with the loads that crossed, until the log's end."""
        values = dict(zip(self.addresses, map(float, self.values), strict=True))
        return [with_values(case, i, values) for i, case in enumerate(self.dataset.cases)]

    @property
    def intervals(self) -> Float[np.ndarray, "free 2"]:
        """95 % intervals within the bounds; infinite where the data cannot tell."""
        half = t_quantile(self.degrees_of_freedom) * self.errors
        low = np.maximum(self.values - half, [number.low for number in self.parameters])
        high = np.minimum(self.values + half, [number.high for number in self.parameters])
        identifiable = np.isfinite(self.errors)
        return np.stack(
            [np.where(identifiable, low, -np.inf), np.where(identifiable, high, np.inf)], axis=1
        )

    @property
    def at_bound(self) -> list[str]:
        """Addresses of the numbers that ended at one of their bounds."""
        pairs = zip(self.parameters, self.values, strict=True)
        return [number.address for number, value in pairs if number.at_bound(value)]

    def __str__(self) -> str:
        return fit_table(self)

    def to_dict(self) -> dict:
        """The fit as plain numbers and words, for JSON; what the data cannot tell is None."""
        parameters = {}
        rows = zip(self.parameters, self.values, self.errors, self.intervals, strict=True)
        for number, value, error, interval in rows:
            identifiable = bool(np.isfinite(error))
            parameters[number.address] = {
                "value": float(value),
                "unit": number.unit,
                "standard_error": float(error) if identifiable else None,
                "interval_95": interval.tolist() if identifiable else None,
                "start": number.start,
                "at_bound": number.at_bound(value),
            }
        return {
            "numbers": parameters,
            "correlation": _nan_to_none(self.correlation),
            "unseen": self.unidentifiable,
            "noise": _nan_to_none(self.noise),
            "verdict": self.verdict,
        }

    def plot(self):
        """Figure of measured, fitted and residual, one column for each log and quantity."""
        from jaxbeam.plot import FitPanel, plot_fit

        measured = [sensor.quantity for sensor in self.case.sensors]
        panels = []
        for i, log in enumerate(self.dataset.logs):
            count = log.times.size
            for quantity in dict.fromkeys(measured):
                has = self.dataset.mask[i].any(axis=0)
                channels = [n for n, other in enumerate(measured) if other == quantity and has[n]]
                if not channels:
                    continue
                panels.append(
                    FitPanel(
                        title=log.source.rsplit("/", 1)[-1],
                        times=log.times,
                        measured=self.dataset.measured[i, :count, channels].T,
                        fitted=self.fitted[i, :count, channels].T,
                        names=[f"sensor {n}" for n in channels],
                        unit=QUANTITIES[quantity],
                    )
                )
        return plot_fit(panels, title=self.case.title)


def identify(
    case: Case,
    logs: Log | Sequence[Log],
    free: Mapping[str, tuple[float, float] | Prior | None] | Sequence[str] | str,
    *,
    loss: str = "squares",
    stages: Sequence[Sequence[str]] = (),
    starts: int = 1,
    seed: int = 0,
    checkpoint: str | os.PathLike | None = None,
    resume: bool = False,
) -> Fit:
    """Fit numbers of a case to logs of runs with known loads.

    `free` names addresses, each with bounds (low, high), a `Prior` (bounds, scale, prior) or
    None; a number of one log, such as its load's speed, is at `logs.0.loads.0.speed`, one of every
    log at `logs.*.loads.0.speed`. Loads are those of the logs, or else the case's.
    The sum of squared residuals over their noise (and of the priors' pulls) is minimised by
    bounded Levenberg-Marquardt (optimistix) with exact forward derivatives; noise levels of the
    channels are estimated from the residuals. Standard errors follow from the Jacobian, widened
    where residuals are correlated in time; directions the data cannot see are reported by name.

    `loss` "soft-l1" or "huber" lets outliers count less. `stages` are lists of addresses that are
    fitted first, one list after the other, the rest held. From more than one of the `starts`
    (others are drawn by the `seed`) the lowest minimum is taken; with a `checkpoint` file that
    search can be stopped at any time and taken up with `resume`: the result is the same.

    Raises ValueError for faulty input or a checkpoint of another search, FileExistsError if the
    checkpoint exists and `resume` is not set, and RuntimeError if the simulation cannot follow.
    """
    logs = [logs] if isinstance(logs, Log) else list(logs)
    addresses = [free] if isinstance(free, str) else free
    bounds = dict(addresses) if isinstance(addresses, Mapping) else dict.fromkeys(addresses)
    check_loss(loss)
    if starts < 1:
        raise ValueError(f"starts must be 1 or more, not {starts}")
    file = None if checkpoint is None else Path(checkpoint)
    if file is not None and file.exists() and not resume:
        raise FileExistsError(f"{file} exists: resume that search, or delete it")
    dataset = make_dataset(case, logs)
    largest_reading = float(np.max(np.abs(dataset.measured)))
    parameters = free_parameters(dataset.cases, bounds, largest_reading)
    stage_masks = [_stage_mask(parameters, stage) for stage in stages]
    least_squares = LeastSquares(dataset, parameters, loss)
    minima, start = (), None
    if starts > 1:
        digest = _search_digest(dataset, parameters, loss, starts, seed)
        minima = tuple(multi_start(least_squares, dataset.measured, starts, seed, file, digest))
        start = minima[0].unbounded
    for mask in stage_masks:
        start = least_squares.solve(dataset.measured, start=start, free=mask).unbounded
    return fit_result(
        case, least_squares, least_squares.solve(dataset.measured, start=start), minima
    )


def fit_result(
    case: Case,
    least_squares: LeastSquares,
    solution: LeastSquaresSolution,
    minima: tuple[LocalMinimum, ...] = (),
) -> Fit:
    """The result of a search: `case` is the one that was to be fitted."""
    dataset, parameters = least_squares.data, least_squares.parameters
    pairs = zip(parameters, solution.values, strict=True)
    values = {number.address: float(value) for number, value in pairs}
    verdict = (
        "converged"
        if solution.converged
        else f"not converged after {MAX_STEPS} steps: start closer"
    )
    return Fit(
        parameters=parameters,
        values=solution.values,
        errors=solution.uncertainty.errors,
        correlation=solution.uncertainty.correlation,
        unidentifiable=solution.uncertainty.unidentifiable,
        noise=np.where(dataset.mask.any(axis=1), solution.noise, np.nan),
        verdict=verdict + dataset.doubt(values),
        case=_fitted_case(case, dataset, values),
        dataset=dataset,
        fitted=solution.predicted,
        autocorrelation_factor=solution.autocorrelation_factor,
        degrees_of_freedom=solution.degrees_of_freedom,
        least_squares=least_squares,
        minima=minima,
    )


def _stage_mask(parameters: list[FreeParameter], stage: Sequence[str]):
    """Which numbers move in a stage; `logs.*` in front means those of every log."""
    names = [number.address for number in parameters]
    inner = [LOG_ADDRESS.sub(r"logs.*.\2", name) for name in names]
    for address in stage:
        if address not in (*names, *inner):
            raise ValueError(f"a stage fits {address}, which is not free; free are {names}")
    return np.array([a in stage or b in stage for a, b in zip(names, inner, strict=True)])


def _search_digest(
    dataset: Dataset, parameters: list[FreeParameter], loss: str, starts: int, seed: int
) -> str:
    """What tells one search from another."""
    return fingerprint(
        {
            "cases": [jax.tree.map(lambda leaf: known(leaf).tolist(), c) for c in dataset.cases],
            "measured": [dataset.measured.tobytes().hex(), dataset.mask.tobytes().hex()],
            "times": dataset.times.tobytes().hex(),
            "numbers": [dataclasses.asdict(number) for number in parameters],
            "settings": [loss, starts, seed],
        }
    )


def _nan_to_none(table: Float[np.ndarray, "row column"]) -> list[list[float | None]]:
    return [[None if np.isnan(entry) else entry for entry in row] for row in table.tolist()]


def _fitted_case(case: Case, dataset: Dataset, values: dict[str, float]) -> Case:
    """The case with what was fitted; the loads of a single log become its own."""
    if len(dataset.logs) == 1:
        fitted = with_values(dataset.cases[0], 0, values)
        # Commands that were logged belong to the log.
        fitted = dataclasses.replace(fitted, controller=case.controller)
        return replace(fitted, {"run.duration": case.run.duration})
    shared = {address: v for address, v in values.items() if not LOG_ADDRESS.fullmatch(address)}
    if any(log.loads is not None for log in dataset.logs):
        shared = {address: v for address, v in shared.items() if not address.startswith("loads.")}
    return replace(case, shared)
