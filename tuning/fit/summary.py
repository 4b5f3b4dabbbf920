"""Text about a fit: the table of its parameters, its minima, and remarks in a sentence each."""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.runtime.printer import Row, text_table
from tuning.fit.least_squares import LocalMinimum
from tuning.logs.log import Log
from tuning.logs.logger import samples_held
from tuning.logs.quality import find_faults
from tuning.parameters.free import FreeParameter

MAX_CORRELATION = 0.95  # correlation beyond which two parameters are called hard to tell apart
PRIOR_DOMINANCE = 0.7  # of the prior's deviation: with a larger error the logs say less than it

NOT_IDENTIFIABLE = "not identifiable"
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
