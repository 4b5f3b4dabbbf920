"""Model predictive control: at each tick the best moves to come within the limits, chapter 7.

    J = sum of weight |y|^2 over the horizon + sum of move_weight |du|^2 over the moves

with y the deflections at some places, eq. (7.6), subject to the actuators' limits and rates, eq.
(7.28). The first move is made, and all is asked anew at the next tick.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

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
from jaxbeam.control.predictive.by_qpax import is_installed
from jaxbeam.control.predictive.prediction import (
    Prediction,
    SampledPlant,
    incremental_model,
    move_basis,
    move_maps,
    predict,
    sampled_plant,
)
from jaxbeam.control.predictive.qp import METHODS, solve_qp
from jaxbeam.control.state_law import AbstractStateLaw
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.riccati import dare


class MPCDesign(eqx.Module):
    """What is designed before the first tick.

    `sampled_plant` and `prediction` are those of the unloaded plant. `plant` is what the future is read
    from at each tick, with loads of no mass if they only weigh on it; None if it stays the same.
    Commands are within their limits and rates where rows @ variables <= top - side @ u(k-1).
    """

    sampled_plant: SampledPlant
    prediction: Prediction
    C: Float[Array, "output state"]
    move_maps: Float[Array, "horizon actuator variable"]
    limit_rows: Float[Array, "row variable"]
    limits: Float[Array, " row"]
    limit_command_rows: Float[Array, "row actuator"]
    terminal_cost: Float[Array, "both both"] | None
    plant: Plant | None


class MPCState(eqx.Module):
    """What is kept from tick to tick: the state, and how often no solution has been found."""

    design: MPCDesign
    previous_state: Float[Array, " previous_state"]
    failures: Float[Array, ""]


class MPC(AbstractStateLaw):
    """Model predictive control, eqs (7.1) to (7.30) of the thesis; it needs a period.

    Controlled are the deflections at `places`, at the sensors if left out, `horizon` periods
    ahead, by `move_maps` moves; with a `laguerre_pole` the moves go on through the horizon and are
    made up of so many Laguerre functions. What the last period brought that the model does not
    explain is taken to go on: this is the incremental form (7.1), and rids the loop of an offset
    by constant loads. With loads "known" their weights are fed forward as they travel, those still
    to come included, and only the rest is taken so; a "time-varying" prediction has their masses
    too, an update of F and Phi at each tick. The delay is in the prediction.

    Each actuator's limits and rate are kept; a `soft_limit` on deflections is passed where it
    costs less, at `soft_weight` times the square of the excess. With the `terminal` cost "riccati"
    the regulator of the unloaded plant is taken to act after the horizon, eq. (7.31). `solver`
    says how the quadratic program is solved; "unconstrained" is the law (7.9), cut off by the
    actuators only. Where no solution is found the last command is held, and the record says so.
    """

    horizon: int = count("periods ahead that are predicted")
    moves: int = count("moves, or Laguerre functions, for each actuator")
    move_weight: Float[Array, " *actuator"] = number(
        "m^2/unit of a command^2", "weight of the square of each move, r_w", POSITIVE
    )
    output_weight: Float[Array, " *output"] | None = number(
        "1", "weight of the square of each deflection; 1 if left out", NOT_NEGATIVE, default=None
    )
    horizon_weight: Float[Array, " period"] | None = number(
        "1", "weight of each period ahead; 1 if left out", NOT_NEGATIVE, default=None
    )
    places: Float[Array, " place"] | None = number(
        "m", "where deflections are controlled", ON_BEAM, default=None
    )
    soft_limit: Float[Array, " *output"] | None = number(
        "m", "largest deflection wanted at each place", POSITIVE, default=None
    )
    soft_weight: Float[Array, ""] = number(
        "1", "weight of the square of what exceeds a soft limit", POSITIVE, default=1e4
    )
    loads: str = choice(
        "weights of the loads in the prediction", "ignored", "known", default="ignored"
    )
    prediction: str = choice(
        "plant in the prediction", "time-invariant", "time-varying", default="time-invariant"
    )
    laguerre_pole: Float[Array, ""] | None = number(
        "1", "pole of Laguerre functions, 0 to 1", NOT_NEGATIVE, default=None
    )
    terminal: str = choice("cost after the horizon", "none", "riccati", default="none")
    solver: str = choice("how moves are found", *METHODS, "unconstrained", default="interior")

    @property
    def stateless(self) -> bool:
        return False

    def validate(self, case):
        outputs = len(case.sensors) if self.places is None else self.places.shape[0]
        sizes = {
            "move_weight": ((), (len(case.actuators),)),
            "output_weight": ((), (outputs,)),
            "horizon_weight": ((self.horizon,),),
            "soft_limit": ((), (outputs,)),
        }
        if self.period is None:
            return "period must be given: predictive control acts at samples"
        excess_delay = None if self.delay is None else self.delay - self.period
        if excess_delay is not None and is_concrete(excess_delay) and concrete(excess_delay) >= 0:
            return "delay must be less than the period: no longer one is predicted"
        if self.moves > self.horizon:
            return f"moves must be at most the horizon, {self.horizon}, not {self.moves}"
        if outputs == 0:
            return "places must be given where there are no sensors"
        for name, allowed in sizes.items():
            value = getattr(self, name)
            if value is not None and value.shape not in allowed:
                what = " or ".join("one number" if not s else f"{s[0]} entries" for s in allowed)
                return f"{name} must have {what}, not {value.size}"
        pole = self.laguerre_pole
        if pole is not None and is_concrete(pole) and concrete(pole) >= 1:
            return f"laguerre_pole must be below 1, not {concrete(pole):g}"
        if self.solver == "qpax" and not is_installed():
            return "solver must be another: qpax is not installed (pip install 'qpax>=0.1.4')"
        if self.loads == "known" and not case.loads:
            return "loads must be 'ignored' where there are none"
        if self.terminal == "riccati" and outputs > len(case.actuators):
            return (
                f"terminal must be 'none': {len(case.actuators)} actuators cannot bring"
                f" {outputs} deflections to zero, so that the cost after the horizon is infinite"
            )
        return super().validate(case)

    def failures(self, memory):
        return memory[0].failures

    def prepare(self, plant, design_plant):
        actuators = plant.case.actuators
        sampled_plant = self._sampled_plant(design_plant.unloaded, 0)
        maps = move_maps(move_basis(self.horizon, self.moves, self.laguerre_pole), len(actuators))
        C = self._deflection_rows(design_plant, sampled_plant.A.shape[0])
        # Of plain moves those after the last are none: the limits hold there too.
        limited_periods = self.horizon if self.laguerre_pole is not None else self.moves
        design = MPCDesign(
            sampled_plant,
            predict(_repeat(sampled_plant, self.horizon), C, maps, jnp.zeros(0)),
            C,
            maps,
            *_command_limits(actuators, maps[:limited_periods], self.period),
            self._terminal_cost(sampled_plant, C),
            self._prediction_plant(design_plant),
        )
        return MPCState(design, jnp.zeros(sampled_plant.A.shape[0]), jnp.zeros(()))

    def command(self, memory, estimate, measurement, t):
        design, previous_command = memory.design, measurement.command
        state = estimate.state
        if self.delay is not None:
            state = jnp.concatenate([state, previous_command])
        past_plant, prediction, weights = self._predict(design, t, estimate)
        predicted_state = (
            past_plant.A @ memory.state + past_plant.B @ previous_command + past_plant.E @ weights
        )
        current_state = jnp.concatenate(
            [state, state - predicted_state, previous_command, jnp.ones(1)]
        )
        move, solved = self._first_move(design, prediction, current_state, previous_command)
        command = previous_command + jnp.where(solved, move, 0.0)
        return command, MPCState(design, state, memory.failures + ~solved)

    def _deflection_rows(self, design_plant, state_count):
        """Rows that take the states to the deflections that are controlled."""
        places = self.places
        if places is None:
            places = design_plant.case.sensor_positions
        shape = design_plant.modal_model.shapes(places, (0,))[0] / design_plant.scale
        return jnp.zeros((shape.shape[0], state_count)).at[:, : shape.shape[1]].set(shape)

    def _sampled_plant(self, system, load_count) -> SampledPlant:
        B, B_f = jnp.split(system.B, [system.B.shape[1] - load_count], axis=1)
        return sampled_plant(system.A, B, B_f, self.period, self.delay)

    def _prediction_plant(self, design_plant) -> Plant | None:
        """The model from which the future is read at each tick, if it changes."""
        if self.prediction == "time-varying":
            return design_plant
        if self.loads == "ignored":
            return None
        return eqx.tree_at(lambda m: m.loads.inertia, design_plant, replace_fn=jnp.zeros_like)

    def _predict(self, design, t, estimate):
        """The plant over the last period, the prediction, and the weights of the loads in it."""
        if design.model is None:
            return design.plant, design.prediction, jnp.zeros(0)
        weights = design.model.weights
        if self.loads == "ignored":
            weights = jnp.zeros_like(weights)
        elif estimate.weights is not None:
            weights = estimate.weights
        midpoints = t + (jnp.arange(-1, self.horizon) + 0.5) * self.period
        sample_frozen = jax.vmap(
            lambda time: self._sampled_plant(design.model.at(time), weights.shape[0])
        )
        plants = sample_frozen(midpoints)
        past, future = (jax.tree.map(lambda p, s=s: p[s], plants) for s in (0, slice(1, None)))
        return past, predict(future, design.C, design.steps, weights), weights

    def _output_weights(self, output_count):
        """Weights (horizon, output) of squared deflections."""
        period_weights = (
            jnp.ones(self.horizon) if self.horizon_weight is None else self.horizon_weight
        )
        output_weights = (
            jnp.ones(output_count) if self.output_weight is None else self.output_weight
        )
        return period_weights[:, None] * jnp.broadcast_to(output_weights, (output_count,))

    def _terminal_cost(self, sampled_plant, C):
        """P of the cost after the horizon, of the incremental model with the regulator's law."""
        if self.terminal == "none":
            return None
        A, B, output_rows = incremental_model(sampled_plant.A, sampled_plant.B, C)
        Q = output_rows.T @ (self._output_weights(C.shape[0])[-1, :, None] * output_rows)
        return dare(A, B, Q, jnp.diag(jnp.broadcast_to(self.move_weight, B.shape[1])))

    def quadratic_program(
        self, design: MPCDesign, prediction: Prediction, current_state, previous_command
    ):
        """The quadratic program of a tick: H, f, M and gamma of `solve_qp`.

        `current_state` is what the free response follows from, the state, its change that the model does
        not explain, the command `previous_command`, and 1.
        """
        free_response = prediction.F @ current_state
        weight, Phi, move_maps = (
            self._output_weights(free_response.shape[1]),
            prediction.Phi,
            design.move_maps,
        )
        if design.terminal_cost is not None:
            weight = weight.at[-1].set(0.0)  # P has it
        move_weights = jnp.broadcast_to(self.move_weight, previous_command.shape)
        move_cost = jnp.einsum("hav,a,haw->vw", move_maps, move_weights, move_maps)
        H = jnp.einsum("hov,ho,how->vw", Phi, weight, Phi) + move_cost
        f = jnp.einsum("hov,ho,ho->v", Phi, weight, free_response)
        if design.terminal_cost is not None:
            terminal_gradient = prediction.terminal_phi.T @ design.terminal_cost
            H, f = (
                H + terminal_gradient @ prediction.terminal_phi,
                f + terminal_gradient @ (prediction.terminal @ current_state),
            )
        H, f = 2 * H, 2 * f
        M, gamma = design.limit_rows, design.limits - design.limit_command_rows @ previous_command
        if self.solver == "unconstrained":
            return H, f, M[:0], gamma[:0]
        if self.soft_limit is not None:
            return self._with_soft_limits(H, f, M, gamma, Phi, free_response)
        return H, f, M, gamma

    def _first_move(self, design, prediction, current_state, previous_command):
        """The first move, and whether there is one that solves the problem."""
        H, f, M, gamma = self.quadratic_program(design, prediction, current_state, previous_command)
        move_maps = design.steps
        if M.shape[0] == 0:
            return move_maps[0] @ -jnp.linalg.solve(H, f), jnp.ones((), bool)
        found = solve_qp(H, f, M, gamma, self.solver)
        return move_maps[0] @ found.x[: move_maps.shape[2]], found.solved

    def _with_soft_limits(self, H, f, M, gamma, Phi, free_response):
        """The problem with an excess over the soft limit for each output as further variables."""
        horizon, outputs, variables = Phi.shape
        H = jax.scipy.linalg.block_diag(H, 2 * self.soft_weight * jnp.eye(outputs))
        excess = jnp.tile(jnp.eye(outputs), (horizon, 1))
        rows, free_deflections = Phi.reshape(-1, variables), free_response.reshape(-1)
        limit = jnp.tile(jnp.broadcast_to(self.soft_limit, (outputs,)), horizon)
        M = jnp.block([[M, jnp.zeros((M.shape[0], outputs))], [rows, -excess], [-rows, -excess]])
        return (
            H,
            jnp.pad(f, (0, outputs)),
            M,
            jnp.concatenate([gamma, limit - free_deflections, limit + free_deflections]),
        )


def _repeat(plant: SampledPlant, times: int) -> SampledPlant:
    return jax.tree.map(lambda part: jnp.broadcast_to(part, (times, *part.shape)), plant)


def _command_limits(actuators, move_maps, period):
    """Limits and rates of the actuators as rows @ variables <= top - side @ u(k-1), eq. (7.28)."""
    count, variables = len(actuators), move_maps.shape[2]
    rows, limit_values, command_rows = (
        [jnp.zeros((0, variables))],
        [jnp.zeros(0)],
        [jnp.zeros((0, count))],
    )
    cumulative_moves = jnp.cumsum(move_maps, axis=0)
    for i, actuator in enumerate(actuators):
        limits, rate = actuator.command_limits(), actuator.command_rate_limit()
        bounds = []
        if limits is not None:
            bounds += [
                (cumulative_moves[:, i], limits[1], 1.0),
                (-cumulative_moves[:, i], -limits[0], -1.0),
            ]
        if rate is not None:
            bounds += [(sign * move_maps[:, i], rate * period, 0.0) for sign in (1.0, -1.0)]
        for row, top, sign in bounds:
            rows.append(row)
            limit_values.append(jnp.full(row.shape[0], top))
            command_rows.append(jnp.zeros((row.shape[0], count)).at[:, i].set(sign))
    return jnp.concatenate(rows), jnp.concatenate(limit_values), jnp.concatenate(command_rows)
