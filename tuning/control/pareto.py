"""Multi-objective tuning: Pareto front (epsilon-constraint method) and lexicographic order."""

import dataclasses
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from jaxbeam.case.case import Case
from jaxbeam.runtime.printer import text_table
from tuning.control.load_cases import LoadCases
from tuning.control.objective import ALL_METRICS, Objective
from tuning.control.penalised_objective import StabilityConstraint
from tuning.control.tune import ParameterBounds, TuningProblem, check_arguments
from tuning.control.tuning_result import TuningResult


@dataclasses.dataclass(frozen=True, eq=False)
class ParetoFront:
    """Tunings for one objective under ever tighter limits on one metric, loosest first."""

    metric: str
    limits: tuple[float, ...]
    tuned: tuple[TuningResult, ...]

    def points(self, held_out: bool = False) -> np.ndarray:
        """Merit and objective for each limit (limit, 2), on training or held-out runs."""
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

    From the loosest limit to the tightest, each search starts where the one before ended; all share
    compiled programs. Other arguments are those of `tune`; a line search meets limits more exactly
    than Adam.

    Raises ValueError as `tune` does, and for an unknown metric or a limit that is not positive.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3, limits=(-2.0, 2.0))],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.3, speed=2.0)],
    ...     controller=jb.Feedback(gains=[500.0], period=0.01),
    ...     run=jb.Run(0.3),
    ... )
    >>> loads = tuning.LoadCases(({"loads.0.mass": 0.2},), ({"loads.0.mass": 0.3},))
    >>> free = {"controller.gains.0": (100.0, 5000.0)}
    >>> options = {"steps": 3, "least_peaks": False, "progress": False}
    >>> peak = tuning.Objective({"peak": 1.0})
    >>> front = tuning.pareto(case, free, loads, peak, "effort", [0.1, 0.5], **options)
    >>> print(front.limits)
    (0.5, 0.1)
    """
    limits = tuple(sorted(map(float, limits), reverse=True))
    objectives = [_with_limits(objective, {metric: limit}) for limit in limits]
    if not objectives:
        raise ValueError(f"a Pareto front needs at least one limit of {metric}, such as [0.1, 0.2]")
    check_arguments(free, cases, objectives[0], method, steps, least_peaks=least_peaks)
    problem = TuningProblem(case, free, cases, objectives[0], stable, positions, least_peaks)
    tuned = _tune_successively(problem, objectives, method, steps, seed, progress)
    return ParetoFront(metric, limits, tuple(tuned))


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

    The limit on a metric is its minimum plus the share `slack` of it. There is one result for each
    metric; the last one is that for all. `aggregation` is that of an
    `Objective`, over the runs. Other arguments are those of `tune`.

    Raises ValueError as `tune` does, for an unknown metric and one that is named twice.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3, limits=(-2.0, 2.0))],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.3, speed=2.0)],
    ...     controller=jb.Feedback(gains=[500.0], period=0.01),
    ...     run=jb.Run(0.3),
    ... )
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


def _with_limits(objective: Objective, limits: dict[str, float]) -> Objective:
    unknown = set(limits) - set(ALL_METRICS)
    if unknown:
        raise ValueError(f"there is no metric {min(unknown)!r}; it may be {', '.join(ALL_METRICS)}")
    return dataclasses.replace(objective, limits=objective.limits | limits)
