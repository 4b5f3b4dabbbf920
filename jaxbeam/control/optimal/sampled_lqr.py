"""The linear-quadratic regulator of a plant whose commands are held from sample to sample."""

import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Float

from jaxbeam.case.fields import NOT_NEGATIVE, concrete, is_concrete, number
from jaxbeam.control.optimal.lqr import AbstractRegulator
from jaxbeam.estimation.sampled_plant import exponential_and_gramian, sample_timing
from jaxbeam.numerics.discretisation import balance
from jaxbeam.numerics.intervals import InputMatrix, InputWeight, Square, symmetric_part
from jaxbeam.numerics.riccati import dlqr

# With the command before among the states.
AugmentedSquare = Float[Array, "both both"]
AugmentedInputs = Float[Array, "both input"]


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
    def design_depends_on_loads(self) -> bool:
        return self.estimator is not None

    @property
    def feeds_back_command(self) -> bool:
        """Whether the command last given is among the states."""
        return self.delay is not None or self.input_rate_weight is not None

    def gains(self, plant):
        system, timing = plant.unloaded, sample_timing(self)
        Q, R = self.weights(plant)
        A, B, Q, R, N = discrete_lq_problem(
            system.A, system.B, Q, R, timing.period, timing.input_delay
        )
        if self.input_rate_weight is not None:
            rate_cost = jnp.diag(self.input_rate_weight) / timing.period
            states, commands = system.B.shape
            Q = Q.at[states:, states:].add(rate_cost)
            N = N.at[states:].add(-rate_cost)
            R = R + rate_cost
        if not self.feeds_back_command:
            states = system.A.shape[0]
            A, B, Q, N = A[:states, :states], B[:states], Q[:states, :states], N[:states]
        return dlqr(A, B, Q, R, N)[0]

    def prepare(self, plant, design_plant):
        gain = self.gains(design_plant)
        command_shares = jnp.ones(gain.shape[1] - self.feedback_shares.shape[0])
        return gain * jnp.concatenate([self.feedback_shares, command_shares])

    def command(self, memory, estimate, measurement, t):
        previous_command = [measurement.command] if self.feeds_back_command else []
        return -memory @ jnp.concatenate([estimate.state, *previous_command]), memory

    def validate(self, case):
        if self.period is None:
            return "period must be given: kind 'dlqr' designs for commands that are held so long"
        concrete_delay = (
            self.delay is not None and is_concrete(self.delay) and is_concrete(self.period)
        )
        if concrete_delay and concrete(self.delay) >= concrete(self.period):
            return "delay must be less than the period: one command may be under way, not more"
        rate = self.input_rate_weight
        if rate is not None and rate.shape[0] != len(case.actuators):
            return f"input_rate_weight must have {len(case.actuators)} entries, not {rate.shape[0]}"
        return super().validate(case)


def discrete_lq_problem(
    A: Square,
    B: InputMatrix,
    Q: Square,
    R: InputWeight,
    period: Float[Array, ""],
    input_delay: Float[Array, ""] | None = None,
) -> tuple[AugmentedSquare, AugmentedInputs, AugmentedSquare, InputWeight, AugmentedInputs]:
    """The discrete problem (A, B, Q, R, N) that costs what the integral of x'Qx + u'Ru does.

    Its states are x and the command before; its sum is of s'Qs + u'Ru + 2 s'Nu over those states s
    and commands u, which are held for a period (s) and begin `input_delay` (s) after the sample. Exact
    (Van Loan, IEEE Trans. Automatic Control 23, 1978), differentiable.
    """
    states, commands = B.shape
    augmented_matrix = jnp.pad(jnp.concatenate([A, B], axis=1), ((0, commands), (0, 0)))
    scale = jnp.concatenate([balance(A), jnp.ones(commands)])
    cost_scale = scale * scale[:, None]
    cost_rate = block_diag(Q, R)

    def propagator_and_cost(span):
        """Propagator of x and a held command, and what they cost, over a span (s)."""
        matrix = augmented_matrix * scale / scale[:, None] * span
        flow, cost = exponential_and_gramian(matrix.T, span * cost_rate * cost_scale)
        return flow.T * scale[:, None] / scale, cost / cost_scale

    one, none = np.eye(commands), np.zeros((commands, commands))
    command_rows = np.concatenate([np.zeros((commands, states)), none, one], axis=1)
    state_at_change = jnp.eye(states + commands, states + 2 * commands)  # x and v, of (x, v, u)
    cost = jnp.zeros((states + 2 * commands,) * 2)
    if input_delay is not None:
        propagator, interval_cost = propagator_and_cost(input_delay)
        cost = state_at_change.T @ interval_cost @ state_at_change
        state_at_change = propagator @ state_at_change
    propagator, interval_cost = propagator_and_cost(
        period if input_delay is None else period - input_delay
    )
    state_after_change = jnp.concatenate([state_at_change[:states], command_rows])
    cost = symmetric_part(cost + state_after_change.T @ interval_cost @ state_after_change)
    next_state = jnp.concatenate([(propagator @ state_after_change)[:states], command_rows])
    state_count = states + commands
    return (
        next_state[:, :state_count],
        next_state[:, state_count:],
        cost[:state_count, :state_count],
        cost[state_count:, state_count:],
        cost[:state_count, state_count:],
    )
