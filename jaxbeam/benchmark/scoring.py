"""Scores: shares of the attainable reduction of the peak, from the bound of each load.

A share is (uncontrolled - peak) / (uncontrolled - bound), with the largest absolute deflections at
the positions of the problem and the samples of the run, and `jaxbeam.bound` at the same. It is 0
without control and at most 1. Bounds of the published loads are stored with their certificates: for
any commands within the limits, the sum of the deflections times the `weights` (at `places`, indices
of a sample and a position) is at least the bound, and so is the peak, as the absolute weights have
the sum 1.
"""

import dataclasses
import functools
import json
import warnings
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from jaxbeam.analysis.bound.bound import bound
from jaxbeam.benchmark.environment import Environment
from jaxbeam.benchmark.problem import TEST_SEEDS, BenchmarkProblem, load
from jaxbeam.case.case import Case
from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import refuses_traced
from jaxbeam.control.state_controller import AbstractStateController
from jaxbeam.files.case_file import load_controller
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import Module
from jaxbeam.simulation.simulate import ContactLossWarning, simulate

LEAST_SHARE = -1.0  # that counts for a run that diverges, or is worse
SAME = "period", "delay", "resolution"  # of all controllers of a problem


class Attainable(NamedTuple):
    """Peak without commands and least peak (m) of a load, and the certificate of the latter."""

    load: Float[np.ndarray, " number"]
    uncontrolled: float
    bound: float
    places: Int[np.ndarray, "2 constraint"]
    weights: Float[np.ndarray, " constraint"]


class Score(Module):
    """Shares of the attainable reduction, by seed of the test load, and the `peaks` (m)."""

    problem: str
    seeds: tuple[int, ...]
    shares: Float[np.ndarray, " seed"]
    peaks: Float[np.ndarray, " seed"]

    @property
    def mean(self) -> float:
        """Score: the mean share, in which a run counts at least LEAST_SHARE, if it diverges too."""
        return float(np.mean(np.fmax(self.shares, LEAST_SHARE)))

    @property
    def worst(self) -> float:
        """Smallest share, at least LEAST_SHARE."""
        return float(np.min(np.fmax(self.shares, LEAST_SHARE)))


@refuses_traced("a score")
def score(
    problem: str | BenchmarkProblem,
    controller: Any = None,
    seed: int | Sequence[int] = TEST_SEEDS,
) -> Score:
    """Score of a controller or policy on the test loads of some seeds, by default the published.

    A controller (or its file; the baseline if left out) is simulated. A policy is a function from
    an observation to an action of the `Environment`; if it has a method `reset`, that is called
    before each run.

    Raises ValueError for an unknown problem, for a controller with another period, delay or
    resolution than the problem, and for one that needs the true state.

    >>> import jaxbeam as jb
    >>> law = jb.Feedback(gains=[4000.0], period=0.01, resolution=0.01)
    >>> print(f"{jb.benchmark.score('unknown_mass', law, seed=1).mean:.0%}")
    36%
    """
    problem = load(problem) if isinstance(problem, str) else problem
    seeds = (seed,) if isinstance(seed, int) else tuple(seed)
    if controller is None:
        controller = problem.case.controller
    elif isinstance(controller, str | Path):
        controller = load_controller(controller)
    if isinstance(controller, AbstractController):
        check_controller(problem, controller)
        peaks = [_peak_under_law(problem, controller, one) for one in seeds]
    elif callable(controller):
        peaks = _peaks_under_policy(problem, controller, seeds)
    else:
        raise ValueError(
            "score takes a controller, a file of one, or a policy: a function from an observation"
            f" to an action; not a {type(controller).__name__}"
        )
    found = [attainable(problem, one) for one in seeds]
    shares = [
        (one.uncontrolled - peak) / (one.uncontrolled - one.bound)
        for one, peak in zip(found, peaks, strict=True)
    ]
    return Score(problem.name, seeds, np.array(shares), np.array(peaks))


def check_controller(problem: BenchmarkProblem, controller: AbstractController) -> None:
    """Check that a controller suits a problem. Raises ValueError as `score` does."""
    for name in SAME:
        own, given = getattr(problem.case.controller, name), getattr(controller, name)
        if (own is None) != (given is None) or (own is not None and float(own) != float(given)):
            what = "left out" if own is None else f"{float(own):g}"
            raise ValueError(f"controller.{name} must be {what} in the problem {problem.name}")
    if isinstance(controller, AbstractStateController) and controller.estimator is None:
        raise ValueError(
            "controller.estimator must be given: without one the law has the true state, which no"
            " sensor of the benchmark measures"
        )


def design_case(problem: BenchmarkProblem, controller: AbstractController, case: Case) -> Case:
    """Case of a run under a controller, designed for the load if the problem tells it."""
    if not problem.told:
        controller = dataclasses.replace(controller, nominal_plant=state_space(problem.case))
    return dataclasses.replace(case, controller=controller)


def sampled_peak(problem: BenchmarkProblem, case: Case) -> float:
    """Largest absolute deflection (m) of a run at the positions of a problem and its samples."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ContactLossWarning)
        record = simulate(case)
    return float(np.max(np.abs(record.at(np.array(problem.positions)))))


def _peak_under_law(problem: BenchmarkProblem, controller: AbstractController, seed: int) -> float:
    case = problem.run_case(problem.test_load(seed), seed)
    return sampled_peak(problem, design_case(problem, controller, case))


def _peaks_under_policy(
    problem: BenchmarkProblem, policy: Any, seeds: Sequence[int]
) -> list[float]:
    environment = Environment(problem)
    reset, step = jax.jit(environment.reset), jax.jit(environment.step)
    peaks = []
    for seed in seeds:
        if hasattr(policy, "reset"):
            policy.reset()
        state, observation = reset(seed, problem.test_load(seed))
        for _ in range(environment.steps):
            state, observation, _, _ = step(state, policy(np.asarray(observation)))
        peaks.append(float(state.peak))
    return peaks


def attainable(problem: BenchmarkProblem, seed: int) -> Attainable:
    """Attainable peak for the test load of a seed: the stored one, or else computed."""
    stored = published(problem.name)["test"]
    if seed in TEST_SEEDS and len(stored) == len(TEST_SEEDS):
        return stored[TEST_SEEDS.index(seed)]
    return compute_attainable(problem, problem.test_load(seed))


def compute_attainable(
    problem: BenchmarkProblem, numbers: Float[np.ndarray, " number"]
) -> Attainable:
    """Attainable peak for the numbers of a load, computed."""
    case = dataclasses.replace(problem.run_case(numbers), controller=None)
    positions = np.array(problem.positions)
    least = bound(case, positions=positions, period=problem.period)
    active = least.active_constraints
    times = np.rint(active.times * float(case.run.sample_rate)).astype(int)
    places = np.stack([times, np.searchsorted(positions, active.positions)])
    return Attainable(
        np.asarray(numbers), sampled_peak(problem, case), least.peak, places, active.weights
    )


@functools.cache
def published(name: str) -> dict[str, list[Attainable]]:
    """Stored attainable peaks for the "training" and the "test" loads of a problem."""
    return {
        kind: [Attainable(*map(_as_stored, row)) for row in rows]
        for kind, rows in _stored("bounds").get(name, {"training": [], "test": []}).items()
    }


def baselines() -> dict[str, Score]:
    """Stored scores of the baselines by problem.

    >>> import jaxbeam as jb
    >>> print(f"{jb.benchmark.baselines()['patch'].mean:.0%}")
    94%
    """
    found = _stored("baselines")
    return {
        name: Score(name, TEST_SEEDS, np.array(one["shares"]), np.array(one["peaks"]))
        for name, one in found.items()
    }


def clear() -> None:
    """Clear the caches, so that stored bounds and baselines are read again."""
    published.cache_clear()
    _stored.cache_clear()


def _as_stored(value):
    return np.array(value) if isinstance(value, list) else value


@functools.cache
def _stored(name: str) -> dict[str, Any]:
    path = resources.files("jaxbeam.benchmark") / f"{name}.json"
    return json.loads(path.read_text("utf-8")) if path.is_file() else {}
