"""A fit searched from many starts at once, and the table of the minima found."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.stats import norm, qmc

from tuning.checkpoint import load, save
from tuning.fit.least_squares import LEASH, Search
from tuning.parameters.free import Free

BLOCK = 8  # starts searched from side by side, and between two states on disk
SAME = 1e-2  # typical sizes: values closer than that are those of one minimum


@dataclasses.dataclass(frozen=True, eq=False)
class Minimum:
    """Where searches ended: half the sum of weighted squares there, values, and from how many."""

    cost: float
    values: Float[np.ndarray, " free"]
    point: Float[np.ndarray, " free"]
    starts: int
    converged: bool


def draw_starts(numbers: Sequence[Free], count: int, seed: int) -> Float[np.ndarray, "start free"]:
    """Search points to start from: the numbers' own first, then a Latin hypercube.

    Between two bounds all values (on the number's scale) are as likely; without, starts scatter
    around the number's own by about its typical size.
    """
    own = np.array([[number.inward(number.start) for number in numbers]])
    if count == 1:
        return own
    shares = qmc.LatinHypercube(len(numbers), rng=np.random.default_rng(seed)).random(count - 1)
    columns = []
    for i, number in enumerate(numbers):
        if np.isfinite(number.high - number.low):
            columns.append(number.at_share(np.clip(shares[:, i], 1e-3, 1 - 1e-3)))
        else:
            reach = LEASH / 2 * number.search_size
            columns.append(own[0, i] + reach * norm.ppf(shares[:, i]))
    return np.concatenate([own, np.stack(columns, axis=1)])


def scout(
    search: Search,
    measured: Float[np.ndarray, "log time channel"],
    count: int,
    seed: int,
    checkpoint: Path | None = None,
    mark: str = "",
) -> list[Minimum]:
    """Search from several starts, in blocks that run side by side; return minima, lowest first.

    The noise is that guessed from the samples, so that costs compare. After each block the state
    is written to the `checkpoint`, under its `mark`; if there is one already, the search goes on
    from there, to the same result. Searches that ended in no number are left out.

    Raises ValueError for a checkpoint that is damaged or of another search, and RuntimeError if
    no search ended in a number.
    """
    starts = draw_starts(search.numbers, count, seed)
    noise = search.first_noise(measured)
    found = {"points": np.empty((0, starts.shape[1])), "converged": np.empty(0, bool)}
    if checkpoint is not None and checkpoint.exists():
        found = load(checkpoint, mark)
    weights, free = search.weights(noise), np.ones(len(search.numbers), bool)
    while len(found["points"]) < count:
        block = starts[len(found["points"]) :][:BLOCK]
        scales = np.array([search.scale(point, noise) for point in block])
        scales = np.where(np.isfinite(scales), scales, 1.0)
        points, converged = search.minimise(block, scales, weights, measured, free)
        found = {
            "points": np.concatenate([found["points"], points]),
            "converged": np.concatenate([found["converged"], converged]),
        }
        if checkpoint is not None:
            save(checkpoint, mark, found)
    return _minima(search, measured, noise, found)


def _minima(search: Search, measured, noise, found) -> list[Minimum]:
    """Gather what ended in the same place."""
    sizes = np.array([number.size for number in search.numbers])
    values = [search.values_at(point) for point in found["points"]]
    costs = np.array([search.cost(value, noise, measured) for value in values])
    minima: list[Minimum] = []
    for i in np.argsort(costs, kind="stable"):
        if not np.isfinite(costs[i]):
            continue
        for j, known in enumerate(minima):
            if np.all(np.abs(known.values - values[i]) < SAME * sizes):
                minima[j] = dataclasses.replace(
                    known,
                    starts=known.starts + 1,
                    converged=known.converged or bool(found["converged"][i]),
                )
                break
        else:
            converged = bool(found["converged"][i])
            minima.append(Minimum(float(costs[i]), values[i], found["points"][i], 1, converged))
    if not minima:
        raise RuntimeError("no start led to values with which the case can be simulated")
    return minima
