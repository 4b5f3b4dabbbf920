"""Gains and estimator of the controller of a case, designed and tabulated for export.

Tables are as a controller evaluates them, with the check values of files.
"""

import dataclasses
import math
import zlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import concrete, kinds
from jaxbeam.case.validation import check_case
from jaxbeam.control.crossing_gains import GainSchedule, ScheduledGainLaw
from jaxbeam.control.estimation.observer import ConstantGainFilter, Observer
from jaxbeam.control.estimation.sampled_plant import sample_timing
from jaxbeam.control.lqr import LQR
from jaxbeam.control.state_controller import AbstractStateLaw, GainLaw, StateFeedback
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.sensor_signals import sensor_sections
from jaxbeam.model.state_space import StateSpace, state_space, vehicle_signals
from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled

ARRAYS = ("masses", "speeds", "shares", "table", "rest", "filters", "estimator")
TEST_SHARE = 0.37  # of the crossing
TEST_FRACTION = 0.3  # of the ranges of mass and speed


@dataclasses.dataclass(frozen=True, eq=False)
class Gains:
    """Gain tables as a controller evaluates them: u = -K(mass, speed, share) z.

    `table` (mass, speed, share, actuator, column) is K at the `masses` (kg), `speeds` (m/s) and
    fractions (`shares`) of the crossing, 0 at the entry of the first load, 1 at the last exit;
    `rest` (mass, speed, actuator, column) is K after the exit, which decays with the time constant
    `decay_time` (s) if that is finite. K is interpolated linearly over the share, and over mass and
    speed either linearly too (`interpolation` "interpolated") or by the "nearest" design; beyond
    the grid it is constant. A design for one load has one mass and one speed, both 0; a constant
    gain has one share as well.

    `crossing_time` (s) is that of the design, 0 for a constant gain. `columns` (of z) and
    `commands` are pairs of name and unit. Rows of `filters` are the index of a sensor and a section
    b0, b1, b2, a0, a1, a2 of its digital filter.

    `estimator` = [[A, B, B', L], [C, 0, D, o]], empty if there is none, has at each sample k the
    prediction x- = A x + B u[k-1] + B' u[k] and the update x = x- + L (y - C x- - D u[k] - o), with
    `reading_count` readings y, commands u[k] that acted until sample k, and o the first column of
    its block. Its first states are the first of z.
    """

    masses: np.ndarray
    speeds: np.ndarray
    shares: np.ndarray
    table: np.ndarray
    rest: np.ndarray
    filters: np.ndarray
    period: float
    crossing_time: float
    decay_time: float
    interpolation: str
    columns: tuple[tuple[str, str], ...]
    commands: tuple[tuple[str, str], ...]
    estimator: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    reading_count: int = 0

    def command(
        self,
        state: ArrayLike,
        share: float = 0.0,
        since_exit: float = 0.0,
        mass: float = 0.0,
        speed: float = 0.0,
    ) -> np.ndarray:
        """Commands for a state z, in the order of `columns`, at a fraction of the crossing.

        The `share` is negative before the entry, where commands are zero, and 1 or more from the
        exit on, which was `since_exit` s ago. `mass` (kg) and `speed` (m/s, absolute) are those of
        the load. Products are added in the order of the function `jaxbeam_command` of the C header,
        so results agree to the last bit (with a finite `decay_time`, if both use the same `exp`).
        """
        total = np.zeros(len(self.commands))
        if share < 0:
            return total
        gain = np.zeros(self.rest.shape[2:])
        for i, mass_weight in self._grid_weights(self.masses, mass):
            for j, speed_weight in self._grid_weights(self.speeds, speed):
                gain = gain + mass_weight * speed_weight * self._gain_at(i, j, share, since_exit)
        for column, value in zip(gain.T, np.asarray(state, float), strict=True):
            total = total - column * value
        return total

    @property
    def estimator_size(self) -> int:
        """Number of states of the estimator."""
        return self.estimator.shape[0] - self.reading_count

    def estimate(
        self,
        state: ArrayLike,
        previous_command: ArrayLike,
        current_command: ArrayLike,
        readings: ArrayLike,
    ) -> np.ndarray:
        """State estimate at a sample, from that at the previous sample; zero initially.

        `previous_command` acted until the previous sample, `current_command` until this one. Sums
        are in the order of the function `jaxbeam_estimate` of the C header.
        """
        size, inputs = self.estimator_size, len(self.commands)
        if not size:
            return np.zeros(0)
        stacked = np.concatenate(
            [np.ravel(state), np.ravel(previous_command), np.ravel(current_command)]
        )
        prior = _accumulate(np.zeros(size), self.estimator[:size], stacked)
        output_rows, offset_column = self.estimator[size:], size + 2 * inputs
        output_inputs = np.concatenate([prior, np.zeros(inputs), np.ravel(current_command)])
        innovation = _accumulate(
            np.ravel(readings) - output_rows[:, offset_column], -output_rows, output_inputs
        )
        return _accumulate(prior, self.estimator[:size, offset_column:], innovation)

    def _gain_at(self, i: int, j: int, share: float, since_exit: float) -> np.ndarray:
        """Gain of one mass and speed of the grid."""
        if share >= 1 and self.shares.size > 1:
            decay = (
                math.exp(-since_exit / self.decay_time) if math.isfinite(self.decay_time) else 1.0
            )
            return decay * self.rest[i, j]
        k, fraction = _index_and_fraction(self.shares, share)
        low = self.table[i, j, k]
        return low + fraction * (self.table[i, j, min(k + 1, self.shares.size - 1)] - low)

    def _grid_weights(self, grid: np.ndarray, value: float) -> list[tuple[int, float]]:
        """Indices into a grid and their weights, for the interpolation at a value."""
        if self.interpolation == "nearest":
            return [(int(np.argmin(np.abs(grid - value))), 1.0)]
        i, fraction = _index_and_fraction(grid, value)
        return [(i, 1.0 - fraction), (min(i + 1, grid.size - 1), fraction)]

    @property
    def test_input(self) -> dict:
        """Arguments of `command` for its check value: the state is 1, 1/2, 1/3, ..."""
        grids = self.masses, self.speeds
        mass, speed = (float(g[0] + TEST_FRACTION * (g[-1] - g[0])) for g in grids)
        state = (1 / np.arange(1.0, len(self.columns) + 1)).tolist()
        load = {"mass": mass, "speed": speed}
        return {"state": state, "share": TEST_SHARE, "since_exit": 0.0} | load

    @property
    def test_command(self) -> np.ndarray:
        """Check value: commands for the test input."""
        return self.command(**self.test_input)

    @property
    def test_estimate(self) -> np.ndarray:
        """Check value: estimate for states, commands and readings of 1, 1/2, 1/3, ... each."""
        counts = self.estimator_size, len(self.commands), len(self.commands)
        return self.estimate(*(1 / np.arange(1.0, n + 1) for n in (*counts, self.reading_count)))

    @property
    def checksum(self) -> int:
        """CRC-32 of period, crossing time, decay time and all arrays, as little-endian doubles."""
        numbers = [self.period, self.crossing_time, self.decay_time]
        parts = [numbers, *(getattr(self, name) for name in ARRAYS)]
        return zlib.crc32(b"".join(np.ravel(part).astype("<f8").tobytes() for part in parts))


def _accumulate(total: np.ndarray, matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sum of a total and a matrix times values, column by column; further columns are ignored."""
    for column, value in zip(matrix.T, values, strict=False):
        total = total + column * value
    return total


def _index_and_fraction(grid: np.ndarray, value: float) -> tuple[int, float]:
    """Index of the last point of a grid that is not above a value, and fraction to the next."""
    i = max(int(np.searchsorted(grid, value, "right")) - 1, 0)
    if i + 1 >= grid.size or value <= grid[i]:
        return i, 0.0
    return i, float((value - grid[i]) / (grid[i + 1] - grid[i]))


EXPORTABLE = (LQR, StateFeedback)


@checks_classes
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
