"""Controllers tuned by gradients through the closed loop, and proven on cases held out."""

import dataclasses
import functools
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Float
from tqdm import tqdm

from jaxbeam.case import Case, replace
from jaxbeam.casefile import case_to_dict
from jaxbeam.compiling import compiled
from jaxbeam.simulate import ContactLossWarning
from tuning.bench import Bench, make_bench
from tuning.checkpoint import fingerprint, load, save
from tuning.free import Free, free_numbers
from tuning.load_cases import LoadCases
from tuning.objective import Objective
from tuning.proof import Outcome, Tuned
from tuning.stable import STEEP, Stable

RATE = 0.1  # first step of the search variables, each of which is of order one
SHARPNESS = (30.0, 1000.0)  # of smooth maxima, at the first step and the last
EVERY = 5  # steps between checkpoints
SHRINK = 0.5  # of the steps of a start that has come to a loop which diverges


def tune(
    case: Case,
    free: Mapping[str, tuple[float, float] | None],
    cases: LoadCases,
    objective: Objective | None = None,
    *,
    stable: Stable | None = None,
    places: Sequence[float] | None = None,
    steps: int = 80,
    starts: int = 1,
    seed: int = 0,
    bounds: bool = True,
    checkpoint: str | os.PathLike | None = None,
    resume: bool = False,
    progress: bool = True,
) -> Tuned:
    """Tune numbers of a controlled case over many runs; prove them on runs held out.

    `free` gives addresses, each with its bounds or None: gains and weights of the controller, but
    also filters' cutoffs or places of actuators and sensors. The runs of `cases` are simulated
    closed loop, limits included, side by side; Adam follows the gradient of the `objective`, whose
    maxima are smooth at first and ever sharper, for a number of `steps`, from the case's own
    numbers and from `starts` - 1 random ones at once. What is kept is the best that was met by the
    true objective, the start included. `places` (m) are where deflections count, the sensors' if
    left out. `stable` asks for a loop that stays stable along the crossings, with room to spare
    (what violates it is kept only where nothing met satisfies it, and the result says so). With
    `bounds` every run is also held against the least peak that is possible.

    With a `checkpoint` file the search can be stopped at any time, and taken up with `resume`: the
    result is the same. A step to where a loop diverges is taken back, and later ones are shorter.

    Raises ValueError for a faulty case, address, run or checkpoint, and if the case as it is
    diverges; FileExistsError if the checkpoint exists and `resume` is not set.
    """
    objective = Objective() if objective is None else objective
    if steps < 1 or starts < 1:
        raise ValueError(f"steps and starts must be 1 or more; they are {steps} and {starts}")
    if "shortfall" in objective.weights and not bounds:
        raise ValueError("the shortfall is that behind the bounds: leave bounds on to tune for it")
    numbers = free_numbers([case], dict(free), 1.0)
    mark = fingerprint(
        {
            "case": case_to_dict(case),
            "free": {n.address: [n.low, n.high] for n in numbers},
            "cases": dataclasses.asdict(cases),
            "objective": dataclasses.asdict(objective),
            "stable": None if stable is None else dataclasses.asdict(stable),
            "settings": [places, steps, starts, seed],
        }
    )
    file = None if checkpoint is None else Path(checkpoint)
    if file is not None and file.exists() and not resume:
        raise FileExistsError(f"{file} exists; resume the search, or name another file")
    bench = make_bench(case, cases.training, places, bounds)
    violation = None if stable is None else stable.violation(bench.cases)
    search = _Search(bench, numbers, objective, violation, steps)
    state = search.first(starts, seed)
    if not np.isfinite(state.best_value[0]):
        raise ValueError("the loop diverges as it is: start from a controller that does not")
    if file is not None and file.exists():
        state = search.rebuilt(state, load(file, mark))
    with tqdm(total=steps, initial=state.step, desc="tuning", disable=not progress) as bar:
        while state.step < steps:
            state = search.next(state)
            bar.update()
            bar.set_postfix_str(f"objective {state.best_value.min():.4g}")
            if file is not None and (state.step % EVERY == 0 or state.step == steps):
                save(file, mark, state.arrays())
    best = state.best[np.argmin(state.best_value)]
    values = np.array(
        [float(n.outward(jnp.asarray(y))) for n, y in zip(numbers, best, strict=True)]
    )
    if np.array_equal(best, search.own):
        values = np.array([number.start for number in numbers])
    before = {number.address: number.start for number in numbers}
    after = dict(zip(before, map(float, values), strict=True))
    outcomes = []
    for name, runs in (("training", cases.training), ("held out", cases.held_out)):
        if runs:
            own = bench if name == "training" else make_bench(case, runs, places, bounds)
            outcomes.append(_outcome(name, own, objective, before, after))
    return Tuned(
        case=replace(case, after),
        numbers=numbers,
        values=values,
        objective=objective,
        history=state.history,
        rejected=int(state.rejected.sum()),
        outcomes=outcomes,
        violation=0.0 if violation is None else float(compiled(violation)(after)),
    )


@dataclasses.dataclass(frozen=True)
class _State:
    """Where a search has come to: each start at its search point, with the best it has met."""

    step: int
    point: Float[np.ndarray, "start free"]
    moments: list[np.ndarray]
    scale: Float[np.ndarray, " start"]
    best: Float[np.ndarray, "start free"]
    best_value: Float[np.ndarray, " start"]
    history: Float[np.ndarray, "step start"]
    rejected: Float[np.ndarray, " start"]

    def arrays(self) -> dict[str, np.ndarray]:
        """All of it as named arrays."""
        named = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        moments = {f"moment_{i}": part for i, part in enumerate(named.pop("moments"))}
        return {name: np.asarray(value) for name, value in named.items()} | moments


class _Search:
    """Steps of a search, compiled once for all starts."""

    def __init__(
        self, bench: Bench, numbers: list[Free], objective: Objective, violation, steps: int
    ):
        self.numbers, self.steps = numbers, steps
        self.own = np.array([number.inward(number.start) for number in numbers])
        self.adam = optax.adam(optax.cosine_decay_schedule(RATE, steps, alpha=0.05))

        def smooth_and_true(point, sharpness, bench):
            pairs = zip(numbers, point, strict=True)
            values = {n.address: n.outward(y) for n, y in pairs}
            found = bench.histories(values)
            # So steep that what violates it is never the best, unless everything does.
            price = 0.0 if violation is None else STEEP * violation(values)
            smooth, true = (
                objective.of_runs(objective.of_run(bench.judge(found, sharp)), sharp) + price
                for sharp in (sharpness, None)
            )
            return smooth, true

        @compiled
        def slope(points, sharpness, bench):
            single = jax.value_and_grad(smooth_and_true, has_aux=True)
            return jax.vmap(lambda point: single(point, sharpness, bench))(points)

        self._slope = functools.partial(slope, bench=bench)

        def onward(point, gradient, moments, scale):
            change, moments = self.adam.update(gradient, moments)
            return point + scale * change, moments

        self._onward = compiled(jax.vmap(onward))

    def first(self, starts: int, seed: int) -> _State:
        """The case's own numbers, and random ones within bounds or a factor of three."""
        rng = np.random.default_rng(seed)
        spread = [
            rng.uniform(-np.pi / 2, np.pi / 2, starts - 1)
            if np.isfinite(n.high - n.low)
            else n.inward(n.start) + np.log(3) * n.search_size * rng.uniform(-1, 1, starts - 1)
            for n in self.numbers
        ]
        point = np.concatenate([self.own[None], np.array(spread).reshape(len(self.own), -1).T])
        moments = jax.vmap(self.adam.init)(jnp.asarray(point))
        (_, true), _ = self._slope(jnp.asarray(point), jnp.asarray(SHARPNESS[0]))
        value = np.where(np.isfinite(true), true, np.inf)
        none = np.zeros(starts)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(moments)]
        return _State(0, point, leaves, none + 1, point, value, np.zeros((0, starts)), none)

    def next(self, state: _State) -> _State:
        """One step of every start; those that came to a diverging loop go back, and go slower."""
        share = state.step / max(self.steps - 1, 1)
        sharpness = SHARPNESS[0] * (SHARPNESS[1] / SHARPNESS[0]) ** share
        # An array: a plain number would be part of the program, compiled anew at every step.
        (_, true), gradient = self._slope(jnp.asarray(state.point), jnp.asarray(sharpness))
        gradient, true = np.asarray(gradient), np.asarray(true)
        sound = np.isfinite(true) & np.isfinite(gradient).all(axis=1)
        better = sound & (true < state.best_value)
        best = np.where(better[:, None], state.point, state.best)
        best_value = np.where(better, true, state.best_value)
        scale = np.where(sound, state.scale, SHRINK * state.scale)
        structure = jax.tree.structure(self.adam.init(jnp.asarray(state.point[0])))
        moments = jax.tree.unflatten(structure, list(state.moments))
        point, moments = self._onward(
            state.point, np.where(sound[:, None], gradient, 0.0), moments, scale
        )
        return _State(
            step=state.step + 1,
            point=np.where(sound[:, None], np.asarray(point), best),
            moments=[np.asarray(leaf) for leaf in jax.tree.leaves(moments)],
            scale=scale,
            best=best,
            best_value=best_value,
            history=np.concatenate([state.history, np.where(sound, true, np.nan)[None]]),
            rejected=state.rejected + ~sound,
        )

    def rebuilt(self, like: _State, arrays: dict[str, np.ndarray]) -> _State:
        """The state whose arrays were saved."""
        moments = [arrays.pop(f"moment_{i}") for i in range(len(like.moments))]
        step = int(arrays.pop("step"))
        return _State(step=step, moments=moments, **arrays)


@compiled
def _merits(bench: Bench, values):
    return bench.merits(values)


def _outcome(name, bench: Bench, objective, before, after) -> Outcome:
    """True peaks and merits of all runs, before and after, and the least peaks possible."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        pairs = [bench.records(values) for values in (before, after)]
    peaks = [_peaks(bench, records) for records in pairs]
    arrays = [jax.tree.map(jnp.asarray, values) for values in (before, after)]
    # What is compiled must not depend on what the runs are called.
    nameless = dataclasses.replace(bench, runs=())
    values = [np.asarray(objective.of_run(_merits(nameless, v))) for v in arrays]
    return Outcome(
        name=name,
        runs=tuple(bench.runs),
        uncontrolled=bench.free["peak"],
        before=peaks[0],
        after=peaks[1],
        least=bench.free["least"],
        values=np.stack(values),
        saturated=np.array([float(np.asarray(r.saturated).mean()) for r in pairs[1]]),
        objective=[float(objective.of_runs(jnp.asarray(v))) for v in values],
    )


def _peaks(bench: Bench, records) -> Float[np.ndarray, " run"]:
    """Largest deflection of each run: between samples at sensors, at samples elsewhere."""
    sensors = np.array([float(sensor.position) for sensor in bench.cases[0].sensors])
    if np.array_equal(sensors, np.asarray(bench.places)):
        return np.array([float(np.max(record.peak_deflection)) for record in records])
    return np.array([float(np.max(np.abs(record.at(bench.places)))) for record in records])
