"""Export of the controller of a case: design of gains and estimator, tabulated."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check_case
from jaxbeam.control.optimal.gain_schedules import GainSchedule
from jaxbeam.control.optimal.lqr import LQR, AbstractScheduledRegulator
from jaxbeam.control.optimal.sampled_lqr import DiscreteLQR
from jaxbeam.control.optimal.scheduled_lqr import GainScheduleGrid, ScheduledLQR
from jaxbeam.control.state_feedback import StateFeedback
from jaxbeam.estimation.observer import Observer
from jaxbeam.files.export.gains import Gains
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensor_signals import sensor_sections
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.compiling import compiled


def export_gains(case: Case, points: int = 1001) -> Gains:
    """Gains of the controller of a case, its constant-gain estimator and its sensors' filters.

    Gains that vary along the crossing are tabulated at a number of `points`. Load identification
    is not exported: mass and speed are arguments of `Gains.command`, to be zero before the second
    gate, with the smallest mass of the grid until the mass is identified. The readings are filtered
    by the digital filters before they enter the estimator, whose model includes filters and delays.
    Raises ValueError for an invalid case, a controller without a period or without a gain table,
    an estimator of varying gain, and fewer than two points.
    """
    check_case(case)
    law = case.controller
    is_scheduled = isinstance(law, AbstractScheduledRegulator)
    if not (is_scheduled or isinstance(law, LQR | DiscreteLQR | StateFeedback)):
        raise ValueError(
            "controller.kind cannot be exported: tables are made of 'state', 'lqr', 'dlqr',"
            " 'lqr-finite', 'lqr-step', 'lqr-augmented' and 'lqr-scheduled'"
        )
    if law.period is None:
        raise ValueError("controller.period is missing: a real controller samples; give its period")
    estimator_settings = law.estimator
    if not (
        estimator_settings is None
        or isinstance(estimator_settings, Observer)
        or getattr(estimator_settings, "loads", "") == "ignored"
    ):
        raise ValueError(
            "controller.estimator cannot be exported: its gain must not change; take 'observer', or"
            " 'kalman' with loads = 'ignored', or leave it out to write the gains alone"
        )
    if points < 2:
        raise ValueError(f"a table needs at least two points, not {points}")
    shares = np.linspace(0, 1, points) if is_scheduled else np.zeros(1)
    (system, grid, table, rest, crossing), estimator = _design_gains(
        case, mesh_layout(case), shares
    )
    columns, commands = system.states, system.inputs
    extra_columns = table.shape[-1] - len(columns)
    if extra_columns and is_scheduled:
        columns += tuple((f"load_{i}", "N") for i in range(extra_columns))
    elif extra_columns:
        columns += tuple((f"last_{name}", unit) for name, unit in commands)
    decay_time, (masses, speeds) = getattr(law, "fade_time", None), grid
    return Gains(
        np.asarray(masses),
        np.asarray(speeds),
        shares,
        np.asarray(table),
        np.asarray(rest),
        _digital_filters(case),
        float(concrete(law.period)),
        float(crossing),
        np.inf if decay_time is None else float(concrete(decay_time)),
        law.between if isinstance(law, ScheduledLQR) else "interpolated",
        tuple(tuple(column) for column in columns),
        tuple(tuple(command) for command in commands),
        np.asarray(estimator),
        len(case.sensors) if estimator.size else 0,
    )


def _digital_filters(case: Case) -> np.ndarray:
    """Sections of the sensors' digital filters: rows of sensor index, b0, b1, b2, a0, a1, a2."""
    rows = np.zeros((0, 7))
    for i, sensor in enumerate(case.sensors):
        sections = sensor_sections(sensor, case.controller.period)
        if sections is not None:
            rows = np.concatenate([rows, np.insert(np.asarray(sections), 0, i, axis=1)])
    return rows


@compiled
def _design_gains(case: Case, layout, shares):
    """Results of `_tabulate_gains`, and the matrix `estimator` of `Gains`."""
    plant, law = state_space(case, layout=layout), case.controller
    design_plant = law.design_plant(plant)
    estimator = jnp.zeros((0, 0))
    if law.estimator is not None:
        filter_design = law.estimator.init(design_plant)
        transition, sensor_count = filter_design.transition, filter_design.C.shape[0]
        offset = jnp.zeros((sensor_count, sensor_count)).at[:, 0].set(filter_design.offset)
        estimator = jnp.block([
            [transition.drift, transition.before, transition.after, filter_design.gain],
            [filter_design.C, jnp.zeros_like(filter_design.D), filter_design.D, offset],
        ])  # fmt: skip
    return _tabulate_gains(law, plant, design_plant, shares), estimator


def _tabulate_gains(law, plant, design_plant, shares):
    """Design plant, masses and speeds, gains along and after the crossing, crossing time (s).

    Gains have mass and speed as their first axes.
    """
    memory = law.gain if isinstance(law, StateFeedback) else law.prepare(plant, design_plant)
    no_grid = jnp.zeros(1), jnp.zeros(1)
    if isinstance(memory, GainScheduleGrid):
        tables = jax.vmap(jax.vmap(lambda each: jax.vmap(each.table)(shares)))(memory.schedules)
        crossing = memory.length / memory.given[1]
        grid = memory.masses, memory.speeds
        return design_plant.unloaded, grid, tables, memory.schedules.final_gain, crossing
    if isinstance(memory, GainSchedule):
        table, crossing = jax.vmap(memory.table)(shares), memory.end - memory.start
        return (
            design_plant.unloaded,
            no_grid,
            table[None, None],
            memory.final_gain[None, None],
            crossing,
        )
    return design_plant.unloaded, no_grid, memory[None, None, None], memory[None, None], 0.0
