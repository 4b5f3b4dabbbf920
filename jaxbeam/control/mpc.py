"""Model predictive control, chapter 7 of the thesis: settings of a case file, and the law.

    J = sum of weight |y|^2 over the horizon + sum of move_weight |du|^2 over the moves

with y the deflections at some positions, eq. (7.6), subject to limits and rate limits of the
actuators, eq. (7.28). The first move is applied; the problem is solved again at the next sample.
"""

import dataclasses
import warnings
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import ControlStep, Estimate
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    choice,
    concrete,
    count,
    is_concrete,
    number,
)
from jaxbeam.control.estimation.sampled_plant import in_blocks
from jaxbeam.control.prediction import (
    Prediction,
    Preview,
    SampledPlant,
    Terminal,
    TerminalRegulator,
    dual_mode_terminal,
    incremental_terminal,
    limits_error,
    move_basis,
    move_maps,
    periods_needed,
    predict,
    preview,
    repeat_plant,
    sampled_plant,
    terminal_regulator,
    unseen_modes,
)
from jaxbeam.control.state_controller import (
    AbstractStateController,
    AbstractStateLaw,
    deflection_rows,
)
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.qp import METHODS, QuadraticProgram, first_move
from jaxbeam.runtime.arrays import Array, Number, add_at, set_at, take, xp
from jaxbeam.runtime.printer import counted


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


MAX_TERMINAL_WEIGHT = 3.0  # beyond it crossings were worse than without a terminal set, in trials


class TerminalSetWarning(UserWarning):
    """Warning of a terminal set that outweighs the deflections where loads put it out of reach."""


class MPC(AbstractStateController):
    """Model predictive control, eqs (7.1) to (7.30) of the thesis; it needs a period.

    Controlled are the deflections at `positions`, at the sensors if left out, `horizon` periods
    ahead, by `moves` moves; with a `laguerre_pole` the moves extend over the horizon and are
    combinations of as many Laguerre functions. The part of the last change of the state that the
    model does not explain is assumed to persist: this is the incremental form (7.1), which removes
    the steady deflection under constant loads. With loads "known" their weights are fed forward
    along their way, those of later loads included, and only the rest is assumed to persist; a
    "time-varying" prediction includes their masses too, with new F and Phi at each sample.
    Vehicles are predicted with their states: with loads "known" or a "time-varying" prediction the
    forces of their springs, which deflection and profile change, are those to come. The delay is
    part of the prediction.

    Limits and rate limits of each actuator are kept; a `soft_limit` on deflections is exceeded
    where that costs less, at `soft_weight` times the square of the excess. A `hard_limit` is kept
    in every predicted period; where no commands keep it there is no solution. `solver` is the
    method for the quadratic program; "unconstrained" is the law (7.9), clipped by the actuators
    only. Where no solution is found the last command is held, and the record counts a failure.

    With the `terminal` cost "riccati" the regulator of the unloaded plant is assumed to act after
    the horizon, eq. (7.31), under what persists of the loads. In "dual-mode", for any number of
    sensors, the loads have left by then: the regulator brings deflections and commands to zero, and
    the horizon ends in the set of states from which it keeps limits, rate limits and `hard_limit`
    for ever, by the limits of its next `terminal_periods` periods. Without loads the cost then
    decreases from sample to sample, and a problem that has a solution goes on having one. Under
    loads, which the regulator does not know, the set may be out of reach: with a `terminal_weight`
    w it is left where that costs less. An excess e over a limit, relative to it, costs w (e + e^2)
    times the least cost of a state from which the regulator meets a limit. With w up to 3 that has
    not raised peaks in trials; more lets the set outweigh the deflections, of which `simulate`
    warns, and a set without a weight fails where it is out of reach.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.MPC(horizon=4, moves=2, move_weight=1e-9, period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.090 mm
    """

    kind: ClassVar[str] = "mpc"

    horizon: int = count("periods of the prediction")
    moves: int = count("moves, or Laguerre functions, for each actuator")
    move_weight: Float[Number, " *actuator"] = number(
        "m^2/unit of a command^2", "weight of the square of each move, r_w", POSITIVE
    )
    output_weight: Float[Number, " *output"] | None = number(
        "1", "weight of the square of each deflection; 1 if left out", NOT_NEGATIVE, default=None
    )
    horizon_weight: Float[Number, " period"] | None = number(
        "1", "weight of each period of the prediction; 1 if left out", NOT_NEGATIVE, default=None
    )
    positions: Float[Number, " position"] | None = number(
        "m", "positions of the controlled deflections", ON_BEAM, default=None
    )
    soft_limit: Float[Number, " *output"] | None = number(
        "m", "soft limit of each deflection", POSITIVE, default=None
    )
    soft_weight: Float[Number, ""] = number(
        "1", "weight of the square of the excess over a soft limit", POSITIVE, default=1e4
    )
    hard_limit: Float[Number, " *output"] | None = number(
        "m", "limit of each deflection that predictions must keep", POSITIVE, default=None
    )
    loads: str = choice(
        "weights of the loads in the prediction", "ignored", "known", default="ignored"
    )
    prediction: str = choice(
        "plant in the prediction", "time-invariant", "time-varying", default="time-invariant"
    )
    laguerre_pole: Float[Number, ""] | None = number(
        "1", "pole of Laguerre functions, 0 to 1", NOT_NEGATIVE, default=None
    )
    terminal: str = choice(
        "cost, and set, after the horizon", "none", "riccati", "dual-mode", default="none"
    )
    terminal_periods: int = count("periods whose limits make up the terminal set", default=20)
    terminal_weight: Float[Number, ""] | None = number(
        "1", "weight of excesses over limits after the horizon, 1 say", POSITIVE, default=None
    )
    solver: str = choice(
        "method for the quadratic program", *METHODS, "unconstrained", default="interior"
    )

    @property
    def design_depends_on_loads(self) -> bool:
        predicted = self.loads == "known" or self.prediction == "time-varying"
        return predicted or super().design_depends_on_loads

    def validate(self, case):
        outputs = len(case.sensors) if self.positions is None else self.positions.shape[0]
        sizes = {
            "move_weight": ((), (len(case.driven),)),
            "output_weight": ((), (outputs,)),
            "horizon_weight": ((self.horizon,),),
            "soft_limit": ((), (outputs,)),
            "hard_limit": ((), (outputs,)),
        }
        if self.period is None:
            return "period must be given: predictive control acts at samples"
        excess_delay = None if self.delay is None else self.delay - self.period
        if excess_delay is not None and is_concrete(excess_delay) and concrete(excess_delay) >= 0:
            return (
                "delay must be less than the period: the prediction allows for one pending command"
            )
        if self.moves > self.horizon:
            return f"moves must be at most the horizon, {self.horizon}, not {self.moves}"
        if outputs == 0:
            return "positions must be given where there are no sensors"
        for name, allowed in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape not in allowed:
                allowed_sizes = " or ".join(
                    "one number" if not s else counted(s[0], "entry", "entries") for s in allowed
                )
                return f"{name} must have {allowed_sizes}, not {value.size}"
        pole = self.laguerre_pole
        if pole is not None and is_concrete(pole) and concrete(pole) >= 1:
            return f"laguerre_pole must be below 1, not {concrete(pole):g}"
        if self.loads == "known" and not case.loads:
            return "loads must be 'ignored' where there are none"
        if self.terminal == "riccati" and outputs > len(case.driven):
            return (
                f"terminal must be 'none' or 'dual-mode': {len(case.driven)} actuators cannot"
                f" bring {outputs} deflections under a load to zero, so that the cost after the"
                " horizon is infinite"
            )
        if self.terminal_weight is not None and self.terminal != "dual-mode":
            return "terminal_weight is that of a terminal set: leave it out, or take 'dual-mode'"
        if self.terminal == "dual-mode":
            error = self._dual_mode_error(case, outputs)
            if error is not None:
                return error
        return super().validate(case)

    def _dual_mode_error(self, case, outputs: int) -> str | None:
        """Error of settings that do not allow for a terminal set, or None."""
        if self.laguerre_pole is not None or self.moves != self.horizon:
            return (
                "moves must be as many as the horizon has periods, and plain, with terminal"
                " 'dual-mode': the regulator takes over after the last of them"
            )
        if outputs < len(case.driven):
            return (
                f"positions must be {len(case.driven)} or more with terminal 'dual-mode':"
                f" commands of so many actuators are not all seen in {outputs} deflections"
            )
        return limits_error(case.actuators)

    def design_error(self, design_plant):
        if self.terminal != "dual-mode" or self.solver == "unconstrained":
            return None
        regulator = self._regulator(*self._sampled(design_plant), design_plant.case.driven)
        unseen = unseen_modes(regulator, design_plant.case.beam.modes)
        if self.terminal_weight is not None and unseen.size:
            return (
                f"positions must show mode {unseen[0]} where there is a terminal_weight, and are"
                " nodes of it: add a position, or leave out terminal_weight"
            )
        needed = periods_needed(regulator, self.terminal_periods)
        if needed == self.terminal_periods:
            self._warn_of_set(design_plant.case.loads)
            return None
        if needed is None:
            return (
                "terminal must be 'none': no number of periods gives a terminal set, as the"
                " regulator brings the beam to rest too slowly"
            )
        return (
            f"terminal_periods must be at least {needed}: limits of fewer periods do not keep those"
            " of all later ones"
        )

    def _warn_of_set(self, loads) -> None:
        """Warn of a terminal set that loads may put out of reach, and that outweighs them then."""
        weight = np.inf if self.terminal_weight is None else concrete(self.terminal_weight)
        if not loads or weight <= MAX_TERMINAL_WEIGHT:
            return
        given = "left out" if self.terminal_weight is None else f"{weight:g}"
        warnings.warn(
            f"controller.terminal_weight is {given}: where loads put the terminal set out of reach,"
            " it outweighs the deflections, or there is no solution; take 1",
            TerminalSetWarning,
            stacklevel=2,
        )

    def design_state_law(self, plant, design_plant):
        actuators = plant.case.driven
        sampled, C, weights = self._sampled(design_plant)
        beam, loaded_plant = design_plant.modal_model.state_count, self._loaded_plant(design_plant)
        vehicles = 0 if loaded_plant is None else loaded_plant.vehicle_states
        basis = move_basis(self.horizon, self.moves, self.laguerre_pole)
        maps = move_maps(basis, len(actuators))
        terminal = None
        if self.terminal == "riccati":
            terminal = incremental_terminal(
                sampled, C, weights[-1], self._move_weights(len(actuators)), beam, vehicles
            )
        elif self.terminal == "dual-mode":
            regulator = self._regulator(sampled, C, weights, actuators)
            states = sampled.A.shape[0] + vehicles
            terminal = dual_mode_terminal(
                regulator, self.terminal_periods, self.terminal_weight, states
            )
        # After the last unit move commands stay, so that limits kept until then are kept.
        limited_periods = self.horizon if self.laguerre_pole is not None else self.moves
        return MPCLaw(
            sampled_plant=sampled,
            prediction=predict(repeat_plant(sampled, self.horizon), C, maps, xp.zeros(0)),
            C=_with_vehicles(C, beam, vehicles),
            move_maps=maps,
            limits=command_limits(actuators, maps[:limited_periods], self.period),
            output_weights=weights,
            move_weights=self._move_weights(len(actuators)),
            soft_limit=self.soft_limit,
            soft_weight=self.soft_weight,
            hard_limit=self.hard_limit,
            terminal=terminal,
            preview=loaded_plant and preview(loaded_plant, self.period, self.delay),
            delayed=self.delay is not None,
            known_weights=self.loads == "known",
            solver=self.solver,
        )

    def _sampled(self, design_plant: Plant):
        """Sampled unloaded plant, rows of its controlled deflections, and their weights."""
        system = design_plant.unloaded
        sampled = sampled_plant(
            system.A, system.B, xp.zeros((system.A.shape[0], 0)), self.period, self.delay
        )
        positions = design_plant.case.sensor_positions if self.positions is None else self.positions
        C = deflection_rows(design_plant, positions)
        C = xp.pad(C, ((0, 0), (0, sampled.A.shape[0] - C.shape[1])))  # the delay adds states
        weights = output_weights(self.horizon, C.shape[0], self.horizon_weight, self.output_weight)
        return sampled, C, weights

    def _regulator(self, sampled, C, weights, actuators) -> TerminalRegulator:
        """Regulator after the horizon of the unloaded plant."""
        move_weights = self._move_weights(len(actuators))
        parts = weights[-1], move_weights, actuators, self.period, self.hard_limit
        return terminal_regulator(sampled, self.delay is not None, C, *parts)

    def _move_weights(self, actuators: int) -> Float[Array, " actuator"]:
        """Weight of the moves of each actuator."""
        return xp.broadcast_to(self.move_weight, (actuators,))

    def _loaded_plant(self, design_plant: Plant) -> Plant | None:
        """Plant of predictions that vary with time, or None; its wheels may be massless."""
        if self.prediction == "time-varying":
            return design_plant
        if self.loads == "ignored":
            return None
        return eqx.tree_at(
            lambda m: m.loads.wheels.inertia,
            design_plant,
            replace_fn=lambda inertia: np.zeros(inertia.shape),
        )


def _with_vehicles(rows: Float[Array, "row state"], beam: int, count: int):
    """Rows with zeros for the states of vehicles after the `beam` ones."""
    zeros = xp.zeros((rows.shape[0], count))
    return xp.concatenate([rows[:, :beam], zeros, rows[:, beam:]], axis=1)
