"""Discrete linear-quadratic regulator: commands are held from sample to sample."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import NOT_NEGATIVE, concrete, is_concrete, number
from jaxbeam.control.optimal.lqr import AbstractRegulator
from jaxbeam.control.state_law import GainLaw
from jaxbeam.estimation.sampled_plant import sample_timing
from jaxbeam.model.state_space import Plant
from jaxbeam.numerics.discretisation import balance, exponential_and_gramian
from jaxbeam.numerics.matrices import InputMatrix, InputWeight, Square, symmetric_part
from jaxbeam.numerics.riccati import dlqr
from jaxbeam.runtime.arrays import Array, add_at, block_diag, xp

# With the previous command among the states.
AugmentedSquare = Float[Array, "augmented augmented"]
AugmentedInputs = Float[Array, "augmented input"]


class DiscreteLQR(AbstractRegulator):
    """Time-invariant regulator for the plant without loads, designed for held commands.

    It minimises the same integral as `LQR`, over commands that are held for a `period` and begin a
    `delay` after the sample: weights have the same meaning at every period, the cost includes the
    motion between samples, and the gain tends to that of `LQR` as the period shrinks.
    `input_rate_weight` adds the changes of the command, as rates over a period. With it or a delay,
    the last command, as limited by the actuators, is fed back too.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.DiscreteLQR(
    ...         state_weight=[1e7, 10.0], command_weight=[1e-3], period=0.005
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.537 mm
    """

    kind: ClassVar[str] = "dlqr"

    input_rate_weight: Float[Array, " actuator"] | None = number(
        "s^2/unit of a command^2",
        "weight of the rate of change of each command",
        NOT_NEGATIVE,
        default=None,
    )

    @property
    def feeds_back_command(self) -> bool:
        """Whether the last command is fed back too."""
        return self.delay is not None or self.input_rate_weight is not None

    def sampled_gain(self, plant: Plant) -> Float[Array, "actuator column"]:
        """Gain designed for a plant, for its states and, if it is fed back, the last command."""
        system, timing = plant.unloaded, sample_timing(self)
        Q, R = self.weights(plant)
        A, B, Q, R, N = discrete_lq_problem(
            system.A, system.B, Q, R, timing.period, timing.input_delay
        )
        if self.input_rate_weight is not None:
            rate_cost = xp.diag(self.input_rate_weight) / timing.period
            states, commands = system.B.shape
            Q = add_at(Q, np.s_[states:, states:], rate_cost)
            N = add_at(N, np.s_[states:], -rate_cost)
            R = R + rate_cost
        if not self.feeds_back_command:
            states = system.A.shape[0]
            A, B, Q, N = A[:states, :states], B[:states], Q[:states, :states], N[:states]
        return dlqr(A, B, Q, R, N)[0]

    def design_state_law(self, plant, design_plant):
        gain = self.sampled_gain(design_plant)
        command_shares = xp.ones(gain.shape[1] - self.feedback_shares.shape[0])
        shares = xp.concatenate([self.feedback_shares, command_shares])
        return GainLaw(gain * shares, self.feeds_back_command)

    def validate(self, case):
        if self.period is None:
            return "period must be given: kind 'dlqr' is designed for commands held that long"
        concrete_delay = (
            self.delay is not None and is_concrete(self.delay) and is_concrete(self.period)
        )
        if concrete_delay and concrete(self.delay) >= concrete(self.period):
            return "delay must be less than the period: the design allows for one pending command"
        rate = self.input_rate_weight
        if rate is not None and rate.shape[0] != len(case.driven):
            return f"input_rate_weight must have {len(case.driven)} entries, not {rate.shape[0]}"
        return super().validate(case)


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
