"""Fixed design: a control law designed for the nominal plant and used on uncertain plants."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx

from jaxbeam.case.case import Case, replace
from jaxbeam.model.modes import Layout
from jaxbeam.model.state_space import state_space


def with_fixed_design(case: Case, nominal: Mapping[str, Any], layout: Layout) -> Case:
    """Case whose control law is designed for the plant with `nominal` values at some addresses.

    Without that a law is designed for the plant of its case, hence for each uncertain plant anew.
    `layout` is the order of positions along the beam, the same for both.
    """
    if not nominal or case.controller is None:
        return case
    plant = state_space(replace(case, dict(nominal)), layout=layout)
    return eqx.tree_at(
        lambda c: c.controller.nominal_plant, case, plant, is_leaf=lambda leaf: leaf is None
    )
