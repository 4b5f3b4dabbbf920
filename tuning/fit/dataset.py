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
from jaxbeam.simulation.integration_plan import Plan, make_plan
from jaxbeam.simulation.simulate import readings
from tuning.logs.log import Log
from tuning.logs.pairing import at_sensors, case_of_log, check_loads, check_times, made_alike
from tuning.parameters.free import OF_LOG, insert

TOLERANCE = 1e-5  # of the largest deflection: what logs can resolve, with room to spare
OFFSET = re.compile(r"sensors\.(\d+)\.offset")


@dataclasses.dataclass(frozen=True)
class Campaign:
    """Logs with the case of each: logs alike in structure share one compiled simulation.

    Logs are padded to the longest with equally spaced times, `real` is 1 for samples
    that were measured and 0 for those that only fill up. Samples are (log, time, channel). Where
    a controller takes part, its commands from a log included, `schedule` holds its clock in each.
    `given` is the case before any log changed it.
    """

    given: Case
    cases: list[Case]
    logs: list[Log]
    plan: Plan
    times: Float[np.ndarray, "log time"]
    measured: Float[np.ndarray, "log time channel"]
    real: Float[np.ndarray, "log time channel"]
    schedule: Schedule | None = None

    def local(self, addresses: list[str]) -> tuple[list[str], np.ndarray]:
        """Addresses as seen within a log, and which of the free numbers (log, address) each is.

        A number of one log is -1 in the others, which keep their own.
        """
        inner = list(dict.fromkeys(OF_LOG.sub(r"\2", address) for address in addresses))
        which = np.full((len(self.logs), len(inner)), -1)
        for i, address in enumerate(addresses):
            own = OF_LOG.fullmatch(address)
            rows = slice(None) if own is None else int(own[1])
            which[rows, inner.index(own[2] if own else address)] = i
        return inner, which

    def predictor(self, addresses: list[str]):
        """Function from the values at the addresses to all samples, with cheap derivatives.

        Each log is differentiated by its own few numbers only, one log after the other: side by
        side they would not share what is equal in time.
        """
        inner, which = self.local(addresses)
        moving = [address for address in inner if not OFFSET.fullmatch(address)]
        columns = [inner.index(address) for address in moving]
        own = jnp.array([[value_at(case, a) for a in inner] for case in self.cases])
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *self.cases)
        steady = {a: 0.0 for a in addresses_of_offsets(self.cases[0])}
        channels = {int(OFFSET.fullmatch(a)[1]): inner.index(a) for a in inner if a not in moving}
        constant = jnp.array([[s.offset for s in case.sensors] for case in self.cases])

        def simulated(run, values):
            case, times, schedule = run
            case = replace(case, dict(zip(moving, values, strict=True)) | steady)
            return readings(case, times, dataclasses.replace(self.plan, schedule=schedule))

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
                basis = jnp.eye(len(moving))

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

    def doubt(self, values: dict[str, float]) -> str:
        """Why fitted values may be wrong although the search ended; "" if there is no doubt.

        The plan was made for the starts; far from them loads may come in another order, or
        steps be too long. And without bounds a number may end where no rig can have it.
        """
        for i, (case, times) in enumerate(zip(self.cases, self.times, strict=True)):
            try:
                plan = make_plan(insert(case, i, values), jnp.asarray(times), TOLERANCE)
            except (ValueError, RuntimeError) as error:
                return f", to a case that cannot be: {error}"
            changed = (
                plan.form.layout != self.plan.form.layout or plan.form.slots > self.plan.form.slots
            )
            if changed or plan.substeps > 2 * self.plan.substeps:
                return ", but far from the start: fit once more with these values as the start"
        return ""


def addresses_of_offsets(case: Case) -> list[str]:
    """Addresses of the offsets of all sensors."""
    return [f"sensors.{i}.offset" for i in range(len(case.sensors))]


def prepare(case: Case, logs: list[Log]) -> Campaign:
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
    times = [_filled(log.times, count) for log in logs]
    cases = [case_of_log(case, log, filled) for log, filled in zip(logs, times, strict=True)]
    ordered = [at_sensors(case, log) for log in logs]
    for log, own in zip(logs, cases, strict=True):
        check_loads(log, own)
    cases = made_alike(cases, times)
    shapes = {jax.tree.structure(own) for own in cases}
    if len(shapes) > 1:
        raise ValueError(
            "the logs differ in the kinds of their loads, one after the other, or in how these "
            "move (by a speed, or by a table); give all the same kinds, or fit the logs apart"
        )
    measured, real = [], []
    for log, (values, has) in zip(logs, ordered, strict=True):
        measured.append(np.pad(values, ((0, count - log.times.size), (0, 0))))
        real.append(np.pad(has, ((0, count - log.times.size), (0, 0))))
    plans = [make_plan(own, jnp.asarray(t), TOLERANCE) for own, t in zip(cases, times, strict=True)]
    if len({plan.form.layout for plan in plans}) > 1:
        raise ValueError("the logs differ in the order of places along the beam; fit them apart")
    form = dataclasses.replace(
        plans[0].form,
        slots=max(plan.form.slots for plan in plans),
        coupled=any(plan.form.coupled for plan in plans),
    )
    plan = dataclasses.replace(
        plans[0],
        form=form,
        substeps=max(plan.substeps for plan in plans),
        lead=max(plan.lead for plan in plans),
        even=all(plan.even for plan in plans),
        schedule=None,
    )
    clocks = [own.schedule for own in plans]
    schedule = None if clocks[0] is None else stacked(clocks)
    return Campaign(
        case,
        cases,
        logs,
        plan,
        np.array(times),
        np.array(measured),
        np.array(real, float),
        schedule,
    )


def _filled(times: Float[np.ndarray, " time"], count: int) -> Float[np.ndarray, " filled"]:
    """Times followed by as many more, equally spaced, as make up a count."""
    spacing = np.diff(times).mean()
    return np.append(times, times[-1] + spacing * np.arange(1, count - times.size + 1))
