"""Multi-objective tuning: Pareto front (epsilon-constraint method) and lexicographic order.

Integer parameters of a controller, such as horizons: the case is tuned with each choice.

Reduced-order feedback: the states to feed back, selected by a search over relaxed shares.
"""

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, addresses
from jaxbeam.case.fields import refuses_traced
from jaxbeam.control.lqr import LQR
from jaxbeam.files.case_file import with_settings
from jaxbeam.runtime.printer import text_table
from tuning.control.objective import Objective
from tuning.control.penalised_objective import StabilityConstraint
from tuning.control.run_set import LoadCases
from tuning.control.tune import ParameterBounds, TuningProblem, check_arguments, tune
from tuning.control.tuning_result import TuningResult


@dataclasses.dataclass(frozen=True, eq=False)
class ParetoFront:
    """Tunings for one objective under ever tighter limits on one metric, loosest first."""

    metric: str
    limits: tuple[float, ...]
    tuned: tuple[TuningResult, ...]

    def points(self, held_out: bool = False) -> np.ndarray:
        """Metric and objective for each limit (limit, 2), on training or held-out runs."""
        run_sets = [found.run_sets[-1 if held_out else 0] for found in self.tuned]
        return np.array([[one.metrics[self.metric], one.objective[1]] for one in run_sets])

    def __str__(self) -> str:
        columns = ("limit", self.metric, "objective")
        header = (*columns, f"{self.metric} held out", "objective held out")
        points = zip(self.limits, self.points(), self.points(held_out=True), strict=True)
        rows = [
            [f"{x:.5g}" for x in (limit, *training, *held_out)]
            for limit, training, held_out in points
        ]
        return "\n".join(text_table(header, rows, ">" * len(header)))

    def plot(self):
        """Figure of the front, on training and on held-out runs."""
        from jaxbeam.plot import plot_pareto_front

        kinds = {found.name: found.name == "held out" for found in self.tuned[0].run_sets}
        lines = {name: self.points(held_out) for name, held_out in kinds.items()}
        return plot_pareto_front(lines, self.metric, title=self.tuned[0].case.title)


@refuses_traced("a tuning")
def pareto(
    case: Case,
    free: ParameterBounds,
    cases: LoadCases,
    objective: Objective,
    metric: str,
    limits: Sequence[float],
    *,
    stable: StabilityConstraint | None = None,
    positions: Sequence[float] | None = None,
    method: str = "lbfgs",
    steps: int = 80,
    seed: int = 0,
    least_peaks: bool = True,
    progress: bool = True,
) -> ParetoFront:
    """Pareto front: tunings for an objective under each limit on a metric (see `Objective`).

    From the loosest limit to the tightest, each search starts where the one before ended, with the
    same compiled programs. Other arguments are those of `tune`; a line search meets limits more
    exactly than Adam.

    Raises ValueError as `tune` does, and for an unknown metric or a limit that is not positive.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.load_case("case.toml")
    >>> loads = tuning.LoadCases(({"loads.0.mass": 0.2},), ({"loads.0.mass": 0.3},))
    >>> free = {"controller.gains.0": (100.0, 5000.0)}
    >>> options = {"steps": 3, "least_peaks": False, "progress": False}
    >>> peak = tuning.Objective({"peak": 1.0})
    >>> front = tuning.pareto(case, free, loads, peak, "effort", [0.1, 0.5], **options)
    >>> print(front.limits)
    (0.5, 0.1)
    """
    limits = tuple(sorted(map(float, limits), reverse=True))
    objectives = [
        dataclasses.replace(objective, limits=objective.limits | {metric: limit})
        for limit in limits
    ]
    if not objectives:
        raise ValueError(f"a Pareto front needs at least one limit of {metric}, such as [0.1, 0.2]")
    check_arguments(free, cases, objectives[0], method, steps, least_peaks=least_peaks)
    problem = TuningProblem(case, free, cases, objectives[0], stable, positions, least_peaks)
    tuned = _tune_successively(problem, objectives, method, steps, seed, progress)
    return ParetoFront(metric, limits, tuple(tuned))


@refuses_traced("a tuning")
def lexicographic(
    case: Case,
    free: ParameterBounds,
    cases: LoadCases,
    metrics: Sequence[str],
    *,
    slack: float = 0.01,
    aggregation: str = "worst",
    stable: StabilityConstraint | None = None,
    positions: Sequence[float] | None = None,
    method: str = "lbfgs",
    steps: int = 80,
    seed: int = 0,
    least_peaks: bool = True,
    progress: bool = True,
) -> tuple[TuningResult, ...]:
    """Tune for metrics in order of rank: each is minimised subject to limits on those before it.

    The limit on a metric is its minimum times 1 + `slack`. There is one result for each
    metric; the last one is that for all. `aggregation` is that of an
    `Objective`, over the runs. Other arguments are those of `tune`.

    Raises ValueError as `tune` does, for an unknown metric and one that is named twice.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.load_case("case.toml")
    >>> loads = tuning.LoadCases(({"loads.0.mass": 0.2},), ({"loads.0.mass": 0.3},))
    >>> free = {"controller.gains.0": (100.0, 5000.0)}
    >>> options = {"steps": 3, "least_peaks": False, "progress": False}
    >>> results = tuning.control.lexicographic(case, free, loads, ["peak", "effort"], **options)
    >>> print(len(results), "results")
    2 results
    """
    if not metrics or len(set(metrics)) < len(metrics):
        raise ValueError("name at least one metric, and each once, the most important first")
    of_all = Objective(dict.fromkeys(metrics, 1.0), aggregation)
    check_arguments(free, cases, of_all, method, steps, least_peaks=least_peaks)
    problem = TuningProblem(case, free, cases, of_all, stable, positions, least_peaks)
    found: list[TuningResult] = []

    def objectives() -> Iterator[Objective]:
        limits = {}
        for metric in metrics:
            yield Objective({metric: 1.0}, aggregation, limits=dict(limits))
            limits[metric] = (1 + slack) * found[-1].run_sets[0].metrics[metric]

    for result in _tune_successively(problem, objectives(), method, steps, seed, progress):
        found.append(result)
    return tuple(found)


def _tune_successively(
    problem: TuningProblem,
    objectives: Iterable[Objective],
    method: str,
    steps: int,
    seed: int,
    progress: bool,
) -> Iterator[TuningResult]:
    """One result for each objective; each search starts at the best point of the one before."""
    optimisation, point = problem.optimisation(method, steps), None
    for objective in objectives:
        points = optimisation.start_points(1, seed, point)
        state = optimisation.run(objective.target, points, seed, progress=progress)
        point = state.best[0]
        yield problem.tuning_result(optimisation, state, objective)


def _rank(found: TuningResult) -> tuple[bool, float]:
    """The objective on training runs; results that violate the stability constraint come last."""
    return found.stability_violation > 0, found.run_sets[0].objective[1]


@dataclasses.dataclass(frozen=True, eq=False)
class IntegerSearchResult:
    """Tuning results by choice of integers."""

    choices: tuple[dict[str, int], ...]
    tuned: tuple[TuningResult, ...]

    @property
    def best(self) -> TuningResult:
        """The result with the lowest objective on training runs; stable ones come first."""
        return min(self.tuned, key=_rank)

    def __str__(self) -> str:
        names = list(self.choices[0])
        header = [*names, *(run_set.name for run_set in self.tuned[0].run_sets), ""]
        rows = []
        for choice, found in zip(self.choices, self.tuned, strict=True):
            objectives = [f"{run_set.objective[1]:.5g}" for run_set in found.run_sets]
            mark = "(best)" if found is self.best else ""
            rows.append([*(f"{choice[name]:d}" for name in names), *objectives, mark])
        lines = text_table(header, rows, ">" * (len(header) - 1) + "<")
        return "\n".join(["objective by choice", *lines, "", str(self.best)])


@refuses_traced("a tuning")
def tune_integers(
    case: Case,
    choices: Mapping[str, Sequence[int]],
    free: ParameterBounds,
    cases: LoadCases,
    objective: Objective | None = None,
    **options: Any,
) -> IntegerSearchResult:
    """Tune a case with every combination of integers at some addresses.

    `choices` are lists by address, such as {"controller.horizon": [4, 6, 8]}. Integers decide array
    shapes and have no gradient, so that each combination is a search of its own; `options` are
    those of `tune`.

    Raises ValueError for an address without an integer, and as `tune` does.

    >>> import dataclasses
    >>> import jaxbeam as jb
    >>> import tuning
    >>> law = jb.MPC(horizon=4, moves=2, move_weight=1e-9, period=0.01)
    >>> case = dataclasses.replace(jb.load_case("case.toml"), controller=law)
    >>> loads = tuning.LoadCases(({"loads.0.mass": 0.2},), ({"loads.0.mass": 0.3},))
    >>> options = {"steps": 1, "least_peaks": False, "progress": False}
    >>> free = {"controller.move_weight": (1e-10, 1e-8)}
    >>> found = tuning.control.tune_integers(
    ...     case, {"controller.horizon": [2, 4]}, free, loads, **options
    ... )
    >>> print(found.choices)
    ({'controller.horizon': 2}, {'controller.horizon': 4})
    """
    rows = [dict(zip(choices, row, strict=True)) for row in itertools.product(*choices.values())]
    if not choices or not rows:
        raise ValueError("name at least one integer, with at least one value to try")
    chosen = [with_integers(case, row) for row in rows]
    found = [tune(own, free, cases, objective, **options) for own in chosen]
    return IntegerSearchResult(tuple(rows), tuple(found))


def with_integers(case: Case, values: Mapping[str, int]) -> Case:
    """The case with other integers at some addresses.

    Raises ValueError for an address at which there is no integer.
    """
    for address in values:
        if address in addresses(case):
            raise ValueError(f"{address} is no integer: tune it as a free parameter")
    return with_settings(case, {address: int(value) for address, value in values.items()})


FEEDBACK_ADDRESS = "controller.feedback"
SUM_PENALTY = 10.0  # added to the objective if the sum of the fractions is off by one
CANDIDATE_COUNT = 3  # states tried as the last one to be fed back


@dataclasses.dataclass(frozen=True, eq=False)
class ReducedFeedback:
    """Result of `tune_reduced`: states fed back, and their fractions (`shares`) before rounding.

    `relaxed` is the result with these fractions, `tuned` that with the fractions rounded and the
    other parameters tuned again.
    """

    fed_back: tuple[int, ...]
    shares: Float[np.ndarray, " state"]
    relaxed: TuningResult
    tuned: TuningResult

    def __str__(self) -> str:
        rows = [
            (str(state), f"{share:.3f}", "yes" if state in self.fed_back else "no")
            for state, share in enumerate(self.shares)
        ]
        lines = text_table(("state", "share", "fed back"), rows, "<><")
        rounded, tuned = self.tuned.run_sets[0].objective
        relaxed = self.relaxed.run_sets[0].objective[1]
        lines += [
            "",
            f"objective on training: {relaxed:.5g} with these shares, {rounded:.5g} when they are"
            f" rounded, {tuned:.5g} when the other parameters are tuned again",
        ]
        return "\n".join([*lines, "", str(self.tuned)])


@refuses_traced("a tuning")
def tune_reduced(
    case: Case,
    keep: int,
    free: ParameterBounds,
    cases: LoadCases,
    objective: Objective | None = None,
    **options: Any,
) -> ReducedFeedback:
    """Tune a regulator that feeds back `keep` of its states only, and select these.

    First the fraction of each state (the controller's `feedback`) is a free parameter from 0 to 1,
    with a penalty that keeps their sum at `keep`. Then the largest become 1, the others 0, and the
    parameters in `free` are tuned again from their last values; for the last state the next largest
    fractions are tried as well, and the best on training runs is the result. `options` are
    those of `tune`, without a checkpoint.

    Raises ValueError for a controller that is no regulator, for more states than it has, and as
    `tune` does.

    >>> import dataclasses
    >>> import jaxbeam as jb
    >>> import tuning
    >>> law = jb.LQR(state_weight=[1e6, 1.0], command_weight=[1e-2], period=0.01)
    >>> case = dataclasses.replace(jb.load_case("case.toml"), controller=law)
    >>> loads = tuning.LoadCases(({"loads.0.mass": 0.2},), ({"loads.0.mass": 0.3},))
    >>> free = {"controller.command_weight.0": (1e-4, 1.0)}
    >>> options = {"steps": 2, "least_peaks": False, "progress": False}
    >>> found = tuning.control.tune_reduced(case, 1, free, loads, **options)
    >>> print(len(found.fed_back), "of", len(found.shares), "states")
    1 of 2 states
    """
    controller = case.controller
    if not isinstance(controller, LQR):
        raise ValueError("only regulators, such as kind 'lqr', have states to leave out")
    states = int(controller.state_weight.shape[0])
    if not 1 <= keep < states:
        raise ValueError(f"keep must be 1 to {states - 1} of the {states} states; it is {keep}")
    if any(address.startswith(FEEDBACK_ADDRESS) for address in free) or "checkpoint" in options:
        raise ValueError(f"leave {FEEDBACK_ADDRESS} out of what is free, and name no checkpoint")
    names = [f"{FEEDBACK_ADDRESS}.{state}" for state in range(states)]
    shared = dict.fromkeys(names, (0.0, 1.0))

    def penalty(values):
        # On both sides: weights can compensate fractions that are all too small.
        total = jnp.sum(jnp.stack([values[name] for name in names]))
        return SUM_PENALTY * (total - keep) ** 2

    relaxed = tune(
        _with_feedback(case, np.full(states, keep / states)),
        dict(free) | shared,
        cases,
        objective,
        penalty=penalty,
        **options,
    )
    found = [parameter.address for parameter in relaxed.parameters]
    shares = np.array([relaxed.values[found.index(name)] for name in names])
    order = np.argsort(-shares, kind="stable")
    # The best relaxed fractions need not be the best when rounded.
    candidates = [
        np.append(order[: keep - 1], last) for last in order[keep - 1 :][:CANDIDATE_COUNT]
    ]
    results = []
    for kept in candidates:
        rounded = _with_feedback(relaxed.case, np.isin(np.arange(states), kept).astype(float))
        results.append(tune(rounded, free, cases, objective, **options))
    best = min(range(len(candidates)), key=lambda i: _rank(results[i]))
    return ReducedFeedback(
        tuple(sorted(map(int, candidates[best]))), shares, relaxed, results[best]
    )


def _with_feedback(case: Case, shares: Float[np.ndarray, " state"]) -> Case:
    """The case whose controller feeds back these fractions (`shares`) of the states."""
    controller = dataclasses.replace(case.controller, feedback=shares)
    return dataclasses.replace(case, controller=controller)
