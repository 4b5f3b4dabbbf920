"""Tuning: parameters of a controlled case optimised by gradients through the closed loop."""

import dataclasses
import functools
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.analysis.bound.bound import no_bound
from jaxbeam.case.case import Case, check_distinct, each_address, list_sizes, replace
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.files.case_file import case_to_dict
from jaxbeam.model.plausibility.check import warn_if_implausible
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.record import Record
from jaxbeam.simulation.simulate import ContactLossWarning, Histories
from tuning.checkpoint import Checkpoint, checkpoint_path, fingerprint
from tuning.control.objective import Objective
from tuning.control.optimisation import Optimisation, OptimisationState, optimiser
from tuning.control.penalised_objective import STABILITY_PENALTY_SLOPE, StabilityConstraint
from tuning.control.run_set import (
    LoadCases,
    RunSet,
    draw_plants,
    make_run_set,
    with_identified_plant,
)
from tuning.control.tuning_result import DETUNING, RunSetResult, StartResult, TuningResult
from tuning.fit.result import Fit
from tuning.fit.uncertainty import Posterior
from tuning.parameters import free_parameters

ParameterBounds = Mapping[str, tuple[float, float] | None]


@refuses_traced("a tuning")
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
    """Tune parameters of a controlled or damped case on training runs; report held-out runs.

    `free` gives addresses, each with bounds (low, high) or None: gains and weights of the
    controller, numbers of absorbers, cutoffs of filters, positions of actuators and sensors. In a
    case without a controller "no control" is that without its absorbers. The runs of
    `cases` are simulated in closed loop, limits included, as one batch. An optimiser follows the
    gradient of the `objective`, whose maxima are smooth at first and ever sharper, for a number of
    `steps`, from the case's own values and from `starts` - 1 random ones at once. The result is the
    best point met by the true objective, the start included.

    `positions` (m) are where deflections count, those of the sensors if left out. `stable` is a
    constraint on the poles along the crossings (points that violate it are the result only where
    no other was met, which the result says). A `penalty`, a differentiable function of the values
    by address, is added to the objective. With `least_peaks` the least achievable peak of each run
    is computed, unless limits of a voltage within an inner loop allow none.

    The `method` is "adam" or "lbfgs" (optax) or "bfgs" (optimistix); each step simulates all runs
    once or, with a `batch` (Adam only), so many of them, drawn by the `seed`.

    An identified `plant` replaces the case's own beam, supports, actuators and sensors. Training
    runs are then simulated on a number of `plants` drawn from its uncertainty, held-out runs on as
    many others; controllers are designed for the fitted plant.

    With a `checkpoint` file the search can be stopped at any time; with `resume` it goes on, to the
    same result.

    Raises ValueError for a faulty case, address, run or checkpoint, and if the closed loop is
    unstable with the start values; FileExistsError if the checkpoint exists and `resume` is not
    set.

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
    >>> result = tuning.tune(case, free, loads, **options)
    >>> print(f"gain {result.values[0]:.0f}")
    gain 767
    """
    objective = Objective() if objective is None else objective
    if plant is not None:
        case = with_identified_plant(case, plant)
        drawn = draw_plants(plant, 2 * plants, seed)
        cases = cases.across(drawn[:plants], drawn[plants:])
    check_arguments(
        free, cases, objective, method, steps, starts=starts, batch=batch, least_peaks=least_peaks
    )
    path = checkpoint_path(checkpoint, resume)
    warn_if_implausible(case)
    if path is not None and penalty is not None:
        raise ValueError(
            "a search with a user-defined penalty cannot be checkpointed: leave out `checkpoint`"
        )
    problem = TuningProblem(case, free, cases, objective, stable, positions, least_peaks, penalty)
    optimisation = problem.optimisation(method, steps, batch)
    digest = fingerprint(problem.description | {"settings": [method, steps, batch, starts, seed]})
    points = optimisation.start_points(starts, seed)
    # Held-out runs are prepared while the search compiles; their faults are reported before it.
    with ThreadPoolExecutor(1) as pool:
        held_out_future = pool.submit(lambda: problem.held_out_runs if cases.held_out else None)
        optimisation.compile(objective.target, points)
        held_out_future.result()
    state = optimisation.run(
        objective.target, points, seed, checkpoint=Checkpoint(path, digest), progress=progress
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
    """Check the arguments of a tuning.

    Raises ValueError for the first that is wrong.
    """
    if steps < 1 or starts < 1:
        raise ValueError(f"steps and starts must be 1 or more; they are {steps} and {starts}")
    if "shortfall" in objective.weights | objective.limits and not least_peaks:
        raise ValueError(
            "shortfall is relative to the least achievable peaks: leave least_peaks on for it"
        )
    optimiser(method, steps)
    runs = len(cases.training)
    if batch is not None and method != "adam":
        raise ValueError(f"a batch is for adam: {method} needs gradients of one objective")
    if batch is not None and not 1 <= batch <= runs:
        raise ValueError(f"batch must be between 1 and the {runs} training runs; it is {batch}")
    varied = {address for run in (*cases.training, *cases.held_out) for address in run}
    both = sorted(varied & set(free))
    if both:
        raise ValueError(f"{both[0]} is free, but differs from run to run: leave out one of these")


class TuningProblem:
    """Case, free parameters and run sets of a tuning, prepared once for any number of searches."""

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
        obstacle = no_bound(case)
        if obstacle and "shortfall" in objective.weights | objective.limits:
            raise ValueError(
                f"shortfall is relative to the least achievable peaks, but {obstacle}: tune for"
                " peak in its place"
            )
        self.case, self.cases, self.objective = case, cases, objective
        self.positions, self.least_peaks, self.penalty = positions, least_peaks, penalty
        self.parameters = free_parameters([case], dict(free), 1.0)
        sizes = list_sizes(case)
        for varied in {frozenset(run) for run in (*cases.training, *cases.held_out)}:
            check_distinct({one: each_address(one, sizes) for one in (*free, *sorted(varied))})
        self.run_set = make_run_set(
            case, cases.training, positions, least_peaks, objective.quantities
        )
        self.violation = None
        if stable is not None:
            self.violation = stable.violation_of_runs(case, self.run_set)
        self.description = {
            "case": case_to_dict(case),
            "free": {p.address: [p.low, p.high] for p in self.parameters},
            "cases": dataclasses.asdict(cases),
            "objective": dataclasses.asdict(objective),
            "stable": None if stable is None else dataclasses.asdict(stable),
            "positions": positions,
        }

    def optimisation(self, method: str, steps: int, batch: int | None = None) -> Optimisation:
        """Search of this problem by an optimiser."""
        return Optimisation(
            self.run_set, self.parameters, self.objective, self._penalty(), method, steps, batch
        )

    def _penalty(self) -> Callable | None:
        """Sum of the user's penalty and that on instability, as a function of values by address."""
        own, violation = self.penalty, self.violation
        # So steep that unstable points are the best only where all are unstable.
        if violation is None:
            return own
        if own is None:
            return lambda values: STABILITY_PENALTY_SLOPE * violation(values)
        return lambda values: STABILITY_PENALTY_SLOPE * violation(values) + own(values)

    @functools.cached_property
    def held_out_runs(self) -> RunSet:
        """Run set of the held-out cases; there must be at least one."""
        settings = self.positions, self.least_peaks, self.objective.quantities
        return make_run_set(self.case, self.cases.held_out, *settings)

    def tuning_result(
        self, optimisation: Optimisation, state: OptimisationState, objective: Objective
    ) -> TuningResult:
        """Result of a search, on training and held-out runs."""
        values = optimisation.best_values(state)
        before = {parameter.address: parameter.start for parameter in self.parameters}
        after = dict(zip(before, map(float, values), strict=True))
        run_sets = {"training": self.run_set}
        if self.cases.held_out:
            run_sets["held out"] = self.held_out_runs
        violation = 0.0 if self.violation is None else float(compiled(self.violation)(after))
        order = np.argsort(state.best_value).tolist()
        tuned = replace(self.case, after)
        detuned = [_detuned(tuned, after, self.cases, error) for error in DETUNING[1:]]
        return TuningResult(
            case=tuned,
            parameters=self.parameters,
            values=values,
            objective=objective,
            history=state.history,
            rejected_steps=int(state.rejected.sum()),
            run_sets=[
                _run_set_result(name, run_set, objective, before, after, detuned)
                for name, run_set in run_sets.items()
            ],
            stability_violation=violation,
            start_results=tuple(
                StartResult(float(state.best_value[i]), optimisation.best_values(state, i))
                for i in order
            ),
        )


@compiled
def _metrics_of(run_set: RunSet, found: Histories):
    return run_set.metrics_of(found)


def _run_set_result(
    name, run_set: RunSet, objective, before, after, detuned: Sequence[dict]
) -> RunSetResult:
    """True peaks and metrics of all runs before and after tuning, and their least peaks.

    The objective is that of `detuned` values too, where the case has absorbers.
    """
    points = [before, after, *(detuned if run_set.cases[0].absorbers else ())]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        pairs = [run_set.records(values) for values in points]
    peaks = [_largest_deflections(run_set, records) for records in pairs[:2]]
    # Compiled programs must not depend on the names of the runs.
    unnamed = dataclasses.replace(run_set, runs=())
    metrics = [_metrics_of(unnamed, _histories(records, run_set)) for records in pairs]
    values = [float(objective.aggregate(objective.weighted_metrics(found))) for found in metrics]
    metrics_before, metrics_after = (
        {name: float(objective.aggregate(part)) for name, part in found.items()}
        for found in metrics[:2]
    )
    return RunSetResult(
        name=name,
        runs=tuple(run_set.runs),
        uncontrolled_peaks=run_set.uncontrolled["peak"],
        peaks_before=peaks[0],
        peaks_after=peaks[1],
        least_peaks=run_set.uncontrolled["least"],
        saturated_share=np.array(
            [record.saturated.mean() if record.saturated.size else 0.0 for record in pairs[1]]
        ),
        objective=values[:2],
        metrics=metrics_after,
        metrics_before=metrics_before,
        detuned=[values[1], *values[2:]] if values[2:] else [],
    )


def _detuned(case: Case, after: dict[str, float], cases: LoadCases, error: float):
    """The values `after` a tuning, with absorbers of frequencies larger by a relative error.

    Those that differ from run to run are left as they are.
    """
    powers, values, sizes = {"frequency": 1, "stiffness": 2}, dict(after), list_sizes(case)
    varied = {one for run in (*cases.training, *cases.held_out) for one in run}
    given = {each for one in (*after, *varied) for each in each_address(one, sizes)}
    for address in after:
        name = address.rpartition(".")[2]
        if address.startswith("absorbers.") and name in powers:
            values[address] *= (1 + error) ** powers[name]
    for i, one in enumerate(case.absorbers):
        name = "stiffness" if one.frequency is None else "frequency"
        if (address := f"absorbers.{i}.{name}") not in given:
            values[address] = float(concrete(getattr(one, name))) * (1 + error) ** powers[name]
    return values


def _histories(records: list[Record], run_set: RunSet) -> Histories:
    """Histories of all runs, along a first axis, at the positions of a run set."""
    names = [sensor.quantity for sensor in records[0].case.sensors]
    own = {name: [i for i, one in enumerate(names) if one == name] for name in run_set.quantities}
    parts = [
        Histories(
            record.at(run_set.positions),
            record.command,
            record.contact_force,
            {name: record.sensor_values[:, index] for name, index in own.items()},
        )
        for record in records
    ]
    return jax.tree.map(lambda *histories: np.stack(histories), *parts)


def _largest_deflections(run_set: RunSet, records) -> Float[np.ndarray, " run"]:
    """Largest deflection (m) of each run: between samples at sensors, at samples elsewhere."""
    # Sensors of the records: a tuning may have moved them from where deflections count.
    sensors = np.array([float(sensor.position) for sensor in records[0].case.sensors])
    if np.array_equal(sensors, np.asarray(run_set.positions)):
        return np.array([float(np.max(record.peak_deflection)) for record in records])
    return np.array([float(np.max(np.abs(record.at(run_set.positions)))) for record in records])
