"""Lower bound on the peak deflection: the least peak over all commands within the limits.

For given loads and a given profile the deflection is affine in the held commands u_k: the beam
under moving loads varies in time, but it is linear in its commands. With u_k the command to one
actuator during one hold,

    w(x, t) = w_0(x, t) + sum_k g_k(x, t) u_k.

Both parts come from the integrator of `simulate`, in batches of unit commands on one load path. The
least peak p is the optimum of a linear program,

    minimise p   subject to   |w_0(x, t) + sum_k g_k(x, t) u_k| <= p,
                              u_min <= u_k <= u_max,   |u_k - u_(k-1)| <= rate * period,

at all positions x and times t. No controller that holds its commands over the same period has a
smaller peak, whatever it measures, estimates or predicts.

The unknowns are the commands, bounds on their changes and absolute values, and the peak. Rows that
keep the deflection below the peak are generated: those violated are added until none is, so that
many positions cost little. Many commands attain the least peak; a small penalty on changes and
absolute values selects smooth ones, and reduces the number of rounds.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import scipy  # loads its parts on first use; all of them take a third of a second
from jaxtyping import Float, Int
from numpy.typing import ArrayLike

from jaxbeam.case.actuators.base import limited_loops
from jaxbeam.case.case import Case, check_is_case
from jaxbeam.case.controller import commanded
from jaxbeam.case.fields import check_on_beam, concrete, real_numbers, refuses_traced
from jaxbeam.case.validation import check_case
from jaxbeam.control.feedforward import Prescribed
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.runtime.arrays import Array, Module, take, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.runtime.memory import block_memory, free_memory, size_text
from jaxbeam.simulation.commands import acting_ranges
from jaxbeam.simulation.integration_plan import steps_per_interval
from jaxbeam.simulation.integrator.discrete_model import NODE_COUNT, discrete_model
from jaxbeam.simulation.integrator.inputs import AbstractInputPolicy
from jaxbeam.simulation.integrator.integrate import integrate_history, integrate_peaks
from jaxbeam.simulation.integrator.peaks import RunningPeaks
from jaxbeam.simulation.integrator.step_size import StaticShapes, choose_step_size, static_shapes
from jaxbeam.simulation.integrator.time_grid import (
    EventSchedule,
    Transmission,
    controller_schedule,
    grid_by_schedule,
    grid_by_step_length,
)
from jaxbeam.simulation.record import Record

TOLERANCE = 1e-9  # relative to the largest deflection
MAX_BATCH_SIZE = 1024  # unit commands at once; fewer where memory is short
NO_PLACES = np.zeros(0)
COPIES = 3  # of the states of all steps of a run, while they are integrated


class InputInfluence(Module):
    """Modal coordinates at `times` (s): `unforced` by commands, and `response` to unit commands.

    A unit command is held from one of the `hold_times` (s) to the next. `deflection_rows` map the
    coordinates to the deflection (m) at given positions. `velocity` and `velocity_response` are
    those (m/s) of the beam at some places as holds begin. Relative errors are about 1e-9.
    """

    deflection_rows: Float[np.ndarray, "position mode"]
    hold_times: Float[np.ndarray, " hold"]
    times: Float[np.ndarray, " time"]
    unforced: Float[np.ndarray, "time mode"]
    response: Float[np.ndarray, "time mode hold actuator"]
    velocity: Float[np.ndarray, "hold place"]
    velocity_response: Float[np.ndarray, "hold place hold actuator"]

    def deflection(
        self, commands: Float[np.ndarray, "hold actuator"]
    ) -> Float[np.ndarray, "time position"]:
        """Deflection (m) under held commands."""
        return (
            self.unforced + np.tensordot(self.response, commands, axes=2)
        ) @ self.deflection_rows.T


class _UnitCommands(AbstractInputPolicy):
    """Input policy of unit commands: in each run to one actuator, during one hold."""

    schedule: EventSchedule
    hold_index: Int[Array, " batch"]
    actuator_index: Int[Array, " batch"]
    load_amplitude: float
    actuators: int = eqx.field(static=True)
    implicit: bool = eqx.field(static=True, default=False)

    def start(self, batch_size):
        return xp.zeros((), int)

    def inputs(self, memory, state, step_info, states):
        hold_started = take(self.schedule.control_sample, step_info.event)
        current_hold = xp.where((step_info.event >= 0) & (hold_started >= 0), hold_started, memory)
        is_commanded = self.actuator_index == np.arange(self.actuators)[:, None]
        command = xp.where(is_commanded & (self.hold_index == current_hold), 1.0, 0.0)
        return xp.broadcast_to(command, (NODE_COUNT, *command.shape)), current_hold

    def observe(self, memory, step_info):
        return None


def input_influence(
    case: Case,
    positions: Float[np.ndarray, " position"],
    period: float,
    spacing: float,
    places: Float[np.ndarray, " place"] = NO_PLACES,
) -> InputInfluence:
    """Influence of commands held over a period (s) on a case, with rows for positions (m).

    Velocities are those at `places` (m). The controller of the case, if any, is left out. Times are
    at most `spacing` (s) apart; the starts of all holds and the end of the run are among them.

    Raises ValueError if the response takes more than half of the memory that is free, RuntimeError
    if no time step meets TOLERANCE.
    """
    duration = float(case.run.duration)
    count = max(1, int(np.ceil(duration / period * (1 - 1e-12))))
    steps_per_hold = max(1, int(np.ceil(period / spacing * (1 - 1e-9))))
    hold_times = np.arange(count) * period
    times = np.append(np.arange(count * steps_per_hold) * (period / steps_per_hold), duration)
    times = times[(times < duration * (1 - 1e-9)) | (times == duration)]
    actuators = len(case.actuators)
    size, memory = 8.0 * times.size * case.beam.modes * count * actuators, free_memory()
    if size > memory / 2:
        raise ValueError(
            f"responses to {count} holds at {times.size} times take {size_text(size)}, more than"
            f" half of the {size_text(memory)} of memory that are free; hold commands for longer"
            f" than {period:g} s, or lower run.sample_rate"
        )
    uncontrolled_case = dataclasses.replace(case, controller=None)
    shapes = static_shapes(uncontrolled_case)
    step, *_ = choose_step_size(uncontrolled_case, shapes, TOLERANCE)
    schedule = controller_schedule(times, Transmission(hold_times, hold_times), [], np.zeros(0))
    substeps = steps_per_interval(np.diff(times).max(), step)
    # Runs with hold -1 (the unforced one) or a hold after the end (padding) have no command; of
    # these the padding is disturbed by the profile alone, as all runs with a command are.
    hold_index = np.append([-1, count], np.repeat(np.arange(count), actuators))
    actuator_index = np.append([0, 0], np.tile(np.arange(actuators), count))
    run_bytes = 8.0 * COPIES * times.size * substeps * 2 * case.beam.modes
    allowed = max(1, int(block_memory() / run_bytes))
    batch_size = min(MAX_BATCH_SIZE, hold_index.size, allowed)
    padding = -hold_index.size % batch_size
    hold_index, actuator_index = (
        np.append(hold_index, np.full(padding, count)),
        np.append(actuator_index, np.zeros(padding, int)),
    )
    outputs = np.concatenate(
        [
            _unit_responses(uncontrolled_case, shapes, schedule, substeps, places, *indices)
            for indices in zip(
                hold_index.reshape(-1, batch_size),
                actuator_index.reshape(-1, batch_size),
                strict=True,
            )
        ],
        axis=-1,
    )
    response = outputs[..., 2 : count * actuators + 2]
    if load_set(case).profile is not None:
        response = response - outputs[..., 1:2]
    response = response.reshape(*response.shape[:2], count, actuators)
    unforced, modes, holds = outputs[..., 0], case.beam.modes, np.searchsorted(times, hold_times)
    return InputInfluence(
        _deflection_rows(uncontrolled_case, shapes, positions),
        hold_times,
        times,
        unforced[:, :modes],
        response[:, :modes],
        unforced[holds, modes:],
        response[holds, modes:],
    )


@compiled_if_traced
def _deflection_rows(case: Case, shapes: StaticShapes, positions):
    return modal_model(case, shapes.layout).shapes(positions, (0,))[0]


@compiled_if_traced
def _unit_responses(
    case: Case,
    shapes: StaticShapes,
    schedule: EventSchedule,
    substeps: int,
    places,
    hold_index,
    actuator_index,
):
    """Modal coordinates, then velocities at places (time, ..., batch).

    Under the weights for hold -1, else under a unit command.
    """
    model, case_loads = modal_model(case, shapes.layout), load_set(case, shapes.layout)
    size = (case_loads.wheel_count, hold_index.shape[0])
    wheels = jax.tree.map(
        lambda part: xp.broadcast_to(part, (*part.shape[:-1], size[1])), case_loads.wheels
    )
    is_loaded = hold_index == -1
    histories = {
        wheel: dataclasses.replace(
            history,
            amplitudes=xp.where(is_loaded, history.amplitudes, 0.0),
            forces=xp.where(is_loaded, history.forces, 0.0),
        )
        for wheel, history in wheels.histories.items()
    }
    weight = xp.where(is_loaded, wheels.weight, 0.0)
    wheels = dataclasses.replace(wheels, weight=weight, histories=histories)
    loads = dataclasses.replace(case_loads, wheels=wheels)
    policy = _UnitCommands(
        schedule=schedule,
        hold_index=hold_index,
        actuator_index=actuator_index,
        load_amplitude=np.inf,
        actuators=len(case.actuators),
    )
    grid = grid_by_schedule(case, model, schedule, substeps)
    steps = grid.counts.shape[0] * substeps
    discrete = discrete_model(model, grid, None, policy)
    _, states, *_ = integrate_history(
        discrete, loads, max_loads=shapes.max_loads, steps=steps, policy=policy
    )
    sample_steps = substeps * grid.event_panels[schedule.sample_events]
    modal = states[sample_steps][:, : 2 * case.beam.modes]
    velocities = xp.einsum("pm,tmb->tpb", model.shapes(places, (0,))[0], modal[:, 1::2])
    return xp.concatenate([modal[:, ::2], velocities], axis=1)


# Tolerances and the penalty are relative to the largest deflection without commands.
LP_TOLERANCE = 1e-9  # feasibility tolerance of the solver
VIOLATION_TOLERANCE = 1e-7  # rows violated by less are not added
ACTIVITY_PENALTY = 1e-6  # on a change of a command, or its mean absolute value, of its scale
FIRST_ROWS = 0.5  # deflection without commands above which rows are in the first round
MAX_ROUNDS = 100  # of adding rows; about five are usual
HIGHS_METHODS = ("highs", "highs-ipm")  # the simplex method fails on some programs
SOLVED, INFEASIBLE = 0, 2  # status of linprog


def least_peak(
    influence: InputInfluence,
    low: Float[np.ndarray, " actuator"],
    high: Float[np.ndarray, " actuator"],
    max_change: Float[np.ndarray, " actuator"],
) -> tuple[float, Float[np.ndarray, "hold actuator"], Float[np.ndarray, "time position"]]:
    """Least peak (m), commands that attain it to 1e-5, and multipliers of the deflections.

    Commands stay between `low` and `high` and change by at most `max_change` from hold to hold,
    starting from zero.

    Raises ValueError if no commands meet the limits, RuntimeError if the solver fails.
    """
    program = _LinearProgram(influence, low, high, max_change)
    commands = program.attaining_commands()
    # With a part of the rows the optimum is at most the least peak: a bound in any case.
    peak, _, multipliers = program.solve(0.0)
    return peak * program.deflection_scale, commands, multipliers


def attaining_commands(
    influence: InputInfluence,
    low: Float[np.ndarray, " actuator"],
    high: Float[np.ndarray, " actuator"],
    max_change: Float[np.ndarray, " actuator"],
    others: tuple[Any, Float[np.ndarray, " row"]],
) -> Float[np.ndarray, "hold actuator"]:
    """Commands whose peak is the least to 1e-5, under further constraints.

    Limits are those of `least_peak`; `others` are a matrix (row, command) and a right side, matrix
    @ commands <= right side, with the commands hold by hold.

    Raises ValueError if no commands meet the constraints, RuntimeError if the solver fails.
    """
    return _LinearProgram(influence, low, high, max_change, others).attaining_commands()


class _LinearProgram:
    """Linear program in scaled unknowns, with the rows added so far."""

    def __init__(self, influence, low, high, max_change, others=None):
        self.influence = influence
        self.shape = influence.response.shape[2:]
        self.deflection_scale = np.max(np.abs(influence.unforced @ influence.deflection_rows.T))
        self.command_scale = _command_scales(influence, low, high, self.deflection_scale)
        self.low, self.high, self.max_change = (
            part / self.command_scale for part in (low, high, max_change)
        )
        matrix, self.others_right = (np.zeros((0, self.shape[0] * self.shape[1])), np.zeros(0))
        if others is not None:
            matrix, self.others_right = others
        self.others = scipy.sparse.csr_array(matrix) * np.tile(self.command_scale, self.shape[0])
        # Rows so far: time index, position index, sign of the deflection.
        self.generated_rows = np.zeros((3, 0), int)

    def attaining_commands(self) -> Float[np.ndarray, "hold actuator"]:
        """Commands that attain the least peak to 1e-5.

        Raises RuntimeError if rows are added without end, and as `solve`.
        """
        commands, peak = np.zeros(self.shape), FIRST_ROWS
        for _ in range(MAX_ROUNDS):
            if not self.add_violated_rows(commands, peak):
                break
            peak, commands, _ = self.solve(ACTIVITY_PENALTY)
        else:
            raise RuntimeError(
                f"the linear program of the bound has not converged in {MAX_ROUNDS} rounds"
            )
        # The solver meets limits to its tolerance; the commands meet them exactly.
        low, high, most = (
            part * self.command_scale for part in (self.low, self.high, self.max_change)
        )
        changes = np.clip(np.diff(commands, axis=0, prepend=0.0), -most, most)
        return np.clip(np.cumsum(changes, axis=0), low, high)

    def add_violated_rows(self, commands, peak) -> bool:
        """Add rows at local maxima along the beam where the deflection exceeds a peak.

        Returns whether there are any.
        """
        deflection = self.influence.deflection(commands) / self.deflection_scale
        size = np.abs(deflection)
        padded = np.pad(size, ((0, 0), (1, 1)), constant_values=-1.0)
        local_maxima = (size >= padded[:, :-2]) & (size > padded[:, 2:])
        time_index, position_index = np.nonzero(local_maxima & (size > peak + VIOLATION_TOLERANCE))
        new_rows = np.stack(
            [
                time_index,
                position_index,
                np.sign(deflection[time_index, position_index]).astype(int),
            ]
        )
        self.generated_rows = np.concatenate([self.generated_rows, new_rows], axis=1)
        return time_index.size > 0

    def solve(self, activity_penalty: float):
        """Scaled peak, commands and multipliers that minimise the peak plus activity penalties.

        Raises ValueError if no commands meet the limits, RuntimeError if the solver fails.
        """
        holds, actuators = self.shape
        count = holds * actuators
        penalties = [0.0, activity_penalty, activity_penalty / holds, 1.0]
        cost = np.repeat(penalties, [count, count + actuators, count, 1])
        matrix, right_side = self._constraints()
        options = {
            "primal_feasibility_tolerance": LP_TOLERANCE,
            "dual_feasibility_tolerance": LP_TOLERANCE,
        }
        bounds = self._bounds()
        for method in HIGHS_METHODS:
            solution = scipy.optimize.linprog(
                cost, matrix, right_side, bounds=bounds, method=method, options=options
            )
            if solution.status in (SOLVED, INFEASIBLE):
                break
        if solution.status == INFEASIBLE:
            raise ValueError(
                "no commands, starting from zero, meet limits and rates of the actuators"
            )
        if solution.status != SOLVED:
            raise RuntimeError(f"the linear program of the bound failed: {solution.message}")
        multipliers = np.zeros((self.influence.times.size, self.influence.deflection_rows.shape[0]))
        when, where, sign = self.generated_rows
        row_multipliers = solution.ineqlin.marginals[right_side.size - sign.size :]
        np.add.at(multipliers, (when, where), -sign * row_multipliers)
        return (
            solution.x[-1],
            solution.x[:count].reshape(self.shape) * self.command_scale,
            multipliers,
        )

    def _constraints(self):
        """Rows for changes and absolute values of commands, then for deflections; right side."""
        sp = scipy.sparse
        holds, actuators = self.shape
        # Commands start from zero; the penalty on changes includes the return to zero at the end.
        difference = sp.eye(holds + 1, holds) - sp.eye(holds + 1, holds, k=-1)
        difference, identity = sp.kron(difference, sp.eye(actuators)), sp.eye(holds * actuators)
        change = sp.eye(difference.shape[0])
        when, where, sign = self.generated_rows
        rows = self.influence.deflection_rows[where] * sign[:, None] / self.deflection_scale
        response = (
            np.einsum("im,imka->ika", rows, self.influence.response[when]) * self.command_scale
        )
        unforced = np.sum(rows * self.influence.unforced[when], axis=1)
        peak_rows = sp.csr_array(response.reshape(sign.size, holds * actuators))
        blocks = [
            [difference, -change, None, None],
            [-difference, -change, None, None],
            [identity, None, -identity, None],
            [-identity, None, -identity, None],
            [self.others, None, None, np.zeros((self.others_right.size, 1))],
            [peak_rows, None, None, -np.ones((sign.size, 1))],
        ]
        matrix = sp.block_array(blocks).tocsr()
        zeros = np.zeros(matrix.shape[0] - sign.size - self.others_right.size)
        return matrix, np.concatenate([zeros, self.others_right, -unforced])

    def _bounds(self):
        holds, actuators = self.shape
        unlimited = np.full(actuators, np.inf), np.full(holds * actuators, np.inf), [np.inf]
        high = np.concatenate(
            [np.tile(self.high, holds), np.tile(self.max_change, holds), *unlimited]
        )
        low = np.zeros(high.size)
        low[: holds * actuators] = np.tile(self.low, holds)
        return np.stack([low, high], axis=1)


def _command_scales(influence, low, high, deflection_scale):
    """Scale of each command: its larger limit, or that which deflects the beam as the loads do."""
    largest_rows = np.abs(influence.deflection_rows).max(axis=0)
    deflection_per_command = largest_rows @ np.abs(influence.response).max(axis=(0, 2))
    scales = np.where(
        deflection_per_command > 0,
        deflection_scale / np.where(deflection_per_command > 0, deflection_per_command, 1.0),
        1.0,
    )
    largest = np.maximum(np.abs(low), np.abs(high))
    return np.where(np.isfinite(largest) & (largest > 0), largest, scales)


DEFAULT_PERIOD = 0.01  # s, over which commands are held without a sampled controller


class ActiveConstraints(NamedTuple):
    """Active constraints of the linear program: positions (m), times (s) and their multipliers.

    The `weights`, multipliers with the sign of the deflection, have absolute values of sum 1. They
    are a certificate of the bound: for any commands within the limits the weighted sum of the
    deflections is at least the bound, and the largest absolute deflection at least that sum.
    """

    positions: Float[np.ndarray, " constraint"]
    times: Float[np.ndarray, " constraint"]
    weights: Float[np.ndarray, " constraint"]


class Bound(Module):
    """Least achievable peak deflection of a case, and commands that attain it.

    `peak` (m) is the largest absolute deflection at the `positions` (m) and at times at most
    `spacing` (s) apart; that between these times may be slightly larger. `uncontrolled` (m) is the
    peak without commands. `commands` start at `times` (s) and are held over `period` (s); they
    attain the peak to 1e-5, with small and smooth commands among those that do; those of springs,
    not among the `driven` actuators, are without effect.
    """

    peak: float
    uncontrolled: float
    positions: Float[np.ndarray, " position"]
    times: Float[np.ndarray, " hold"]
    commands: Float[np.ndarray, "hold actuator"]
    period: float
    spacing: float
    active_constraints: ActiveConstraints
    driven: tuple[int, ...]

    def __repr__(self) -> str:
        return f"Bound: {self.verdict}"

    @property
    def reduction(self) -> float:
        """Attainable reduction as a fraction of the uncontrolled peak, 0 to 1."""
        return 1 - self.peak / self.uncontrolled

    @property
    def verdict(self) -> str:
        """Peaks without control and with the best commands, in one sentence."""
        return (
            f"no control: peak {self.uncontrolled:.6g} m; no controller that holds its commands"
            f" for {self.period:g} s gets below {self.peak:.6g} m, {self.reduction:.1%} less"
        )

    def share(self, record: Record) -> float:
        """Fraction of the attainable reduction that a run achieves: 0 without control, 1 at best.

        Negative for a peak above the uncontrolled one, NaN for a run that diverges. The peak of the
        run is that at the positions of the bound, over its samples if these are not the sensors.
        """
        sensors = np.array([float(sensor.position) for sensor in record.case.sensors])
        if np.array_equal(sensors, self.positions):
            peak = np.max(np.asarray(record.peak_deflection))
        else:
            peak = np.max(np.abs(np.asarray(record.at(self.positions))))
        attainable = self.uncontrolled - self.peak
        return float((self.uncontrolled - peak) / attainable) if attainable > 0 else np.nan

    def controller(self) -> Prescribed:
        """Open-loop controller with the commands of those actuators that take any."""
        end = self.times[-1] + self.period
        commands = self.commands[:, np.array(self.driven, int)]
        values = np.concatenate([commands, commands[-1:]]).T
        offsets = np.zeros(len(self.driven))
        table = {"times": np.append(self.times, end), "values": values}
        return Prescribed(offsets=offsets, period=self.period, **table)


@refuses_traced("a bound")
def bound(
    case: Case,
    positions: ArrayLike | None = None,
    period: float | None = None,
    spacing: float | None = None,
) -> Bound:
    """Least peak deflection over all commands within the limits, and commands that attain it.

    The peak is that at the sensors, or at given `positions` (m from the left end), many for the
    whole beam. Commands are held over `period` (s), by default that of the case's controller, or
    0.01 s, within the limits and rates of the actuators, if any; resolution, delay, and the
    controller of the case have no influence. The deflection is evaluated every `spacing` (s), by
    default at the run's sample rate, and at changes of the commands.

    Raises ValueError for an invalid case, one without loads, without positions or without actuators
    that take commands, for a period or spacing that is not positive, for limits that the rates
    cannot reach from zero, and under `jit` or differentiation (there are no derivatives);
    RuntimeError if the linear program fails.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(
    ...         length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03
    ...     ),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 1.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ... )
    >>> best = jb.bound(case, period=0.02)
    >>> print(f"{best.reduction:.0%} of the peak, at most")
    24% of the peak, at most
    """
    least = _bound_without_baseline(case, positions, period, spacing)
    return dataclasses.replace(least, uncontrolled=_uncontrolled_peak(case, least.positions))


@refuses_traced("a bound")
def least_achievable_peak(case: Case, positions: ArrayLike | None, period: float) -> float:
    """Peak (m) of `bound`, without the run for the uncontrolled peak. Raises as `bound`."""
    return _bound_without_baseline(case, positions, period, None).peak


def _bound_without_baseline(case: Case, positions, period, spacing) -> Bound:
    """Bound of a case, with NaN for the uncontrolled peak."""
    influence, positions, period, spacing = checked_influence(case, positions, period, spacing)
    peak, commands, weights = least_peak(influence, *held_command_limits(case, period))
    when, where = np.nonzero(weights)
    return Bound(
        peak=float(peak),
        uncontrolled=np.nan,
        positions=positions,
        times=influence.hold_times,
        commands=commands,
        period=period,
        spacing=spacing,
        active_constraints=ActiveConstraints(
            positions[where], influence.times[when], weights[when, where]
        ),
        driven=commanded(case.actuators),
    )


def no_bound(case: Case) -> str:
    """Why a case has no bound, in a clause; empty if none of its actuators is the reason."""
    if limited := limited_loops(case.actuators):
        return (
            f"actuators.{limited[0]}.limits bound the voltage within its inner loop, and a bound is"
            " that of a linear plant"
        )
    return ""


def checked_influence(
    case: Case,
    positions: ArrayLike | None,
    period: float | None,
    spacing: float | None,
    places: Float[np.ndarray, " place"] = NO_PLACES,
) -> tuple[InputInfluence, Float[np.ndarray, " position"], float, float]:
    """Influence of held commands, positions (m), period and spacing (s), with the defaults filled.

    Velocities are those at `places` (m). Raises ValueError as `bound`.
    """
    check_is_case(case)
    if obstacle := no_bound(case):
        raise ValueError(f"{obstacle}: leave them out")
    check_case(case)
    own_period = None if case.controller is None else case.controller.period
    period = (
        float(DEFAULT_PERIOD if own_period is None else own_period)
        if period is None
        else float(concrete(period, "period"))
    )
    spacing = float(concrete(1 / case.run.sample_rate if spacing is None else spacing, "spacing"))
    positions = _checked_positions(case, positions)
    if not case.actuators:
        raise ValueError("a bound needs actuators, and the case has none; add one")
    if not any(actuator.accepts_commands for actuator in case.actuators):
        raise ValueError(
            f"actuators: none of the {len(case.actuators)} takes commands; add one that does"
        )
    if not (np.isfinite([period, spacing]).all() and min(period, spacing) > 0):
        raise ValueError(f"period and spacing must be positive; they are {period:g}, {spacing:g} s")
    if period > float(case.run.duration):
        raise ValueError(f"period {period:g} s is longer than the run, {case.run.duration:g} s")
    if not case.loads:
        raise ValueError("a bound needs loads, and the case has none; add one")
    influence = input_influence(case, positions, period, spacing, places)
    if not np.any(influence.unforced @ influence.deflection_rows.T):
        raise ValueError("no load deflects the beam at these positions during the run")
    if not np.any(influence.response):
        raise ValueError(
            "no actuator deflects the beam at these positions; move one off supports and nodes"
        )
    return influence, positions, period, spacing


def _checked_positions(case: Case, positions) -> Float[np.ndarray, " position"]:
    if positions is None:
        positions = case.sensor_positions
    positions = np.asarray(real_numbers("positions", positions, "m", "positions")).ravel()
    if positions.size == 0:
        raise ValueError("a bound needs positions: add a sensor, or give positions (m)")
    for i, position in enumerate(positions):
        check_on_beam(f"positions.{i}", position, case.beam.length)
    return positions


def _uncontrolled_peak(case: Case, positions) -> float:
    """Largest absolute deflection (m) at the positions (m) without commands, in continuous time."""
    uncontrolled_case = dataclasses.replace(case, controller=None)
    shapes = static_shapes(uncontrolled_case)
    step, *_ = choose_step_size(uncontrolled_case, shapes, TOLERANCE)
    running_peaks = run_peaks(uncontrolled_case, shapes, np.asarray(step), positions)
    return float(np.max(running_peaks.refined_peak()[0]))


def held_command_limits(case: Case, period: float) -> tuple[Float[np.ndarray, " actuator"], ...]:
    """Lowest and highest command that acts, and its largest change from hold to hold."""
    low, high, rate = (np.asarray(part) for part in acting_ranges(case))
    return low, high, rate * period


@compiled_if_traced
def run_peaks(
    case: Case,
    shapes: StaticShapes,
    max_step: Float[Array, ""],
    positions: Float[Array, " sensor"],
) -> RunningPeaks:
    """Running peaks of an uncontrolled run at positions (m), in steps of at most `max_step` (s)."""
    model = modal_model(case, shapes.layout, shapes.coupled)
    grid = grid_by_step_length(case, model, max_step)
    discrete = discrete_model(model, grid, positions)
    return integrate_peaks(discrete, load_set(case, shapes.layout), max_loads=shapes.max_loads)[0]
