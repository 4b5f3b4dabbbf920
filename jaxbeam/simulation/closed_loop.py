"""The closed loop: sensors, controller and actuators' limits, as the driver of the integrator.

A controller with a sampling period acts at its ticks, on the readings it has by then; its command
begins a delay later and is held, while the beam moves continuously in between. A controller
without a period acts at every instant: its law is demanded at the Gauss nodes of each step, by
Newton's method, beside the contact law.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import Measurement
from jaxbeam.case.fields import known
from jaxbeam.integrator.events import Schedule, merged
from jaxbeam.integrator.input_policy import AbstractDriver, Moment
from jaxbeam.integrator.propagators import GAUSS, NODES
from jaxbeam.model.contact import Traffic, at_instant
from jaxbeam.model.modal_model import Rig
from jaxbeam.model.modes import Layout
from jaxbeam.model.sensor_filters import sensed
from jaxbeam.model.sensor_signals import design, init, noise_samples, read
from jaxbeam.model.state_space import LoadedBeam, state_space

ITERATIONS = 4  # of Newton's method for a law at every instant; one would do for a linear law


def loop_schedule(case: Case, samples: Float[np.ndarray, " time"]) -> Schedule:
    """When the controller of a case acts and its sensors are read, up to the last sample (s)."""
    controller, end = case.controller, samples[-1]
    knots = controller.knots(case)
    knots = np.zeros(0) if knots is None else known(knots)
    if controller.period is None:
        return merged(samples, np.zeros(0), 0.0, [], [], knots)

    def clock(period):
        return np.arange(int(np.floor(end / period * (1 + 1e-12))) + 1) * period

    period = float(known(controller.period))
    own = [period if s.sampling_period is None else known(s.sampling_period) for s in case.sensors]
    late = [0.0 if s.delay is None else float(known(s.delay)) for s in case.sensors]
    delay = 0.0 if controller.delay is None else float(known(controller.delay))
    return merged(samples, clock(period), delay, [clock(float(p)) for p in own], late, knots)


class Loop(AbstractDriver):
    """The driver made of the controller of a case. Lanes share the controller, not its memory.

    `designed` is that memory at the start, which holds what the controller works out beforehand.
    So many states of a law that acts at every instant are `flowing`: they are the last of the
    rig's, and their rates the last of the commands.
    """

    model: LoadedBeam
    designed: Any
    rig: Rig
    seen: Float[Array, "sensor state"]
    traffic: Traffic
    schedule: Schedule
    sections: tuple
    noise: Float[Array, "read sensor"] | None
    bound: Float[Array, " state"]
    inner: bool = eqx.field(static=True)
    flowing: int = eqx.field(static=True)

    def start(self, lanes: int) -> Any:
        controller, case = self.model.case.controller, self.model.case
        memory = _every_lane(self.designed, lanes)
        if controller.period is None:
            return memory, jnp.zeros((self.rig.command_matrix.shape[1], lanes))
        commands = jnp.zeros((len(case.actuators), lanes))
        pairs = zip(case.sensors, self.sections, strict=True)
        sensing = [init(sensor, sections, jnp.zeros(lanes)) for sensor, sections in pairs]
        rest = [
            read(sensor, sections, state, jnp.zeros(lanes))[0]
            for sensor, sections, state in zip(case.sensors, self.sections, sensing, strict=True)
        ]
        rest = jnp.stack(rest) if rest else jnp.zeros((0, lanes))
        shown = jnp.broadcast_to(rest, (self.schedule.newest + 1, *rest.shape))
        waiting = jnp.zeros((self.schedule.waiting + 1, *commands.shape))
        return memory, commands, sensing, shown, waiting

    def drive(self, memory, state, moment: Moment, states):
        if self.model.case.controller.period is None:
            return self._at_every_instant(memory, state, moment, states)
        memory = jax.lax.cond(
            moment.edge >= 0,
            lambda memory: self._act(memory, state, moment),
            lambda memory: memory,
            memory,
        )
        active = memory[1]
        return jnp.broadcast_to(active, (NODES, *active.shape)), memory

    def _at_every_instant(self, memory, state, moment: Moment, states):
        own, last = memory
        times = moment.start + moment.span * GAUSS
        if not self.inner:
            commands = jax.vmap(lambda time: self._answer(own, state, time))(times)
            return commands, (own, commands[-1])

        def wanted(commands):
            return jax.vmap(lambda *at: self._answer(own, *at))(states(commands), times)

        guess = jnp.broadcast_to(last, (NODES, *last.shape))
        commands = newton(wanted, guess, ITERATIONS)
        return commands, (own, commands[-1])

    def at_instants(self, states: Float[Array, "time state"], times: Float[Array, " time"]):
        """Commands (time, command) of a law at every instant, for a single lane.

        Behind those to the actuators are the rates of the law's own states.
        """
        own = _every_lane(self.designed, 1)
        return jax.vmap(lambda state, time: self._answer(own, state[:, None], time)[:, 0])(
            states, times
        )

    def _answer(self, own, state, time):
        """Commands (actuator, lane) of a law at every instant to a state; rates of own states."""
        case, seen = self.model.case, self.seen @ state
        pairs = zip(case.sensors, seen[: len(case.sensors)], strict=True)
        readings = [read(sensor, None, None, value)[0] for sensor, value in pairs]
        # What filters of the law's own give follows.
        shown = jnp.stack([*readings, *seen[len(case.sensors) :]]) if seen.shape[0] else seen
        none = jnp.zeros((len(case.actuators), state.shape[-1]))
        moving = state[state.shape[0] - self.flowing :]

        def single(own, moving, *seen):
            return jnp.concatenate(
                case.controller.flow(own, moving, Measurement(*seen), time, self._limited)
            )

        ordered = self.model.from_rig(state[: self.model.rig.states])
        every = jax.vmap(single, in_axes=-1, out_axes=-1)
        return every(own, moving, shown, ordered, none)

    def _act(self, memory, state, moment: Moment):
        """All that is due at an edge: readings, a new command, and commands that begin."""
        own, active, sensing, shown, waiting = memory
        case, schedule, edge = self.model.case, self.schedule, moment.edge
        signals = self._signals(state, active, moment.start)
        readings, states = [], []
        for i, sensor in enumerate(case.sensors):
            number = schedule.reads[edge, i]
            noise = None if self.noise is None else self.noise[number, i]
            reading, after = read(sensor, self.sections[i], sensing[i], signals[i], noise)
            due = number >= 0
            readings.append(jnp.where(due, reading, shown[0, i]))
            states.append(_choose(due, after, sensing[i]))
            history = jnp.where(due, jnp.roll(shown[:, i], 1, axis=0), shown[:, i])
            shown = shown.at[:, i].set(history.at[0].set(readings[-1]))

        def tick(inputs):
            own, waiting = inputs
            arrived = self._arrived(shown, edge)
            wanted, own = self._step(own, arrived, state, active, moment.start)
            command = self._limited(wanted, waiting[0])
            return own, jnp.roll(waiting, 1, axis=0).at[0].set(command)

        own, waiting = jax.lax.cond(
            schedule.tick[edge] >= 0, tick, lambda inputs: inputs, (own, waiting)
        )
        begins = schedule.apply[edge]
        active = jnp.where(begins >= 0, waiting[jnp.maximum(begins, 0)], active)
        return own, active, states, shown, waiting

    def shows(self, memory, moment: Moment):
        """Readings (sensor, lane) that have arrived, and failures (lane) of the controller."""
        controller = self.model.case.controller
        if controller.period is None:
            return None
        return self._arrived(memory[3], moment.edge), self.failures(memory)

    def failures(self, memory) -> Float[Array, " lane"]:
        """How many steps of the controller found no solution until now, in every lane."""
        own, commands = memory[:2]
        count = self.model.case.controller.failures
        return jax.vmap(count, in_axes=-1, out_axes=-1, axis_size=commands.shape[-1])(own)

    def _arrived(self, shown, edge):
        """The newest readings (sensor, lane) that have arrived by an edge."""
        newest = [shown[self.schedule.age[edge, i], i] for i in range(shown.shape[1])]
        return jnp.stack(newest) if newest else shown[0]

    def _signals(self, state, command, time):
        """What the sensors see at an instant (sensor, lane)."""
        signals = self.seen @ state
        sensors = self.model.case.sensors
        if not any(sensor.quantity == "acceleration" for sensor in sensors):
            return signals
        _, moving = at_instant(self.rig, self.traffic, time, state, command)
        for i, sensor in enumerate(sensors):
            if sensor.quantity == "acceleration":
                shape = self.rig.shapes(sensor.position, (0,))[0]
                signals = signals.at[i].set(shape @ moving)
        return signals

    def _step(self, own, readings, state, command, time):
        """The controller's step in every lane."""

        def single(own, *seen):
            return self.model.case.controller.step(own, Measurement(*seen), time)

        ordered = self.model.from_rig(state[: self.model.rig.states])
        return jax.vmap(single, in_axes=-1, out_axes=-1)(own, readings, ordered, command)

    def _limited(self, wanted, before=None):
        """Commands as the actuators take them: rounded, within limits and rates of change."""
        controller, case = self.model.case.controller, self.model.case
        if controller.resolution is not None:
            rounded = controller.resolution * jnp.round(wanted / controller.resolution)
            wanted = wanted + jax.lax.stop_gradient(rounded - wanted)
        rows = []
        for i, actuator in enumerate(case.actuators):
            command, limits, rate = wanted[i], actuator.command_limits(), actuator.command_rate()
            if limits is not None:
                command = jnp.clip(command, limits[0], limits[1])
            if rate is not None and before is not None:
                change = rate * controller.period
                command = jnp.clip(command, before[i] - change, before[i] + change)
            rows.append(command)
        return jnp.stack(rows)


def newton(wanted, guess: Float[Array, "*shape lane"], iterations: int):
    """Find what a function gives back unchanged, in each lane by itself, by Newton's method."""
    lanes = guess.shape[-1]
    size = guess.size // lanes
    units = jnp.broadcast_to(jnp.eye(size)[..., None], (size, size, lanes))

    def closer(value, _):
        found, change = jax.linearize(wanted, value)
        slopes = jax.vmap(change)(units.reshape(size, *guess.shape)).reshape(units.shape)
        short = (found - value).reshape(size, lanes)
        step = jnp.linalg.solve((units - slopes).T, short.T[..., None])
        return value + step[..., 0].T.reshape(guess.shape), None

    return jax.lax.scan(closer, guess, length=iterations)[0]


def _every_lane(memory, lanes: int):
    """The same memory in all lanes, along a new last axis."""
    return jax.tree.map(
        lambda leaf: jnp.broadcast_to(jnp.asarray(leaf)[..., None], (*jnp.shape(leaf), lanes)),
        memory,
    )


def _choose(condition, new, old):
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def make_loop(case: Case, layout: Layout, loads: Traffic, schedule: Schedule) -> Loop:
    """The driver for a case that has a controller; its `rig` is the plant to integrate."""
    model = state_space(case, layout=layout)
    wide, seen = sensed(model)
    controller = case.controller
    if controller.period is None:
        sections, noise = (None,) * len(case.sensors), None
    else:
        sections = tuple(design(sensor, controller.period) for sensor in case.sensors)
        noise = None
        if any(sensor.noise is not None for sensor in case.sensors):
            noise = noise_samples(case.run.seed, len(case.sensors), schedule.most_reads)
    inner = controller.period is None and not controller.blind
    designed = controller.init(model)  # once: it may solve Riccati equations
    flowing = controller.own_states(designed) if inner else 0
    wide, seen = with_flowing(wide, seen, flowing)
    # A deflection about as large as the beam is long: modes are of the order sqrt(2 / mass).
    beam = case.beam
    most = beam.length * jnp.sqrt(beam.linear_density * beam.length / 2)
    bound = jnp.full(wide.states, jnp.inf).at[0 : 2 * beam.modes : 2].set(most)
    return Loop(
        model, designed, wide, seen, loads, schedule, sections, noise, bound, inner, flowing
    )


def with_flowing(
    rig: Rig, seen: Float[Array, "sensor state"], count: int
) -> tuple[Rig, Float[Array, "sensor all"]]:
    """A rig with so many more states, whose rates are its last commands; no sensor sees them."""
    if count == 0:
        return rig, seen
    matrix = jnp.pad(rig.state_matrix, ((0, 0), (0, count), (0, count)))
    command = jax.scipy.linalg.block_diag(rig.command_matrix, jnp.eye(count))
    parts = matrix, command
    wide = eqx.tree_at(lambda r: (r.state_matrix, r.command_matrix), rig, parts)
    return wide, jnp.pad(seen, ((0, 0), (0, count)))
