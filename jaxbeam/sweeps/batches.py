"""Batches of a sweep: runs on one load path.

Loads that differ in masses, forces, springs or dampers only have the same path; step matrices that
depend on the path are computed once for all runs of a batch.
"""

import dataclasses
import re
from collections.abc import Collection

import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.case import Case, replace, unit_at, value_at
from jaxbeam.model.modes import Layout, mesh_layout

PATH_UNITS = {"m", "m/s", "s", "m/s^2"}  # of numbers of a load on which its path may depend
# Runs on one path, about, in a batch: many more exceed the cache of the processor. They are split
# evenly, as runs that fill a batch up take as long as others.
BATCH_SIZE, MAX_BATCH_SIZE = 256, 384

# Numbers that decide the order of positions, or the degrees and parts of a beam not uniform.
POSITION_ADDRESS = re.compile(
    r"beam\.(length|axial_force|foundation_stiffness|(segments|hinges)\..*)"
    r"|(supports|actuators)\.(\d+|\*)\.(position|start|end)"
)


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


def addresses_within_batches(case: Case, addresses: Collection[str]) -> list[str]:
    """Those of some addresses on which no path depends: masses, forces and springs of loads."""
    return [
        address
        for address in addresses
        if address == "run.gravity"
        or (address.startswith("loads.") and unit_at(case, address) not in PATH_UNITS)
    ]


def make_batches(
    addresses: list[str],
    runs: Float[np.ndarray, "run address"],
    within: Collection[str],
    most: int = MAX_BATCH_SIZE,
) -> Batches:
    """Batches of runs, which are given by their values at the addresses (SI units).

    Runs that differ in the values at the addresses `within` batches only share one, of `most` runs.
    """
    is_batched = np.array([address in within for address in addresses], bool)
    shared_values, batched_values = runs[:, ~is_batched], runs[:, is_batched]
    order = np.lexsort((np.zeros(len(runs)), *shared_values.T[::-1]))
    new_path = np.any(np.diff(shared_values[order], axis=0) != 0, axis=1)
    runs_by_path = np.split(order, np.flatnonzero(new_path) + 1)
    largest = max(part.size for part in runs_by_path)
    parts = max(-(-largest // most), round(largest / BATCH_SIZE), 1)
    batch_size = -(-largest // parts)
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


def values_at(case: Case, batches: Batches, address: str) -> Float[np.ndarray, " path"]:
    """Number at an address in each batch."""
    if address in batches.shared_addresses:
        return batches.shared_values[:, batches.shared_addresses.index(address)]
    return np.full(batches.shared_values.shape[0], float(value_at(case, address)))


def swept_masses(case: Case, batches: Batches) -> Float[np.ndarray, " path"]:
    """Sum of the swept masses of loads (kg) in each batch, of its run with the largest."""
    total = np.zeros(batches.run_index.shape)
    parts = (
        (batches.shared_addresses, batches.shared_values[:, None]),
        (batches.batched_addresses, batches.batched_values),
    )
    for addresses, values in parts:
        for i, address in enumerate(addresses):
            if address.startswith("loads.") and unit_at(case, address) == "kg":
                total = total + values[..., i]
    return total.max(axis=1)


def common_layout(case: Case, batches: Batches) -> Layout:
    """Layout of all batches: the common order of positions, with the largest degrees of any.

    Raises ValueError if positions along the beam change their order within the sweep.
    """
    varying = [i for i, a in enumerate(batches.shared_addresses) if POSITION_ADDRESS.fullmatch(a)]
    if not varying:
        return mesh_layout(case)
    values = np.unique(batches.shared_values[:, varying], axis=0)
    names = [batches.shared_addresses[i] for i in varying]
    layouts = [mesh_layout(replace(case, dict(zip(names, row, strict=True)))) for row in values]
    largest = {name: _largest(layouts, name) for name in ("degrees", "parts")}
    common = {dataclasses.replace(layout, **largest) for layout in layouts}
    if len(common) > 1:
        raise ValueError(
            f"positions along the beam change their order over {', '.join(names)}: split the sweep "
            "where supports or patch ends meet"
        )
    return common.pop()


def _largest(layouts: list[Layout], name: str) -> tuple[int, ...]:
    """Largest degrees or parts of each element in any layout, where all have as many elements."""
    numbers = [getattr(layout, name) for layout in layouts]
    if len({len(of_layout) for of_layout in numbers}) > 1:
        return numbers[0]
    return tuple(map(int, np.max(numbers, axis=0)))
