"""The thesis's own approximation of supported beams: springs in the modes of the beam without.

Kept as what it is, to reproduce printed numbers and to compare with; the product's own `modes`
are exact. A rigid support becomes a stiff spring, and each such spring makes one spurious mode,
the last of the list.
"""

import dataclasses

import jax.numpy as jnp

from jaxbeam.case.case import Case
from jaxbeam.model.modes import Modes, modes, oriented
from jaxbeam.numerics.eigen import eigen

RIGID = 3.21e10  # N/m; with it Table 2.2 of the thesis is reproduced to all printed digits


def sine_basis_modes(case: Case, rigid_stiffness: float = RIGID) -> Modes:
    """Modes of a supported beam in the first m modes of the same beam without its supports.

    [diag(w_1^2 ... w_m^2) + sum_i k_i psi(x_i) psi(x_i)^T - w^2] p = 0, shapes sum_k psi_k p_k,
    eqs (2.18) to (2.21) of the thesis; psi are sines if the ends are pinned, and m is
    `case.beam.modes`. Rigid supports are springs of `rigid_stiffness` in N/m; rotational springs
    enter alike, with slopes. Frequencies (Hz) and mass-normalised shapes are those of the result.
    """
    beam = case.beam
    bare = modes(dataclasses.replace(case, supports=()))
    stiffness = jnp.diag(bare.stiffness) + bare.coupling
    for support in case.supports:
        spring = rigid_stiffness if support.stiffness is None else support.stiffness
        shape, slope = bare.shapes_together(support.position, (0, 1))
        stiffness = stiffness + spring * jnp.outer(shape, shape)
        stiffness = stiffness + support.rotational_stiffness * jnp.outer(slope, slope)
    values, mix, coupling = eigen(stiffness / bare.unit, jnp.eye(beam.modes))
    series = bare.series @ mix
    return oriented(beam, values * bare.unit, coupling * bare.unit, bare.nodes, series)
