"""The closed loop made linear: how small deviations from a run go on.

Limits and the steps of sensors and commands are left out. A loop without a sampling period is
z' = A z + B u, u = K z; one with a period goes from tick to tick, y_(k+1) = A y_k + B u_k, where
y also holds what filters, estimators and laws remember and the commands that wait for their
delay. All of it follows from the parts of the case by differentiation, so it holds for every
controller.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbeam.case import Case, known_case
from jaxbeam.checks import check
from jaxbeam.compiling import compiled
from jaxbeam.controller import Measurement
from jaxbeam.fields import known
from jaxbeam.loop import plant
from jaxbeam.modes import Layout, lay_out
from jaxbeam.motion import NEVER, AbstractMotion
from jaxbeam.rig import rig
from jaxbeam.sensing import design, init, read
from jaxbeam.statespace import LoadedBeam, loaded_beam

SETTLING = 8  # steps of Newton's method towards the state about which a law is made linear
NEAR = 1e-10  # to an eigenvalue, relative: where inverse iteration is centred
ROUNDING = 1e-9  # of a period: shorter differences are none


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


class Clock(NamedTuple):
    """When things happen within a sampling period, in s and in whole periods."""

    period: float
    delay: float
    lags: tuple[float, ...]


class Frozen(AbstractMotion):
    """A load stopped in mid-motion: it keeps position, speed and acceleration."""

    position: Float[Array, ""]
    speed: Float[Array, ""]
    acceleration: Float[Array, ""]
    on: Any
    length: Float[Array, ""]

    def travel(self, t):
        shape = jnp.shape(t)
        parts = self.position, self.speed, self.acceleration
        return tuple(jnp.broadcast_to(part, shape) for part in parts)

    def window(self):
        return jnp.where(self.on, -NEVER, NEVER), jnp.asarray(NEVER)

    def arrivals(self, places):
        return jnp.zeros(0)


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
def linear(loop: "OpenLoop", clock: Clock | None, t) -> LinearLoop:
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


class OpenLoop(eqx.Module):
    """The plant with the filters of its sensors, and the law, as functions of their states.

    `wide` is the plant with those filters as further states, `seen` what the sensors see of it;
    `memory` is the law's at the start, of which only the leaves that `changes` marks ever change.
    """

    model: LoadedBeam
    wide: LoadedBeam
    seen: Float[Array, "sensor state"]
    memory: Any

    def frozen(self, t) -> "OpenLoop":
        """The same with the loads stopped in mid-motion."""
        loads, length = self.wide.traffic, self.model.case.beam.length
        on = loads.on_beam(t)
        motions = tuple(
            Frozen(*path.travel(t), on[i], length) for i, path in enumerate(loads.motions)
        )
        return eqx.tree_at(lambda loop: loop.wide.traffic.motions, self, motions)

    def parts(self, t):
        """A, B, the rates that the weights cause, and commands as a function of the state."""
        system, held = self.wide.at(t), len(self.model.case.actuators)
        none = jnp.zeros(held)

        def command(state):
            signals = self._signals(state, none, t)
            pairs = zip(self.model.case.sensors, signals, strict=True)
            readings = [read(_ideal(sensor), None, None, value)[0] for sensor, value in pairs]
            readings = jnp.stack(readings) if readings else signals
            return self._law(self.memory, readings, state, none, t)[0]

        push, load = system.B[:, :held], system.B[:, held:] @ self.wide.weights
        return system.A, push, load, command

    def at_rest(self, clock: Clock):
        """State of the sampled loop at rest as one vector, and the function that unpacks it."""
        case = self.model.case
        filters = [
            init(sensor, design(sensor, clock.period), jnp.zeros(())) for sensor in case.sensors
        ]
        seen = [jnp.zeros(_whole(lag / clock.period)[2]) for lag in clock.lags]
        waiting = jnp.zeros((_whole(clock.delay / clock.period)[0] + 1, len(case.actuators)))
        state = jnp.zeros(self.wide.rig.states)
        return ravel_pytree((state, filters, seen, self._moving(self.memory), waiting))

    def tick(self, clock: Clock, state, t, given=None, substeps: int = 1):
        """The loop from just before a tick at t (s) to just before the next, and the commands.

        The commands given are used in place of those of the law. Moving loads are followed in
        `substeps` between any two changes of the command.
        """
        now, filters, seen, own, waiting = state
        case, seen, states, readings = self.model.case, list(seen), [], []
        late, share, _ = _whole(clock.delay / clock.period)
        signals = self._signals(now, waiting[late], t)
        looks = {}
        for i, sensor in enumerate(case.sensors):
            whole, left, reach = _whole(clock.lags[i] / clock.period)
            if left:
                looks.setdefault((1 - left) * clock.period, []).append(i)
            else:
                seen[i] = jnp.concatenate([signals[i : i + 1], seen[i]])
            sections = design(sensor, clock.period)
            reading, after = read(_ideal(sensor), sections, filters[i], seen[i][whole])
            readings.append(reading)
            states.append(after)
            seen[i] = seen[i][:reach]
        readings = jnp.stack(readings) if readings else jnp.zeros(0)
        wanted, own = self._law(self._with(own), readings, now, waiting[late], t)
        waiting = jnp.concatenate([(wanted if given is None else given)[None], waiting])
        # Within the period the command changes once, and sensors with a lag look at the beam.
        change = share * clock.period
        stops = sorted({0.0, change, *looks, clock.period})
        for start, end in zip(stops[:-1], stops[1:], strict=True):
            command = waiting[late + 1] if end <= change else waiting[late]
            now = self._onward(now, command, t + start, end - start, substeps)
            for i in looks.get(end, ()):
                signal = self._signals(now, command, t + end)[i : i + 1]
                seen[i] = jnp.concatenate([signal, seen[i]])[: seen[i].shape[0]]
        return (now, states, seen, self._moving(own), waiting[: late + 1]), wanted

    def _onward(self, state, command, t, span, substeps):
        """The plant after a span (s) under held commands.

        Each substep is two exponentials of matrices at Gauss nodes (order 4; Blanes and Moan,
        Applied Numerical Mathematics 56, 2006), exact if the loads are frozen.
        """
        inputs = jnp.concatenate([command, self.wide.weights])

        def matrix(time):
            # Inputs are further states that stay: so the matrix is the same for all of them.
            system = self.wide.at(time)
            top = jnp.concatenate([system.A, system.B], axis=1)
            return jnp.pad(top, ((0, inputs.shape[0]), (0, 0)))

        start = jnp.concatenate([state, inputs])
        return through(matrix, t, span, substeps, start)[: state.shape[0]]

    def _signals(self, state, command, t):
        """What the sensors see of the plant with their analogue filters."""
        signals = self.seen @ self.wide.to_rig(state)
        quick = np.array([s.quantity == "acceleration" for s in self.model.case.sensors], bool)
        if not quick.any():
            return signals
        system = self.wide.at(t)
        felt = system.C @ state + system.D @ jnp.concatenate([command, self.wide.weights])
        return jnp.where(quick, felt, signals)

    def _law(self, memory, readings, state, command, t):
        inner = self.wide.to_rig(state)[: self.model.rig.states]
        seen = Measurement(readings, self.model.from_rig(inner), command)
        return self.model.case.controller.step(memory, seen, t)

    def _changes(self) -> list[bool]:
        """Which leaves of the law's memory its steps change; the others are its design."""
        case, leaves = self.model.case, jax.tree.leaves(self.memory)
        state = jnp.zeros(self.wide.rig.states)
        readings, command = jnp.zeros(len(case.sensors)), jnp.zeros(len(case.actuators))

        def after(leaves):
            memory = jax.tree.unflatten(jax.tree.structure(self.memory), leaves)
            return jax.tree.leaves(self._law(memory, readings, state, command, jnp.zeros(()))[1])

        traced = jax.make_jaxpr(after)(leaves).jaxpr
        return [a is not b for a, b in zip(traced.invars, traced.outvars, strict=True)]

    def _moving(self, memory):
        """The leaves of a memory of the law that its steps change."""
        pairs = zip(jax.tree.leaves(memory), self._changes(), strict=True)
        return [leaf for leaf, changes in pairs if changes]

    def _with(self, moving):
        """The law's memory with these leaves in place of those that change."""
        leaves, structure = jax.tree.flatten(self.memory)
        fresh = iter(moving)
        pairs = zip(leaves, self._changes(), strict=True)
        leaves = [next(fresh) if changes else leaf for leaf, changes in pairs]
        return jax.tree.unflatten(structure, leaves)


def open_loop(case: Case, layout: Layout) -> OpenLoop:
    """The opened loop of a case with a controller. May be traced and batched."""
    # Cases that differ in their controllers share what is compiled of the rig.
    return _opened(case, _rig(eqx.tree_at(lambda c: c.controller, case, None), layout))


_rig = compiled(rig)


@compiled
def _opened(case, assembled):
    model = loaded_beam(case, assembled)
    wide_rig, seen = plant(model)
    wide = eqx.tree_at(lambda m: m.rig, model, wide_rig)
    return OpenLoop(model, wide, seen, case.controller.init(model))


def through(matrix, t, span, substeps: int, start):
    """x(t + span) of x' = matrix(time) x with x(t) = start, a vector or a matrix; order 4."""
    step = span / substeps
    early, late = 0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6
    near, far = (0.25 + math.sqrt(3) / 6) * step, (0.25 - math.sqrt(3) / 6) * step

    def on(state, time):
        first, second = matrix(time + early * step), matrix(time + late * step)
        for part in (near * first + far * second, far * first + near * second):
            state = jax.scipy.linalg.expm(part, max_squarings=40) @ state
        return state, None

    return jax.lax.scan(on, start, t + step * np.arange(substeps))[0]


def _ideal(sensor):
    """The sensor without what is not linear in it: its range and its resolution."""
    fields = ("range", "resolution", "offset")
    return eqx.tree_at(
        lambda s: [getattr(s, name) for name in fields],
        sensor,
        [None, None, jnp.zeros(())],
        is_leaf=lambda x: x is None,
    )


def _whole(periods: float) -> tuple[int, float, int]:
    """Whole periods in a lag, the share of one that is left, and how many periods it reaches."""
    whole = math.floor(periods + ROUNDING)
    share = max(periods - whole, 0.0)
    share = share if share > ROUNDING else 0.0
    return whole, share, whole + (share > 0)


def _rest(change, start):
    """Where nothing changes, by Newton's method; the start if there is no such place near."""

    def closer(state, _):
        step = jnp.linalg.lstsq(jax.jacfwd(change)(state), -change(state))[0]
        return state + step, None

    found = jax.lax.scan(closer, start, length=SETTLING)[0]
    # Where it lies moves the poles of a law that is not linear; derivatives pass over that.
    return jax.lax.stop_gradient(jnp.where(jnp.all(jnp.isfinite(found)), found, start))
