"""Layout of supports and patches that all runs of a sweep share."""

import dataclasses
import re

import numpy as np

from jaxbeam.case.case import Case, replace
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.sweeps.batches import Batches

# Numbers that decide the order of positions, or the degrees and parts of a beam not uniform.
POSITION_ADDRESS = re.compile(
    r"beam\.(length|axial_force|foundation_stiffness|(segments|hinges)\..*)"
    r"|(supports|actuators)\.(\d+|\*)\.(position|start|end)"
)


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
