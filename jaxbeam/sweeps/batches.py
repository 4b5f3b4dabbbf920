"""Many runs arranged for speed: tasks that share a path, lanes within them.

Loads that differ only in mass or force cross the beam on the same path; all that depends on the
path is then computed once for them. A task is one path; its lanes are the runs on it.
"""

import dataclasses
import re

import numpy as np
from jaxtyping import Float, Int

LIGHT = re.compile(r"loads\.\d+\.(mass|force)|run\.gravity")
MOST_RUNS = 10**9  # of a sweep: more would not fit into any memory
LANES = 256  # more lanes in one task fall out of the cache


@dataclasses.dataclass(frozen=True)
class Tasks:
    """Runs by task and lane: `heavy` values decide the path and the rig, `light` the loads.

    `index` is the number of the run, -1 for lanes that only fill up a task.
    """

    heavy_addresses: tuple[str, ...]
    light_addresses: tuple[str, ...]
    heavy: Float[np.ndarray, "task heavy"]
    light: Float[np.ndarray, "task lane light"]
    index: Int[np.ndarray, "task lane"]


def arrange(
    addresses: list[str], runs: Float[np.ndarray, "run address"], alone: bool = False
) -> Tasks:
    """Arrange runs, given by their values at the addresses (SI units), into tasks and lanes.

    Runs on one path share a task unless they are to be `alone`: a controller that is designed for
    the loads is another one in each.
    """
    is_light = np.array([bool(LIGHT.fullmatch(address)) and not alone for address in addresses])
    heavy, light = runs[:, ~is_light], runs[:, is_light]
    order = np.lexsort((np.zeros(len(runs)), *heavy.T[::-1]))
    apart = np.any(np.diff(heavy[order], axis=0) != 0, axis=1)
    members = np.split(order, np.flatnonzero(apart) + 1)
    lanes = min(LANES, max(part.size for part in members))
    rows = [part[i : i + lanes] for part in members for i in range(0, part.size, lanes)]
    index = np.full((len(rows), lanes), -1)
    for row, runs_of_row in zip(index, rows, strict=True):
        row[: runs_of_row.size] = runs_of_row
    filled = np.where(index < 0, index[:, :1], index)
    names = np.array(addresses)
    return Tasks(
        tuple(names[~is_light].tolist()),
        tuple(names[is_light].tolist()),
        heavy[filled[:, 0]],
        light[filled],
        index,
    )
