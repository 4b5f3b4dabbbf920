"""Data set of a fit: logs, and residuals of a case against them."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from jaxbeam.case.case import Case
from jaxbeam.case.validation import check_case
from jaxbeam.integrator.time_grid import EventSchedule, stack_schedules
from jaxbeam.model.elements import largest_layout
from jaxbeam.model.plausibility.check import check
from jaxbeam.simulation.integration_plan import IntegrationPlan, common_plan, integration_plan
from tuning.fit.least_squares import autocorrelation, autocorrelation_factor
from tuning.logs.log import Log
from tuning.logs.pairing import case_of_log, check_loads, check_times, pad_cases, sensor_readings
from tuning.parameters import LogPrediction, with_values

SIMULATION_TOLERANCE = 1e-5  # of the largest deflection, below the resolution of logs


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Logs with the case of each, alike in structure, so that one compiled simulation serves all.

    Logs are padded to the longest with equally spaced times; `mask` is 1 for measured samples and
    0 for padding. Samples are (log, time, channel). With a controller, or commands from a log,
    `schedule` holds the times of its events in each log. `nominal_case` is the case as given.
    """

    nominal_case: Case
    cases: list[Case]
    logs: list[Log]
    plan: IntegrationPlan
    times: Float[np.ndarray, "log time"]
    measured: Float[np.ndarray, "log time channel"]
    mask: Float[np.ndarray, "log time channel"]
    schedule: EventSchedule | None = None

    def prediction(self, addresses: list[str]) -> LogPrediction:
        """Readings of all logs from values at the addresses, with derivatives at low cost."""
        return LogPrediction(self.cases, self.times, self.plan, self.schedule, addresses)

    def validity_warning(self, values: dict[str, float]) -> str:
        """Warning that the fitted values are implausible, where the starts are not, or that the
        integration plan does not hold at them; "" without.

        Without bounds a parameter may end at a value that no beam can have. The plan was made for
        the starts: far from them the loads may change their order, or steps be too long.
        """
        for i, (case, times) in enumerate(zip(self.cases, self.times, strict=True)):
            try:
                fitted = with_values(case, i, values)
                about = {said.partition(":")[0] for said in check(case).warnings}
                new = [s for s in check(fitted).warnings if s.partition(":")[0] not in about]
                if new:
                    return (
                        f", but to values that can hardly be meant: {new[0]}; give bounds, as by"
                        " --free ADDRESS=LOW:HIGH, or find some of them first by the modes of the"
                        " vibration after the load"
                    )
                plan = integration_plan(fitted, jnp.asarray(times), SIMULATION_TOLERANCE)
            except (ValueError, RuntimeError) as error:
                return f", to a case that cannot be simulated: {error}"
            layouts = plan.shapes.layout, self.plan.shapes.layout
            changed = (
                largest_layout(layouts) != self.plan.shapes.layout
                or plan.shapes.max_loads > self.plan.shapes.max_loads
            )
            if changed or plan.substeps > 2 * self.plan.substeps:
                return ", but far from the start: fit once more with these values as the start"
        return ""


def make_dataset(case: Case, logs: list[Log]) -> Dataset:
    """Dataset of logs, checked against the case.

    Raises ValueError, naming the log, if its channels do not match the sensors, it has no load,
    it ends before the first load has crossed, or logs differ in structure.
    """
    if not logs:
        raise ValueError("give at least one log")
    # Loads, and with them sensors on vehicles, may be described with the logs only.
    check_case(case if case.loads else dataclasses.replace(case, vehicle_sensors=()))
    for log in logs:
        check_times(log)
    count = max(log.times.size for log in logs)
    times = [_padded_times(log.times, count) for log in logs]
    cases = [case_of_log(case, log, filled) for log, filled in zip(logs, times, strict=True)]
    ordered = [sensor_readings(case, log) for log in logs]
    for log, own in zip(logs, cases, strict=True):
        check_loads(log, own)
        check_case(own)
    cases = pad_cases(cases, times)
    shapes = {jax.tree.structure(own) for own in cases}
    if len(shapes) > 1:
        raise ValueError(
            "the logs differ in the kinds of their loads, one after the other, or in how these "
            "move (by a speed, or by a table); give all the same kinds, or fit the logs apart"
        )
    measured, mask = [], []
    for log, (values, valid) in zip(logs, ordered, strict=True):
        measured.append(np.pad(values, ((0, count - log.times.size), (0, 0))))
        mask.append(np.pad(valid, ((0, count - log.times.size), (0, 0))))
    plans = [
        integration_plan(own, jnp.asarray(t), SIMULATION_TOLERANCE)
        for own, t in zip(cases, times, strict=True)
    ]
    plan = dataclasses.replace(common_plan(plans, "logs"), schedule=None)
    schedules = [own.schedule for own in plans]
    schedule = None if schedules[0] is None else stack_schedules(schedules)
    return Dataset(
        nominal_case=case,
        cases=cases,
        logs=logs,
        plan=plan,
        times=np.array(times),
        measured=np.array(measured),
        mask=np.array(mask, float),
        schedule=schedule,
    )


def _padded_times(times: Float[np.ndarray, " time"], count: int) -> Float[np.ndarray, " padded"]:
    """Times (s) continued at their mean spacing up to a count."""
    spacing = np.diff(times).mean()
    return np.append(times, times[-1] + spacing * np.arange(1, count - times.size + 1))


LJUNG_BOX_LAGS = 20  # lags of the autocorrelation in the whiteness test
WHITENESS_SIGNIFICANCE = 0.01  # probability of calling white residuals of a fit autocorrelated
MIN_TIME_SHIFT_SD = 4.0  # standard errors beyond which a time shift or an offset is reported
REST, LEAST_AT_REST = 0.01, 20  # of the largest reading, at most; samples


@dataclasses.dataclass(frozen=True)
class ChannelResiduals:
    """Residuals of one sensor in one log.

    `noise` is their standard deviation in the SI unit of the sensor; `p_value` that of
    `whiteness_p_value`; `autocorrelation_factor` the factor by which autocorrelation raises
    variances; `time_shift` (s) the delay of the log against the model, with its standard error;
    `offset` what the sensor reads where the model is at rest, by its unit, with its own.
    """

    log: int
    sensor: int
    noise: float
    p_value: float
    autocorrelation_factor: float
    time_shift: float
    time_shift_sd: float
    offset: float
    offset_sd: float


def whiteness_p_value(residual: Float[np.ndarray, " time"]) -> float:
    """p-value of the whiteness test of Ljung and Box (1978).

    Q = n (n + 2) sum r_k^2 / (n - k) over the first lags k, against chi-square. The mean is not
    taken off: that of white noise is zero, and a residual about another one is what a model misses.
    """
    count = residual.size
    lags = range(1, min(LJUNG_BOX_LAGS, count // 4) + 1)
    if float(residual @ residual) == 0.0 or not lags:
        return 1.0
    correlations = np.array([autocorrelation(residual, lag) for lag in lags])
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
            reading = np.abs(fitted[i, has, j])
            at_rest = residual[reading <= REST * reading.max()]
            if at_rest.size < LEAST_AT_REST:
                at_rest = np.zeros(2)
            spread = float(at_rest.std() * np.sqrt(autocorrelation_factor(at_rest) / at_rest.size))
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
                    offset=float(at_rest.mean()),
                    offset_sd=spread,
                )
            )
    return found


def coloured(channels: Sequence[ChannelResiduals]) -> list[ChannelResiduals]:
    """Channels whose residuals are not white, by a test corrected for the number of channels."""
    return [one for one in channels if one.p_value < WHITENESS_SIGNIFICANCE / len(channels)]


def explained(channels: Sequence[ChannelResiduals]) -> str:
    """Sentence on whether the model explains the logs, from the residuals of all channels."""
    found = coloured(channels)
    if not found:
        return "the model explains the logs: residuals are white noise"
    return (
        f"the model misses something: residuals of {len(found)} of {len(channels)} signals are no"
        " white noise, and intervals are unreliable"
    )


def residual_remarks(
    channels: Sequence[ChannelResiduals],
    sources: Sequence[str],
    names: Sequence[str],
    driven: Sequence[bool] = (),
) -> list[str]:
    """Sentences on autocorrelated residuals and on time shifts; none if all is well.

    `sources` are the names of the logs, `names` those of the channels; `driven` tells which logs
    have commands.
    """
    remarks, missed = [], coloured(channels)
    for i, source in enumerate(sources):
        own = [channel for channel in channels if channel.log == i]
        found = [channel for channel in own if channel in missed]
        if found:
            factors = ", ".join(
                f"{c.autocorrelation_factor:.2g} at {names[c.sensor]}" for c in found
            )
            remarks.append(
                f"{source}: residuals are no white noise, so the model misses something and its "
                f"intervals are unreliable: widened for autocorrelation (variances times "
                f"{factors}), but not for bias"
            )
        for c in own:
            if abs(c.offset) > max(MIN_TIME_SHIFT_SD * c.offset_sd, c.noise / 2):
                size = f"{c.offset:.3g} (+- {2 * c.offset_sd:.2g}, in SI units)"
                remarks.append(
                    f"{source}: {names[c.sensor]} reads {size} at rest, which biases the fit: free"
                    " its offset"
                )
            if abs(c.time_shift) > MIN_TIME_SHIFT_SD * c.time_shift_sd:
                what = "late" if c.time_shift > 0 else "early"
                held = what == "late" and any(driven[i : i + 1])
                why = ", as under commands held from sample to sample, half of one" if held else ""
                remarks.append(
                    f"{source}: {names[c.sensor]} seems {1e3 * abs(c.time_shift):.3g} ms {what} "
                    f"(+- {2e3 * c.time_shift_sd:.2g} ms{why}): free its delay, or check its clock"
                )
    return remarks
