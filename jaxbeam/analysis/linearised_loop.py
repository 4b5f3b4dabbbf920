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

from jaxbeam.analysis.frozen_loop import ROUNDING, Clock, OpenLoop, open_loop
from jaxbeam.case.case import Case, known_case
from jaxbeam.case.fields import known
from jaxbeam.case.validation import check
from jaxbeam.model.modes import lay_out
from jaxbeam.runtime.compiling import compiled

SETTLING = 8  # steps of Newton's method towards the state about which a law is made linear
NEAR = 1e-10  # to an eigenvalue, relative: where inverse iteration is centred


class LinearLoop(eqx.Module):
    """Matrices of the loop at an instant, opened at the commands: u = K z closes it.

    With a `period` (s) they take deviations from tick to tick. `modal` is the number of leading
    states that are coordinates of modes and their rates (continuous time: in the order of
    `state_space`).
    """

    A: Float[Array, "state state"]
    B: Float[Array, "state actuator"]
    K: Float[Array, "actuator state"]
    period: float | None = eqx.field(static=True)
    modal: int = eqx.field(static=True)

    @property
    def closed(self) -> Float[Array, "state state"]:
        """The state matrix of the closed loop."""
        return self.A + self.B @ self.K

    def rate(self) -> Float[Array, ""]:
        """The largest real part of the poles in 1/s; differentiable to first order, on a CPU.

        Other poles may coincide, as those of a delay do; the rightmost must be a simple one.
        """
        fixed = jax.lax.stop_gradient(self.closed)
        values, vectors = jnp.linalg.eig(fixed)
        first = jnp.argmax(values.real if self.period is None else jnp.abs(values))
        value, right = values[first], vectors[:, first]
        # The left eigenvector by inverse iteration: those of other poles may not exist.
        shifted = fixed.T - value * (1 + NEAR) * jnp.eye(fixed.shape[0])
        left = jnp.ones_like(right)
        for _ in range(2):
            left = jnp.linalg.solve(shifted, left / jnp.linalg.norm(left))
        value = value + left @ ((self.closed - fixed) @ right) / (left @ right)
        return value.real if self.period is None else jnp.log(jnp.abs(value)) / self.period

    def poles(self) -> np.ndarray:
        """Poles of the closed loop in 1/s, by largest real part first.

        Those of a sampled loop are log(z) / period, with frequencies up to half the sampling's.
        """
        found = np.linalg.eigvals(known(self.closed)).astype(complex)
        if self.period is not None:
            # What a delay lets vanish at once would be at minus infinity.
            tiny = np.finfo(float).tiny
            found = np.log(np.where(found == 0, tiny, found)) / self.period
        return found[np.argsort(-found.real)]


def linear_loop(case: Case, t: float) -> LinearLoop:
    """The loop of a case with its loads frozen at a time t (s), about the rest they cause there.

    Frozen loads keep place, speed and acceleration. A law that is not linear is made so about the
    deflection under the frozen weights. Raises ValueError for a faulty case, one without a
    controller, and one whose sensors are not read at the controller's own ticks.
    """
    clock = prepared(case)
    return linear(open_loop(case, lay_out(known_case(case))), clock, jnp.asarray(float(t)))


def prepared(case: Case) -> Clock | None:
    """Check that the loop of a case can be made linear, and give its clock, if it has one.

    Raises ValueError as `linear_loop` does.
    """
    check(case)
    controller = case.controller
    if controller is None:
        raise ValueError("there is no loop: the case has no controller")
    if controller.period is None:
        return None
    period = float(known(controller.period))
    for i, sensor in enumerate(case.sensors):
        own = sensor.sampling_period
        if own is not None and abs(float(known(own)) - period) > ROUNDING * period:
            raise ValueError(
                f"sensors.{i}.sampling_period must be the controller's, {period:g} s, for the loop"
                f" to repeat itself from tick to tick; it is {float(known(own)):g} s"
            )
    lags = tuple(0.0 if s.delay is None else float(known(s.delay)) for s in case.sensors)
    delay = 0.0 if controller.delay is None else float(known(controller.delay))
    return Clock(period, delay, lags)


@compiled
def linear(loop: OpenLoop, clock: Clock | None, t) -> LinearLoop:
    """A loop with its loads frozen at t (s), linear about the rest under their weights."""
    loop, modal = loop.frozen(t), 2 * loop.model.scale.shape[0]
    if clock is None:
        A, push, load, command = loop.parts(t)
        about = _rest(lambda state: A @ state + push @ command(state) + load, jnp.zeros(A.shape[0]))
        return LinearLoop(A, push, jax.jacfwd(command)(about), None, modal)
    start, rebuild = loop.at_rest(clock)

    def onward(state, given):
        after, wanted = loop.tick(clock, rebuild(state), t, given)
        return ravel_pytree(after)[0], wanted

    about = _rest(lambda state: onward(state, None)[0] - state, start)
    wanted = onward(about, None)[1]
    (A, B), (K, _) = jax.jacfwd(onward, argnums=(0, 1))(about, wanted)
    return LinearLoop(A, B, K, clock.period, modal)


def _rest(change, start):
    """Where nothing changes, by Newton's method; the start if there is no such place near."""

    def closer(state, _):
        step = jnp.linalg.lstsq(jax.jacfwd(change)(state), -change(state))[0]
        return state + step, None

    found = jax.lax.scan(closer, start, length=SETTLING)[0]
    # Where it lies moves the poles of a law that is not linear; derivatives pass over that.
    return jax.lax.stop_gradient(jnp.where(jnp.all(jnp.isfinite(found)), found, start))
