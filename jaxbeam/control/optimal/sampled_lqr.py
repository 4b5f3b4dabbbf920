"""The linear-quadratic regulator of a plant whose commands are held from sample to sample."""

import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from jaxbeam.case.fields import NOT_NEGATIVE, is_known, known, number
from jaxbeam.control.optimal.lqr import AbstractRegulator
from jaxbeam.estimation.sampled_plant import ticks, whole_and_sum
from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.intervals import Commands, Inputs, Square, symmetric
from jaxbeam.numerics.riccati import dlqr

# With the command before among the states.
Both = Float[Array, "both both"]
Pushes = Float[Array, "both input"]


class DiscreteLQR(AbstractRegulator):
    """The time-invariant regulator for the rig without loads, designed as it acts: sampled.

    It minimises the same integral as `LQR`, over commands that are held for a `period` and begin a
    `delay` after the sample: the weights say the same at every period, what happens between the
    samples counts, and the gain becomes that of `LQR` as the period shrinks. `input_rate_weight`
    adds the changes of the command, as rates over a period. With it or a delay, the command last
    given, as the actuators took it, is fed back too.
    """

    input_rate_weight: Float[Array, " actuator"] | None = number(
        "s^2/unit of a command^2",
        "weight of the rate of change of each command",
        NOT_NEGATIVE,
        default=None,
    )

    @property
    def knows_loads(self) -> bool:
        return self.estimator is not None

    @property
    def remembers(self) -> bool:
        """Whether the command last given is among the states."""
        return self.delay is not None or self.input_rate_weight is not None

    def gains(self, model):
        plant, clock = model.unloaded, ticks(self)
        Q, R = self.weights(model)
        A, B, Q, R, N = sampled_problem(plant.A, plant.B, Q, R, clock.period, clock.late)
        if self.input_rate_weight is not None:
            toll = jnp.diag(self.input_rate_weight) / clock.period
            states, commands = plant.B.shape
            Q = Q.at[states:, states:].add(toll)
            N = N.at[states:].add(-toll)
            R = R + toll
        if not self.remembers:
            states = plant.A.shape[0]
            A, B, Q, N = A[:states, :states], B[:states], Q[:states, :states], N[:states]
        return dlqr(A, B, Q, R, N)[0]

    def prepare(self, model, designed):
        gain = self.gains(designed)
        last = jnp.ones(gain.shape[1] - self.shares.shape[0])
        return gain * jnp.concatenate([self.shares, last])

    def command(self, memory, estimate, measurement, t):
        last = [measurement.command] if self.remembers else []
        return -memory @ jnp.concatenate([estimate.state, *last]), memory

    def fault(self, case):
        if self.period is None:
            return "period must be given: kind 'dlqr' designs for commands that are held so long"
        told = self.delay is not None and is_known(self.delay) and is_known(self.period)
        if told and known(self.delay) >= known(self.period):
            return "delay must be less than the period: one command may be under way, not more"
        rate = self.input_rate_weight
        if rate is not None and rate.shape[0] != len(case.actuators):
            return f"input_rate_weight must have {len(case.actuators)} entries, not {rate.shape[0]}"
        return super().fault(case)


def sampled_problem(
    A: Square,
    B: Inputs,
    Q: Square,
    R: Commands,
    period: Float[Array, ""],
    late: Float[Array, ""] | None = None,
) -> tuple[Both, Pushes, Both, Commands, Pushes]:
    """The discrete problem (A, B, Q, R, N) that costs what the integral of x'Qx + u'Ru does.

    Its states are x and the command before; its sum is of s'Qs + u'Ru + 2 s'Nu over those states s
    and commands u, which are held for a period (s) and begin `late` (s) after the sample. Exact
    (Van Loan, IEEE Trans. Automatic Control 23, 1978), differentiable.
    """
    states, commands = B.shape
    rate = jnp.pad(jnp.concatenate([A, B], axis=1), ((0, commands), (0, 0)))
    scale = jnp.concatenate([balance(A), jnp.ones(commands)])
    outer = scale * scale[:, None]
    toll = block_diag(Q, R)

    def over(span):
        """Propagator of x and a held command, and what they cost, over a span (s)."""
        matrix = rate * scale / scale[:, None] * span
        flow, cost = whole_and_sum(matrix.T, span * toll * outer)
        return flow.T * scale[:, None] / scale, cost / outer

    one, none = np.eye(commands), np.zeros((commands, commands))
    keep = np.concatenate([np.zeros((commands, states)), none, one], axis=1)
    start = jnp.eye(states + commands, states + 2 * commands)  # x and v, of (x, v, u)
    cost = jnp.zeros((states + 2 * commands,) * 2)
    if late is not None:
        flow, spent = over(late)
        cost = start.T @ spent @ start
        start = flow @ start
    flow, spent = over(period if late is None else period - late)
    begun = jnp.concatenate([start[:states], keep])
    cost = symmetric(cost + begun.T @ spent @ begun)
    after = jnp.concatenate([(flow @ begun)[:states], keep])
    held = states + commands
    return (
        after[:, :held],
        after[:, held:],
        cost[:held, :held],
        cost[held:, held:],
        cost[:held, held:],
    )
