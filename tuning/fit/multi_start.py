"""Multi-start search: a fit searched from several points, and the distinct minima found."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.stats import norm, qmc

from tuning.checkpoint import NO_CHECKPOINT, Checkpoint
from tuning.fit.least_squares import WEAK_PRIOR_WIDTH, LeastSquares
from tuning.parameters.free import FreeParameter

STARTS_PER_BLOCK = 8  # starts between two checkpoints
SAME_MINIMUM_DISTANCE = 1e-2  # typical sizes; values closer than that belong to one minimum


@dataclasses.dataclass(frozen=True, eq=False)
class LocalMinimum:
    """A minimum of the misfit, and the number of starts that led to it.

    `cost` is half the sum of weighted squares, `unbounded` the search variables of the values.
    """

    cost: float
    values: Float[np.ndarray, " parameter"]
    unbounded: Float[np.ndarray, " parameter"]
    starts: int
    converged: bool


def draw_start_points(
    parameters: Sequence[FreeParameter], count: int, seed: int
) -> Float[np.ndarray, "start parameter"]:
    """Search points: the parameters' own starts first, then a Latin hypercube.

    Between two bounds the draws are even on the parameter's scale; without, they scatter around
    its own start by about its typical size.
    """
    own = np.array([[p.to_unbounded(p.start) for p in parameters]])
    if count == 1:
        return own
    shares = qmc.LatinHypercube(len(parameters), rng=np.random.default_rng(seed)).random(count - 1)
    columns = []
    for i, parameter in enumerate(parameters):
        if np.isfinite(parameter.high - parameter.low):
            columns.append(parameter.unbounded_at_share(np.clip(shares[:, i], 1e-3, 1 - 1e-3)))
        else:
            width = WEAK_PRIOR_WIDTH / 2 * parameter.unbounded_size
            columns.append(own[0, i] + width * norm.ppf(shares[:, i]))
    return np.concatenate([own, np.stack(columns, axis=1)])


def multi_start(
    least_squares: LeastSquares,
    measured: Float[np.ndarray, "log time channel"],
    count: int,
    seed: int,
    checkpoint: Checkpoint = NO_CHECKPOINT,
) -> list[LocalMinimum]:
    """Minima found from `count` starts, lowest first.

    All searches take the noise estimated from the samples, so that their costs compare. Searches
    that end in values with which the case cannot be simulated are left out. The checkpoint is
    written after each block of starts; a search that finds one goes on from there, to the same
    result.

    Raises ValueError for a checkpoint that is damaged or of another search, and RuntimeError if
    the case cannot be simulated at any of the ends.
    """
    starts = draw_start_points(least_squares.parameters, count, seed)
    noise = least_squares.initial_noise(measured)
    found = checkpoint.load() or {
        "points": np.empty((0, starts.shape[1])),
        "converged": np.empty(0, bool),
    }
    weights, free = least_squares.weights(noise), np.ones(len(least_squares.parameters), bool)
    while len(found["points"]) < count:
        block = starts[len(found["points"]) :][:STARTS_PER_BLOCK]
        scales = np.array([least_squares.step_scale(point, noise) for point in block])
        scales = np.where(np.isfinite(scales), scales, 1.0)
        ends = [
            least_squares.minimise(point, scale, weights, measured, free)
            for point, scale in zip(block, scales, strict=True)
        ]
        points, converged = zip(*ends, strict=True)
        found = {
            "points": np.concatenate([found["points"], points]),
            "converged": np.concatenate([found["converged"], converged]),
        }
        checkpoint.save(found)
    return _distinct_minima(least_squares, measured, noise, found)


def _distinct_minima(least_squares: LeastSquares, measured, noise, found) -> list[LocalMinimum]:
    """Ends of searches, those at the same values taken together."""
    sizes = np.array([parameter.typical_size for parameter in least_squares.parameters])
    values = [least_squares.values_at(point) for point in found["points"]]
    costs = np.array([least_squares.cost(value, noise, measured) for value in values])
    minima: list[LocalMinimum] = []
    for i in np.argsort(costs, kind="stable"):
        if not np.isfinite(costs[i]):
            continue
        converged = bool(found["converged"][i])
        for j, minimum in enumerate(minima):
            if np.all(np.abs(minimum.values - values[i]) < SAME_MINIMUM_DISTANCE * sizes):
                minima[j] = dataclasses.replace(
                    minimum,
                    starts=minimum.starts + 1,
                    converged=minimum.converged or converged,
                )
                break
        else:
            point = found["points"][i]
            minima.append(LocalMinimum(float(costs[i]), values[i], point, 1, converged))
    if not minima:
        raise RuntimeError(
            "no start led to values with which the case can be simulated: begin closer to the"
            " logs, or give the free parameters narrower bounds"
        )
    return minima
