"""Dataset: logs padded to one length, with the simulation model of each."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.validation import check_case
from jaxbeam.integrator.events import EventSchedule, stack_schedules
from jaxbeam.simulation.integration_plan import IntegrationPlan, common_plan, integration_plan
from tuning.logs.log import Log
from tuning.logs.pairing import case_of_log, check_loads, check_times, pad_cases, sensor_readings
from tuning.parameters.free import with_values
from tuning.parameters.prediction import LogPrediction

SIMULATION_TOLERANCE = 1e-5  # of the largest deflection, below the resolution of logs


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Logs with the case of each, alike in structure, so that they share one compiled simulation.

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
        """Warning that the integration plan does not hold at the fitted values; "" if it does.

        The plan was made for the starts: far from them the loads may change their order, or
        steps be too long; and without bounds a parameter may end at a value that no beam can have.
        """
        for i, (case, times) in enumerate(zip(self.cases, self.times, strict=True)):
            try:
                plan = integration_plan(
                    with_values(case, i, values), jnp.asarray(times), SIMULATION_TOLERANCE
                )
            except (ValueError, RuntimeError) as error:
                return f", to a case that cannot be simulated: {error}"
            changed = (
                plan.shapes.layout != self.plan.shapes.layout
                or plan.shapes.max_loads > self.plan.shapes.max_loads
            )
            if changed or plan.substeps > 2 * self.plan.substeps:
                return ", but far from the start: fit once more with these values as the start"
        return ""


def make_dataset(case: Case, logs: list[Log]) -> Dataset:
    """Dataset of logs, checked against the case.

    Raises ValueError, naming the log, if its channels do not match the sensors, no load is known,
    it ends before the first load has crossed, or logs differ in structure.
    """
    if not logs:
        raise ValueError("give at least one log")
    # Loads, and with them sensors on vehicles, may be known from the logs only.
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
