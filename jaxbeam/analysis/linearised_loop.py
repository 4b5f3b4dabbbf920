"""The closed loop made linear: how small deviations from a run go on.

Limits and the steps of sensors and commands are left out. A loop without a sampling period is
z' = A z + B u, u = K z; one with a period goes from tick to tick, y_(k+1) = A y_k + B u_k, where
y also holds what filters, estimators and laws remember and the commands that wait for their
delay. All of it follows from the parts of the case by differentiation, so it holds for every
controller.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbeam.analysis.frozen_loop import PERIOD_TOLERANCE, LoopDynamics, LoopTiming, loop_dynamics
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check_case
from jaxbeam.model.modes import mesh_layout
from jaxbeam.runtime.compiling import compiled

NEWTON_ITERATIONS = 8  # steps of Newton's method towards the state about which a law is made linear
EIGENVALUE_OFFSET = 1e-10  # to an eigenvalue, relative: where inverse iteration is centred


class LinearisedLoop(eqx.Module):
    """Matrices of the loop at an instant, opened at the commands: u = K z closes it.

    With a `period` (s) they take deviations from tick to tick. `modal_states` is the number of leading
    states that are coordinates of modes and their rates (continuous time: in the order of
    `state_space`).
    """

    A: Float[Array, "state state"]
    B: Float[Array, "state actuator"]
    K: Float[Array, "actuator state"]
    period: float | None = eqx.field(static=True)
    modal_states: int = eqx.field(static=True)

    @property
    def closed_matrix(self) -> Float[Array, "state state"]:
        """The state matrix of the closed loop."""
        return self.A + self.B @ self.K

    def growth_rate(self) -> Float[Array, ""]:
        """The largest real part of the poles in 1/s; differentiable to first order, on a CPU.

        Other poles may coincide, as those of a delay do; the rightmost must be a simple one.
        """
        constant_matrix = jax.lax.stop_gradient(self.closed_matrix)
        values, vectors = jnp.linalg.eig(constant_matrix)
        dominant = jnp.argmax(values.real if self.period is None else jnp.abs(values))
        value, right = values[dominant], vectors[:, dominant]
        # The left eigenvector by inverse iteration: those of other poles may not exist.
        shifted = constant_matrix.T - value * (1 + EIGENVALUE_OFFSET) * jnp.eye(
            constant_matrix.shape[0]
        )
        left = jnp.ones_like(right)
        for _ in range(2):
            left = jnp.linalg.solve(shifted, left / jnp.linalg.norm(left))
        value = value + left @ ((self.closed_matrix - constant_matrix) @ right) / (left @ right)
        return value.real if self.period is None else jnp.log(jnp.abs(value)) / self.period

    def poles(self) -> np.ndarray:
        """Poles of the closed loop in 1/s, by largest real part first.

        Those of a sampled loop are log(z) / period, with frequencies up to half the sampling's.
        """
        poles = np.linalg.eigvals(concrete(self.closed_matrix)).astype(complex)
        if self.period is not None:
            # What a delay lets vanish at once would be at minus infinity.
            tiny = np.finfo(float).tiny
            poles = np.log(np.where(poles == 0, tiny, poles)) / self.period
        return poles[np.argsort(-poles.real)]


def linearised_loop(case: Case, t: float) -> LinearisedLoop:
    """The loop of a case with its loads frozen at a time t (s), about the rest they cause there.

    Frozen loads keep place, speed and acceleration. A law that is not linear is made so about the
    deflection under the frozen weights. Raises ValueError for a faulty case, one without a
    controller, and one whose sensors are not read at the controller's own ticks.
    """
    timing = loop_timing(case)
    return linearise(
        loop_dynamics(case, mesh_layout(concrete_case(case))), timing, jnp.asarray(float(t))
    )


def loop_timing(case: Case) -> LoopTiming | None:
    """Check that the loop of a case can be made linear, and give its clock, if it has one.

    Raises ValueError as `linearised_loop` does.
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
                f" to repeat itself from tick to tick; it is {float(concrete(sampling_period)):g} s"
            )
    sensor_delays = tuple(
        0.0 if s.delay is None else float(concrete(s.delay)) for s in case.sensors
    )
    delay = 0.0 if controller.delay is None else float(concrete(controller.delay))
    return LoopTiming(period, delay, sensor_delays)


@compiled
def linearise(loop: LoopDynamics, timing: LoopTiming | None, t) -> LinearisedLoop:
    """A loop with its loads frozen at t (s), linear about the rest under their weights."""
    loop, modal_states = loop.freeze_loads(t), 2 * loop.plant.coordinate_scale.shape[0]
    if timing is None:
        A, input_matrix, weight_rates, command = loop.continuous_dynamics(t)
        equilibrium = _equilibrium(
            lambda state: A @ state + input_matrix @ command(state) + weight_rates,
            jnp.zeros(A.shape[0]),
        )
        return LinearisedLoop(A, input_matrix, jax.jacfwd(command)(equilibrium), None, modal_states)
    start, rebuild = loop.rest_state(timing)

    def sampling_step(state, given):
        after, wanted = loop.sampling_step(timing, rebuild(state), t, given)
        return ravel_pytree(after)[0], wanted

    equilibrium = _equilibrium(lambda state: sampling_step(state, None)[0] - state, start)
    command_at_equilibrium = sampling_step(equilibrium, None)[1]
    (A, B), (K, _) = jax.jacfwd(sampling_step, argnums=(0, 1))(equilibrium, command_at_equilibrium)
    return LinearisedLoop(A, B, K, timing.period, modal_states)


def _equilibrium(change, start):
    """Where nothing changes, by Newton's method; the start if there is no such place near."""

    def newton_step(state, _):
        step = jnp.linalg.lstsq(jax.jacfwd(change)(state), -change(state))[0]
        return state + step, None

    found = jax.lax.scan(newton_step, start, length=NEWTON_ITERATIONS)[0]
    # Where it lies moves the poles of a law that is not linear; derivatives pass over that.
    return jax.lax.stop_gradient(jnp.where(jnp.all(jnp.isfinite(found)), found, start))
