"""A problem as an environment: pure `reset` and `step`, for jit, vmap, grad and scan.

Between two events of the loop (readings, a command that begins) the command is held, so that the
plant is one affine map of its state and the command, exact to the steps of the integrator. `reset`
composes the maps of all steps for a load; `step` multiplies by one or a few of them. Readings,
filters, delays, limits and resolution are those of the sampled loop of `simulate`.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxbeam.benchmark.problem import LOAD_STREAM, BenchmarkProblem
from jaxbeam.case.actuators.base import limited_loops
from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.case import Case
from jaxbeam.control.feedback import Feedback
from jaxbeam.model.contact import initial_vehicle_states
from jaxbeam.model.load_set import load_set
from jaxbeam.runtime.arrays import Module
from jaxbeam.simulation.closed_loop import LoopMemory, SampledLoop, closed_loop, loop_schedule
from jaxbeam.simulation.integration_plan import sample_times
from jaxbeam.simulation.integrator.discrete_model import NODE_COUNT, discrete_model
from jaxbeam.simulation.integrator.integrate import step_inputs
from jaxbeam.simulation.integrator.load_path import load_path
from jaxbeam.simulation.integrator.step import AffineMap, step_maps
from jaxbeam.simulation.integrator.step_size import StaticShapes
from jaxbeam.simulation.integrator.time_grid import EventSchedule, grid_by_schedule
from jaxbeam.simulation.integrator.vehicles import vehicles_of
from jaxbeam.simulation.varied_plan import declared_ranges, varied_plan

TOLERANCE = 1e-9  # of the steps, relative to the largest deflection
REFUSED = (
    "an environment takes a controller with a period, without dropout and jitter, and sensors"
    " without these that measure no acceleration, and no limits within inner loops: {} does not fit"
)


class HeldMaps(NamedTuple):
    """Affine maps of (state, command) over each interval of each period of a run.

    `states` map to the state at the end of the interval, `deflections` (m) to those at the
    positions of the problem at all samples of the period, zero where these are in another interval.
    """

    states: AffineMap
    deflections: AffineMap


class EnvironmentState(NamedTuple):
    """State of an environment, a tree of arrays.

    `load` are the numbers of the load, `step` is that of the period, `plant` the state of beam,
    analogue filters and vehicles, `peak` (m) the largest absolute deflection so far, `uncontrolled`
    (m) that of the whole run without commands. `maps` and `noise` do not change during a run.
    """

    load: Float[Array, " number"]
    maps: HeldMaps
    noise: Float[Array, "sample sensor"] | None
    uncontrolled: Float[Array, ""]
    step: Int[Array, ""]
    plant: Float[Array, " state"]
    memory: LoopMemory
    peak: Float[Array, ""]


class _SteppedLoop(SampledLoop):
    """Sampled loop that is advanced event by event, with commands from outside."""

    def read(self, memory: LoopMemory, state, event):
        """Memory after the samples of sensors at an event, and the available readings."""
        filters, readings = self._sample_sensors(memory, state, _Event(event, jnp.zeros(())))
        memory = memory._replace(filter_states=filters, readings=readings)
        return memory, self._available_readings(readings, event)[:, 0]

    def passed(self, memory: LoopMemory, state, event, reads: bool) -> LoopMemory:
        """Memory after an event: samples of sensors, a command that begins; unchanged for none."""
        is_event, event = event >= 0, jnp.maximum(event, 0)
        after = self.read(memory, state, event)[0] if reads else memory
        age = jnp.asarray(self.schedule.command_age)[event]
        after = after._replace(commands=self.path.begin(after.commands, age))
        return jax.tree.map(lambda new, old: jnp.where(is_event, new, old), after, memory)


class _Event(NamedTuple):
    event: Any
    start: Any


@dataclasses.dataclass(frozen=True, eq=False)
class _PreparedLoop:
    """What an environment prepares: concrete numbers, whatever transformation it is given to.

    Compared by identity, so that it is a static part of programs.
    """

    case: Case
    loop: _SteppedLoop
    shapes: StaticShapes
    substeps: int
    schedule: EventSchedule
    controls: Int[np.ndarray, " period_or_end"]  # events of the control samples
    starts: Int[np.ndarray, "period interval"]  # first event of each interval, -1 for none
    samples: Int[np.ndarray, "period sample"]  # events of the samples of each period


class Environment(Module):
    """Environment of a problem: `reset` and `step` are pure functions of arrays.

    An observation has the readings of the sensors (their SI units), the elapsed fraction of the
    run, and, in a problem that tells its load, the numbers of the load as fractions of their
    ranges. An action has a command for each actuator that takes any, in its unit; the loop rounds
    and limits it. Rewards are minus the growth of the peak over the peak without commands: their
    sum is minus the ratio of the peaks, which orders runs of a load as the score does.

    Raises ValueError for a controller or sensors of other kinds than those named in REFUSED.

    >>> import jaxbeam as jb
    >>> environment = jb.benchmark.Environment(jb.benchmark.load("patch"))
    >>> state, observation = environment.reset(7)
    >>> state, observation, reward, done = environment.step(state, [1.0])
    >>> print(observation.shape, bool(done))
    (5,) False
    """

    problem: BenchmarkProblem = eqx.field(static=True)
    prepared: _PreparedLoop = eqx.field(static=True)

    @checks_classes
    def __init__(self, problem: BenchmarkProblem):
        case, controller = problem.case, problem.case.controller
        _check(case)
        gains = np.zeros(len(case.driven))
        settings = {name: getattr(controller, name) for name in ("period", "delay", "resolution")}
        silent = Feedback(gains=gains, **settings)
        case = dataclasses.replace(case, controller=silent)
        schedule = loop_schedule(case, np.asarray(sample_times(case)))
        plan = varied_plan(case, declared_ranges(case, problem.vary), None, TOLERANCE)
        shapes = dataclasses.replace(plan.shapes, max_loads=problem.max_loads)
        loop = closed_loop(case, shapes.layout, load_set(case, shapes.layout), schedule)
        stepped = _SteppedLoop(**{f.name: getattr(loop, f.name) for f in dataclasses.fields(loop)})
        self.problem = problem
        self.prepared = _PreparedLoop(
            case, stepped, shapes, plan.substeps, schedule, *_periods(schedule)
        )

    @property
    def steps(self) -> int:
        """Number of steps of a run."""
        return len(self.prepared.starts)

    def reset(
        self, key: Any, load: Any = None
    ) -> tuple[EnvironmentState, Float[Array, " observation"]]:
        """State and observation at the start of a run.

        A seed or JAX key gives the noise, and the load unless its numbers are given, in the order
        and units of `BenchmarkProblem.vary`.

        Raises ValueError for a key that is none, and for another number of numbers of the load.
        """
        key, vary = _key(key), self.problem.vary
        if load is None:
            load = self.problem.numbers(
                jax.random.uniform(jax.random.fold_in(key, LOAD_STREAM), (len(vary),))
            )
        load = jnp.asarray(load, float)
        if load.shape != (len(vary),):
            raise ValueError(
                f"a load has {len(vary)} numbers, {', '.join(vary)}; its shape is {load.shape}"
            )
        maps, plant = self._maps(load)
        noise = self.prepared.loop.noise
        if noise is not None:
            columns = [
                jax.random.normal(jax.random.fold_in(key, i), noise.shape[:1])
                for i in range(noise.shape[1])
            ]
            noise = jnp.stack(columns, axis=1)
        memory = jax.tree.map(jnp.asarray, self.prepared.loop.start(1))
        zero = jnp.zeros(())
        state = EnvironmentState(load, maps, noise, zero, jnp.zeros((), int), plant, memory, zero)
        state = state._replace(uncontrolled=self._peak_without_commands(state))
        return self._observed(state, 0)

    @checks_classes
    def step(
        self, state: EnvironmentState, action: Any
    ) -> tuple[EnvironmentState, Float[Array, " observation"], Float[Array, ""], Any]:
        """State, observation, reward and whether the run has ended, after a period under an action.

        After the end of a run nothing changes any more.

        Raises ValueError for an action of another shape than (commands,).
        """
        driven, action = np.array(self.problem.driven), jnp.asarray(action, float)
        if action.shape != driven.shape:
            raise ValueError(
                f"an action is a list of {len(driven)} commands, one for each actuator that takes"
                f" any; its shape is {action.shape}"
            )
        wanted = jnp.zeros(len(self.prepared.case.actuators)).at[driven].set(action)
        k = jnp.minimum(state.step, self.steps - 1)
        ended = state.step >= self.steps
        loop, memory, plant, peak = self._loop(state), state.memory, state.plant, state.peak
        memory = memory._replace(commands=loop.path.send(memory.commands, wanted[:, None]))
        for i in range(self.prepared.starts.shape[1]):
            event = jnp.asarray(self.prepared.starts)[k, i]
            memory = loop.passed(memory, plant[:, None], event, reads=i > 0)
            plant, highest = _advance(state.maps, k, i, plant, loop.path.acting(memory.commands))
            peak = jnp.maximum(peak, highest)
        after = state._replace(step=state.step + 1, plant=plant, memory=memory, peak=peak)
        after, observation = self._observed(after, k + 1)
        after = jax.tree.map(lambda new, old: jnp.where(ended, old, new), after, state)
        reward = -(after.peak - state.peak) / state.uncontrolled
        return after, observation, reward, after.step >= self.steps

    def _loop(self, state: EnvironmentState) -> _SteppedLoop:
        return dataclasses.replace(self.prepared.loop, noise=state.noise)

    def _observed(self, state: EnvironmentState, period):
        """State after the samples of the sensors at the start of a period, and observation."""
        event = jnp.asarray(self.prepared.controls)[period]
        memory, readings = self._loop(state).read(state.memory, state.plant[:, None], event)
        parts = [readings, (state.step / self.steps)[None]]
        if self.problem.told:
            parts.append(self.problem.shares(state.load))
        return state._replace(memory=memory), jnp.concatenate(parts)

    def _peak_without_commands(self, state: EnvironmentState):
        nothing = jnp.zeros((len(self.prepared.case.actuators), 1))

        def period(plant, k):
            highest = jnp.zeros(())
            for i in range(self.prepared.starts.shape[1]):
                plant, own = _advance(state.maps, k, i, plant, nothing)
                highest = jnp.maximum(highest, own)
            return plant, highest

        return jnp.max(jax.lax.scan(period, state.plant, jnp.arange(self.steps))[1])

    def _maps(self, load) -> tuple[HeldMaps, Float[Array, " state"]]:
        """Maps of all intervals for a load, and the state at the start."""
        case = self.problem.with_load(self.prepared.case, load)
        layout, schedule = self.prepared.shapes.layout, self.prepared.schedule
        loads, model = load_set(case, layout), self.prepared.loop.model
        grid = grid_by_schedule(case, model, schedule, self.prepared.substeps)
        discrete = discrete_model(model, grid, None, self.prepared.loop)
        count = grid.counts.shape[0] * self.prepared.substeps
        path = load_path(discrete, loads, self.prepared.shapes.max_loads, jnp.arange(count))
        maps = step_maps(step_inputs(discrete, loads, path), vehicles_of(loads, grid.lengths))
        states, actuators = maps.states.offset.shape[-1], len(case.actuators)
        linear = jnp.asarray(maps.states.linear)[:, 0]
        held = linear[..., states:].reshape(*linear.shape[:2], NODE_COUNT, actuators).sum(axis=2)
        steps = linear[..., :states], held, jnp.asarray(maps.states.offset)[:, 0]

        panels = jnp.asarray(grid.event_panels) * self.prepared.substeps  # first step of each event
        first = self.prepared.starts[self.prepared.starts >= 0]
        is_first = jnp.zeros(count, bool).at[panels[first]].set(True)
        identity = jnp.eye(states, states + actuators)

        def compose(before, one):
            begins, (transition, by_command, offset) = one
            of_columns = jnp.where(begins, identity, before[0])
            of_one = jnp.where(begins, 0.0, before[1])
            after = (transition @ of_columns).at[:, states:].add(by_command)
            after = after, transition @ of_one + offset
            return after, after

        start = identity, jnp.zeros(states)
        _, (of_columns, of_one) = jax.lax.scan(compose, start, (is_first, steps))

        def at(event):
            """Map to an event from the start of the interval that it ends or is in."""
            last = panels[event] - 1
            return AffineMap(of_columns[last], of_one[last])

        is_one = self.prepared.starts >= 0
        ends = np.where(is_one, _next(self.prepared.starts, self.prepared.controls), 0)
        to_ends = at(ends)
        whole = AffineMap(
            jnp.where(is_one[..., None, None], to_ends.linear, identity),
            jnp.where(is_one[..., None], to_ends.offset, 0.0),
        )
        rows = jnp.zeros((len(self.problem.positions), states))
        shapes = model.shapes(np.asarray(self.problem.positions), (0,))[0]
        rows = rows.at[:, model.coordinate_index].set(shapes)
        # A sample belongs to the interval that begins before it and ends with it or later.
        samples = self.prepared.samples[:, None]
        inside = (
            (samples > self.prepared.starts[..., None])
            & (samples <= ends[..., None])
            & is_one[..., None]
        )
        of_samples = at(self.prepared.samples)
        shape = (*inside.shape, len(rows))
        linear = jnp.where(inside[..., None, None], (rows @ of_samples.linear)[:, None], 0.0)
        offset = jnp.where(inside[..., None], (of_samples.offset @ rows.T)[:, None], 0.0)
        deflections = AffineMap(
            linear.reshape(*shape[:2], -1, states + actuators), offset.reshape(*shape[:2], -1)
        )
        vehicles = initial_vehicle_states(loads)
        plant = jnp.zeros(states)
        if vehicles is not None:
            plant = plant.at[model.state_count :].set(vehicles[:, 0])
        return HeldMaps(whole, deflections), plant


def _key(seed) -> Any:
    """JAX key of a seed, or of a key of either form, as `jax.random.key` or `PRNGKey` make it."""
    seed = seed if hasattr(seed, "dtype") else np.asarray(seed)
    kind, shape = seed.dtype, seed.shape
    if jnp.issubdtype(kind, jax.dtypes.prng_key) and shape == ():
        return seed
    if kind == jnp.uint32 and shape == (2,):
        return jax.random.wrap_key_data(seed)
    if not jnp.issubdtype(kind, jnp.integer) or shape != ():
        raise ValueError(
            f"reset takes a seed, an integer, or one key of JAX; not an array of {kind} of the"
            f" shape {shape}"
        )
    return jax.random.key(seed)


def _advance(maps: HeldMaps, period, interval: int, plant, command):
    """State after an interval under a command (actuator, 1), and the largest deflection (m)."""
    column = jnp.concatenate([plant, command[:, 0]])
    of_states, of_deflections = (
        AffineMap(one.linear[period, interval], one.offset[period, interval]) for one in maps
    )
    deflections = of_deflections.linear @ column + of_deflections.offset
    after = of_states.linear @ column + of_states.offset
    return after, jnp.max(jnp.abs(deflections), initial=0.0)


def _check(case: Case) -> None:
    """Check that an environment can be made of a case. Raises ValueError if not."""
    controller = case.controller
    if controller is None or controller.period is None:
        raise ValueError(REFUSED.format("controller"))
    for i in limited_loops(case.actuators):
        raise ValueError(REFUSED.format(f"actuators.{i}.limits"))
    parts = {"controller": controller} | {f"sensors.{i}": s for i, s in enumerate(case.sensors)}
    for address, part in parts.items():
        if part.dropout is not None or part.jitter is not None:
            raise ValueError(REFUSED.format(address))
        if getattr(part, "has_feedthrough", False):
            raise ValueError(REFUSED.format(address))


def _periods(schedule: EventSchedule):
    """Events of the control samples, and starts of intervals and samples of each period."""
    control, age = np.asarray(schedule.control_sample), np.asarray(schedule.command_age)
    acts = (control >= 0) | (age >= 0) | (np.asarray(schedule.reading) >= 0).any(axis=1)
    controls = np.flatnonzero(control >= 0)
    samples = np.asarray(schedule.sample_events)
    by_period = [
        (np.flatnonzero(acts[a:b]) + a, samples[(samples > a) & (samples <= b)])
        for a, b in zip(controls[:-1], controls[1:], strict=True)
    ]
    most = max(len(starts) for starts, _ in by_period)
    starts = [np.append(s, np.full(most - len(s), -1)) for s, _ in by_period]
    return controls, np.array(starts), np.array([samples for _, samples in by_period])


def _next(starts, controls):
    """Event at which each interval ends: the start of the next one of its period, or the end."""
    following = np.append(starts[:, 1:], np.full((len(starts), 1), -1), axis=1)
    return np.where(following >= 0, following, controls[1:, None])
