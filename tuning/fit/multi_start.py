"""A fit searched from many starts at once, and the table of the minima found."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.stats import norm, qmc

from tuning.checkpoint import load, save
from tuning.fit.least_squares import WEAK_PRIOR_WIDTH, LeastSquares
from tuning.parameters.free import FreeParameter

STARTS_PER_BLOCK = 8  # starts searched from side by side, and between two states on disk
SAME_MINIMUM_DISTANCE = 1e-2  # typical sizes: values closer than that are those of one minimum


@dataclasses.dataclass(frozen=True, eq=False)
class LocalMinimum:
    """Where searches ended: half the sum of weighted squares there, values, and from how many."""

    cost: float
    values: Float[np.ndarray, " free"]
    unbounded: Float[np.ndarray, " free"]
    starts: int
    converged: bool


def draw_start_points(
    parameters: Sequence[FreeParameter], count: int, seed: int
) -> Float[np.ndarray, "start free"]:
    """Search points to start from: the numbers' own first, then a Latin hypercube.

    Between two bounds all values (on the number's scale) are as likely; without, starts scatter
    around the number's own by about its typical size.
    """
    own = np.array([[number.to_unbounded(number.start) for number in parameters]])
    if count == 1:
        return own
    shares = qmc.LatinHypercube(len(parameters), rng=np.random.default_rng(seed)).random(count - 1)
    columns = []
    for i, number in enumerate(parameters):
        if np.isfinite(number.high - number.low):
            columns.append(number.unbounded_at_share(np.clip(shares[:, i], 1e-3, 1 - 1e-3)))
        else:
            width = WEAK_PRIOR_WIDTH / 2 * number.unbounded_size
            columns.append(own[0, i] + width * norm.ppf(shares[:, i]))
    return np.concatenate([own, np.stack(columns, axis=1)])


def multi_start(
    least_squares: LeastSquares,
    measured: Float[np.ndarray, "log time channel"],
    count: int,
    seed: int,
    checkpoint: Path | None = None,
    digest: str = "",
) -> list[LocalMinimum]:
    """Search from several starts, in blocks that run side by side; return minima, lowest first.

    The noise is that guessed from the samples, so that costs compare. After each block the state
    is written to the `checkpoint`, under its `digest`; if there is one already, the search goes on
    from there, to the same result. Searches that ended in no number are left out.

    Raises ValueError for a checkpoint that is damaged or of another search, and RuntimeError if
    no search ended in a number.
    """
    starts = draw_start_points(least_squares.parameters, count, seed)
    noise = least_squares.initial_noise(measured)
    found = {"points": np.empty((0, starts.shape[1])), "converged": np.empty(0, bool)}
    if checkpoint is not None and checkpoint.exists():
        found = load(checkpoint, digest)
    weights, free = least_squares.weights(noise), np.ones(len(least_squares.parameters), bool)
    while len(found["points"]) < count:
        block = starts[len(found["points"]) :][:STARTS_PER_BLOCK]
        scales = np.array([least_squares.step_scale(point, noise) for point in block])
        scales = np.where(np.isfinite(scales), scales, 1.0)
        points, converged = least_squares.minimise(block, scales, weights, measured, free)
        found = {
            "points": np.concatenate([found["points"], points]),
            "converged": np.concatenate([found["converged"], converged]),
        }
        if checkpoint is not None:
            save(checkpoint, digest, found)
    return _distinct_minima(least_squares, measured, noise, found)


def _distinct_minima(least_squares: LeastSquares, measured, noise, found) -> list[LocalMinimum]:
    """Gather what ended in the same place."""
    sizes = np.array([number.typical_size for number in least_squares.parameters])
    values = [least_squares.values_at(point) for point in found["points"]]
    costs = np.array([least_squares.cost(value, noise, measured) for value in values])
    minima: list[LocalMinimum] = []
    for i in np.argsort(costs, kind="stable"):
        if not np.isfinite(costs[i]):
            continue
        for j, minimum in enumerate(minima):
            if np.all(np.abs(minimum.values - values[i]) < SAME_MINIMUM_DISTANCE * sizes):
                minima[j] = dataclasses.replace(
                    minimum,
                    starts=minimum.starts + 1,
                    converged=minimum.converged or bool(found["converged"][i]),
                )
                break
        else:
            converged = bool(found["converged"][i])
            minima.append(
                LocalMinimum(float(costs[i]), values[i], found["points"][i], 1, converged)
            )
    if not minima:
        raise RuntimeError("no start led to values with which the case can be simulated")
    return minima
