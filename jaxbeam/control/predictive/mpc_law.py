"""Law of model predictive control: the quadratic program of a sample from its prediction."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.case.estimator import Estimate
from jaxbeam.control.predictive.prediction import (
    Prediction,
    Preview,
    SampledPlant,
    Terminal,
    predict,
)
from jaxbeam.control.state_controller import AbstractStateLaw
from jaxbeam.estimation.sampled_plant import in_blocks
from jaxbeam.numerics.qp import QuadraticProgram, first_move
from jaxbeam.runtime.arrays import Array, add_at, set_at, take, xp


class CommandLimits(NamedTuple):
    """Limits and rate limits of commands: rows @ variables <= limits - command_rows @ u(k-1)."""

    rows: Float[Array, "row variable"]
    limits: Float[Array, " row"]
    command_rows: Float[Array, "row actuator"]


QuadraticCost = tuple[Float[Array, "variable variable"], Float[Array, " variable"]]


class MPCLaw(AbstractStateLaw):
    """Predictive law of a design plant; its state is the state of the plant at the last sample.

    `sampled_plant` and `prediction` are those of the unloaded plant; with a `preview` both are
    computed at each sample, with the loads on their way, without their weights if not
    `known_weights`; or a `table` has both for all samples, the predictions with the load inputs as
    the last initial conditions. The states are those of the beam, then those of the vehicles of the
    preview, and with a delay the last commands. `output_weights` are those of squared deflections
    in each period, `move_weights` those of squared moves.
    """

    sampled_plant: SampledPlant
    prediction: Prediction
    C: Float[Array, "output state"]
    move_maps: Float[Array, "horizon actuator variable"]
    limits: CommandLimits
    output_weights: Float[Array, "horizon output"]
    move_weights: Float[Array, " actuator"]
    soft_limit: Float[Array, " *output"] | None
    soft_weight: Float[Array, ""]
    hard_limit: Float[Array, " *output"] | None
    terminal: Terminal | None
    preview: Preview | None
    delayed: bool = eqx.field(static=True)
    known_weights: bool = eqx.field(static=True)
    solver: str = eqx.field(static=True)
    table: tuple[SampledPlant, Prediction] | None = None

    @property
    def vehicle_states(self) -> int:
        """Number of states of vehicles in the prediction."""
        return 0 if self.preview is None else self.preview.plant.vehicle_states

    @property
    def needs_vehicles(self):
        return self.vehicle_states > 0

    def initial_state(self):
        return xp.zeros(self.C.shape[1])

    def step(self, state, estimate, measurement, t):
        command = measurement.command
        prediction, initial, state = self.conditions(state, estimate, command, t)
        program = self.quadratic_program(prediction, initial, command)
        move, solved = first_move(program, self.move_maps, self.solver)
        return ControlStep(command + xp.where(solved, move, 0.0), state, solved)

    def conditions(
        self, previous_state, estimate: Estimate, previous_command, t
    ) -> tuple[Prediction, Float[Array, " initial"], Float[Array, " state"]]:
        """Prediction from a sample at t (s), its initial conditions, and the state at the sample.

        `previous_state` and `previous_command` are those of the last sample.
        """
        state = estimate.state
        if self.vehicle_states:
            state = xp.concatenate([state, estimate.vehicles])
        if self.delayed:
            state = xp.concatenate([state, previous_command])
        past_plant, prediction, weights = self._predict(t, estimate)
        predicted_state = (
            past_plant.A @ previous_state + past_plant.B @ previous_command + past_plant.E @ weights
        )
        initial = xp.concatenate([state, state - predicted_state, previous_command, xp.ones(1)])
        return prediction, initial, state

    def _predict(self, t, estimate):
        """Sampled plant of the last period, prediction from t (s), and the load inputs in both.

        These are the weights of the loads, and 1 for profile and forces over time.
        """
        if self.preview is None:
            return self.sampled_plant, self.prediction, xp.zeros(0)
        plant = self.preview.plant
        weights = plant.augmented_start[plant.vehicle_states :]
        if not self.known_weights:
            weights = xp.zeros_like(weights)
        elif estimate.weights is not None:
            constant = weights[estimate.weights.shape[0] :]
            weights = xp.concatenate([estimate.weights, constant])
        if self.table is not None:
            sample = self.preview.sample_at(t)
            past, prediction = jax.tree.map(lambda part: take(part, sample), self.table)
            return past, prediction.under(weights), weights
        plants = self.preview.sampled_plants(t, -1, self.move_maps.shape[0] + 1)
        past, future = (jax.tree.map(lambda p, s=s: p[s], plants) for s in (0, slice(1, None)))
        return past, predict(future, self.C, self.move_maps, weights), weights

    def tabulated(self, times):
        preview, horizon = self.preview, self.move_maps.shape[0]
        if preview is None:
            return self
        inputs = preview.plant.augmented_start.shape[0] - self.vehicle_states

        def block(first, number):
            plants = preview.sampled_plants(first * preview.period, -1, number + horizon)
            periods = 1 + np.arange(horizon)[:, None] + np.arange(number)
            past, future = (
                jax.tree.map(lambda part, index=index: part[index], plants)
                for index in (slice(number), periods)
            )
            return past, predict(future, self.C, self.move_maps, xp.eye(inputs))

        return dataclasses.replace(self, table=in_blocks(block, len(times)))

    def quadratic_program(self, prediction: Prediction, initial, previous_command):
        """Quadratic program of a sample, in the moves and in the excesses over soft limits.

        Excesses over soft limits of deflections come first, then that over a soft terminal set.
        `initial` are the initial conditions of `Prediction`: the state, its unexplained change, the
        previous command u(k-1), and 1.
        """
        H, f = self.merit(prediction, initial)
        program = self.of_moves(H, f, previous_command)
        if self.solver == "unconstrained":
            return program._replace(M=program.M[:0], gamma=program.gamma[:0])
        return self.limited(program, prediction, initial)

    def merit(self, prediction: Prediction, initial) -> QuadraticCost:
        """H and f of the cost of the moves, x'H x + 2 f'x."""
        free_response, weight, Phi = prediction.F @ initial, self.output_weights, prediction.Phi
        if self.terminal is not None:
            weight = set_at(weight, -1, 0.0)  # included in P
        weighted = (weight[..., None] * Phi).reshape(-1, Phi.shape[2])
        H = weighted.T @ Phi.reshape(-1, Phi.shape[2]) + self.move_cost()
        f = weighted.T @ free_response.reshape(-1)
        if self.terminal is not None:
            end_phi = self.terminal.map @ prediction.end_phi
            end = self.terminal.map @ (prediction.end @ initial)
            H = H + end_phi.T @ self.terminal.cost @ end_phi
            f = f + end_phi.T @ (self.terminal.cost @ end)
        return H, f

    def move_cost(self) -> Float[Array, "variable variable"]:
        """H of the cost of the squared moves alone."""
        maps = self.move_maps
        weighted = (self.move_weights[:, None] * maps).reshape(-1, maps.shape[2])
        return weighted.T @ maps.reshape(-1, maps.shape[2])

    def of_moves(self, H, f, previous_command) -> QuadraticProgram:
        """Quadratic program of a cost x'H x + 2 f'x of the moves, within limits of the commands."""
        gamma = self.limits.limits - self.limits.command_rows @ previous_command
        return QuadraticProgram(2 * H, 2 * f, self.limits.rows, gamma)

    def limited(
        self, program: QuadraticProgram, prediction: Prediction, initial, factor: float = 1.0
    ) -> QuadraticProgram:
        """The program with limits of predicted deflections; costs of excesses times a `factor`."""
        free_response, Phi = prediction.F @ initial, prediction.Phi
        if self.hard_limit is not None:
            program = program.within(*rows_within(Phi, free_response, self.hard_limit))
        rows, sides, weight = None, None, None
        if self.terminal is not None and self.terminal.rows.shape[0]:
            terminal = self.terminal
            rows = terminal.rows @ (terminal.map @ prediction.end_phi)
            sides = 1 - terminal.rows @ (terminal.map @ (prediction.end @ initial))
            weight = terminal.weight
            if weight is None:
                program = program.within(rows, sides)
        if self.soft_limit is not None:
            horizon, outputs, _ = Phi.shape
            excess = xp.tile(xp.eye(outputs), (2 * horizon, 1))
            costs = xp.full(outputs, factor * self.soft_weight)
            soft_rows = rows_within(Phi, free_response, self.soft_limit)
            program = program.softly_within(*soft_rows, excess, costs)
        if rows is not None and weight is not None:
            cost = factor * weight
            program = program.softly_within(rows, sides, xp.ones((rows.shape[0], 1)), cost[None])
            # The linear cost is one of the initial condition 1, of which the program is linear.
            program = program._replace(f=add_at(program.f, -1, cost * initial[-1]))
            last = program.f.shape[0] - 1
            program = program.within(-xp.eye(1, last + 1, k=last), xp.zeros(1))
        return program


def rows_within(Phi, free_response, limit):
    """Rows and right sides of |Phi variables + free response| <= limit, of each output."""
    horizon, outputs, variables = Phi.shape
    rows, free_deflections = Phi.reshape(-1, variables), free_response.reshape(-1)
    limit = xp.tile(xp.broadcast_to(limit, (outputs,)), horizon)
    sides = xp.concatenate([limit - free_deflections, limit + free_deflections])
    return xp.concatenate([rows, -rows]), sides


def output_weights(
    horizon: int, outputs: int, horizon_weight, output_weight
) -> Float[Array, "horizon output"]:
    """Weights of squared deflections in each period; weights that are None are 1."""
    period_weights = xp.ones(horizon) if horizon_weight is None else horizon_weight
    factors = xp.ones(outputs) if output_weight is None else output_weight
    return period_weights[:, None] * xp.broadcast_to(factors, (outputs,))


def command_limits(actuators, maps: Float[Array, "period actuator variable"], period):
    """Limits and rate limits of actuators over the periods of some move maps, eq. (7.28)."""
    count, variables = len(actuators), maps.shape[2]
    rows, limit_values = [xp.zeros((0, variables))], [xp.zeros(0)]
    command_rows, cumulative_moves = [xp.zeros((0, count))], xp.cumsum(maps, axis=0)
    for i, actuator in enumerate(actuators):
        limits, rate = actuator.command_limits(), actuator.command_rate_limit()
        bounds = []
        if limits is not None:
            bounds += [
                (cumulative_moves[:, i], limits[1], 1.0),
                (-cumulative_moves[:, i], -limits[0], -1.0),
            ]
        if rate is not None:
            bounds += [(sign * maps[:, i], rate * period, 0.0) for sign in (1.0, -1.0)]
        for row, top, sign in bounds:
            rows.append(row)
            limit_values.append(xp.full(row.shape[0], top))
            command_rows.append(set_at(xp.zeros((row.shape[0], count)), np.s_[:, i], sign))
    parts = (xp.concatenate(part) for part in (rows, limit_values, command_rows))
    return CommandLimits(*parts)
