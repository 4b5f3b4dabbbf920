"""The gains of the controller of a case, designed and tabulated."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check
from jaxbeam.control import DiscreteLQR, StateFeedback
from jaxbeam.control.optimal.gain_schedules import GainSchedule
from jaxbeam.control.optimal.lqr import LQR, AbstractScheduledRegulator
from jaxbeam.control.optimal.scheduled_lqr import GainScheduleGrid, ScheduledLQR
from jaxbeam.estimation import Observer
from jaxbeam.files.export.gains import Gains
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensor_signals import sensor_sections
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.compiling import compiled


def export_gains(case: Case, points: int = 1001) -> Gains:
    """The gains of a case's controller, designed, its estimator, and its sensors' digital filters.

    Gains that change over the crossing are tabulated at so many `points`. Where the controller
    recognises its loads, that is left to the one who runs the table: there is no command before
    the second gate, and the lightest mass is taken until the mass is told. An estimator whose gain
    does not change goes along, with what it knows of filters and delays of the sensors; before it
    runs, the filters do. Raises ValueError for a faulty case, a controller without a period, one
    that is no table of gains, and another estimator.
    """
    check(case)
    law = case.controller
    tabled = isinstance(law, AbstractScheduledRegulator)
    if not (tabled or isinstance(law, LQR | DiscreteLQR | StateFeedback)):
        raise ValueError(
            "controller.kind cannot be exported: tables are made of 'state', 'lqr', 'dlqr',"
            " 'lqr-finite', 'lqr-step', 'lqr-augmented' and 'lqr-scheduled'"
        )
    if law.period is None:
        raise ValueError("controller.period is missing: a real controller samples; give its period")
    own = law.estimator
    if not (own is None or isinstance(own, Observer) or getattr(own, "loads", "") == "ignored"):
        raise ValueError(
            "controller.estimator cannot be exported: its gain must not change; take 'observer', or"
            " 'kalman' with loads = 'ignored', or leave it out to write the gains alone"
        )
    if points < 2:
        raise ValueError(f"a table needs at least two points, not {points}")
    shares = np.linspace(0, 1, points) if tabled else np.zeros(1)
    (plant, grid, table, rest, crossing), estimator = _designed(case, mesh_layout(case), shares)
    columns, commands = plant.states, plant.inputs
    more = table.shape[-1] - len(columns)
    if more and tabled:
        columns += tuple((f"load_{i}", "N") for i in range(more))
    elif more:
        columns += tuple((f"last_{name}", unit) for name, unit in commands)
    fade, (masses, speeds) = getattr(law, "fade_time", None), grid
    return Gains(
        np.asarray(masses),
        np.asarray(speeds),
        shares,
        np.asarray(table),
        np.asarray(rest),
        _filters(case),
        float(concrete(law.period)),
        float(crossing),
        np.inf if fade is None else float(concrete(fade)),
        law.between if isinstance(law, ScheduledLQR) else "interpolated",
        tuple(tuple(column) for column in columns),
        tuple(tuple(command) for command in commands),
        np.asarray(estimator),
        len(case.sensors) if estimator.size else 0,
    )


def _filters(case: Case) -> np.ndarray:
    """The digital filters of the sensors: rows of a sensor's index and one of its sections."""
    rows = np.zeros((0, 7))
    for i, sensor in enumerate(case.sensors):
        sections = sensor_sections(sensor, case.controller.period)
        if sections is not None:
            rows = np.concatenate([rows, np.insert(np.asarray(sections), 0, i, axis=1)])
    return rows


@compiled
def _designed(case: Case, layout, shares):
    """What gains are made of, see `_tabulated`, and the estimator (see `Gains`)."""
    model, law = state_space(case, layout=layout), case.controller
    designed = law.design_plant(model)
    estimator = jnp.zeros((0, 0))
    if law.estimator is not None:
        made = law.estimator.init(designed)
        step, sensors = made.transition, made.C.shape[0]
        offset = jnp.zeros((sensors, sensors)).at[:, 0].set(made.offset)
        estimator = jnp.block([
            [step.drift, step.before, step.after, made.gain],
            [made.C, jnp.zeros_like(made.D), made.D, offset],
        ])  # fmt: skip
    return _tabulated(law, model, designed, shares), estimator


def _tabulated(law, model, designed, shares):
    """The plant designed for; masses and speeds; gains over a crossing and after it; its time (s).

    Tables and gains have a mass and a speed as their first axes.
    """
    memory = law.gain if isinstance(law, StateFeedback) else law.prepare(model, designed)
    one = jnp.zeros(1), jnp.zeros(1)
    if isinstance(memory, GainScheduleGrid):
        tables = jax.vmap(jax.vmap(lambda each: jax.vmap(each.table)(shares)))(memory.schedules)
        crossing = memory.length / memory.given[1]
        grid = memory.masses, memory.speeds
        return designed.unloaded, grid, tables, memory.schedules.final_gain, crossing
    if isinstance(memory, GainSchedule):
        table, crossing = jax.vmap(memory.table)(shares), memory.end - memory.start
        return designed.unloaded, one, table[None, None], memory.final_gain[None, None], crossing
    return designed.unloaded, one, memory[None, None, None], memory[None, None], 0.0
