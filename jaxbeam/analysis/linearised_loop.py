"""Linearised closed loop with frozen loads.

In continuous time z' = A z + B u, u = K z; with a sampling period z_(k+1) = A z_k + B u_k from
sample to sample, where z also holds the states of filters, estimators and laws and the queue of
delayed commands. The matrices are derivatives of the loop's dynamics, so every controller has
them. Limits, ranges and resolution are left out. Frozen loads keep position, speed and
acceleration; stationary ones rest at their positions.
"""

import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.frozen_loop import (
    PERIOD_TOLERANCE,
    LoopDynamics,
    LoopTiming,
    NotAffineError,
    affine_jacobian,
    apply,
    is_affine,
    loop_dynamics,
    random_argument,
)
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.controller import AbstractSampledLaw, ControlStep, Measurement
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check_case
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import Signal, StateSpace
from jaxbeam.runtime.arrays import (
    Array,
    Module,
    any_traced,
    ravel_pytree,
    scan,
    solve,
    stop_gradient,
    to_numpy,
    xp,
    zeros,
)
from jaxbeam.runtime.compiling import LOW_OPTIMISATION, compiled


class LinearLaw(AbstractSampledLaw):
    """Linear law of the deviations of an affine one: (commands, next state) = matrix @ inputs.

    Inputs are the state of the law, the readings y, the state x of the plant and the last commands
    u, one after the other; with a matrix for each time, columns of them (see `apply`).
    """

    matrix: Float[Array, "*time after before"]
    commands: int = eqx.field(static=True)

    def initial_state(self):
        return np.zeros(self.matrix.shape[-2] - self.commands)

    def step(self, state, measurement, t):
        measured = measurement.readings, measurement.state, measurement.command
        after = apply(self.matrix, xp.concatenate([state, *measured]))
        return ControlStep(after[: self.commands], after[self.commands :])


def linear_loop(loop: LoopDynamics, times: Float[np.ndarray, " time"]) -> LoopDynamics:
    """Linear loop of the deviations of a concrete, affine sampled loop, at several times (s).

    Raises NotAffineError for a law that is not affine, or that computes with JAX.
    """
    states, unpack = ravel_pytree(loop.law.initial_state())
    commands = len(loop.plant.case.actuators)
    plant_states = loop.plant.modal_model.state_count
    sizes = states.size, len(loop.plant.case.sensors), plant_states, commands
    ends = list(itertools.accumulate(sizes))
    nothing: Any = np.zeros(ends[-1])

    def step_at(t):
        def step(values):
            own, *measured = (values[slice(*both)] for both in itertools.pairwise([0, *ends]))
            command, after, _ = loop.law.step(unpack(own), Measurement(*measured), t)
            return xp.concatenate([command, ravel_pytree(after)[0]])

        return step

    argument, last = random_argument(ends[-1]), None
    matrices: list[Any] = []
    for t in times:
        step = step_at(t)
        value = step(argument)
        same = last is not None and (
            np.array_equal(value, last) or is_affine(step, matrices[-1], step(nothing))
        )
        matrices.append(matrices[-1] if same else affine_jacobian(step, nothing))
        last = value
    weight = loop.augmented_plant.loads.wheels.weight
    return eqx.tree_at(
        lambda x: (x.law, x.augmented_plant.loads.wheels.weight),
        loop,
        (LinearLaw(np.stack(matrices), commands), 0 * weight),
    )


def sampled_matrices(
    loop: LoopDynamics, timing: LoopTiming, times, transitions
) -> tuple[
    Float[np.ndarray, "time state state"],
    Float[np.ndarray, "time state actuator"],
    Float[np.ndarray, "time actuator state"],
]:
    """Matrices A, B and K of a `linear_loop` opened at the commands, over a period from each time.

    `transitions` are those of its plant.
    """
    start, unpack = loop.rest_state(timing)
    size, commands = len(start), loop.law.commands
    columns = np.tile(np.eye(size + commands), len(times))
    after, command = loop.sampling_step(
        timing, unpack(columns[:size]), times, transitions, columns[size:]
    )
    rows = [leaf.reshape(-1, columns.shape[1]) for leaf in (*jax.tree.leaves(after), command)]
    both: Any = np.concatenate(rows).reshape(size + commands, len(times), size + commands)
    both = np.moveaxis(both, 1, 0)
    return both[:, :size, :size], both[:, :size, size:], both[:, size:, :size]


NEWTON_ITERATIONS = 8  # towards the equilibrium about which the loop is linearised
NEWTON_ROUNDING = 1e-14  # relative change below which an iterate counts as the last
EIGENVALUE_OFFSET = 1e-10  # of the shift of inverse iteration from an eigenvalue, relative


class LinearisedLoop(Module):
    """Matrices of the loop at one time, opened at the commands; u = K z closes it.

    With a `period` (s) they are those of a sampled loop, else of a continuous one. The first
    `modal_states` states are modal coordinates and their rates (in continuous time in the order of
    `state_space`).
    """

    A: Float[Array, "state state"]
    B: Float[Array, "state actuator"]
    K: Float[Array, "actuator state"]
    period: float | None = eqx.field(static=True)
    modal_states: int = eqx.field(static=True)

    @property
    def closed_matrix(self) -> Float[Array, "state state"]:
        """State matrix A + B K of the closed loop."""
        return self.A + self.B @ self.K

    def to_control(self) -> Any:
        """A `control.StateSpace` of python-control: the loop opened at the commands.

        From the commands that act to those that the law returns, L(s) = K (s - A)^-1 B; with
        `control.feedback(loop, sign=1)` the loop is closed. Raises ImportError, saying what to
        install, if that package is missing.
        """
        return self._system(self.A).to_control()

    def closed_to_control(self) -> Any:
        """A `control.StateSpace` of python-control: the closed loop, with the same signals.

        From commands that are added to those of the law. Raises ImportError as `to_control`.
        """
        return self._system(self.closed_matrix).to_control()

    def _system(self, matrix) -> StateSpace:
        """System of a state matrix, from the commands to those of the law."""
        commands = tuple(Signal(f"command_{i}", "") for i in range(self.B.shape[1]))
        states = tuple(Signal(f"x_{i}", "") for i in range(self.A.shape[0]))
        returned = tuple(Signal(f"law_{i}", "") for i in range(self.B.shape[1]))
        D, period = xp.zeros((len(returned), len(commands))), self.period
        period = None if period is None else xp.asarray(period)
        signals = states, commands, returned
        return StateSpace(matrix, self.B, self.K, D, *signals, period)

    def growth_rate(self) -> Float[Array, ""]:
        """Largest real part of the poles in 1/s; differentiable to first order, on a CPU.

        The rightmost pole must be simple; others may coincide, as those of a delay do.
        """
        constant_matrix = stop_gradient(self.closed_matrix)
        values, vectors = xp.linalg.eig(constant_matrix)
        dominant = xp.argmax(values.real if self.period is None else xp.abs(values))
        value, right = values[dominant], vectors[:, dominant]
        # Left eigenvector by inverse iteration: multiple poles may have too few eigenvectors.
        shifted = constant_matrix.T - value * (1 + EIGENVALUE_OFFSET) * xp.eye(
            constant_matrix.shape[0]
        )
        left = xp.ones_like(right)
        for _ in range(2):
            left = solve(shifted, left / xp.linalg.norm(left))
        value = value + left @ ((self.closed_matrix - constant_matrix) @ right) / (left @ right)
        return value.real if self.period is None else xp.log(xp.abs(value)) / self.period

    def poles(self) -> np.ndarray:
        """Poles of the closed loop in 1/s, the largest real part first.

        Those of a sampled loop are log(z) / period, with frequencies up to half the sampling rate.
        """
        poles = np.linalg.eigvals(concrete(self.closed_matrix)).astype(complex)
        if self.period is not None:
            # Delays have z = 0, whose logarithm is minus infinity.
            tiny = np.finfo(float).tiny
            poles = np.log(np.where(poles == 0, tiny, poles)) / self.period
        return poles[np.argsort(-poles.real)]


def linearised_loop(case: Case, t: float) -> LinearisedLoop:
    """Linearised loop of a case with loads frozen at a time t (s), about the equilibrium there.

    Frozen loads keep position, speed and acceleration. Raises ValueError for an invalid case, one
    without a controller, or a sensor with a sampling period other than the controller's.
    """
    timing = loop_timing(case)
    return linearise(
        loop_dynamics(case, mesh_layout(concrete_case(case))), timing, xp.asarray(float(t))
    )


def loop_timing(case: Case) -> LoopTiming | None:
    """Sampling period and delays of the loop of a case; None in continuous time.

    Raises ValueError as `linearised_loop`.
    """
    check_case(case)
    controller = case.controller
    if controller is None:
        raise ValueError("there is no loop: the case has no controller")
    if controller.period is None:
        return None
    period = float(concrete(controller.period))
    for i, sensor in enumerate(case.sensors):
        sampling_period = sensor.sampling_period
        if (
            sampling_period is not None
            and abs(float(concrete(sampling_period)) - period) > PERIOD_TOLERANCE * period
        ):
            raise ValueError(
                f"sensors.{i}.sampling_period must be the controller's, {period:g} s, for the loop"
                f" to be periodic; it is {float(concrete(sampling_period)):g} s"
            )
    sensor_delays = tuple(
        0.0 if s.delay is None else float(concrete(s.delay)) for s in case.sensors
    )
    delay = 0.0 if controller.delay is None else float(concrete(controller.delay))
    return LoopTiming(period, delay, sensor_delays)


class _Derivatives(NamedTuple):
    """Change of a state (per s, or from sample to sample), and its Jacobians; see the module."""

    change: Float[Array, " state"]
    A: Float[Array, "state state"]
    B: Float[Array, "state actuator"]
    K: Float[Array, "actuator state"]


def linearise(loop: LoopDynamics, timing: LoopTiming | None, t) -> LinearisedLoop:
    """Linearised loop with loads frozen at t (s), about the equilibrium under their weights."""
    if any_traced(loop, t):
        return _linearise_compiled(_derivatives, loop, timing, t)
    try:
        return affine_linearisations(loop, timing, [t])[0]
    except NotAffineError:
        return _linearise(_derivatives_compiled, loop, timing, t)


def affine_linearisations(
    loop: LoopDynamics, timing: LoopTiming | None, times
) -> list[LinearisedLoop]:
    """Linear loops with loads frozen at times (s), for a concrete loop that is affine.

    Each holds about all states. Raises NotAffineError if the loop is not affine.
    """
    times, parts = np.asarray(times, float), []
    if timing is None:
        systems = loop.augmented_plant.at(times)
        for i, t in enumerate(times):
            system = jax.tree.map(lambda part, i=i: part[i], systems)
            A, B, _, command = loop.continuous_dynamics(t, system)
            parts.append((A, B, affine_jacobian(command, np.zeros(A.shape[0]))))
    else:
        linear = linear_loop(loop, times)
        plant = linear.plant_transitions(timing, times, weights=False)
        parts = zip(*sampled_matrices(linear, timing, times, plant), strict=True)
    period = None if timing is None else timing.period
    modal_states = 2 * loop.plant.coordinate_scale.shape[0]
    return [LinearisedLoop(A, B, K, period, modal_states) for A, B, K in parts]


def linearise_each(loop: LoopDynamics, timing: LoopTiming | None, times) -> list[LinearisedLoop]:
    """Linearised loops with loads frozen at each of some concrete times (s); see `linearise`."""
    try:
        return affine_linearisations(loop, timing, times)
    except NotAffineError:
        return [_linearise(_derivatives_compiled, loop, timing, t) for t in times]


def _derivatives(loop: LoopDynamics, timing: LoopTiming | None, t, state) -> _Derivatives:
    """Derivatives of the loop with loads frozen at t (s), at a state."""
    loop = loop.freeze_loads(t)
    if timing is None:
        A, B, weight_rates, command = loop.continuous_dynamics(t)
        K = jax.jacfwd(command)(state)
        return _Derivatives(A @ state + B @ command(state) + weight_rates, A, B, K)
    _, rebuild = loop.rest_state(timing)
    transitions = loop.plant_transitions(timing, t)

    def sampling_step(state, given):
        after, command = loop.sampling_step(timing, rebuild(state), t, transitions, given)
        after = ravel_pytree(after)[0]
        return (after, command), (after, command)

    command = sampling_step(state, None)[0][1]
    jacobian = jax.jacfwd(sampling_step, argnums=(0, 1), has_aux=True)
    ((A, B), (K, _)), (after, _) = jacobian(state, command)
    return _Derivatives(after - state, A, B, K)


# The program of one state is shorter than that of the search for the equilibrium.
_derivatives_compiled = compiled(_derivatives, **LOW_OPTIMISATION)


def _linearise(derivatives, loop: LoopDynamics, timing, t) -> LinearisedLoop:
    """Loop linearised about its equilibrium, which Newton's method finds by `derivatives`.

    Linearised about rest if it does not converge.
    """
    plant = loop.augmented_plant
    size = plant.modal_model.state_count + plant.vehicle_states
    if timing is None:
        start = zeros((size + loop.law.state_count,), like=loop)
    else:
        start = loop.rest_state(timing)[0]
    constant = 0.0 if timing is None else np.eye(start.shape[0])

    def newton_step(state):
        change, A, B, K = to_numpy(derivatives(loop, timing, t, state))
        return state + xp.linalg.lstsq(A + B @ K - constant, -change)[0]

    if any_traced(loop, t):
        state = scan(lambda x, _: (newton_step(x), None), start, length=NEWTON_ITERATIONS)[0]
    else:
        state = to_numpy(start)
        for _ in range(NEWTON_ITERATIONS):
            previous, state = state, newton_step(state)
            if np.max(np.abs(state - previous)) <= NEWTON_ROUNDING * np.max(np.abs(state)):
                break
    # Derivatives of the poles by the equilibrium, non-zero for a nonlinear law, are left out.
    state = stop_gradient(xp.where(xp.all(xp.isfinite(state)), state, start))
    _, A, B, K = to_numpy(derivatives(loop, timing, t, state))
    period = None if timing is None else timing.period
    return LinearisedLoop(A, B, K, period, 2 * loop.plant.coordinate_scale.shape[0])


_linearise_compiled = compiled(_linearise, **LOW_OPTIMISATION)
