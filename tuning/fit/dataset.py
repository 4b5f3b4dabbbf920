"""Dataset: logs padded to one length, with the simulation model of each."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, replace, stack_cases, value_at
from jaxbeam.case.validation import check_case
from jaxbeam.integrator.events import EventSchedule, stack_schedules
from jaxbeam.simulation.integration_plan import IntegrationPlan, common_plan, integration_plan
from jaxbeam.simulation.simulate import simulate_readings
from tuning.logs.log import Log
from tuning.logs.pairing import case_of_log, check_loads, check_times, pad_cases, sensor_readings
from tuning.parameters.free import LOG_ADDRESS, with_values

SIMULATION_TOLERANCE = 1e-5  # of the largest deflection, below the resolution of logs
OFFSET_ADDRESS = re.compile(r"(vehicle_)?sensors\.(\d+)\.offset")


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

    def log_addresses(self, addresses: list[str]) -> tuple[list[str], np.ndarray]:
        """Addresses within a log, and the index of the free parameter at each (log, address).

        The index is -1 where the parameter belongs to another log.
        """
        inner = list(dict.fromkeys(LOG_ADDRESS.sub(r"\2", address) for address in addresses))
        which = np.full((len(self.logs), len(inner)), -1)
        for i, address in enumerate(addresses):
            own = LOG_ADDRESS.fullmatch(address)
            rows = slice(None) if own is None else int(own[1])
            which[rows, inner.index(own[2] if own else address)] = i
        return inner, which

    def predictor(self, addresses: list[str]):
        """Function from values at the addresses to all samples, with derivatives at low cost.

        Each log is differentiated by its own parameters only, one log after the other: as a batch
        they would not share what is the same at all times.
        """
        own_addresses, which = self.log_addresses(addresses)
        simulated_addresses = [
            address for address in own_addresses if not OFFSET_ADDRESS.fullmatch(address)
        ]
        columns = [own_addresses.index(address) for address in simulated_addresses]
        own = jnp.array([[value_at(case, a) for a in own_addresses] for case in self.cases])
        zero_offsets = offset_addresses(self.cases[0])
        channels = {
            zero_offsets.index(a): own_addresses.index(a)
            for a in own_addresses
            if a not in simulated_addresses
        }
        constant = jnp.array([[s.offset for s in case.all_sensors] for case in self.cases])

        def simulated(run, values):
            case, times, schedule = run
            case = replace(
                case,
                dict(zip(simulated_addresses, values, strict=True))
                | dict.fromkeys(zero_offsets, 0.0),
            )
            return simulate_readings(case, times, dataclasses.replace(self.plan, schedule=schedule))

        def gather(values):
            return jnp.where(which < 0, own, values[which])

        def offsets(table):
            rows = [
                table[:, channels[i]] if i in channels else constant[:, i]
                for i in range(constant.shape[1])
            ]
            return jnp.stack(rows, axis=1)[:, None, :]

        runs = (stack_cases(self.cases), jnp.asarray(self.times), self.schedule)

        @jax.custom_jvp
        def predict(values):
            table = gather(values)
            samples = jax.lax.map(lambda part: simulated(*part), (runs, table[:, columns]))
            return samples + offsets(table)

        # A jitted function is traced once for all programs that it is part of.
        @jax.jit
        def linearised(runs, table):
            def both(part):
                run, values = part
                basis = jnp.eye(len(simulated_addresses))

                def along(direction):
                    return jax.jvp(lambda v: simulated(run, v), (values,), (direction,))

                return jax.vmap(along, out_axes=(None, -1))(basis)

            return jax.lax.map(both, (runs, table))

        @predict.defjvp
        def _(primals, tangents):
            table, change = jax.jvp(gather, primals, tangents)
            samples, slopes = linearised(runs, table[:, columns])
            moved = jnp.einsum("ltca,la->ltc", slopes, change[:, columns])
            # Offsets only shift: their derivative is that of the shift.
            shift = offsets(change) - offsets(jnp.zeros_like(change))
            return samples + offsets(table), moved + shift

        return predict

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


def offset_addresses(case: Case) -> list[str]:
    """Addresses of the offsets of all sensors, in the order of the channels."""
    on_beam = [f"sensors.{i}.offset" for i in range(len(case.sensors))]
    return on_beam + [f"vehicle_sensors.{i}.offset" for i in range(len(case.vehicle_sensors))]


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
