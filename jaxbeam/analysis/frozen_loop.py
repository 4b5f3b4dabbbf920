"""A closed loop cut open at its commands: how plant, sensors and law go on, as pure functions.

Limits and the steps of sensors and commands are left out. What waits, filters and laws remember is
part of the state, so that the loop can be made linear, or carried along a crossing.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import Measurement
from jaxbeam.case.trajectory import NEVER, AbstractMotion
from jaxbeam.model.modal_model import rig_in_one
from jaxbeam.model.modes import Layout
from jaxbeam.model.sensor_filters import sensed
from jaxbeam.model.sensor_signals import design, init, read
from jaxbeam.model.state_space import LoadedBeam, loaded_beam
from jaxbeam.runtime.compiling import compiled

ROUNDING = 1e-9  # of a period: shorter differences are none


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
        """A, B, the rates that the weights cause, and commands as a function of the state.

        States of its own that a law has are the last, about those at the start of a run.
        """
        system, held = self.wide.at(t), len(self.model.case.actuators)
        controller, size = self.model.case.controller, system.A.shape[0]
        none = jnp.zeros(held)

        def answer(state, limited):
            # The sensors are ideal here; what filters of the law's own give follows.
            inner, own = state[:size], state[size:]
            measurement = self._measured(self._signals(inner, none, t), inner, none)
            return controller.flow(self.memory, own, measurement, t, limited)

        def command(state):
            return answer(state, lambda wanted: wanted)[0]

        def rates(state, given):
            return answer(state, lambda wanted: given)[1]

        own = controller.own_states(self.memory)
        still = jnp.zeros(size + own)
        slopes, pushes = jax.jacfwd(rates, argnums=(0, 1))(still, none)
        A = jnp.concatenate([jnp.pad(system.A, ((0, 0), (0, own))), slopes])
        push = jnp.concatenate([system.B[:, :held], pushes])
        load = jnp.append(system.B[:, held:] @ self.wide.weights, rates(still, none))
        return A, push, load, command

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
        seen = self._measured(readings, state, command)
        return self.model.case.controller.step(memory, seen, t)

    def _measured(self, readings, state, command):
        inner = self.wide.to_rig(state)[: self.model.rig.states]
        return Measurement(readings, self.model.from_rig(inner), command)

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
    return _opened(case, rig_in_one(case, layout))


@compiled
def _opened(case, assembled):
    model = loaded_beam(case, assembled)
    wide_rig, seen = sensed(model)
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
