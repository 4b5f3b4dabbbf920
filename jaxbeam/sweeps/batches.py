"""Many runs arranged for speed: tasks that share a path, lanes within them.

Loads that differ only in mass or force cross the beam on the same path; all that depends on the
path is then computed once for them. A task is one path; its lanes are the runs on it.
"""

import dataclasses
import re

import numpy as np
from jaxtyping import Float, Int

BATCHED_ADDRESS = re.compile(r"loads\.\d+\.(mass|force)|run\.gravity")
MAX_BATCH_SIZE = 256  # more lanes in one task fall out of the cache


@dataclasses.dataclass(frozen=True)
class Batches:
    """Runs by task and lane: `shared_values` values decide the path and the rig, `batched_values` the loads.

    `run_index` is the number of the run, -1 for lanes that only fill up a task.
    """

    shared_addresses: tuple[str, ...]
    batched_addresses: tuple[str, ...]
    shared_values: Float[np.ndarray, "task heavy"]
    batched_values: Float[np.ndarray, "task lane light"]
    run_index: Int[np.ndarray, "task lane"]


def make_batches(
    addresses: list[str], runs: Float[np.ndarray, "run address"], one_run_each: bool = False
) -> Batches:
    """Arrange runs, given by their values at the addresses (SI units), into tasks and lanes.

    Runs on one path share a task unless they are to be `one_run_each`: a controller that is designed for
    the loads is another one in each.
    """
    is_batched = np.array(
        [bool(BATCHED_ADDRESS.fullmatch(address)) and not one_run_each for address in addresses]
    )
    shared_values, batched_values = runs[:, ~is_batched], runs[:, is_batched]
    order = np.lexsort((np.zeros(len(runs)), *shared_values.T[::-1]))
    new_path = np.any(np.diff(shared_values[order], axis=0) != 0, axis=1)
    runs_by_path = np.split(order, np.flatnonzero(new_path) + 1)
    batch_size = min(MAX_BATCH_SIZE, max(part.size for part in runs_by_path))
    rows = [
        part[i : i + batch_size] for part in runs_by_path for i in range(0, part.size, batch_size)
    ]
    index = np.full((len(rows), batch_size), -1)
    for row, runs_of_row in zip(index, rows, strict=True):
        row[: runs_of_row.size] = runs_of_row
    padded_index = np.where(index < 0, index[:, :1], index)
    names = np.array(addresses)
    return Batches(
        tuple(names[~is_batched].tolist()),
        tuple(names[is_batched].tolist()),
        shared_values[padded_index[:, 0]],
        batched_values[padded_index],
        index,
    )
