"""Optimisation of an objective from several starts: the search and its methods.

All share the one program that simulates, and their evaluations are counted alike.

The state of all starts can be kept in a checkpoint after every few steps.
"""

import abc
import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import optimistix
from jaxtyping import Bool, Float

from jaxbeam.runtime.arrays import Array
from jaxbeam.runtime.compiling import compiled
from jaxbeam.runtime.progress import ProgressBar, found_so_far
from tuning.checkpoint import NO_CHECKPOINT, Checkpoint
from tuning.control.objective import Objective, WeightsAndLimits
from tuning.control.penalised_objective import PenalisedObjective, true_values, values_and_gradients
from tuning.control.run_set import RunSet
from tuning.parameters import FreeParameter, to_unbounded

METHODS = ("adam", "lbfgs", "bfgs")
ADAM_STEP = 0.1  # first step of Adam, in search variables, which are of order one
MAX_FIRST_STEP = 0.5  # longest first step of a line search, root mean square of the variables
BACKTRACKING_FACTOR = 0.5  # on a step that led to an unstable loop or decreased too little
SUFFICIENT_DECREASE = 1e-4  # fraction of the decrease predicted by the slope (Armijo condition)
SHARPNESS_STAGES = 5  # stages of sharper maxima, for methods whose curvatures jump with sharpness

Point = Float[Array, " parameter"]
Value = Float[Array, ""]
Flag = Bool[Array, ""]


class AbstractOptimiser(eqx.Module):
    """Interface: initial state and one step of a search from a single start."""

    @property
    @abc.abstractmethod
    def sharpness_stages(self) -> int | None:
        """Number of stages in which maxima get sharper; None if they do at every step."""

    @abc.abstractmethod
    def init(self, point: Point) -> Any:
        """State before the first step."""

    @abc.abstractmethod
    def step(
        self, previous, point: Point, value: Value, gradient: Point, objective_changed: Flag
    ) -> tuple[Point, Any]:
        """The next point to evaluate, and the state after the step.

        `value` is infinite, and the gradient zero, where the loop diverges. `objective_changed` is
        true if the objective has become sharper, so that earlier values do not compare.
        """


class AdamState(NamedTuple):
    """State of `Adam`: its moments, the last point with a finite value, and the scale of steps."""

    moments: Any
    last_finite: Point
    step_scale: Value


class Adam(AbstractOptimiser):
    """Adam (Kingma and Ba, 2015; optax) with steps that get shorter along a cosine.

    A step to a point where the loop diverges is taken back, and later ones are shorter.
    """

    steps: int

    @property
    def sharpness_stages(self):
        return None

    @property
    def transformation(self) -> optax.GradientTransformation:
        """The update rule of optax."""
        return optax.adam(optax.cosine_decay_schedule(ADAM_STEP, self.steps, alpha=0.05))

    def init(self, point):
        return AdamState(self.transformation.init(point), point, jnp.ones(()))

    def step(self, previous, point, value, gradient, objective_changed):
        finite = jnp.isfinite(value)
        scale = jnp.where(finite, previous.step_scale, BACKTRACKING_FACTOR * previous.step_scale)
        base = jnp.where(finite, point, previous.last_finite)
        change, moments = self.transformation.update(gradient, previous.moments)
        next_point = base + jnp.where(finite, scale, 0.0) * change
        return next_point, AdamState(moments, base, scale)


class LineSearchState(NamedTuple):
    """State of `LBFGS`: curvature pairs, and the line of the current line search."""

    curvature: Any
    origin: Point
    value: Value
    direction: Point
    directional_slope: Value
    step_length: Value


class LBFGS(AbstractOptimiser):
    """L-BFGS (Nocedal, 1980; optax) with a backtracking line search.

    Curvature pairs are dropped where the curvature is negative or the objective has changed.
    """

    transformation = optax.scale_by_lbfgs(memory_size=10)

    @property
    def sharpness_stages(self):
        return SHARPNESS_STAGES

    def init(self, point):
        zero = jnp.zeros(())
        return LineSearchState(
            self.transformation.init(point), point, zero + jnp.inf, 0 * point, zero, zero + 1.0
        )

    def step(self, previous, point, value, gradient, objective_changed):
        goal = (
            previous.value + SUFFICIENT_DECREASE * previous.step_length * previous.directional_slope
        )
        accepted = jnp.isfinite(value) & (objective_changed | (value <= goal))
        last = previous.curvature
        negative_curvature = jnp.vdot(point - last.params, gradient - last.updates) <= 0
        empty = self.transformation.init(point)
        usable = jax.tree.map(
            lambda new, old: jnp.where(objective_changed | negative_curvature, new, old),
            empty,
            last,
        )
        uphill, learnt = self.transformation.update(gradient, usable, point)
        size = jnp.linalg.norm(uphill) / (MAX_FIRST_STEP * jnp.sqrt(point.size))
        direction = -uphill / jnp.maximum(size, 1.0)
        next_line = LineSearchState(
            learnt, point, value, direction, jnp.vdot(direction, gradient), jnp.ones(())
        )
        halved = previous._replace(step_length=BACKTRACKING_FACTOR * previous.step_length)
        found = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), next_line, halved)
        return found.origin + found.step_length * found.direction, found


class OptimistixState(NamedTuple):
    """State of `Optimistix`: the point of its solver, and the arrays of the solver's state."""

    point: Point
    state: Any


class Optimistix(AbstractOptimiser):
    """A minimiser of optimistix that evaluates one point per step, such as BFGS.

    It is given the tangent plane at that point in place of the objective.
    """

    solver: optimistix.AbstractMinimiser

    @property
    def sharpness_stages(self):
        return SHARPNESS_STAGES

    def init(self, point):
        value = jax.ShapeDtypeStruct((), point.dtype)
        state = self.solver.init(_zero_function, point, None, {}, value, None, frozenset())
        return OptimistixState(point, eqx.filter(state, eqx.is_array))

    def step(self, previous, point, value, gradient, objective_changed):
        finite = jnp.isfinite(value)
        empty = self.init(point)
        restarts = objective_changed & finite
        previous = jax.tree.map(lambda new, old: jnp.where(restarts, new, old), empty, previous)
        value = jnp.where(finite, value, jnp.finfo(point.dtype).max / 4)

        def plane(asked, _):
            return value + jnp.vdot(gradient, asked - jax.lax.stop_gradient(asked)), None

        template = self.solver.init(_zero_function, point, None, {}, value, None, frozenset())
        state = eqx.combine(previous.state, eqx.filter(template, eqx.is_array, inverse=True))
        next_point, state, _ = self.solver.step(plane, previous.point, None, {}, state, frozenset())
        return state.y_eval, OptimistixState(next_point, eqx.filter(state, eqx.is_array))


def _zero_function(point, _):
    return jnp.zeros(()), None


def optimiser(name: str, steps: int) -> AbstractOptimiser:
    """Optimiser by name, for a number of steps. Raises ValueError for an unknown name."""
    if name not in METHODS:
        raise ValueError(f"a method is one of {', '.join(METHODS)}, not {name!r}")
    if name == "adam":
        return Adam(steps)
    return LBFGS() if name == "lbfgs" else Optimistix(optimistix.BFGS(rtol=1e-8, atol=1e-8))


SHARPNESS = (30.0, 1000.0)  # of smooth maxima, at the first step and at the last
SHARPENING_FRACTION = 0.7  # of the steps in which sharpness rises, for optimisers with stages
CHECKPOINT_STEPS = 5  # steps between checkpoints


@dataclasses.dataclass(frozen=True)
class OptimisationState:
    """State of a search: each start at its point (search variables), with the best so far.

    `optimiser_state` are the arrays of the optimiser's state; `history` the true objective by step
    and start, NaN where the loop diverged (with mini-batches, of the runs of that step);
    `rejected` counts these steps.
    """

    step: int
    point: Float[np.ndarray, "start parameter"]
    optimiser_state: list[np.ndarray]
    best: Float[np.ndarray, "start parameter"]
    best_value: Float[np.ndarray, " start"]
    history: Float[np.ndarray, "step start"]
    rejected: Float[np.ndarray, " start"]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """The state as named arrays."""
        named = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        parts = enumerate(named.pop("optimiser_state"))
        named |= {f"optimiser_state_{i}": part for i, part in parts}
        return {name: np.asarray(value) for name, value in named.items()}

    def restored(self, arrays: dict[str, np.ndarray]) -> "OptimisationState":
        """The state whose arrays were saved, of the same optimiser as this one."""
        names = [f"optimiser_state_{i}" for i in range(len(self.optimiser_state))]
        others = {name: value for name, value in arrays.items() if name not in names}
        others["step"] = int(others["step"])
        return OptimisationState(optimiser_state=[arrays[name] for name in names], **others)


def _without_start(parameter: FreeParameter) -> FreeParameter:
    """The parameter without its start, so that searches from other starts use the same program."""
    return dataclasses.replace(parameter, start=0.0, typical_size=1.0)


@compiled
def _initial_optimiser_states(method: AbstractOptimiser, points):
    return jax.vmap(method.init)(points)


@compiled
def _optimiser_steps(method: AbstractOptimiser, states, points, values, gradients, changed):
    def single(state, point, value, gradient):
        return method.step(state, point, value, gradient, changed)

    return jax.vmap(single)(states, points, values, gradients)


class Optimisation:
    """Searches over the free parameters of a run set; compiled once for all targets and starts.

    `penalty` is added to the objective, as a function of values by address. With a `batch` each
    step simulates so many of the runs only, drawn by the seed, and all runs are simulated once in
    an epoch.
    """

    def __init__(
        self,
        run_set: RunSet,
        parameters: list[FreeParameter],
        objective: Objective,
        penalty: Callable | None = None,
        method: str = "adam",
        steps: int = 80,
        batch: int | None = None,
    ):
        self.parameters, self.steps, self.batch = parameters, steps, batch
        self.method = optimiser(method, steps)
        self.start_point = to_unbounded(parameters, [p.start for p in parameters])
        self.run_count = len(run_set.runs)
        # Compiled programs must not depend on the names of the runs. A least peak that is not
        # computed has no weight, but NaN would spoil the gradient.
        least = np.nan_to_num(run_set.uncontrolled["least"])
        uncontrolled = run_set.uncontrolled | {"least": least}
        self.run_set = dataclasses.replace(run_set, runs=(), uncontrolled=uncontrolled)
        self.objective = PenalisedObjective(
            parameters=tuple(map(_without_start, parameters)),
            aggregation=objective.aggregation,
            tail_share=objective.tail_share,
            penalty=penalty,
        )

    def start_points(
        self, starts: int, seed: int, start_point=None
    ) -> Float[np.ndarray, "start parameter"]:
        """Start points: `start_point` (the case's own if left out), then random ones.

        Random ones are within bounds, or a factor of 3 of the first.
        """
        start_point = self.start_point if start_point is None else start_point
        rng = np.random.default_rng(seed)
        spread = [
            rng.uniform(-np.pi / 2, np.pi / 2, starts - 1)
            if np.isfinite(p.high - p.low)
            else p.to_unbounded(p.start)
            + np.log(3) * p.unbounded_size * rng.uniform(-1, 1, starts - 1)
            for p in self.parameters
        ]
        return np.concatenate([start_point[None], np.array(spread).reshape(len(start_point), -1).T])

    def compile(
        self, target: WeightsAndLimits, points: Float[np.ndarray, "start parameter"]
    ) -> None:
        """Compile the program of the steps, before the first step needs it."""
        arguments = self._step_arguments(points, SHARPNESS[0], self._batch_runs(0, 0), target)
        values_and_gradients.precompile(*arguments)()

    def run(
        self,
        target: WeightsAndLimits,
        points: Float[np.ndarray, "start parameter"],
        seed: int = 0,
        *,
        checkpoint: Checkpoint = NO_CHECKPOINT,
        progress: bool = False,
    ) -> OptimisationState:
        """State after all steps from some points; a checkpoint that exists is continued.

        Raises ValueError if the loop is unstable at the first point, or for a checkpoint of another
        search.
        """
        state = self._initial_state(target, points)
        if not np.isfinite(state.best_value[0]):
            raise ValueError(
                "the closed loop is unstable with the start values: start from a stabilising "
                "controller"
            )
        kept = checkpoint.load()
        if kept is not None:
            state = state.restored(kept)
        total = self.steps
        bar = ProgressBar(total, "step", shown=progress, initial=state.step, desc="tuning")
        with bar:
            while state.step < total:
                state = self._step(state, target, seed)
                found_so_far((state.history, self.best_values(state)))
                bar.update()
                bar.set_postfix_str(f"objective {state.best_value.min():.4g}")
                if state.step % CHECKPOINT_STEPS == 0 or state.step == total:
                    checkpoint.save(state.to_arrays())
        return state

    def best_values(
        self, state: OptimisationState, start: int | None = None
    ) -> Float[np.ndarray, " parameter"]:
        """Values of the free parameters at the best point, of one start or of all."""
        best = state.best[np.argmin(state.best_value) if start is None else start]
        if np.array_equal(best, self.start_point):
            return np.array([parameter.start for parameter in self.parameters])
        pairs = zip(self.parameters, best, strict=True)
        return np.array([float(p.from_unbounded(jnp.asarray(y))) for p, y in pairs])

    def _step_arguments(self, points, sharpness: float, run_indices, target) -> tuple:
        """Arguments of `values_and_gradients`.

        Arrays: plain numbers would be part of the program, compiled anew at every step.
        """
        arrays = jnp.asarray(points), jnp.asarray(sharpness), jnp.asarray(run_indices)
        return self.objective, self.batch is not None, self.run_set, *arrays, target

    def _initial_state(self, target, points) -> OptimisationState:
        value = self._all_run_values(points, target)
        value = np.where(np.isfinite(value), value, np.inf)
        leaves = jax.tree.leaves(_initial_optimiser_states(self.method, jnp.asarray(points)))
        none = np.zeros(len(points))
        return OptimisationState(
            step=0,
            point=points,
            optimiser_state=[np.asarray(leaf) for leaf in leaves],
            best=points,
            best_value=value,
            history=np.zeros((0, len(points))),
            rejected=none,
        )

    def _step(self, state: OptimisationState, target, seed: int) -> OptimisationState:
        """The state after one more step of every start."""
        sharpness, objective_changed = self._sharpness(state.step)
        run_indices = self._batch_runs(state.step, seed)
        arguments = self._step_arguments(state.point, sharpness, run_indices, target)
        (value, true), gradient = values_and_gradients(*arguments)
        value, true, gradient = np.asarray(value), np.asarray(true), np.asarray(gradient)
        finite = np.isfinite(true) & np.isfinite(value) & np.isfinite(gradient).all(axis=1)
        best, best_value = state.best, state.best_value
        if self._compares_with_best(state.step):
            all_runs = true if self.batch is None else self._all_run_values(state.point, target)
            better = finite & np.isfinite(all_runs) & (all_runs < best_value)
            best = np.where(better[:, None], state.point, best)
            best_value = np.where(better, all_runs, best_value)
        points = jnp.asarray(state.point)
        structure = jax.tree.structure(_initial_optimiser_states(self.method, points))
        found: Any = _optimiser_steps(
            self.method,
            jax.tree.unflatten(structure, [jnp.asarray(part) for part in state.optimiser_state]),
            points,
            jnp.asarray(np.where(finite, value, np.inf)),
            jnp.asarray(np.where(finite[:, None], gradient, 0.0)),
            jnp.asarray(objective_changed),
        )
        next_points, optimiser_state = found
        return OptimisationState(
            step=state.step + 1,
            point=np.asarray(next_points),
            optimiser_state=[np.asarray(leaf) for leaf in jax.tree.leaves(optimiser_state)],
            best=best,
            best_value=best_value,
            history=np.concatenate([state.history, np.where(finite, true, np.nan)[None]]),
            rejected=state.rejected + ~finite,
        )

    def _all_run_values(self, points, target) -> Float[np.ndarray, " start"]:
        """True objective of all runs at some points."""
        if self.batch is not None:
            values = true_values(self.objective, self.run_set, jnp.asarray(points), target)
            return np.asarray(values)
        # By the program of the steps, which is compiled anyway.
        all_runs = np.arange(self.run_count)
        arguments = self._step_arguments(points, SHARPNESS[0], all_runs, target)
        return np.asarray(values_and_gradients(*arguments)[0][1])

    def _sharpness(self, step: int) -> tuple[float, bool]:
        """Sharpness of smooth maxima at a step, and whether it has changed with the step."""
        low, high = SHARPNESS
        staged = self.method.sharpness_stages is not None
        rising = max(round(SHARPENING_FRACTION * self.steps), 1) if staged else self.steps
        stages = min(self.method.sharpness_stages or rising, rising)
        stage, before = (min(stages * k // rising, stages - 1) for k in (step, step - 1))
        share = stage / max(stages - 1, 1)
        return low * (high / low) ** share, step == 0 or stage > before

    def _batch_runs(self, step: int, seed: int) -> np.ndarray:
        """Indices of the runs that a step simulates."""
        if self.batch is None:
            return np.arange(self.run_count)
        return np.random.default_rng([seed, step]).choice(self.run_count, self.batch, replace=False)

    def _compares_with_best(self, step: int) -> bool:
        """Whether a step compares its point with the best: with mini-batches, once in an epoch."""
        if self.batch is None:
            return True
        epoch = -(-self.run_count // self.batch)
        return (step + 1) % epoch == 0 or step == self.steps - 1
