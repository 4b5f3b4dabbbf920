"""Beams whose modes are tested, and their modes, compiled as a whole."""

import equinox as eqx
import numpy as np

from jaxbeam.case.actuators import Patch
from jaxbeam.case.beam import ENDS, Beam, Support
from jaxbeam.case.case import Case
from jaxbeam.model.modes import Modes, lay_out, modes

STUFF = {"flexural_rigidity": 11.68, "mass_per_length": 0.535}
PAIRS = [f"{left}-{right}" for left in ENDS for right in ENDS]
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
    """Compiled as a whole, which is faster than step by step."""
    return _modes(case, lay_out(case))


def parameters(case: Case, span: float) -> np.ndarray:
    """k times a length, of each mode of a beam of 11.68 N m^2 and 0.535 kg/m."""
    return (0.535 / 11.68 * np.asarray(solve(case).stiffness)) ** 0.25 * span


def held(stiffness, turn=0.0) -> Case:
    """A pinned beam with one support of given springs."""
    return Case(Beam(1.2, **STUFF, modes=12), [Support(0.5, stiffness, 0.0, turn)])
