"""Static correction: quasi-static response of the truncated modes; section forces.

Point forces and the couples of a patch also bend the beam locally, in high modes that respond
quasi-statically: by the exact static response less that of the modes kept. The correction of the
deflection is small; curvature and third derivative, hence section forces, need it.
"""

from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.model.statics import influence_line, static_deflection_per_command
from jaxbeam.runtime.arrays import Array, solve, xp
from jaxbeam.runtime.compiling import compiled_if_traced
from jaxbeam.simulation.record import Record


def residual_actuator_gain(
    case: Case, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "actuator *position"]:
    """Residual of the modes in `static_deflection_per_command` at x (m), in m/V or m/N.

    `derivative` (up to 3) gives that x-derivative instead. Suspensions act on both, the exact beam
    and the modes. Raises ValueError as `static_deflection_per_command` does.
    """
    layout = mesh_layout(case) if layout is None else layout
    exact = static_deflection_per_command(case, x, derivative, layout)
    return exact - _modal_actuator_gain(case, layout, xp.asarray(x, float), derivative)


@compiled_if_traced
def _modal_actuator_gain(case: Case, layout: Layout, x, derivative: int):
    model = modal_model(case, layout)
    steady_forces = xp.array([a.attachment().static_gain for a in case.actuators]).reshape(-1)
    amplitudes = solve(model.stiffness(), model.displacement_map.T * steady_forces)
    return xp.moveaxis(model.shapes(x, (derivative,))[0] @ amplitudes, -1, 0)


def residual_flexibility(
    case: Case, x, load_positions, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "..."]:
    """Residual flexibility: residual of the modes in `influence_line`, (load position..., x...).

    In m/N, or of an x-derivative as there. Raises ValueError as `influence_line` does.
    """
    layout = mesh_layout(case) if layout is None else layout
    exact = influence_line(case, x, load_positions, derivative, layout)
    x, load_positions = xp.asarray(x, float), xp.asarray(load_positions, float)
    return exact - _modal_influence_line(case, layout, x, load_positions, derivative)


@compiled_if_traced
def _modal_influence_line(case: Case, layout: Layout, x, load_positions, derivative: int):
    model = modal_model(case, layout)
    load_shapes = model.shapes(load_positions.reshape(-1), (0,))[0]
    amplitudes = solve(model.stiffness(), -load_shapes.T)
    line = model.shapes(x.reshape(-1), (derivative,))[0] @ amplitudes
    return line.T.reshape((*load_positions.shape, *x.shape))


def corrected_deflection(
    record: Record, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "time *position"]:
    """Statically corrected history of a record's deflection at x (m), in m.

    Sum of the modes, plus the residual of the modes under the contact forces and commands of each
    instant; `derivative` (up to 3) gives that x-derivative instead. Accurate where forces and
    commands change slowly compared with the first truncated mode. Raises ValueError as
    `influence_line` does.
    """
    case, x = record.case, xp.asarray(x, float)
    shapes = record.modes.shapes(x, derivative)
    history = xp.tensordot(record.coordinates, shapes, axes=[1, -1])
    if case.loads:
        on_beam = xp.isfinite(record.load_position)
        load_positions = xp.where(on_beam, record.load_position, 0.0)
        residual = residual_flexibility(case, x, load_positions, derivative, layout)
        # Wheels of vehicles press on the ground, too.
        forces = xp.where(on_beam, record.contact_force, 0.0)
        history = history + xp.einsum("tl,tl...->t...", forces, residual)
    if case.controller is not None:
        residual = residual_actuator_gain(case, x, derivative, layout)
        history = history + xp.tensordot(record.command, residual, axes=1)
    return history


# Section forces


def bending_moment(case: Case, x, curvature, commands=None) -> Float[Array, "..."]:
    """Bending moment of the section at x (m), patches included, in N m; sagging is positive.

    M = E I w'' + active moments of the patches over x: in equilibrium with the external forces,
    hence zero for a patch alone on a statically determinate beam. `curvature` (..., *position) is
    w'' in 1/m, the second derivative of `corrected_deflection`, `static_deflection_per_command` or
    `influence_line`. `commands` (..., actuator) are in V or N, by default zero. At the end of a
    patch, the moment to the right of it.

    >>> import jaxbeam as jb
    >>> beam = jb.Case(jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0))
    >>> curvature = jb.influence_line(beam, x=0.5, load_positions=1.0, derivative=2)
    >>> print(f"{jb.bending_moment(beam, 0.5, curvature):.3f} N m")  # F x / 2
    0.250 N m
    """
    x = xp.asarray(x, float)
    moment = _bending_stiffness(case, x) * curvature
    for i, actuator in enumerate(case.actuators if commands is not None else ()):
        # Couples come in opposite pairs, and the section between them carries them.
        couples = [
            (position, factor)
            for position, order, factor in actuator.displacement_map()
            if order == 1
        ]
        steps = (factor * _unit_step(case, x, position) for position, factor in couples)
        inside = sum(steps, xp.zeros(x.shape))
        couple = actuator.attachment().static_gain * xp.asarray(commands, float)[..., i]
        moment = moment + xp.tensordot(couple, inside, axes=0)
    return moment


def shear_force(case: Case, x, third_derivative) -> Float[Array, "..."]:
    """Shear force of the section at x (m) in N: the x-derivative of the bending moment.

    `third_derivative` (..., *position) is that of the deflection by x, in 1/m^2. At a point force,
    the shear force to the right of it.
    """
    return _bending_stiffness(case, xp.asarray(x, float)) * third_derivative


def _bending_stiffness(case: Case, x):
    """Bending stiffness E I at x in N m^2, patches included."""
    rigidity = xp.full(x.shape, case.beam.bending_stiffness)
    for patch in filter(None, (actuator.section_stiffening() for actuator in case.actuators)):
        inside = _unit_step(case, x, patch.start) - _unit_step(case, x, patch.end)
        rigidity = rigidity + patch.bending_stiffness * inside
    return rigidity


def _unit_step(case: Case, x, position):
    """1 from a position on, 0 before it; at the right end, the value left of it."""
    return xp.where((x >= position) & (position < case.beam.length), 1.0, 0.0)
