"""Controllers tuned by gradients through the closed loop, and proven on cases held out."""

from __future__ import annotations

import dataclasses
import functools
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, replace
from jaxbeam.files.case_file import case_to_dict
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import ContactLossWarning, Histories
from tuning.checkpoint import fingerprint
from tuning.control.load_cases import LoadCases
from tuning.control.objective import Objective
from tuning.control.optimisation import Optimisation, OptimisationState
from tuning.control.optimisers import optimiser
from tuning.control.plants import draw_plants, with_identified_plant
from tuning.control.run_set import RunSet, make_run_set
from tuning.control.stability_constraint import STABILITY_PENALTY_SLOPE, StabilityConstraint
from tuning.control.tuning_result import RunSetResult, StartResult, TuningResult
from tuning.parameters.free import free_parameters

if TYPE_CHECKING:
    from tuning.fit.identify import Fit
    from tuning.fit.uncertainty.posterior import Posterior

ParameterBounds = Mapping[str, tuple[float, float] | None]


def tune(
    case: Case,
    free: ParameterBounds,
    cases: LoadCases,
    objective: Objective | None = None,
    *,
    plant: Fit | Posterior | None = None,
    plants: int = 4,
    stable: StabilityConstraint | None = None,
    penalty: Callable | None = None,
    positions: Sequence[float] | None = None,
    method: str = "adam",
    steps: int = 80,
    batch: int | None = None,
    starts: int = 1,
    seed: int = 0,
    least_peaks: bool = True,
    checkpoint: str | os.PathLike | None = None,
    resume: bool = False,
    progress: bool = True,
) -> TuningResult:
    """Tune numbers of a controlled case over many runs; prove them on runs held out.

    `free` gives addresses, each with its bounds or None: gains and weights of the controller, but
    also filters' cutoffs or places of actuators and sensors. The runs of `cases` are simulated
    closed loop, limits included, side by side; a `method` follows the gradient of the `objective`,
    whose maxima are smooth at first and ever sharper, for a number of `steps`, from the case's own
    numbers and from `starts` - 1 random ones at once. What is kept is the best that was met by the
    true objective, the start included. `positions` (m) are where deflections count, the sensors' if
    left out. `stable` asks for a loop that stays stable along the crossings, with room to spare
    (what violates it is kept only where nothing met satisfies it, and the result says so). A
    `penalty`, a differentiable function of the values by address, is added to the objective. With
    `least_peaks` every run is also held against the least peak that is possible.

    The method is "adam" or "lbfgs" (optax) or "bfgs" (optimistix); each step simulates all runs
    once. With a `batch`, for Adam only, a step simulates so many of them, drawn by the `seed`.

    A `plant` that was identified takes the place of the case's own: its beam, supports, actuators
    and sensors. Training runs are simulated on a number of `plants` drawn from what the fit leaves
    uncertain, held-out ones on as many others; laws are designed for the fitted one.

    With a `checkpoint` file the search can be stopped at any time, and taken up with `resume`: the
    result is the same. A step to where a loop diverges is taken back, and later ones are shorter.

    Raises ValueError for a faulty case, address, run or checkpoint, and if the case as it is
    diverges; FileExistsError if the checkpoint exists and `resume` is not set.
    """
    objective = Objective() if objective is None else objective
    if plant is not None:
        case = with_identified_plant(case, plant)
        drawn = draw_plants(plant, 2 * plants, seed)
        cases = cases.across(drawn[:plants], drawn[plants:])
    check_arguments(
        free, cases, objective, method, steps, starts=starts, batch=batch, least_peaks=least_peaks
    )
    file = None if checkpoint is None else Path(checkpoint)
    if file is not None and file.exists() and not resume:
        raise FileExistsError(f"{file} exists; resume the search, or name another file")
    if file is not None and penalty is not None:
        raise ValueError("a search with a price of its own cannot be kept: leave out checkpoint")
    problem = TuningProblem(case, free, cases, objective, stable, positions, least_peaks, penalty)
    optimisation = problem.optimisation(method, steps, batch)
    digest = fingerprint(problem.description | {"settings": [method, steps, batch, starts, seed]})
    points = optimisation.start_points(starts, seed)
    # The runs of the proof are simulated while the search compiles; what is wrong with them is
    # told before it begins.
    with ThreadPoolExecutor(1) as pool:
        held_out_future = pool.submit(lambda: problem.held_out_runs if cases.held_out else None)
        optimisation.compile(objective.target, points)
        held_out_future.result()
    state = optimisation.run(
        objective.target, points, seed, file=file, digest=digest, progress=progress
    )
    return problem.tuning_result(optimisation, state, objective)


def check_arguments(
    free: ParameterBounds,
    cases: LoadCases,
    objective: Objective,
    method: str,
    steps: int,
    *,
    starts: int = 1,
    batch: int | None = None,
    least_peaks: bool = True,
) -> None:
    """Refuse what could only fail later. Raises ValueError, saying what and why."""
    if steps < 1 or starts < 1:
        raise ValueError(f"steps and starts must be 1 or more; they are {steps} and {starts}")
    if "shortfall" in objective.weights | objective.limits and not least_peaks:
        raise ValueError("the shortfall is that behind the bounds: leave bounds on to tune for it")
    optimiser(method, steps)
    runs = len(cases.training)
    if batch is not None and method != "adam":
        raise ValueError(f"a batch is for adam: the slopes of {method} must be those of one sum")
    if batch is not None and not 1 <= batch <= runs:
        raise ValueError(f"batch must be between 1 and the {runs} training runs; it is {batch}")
    varied = {address for run in (*cases.training, *cases.held_out) for address in run}
    both = sorted(varied & set(free))
    if both:
        raise ValueError(f"{both[0]} is free, but differs from run to run: leave out one of these")
    for address in free:
        if address.endswith(("period", "delay")):
            raise ValueError(
                f"{address} cannot be free: it decides when the loop acts, and so how the run is"
                " cut into steps; tune for several of its values and compare"
            )


class TuningProblem:
    """What is tuned, on what runs: prepared once for any number of searches."""

    def __init__(
        self,
        case: Case,
        free: ParameterBounds,
        cases: LoadCases,
        objective: Objective,
        stable: StabilityConstraint | None = None,
        positions: Sequence[float] | None = None,
        least_peaks: bool = True,
        penalty: Callable | None = None,
    ):
        self.case, self.cases, self.objective = case, cases, objective
        self.positions, self.least_peaks, self.penalty = positions, least_peaks, penalty
        self.parameters = free_parameters([case], dict(free), 1.0)
        self.run_set = make_run_set(case, cases.training, positions, least_peaks)
        self.violation = None
        if stable is not None:
            self.violation = stable.violation_of_runs(case, self.run_set)
        self.description = {
            "case": case_to_dict(case),
            "free": {n.address: [n.low, n.high] for n in self.parameters},
            "cases": dataclasses.asdict(cases),
            "objective": dataclasses.asdict(objective),
            "stable": None if stable is None else dataclasses.asdict(stable),
            "places": positions,
        }

    def optimisation(self, method: str, steps: int, batch: int | None = None) -> Optimisation:
        """A search of this problem."""
        return Optimisation(
            self.run_set, self.parameters, self.objective, self._penalty(), method, steps, batch
        )

    def _penalty(self) -> Callable | None:
        """What a search pays on top of the objective, as a function of values by address."""
        own, violation = self.penalty, self.violation
        # So steep that what violates stability is never the best, unless everything does.
        if violation is None:
            return own
        if own is None:
            return lambda values: STABILITY_PENALTY_SLOPE * violation(values)
        return lambda values: STABILITY_PENALTY_SLOPE * violation(values) + own(values)

    @functools.cached_property
    def held_out_runs(self) -> RunSet:
        """The runs that the search does not see, prepared; there must be some."""
        return make_run_set(self.case, self.cases.held_out, self.positions, self.least_peaks)

    def tuning_result(
        self, optimisation: Optimisation, state: OptimisationState, objective: Objective
    ) -> TuningResult:
        """What a search came to, on training and held-out runs."""
        values = optimisation.best_values(state)
        before = {number.address: number.start for number in self.parameters}
        after = dict(zip(before, map(float, values), strict=True))
        outcomes = [_run_set_result("training", self.run_set, objective, before, after)]
        if self.cases.held_out:
            outcomes.append(
                _run_set_result("held out", self.held_out_runs, objective, before, after)
            )
        order = np.argsort(state.best_value).tolist()
        return TuningResult(
            case=replace(self.case, after),
            parameters=self.parameters,
            values=values,
            objective=objective,
            history=state.history,
            rejected_steps=int(state.rejected.sum()),
            run_sets=outcomes,
            stability_violation=0.0
            if self.violation is None
            else float(compiled(self.violation)(after)),
            start_results=tuple(
                StartResult(float(state.best_value[i]), optimisation.best_values(state, i))
                for i in order
            ),
        )


@compiled
def _merits_of(run_set: RunSet, found: Histories):
    return run_set.merits_of(found)


def _run_set_result(name, run_set: RunSet, objective, before, after) -> RunSetResult:
    """True peaks and merits of all runs, before and after, and the least peaks possible."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        pairs = [run_set.records(values) for values in (before, after)]
    peaks = [_largest_deflections(run_set, records) for records in pairs]
    # What is compiled must not depend on what the runs are called.
    unnamed = dataclasses.replace(run_set, runs=())
    merits = [_merits_of(unnamed, _histories(records, run_set.positions)) for records in pairs]
    values = [np.asarray(objective.weighted_merits(found)) for found in merits]
    return RunSetResult(
        name=name,
        runs=tuple(run_set.runs),
        uncontrolled_peaks=run_set.uncontrolled["peak"],
        peaks_before=peaks[0],
        peaks_after=peaks[1],
        least_peaks=run_set.uncontrolled["least"],
        objective_values=np.stack(values),
        saturated_share=np.array([float(np.asarray(r.saturated).mean()) for r in pairs[1]]),
        objective=[float(objective.aggregate(jnp.asarray(v))) for v in values],
        merits={name: float(objective.aggregate(part)) for name, part in merits[1].items()},
    )


def _histories(records: list[Record], positions) -> Histories:
    """Histories of all runs, along a first axis, at some places (m)."""
    parts = [(record.at(positions), record.command, record.contact_force) for record in records]
    return Histories(*map(np.stack, zip(*parts, strict=True)))


def _largest_deflections(run_set: RunSet, records) -> Float[np.ndarray, " run"]:
    """Largest deflection of each run: between samples at sensors, at samples elsewhere."""
    # Those of the records: a tuning may have moved them away from where deflections count.
    sensors = np.array([float(sensor.position) for sensor in records[0].case.sensors])
    if np.array_equal(sensors, np.asarray(run_set.positions)):
        return np.array([float(np.max(record.peak_deflection)) for record in records])
    return np.array([float(np.max(np.abs(record.at(run_set.positions)))) for record in records])
