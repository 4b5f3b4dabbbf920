"""Result of an identification: values with standard errors, residuals, remarks, and its text.

Fits on disk: the parameters found, with the case and the logs, in one file.
"""

import dataclasses
import functools
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case, replace
from jaxbeam.case.fields import refuses_traced
from jaxbeam.case.sensors import unit_of
from jaxbeam.files.case_file import case_from_dict, case_to_dict
from jaxbeam.runtime.printer import Row, TableViews, text_table
from tuning.checkpoint import read_arrays, save
from tuning.fit.dataset import (
    ChannelResiduals,
    Dataset,
    channel_residuals,
    coloured,
    explained,
    make_dataset,
    residual_remarks,
)
from tuning.fit.least_squares import (
    MAX_STEPS,
    LeastSquares,
    LeastSquaresSolution,
    LocalMinimum,
    confidence_intervals,
)
from tuning.logs.log import Log
from tuning.logs.quality import find_faults, samples_held
from tuning.parameters import LOG_ADDRESS, FreeParameter, Prior, to_unbounded, with_values

MAX_CORRELATION = 0.95  # correlation beyond which two parameters are called hard to tell apart
PRIOR_DOMINANCE = 0.7  # of the prior's deviation: with a larger error the logs say less than it

NOT_IDENTIFIABLE = "not identifiable"
CONVERGED = "converged"
Parameters = Sequence[FreeParameter]
Values = Float[np.ndarray, " parameter"]


def interval_text(interval: Float[np.ndarray, "2"]) -> str:
    """A 95 % interval in words; infinite ones are those of parameters not identifiable."""
    if not np.all(np.isfinite(interval)):
        return NOT_IDENTIFIABLE
    return f"{interval[0]:.5g} to {interval[1]:.5g}"


def parameter_table(
    parameters: Parameters, values: Values, intervals: Float[np.ndarray, "parameter 2"]
) -> list[str]:
    """Lines of a table: address, unit, start, fitted value and 95 % interval."""
    rows: list[Row] = [
        (
            parameter.address,
            "" if parameter.unit == "1" else parameter.unit,
            f"{parameter.start:.5g}",
            f"{value:.5g}",
            interval_text(interval),
        )
        for parameter, value, interval in zip(parameters, values, intervals, strict=True)
    ]
    header = ("parameter", "unit", "start", "fitted", "95 % interval")
    return text_table(header, rows, "<<>><")


def minima_lines(minima: Sequence[LocalMinimum]) -> list[str]:
    """The minima that several starts led to, lowest first; no lines for a single start."""
    if not minima:
        return []
    lines = ["", f"{len(minima)} minima from {sum(m.starts for m in minima)} starts:"]
    for found in minima:
        values = "  ".join(f"{value:.5g}" for value in found.values)
        state = "" if found.converged else "  (not converged)"
        lines.append(f"  misfit {found.cost:.6g} from {found.starts} starts: {values}{state}")
    return lines


def bound_remarks(parameters: Parameters, values: Values) -> Iterator[str]:
    """Sentences on parameters that ended at a bound."""
    for parameter, value in zip(parameters, values, strict=True):
        if parameter.at_bound(value):
            yield (
                f"{parameter.address} ended at its bound ({parameter.low:.5g} to "
                f"{parameter.high:.5g}): the logs fit best there or beyond, and the intervals do "
                "not hold; widen the bounds if they may be wrong"
            )


def unidentifiable_remarks(
    parameters: Parameters, unidentifiable: Sequence[dict[str, float]]
) -> Iterator[str]:
    """Sentences on unidentifiable directions, each a dictionary from address to change (SI)."""
    units = {parameter.address: parameter.unit for parameter in parameters}
    for direction in unidentifiable:
        if len(direction) == 1:
            yield (
                f"{next(iter(direction))} is not identifiable from the data: give it a value known "
                "otherwise"
            )
            continue
        changes = [f"{a} by {change:+.3g} {units[a]}" for a, change in direction.items()]
        yield (
            f"a change of {', '.join(changes)} together is not identifiable from the data: give "
            "one of them a value known otherwise"
        )


def correlation_remarks(
    addresses: Sequence[str], correlation: Float[np.ndarray, "parameter parameter"]
) -> Iterator[str]:
    """Sentences on pairs of parameters that are strongly correlated."""
    for i, j in np.argwhere(np.triu(np.abs(np.nan_to_num(correlation)) > MAX_CORRELATION, 1)):
        yield (
            f"{addresses[i]} and {addresses[j]} are hard to tell apart: "
            f"correlation {correlation[i, j]:.3f}"
        )


def prior_remarks(parameters: Parameters, errors: Values) -> Iterator[str]:
    """Sentences on parameters whose standard error is nearly that of their prior."""
    for parameter, error in zip(parameters, errors, strict=True):
        deviation = parameter.prior.deviation
        if deviation is not None and error > PRIOR_DOMINANCE * deviation:
            yield f"{parameter.address} is determined by its prior more than by the logs"


def channel_names(case: Case) -> list[str]:
    """Names of all sensors of a case: "sensor 0", then "vehicle sensor 0" for those on vehicles."""
    on_vehicles = [f"vehicle sensor {i}" for i in range(len(case.vehicle_sensors))]
    return [f"sensor {i}" for i in range(len(case.sensors))] + on_vehicles


def noise_remarks(
    case: Case, logs: Sequence[Log], noise: Float[np.ndarray, "log channel"]
) -> Iterator[str]:
    """A sentence for each log: standard deviations of its residuals, with their units."""
    named = list(zip((s.unit for s in case.all_sensors), channel_names(case), strict=True))
    for log, levels in zip(logs, noise, strict=True):
        pairs = zip(levels, named, strict=True)
        words = [f"{n:.3g} {unit} ({name})" for n, (unit, name) in pairs if np.isfinite(n)]
        yield f"standard deviation of the residual of {log.source}: {', '.join(words)}"


def held_reading_remarks(case: Case, logs: Sequence[Log]) -> Iterator[str]:
    """Logs with readings between the samples of the case's controller, which holds its own."""
    period = None if case.controller is None else case.controller.period
    if period is None or all(sensor.sampling_period is not None for sensor in case.sensors):
        return
    for log in logs:
        step = float(np.median(np.diff(log.times)))
        if step < 0.9 * float(period) and any(samples_held(one) == 1 for one in log.values.T):
            yield (
                f"{log.source}: its readings come every {step:.4g} s, but a controller holds those"
                f" of sensors without a sampling_period for its period, {float(period):.4g} s: set"
                f" sensors.N.sampling_period to {step:.4g} s if the log is not the controller's"
            )


def log_remarks(logs: Sequence[Log]) -> Iterator[str]:
    """Notes made when logs were read, and faults that were found and not masked."""
    for log in logs:
        yield from (f"{log.source}: {note}" for note in log.notes)
        yield from (f"{fault} (not masked)" for fault in find_faults(log))


@dataclasses.dataclass(frozen=True, eq=False)
class ParameterEstimates:
    """Parameters fitted to measurements (SI units), with standard errors and their correlation.

    `unidentifiable` are directions (changes by address) that the data do not tell.
    """

    parameters: list[FreeParameter]
    values: Float[np.ndarray, " parameter"]
    errors: Float[np.ndarray, " parameter"]
    correlation: Float[np.ndarray, "parameter parameter"]
    unidentifiable: list[dict[str, float]]

    @property
    def addresses(self) -> list[str]:
        """Addresses of the free parameters."""
        return [parameter.address for parameter in self.parameters]


@dataclasses.dataclass(frozen=True, eq=False)
class Fit(ParameterEstimates, TableViews):
    """Result of an identification, in SI units and the order of `parameters`.

    `errors` are standard errors, infinite for parameters that are not identifiable from the data;
    `unidentifiable` holds the directions responsible: changes by address that, made together, leave
    the readings as good as they are. `noise` is the standard deviation of the residuals, NaN for a
    sensor that a log lacks. `case` has the fitted values; with several logs, those of one log
    (`logs.1.loads.0.speed`) are in `cases`, one for each log. `autocorrelation_factor` is the
    factor by which autocorrelation of the residuals raises variances and has widened the
    intervals; `degrees_of_freedom` the number of independent samples left. `minima` are those
    found from several starts, lowest first. `search` says how the search for the minimum ended.

    >>> import tuning
    >>> fit = tuning.load_fit("fit.npz")
    >>> print(
    ...     fit.addresses[0], f"{fit.values[0]:.2f} +- {fit.errors[0]:.2f} N m^2,", fit.search
    ... )
    beam.flexural_rigidity 12.02 +- 0.02 N m^2, converged
    """

    noise: Float[np.ndarray, "log channel"]
    search: str
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

    @functools.cached_property
    def channel_residuals(self) -> list[ChannelResiduals]:
        """Noise, whiteness and time shift of the residuals of each sensor in each log."""
        return channel_residuals(
            self.dataset.times, self.fitted, self.residuals, self.noise, self.autocorrelation_factor
        )

    @property
    def verdict(self) -> str:
        """Whether the model explains the logs, so that intervals are reliable, and the search."""
        return f"{explained(self.channel_residuals)}; the search {self.search}"

    @property
    def widened_noise(self) -> Float[np.ndarray, "log channel"]:
        """Noise widened for autocorrelation; 1 where a log lacks the sensor."""
        widened = self.noise * np.sqrt(self.autocorrelation_factor)
        return np.where(np.isnan(self.noise), 1.0, widened)

    @property
    def start_values(self) -> Float[np.ndarray, " parameter"]:
        """Values from which the search began."""
        return np.array([parameter.start for parameter in self.parameters])

    @property
    def unbounded(self) -> Float[np.ndarray, " parameter"]:
        """Search variables of the fitted values."""
        return to_unbounded(self.parameters, self.values)

    @property
    def cases(self) -> list[Case]:
        """The fitted case of each log, with the loads that crossed, until the log's end."""
        values = dict(zip(self.addresses, map(float, self.values), strict=True))
        return [with_values(case, i, values) for i, case in enumerate(self.dataset.cases)]

    @property
    def intervals(self) -> Float[np.ndarray, "parameter 2"]:
        """95 % intervals within the bounds; infinite for parameters that are not identifiable."""
        intervals = confidence_intervals(self.values, self.errors, self.degrees_of_freedom)
        low = np.array([parameter.low for parameter in self.parameters])
        high = np.array([parameter.high for parameter in self.parameters])
        within = np.clip(intervals, low[:, None], high[:, None])
        return np.where(np.isfinite(self.errors)[:, None], within, intervals)

    @property
    def at_bound(self) -> list[str]:
        """Addresses of the parameters that ended at one of their bounds."""
        pairs = zip(self.parameters, self.values, strict=True)
        return [parameter.address for parameter, value in pairs if parameter.at_bound(value)]

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Address, unit, start, value, standard error and 95 % interval of each parameter, by head.

        Errors and intervals are infinite for parameters that are not identifiable.
        """
        units = ["" if one.unit == "1" else one.unit for one in self.parameters]
        return {
            "parameter": np.array(self.addresses),
            "unit": np.array(units),
            "start": self.start_values,
            "fitted": np.asarray(self.values),
            "standard error": np.asarray(self.errors),
            "95 % from": self.intervals[:, 0],
            "95 % to": self.intervals[:, 1],
        }

    @property
    def remarks(self) -> list[str]:
        """Sentences on bounds, unidentifiable directions, correlations, priors, noise and logs."""
        logs, names = self.dataset.logs, channel_names(self.case)
        return [
            *bound_remarks(self.parameters, self.values),
            *unidentifiable_remarks(self.parameters, self.unidentifiable),
            *correlation_remarks(self.addresses, self.correlation),
            *prior_remarks(self.parameters, self.errors),
            *noise_remarks(self.case, logs, self.noise),
            *residual_remarks(
                self.channel_residuals,
                [log.source for log in logs],
                names,
                [any(one is not None for one in log.actuators) for log in logs],
            ),
            *held_reading_remarks(self.case, logs),
            *log_remarks(logs),
        ]

    def __str__(self) -> str:
        table = parameter_table(self.parameters, self.values, self.intervals)
        minima = minima_lines(self.minima)
        return "\n".join([self.verdict, "", *table, *minima, "", *self.remarks])

    def to_dict(self) -> dict:
        """Plain numbers and words for JSON; None for what is not identifiable."""
        parameters = {}
        rows = zip(self.parameters, self.values, self.errors, self.intervals, strict=True)
        for parameter, value, error, interval in rows:
            identifiable = bool(np.isfinite(error))
            parameters[parameter.address] = {
                "value": float(value),
                "unit": parameter.unit,
                "standard_error": float(error) if identifiable else None,
                "interval_95": interval.tolist() if identifiable else None,
                "start": parameter.start,
                "at_bound": parameter.at_bound(value),
            }
        return {
            "verdict": self.verdict,
            "explained": not coloured(self.channel_residuals),
            "numbers": parameters,
            "correlation": _nan_to_none(self.correlation),
            "unseen": self.unidentifiable,
            "noise": _nan_to_none(self.noise),
        }

    def plot(self):
        """Figure of measured, fitted and residual, one column for each log and quantity."""
        from jaxbeam.plot import FitPanel, plot_fit

        quantities = [sensor.quantity for sensor in self.case.all_sensors]
        names = channel_names(self.case)
        panels = []
        for i, log in enumerate(self.dataset.logs):
            count = log.times.size
            for quantity in dict.fromkeys(quantities):
                has = self.dataset.mask[i].any(axis=0)
                channels = [n for n, other in enumerate(quantities) if other == quantity and has[n]]
                if not channels:
                    continue
                panels.append(
                    FitPanel(
                        title=log.source.rsplit("/", 1)[-1],
                        times=log.times,
                        measured=self.dataset.measured[i, :count, channels].T,
                        fitted=self.fitted[i, :count, channels].T,
                        names=[names[n] for n in channels],
                        unit=str(unit_of(quantity)),
                        valid=self.dataset.mask[i, :count, channels].T > 0,
                    )
                )
        return plot_fit(panels, title=self.case.title)


def fit_result(
    case: Case,
    least_squares: LeastSquares,
    solution: LeastSquaresSolution,
    minima: tuple[LocalMinimum, ...] = (),
) -> Fit:
    """Fit from the solution of its least-squares problem; `case` is the one before the fit."""
    dataset, parameters = least_squares.data, least_squares.parameters
    pairs = zip(parameters, solution.values, strict=True)
    values = {parameter.address: float(value) for parameter, value in pairs}
    search = (
        CONVERGED
        if solution.converged
        else f"has not converged after {MAX_STEPS} steps: start closer"
    )
    return Fit(
        parameters=parameters,
        values=solution.values,
        errors=solution.uncertainty.errors,
        correlation=solution.uncertainty.correlation,
        unidentifiable=solution.uncertainty.unidentifiable,
        noise=np.where(dataset.mask.any(axis=1), solution.noise, np.nan),
        search=search + dataset.validity_warning(values),
        case=_fitted_case(case, dataset, values),
        dataset=dataset,
        fitted=solution.predicted,
        autocorrelation_factor=solution.autocorrelation_factor,
        degrees_of_freedom=solution.degrees_of_freedom,
        least_squares=least_squares,
        minima=minima,
    )


def _fitted_case(case: Case, dataset: Dataset, values: dict[str, float]) -> Case:
    """The case with the fitted values; with a single log, with the loads of that log, too."""
    if len(dataset.logs) == 1:
        fitted = with_values(dataset.cases[0], 0, values)
        # Commands that were logged belong to the log.
        fitted = dataclasses.replace(fitted, controller=case.controller)
        return replace(fitted, {"run.duration": case.run.duration})
    shared = {address: v for address, v in values.items() if not LOG_ADDRESS.fullmatch(address)}
    if any(log.loads is not None for log in dataset.logs):
        shared = {address: v for address, v in shared.items() if not address.startswith("loads.")}
    return replace(case, shared)


def _nan_to_none(table: Float[np.ndarray, "row column"]) -> list[list[float | None]]:
    return [[None if np.isnan(entry) else entry for entry in row] for row in table.tolist()]


FORMAT, FORMER_FORMAT = "jaxbeam fit 2", "jaxbeam fit 1"
_FIT_ARRAYS = ("values", "errors", "correlation", "noise", "fitted", "autocorrelation_factor")
_LOG_ARRAYS = ("times", "values", "valid")
_LOG_FIELDS = (
    "names",
    "quantities",
    "units",
    "sensors",
    "positions",
    "actuators",
    "notes",
    "vehicle_sensors",
)


@refuses_traced("a file")
def save_fit(fit: Fit, path: str | os.PathLike, overwrite: bool = False) -> None:
    """Write a fit with its logs and case to a file (.npz), without any loss of precision.

    Raises FileExistsError if the file exists and `overwrite` is not set.

    >>> import tuning
    >>> tuning.save_fit(tuning.load_fit("fit.npz"), "copy.npz")
    """
    logs = fit.dataset.logs
    header = {
        "case": case_to_dict(fit.case),
        "nominal_case": case_to_dict(fit.dataset.nominal_case),
        "parameters": [dataclasses.asdict(parameter) for parameter in fit.parameters],
        "unidentifiable": fit.unidentifiable,
        "search": fit.search,
        "degrees_of_freedom": fit.degrees_of_freedom,
        "loss": fit.least_squares.loss,
        "logs": [_log_header(log, fit.case) for log in logs],
        "minima": [[m.cost, m.starts, m.converged] for m in fit.minima],
    }
    arrays = {name: getattr(fit, name) for name in _FIT_ARRAYS}
    for i, log in enumerate(logs):
        arrays |= {f"log{i}.{name}": getattr(log, name) for name in _LOG_ARRAYS}
    for i, found in enumerate(fit.minima):
        arrays |= {f"minimum{i}.values": found.values, f"minimum{i}.point": found.unbounded}
    save(path, FORMAT, arrays | {"about": np.array(json.dumps(header))}, overwrite)


@checks_classes
def load_fit(path: str | os.PathLike) -> Fit:
    """Fit from a file written by `save_fit`.

    Raises ValueError if there is no such file, or it is damaged or no fit, OSError if it cannot be
    read.

    >>> import tuning
    >>> print(str(tuning.load_fit("fit.npz")).splitlines()[3])
    beam.flexural_rigidity  N m^2     10  12.024  11.99 to 12.059
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: there is no such fit; name the .npz file that identify wrote")
    arrays, header = _read(path)
    nominal_case = case_from_dict(header["nominal_case"])
    beam = header["nominal_case"]["beam"]
    logs = [_read_log(i, entry, beam, arrays) for i, entry in enumerate(header["logs"])]
    parameters = [
        FreeParameter(**{**entry, "prior": Prior(**entry["prior"])})
        for entry in header["parameters"]
    ]
    dataset = make_dataset(nominal_case, logs)
    minima = [
        LocalMinimum(
            cost, arrays[f"minimum{i}.values"], arrays[f"minimum{i}.point"], starts, converged
        )
        for i, (cost, starts, converged) in enumerate(header["minima"])
    ]
    return Fit(
        parameters=parameters,
        **{name: arrays[name] for name in _FIT_ARRAYS},
        unidentifiable=header["unidentifiable"],
        search=header.get("search") or header["verdict"],  # so called before 0.3
        case=case_from_dict(header["case"]),
        dataset=dataset,
        degrees_of_freedom=header["degrees_of_freedom"],
        least_squares=LeastSquares(dataset, parameters, header["loss"]),
        minima=tuple(minima),
    )


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict]:
    """Arrays and header of a file. Raises ValueError if it is no fit of the present format."""
    arrays = read_arrays(path, "fit")
    found = str(arrays.pop("fingerprint", ""))
    if found == FORMER_FORMAT:
        raise ValueError(f"{path} was written by jaxbeam 0.1: identify from the logs again")
    if found != FORMAT or "about" not in arrays:
        raise ValueError(
            f"{path} is a NumPy archive, but no fit; name the .npz file that identify wrote"
        )
    return arrays, json.loads(str(arrays["about"]))


def _log_header(log: Log, case: Case) -> dict:
    """Names, units and sources of a log as plain data; loads as in a case file."""
    header = {name: getattr(log, name) for name in _LOG_FIELDS} | {
        "source": log.source,
        "loads": None,
    }
    if log.loads is not None:
        with_loads = dataclasses.replace(case, loads=tuple(log.loads), controller=None)
        header["loads"] = case_to_dict(with_loads).get("loads", [])
    return header


def _read_log(index: int, header: dict, beam: dict, arrays) -> Log:
    loads = header["loads"]
    if loads is not None:
        loads = case_from_dict({"beam": beam, "loads": loads}).loads
    words = {name: tuple(header[name]) for name in _LOG_FIELDS if name in header}
    own = {name: arrays[f"log{index}.{name}"] for name in _LOG_ARRAYS}
    return Log(**own, **words, source=header["source"], loads=loads)
