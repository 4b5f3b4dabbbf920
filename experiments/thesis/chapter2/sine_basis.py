"""Modes of supported beams by the approximation of the thesis: springs in sine modes.

Kept to reproduce printed numbers and to compare with `jaxbeam.modes`, which is exact. A rigid
support becomes a stiff spring, and each such spring adds one spurious mode, the last of the list.
"""

import dataclasses

import jax.numpy as jnp

from jaxbeam.case.case import Case
from jaxbeam.model.modes import Modes, modes, normalised_modes
from jaxbeam.numerics.matrices import eigen

RIGID_SUPPORT_STIFFNESS = 3.21e10  # N/m, reproduces Table 2.2 of the thesis to all printed digits


def sine_basis_modes(case: Case, rigid_stiffness: float = RIGID_SUPPORT_STIFFNESS) -> Modes:
    """Modes of a supported beam in the first m modes of the same beam without its supports.

    [diag(w_1^2 ... w_m^2) + sum_i k_i psi(x_i) psi(x_i)^T - w^2] p = 0, shapes sum_k psi_k p_k,
    eqs (2.18) to (2.21) of the thesis; psi are sines if the ends are pinned, and m is
    `case.beam.modes`. Rigid supports are springs of `rigid_stiffness` in N/m; rotational springs
    enter alike, with slopes. Frequencies (Hz) and mass-normalised shapes are those of the result.
    """
    beam = case.beam
    unsupported = modes(dataclasses.replace(case, supports=()))
    stiffness = jnp.diag(unsupported.stiffness) + unsupported.coupling
    for support in case.supports:
        spring = rigid_stiffness if support.stiffness is None else support.stiffness
        shape, slope = unsupported.shape_derivatives(support.position, (0, 1))
        stiffness = stiffness + spring * jnp.outer(shape, shape)
        stiffness = stiffness + support.rotational_stiffness * jnp.outer(slope, slope)
    values, eigenvectors, coupling = eigen(
        stiffness / unsupported.stiffness_unit, jnp.eye(beam.modes)
    )
    series = unsupported.series @ eigenvectors
    return normalised_modes(
        beam,
        values * unsupported.stiffness_unit,
        coupling * unsupported.stiffness_unit,
        unsupported.nodes,
        series,
        unsupported.layout,
    )
