"""Logs and the case that is to explain them, made ready for a fit."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, replace, value_at
from jaxbeam.case.validation import check
from jaxbeam.integrator.events import Schedule, stacked
from jaxbeam.simulation.integration_plan import IntegrationPlan, integration_plan
from jaxbeam.simulation.simulate import simulate_readings
from tuning.logs.log import Log
from tuning.logs.pairing import case_of_log, check_loads, check_times, pad_cases, sensor_readings
from tuning.parameters.free import LOG_ADDRESS, with_values

SIMULATION_TOLERANCE = 1e-5  # of the largest deflection: what logs can resolve, with room to spare
OFFSET_ADDRESS = re.compile(r"sensors\.(\d+)\.offset")


@dataclasses.dataclass(frozen=True)
class Dataset:
    """Logs with the case of each: logs alike in structure share one compiled simulation.

    Logs are padded to the longest with equally spaced times, `mask` is 1 for samples
    that were measured and 0 for those that only fill up. Samples are (log, time, channel). Where
    a controller takes part, its commands from a log included, `schedule` holds its clock in each.
    `nominal_case` is the case before any log changed it.
    """

    nominal_case: Case
    cases: list[Case]
    logs: list[Log]
    plan: IntegrationPlan
    times: Float[np.ndarray, "log time"]
    measured: Float[np.ndarray, "log time channel"]
    mask: Float[np.ndarray, "log time channel"]
    schedule: Schedule | None = None

    def log_addresses(self, addresses: list[str]) -> tuple[list[str], np.ndarray]:
        """Addresses as seen within a log, and which of the free numbers (log, address) each is.

        A number of one log is -1 in the others, which keep their own.
        """
        inner = list(dict.fromkeys(LOG_ADDRESS.sub(r"\2", address) for address in addresses))
        which = np.full((len(self.logs), len(inner)), -1)
        for i, address in enumerate(addresses):
            own = LOG_ADDRESS.fullmatch(address)
            rows = slice(None) if own is None else int(own[1])
            which[rows, inner.index(own[2] if own else address)] = i
        return inner, which

    def predictor(self, addresses: list[str]):
        """Function from the values at the addresses to all samples, with cheap derivatives.

        Each log is differentiated by its own few numbers only, one log after the other: side by
        side they would not share what is equal in time.
        """
        own_addresses, which = self.log_addresses(addresses)
        simulated_addresses = [
            address for address in own_addresses if not OFFSET_ADDRESS.fullmatch(address)
        ]
        columns = [own_addresses.index(address) for address in simulated_addresses]
        own = jnp.array([[value_at(case, a) for a in own_addresses] for case in self.cases])
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *self.cases)
        zero_offsets = {a: 0.0 for a in offset_addresses(self.cases[0])}
        channels = {
            int(OFFSET_ADDRESS.fullmatch(a)[1]): own_addresses.index(a)
            for a in own_addresses
            if a not in simulated_addresses
        }
        constant = jnp.array([[s.offset for s in case.sensors] for case in self.cases])

        def simulated(run, values):
            case, times, schedule = run
            case = replace(case, dict(zip(simulated_addresses, values, strict=True)) | zero_offsets)
            return simulate_readings(case, times, dataclasses.replace(self.plan, schedule=schedule))

        def gather(values):
            return jnp.where(which < 0, own, values[which])

        def offsets(table):
            rows = [
                table[:, channels[i]] if i in channels else constant[:, i]
                for i in range(constant.shape[1])
            ]
            return jnp.stack(rows, axis=1)[:, None, :]

        runs = (stacked, jnp.asarray(self.times), self.schedule)

        @jax.custom_jvp
        def predict(values):
            table = gather(values)
            samples = jax.lax.map(lambda part: simulated(*part), (runs, table[:, columns]))
            return samples + offsets(table)

        # A function of its own is traced once for all programs that it is a part of.
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
        """Why fitted values may be wrong although the search ended; "" if there is no doubt.

        The plan was made for the starts; far from them loads may come in another order, or
        steps be too long. And without bounds a number may end where no rig can have it.
        """
        for i, (case, times) in enumerate(zip(self.cases, self.times, strict=True)):
            try:
                plan = integration_plan(
                    with_values(case, i, values), jnp.asarray(times), SIMULATION_TOLERANCE
                )
            except (ValueError, RuntimeError) as error:
                return f", to a case that cannot be: {error}"
            changed = (
                plan.shapes.layout != self.plan.shapes.layout
                or plan.shapes.max_loads > self.plan.shapes.max_loads
            )
            if changed or plan.substeps > 2 * self.plan.substeps:
                return ", but far from the start: fit once more with these values as the start"
        return ""


def offset_addresses(case: Case) -> list[str]:
    """Addresses of the offsets of all sensors."""
    return [f"sensors.{i}.offset" for i in range(len(case.sensors))]


def make_dataset(case: Case, logs: list[Log]) -> Dataset:
    """Check logs against the case and bring them to one shape.

    Raises ValueError, naming the log, if its channels do not match the sensors, no load is known,
    it ends before the first load has crossed, or logs differ too much to be fitted together.
    """
    if not logs:
        raise ValueError("give at least one log")
    check(case)
    for log in logs:
        check_times(log)
    count = max(log.times.size for log in logs)
    times = [_padded_times(log.times, count) for log in logs]
    cases = [case_of_log(case, log, filled) for log, filled in zip(logs, times, strict=True)]
    ordered = [sensor_readings(case, log) for log in logs]
    for log, own in zip(logs, cases, strict=True):
        check_loads(log, own)
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
    if len({plan.shapes.layout for plan in plans}) > 1:
        raise ValueError("the logs differ in the order of places along the beam; fit them apart")
    static_shapes = dataclasses.replace(
        plans[0].shapes,
        slots=max(plan.shapes.max_loads for plan in plans),
        coupled=any(plan.shapes.coupled for plan in plans),
    )
    plan = dataclasses.replace(
        plans[0],
        shapes=static_shapes,
        substeps=max(plan.substeps for plan in plans),
        lead=max(plan.lead_samples for plan in plans),
        equally_spaced=all(plan.equally_spaced for plan in plans),
        schedule=None,
    )
    schedules = [own.schedule for own in plans]
    schedule = None if schedules[0] is None else stacked(schedules)
    return Dataset(
        case,
        cases,
        logs,
        plan,
        np.array(times),
        np.array(measured),
        np.array(mask, float),
        schedule,
    )


def _padded_times(times: Float[np.ndarray, " time"], count: int) -> Float[np.ndarray, " filled"]:
    """Times followed by as many more, equally spaced, as make up a count."""
    spacing = np.diff(times).mean()
    return np.append(times, times[-1] + spacing * np.arange(1, count - times.size + 1))
