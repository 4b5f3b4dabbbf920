"""Static correction: what the modes that were left out would add to a response.

A few modes carry the motion, but a force at a point and the couples of a patch also bend the beam
locally, in high modes that follow without delay. Their share is the exact static response less
that of the modes which were kept. The deflection hardly needs it; curvature and the third
derivative, from which section forces follow, do.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.model.statics import influence_line, static_deflection_per_command
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.record import Record


def residual_actuator_gain(
    case: Case, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "actuator *place"]:
    """What the modes of the rig miss of `static_deflection_per_command` at x (m), in m/V or m/N.

    `derivative` (up to 3) gives that x-derivative instead. Suspensions act on both, the exact
    beam and the modes. Raises ValueError as `static_deflection_per_command` does.
    """
    layout = mesh_layout(case) if layout is None else layout
    exact = static_deflection_per_command(case, x, derivative, layout)
    return exact - _modal_actuator_gain(case, layout, jnp.asarray(x, float), derivative)


@compiled
def _modal_actuator_gain(case: Case, layout: Layout, x, derivative: int):
    model = modal_model(case, layout)
    steady_forces = jnp.array([a.attachment().static_gain for a in case.actuators]).reshape(-1)
    amplitudes = jnp.linalg.solve(model.stiffness(), model.displacement_map.T * steady_forces)
    return jnp.moveaxis(model.shapes(x, (derivative,))[0] @ amplitudes, -1, 0)


def residual_flexibility(
    case: Case, x, load_positions, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "..."]:
    """What the modes of the rig miss of `influence_line`, in m/N: (position..., place...).

    The rest is as for `residual_actuator_gain`.
    """
    layout = mesh_layout(case) if layout is None else layout
    exact = influence_line(case, x, load_positions, derivative, layout)
    x, load_positions = jnp.asarray(x, float), jnp.asarray(load_positions, float)
    return exact - _modal_influence_line(case, layout, x, load_positions, derivative)


@compiled
def _modal_influence_line(case: Case, layout: Layout, x, load_positions, derivative: int):
    model = modal_model(case, layout)
    load_shapes = model.shapes(load_positions.reshape(-1), (0,))[0]
    amplitudes = jnp.linalg.solve(model.stiffness(), -load_shapes.T)
    line = model.shapes(x.reshape(-1), (derivative,))[0] @ amplitudes
    return line.T.reshape(*load_positions.shape, *x.shape)


def corrected_deflection(
    record: Record, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "time *place"]:
    """History of a record's deflection at x (m), statically corrected, in m.

    The sum of the modes, and what they miss of the deflection under the contact forces and the
    commands of each instant; `derivative` (up to 3) gives that x-derivative instead. Good where
    forces and commands change slowly beside the first mode that was left out. Raises ValueError
    as `influence_line` does.
    """
    case, x = record.case, jnp.asarray(x, float)
    shapes = record.modes.shapes(x, derivative)
    history = jnp.tensordot(record.coordinates, shapes, axes=[1, -1])
    if case.loads:
        load_positions = jnp.where(jnp.isfinite(record.load_position), record.load_position, 0.0)
        residual = residual_flexibility(case, x, load_positions, derivative, layout)
        history = history + jnp.einsum("tl,tl...->t...", record.contact_force, residual)
    if case.controller is not None:
        residual = residual_actuator_gain(case, x, derivative, layout)
        history = history + jnp.tensordot(record.command, residual, axes=1)
    return history


# Section forces


def bending_moment(case: Case, x, curvature, commands=None) -> Float[Array, "..."]:
    """Moment in the section at x (m), beam and patches together, in N m; sagging is positive.

    M = E I w'' + the moments that patches over x make themselves, so that it balances what acts
    on the beam from outside: a patch alone leaves none in a statically determinate beam.
    `curvature` (..., *place) is w'' in 1/m, from `static_deflection_per_command`, `corrected_deflection` or `influence_line`;
    `commands` (..., actuator) are in V or N, zero if left out. At the edge of a patch it is the
    moment to the right.
    """
    x = jnp.asarray(x, float)
    info = _bending_stiffness(case, x) * curvature
    for i, actuator in enumerate(case.actuators if commands is not None else ()):
        # Couples come in opposite pairs, and the section between them carries them.
        couples = [
            (place, factor) for place, order, factor in actuator.displacement_map() if order == 1
        ]
        inside = sum((f * _unit_step(case, x, place) for place, f in couples), jnp.zeros(x.shape))
        couple = actuator.attachment().static_gain * jnp.asarray(commands, float)[..., i]
        info = info + jnp.tensordot(couple, inside, axes=0)
    return info


def shear_force(case: Case, x, third_derivative) -> Float[Array, "..."]:
    """Shear force in the section at x (m) in N: the slope of the bending moment along the beam.

    `third_derivative` (..., *place) is the third x-derivative of the deflection in 1/m^2. At a point force
    it is that to the right.
    """
    return _bending_stiffness(case, jnp.asarray(x, float)) * third_derivative


def _bending_stiffness(case: Case, x):
    """Bending stiffness E I at x in N m^2, patches included."""
    rigidity = jnp.full(x.shape, case.beam.bending_stiffness)
    for patch in filter(None, (actuator.section_stiffening() for actuator in case.actuators)):
        inside = _unit_step(case, x, patch.start) - _unit_step(case, x, patch.end)
        rigidity = rigidity + patch.bending_stiffness * inside
    return rigidity


def _unit_step(case: Case, x, position):
    """1 from a place on, 0 before it; the right end belongs to what lies left of it."""
    return jnp.where((x >= position) & (position < case.beam.length), 1.0, 0.0)
