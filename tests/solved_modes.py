"""Beams whose modes are tested, and their modes by one compiled program."""

import equinox as eqx
import numpy as np

from jaxbeam.case.actuators.base import Patch
from jaxbeam.case.beam import END_CONDITIONS, Beam, Support
from jaxbeam.case.case import Case
from jaxbeam.model.modes import Modes, mesh_layout, modes

PROPERTIES = {"flexural_rigidity": 11.68, "mass_per_length": 0.535}
PAIRS = [f"{left}-{right}" for left in END_CONDITIONS for right in END_CONDITIONS]
PATCHED = Case(
    Beam(1.3, 2.0, 0.7, ends="guided-free", modes=8),
    [Support(0.3, 500.0, 0.4, 3.0), Support(0.91), Support(1.25, 20.0)],
    [
        Patch(0.2, 0.45, 1e-3, added_mass=0.4, added_rigidity=1.0),
        Patch(0.4, 0.7, 1e-3, added_mass=0.1, added_rigidity=0.5),
    ],
)


@eqx.filter_jit
def _modes(case, layout):
    return modes(case, layout)


def solve(case: Case) -> Modes:
    """Modes of a case by one compiled program, faster than operation by operation."""
    return _modes(case, mesh_layout(case))


def parameters(case: Case, span: float) -> np.ndarray:
    """k times a length, of each mode of a beam of 11.68 N m^2 and 0.535 kg/m."""
    return (0.535 / 11.68 * np.asarray(solve(case).stiffness)) ** 0.25 * span


def supported_beam(stiffness, rotational_stiffness=0.0) -> Case:
    """Pinned beam on one support with a spring (N/m) and a rotational spring (N m/rad)."""
    return Case(
        Beam(1.2, **PROPERTIES, modes=12), [Support(0.5, stiffness, 0.0, rotational_stiffness)]
    )
