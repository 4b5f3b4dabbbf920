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
from tuning.control.objective import Objective, Target
from tuning.control.optimisers import method_of
from tuning.control.run_set import Bench
from tuning.parameters.free import Free

SHARPNESS = (30.0, 1000.0)  # of smooth maxima, at the first step and the last
SETTLED = 0.7  # share of the steps in which sharpness rises, for methods with stages of it
EVERY = 5  # steps between checkpoints
FEW = 4  # free numbers up to which slopes are found forward, which takes less time to compile


@dataclasses.dataclass(frozen=True)
class State:
    """Where a search has come to: each start at its search point, with the best it has met.

    `memory` are the leaves of what its method remembers; `history` are true values of the
    objective, NaN where a loop diverged (with mini-batches, of the runs of that step).
    """

    step: int
    point: Float[np.ndarray, "start free"]
    memory: list[np.ndarray]
    best: Float[np.ndarray, "start free"]
    best_value: Float[np.ndarray, " start"]
    history: Float[np.ndarray, "step start"]
    rejected: Float[np.ndarray, " start"]

    def arrays(self) -> dict[str, np.ndarray]:
        """All of it as named arrays."""
        named = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        memory = {f"memory_{i}": part for i, part in enumerate(named.pop("memory"))}
        return {name: np.asarray(value) for name, value in named.items()} | memory


@dataclasses.dataclass(frozen=True)
class Form:
    """What programs are compiled for: how numbers are mapped, how runs are taken together."""

    numbers: tuple[Free, ...]
    over: str
    share: float
    price: Callable | None

    def judge(self, point, bench: Bench, target: Target, *sharpnesses):
        """The price of a point, once for each sharpness of maxima."""
        pairs = zip(self.numbers, point, strict=True)
        values = {number.address: number.outward(y) for number, y in pairs}
        found = bench.histories(values)
        price = 0.0 if self.price is None else self.price(values)
        own = Objective(over=self.over, share=self.share)
        return tuple(
            own.with_price(bench.judge(found, sharp), target, sharp) + price
            for sharp in sharpnesses
        )


def _shape_of(number: Free) -> Free:
    """A free number without its start: searches from other starts share what is compiled."""
    return dataclasses.replace(number, start=0.0, size=1.0)


@compiled
def _slope(form: Form, some: bool, bench: Bench, points, sharpness, rows, target):
    """Values, smooth and true, with slopes of the smooth ones, of all or some runs."""
    bench = bench.at(rows) if some else bench

    def judge(point):
        return form.judge(point, bench, target, sharpness, None)

    def forward(point):
        def along(way):
            return jax.jvp(judge, (point,), (way,), has_aux=True)

        value, slope, true = jax.vmap(along, out_axes=(None, 0, None))(jnp.eye(point.size))
        return (value, true), slope

    few = points.shape[1] <= FEW
    return jax.vmap(forward if few else jax.value_and_grad(judge, has_aux=True))(points)


@compiled
def _true(form: Form, bench: Bench, points, target):
    return jax.vmap(lambda point: form.judge(point, bench, target, None)[0])(points)


class Descent:
    """Searches over free numbers on a bench; compiled once for all targets and starts.

    `price` is added to the objective, as a function of values by address. With `batch` each step
    looks at so many of the runs only, drawn by the seed, and all runs are judged once in a while.
    """

    def __init__(
        self,
        bench: Bench,
        numbers: list[Free],
        objective: Objective,
        price: Callable | None = None,
        method: str = "adam",
        steps: int = 80,
        batch: int | None = None,
    ):
        self.numbers, self.steps, self.batch = numbers, steps, batch
        self.method = method_of(method, steps)
        self.own = np.array([number.inward(number.start) for number in numbers])
        self.runs = len(bench.runs)
        # Nameless: what is compiled must not depend on what the runs are called. A least peak that
        # is not known counts nowhere, but NaN would spoil the slope.
        least = np.nan_to_num(bench.free["least"])
        bench = dataclasses.replace(bench, runs=(), free=bench.free | {"least": least})

        form = Form(tuple(map(_shape_of, numbers)), objective.over, objective.share, price)
        self._given = form, batch is not None, bench
        self._true = functools.partial(_true, form, bench)
        own = self.method
        self._init = compiled(lambda points: jax.vmap(own.init)(points))

        @compiled
        def onward(memory, points, values, slopes, fresh):
            def one(memory, point, value, slope):
                return own.next(memory, point, value, slope, fresh)

            return jax.vmap(one)(memory, points, values, slopes)

        self._next = onward

    def points(self, starts: int, seed: int, own=None) -> Float[np.ndarray, "start free"]:
        """A point (the case's own), and random ones within bounds or a factor of three."""
        own = self.own if own is None else own
        rng = np.random.default_rng(seed)
        spread = [
            rng.uniform(-np.pi / 2, np.pi / 2, starts - 1)
            if np.isfinite(n.high - n.low)
            else n.inward(n.start) + np.log(3) * n.search_size * rng.uniform(-1, 1, starts - 1)
            for n in self.numbers
        ]
        return np.concatenate([own[None], np.array(spread).reshape(len(own), -1).T])

    def compile(self, target: Target, points: Float[np.ndarray, "start free"]) -> None:
        """Compile the program of every step, of whose results nothing is wanted yet."""
        rows = jnp.asarray(self._rows(0, 0))
        _slope.ahead(*self._given, jnp.asarray(points), jnp.asarray(SHARPNESS[0]), rows, target)()

    def run(
        self,
        target: Target,
        points: Float[np.ndarray, "start free"],
        seed: int = 0,
        *,
        file: Path | None = None,
        mark: str = "",
        progress: bool = False,
    ) -> State:
        """Search from some points for all steps; a `file` keeps the state, and is gone on with.

        Raises ValueError if the loop diverges at the first point, or for a foreign file.
        """
        state = self._first(target, points)
        if not np.isfinite(state.best_value[0]):
            raise ValueError("the loop diverges as it is: start from a controller that does not")
        if file is not None and file.exists():
            state = _rebuilt(state, load(file, mark))
        total = self.steps
        with tqdm(total=total, initial=state.step, desc="tuning", disable=not progress) as bar:
            while state.step < total:
                state = self._onward(state, target, seed)
                bar.update()
                bar.set_postfix_str(f"objective {state.best_value.min():.4g}")
                if file is not None and (state.step % EVERY == 0 or state.step == total):
                    save(file, mark, state.arrays())
        return state

    def values(self, state: State, start: int | None = None) -> Float[np.ndarray, " free"]:
        """Values of the free numbers at the best point met, by one start or by all."""
        best = state.best[np.argmin(state.best_value) if start is None else start]
        if np.array_equal(best, self.own):
            return np.array([number.start for number in self.numbers])
        pairs = zip(self.numbers, best, strict=True)
        return np.array([float(n.outward(jnp.asarray(y))) for n, y in pairs])

    def _first(self, target, points) -> State:
        value = self._whole(points, target)
        value = np.where(np.isfinite(value), value, np.inf)
        memory = [np.asarray(leaf) for leaf in jax.tree.leaves(self._init(jnp.asarray(points)))]
        starts = len(points)
        none = np.zeros(starts)
        return State(0, points, memory, points, value, np.zeros((0, starts)), none)

    def _onward(self, state: State, target, seed: int) -> State:
        """One step of every start."""
        sharpness, fresh = self._sharpness(state.step)
        rows = self._rows(state.step, seed)
        # Arrays: plain numbers would be part of the program, compiled anew at every step.
        (value, true), slope = _slope(
            *self._given,
            jnp.asarray(state.point),
            jnp.asarray(sharpness),
            jnp.asarray(rows),
            target,
        )
        value, true, slope = np.asarray(value), np.asarray(true), np.asarray(slope)
        sound = np.isfinite(true) & np.isfinite(value) & np.isfinite(slope).all(axis=1)
        best, best_value = state.best, state.best_value
        if self._judges(state.step):
            whole = true if self.batch is None else self._whole(state.point, target)
            better = sound & np.isfinite(whole) & (whole < best_value)
            best = np.where(better[:, None], state.point, best)
            best_value = np.where(better, whole, best_value)
        structure = jax.tree.structure(self._init(jnp.asarray(state.point)))
        found: Any = self._next(
            jax.tree.unflatten(structure, [jnp.asarray(part) for part in state.memory]),
            jnp.asarray(state.point),
            jnp.asarray(np.where(sound, value, np.inf)),
            jnp.asarray(np.where(sound[:, None], slope, 0.0)),
            jnp.asarray(fresh),
        )
        point, memory = found
        return State(
            step=state.step + 1,
            point=np.asarray(point),
            memory=[np.asarray(leaf) for leaf in jax.tree.leaves(memory)],
            best=best,
            best_value=best_value,
            history=np.concatenate([state.history, np.where(sound, true, np.nan)[None]]),
            rejected=state.rejected + ~sound,
        )

    def _whole(self, points, target) -> Float[np.ndarray, " start"]:
        """True values at some points, of all runs."""
        if self.batch is not None:
            return np.asarray(self._true(jnp.asarray(points), target))
        # By the program that steps need anyway.
        sharpness, rows = jnp.asarray(SHARPNESS[0]), jnp.arange(self.runs)
        found = _slope(*self._given, jnp.asarray(points), sharpness, rows, target)
        return np.asarray(found[0][1])

    def _sharpness(self, step: int) -> tuple[float, bool]:
        """How sharp maxima are at a step, and whether they have become so with it."""
        low, high = SHARPNESS
        staged = self.method.stages is not None
        rising = max(round(SETTLED * self.steps), 1) if staged else self.steps
        stages = min(self.method.stages or rising, rising)
        stage, before = (min(stages * k // rising, stages - 1) for k in (step, step - 1))
        share = stage / max(stages - 1, 1)
        return low * (high / low) ** share, step == 0 or stage > before

    def _rows(self, step: int, seed: int) -> np.ndarray:
        """Which runs a step looks at."""
        if self.batch is None:
            return np.arange(self.runs)
        return np.random.default_rng([seed, step]).choice(self.runs, self.batch, replace=False)

    def _judges(self, step: int) -> bool:
        """Whether the point of a step is held against the best: with batches, once in an epoch."""
        if self.batch is None:
            return True
        epoch = -(-self.runs // self.batch)
        return (step + 1) % epoch == 0 or step == self.steps - 1


def _rebuilt(like: State, arrays: dict[str, np.ndarray]) -> State:
    """The state whose arrays were saved."""
    memory = [arrays.pop(f"memory_{i}") for i in range(len(like.memory))]
    step = int(arrays.pop("step"))
    return State(step=step, memory=memory, **arrays)
