"""Layout of supports and patches that all runs of a sweep share."""

import dataclasses
import re

import numpy as np

from jaxbeam.case.case import Case, replace
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.sweeps.batches import Batches

POSITION_ADDRESS = re.compile(r"beam\.length|(supports|actuators)\.(\d+|\*)\.(position|start|end)")


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
    degrees = layouts[0].degrees
    if len({len(layout.degrees) for layout in layouts}) == 1:
        degrees = np.max([layout.degrees for layout in layouts], axis=0)
    common = {dataclasses.replace(layout, degrees=tuple(map(int, degrees))) for layout in layouts}
    if len(common) > 1:
        raise ValueError(
            f"positions along the beam change their order over {', '.join(names)}: split the sweep "
            "where supports or patch ends meet"
        )
    return common.pop()
