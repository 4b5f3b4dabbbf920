"""What one figure of merit costs in another: a front of tunings, and merits in order of rank."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from jaxbeam.case.case import Case
from tuning.control.load_cases import LoadCases
from tuning.control.objective import MERITS, Objective
from tuning.control.stability_constraint import StabilityConstraint
from tuning.control.tune import ParameterBounds, TuningProblem, check_arguments
from tuning.control.tuning_result import TuningResult


@dataclasses.dataclass(frozen=True, eq=False)
class ParetoFront:
    """Tunings for one objective under ever tighter limits of one merit, loosest first."""

    merit: str
    limits: tuple[float, ...]
    tuned: tuple[TuningResult, ...]

    def points(self, held_out: bool = False) -> np.ndarray:
        """For each limit the merit and the objective (limit, 2), of training or held-out runs."""
        own = [found.run_sets[-1 if held_out else 0] for found in self.tuned]
        return np.array([[one.merits[self.merit], one.objective[1]] for one in own])

    def __str__(self) -> str:
        heads = ("limit", self.merit, "objective", f"{self.merit} held out", "objective held out")
        lines = ["".join(f"{head:>24}" for head in heads)]
        rows = zip(self.limits, self.points(), self.points(held_out=True), strict=True)
        for limit, trained, proven in rows:
            lines.append("".join(f"{x:>24.5g}" for x in (limit, *trained, *proven)))
        return "\n".join(lines)

    def plot(self):
        """Figure of the front, on training and on held-out runs."""
        from jaxbeam.plot import plot_pareto_front

        kinds = {found.name: found.name == "held out" for found in self.tuned[0].run_sets}
        lines = {name: self.points(held_out) for name, held_out in kinds.items()}
        return plot_pareto_front(lines, self.merit, title=self.tuned[0].case.title)


def pareto(
    case: Case,
    free: ParameterBounds,
    cases: LoadCases,
    objective: Objective,
    merit: str,
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
    """Tune for an objective under each of some limits on a merit (see `Objective`).

    From the loosest limit to the tightest each search goes on from where the last one ended, and
    all share what is compiled. Arguments are those of `tune`; a line search meets limits more
    exactly than Adam.

    Raises ValueError as `tune` does, and for an unknown merit or a limit that is not positive.
    """
    limits = tuple(sorted(map(float, limits), reverse=True))
    objectives = [_with_limits(objective, {merit: limit}) for limit in limits]
    if not objectives:
        raise ValueError("a front needs at least one limit")
    check_arguments(free, cases, objectives[0], method, steps, least_peaks=least_peaks)
    problem = TuningProblem(case, free, cases, objectives[0], stable, positions, least_peaks)
    return ParetoFront(
        merit, limits, tuple(_tune_each(problem, objectives, method, steps, seed, progress))
    )


def lexicographic(
    case: Case,
    free: ParameterBounds,
    cases: LoadCases,
    merits: Sequence[str],
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
    """Tune for merits in order of rank: each is lowered as far as those before it allow.

    What a merit has come to, plus the share `slack` of it, is a limit for all that follow. One
    result for each merit; the last is that for all. Other arguments are those of `tune`.

    Raises ValueError as `tune` does, for an unknown merit and one that is named twice.
    """
    if not merits or len(set(merits)) < len(merits):
        raise ValueError("name at least one merit, and each once, the most important first")
    check_arguments(
        free, cases, Objective(dict.fromkeys(merits, 1.0)), method, steps, least_peaks=least_peaks
    )
    problem = TuningProblem(
        case, free, cases, Objective({merits[0]: 1.0}, aggregation), stable, positions, least_peaks
    )
    found, limits = [], {}
    optimisation, points = problem.optimisation(method, steps), None
    for merit in merits:
        objective = Objective({merit: 1.0}, aggregation, limits=dict(limits))
        points = optimisation.start_points(1, seed, points)
        state = optimisation.run(objective.target, points, seed, progress=progress)
        points = state.best[0]
        found.append(problem.tuning_result(optimisation, state, objective))
        limits[merit] = (1 + slack) * found[-1].run_sets[0].merits[merit]
    return tuple(found)


def _tune_each(problem: TuningProblem, objectives, method, steps, seed, progress):
    """One result for each goal, every search begun where the one before it ended."""
    optimisation, point = problem.optimisation(method, steps), None
    for goal in objectives:
        state = optimisation.run(
            goal.target, optimisation.start_points(1, seed, point), seed, progress=progress
        )
        point = state.best[0]
        yield problem.tuning_result(optimisation, state, goal)


def _with_limits(objective: Objective, limits: dict[str, float]) -> Objective:
    unknown = set(limits) - set(MERITS)
    if unknown:
        raise ValueError(f"there is no merit {min(unknown)!r}; it may be {', '.join(MERITS)}")
    return dataclasses.replace(objective, limits=objective.limits | limits)
