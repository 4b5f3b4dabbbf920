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
    count,
    is_known,
    known,
    number,
)
from jaxbeam.control.predictive.by_qpax import installed
from jaxbeam.control.predictive.prediction import (
    Prediction,
    Sampled,
    incremental,
    moves,
    predict,
    pulses,
    sample,
)
from jaxbeam.control.predictive.qp import METHODS, solve_qp
from jaxbeam.control.state_law import AbstractStateLaw
from jaxbeam.model.state_space import LoadedBeam
from jaxbeam.numerics.riccati import dare


class Design(eqx.Module):
    """What is designed before the first tick.

    `plant` and `prediction` are those of the unloaded plant. `model` is what the future is read
    from at each tick, with loads of no mass if they only weigh on it; None if it stays the same.
    Commands are within their limits and rates where rows @ variables <= top - side @ u(k-1).
    """

    plant: Sampled
    prediction: Prediction
    C: Float[Array, "output state"]
    steps: Float[Array, "horizon actuator variable"]
    rows: Float[Array, "row variable"]
    top: Float[Array, " row"]
    side: Float[Array, "row actuator"]
    tail: Float[Array, "both both"] | None
    model: LoadedBeam | None


class Memory(eqx.Module):
    """What is kept from tick to tick: the state, and how often no solution has been found."""

    design: Design
    state: Float[Array, " state"]
    failures: Float[Array, ""]


class MPC(AbstractStateLaw):
    """Model predictive control, eqs (7.1) to (7.30) of the thesis; it needs a period.

    Controlled are the deflections at `places`, at the sensors if left out, `horizon` periods
    ahead, by `moves` moves; with a `laguerre_pole` the moves go on through the horizon and are
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
    def memoryless(self) -> bool:
        return False

    def fault(self, case):
        outputs = len(case.sensors) if self.places is None else self.places.shape[0]
        sizes = {
            "move_weight": ((), (len(case.actuators),)),
            "output_weight": ((), (outputs,)),
            "horizon_weight": ((self.horizon,),),
            "soft_limit": ((), (outputs,)),
        }
        if self.period is None:
            return "period must be given: predictive control acts at samples"
        late = None if self.delay is None else self.delay - self.period
        if late is not None and is_known(late) and known(late) >= 0:
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
        if pole is not None and is_known(pole) and known(pole) >= 1:
            return f"laguerre_pole must be below 1, not {known(pole):g}"
        if self.solver == "qpax" and not installed():
            return "solver must be another: qpax is not installed (pip install 'qpax>=0.1.4')"
        if self.loads == "known" and not case.loads:
            return "loads must be 'ignored' where there are none"
        if self.terminal == "riccati" and outputs > len(case.actuators):
            return (
                f"terminal must be 'none': {len(case.actuators)} actuators cannot bring"
                f" {outputs} deflections to zero, so that the cost after the horizon is infinite"
            )
        return super().fault(case)

    def failures(self, memory):
        return memory[0].failures

    def prepare(self, model, designed):
        actuators = model.case.actuators
        plant = self._sampled(designed.unloaded, 0)
        steps = moves(pulses(self.horizon, self.moves, self.laguerre_pole), len(actuators))
        C = self._outputs(designed, plant.A.shape[0])
        # Of plain moves those after the last are none: the limits hold there too.
        free = self.horizon if self.laguerre_pole is not None else self.moves
        design = Design(
            plant,
            predict(_repeated(plant, self.horizon), C, steps, jnp.zeros(0)),
            C,
            steps,
            *_bounds(actuators, steps[:free], self.period),
            self._tail(plant, C),
            self._read_from(designed),
        )
        return Memory(design, jnp.zeros(plant.A.shape[0]), jnp.zeros(()))

    def command(self, memory, estimate, measurement, t):
        design, before = memory.design, measurement.command
        state = estimate.state
        if self.delay is not None:
            state = jnp.concatenate([state, before])
        past, prediction, weights = self._seen_from(design, t, estimate)
        explained = past.A @ memory.state + past.B @ before + past.E @ weights
        known = jnp.concatenate([state, state - explained, before, jnp.ones(1)])
        move, solved = self._move(design, prediction, known, before)
        command = before + jnp.where(solved, move, 0.0)
        return command, Memory(design, state, memory.failures + ~solved)

    def _outputs(self, designed, states):
        """Rows that take the states to the deflections that are controlled."""
        places = self.places
        if places is None:
            places = designed.case.sensor_places
        shape = designed.rig.shapes(places, (0,))[0] / designed.scale
        return jnp.zeros((shape.shape[0], states)).at[:, : shape.shape[1]].set(shape)

    def _sampled(self, system, loads) -> Sampled:
        B, B_f = jnp.split(system.B, [system.B.shape[1] - loads], axis=1)
        return sample(system.A, B, B_f, self.period, self.delay)

    def _read_from(self, designed) -> LoadedBeam | None:
        """The model from which the future is read at each tick, if it changes."""
        if self.prediction == "time-varying":
            return designed
        if self.loads == "ignored":
            return None
        return eqx.tree_at(lambda m: m.traffic.inertia, designed, replace_fn=jnp.zeros_like)

    def _seen_from(self, design, t, estimate):
        """The plant over the last period, the prediction, and the weights of the loads in it."""
        if design.model is None:
            return design.plant, design.prediction, jnp.zeros(0)
        weights = design.model.weights
        if self.loads == "ignored":
            weights = jnp.zeros_like(weights)
        elif estimate.weights is not None:
            weights = estimate.weights
        middles = t + (jnp.arange(-1, self.horizon) + 0.5) * self.period
        frozen = jax.vmap(lambda time: self._sampled(design.model.at(time), weights.shape[0]))
        plants = frozen(middles)
        past, future = (jax.tree.map(lambda p, s=s: p[s], plants) for s in (0, slice(1, None)))
        return past, predict(future, design.C, design.steps, weights), weights

    def _weights(self, outputs):
        """Weights (horizon, output) of squared deflections."""
        ahead = jnp.ones(self.horizon) if self.horizon_weight is None else self.horizon_weight
        each = jnp.ones(outputs) if self.output_weight is None else self.output_weight
        return ahead[:, None] * jnp.broadcast_to(each, (outputs,))

    def _tail(self, plant, C):
        """P of the cost after the horizon, of the incremental model with the regulator's law."""
        if self.terminal == "none":
            return None
        A, B, seen = incremental(plant.A, plant.B, C)
        Q = seen.T @ (self._weights(C.shape[0])[-1, :, None] * seen)
        return dare(A, B, Q, jnp.diag(jnp.broadcast_to(self.move_weight, B.shape[1])))

    def program(self, design: Design, prediction: Prediction, known, before):
        """The quadratic program of a tick: H, f, M and gamma of `solve_qp`.

        `known` is what the free response follows from, the state, its change that the model does
        not explain, the command `before`, and 1.
        """
        free = prediction.F @ known
        weight, Phi, steps = self._weights(free.shape[1]), prediction.Phi, design.steps
        if design.tail is not None:
            weight = weight.at[-1].set(0.0)  # P has it
        price = jnp.broadcast_to(self.move_weight, before.shape)
        effort = jnp.einsum("hav,a,haw->vw", steps, price, steps)
        H = jnp.einsum("hov,ho,how->vw", Phi, weight, Phi) + effort
        f = jnp.einsum("hov,ho,ho->v", Phi, weight, free)
        if design.tail is not None:
            pull = prediction.end_phi.T @ design.tail
            H, f = H + pull @ prediction.end_phi, f + pull @ (prediction.end @ known)
        H, f = 2 * H, 2 * f
        M, gamma = design.rows, design.top - design.side @ before
        if self.solver == "unconstrained":
            return H, f, M[:0], gamma[:0]
        if self.soft_limit is not None:
            return self._softened(H, f, M, gamma, Phi, free)
        return H, f, M, gamma

    def _move(self, design, prediction, known, before):
        """The first move, and whether there is one that solves the problem."""
        H, f, M, gamma = self.program(design, prediction, known, before)
        steps = design.steps
        if M.shape[0] == 0:
            return steps[0] @ -jnp.linalg.solve(H, f), jnp.ones((), bool)
        found = solve_qp(H, f, M, gamma, self.solver)
        return steps[0] @ found.x[: steps.shape[2]], found.solved

    def _softened(self, H, f, M, gamma, Phi, free):
        """The problem with an excess over the soft limit for each output as further variables."""
        horizon, outputs, variables = Phi.shape
        H = jax.scipy.linalg.block_diag(H, 2 * self.soft_weight * jnp.eye(outputs))
        excess = jnp.tile(jnp.eye(outputs), (horizon, 1))
        rows, now = Phi.reshape(-1, variables), free.reshape(-1)
        limit = jnp.tile(jnp.broadcast_to(self.soft_limit, (outputs,)), horizon)
        M = jnp.block([[M, jnp.zeros((M.shape[0], outputs))], [rows, -excess], [-rows, -excess]])
        return H, jnp.pad(f, (0, outputs)), M, jnp.concatenate([gamma, limit - now, limit + now])


def _repeated(plant: Sampled, times: int) -> Sampled:
    return jax.tree.map(lambda part: jnp.broadcast_to(part, (times, *part.shape)), plant)


def _bounds(actuators, steps, period):
    """Limits and rates of the actuators as rows @ variables <= top - side @ u(k-1), eq. (7.28)."""
    count, variables = len(actuators), steps.shape[2]
    rows, tops, sides = [jnp.zeros((0, variables))], [jnp.zeros(0)], [jnp.zeros((0, count))]
    total = jnp.cumsum(steps, axis=0)
    for i, actuator in enumerate(actuators):
        limits, rate = actuator.command_limits(), actuator.command_rate()
        bounds = []
        if limits is not None:
            bounds += [(total[:, i], limits[1], 1.0), (-total[:, i], -limits[0], -1.0)]
        if rate is not None:
            bounds += [(sign * steps[:, i], rate * period, 0.0) for sign in (1.0, -1.0)]
        for row, top, sign in bounds:
            rows.append(row)
            tops.append(jnp.full(row.shape[0], top))
            sides.append(jnp.zeros((row.shape[0], count)).at[:, i].set(sign))
    return jnp.concatenate(rows), jnp.concatenate(tops), jnp.concatenate(sides)
