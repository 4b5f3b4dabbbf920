"""Gains and estimator of the controller of a case, designed and tabulated for export."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete, kinds
from jaxbeam.case.validation import check_case
from jaxbeam.control.optimal.crossing_gains import GainSchedule, ScheduledGainLaw
from jaxbeam.control.optimal.lqr import LQR
from jaxbeam.control.state_controller import AbstractStateLaw, GainLaw, StateFeedback
from jaxbeam.estimation.observer import ConstantGainFilter, Observer
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.files.export.gains import Gains
from jaxbeam.model.contact import vehicle_signals
from jaxbeam.model.linear_system import StateSpace
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensing.sensor_signals import sensor_sections
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled

EXPORTABLE = (LQR, StateFeedback)


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
    if not isinstance(law, EXPORTABLE):
        words = [
            repr(kind)
            for kind, controller in kinds(AbstractController).items()
            if issubclass(controller, EXPORTABLE)
        ]
        raise ValueError(
            "controller.kind cannot be exported: tables are made of"
            f" {', '.join(words[:-1])} and {words[-1]}"
        )
    is_lqr = isinstance(law, LQR)
    if is_lqr and (law.schedule == "positions" or law.reference is not None):
        raise ValueError(
            "controller cannot be exported as tables: leave out schedule = 'positions' and integral"
            " action, or write C code"
        )
    varies = is_lqr and law.varies
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
    shares = np.linspace(0, 1, points) if varies else np.zeros(1)
    design = _design_gains(case, mesh_layout(case), shares)
    columns, commands = design.system.states, design.system.inputs
    extra_columns = design.table.shape[-1] - len(columns)
    if extra_columns and varies:
        columns += _further_columns(case)[:extra_columns]
    elif extra_columns:
        columns += tuple((f"last_{name}", unit) for name, unit in commands)
    decay_time = getattr(law, "fade_time", None)
    return Gains(
        masses=np.asarray(design.masses),
        speeds=np.asarray(design.speeds),
        shares=shares,
        table=np.asarray(design.table),
        rest=np.asarray(design.rest),
        filters=_digital_filters(case),
        period=float(concrete(law.period)),
        crossing_time=float(design.crossing_time),
        decay_time=np.inf if decay_time is None else float(concrete(decay_time)),
        interpolation=law.between if is_lqr else "interpolated",
        columns=tuple(tuple(column) for column in columns),
        commands=tuple(tuple(command) for command in commands),
        estimator=np.asarray(design.estimator),
        reading_count=len(case.sensors) if design.estimator.size else 0,
    )


def _further_columns(case: Case) -> tuple:
    """Names and units of the further columns of z of a regulator over the crossing, in order.

    They are states of vehicles, weights of the wheels, and 1 for other measured disturbances.
    """
    loads = load_set(case)
    weights = tuple((f"load_{i}", "N") for i in range(loads.wheel_count))
    vehicles = () if case.controller.schedule == "load" else vehicle_signals(loads)
    return (*vehicles, *weights, ("known_disturbance", "1"))


def _digital_filters(case: Case) -> np.ndarray:
    """Sections of the sensors' digital filters: rows of sensor index, b0, b1, b2, a0, a1, a2."""
    rows = np.zeros((0, 7))
    for i, sensor in enumerate(case.sensors):
        sections = sensor_sections(sensor, case.controller.period)
        if sections is not None:
            rows = np.concatenate([rows, np.insert(np.asarray(sections), 0, i, axis=1)])
    return rows


class GainDesign(NamedTuple):
    """Designed numbers of a gain table; see `Gains`."""

    system: StateSpace
    masses: Float[Array, " mass"]
    speeds: Float[Array, " speed"]
    table: Float[Array, "mass speed share actuator column"]
    rest: Float[Array, "mass speed actuator column"]
    crossing_time: Float[Array, ""]
    estimator: Float[Array, "row entry"]


@compiled
def _design_gains(case: Case, layout, shares) -> GainDesign:
    """Design of the controller of a case, tabulated at fractions (`shares`) of the crossing."""
    controller = case.controller
    plant = state_space(case, layout=layout).of_driven()
    design_plant = controller.design_plant(plant)
    estimator = jnp.zeros((0, 0))
    if controller.estimator is not None:
        timing = sample_timing(controller)
        estimator = _estimator_matrix(controller.estimator.sampled_filter(design_plant, timing))
    law = controller.design_state_law(plant, design_plant)
    return GainDesign(design_plant.unloaded, *_tabulated(law, shares), estimator)


def _estimator_matrix(filter: ConstantGainFilter) -> Float[Array, "row entry"]:
    """Matrix [[A, B, B', L], [C, 0, D, o]] of a filter; see `Gains`."""
    transition, sensors = filter.transition, filter.C.shape[0]
    offset = jnp.zeros((sensors, sensors)).at[:, 0].set(filter.offset)
    prediction = transition.matrix, transition.previous_input_matrix, transition.input_matrix
    return jnp.block(
        [[*prediction, filter.gain], [filter.C, jnp.zeros_like(filter.D), filter.D, offset]]
    )


def _tabulated(
    law: AbstractStateLaw, shares: Float[Array, " share"]
) -> tuple[Array, Array, Array, Array, Array]:
    """Masses (kg), speeds (m/s), gains at fractions of and after the crossing, its time (s)."""
    no_grid = jnp.zeros(1), jnp.zeros(1)
    if isinstance(law, GainLaw):
        return *no_grid, law.gain[None, None, None], law.gain[None, None], jnp.zeros(())
    if isinstance(law, GainSchedule):
        table = jax.vmap(law.table)(shares)
        return *no_grid, table[None, None], law.final_gain[None, None], law.end - law.start
    assert isinstance(law, ScheduledGainLaw)
    tables = jax.vmap(jax.vmap(lambda schedule: jax.vmap(schedule.table)(shares)))(law.schedules)
    crossing_time = law.length / law.design_speed
    return law.masses, law.speeds, tables, law.schedules.final_gain, crossing_time
