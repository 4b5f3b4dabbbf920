"""Linearised closed loop with frozen loads.

In continuous time z' = A z + B u, u = K z; with a sampling period z_(k+1) = A z_k + B u_k from
sample to sample, where z also holds the states of filters, estimators and laws and the queue of
delayed commands. The matrices are derivatives of the loop's dynamics, so every controller has
them. Limits, ranges and resolution are left out. Frozen loads keep position, speed and
acceleration; stationary ones rest at their positions.

The gain of a filter that follows its loads varies as they cross. With loads at rest it tends to a
constant one, and the loop is then time-invariant. Estimates of weights have settled, too.
"""

import dataclasses
import itertools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.frozen_loop import (
    PERIOD_TOLERANCE,
    FrozenTrajectory,
    LoopDynamics,
    LoopTiming,
    NotAffineError,
    affine_jacobian,
    apply,
    frozen_loads,
    is_affine,
    loop_dynamics,
    random_argument,
)
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.controller import (
    AbstractSampledFilter,
    AbstractSampledLaw,
    ControlStep,
    LawOfCommanded,
    Measurement,
)
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.loads.base import MovingMass
from jaxbeam.case.trajectory import NEVER
from jaxbeam.case.validation import check_case
from jaxbeam.control.estimation.crossing_filter import CrossingFilter, FilterState, SampleModel
from jaxbeam.control.estimation.observer import sampled_kalman_gain
from jaxbeam.control.state_controller import SampledStateLaw
from jaxbeam.model.load_set import LoadSet, load_set
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import Signal, StateSpace, state_space
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


class SettledFilter(AbstractSampledFilter):
    """Filter of crossing loads, settled at t (s): a constant `gain`, the `model` of one sample."""

    filter: CrossingFilter
    model: SampleModel
    gain: Float[Array, "state sensor"]
    t: Float[Array, ""]

    def initial_state(self):
        start = self.filter.initial_state()
        return start.x, start.command

    def update(self, state, measurement, t):
        x, command = state
        no_covariance = xp.zeros((len(x), len(x)))
        predicted = self.filter.predict(
            FilterState(x, no_covariance, command), measurement.command, self.t, self.model
        )
        x = predicted.x + self.gain @ measurement.innovation(predicted.readings)
        return self.filter.estimate(x, self.t), (x, measurement.command)


def settled_law(law: Any, t: Any, stationary: Any) -> Any:
    """The law with its filter of crossing loads settled, under loads that stay as at t (s).

    `stationary` maps a set of loads to one that rests at its positions of t. A law without such a
    filter is returned as it is. Raises ValueError if the filter does not settle.
    """
    if isinstance(law, LawOfCommanded):
        return dataclasses.replace(law, law=settled_law(law.law, t, stationary))
    if not (isinstance(law, SampledStateLaw) and isinstance(law.filter, CrossingFilter)):
        parts = jax.tree.leaves(law, is_leaf=lambda part: isinstance(part, CrossingFilter))
        if any(isinstance(part, CrossingFilter) for part in parts):
            raise ValueError("the gain of the Kalman filter varies as the loads cross")
        return law
    filter = eqx.tree_at(lambda x: x.filtered.plant.loads, law.filter, replace_fn=stationary)
    transition, C, D = filter.model_at(t)
    gain = _settled_gain(transition, C, filter.sensor_chain.noise_covariance)
    return dataclasses.replace(law, filter=SettledFilter(filter, (transition, C, D), gain, t))


def _settled_gain(transition, C, noise_covariance) -> Float[np.ndarray, "state sensor"]:
    """Constant gain of a model; zero for constant states, such as weights.

    Raises ValueError if there is none.
    """
    matrix, noise = np.asarray(transition.matrix), np.asarray(transition.noise_covariance)
    constant = np.all(matrix == np.eye(len(matrix)), axis=1) & ~np.any(noise, axis=1)
    kept = ~constant
    gain = np.zeros((len(matrix), len(C)))
    gain[kept], _ = sampled_kalman_gain(
        matrix[np.ix_(kept, kept)], C[:, kept], noise[np.ix_(kept, kept)], noise_covariance
    )
    if not np.all(np.isfinite(gain)):
        raise ValueError("the Kalman filter has no constant gain under stationary loads")
    return gain


ROUNDING = 1e-14  # of the entries of a constant state in a matrix of a loop


def stationary_loops(case: Case, times) -> list[LinearisedLoop]:
    """Loops of a case with its loads stationary at their positions of some times (s).

    They are linearised about the equilibrium under the loads. Raises ValueError as
    `linearised_loop`.
    """
    timing = loop_timing(case)
    loop = loop_dynamics(case, mesh_layout(concrete_case(case)))
    return [
        without_constant_states(linearise(_with_stationary_loads(loop, t), timing, xp.asarray(t)))
        for t in times
    ]


def loop_with_mass_at(case: Case, position: float, mass: float) -> LinearisedLoop:
    """Loop of a case with one stationary mass (kg) at a position (m), and without its loads.

    The law is that of the case, at the time at which the first load of the case is there: a
    schedule has the gains of that time. It is linearised about the equilibrium under the mass.
    Raises ValueError for a position off the beam, a negative mass, and as `linearised_loop`.
    """
    loads = standing_mass(case, position, mass)
    timing = loop_timing(case)
    loop = loop_dynamics(case, mesh_layout(concrete_case(case)))
    loop = eqx.tree_at(lambda loop: loop.augmented_plant.loads, loop, loads)
    t = xp.asarray(_passage_time(case, position))
    return without_constant_states(linearise(loop, timing, t))


def standing_mass(case: Case, position: float, mass: float) -> LoadSet:
    """Load set of a stationary mass (kg) at a position (m) in place of the loads of a case.

    Raises ValueError for a position off the beam, and a mass that is negative or not finite.
    """
    position, mass = float(concrete(position, "position")), float(concrete(mass, "mass"))
    length = float(concrete(case.beam.length))
    if not 0 <= position <= length:
        raise ValueError(f"the mass at {position:g} m is off the beam, 0 to {length:g} m")
    if not 0 <= mass < np.inf:
        raise ValueError(f"the mass at {position:g} m must be positive, in kg; it is {mass:g}")
    alone = dataclasses.replace(case, loads=(MovingMass(mass=mass, speed=1.0),), profile=None)
    zero, one = xp.zeros(()), xp.ones(())
    path = FrozenTrajectory(
        xp.asarray(position), zero, zero, one, xp.ones(1, bool), case.beam.length
    )
    loads = load_set(alone)
    paths = path, *loads.trajectories[1:]  # of absorbers
    return dataclasses.replace(loads, trajectories=paths, profile=None)


def without_constant_states(loop: LinearisedLoop) -> LinearisedLoop:
    """Sampled loop without constant states, such as those of a completed load identification."""
    if loop.period is None:
        return loop
    size = loop.A.shape[0]
    unchanged = np.abs(np.asarray(loop.A) - np.eye(size)) <= ROUNDING
    constant = np.all(unchanged, axis=1) & ~np.any(loop.B, axis=1)
    kept = ~constant
    return LinearisedLoop(
        loop.A[kept][:, kept], loop.B[kept], loop.K[:, kept], loop.period, loop.modal_states
    )


def _with_stationary_loads(loop: LoopDynamics, t: float) -> LoopDynamics:
    """Loop with stationary loads at their positions of t (s), and a filter settled under them.

    Raises ValueError for a filter that does not settle.
    """
    length, zero = loop.plant.case.beam.length, xp.zeros(())

    def stationary(loads: LoadSet) -> LoadSet:
        frozen = frozen_loads(loads, length, xp.asarray(t))
        paths = tuple(
            dataclasses.replace(path, speed=zero, acceleration=zero) for path in frozen.trajectories
        )
        return eqx.tree_at(lambda loads: loads.trajectories, frozen, paths)

    law = settled_law(loop.law, np.float64(t), stationary)
    loads = stationary(loop.augmented_plant.loads)
    return eqx.tree_at(lambda loop: (loop.law, loop.augmented_plant.loads), loop, (law, loads))


def _passage_time(case: Case, position: float) -> float:
    """Time (s) at which the first wheel of the first load is at a position (m); 0 if never."""
    trajectories = load_set(case).trajectories
    if not trajectories:
        return 0.0
    passage, *_ = concrete(trajectories[0].passage_times(xp.asarray([position])))
    return float(passage) if abs(passage) < NEVER else 0.0


class ControlSystems(NamedTuple):
    """Systems of python-control, `control.StateSpace`, with named signals.

    `plant` is in continuous time, from the commands `command_i` and, with a mass on the beam, its
    weight `load_0` (N, positive downwards) to the readings `sensor_i_<quantity>` of ideal sensors.
    `loop` is opened at the commands: from those that act, `command_i`, to those that the law
    returns, `law_i`, with filters, estimators and delays, in discrete time where the law samples.
    `closed` is the closed loop, from commands added to those of the law to those of the law. Both
    are None for a case without a controller.
    """

    plant: Any
    loop: Any
    closed: Any


@refuses_traced("a system of python-control")
def to_control(
    case: Case, position: float | None = None, mass: float | None = None
) -> ControlSystems:
    """Plant and loop of a case as objects of python-control.

    A stationary `mass` (kg), that of the first load of the case if left out, is at `position` (m);
    without a position there is none. Nonlinear laws are linearised about the equilibrium under the
    mass, schedules have the gains of the time at which the first load is there.

    Raises ValueError for an invalid case, a mass without a position, a position off the beam, and a
    mass that is negative or missing; ImportError, saying what to install, if python-control is
    missing.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ...     controller=jb.Feedback([200.0], period=0.002),
    ... )
    >>> systems = jb.to_control(case, position=0.3)
    >>> systems.plant.input_labels, systems.plant.output_labels, systems.loop.dt
    (['command_0', 'load_0'], ['sensor_0_deflection'], 0.002)
    """
    check_case(case)
    if position is None and mass is not None:
        raise ValueError("mass needs a position (m) of the mass on the beam")
    if position is not None and mass is None:
        mass = _first_mass(case)
    plant = state_space(case)
    if position is None or mass is None:
        system, position, mass = plant.unloaded, float(concrete(case.beam.length)) / 2, 0.0
    else:
        loads = standing_mass(case, position, mass)
        alone = dataclasses.replace(case, loads=(MovingMass(mass=mass, speed=1.0),), profile=None)
        system = dataclasses.replace(plant, case=alone, loads=loads).at(0.0)
    if case.controller is None:
        return ControlSystems(system.to_control(), None, None)
    loop = loop_with_mass_at(case, position, mass)
    return ControlSystems(system.to_control(), loop.to_control(), loop.closed_to_control())


def _first_mass(case: Case) -> float:
    """Mass (kg) of the first load of a case."""
    mass = case.loads[0].total_mass(case.run.gravity) if case.loads else None
    if mass is None:
        raise ValueError("mass must be given: the case has no load with a mass")
    return float(concrete(mass))
