"""The search of a tuning: all starts go downhill side by side, and it can be stopped any time."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from jaxbeam.runtime.compiling import compiled
from tuning.checkpoint import load, save
from tuning.control.objective import Objective, WeightsAndLimits
from tuning.control.optimisers import optimiser
from tuning.control.run_set import RunSet
from tuning.parameters.free import FreeParameter

SHARPNESS = (30.0, 1000.0)  # of smooth maxima, at the first step and the last
SHARPENING_SHARE = 0.7  # share of the steps in which sharpness rises, for methods with stages of it
CHECKPOINT_STEPS = 5  # steps between checkpoints
MAX_FORWARD_PARAMETERS = (
    4  # free numbers up to which slopes are found forward, which takes less time to compile
)


@dataclasses.dataclass(frozen=True)
class OptimisationState:
    """Where a search has come to: each start at its search point, with the best it has met.

    `optimiser_state` are the leaves of what its method remembers; `history` are true values of the
    objective, NaN where a loop diverged (with mini-batches, of the runs of that step).
    """

    step: int
    point: Float[np.ndarray, "start free"]
    optimiser_state: list[np.ndarray]
    best: Float[np.ndarray, "start free"]
    best_value: Float[np.ndarray, " start"]
    history: Float[np.ndarray, "step start"]
    rejected: Float[np.ndarray, " start"]

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All of it as named arrays."""
        named = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        memory = {f"memory_{i}": part for i, part in enumerate(named.pop("memory"))}
        return {name: np.asarray(value) for name, value in named.items()} | memory


@dataclasses.dataclass(frozen=True)
class PenalisedObjective:
    """What programs are compiled for: how numbers are mapped, how runs are taken together."""

    parameters: tuple[FreeParameter, ...]
    aggregation: str
    tail_share: float
    penalty: Callable | None

    def evaluate(self, point, run_set: RunSet, target: WeightsAndLimits, *sharpnesses):
        """The price of a point, once for each sharpness of maxima."""
        pairs = zip(self.parameters, point, strict=True)
        values = {number.address: number.from_unbounded(y) for number, y in pairs}
        found = run_set.histories(values)
        penalty = 0.0 if self.penalty is None else self.penalty(values)
        own = Objective(aggregation=self.aggregation, tail_share=self.tail_share)
        return tuple(
            own.penalised(run_set.merits_of(found, sharp), target, sharp) + penalty
            for sharp in sharpnesses
        )


def _without_start(number: FreeParameter) -> FreeParameter:
    """A free number without its start: searches from other starts share what is compiled."""
    return dataclasses.replace(number, start=0.0, size=1.0)


@compiled
def _values_and_gradients(
    objective: PenalisedObjective,
    in_batches: bool,
    run_set: RunSet,
    points,
    sharpness,
    run_indices,
    target,
):
    """Values, smooth and true, with slopes of the smooth ones, of all or some runs."""
    run_set = run_set.subset(run_indices) if in_batches else run_set

    def judge(point):
        return objective.evaluate(point, run_set, target, sharpness, None)

    def forward(point):
        def along(way):
            return jax.jvp(judge, (point,), (way,), has_aux=True)

        value, slope, true = jax.vmap(along, out_axes=(None, 0, None))(jnp.eye(point.size))
        return (value, true), slope

    few = points.shape[1] <= MAX_FORWARD_PARAMETERS
    return jax.vmap(forward if few else jax.value_and_grad(judge, has_aux=True))(points)


@compiled
def _true_values(objective: PenalisedObjective, run_set: RunSet, points, target):
    return jax.vmap(lambda point: objective.evaluate(point, run_set, target, None)[0])(points)


class Optimisation:
    """Searches over free numbers on a bench; compiled once for all targets and starts.

    `price` is added to the objective, as a function of values by address. With `batch` each step
    looks at so many of the runs only, drawn by the seed, and all runs are judged once in a while.
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
        self.start_point = np.array([number.to_unbounded(number.start) for number in parameters])
        self.run_count = len(run_set.runs)
        # Nameless: what is compiled must not depend on what the runs are called. A least peak that
        # is not known counts nowhere, but NaN would spoil the slope.
        least = np.nan_to_num(run_set.uncontrolled["least"])
        run_set = dataclasses.replace(
            run_set, runs=(), free=run_set.uncontrolled | {"least": least}
        )

        penalised = PenalisedObjective(
            tuple(map(_without_start, parameters)),
            objective.aggregation,
            objective.tail_share,
            penalty,
        )
        self._program_arguments = penalised, batch is not None, run_set
        self._evaluate_true = functools.partial(_true_values, penalised, run_set)
        own = self.method
        self._init_method = compiled(lambda points: jax.vmap(own.init)(points))

        @compiled
        def method_step(memory, points, values, slopes, fresh):
            def one(memory, point, value, slope):
                return own.step(memory, point, value, slope, fresh)

            return jax.vmap(one)(memory, points, values, slopes)

        self._step_method = method_step

    def start_points(
        self, starts: int, seed: int, start_point=None
    ) -> Float[np.ndarray, "start free"]:
        """A point (the case's own), and random ones within bounds or a factor of three."""
        start_point = self.start_point if start_point is None else start_point
        rng = np.random.default_rng(seed)
        spread = [
            rng.uniform(-np.pi / 2, np.pi / 2, starts - 1)
            if np.isfinite(n.high - n.low)
            else n.to_unbounded(n.start)
            + np.log(3) * n.unbounded_size * rng.uniform(-1, 1, starts - 1)
            for n in self.parameters
        ]
        return np.concatenate([start_point[None], np.array(spread).reshape(len(start_point), -1).T])

    def compile(self, target: WeightsAndLimits, points: Float[np.ndarray, "start free"]) -> None:
        """Compile the program of every step, of whose results nothing is wanted yet."""
        rows = jnp.asarray(self._batch_runs(0, 0))
        _values_and_gradients.precompile(
            *self._program_arguments, jnp.asarray(points), jnp.asarray(SHARPNESS[0]), rows, target
        )()

    def run(
        self,
        target: WeightsAndLimits,
        points: Float[np.ndarray, "start free"],
        seed: int = 0,
        *,
        file: Path | None = None,
        digest: str = "",
        progress: bool = False,
    ) -> OptimisationState:
        """Search from some points for all steps; a `file` keeps the state, and is gone on with.

        Raises ValueError if the loop diverges at the first point, or for a foreign file.
        """
        state = self._initial_state(target, points)
        if not np.isfinite(state.best_value[0]):
            raise ValueError("the loop diverges as it is: start from a controller that does not")
        if file is not None and file.exists():
            state = _restored_state(state, load(file, digest))
        total = self.steps
        with tqdm(total=total, initial=state.step, desc="tuning", disable=not progress) as bar:
            while state.step < total:
                state = self._step(state, target, seed)
                bar.update()
                bar.set_postfix_str(f"objective {state.best_value.min():.4g}")
                if file is not None and (state.step % CHECKPOINT_STEPS == 0 or state.step == total):
                    save(file, digest, state.to_arrays())
        return state

    def best_values(
        self, state: OptimisationState, start: int | None = None
    ) -> Float[np.ndarray, " free"]:
        """Values of the free numbers at the best point met, by one start or by all."""
        best = state.best[np.argmin(state.best_value) if start is None else start]
        if np.array_equal(best, self.start_point):
            return np.array([number.start for number in self.parameters])
        pairs = zip(self.parameters, best, strict=True)
        return np.array([float(n.from_unbounded(jnp.asarray(y))) for n, y in pairs])

    def _initial_state(self, target, points) -> OptimisationState:
        value = self._all_run_values(points, target)
        value = np.where(np.isfinite(value), value, np.inf)
        memory = [
            np.asarray(leaf) for leaf in jax.tree.leaves(self._init_method(jnp.asarray(points)))
        ]
        starts = len(points)
        none = np.zeros(starts)
        return OptimisationState(0, points, memory, points, value, np.zeros((0, starts)), none)

    def _step(self, state: OptimisationState, target, seed: int) -> OptimisationState:
        """One step of every start."""
        sharpness, fresh = self._sharpness(state.step)
        rows = self._batch_runs(state.step, seed)
        # Arrays: plain numbers would be part of the program, compiled anew at every step.
        (value, true), slope = _values_and_gradients(
            *self._program_arguments,
            jnp.asarray(state.point),
            jnp.asarray(sharpness),
            jnp.asarray(rows),
            target,
        )
        value, true, slope = np.asarray(value), np.asarray(true), np.asarray(slope)
        finite = np.isfinite(true) & np.isfinite(value) & np.isfinite(slope).all(axis=1)
        best, best_value = state.best, state.best_value
        if self._compares_with_best(state.step):
            all_runs = true if self.batch is None else self._all_run_values(state.point, target)
            better = finite & np.isfinite(all_runs) & (all_runs < best_value)
            best = np.where(better[:, None], state.point, best)
            best_value = np.where(better, all_runs, best_value)
        structure = jax.tree.structure(self._init_method(jnp.asarray(state.point)))
        found: Any = self._step_method(
            jax.tree.unflatten(structure, [jnp.asarray(part) for part in state.optimiser_state]),
            jnp.asarray(state.point),
            jnp.asarray(np.where(finite, value, np.inf)),
            jnp.asarray(np.where(finite[:, None], slope, 0.0)),
            jnp.asarray(fresh),
        )
        point, memory = found
        return OptimisationState(
            step=state.step + 1,
            point=np.asarray(point),
            optimiser_state=[np.asarray(leaf) for leaf in jax.tree.leaves(memory)],
            best=best,
            best_value=best_value,
            history=np.concatenate([state.history, np.where(finite, true, np.nan)[None]]),
            rejected=state.rejected + ~finite,
        )

    def _all_run_values(self, points, target) -> Float[np.ndarray, " start"]:
        """True values at some points, of all runs."""
        if self.batch is not None:
            return np.asarray(self._evaluate_true(jnp.asarray(points), target))
        # By the program that steps need anyway.
        sharpness, rows = jnp.asarray(SHARPNESS[0]), jnp.arange(self.run_count)
        found = _values_and_gradients(
            *self._program_arguments, jnp.asarray(points), sharpness, rows, target
        )
        return np.asarray(found[0][1])

    def _sharpness(self, step: int) -> tuple[float, bool]:
        """How sharp maxima are at a step, and whether they have become so with it."""
        low, high = SHARPNESS
        staged = self.method.sharpness_stages is not None
        rising = max(round(SHARPENING_SHARE * self.steps), 1) if staged else self.steps
        stages = min(self.method.sharpness_stages or rising, rising)
        stage, before = (min(stages * k // rising, stages - 1) for k in (step, step - 1))
        share = stage / max(stages - 1, 1)
        return low * (high / low) ** share, step == 0 or stage > before

    def _batch_runs(self, step: int, seed: int) -> np.ndarray:
        """Which runs a step looks at."""
        if self.batch is None:
            return np.arange(self.run_count)
        return np.random.default_rng([seed, step]).choice(self.run_count, self.batch, replace=False)

    def _compares_with_best(self, step: int) -> bool:
        """Whether the point of a step is held against the best: with batches, once in an epoch."""
        if self.batch is None:
            return True
        epoch = -(-self.run_count // self.batch)
        return (step + 1) % epoch == 0 or step == self.steps - 1


def _restored_state(like: OptimisationState, arrays: dict[str, np.ndarray]) -> OptimisationState:
    """The state whose arrays were saved."""
    memory = [arrays.pop(f"memory_{i}") for i in range(len(like.optimiser_state))]
    step = int(arrays.pop("step"))
    return OptimisationState(step=step, optimiser_state=memory, **arrays)
