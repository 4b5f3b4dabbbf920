"""Regulators for commands held between samples, and the controllability that sampling leaves.

A mode with poles a +- i omega is uncontrollable at periods k pi / omega: in each of them its phase
advances by a multiple of pi, so that all commands move its state along one line.
"""

import warnings

import equinox as eqx
import numpy as np
import scipy
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import ControlStep
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check_case
from jaxbeam.control.state_controller import AbstractStateLaw
from jaxbeam.model.state_space import Plant, StateSpace, state_space
from jaxbeam.numerics.matrices import InputMatrix, InputWeight, Square, symmetric_part
from jaxbeam.numerics.riccati import dlqr
from jaxbeam.numerics.stages import balance, exponential_and_gramian
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

    `limits` (actuator, 2) are those of the commands, within which e goes on; `fractions` are those
    of the states that are fed back.
    """

    gain: Float[Array, "actuator column"]
    fractions: Float[Array, " state"]
    reference: Float[Array, " output"]
    period: Float[Array, ""]
    limits: Float[Array, "actuator 2"]
    feeds_back_command: bool = eqx.field(static=True)

    def initial_state(self):
        return xp.zeros_like(self.reference)

    def step(self, state, estimate, measurement, t):
        last = measurement.command if self.feeds_back_command else xp.zeros(0)
        command = -self.gain @ xp.concatenate([self.fractions * estimate.state, last, state])
        within = xp.all((command >= self.limits[:, 0]) & (command <= self.limits[:, 1]))
        error = measurement.readings[: self.reference.shape[0]] - self.reference
        return ControlStep(command, state + xp.where(within, self.period, 0.0) * error)


MIN_REACHABILITY = 0.3  # of the controllability Gramian; below, there is a warning
UNCONTROLLABLE = 1e-9  # of the largest possible modal input; below, a mode is uncontrollable


class SamplingWarning(UserWarning):
    """Warning of a mode of the design that is hardly controllable at the sampling period."""


def sampling_limit(case: Case) -> Float[Array, " mode"]:
    """Sampling periods pi / omega (s) at which a mode is uncontrollable, slowest mode first.

    Eq. (5.6) of the thesis: omega is the imaginary part of a pole of the case without its loads,
    suspensions included; an overdamped mode has no limit and no entry. Controllability is lost at
    multiples of the limit too, and poor near it and in between. Not for use inside `jit`.

    Raises ValueError for an invalid case.

    >>> import jaxbeam as jb
    >>> from jaxbeam.control.sampled_lqr import sampling_limit
    >>> case = jb.Case(
    ...     jb.Beam(
    ...         length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03
    ...     ),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 1.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ... )
    >>> print(sampling_limit(case).round(4))
    [0.0245 0.0061 0.0027]
    """
    check_case(case)
    return xp.asarray(np.pi / _oscillatory_modes(state_space(case).unloaded)[0].imag)


def warn_slow_sampling(system: StateSpace, period: float, memory_time: float) -> None:
    """Warn (SamplingWarning) if a mode of a plant is hardly controllable at a period (s).

    `memory_time` (s) is as in `sampled_reachability`.
    """
    ratio, pole = sampled_reachability(system, period, memory_time)
    if ratio >= MIN_REACHABILITY:
        return
    warnings.warn(
        f"the mode at {pole / (2 * np.pi):.4g} Hz is hardly controllable at a period of"
        f" {period:.4g} s: its sampling limit is pi / omega = {np.pi / pole:.4g} s, and a fraction"
        f" {ratio:.2g} of its controllability is left; sample faster, or design for fewer modes",
        SamplingWarning,
        stacklevel=2,
    )


def sampled_reachability(
    system: StateSpace, period: float, memory_time: float
) -> tuple[float, float]:
    """Smallest ratio of sampled to continuous controllability of any mode, and omega of that mode.

    Controllability is the Gramian of a mode: the states that commands of unit energy attain, with
    forgetting over a `memory_time` (s), which keeps that of undamped modes finite. The ratio is the
    least over both directions of a mode, hence zero where sampling makes it uncontrollable; omega
    is in rad/s. Overdamped modes and uncontrollable ones are left out; without others the ratio is
    1 and omega 0. In modal coordinates both Gramians have a closed form.
    """
    poles, rows = _oscillatory_modes(system)
    modal_inputs = rows @ concrete(system.B)
    max_input = np.linalg.norm(rows, axis=1) * np.linalg.norm(concrete(system.B))
    controllable = np.linalg.norm(modal_inputs, axis=1) > UNCONTROLLABLE * max_input
    ratios = [
        _mode_reachability(*mode, period, memory_time)
        for mode in zip(poles[controllable], modal_inputs[controllable], strict=True)
    ]
    if not ratios:
        return 1.0, 0.0
    worst = int(np.argmin(ratios))
    return ratios[worst], float(poles[controllable][worst].imag)


def _mode_reachability(
    pole: complex, modal_input: np.ndarray, period: float, memory_time: float
) -> float:
    """Ratio of the Gramians of a mode and its conjugate, with the modal inputs l'B."""
    pole = pole - 0.5 / memory_time
    pair, modal_input = (
        np.array([pole, np.conj(pole)]),
        np.stack([modal_input, np.conj(modal_input)]),
    )
    sampled_input = modal_input * (np.expm1(pair * period) / pair)[:, None]
    sums = pair[:, None] + pair.conj()
    continuous_gramian = modal_input @ modal_input.conj().T / -sums
    sampled_gramian = sampled_input @ sampled_input.conj().T / -np.expm1(sums * period) / period
    return float(max(scipy.linalg.eigvalsh(sampled_gramian, continuous_gramian)[0], 0.0))


def _oscillatory_modes(system: StateSpace) -> tuple[np.ndarray, np.ndarray]:
    """Oscillating poles (1/s, those with positive imaginary part) and their left eigenvectors."""
    eigenpairs = scipy.linalg.eig(concrete(system.A), left=True, right=False)
    poles, left_vectors = eigenpairs[0], eigenpairs[1]
    oscillatory = np.flatnonzero(poles.imag > 1e-6 * np.abs(poles))
    oscillatory = oscillatory[np.argsort(poles[oscillatory].imag)]
    return poles[oscillatory], left_vectors[:, oscillatory].conj().T
