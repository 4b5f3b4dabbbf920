"""Regulators designed for commands that are held from sample to sample, with integral action."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import ControlStep
from jaxbeam.control.state_law import AbstractStateLaw
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.discretisation import balance, exponential_and_gramian
from jaxbeam.numerics.matrices import InputMatrix, InputWeight, Square, symmetric_part
from jaxbeam.numerics.riccati import dlqr
from jaxbeam.runtime.arrays import Array, add_at, block_diag, xp

# With the previous command among the states.
AugmentedSquare = Float[Array, "augmented augmented"]
AugmentedInputs = Float[Array, "augmented input"]


def sampled_gain(
    plant: Plant,
    Q: Square,
    R: InputWeight,
    period: Float[Array, ""],
    input_delay: Float[Array, ""] | None,
    rate_weight: Float[Array, " actuator"] | None,
    integral_weight: Float[Array, " output"] | None,
) -> Float[Array, "actuator column"]:
    """Gain designed for a plant without its loads, whose commands are held for a period (s).

    Its columns are those of the states; of the last command, with a delay or a weight of the rate
    of commands; and of the integrals of the errors of the first sensors, if these have weights.
    """
    system = plant.unloaded
    states = system.A.shape[0]
    A, B, Q, R, N = discrete_lq_problem(system.A, system.B, Q, R, period, input_delay)
    if rate_weight is not None:
        rate_cost = xp.diag(rate_weight) / period
        Q = add_at(Q, np.s_[states:, states:], rate_cost)
        N = add_at(N, np.s_[states:], -rate_cost)
        R = R + rate_cost
    if input_delay is None and rate_weight is None:
        A, B, Q, N = A[:states, :states], B[:states], Q[:states, :states], N[:states]
    if integral_weight is not None:
        outputs = integral_weight.shape[0]
        rows = xp.pad(system.C[:outputs], ((0, 0), (0, A.shape[0] - states)))
        A = xp.block([[A, xp.zeros((A.shape[0], outputs))], [period * rows, xp.eye(outputs)]])
        B, N = (xp.pad(part, ((0, outputs), (0, 0))) for part in (B, N))
        Q = block_diag(Q, period * xp.diag(integral_weight))
    return dlqr(A, B, Q, R, N)[0]


def discrete_lq_problem(
    A: Square,
    B: InputMatrix,
    Q: Square,
    R: InputWeight,
    period: Float[Array, ""],
    input_delay: Float[Array, ""] | None = None,
) -> tuple[AugmentedSquare, AugmentedInputs, AugmentedSquare, InputWeight, AugmentedInputs]:
    """Discrete problem (A, B, Q, R, N) with the cost of the integral of x'Qx + u'Ru.

    Its states s are x and the previous command; its cost is the sum of s'Qs + u'Ru + 2 s'Nu over
    the samples. Commands u are held for a period (s) and begin `input_delay` (s) after the sample.
    Exact (Van Loan, IEEE Trans. Automatic Control 23, 1978), differentiable.
    """
    states, commands = B.shape
    augmented_matrix = xp.pad(xp.concatenate([A, B], axis=1), ((0, commands), (0, 0)))
    scale = xp.concatenate([balance(A), xp.ones(commands)])
    cost_scale = scale * scale[:, None]
    cost_rate = block_diag(Q, R)

    def propagator_and_cost(span):
        """Propagator of x and a held command over a span (s), and its cost matrix."""
        matrix = augmented_matrix * scale / scale[:, None] * span
        transition, cost = exponential_and_gramian(matrix.T, span * cost_rate * cost_scale)
        return transition.T * scale[:, None] / scale, cost / cost_scale

    identity, zeros = np.eye(commands), np.zeros((commands, commands))
    command_rows = np.concatenate([np.zeros((commands, states)), zeros, identity], axis=1)
    state_at_change = xp.eye(states + commands, states + 2 * commands)  # x and v, of (x, v, u)
    cost = xp.zeros((states + 2 * commands,) * 2)
    if input_delay is not None:
        propagator, interval_cost = propagator_and_cost(input_delay)
        cost = state_at_change.T @ interval_cost @ state_at_change
        state_at_change = propagator @ state_at_change
    propagator, interval_cost = propagator_and_cost(
        period if input_delay is None else period - input_delay
    )
    state_after_change = xp.concatenate([state_at_change[:states], command_rows])
    cost = symmetric_part(cost + state_after_change.T @ interval_cost @ state_after_change)
    next_state = xp.concatenate([(propagator @ state_after_change)[:states], command_rows])
    state_count = states + commands
    return (
        next_state[:, :state_count],
        next_state[:, state_count:],
        cost[:state_count, :state_count],
        cost[state_count:, state_count:],
        cost[:state_count, state_count:],
    )


class IntegralLaw(AbstractStateLaw):
    """u = -K (x, last command, e) with the integrals e of the errors as the state of the law.

    `limits` (actuator, 2) are those of the commands, within which e goes on; `shares` those of the
    states that are fed back.
    """

    gain: Float[Array, "actuator column"]
    shares: Float[Array, " state"]
    reference: Float[Array, " output"]
    period: Float[Array, ""]
    limits: Float[Array, "actuator 2"]
    feeds_back_command: bool = eqx.field(static=True)

    def initial_state(self):
        return xp.zeros_like(self.reference)

    def step(self, state, estimate, measurement, t):
        last = measurement.command if self.feeds_back_command else xp.zeros(0)
        command = -self.gain @ xp.concatenate([self.shares * estimate.state, last, state])
        within = xp.all((command >= self.limits[:, 0]) & (command <= self.limits[:, 1]))
        error = measurement.readings[: self.reference.shape[0]] - self.reference
        return ControlStep(command, state + xp.where(within, self.period, 0.0) * error)
