"""Batches of a sweep: runs on one load path.

Loads that differ in mass or force only have the same path; step matrices that depend on the path
are computed once for all runs of a batch.
"""

import dataclasses
import re

import numpy as np
from jaxtyping import Float, Int

BATCHED_ADDRESS = re.compile(r"loads\.\d+\.(mass|force)|run\.gravity")
MAX_BATCH_SIZE = 256  # runs; more exceed the cache of the processor


@dataclasses.dataclass(frozen=True)
class Batches:
    """Values of the runs at addresses of the case, in batches with one load path each.

    `shared_values` determine path and model, `batched_values` masses and forces of the loads.
    `run_index` is the number of each run, -1 for padding.
    """

    shared_addresses: tuple[str, ...]
    batched_addresses: tuple[str, ...]
    shared_values: Float[np.ndarray, "path shared"]
    batched_values: Float[np.ndarray, "path batch batched"]
    run_index: Int[np.ndarray, "path batch"]


def make_batches(
    addresses: list[str], runs: Float[np.ndarray, "run address"], one_run_each: bool = False
) -> Batches:
    """Batches of runs, which are given by their values at the addresses (SI units).

    Runs on one path share a batch, unless there is to be `one_run_each`, for controllers whose
    design depends on the loads.
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
