"""Reduced-order feedback: the states to feed back, selected by a search over relaxed shares."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.control.optimal.lqr import LQR
from jaxbeam.runtime.printer import text_table
from tuning.control.load_cases import LoadCases
from tuning.control.objective import Objective
from tuning.control.tune import ParameterBounds, tune
from tuning.control.tuning_result import TuningResult

FEEDBACK_ADDRESS = "controller.feedback"
SHARE_PENALTY = 10.0  # added to the objective if the sum of the shares is off by one
CANDIDATE_COUNT = 3  # states tried as the last one to be fed back


@dataclasses.dataclass(frozen=True, eq=False)
class ReducedFeedback:
    """Indices of the states that are fed back, and all `shares` of the relaxed search.

    `relaxed` is the result with these shares, `tuned` that with the shares rounded and the other
    parameters tuned again.
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


def tune_reduced(
    case: Case,
    keep: int,
    free: ParameterBounds,
    cases: LoadCases,
    objective: Objective | None = None,
    **options: Any,
) -> ReducedFeedback:
    """Tune a regulator that feeds back `keep` of its states only, and select these.

    First the share of each state (the controller's `feedback`) is a free parameter from 0 to 1,
    with a penalty that keeps their sum at `keep`. Then the largest shares become 1, the others 0,
    and the parameters in `free` are tuned again from their last values; for the last state the next
    largest shares are tried as well, and the best on training runs is the result. `options` are
    those of `tune`, without a checkpoint.

    Raises ValueError for a controller that is no regulator, for more states than it has, and as
    `tune` does.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     actuators=[jb.PointForce(0.3, limits=(-2.0, 2.0))],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.3, speed=2.0)],
    ...     controller=jb.LQR(state_weight=[1e6, 1.0], command_weight=[1e-2], period=0.01),
    ...     run=jb.Run(0.3),
    ... )
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
        # On both sides: weights can compensate shares that are all too small.
        total = jnp.sum(jnp.stack([values[name] for name in names]))
        return SHARE_PENALTY * (total - keep) ** 2

    relaxed = tune(
        _with_feedback(case, np.full(states, keep / states)),
        dict(free) | shared,
        cases,
        objective,
        penalty=penalty,
        **options,
    )
    pairs = zip(relaxed.parameters, relaxed.values, strict=True)
    found = {parameter.address: value for parameter, value in pairs}
    shares = np.array([found[name] for name in names])
    order = np.argsort(-shares, kind="stable")
    # The best relaxed shares need not be the best when rounded.
    candidates = [
        np.append(order[: keep - 1], last) for last in order[keep - 1 :][:CANDIDATE_COUNT]
    ]
    results = []
    for kept in candidates:
        rounded = _with_feedback(relaxed.case, np.isin(np.arange(states), kept).astype(float))
        results.append(tune(rounded, free, cases, objective, **options))
    best = min(
        range(len(candidates)),
        key=lambda i: (results[i].stability_violation > 0, results[i].run_sets[0].objective[1]),
    )
    return ReducedFeedback(
        tuple(sorted(map(int, candidates[best]))), shares, relaxed, results[best]
    )


def _with_feedback(case: Case, shares: Float[np.ndarray, " state"]) -> Case:
    """The case with other shares of its controller's states fed back."""
    controller = dataclasses.replace(case.controller, feedback=shares)
    return dataclasses.replace(case, controller=controller)
