"""Buckling of a beam in compression."""

import equinox as eqx
import numpy as np

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import concrete
from jaxbeam.model.layout import Layout
from jaxbeam.model.theory.elements import assemble_sections
from jaxbeam.model.theory.sections import sections
from jaxbeam.runtime.arrays import xp

NO_FORCE = 1e-6  # of E I / L^2: a critical force below this is that of a rigid body
RIGID_BODY_SHIFT = 1e-10  # of the mass matrix: makes the stiffness of a free beam invertible


def check_buckling(case: Case, layout: Layout) -> None:
    """Check that the axial force does not make the beam buckle.

    Raises ValueError, with the critical force.
    """
    force = case.beam.axial_force
    if force is None or not float(concrete(force)) < 0:
        return
    critical = critical_axial_force(concrete_case(case), layout)
    if critical > -NO_FORCE * float(concrete(case.beam.bending_stiffness / case.beam.length**2)):
        raise ValueError(
            f"beam.axial_force is {float(concrete(force)):g} N, but the beam ({case.beam.ends}) can"
            " turn as a rigid body, so that any compression makes it buckle: hold it, or leave the"
            " compression out"
        )
    if float(concrete(force)) <= critical:
        raise ValueError(
            f"beam.axial_force is {float(concrete(force)):g} N, but the beam buckles at"
            f" {critical:.6g} N (compression is negative): reduce it, or hold the beam"
        )


def critical_axial_force(case: Case, layout: Layout) -> float:
    """Axial force (N) at which the beam buckles, negative; suspensions of actuators left out.

    K_0 x = -T G x, with the stiffness K_0 without axial force and G = int w'^2.
    """
    found = sections(case, layout)
    matrices = []
    for axial_force in (0.0, 1.0):
        changed = eqx.tree_at(lambda s: s.axial_force, found, xp.asarray(axial_force))
        stiffness, mass, *_ = assemble_sections(case, layout, changed)
        matrices.append(np.asarray(stiffness))
    stiffness = matrices[0] + RIGID_BODY_SHIFT * np.asarray(mass)
    factor = np.linalg.inv(np.linalg.cholesky(stiffness))
    largest = np.linalg.eigvalsh(factor @ (matrices[1] - matrices[0]) @ factor.T)[-1]
    unit = float(case.beam.bending_stiffness) / float(case.beam.length) ** 2
    return -unit / float(largest)
