"""Reduced-order feedback: which states to feed back, found by a search whose shares are relaxed."""

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.control.optimal.lqr import AbstractRegulator
from tuning.control.load_cases import LoadCases
from tuning.control.objective import Objective
from tuning.control.tune import ParameterBounds, tune
from tuning.control.tuning_result import TuningResult

FEEDBACK_ADDRESS = "controller.feedback"
SHARE_PENALTY = 10.0  # of the objective, for shares that together are one off
CANDIDATE_COUNT = 3  # states that may be the last to be fed back


@dataclasses.dataclass(frozen=True, eq=False)
class ReducedFeedback:
    """States that are fed back (`fed_back`, from 0), by their `shares` in the relaxed search.

    `tuned` is what the others came to once the shares were rounded; its start is the rounded law.
    """

    fed_back: tuple[int, ...]
    shares: Float[np.ndarray, " state"]
    relaxed: TuningResult
    tuned: TuningResult

    def __str__(self) -> str:
        lines = [f"{'state':<8}{'share':>8}  fed back"]
        for state, share in enumerate(self.shares):
            lines.append(f"{state:<8}{share:>8.3f}  {'yes' if state in self.fed_back else 'no'}")
        rounded, tuned = self.tuned.run_sets[0].objective
        relaxed = self.relaxed.run_sets[0].objective[1]
        lines += [
            "",
            f"objective on training: {relaxed:.5g} with these shares, {rounded:.5g} when they are"
            f" rounded, {tuned:.5g} when the others are tuned again",
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
    """Tune a regulator that feeds back only `keep` of its states, and find which.

    First the share of every state (the law's `feedback`) is a free number from 0 to 1, tuned with
    the others while the shares together come to `keep`. Then the largest become 1, the others 0,
    and the numbers in `free` are tuned once more, from where they had come to; for the last of the
    states the next in line are tried as well, and the best on training runs is taken. `options` are
    those of `tune`, without checkpoints.

    Raises ValueError for a controller that is no regulator, for a number of states that it has
    not, and as `tune` does.
    """
    law = case.controller
    if not isinstance(law, AbstractRegulator):
        raise ValueError("only regulators, such as kind 'lqr', have states to leave out")
    states = int(law.state_weight.shape[0])
    if not 1 <= keep < states:
        raise ValueError(f"keep must be 1 to {states - 1} of the {states} states; it is {keep}")
    if any(address.startswith(FEEDBACK_ADDRESS) for address in free) or "checkpoint" in options:
        raise ValueError(f"leave {FEEDBACK_ADDRESS} out of what is free, and name no checkpoint")
    names = [f"{FEEDBACK_ADDRESS}.{state}" for state in range(states)]
    shared = dict.fromkeys(names, (0.0, 1.0))

    def penalty(values):
        # Both ways: weights make up for shares that are all too small.
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
    found = {n.address: x for n, x in zip(relaxed.parameters, relaxed.values, strict=True)}
    shares = np.array([found[name] for name in names])
    order = np.argsort(-shares, kind="stable")
    # What is best in part need not be when whole: the last places are tried out.
    candidates = [
        np.append(order[: keep - 1], last) for last in order[keep - 1 :][:CANDIDATE_COUNT]
    ]
    results = []
    for kept in candidates:
        rounded = _with_feedback(relaxed.case, np.isin(np.arange(states), kept).astype(float))
        results.append(tune(rounded, free, cases, objective, **options))
    best = min(
        range(len(candidates)),
        key=lambda i: (results[i].violation > 0, results[i].run_sets[0].objective[1]),
    )
    return ReducedFeedback(
        tuple(sorted(map(int, candidates[best]))), shares, relaxed, results[best]
    )


def _with_feedback(case: Case, shares: Float[np.ndarray, " state"]) -> Case:
    """The case with other shares of its states fed back."""
    law = dataclasses.replace(case.controller, feedback=shares)
    return dataclasses.replace(case, controller=law)
