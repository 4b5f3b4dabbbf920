"""Data set of a fit: logs matched with a case (sensors, commands, loads), and its residuals."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import chi2

from jaxbeam.case.case import Case, crossing_times, replace
from jaxbeam.case.controller import commanded
from jaxbeam.case.fields import concrete, kind_of
from jaxbeam.case.loads.base import AbstractLoad
from jaxbeam.case.sensors import unit_of
from jaxbeam.case.trajectory import NEVER
from jaxbeam.case.validation import check_case
from jaxbeam.control.feedforward import Prescribed
from jaxbeam.model.elements import largest_layout
from jaxbeam.model.plausibility.check import check
from jaxbeam.runtime.printer import counted
from jaxbeam.simulation.integration_plan import IntegrationPlan, common_plan, integration_plan
from jaxbeam.simulation.integrator.time_grid import EventSchedule, stack_schedules
from tuning.fit.least_squares import autocorrelation, autocorrelation_factor
from tuning.logs.log import Log
from tuning.logs.quality import samples_held
from tuning.parameters import LogPrediction, with_values

MAX_START_DURATIONS = 10.0  # first time of a log, in its durations, that is simulated from 0 on
COMMAND_UNITS = {"voltage": "V", "force": "N"}


def case_of_log(case: Case, log: Log, times: Float[np.ndarray, " time"]) -> Case:
    """The case with the loads and commands of a log, until its end.

    Commands are linear from sample to sample. One that stays for two samples or more is held by its
    converter, and is weighted with its neighbours so that its steps are where they are in the log:
    half a sample early, they would take k dt / 2 from the damping of a spring k.
    `times` (s) are those of the log and of its padding, in which the last commands stay. Raises
    ValueError, naming the log, for a command that no actuator of the case accepts.
    """
    if log.loads is not None:
        case = dataclasses.replace(case, loads=tuple(log.loads))
    if any(actuator is not None for actuator in log.actuators):
        commands = np.zeros((len(case.actuators), times.size))
        for channel, actuator in enumerate(log.actuators):
            if actuator is not None:
                _check_command(case, log, channel, actuator)
                more = times.size - log.times.size
                commands[actuator] = np.pad(_acting(log.values[:, channel]), (0, more), mode="edge")
        case = _prescribing(case, times, commands)
    return replace(case, {"run.duration": float(log.times[-1])})


def _acting(command: Float[np.ndarray, " time"]) -> Float[np.ndarray, " time"]:
    """The command, or if its samples are held, values that act alike when joined by lines.

    Held from sample to sample it is sinc(x) exp(-i x) of its samples, x = omega dt / 2, and lines
    are sinc(x)^2: these weights make up for exp(-i x) / sinc(x) up to x^4.
    """
    if samples_held(command) == 1.0:
        return command
    at = np.pad(command, (2, 1), mode="edge")  # at[2:-1] is the command
    return (7 * (at[2:-1] + at[1:-2]) - at[3:] - at[:-3]) / 12


def pad_cases(cases: list[Case], times: list[Float[np.ndarray, " time"]]) -> list[Case]:
    """The cases padded to one structure, by zero commands and by loads that enter after the end.

    Thus a crossing without commands and a shaken beam without loads have the same structure.
    """
    prescribed = any(isinstance(case.controller, Prescribed) for case in cases)
    longest = max((case.loads for case in cases), key=len)
    made = []
    for case, own in zip(cases, times, strict=True):
        if prescribed and case.controller is None:
            case = _prescribing(case, own, np.zeros((len(case.actuators), own.size)))
        absent_loads = tuple(_entering_at(load, 2 * own[-1]) for load in longest[len(case.loads) :])
        made.append(dataclasses.replace(case, loads=(*case.loads, *absent_loads)))
    return made


def _prescribing(case: Case, times, commands: Float[np.ndarray, "actuator time"]) -> Case:
    """The case with a table of commands for its actuators but springs and dampers."""
    values = commands[np.array(commanded(case.actuators), int)]
    controller = Prescribed(offsets=np.zeros(len(values)), times=times, values=values)
    return dataclasses.replace(case, controller=controller)


def _entering_at(load: AbstractLoad, time: float) -> AbstractLoad:
    """The load with another entry time (s)."""
    if load.times is None:
        return dataclasses.replace(load, entry_time=time)
    return dataclasses.replace(load, times=load.times - load.times[0] + time)


def _check_command(case: Case, log: Log, channel: int, actuator: int) -> None:
    if not 0 <= actuator < len(case.actuators):
        raise ValueError(
            f"{log.source}: {log.names[channel]} is the command to actuators.{actuator}, but the"
            f" case has {counted(len(case.actuators), 'actuator')}, counted from 0"
        )
    if log.actuators.count(actuator) > 1:
        raise ValueError(f"{log.source}: two of its channels are commands to actuators.{actuator}")
    if case.controller is not None:
        raise ValueError(
            f"{log.source}: its commands and the controller of the case contradict each other;"
            " leave one out"
        )
    device = case.actuators[actuator]
    unit = device.command_unit
    if unit == "1":
        raise ValueError(
            f"{log.source}: {log.names[channel]} is the command to actuators.{actuator}, a"
            f" {kind_of(type(device))}, which takes none; actuators are counted from 0"
        )
    if COMMAND_UNITS.get(log.quantities[channel]) != unit:
        raise ValueError(
            f"{log.source}: {log.names[channel]} holds {log.quantities[channel]} in"
            f" {log.units[channel]}, but the command to actuators.{actuator} is in {unit}"
        )
    limits = device.command_limits()
    low, high = (-np.inf, np.inf) if limits is None else concrete(limits)
    least, most = log.values[:, channel].min(), log.values[:, channel].max()
    if least < low or most > high:
        raise ValueError(
            f"{log.source}: {log.names[channel]} goes from {least:g} to {most:g} {unit}, beyond"
            f" what actuators.{actuator} takes, {low:g} to {high:g} {unit}: correct its limits"
        )


def sensor_readings(
    case: Case, log: Log
) -> tuple[Float[np.ndarray, "time sensor"], Bool[np.ndarray, "time sensor"]]:
    """Readings of a log in the order of `Case.all_sensors` (time, sensor), and which are valid.

    A log that does not name its sensors has all of them, in their order. Raises ValueError, naming
    the log, if its channels do not match the sensors.
    """
    sensors, on_beam = case.all_sensors, len(case.sensors)
    if not sensors:
        raise ValueError("the case has no sensors to compare the logs with")
    named = [(number, i) for i, number in enumerate(log.sensors) if number is not None]
    _check_known(log, [number for number, _ in named], "sensors", on_beam)
    pairs = [(number, i) for i, number in enumerate(log.vehicle_sensors) if number is not None]
    on_vehicles = len(case.vehicle_sensors)
    _check_known(log, [number for number, _ in pairs], "vehicle_sensors", on_vehicles)
    named += [(on_beam + number, i) for number, i in pairs]
    read = [i for i, actuator in enumerate(log.actuators) if actuator is None]
    order = dict(named) if named else dict(enumerate(read))
    if len(named) > len(order):
        raise ValueError(f"{log.source}: two of its channels are of the same sensor of the case")
    if not named and len(order) != len(sensors):
        raise _mismatch(log, len(sensors))
    values = np.zeros((log.times.size, len(sensors)))
    valid = np.zeros(values.shape, bool)
    for number, channel in order.items():
        sensor, unit = sensors[number], unit_of(log.quantities[channel])
        if unit != sensor.unit:
            listed = "sensors" if number < on_beam else "vehicle_sensors"
            own = number if number < on_beam else number - on_beam
            raise ValueError(
                f"{log.source}: {log.names[channel]} holds {log.quantities[channel]} in "
                f"{log.units[channel]}, but {listed}.{own} measures {sensor.quantity}"
            )
        values[:, number], valid[:, number] = log.values[:, channel], log.valid[:, channel]
    return values, valid


def _check_known(log: Log, numbers: list[int], name: str, count: int) -> None:
    if any(not 0 <= number < count for number in numbers):
        raise _mismatch(log, count, name.replace("_", " "))


def _mismatch(log: Log, count: int, name: str = "sensors") -> ValueError:
    listed = counted(count, name.removesuffix("s"))
    key = name.replace(" ", "_").removesuffix("s")
    return ValueError(
        f"{log.source}: its channels {', '.join(log.names)} do not match the case's {listed}; "
        f"say in the TOML file beside it which `{key}` each column is, counted from 0"
    )


def check_times(log: Log) -> None:
    """Check the times of a log, for runs start at t = 0 from rest.

    Raises ValueError, naming the log, for too few samples, times below 0 and a start much later
    than the log is long.
    """
    first, last = float(log.times[0]), float(log.times[-1])
    if log.times.size < 3:
        raise ValueError(f"{log.source}: a fit needs at least 3 samples, not {log.times.size}")
    if first < 0:
        raise ValueError(
            f"{log.source}: it starts at {first:.4g} s, but runs start at 0, at rest; add "
            f"{-first:.4g} s to its times and to the loads' entry times"
        )
    if first > MAX_START_DURATIONS * (last - first):
        raise ValueError(
            f"{log.source}: it starts only at {first:.6g} s, while runs start at 0; subtract the "
            "time at which the recording began from its times and from the loads' entry times"
        )


def check_loads(log: Log, case: Case) -> None:
    """Raises ValueError unless the log has a load, which has crossed before the log ends."""
    if case.controller is not None and not case.loads:
        return
    if not case.loads:
        raise ValueError(
            f"{log.source}: no load is known, neither in the case nor in the TOML file beside the "
            "log; without loads, only modes can be identified (`identify_modes`)"
        )
    entries, exits = crossing_times(case).T
    end = float(log.times[-1])
    if end < min(entries):
        raise ValueError(
            f"{log.source}: it ends at {end:.4g} s, before the first load enters at "
            f"{min(entries):.4g} s"
        )
    crossing = [leave for leave in exits if leave < NEVER]
    if crossing and end < min(crossing):
        raise ValueError(
            f"{log.source}: it ends at {end:.4g} s, before the first load has crossed at "
            f"{min(crossing):.4g} s; check the load's speed and entry time"
        )


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
