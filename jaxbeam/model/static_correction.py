"""Static correction: quasi-static response of the truncated modes; section forces.

Point forces and the couples of a patch also bend the beam locally, in high modes that respond
quasi-statically: by the exact static response less that of the modes kept. The correction of the
deflection is small; curvature and third derivative, hence section forces, need it.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.beam import has
from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.fields import is_concrete
from jaxbeam.case.sensors import TWIST, TWIST_RATE
from jaxbeam.model.deflection_lines import (
    residual_influence,
    static_deflection_per_port_force,
    unchecked_influence_line,
    validated_layout,
)
from jaxbeam.model.elements import rigidity_at
from jaxbeam.model.flexibility import check_supported
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modal_model import modal_model
from jaxbeam.model.modes import Layout, Modes, mesh_layout
from jaxbeam.runtime.arrays import Array, is_numpy, set_at, solve, xp
from jaxbeam.runtime.compiling import compiled_if_traced

OF_TWIST = TWIST, TWIST_RATE


def residual_port_flexibility(
    case: Case, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "actuator *position"]:
    """Residual of the modes in the static deflection per force of each actuator on the beam.

    At x (m), in m/N for a force, 1/N for a couple; `derivative` (up to 3) gives that x-derivative
    instead. Suspensions act on both, the exact beam and the modes. Raises ValueError as
    `static_deflection_per_command` does.
    """
    layout = mesh_layout(case) if layout is None else layout
    exact = static_deflection_per_port_force(case, x, derivative, layout)
    return exact - _modal_port_flexibility(case, layout, xp.asarray(x, float), derivative)


@compiled_if_traced
def _modal_port_flexibility(case: Case, layout: Layout, x, derivative: int):
    model = modal_model(case, layout)
    amplitudes = solve(model.stiffness(), model.displacement_map.T)
    return xp.moveaxis(model.fields(x, (derivative,))[0] @ amplitudes, -1, 0)


def residual_flexibility(
    case: Case, x, load_positions, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "..."]:
    """Residual flexibility: residual of the modes in `influence_line`, (load position..., x...).

    In m/N, or of an x-derivative as there. Raises ValueError as `influence_line` does.
    """
    layout = validated_layout(case, layout, x=x, positions=load_positions)
    return _residual_flexibility(case, x, load_positions, derivative, layout)


def _residual_flexibility(case: Case, x, load_positions, derivative: int, layout: Layout):
    """`residual_flexibility` without checks of the case and of the positions."""
    x, load_positions = xp.asarray(x, float), xp.asarray(load_positions, float)
    exact = unchecked_influence_line(case, layout, x, load_positions, derivative)
    return exact - modal_influence_line(case, layout, x, load_positions, derivative)


@compiled_if_traced
def modal_influence_line(case: Case, layout: Layout, x, load_positions, derivative: int):
    """Part of `unchecked_influence_line` that the modes represent."""
    model = modal_model(case, layout)
    of_load = derivative if derivative in OF_TWIST else 0
    load_shapes = model.fields(load_positions.reshape(-1), (TWIST if of_load else 0,))[0]
    amplitudes = solve(model.stiffness(), -load_shapes.T)
    line = model.fields(x.reshape(-1), (derivative,))[0] @ amplitudes
    return line.T.reshape((*load_positions.shape, *x.shape))


class Motion(NamedTuple):
    """Motion of the modes and forces on the beam at the instants of a run.

    Modal coordinates, their rates and accelerations; positions of the loads (m, NaN off the beam)
    and their contact forces (N, positive downwards); commands to the actuators (V or N).
    """

    coordinates: Float[Array, "time mode"]
    rates: Float[Array, "time mode"]
    accelerations: Float[Array, "time mode"]
    load_position: Float[Array, "time load"]
    contact_force: Float[Array, "time load"]
    command: Float[Array, "time actuator"]


def corrected_history(
    case: Case, modes: Modes, motion: Motion, x, derivative: int = 0
) -> Float[Array, "time *position"]:
    """Statically corrected history of the deflection at x (m), in m, or of its x-derivative.

    w = sum psi_j q_j + sum residual(x, y) F over the forces F at y on the beam (the
    mode-acceleration method): contact forces, commands by their static gains, and forces of dampers
    at supports and of dampers and masses of actuators. Then E I w'''' is the exact sum of the
    forces, less inertia and damping of the modes. Beams that can move as a rigid body are left
    uncorrected.
    """
    x, layout = xp.asarray(x, float), modes.layout
    history = xp.tensordot(motion.coordinates, modes.fields(x, (derivative,))[0], axes=[1, -1])
    if not is_supported(case, layout):
        return history
    if case.carried:
        history = history + _loads_history(case, motion, x, derivative, layout)
    if derivative in OF_TWIST:  # dampers and actuators are on the axis
        return history
    for support in case.supports:
        if support.damping is not None:
            velocity = motion.rates @ modes.shapes(support.position)
            residual = _residual_flexibility(case, x, support.position, derivative, layout)
            history = history + xp.tensordot(support.damping * velocity, residual, axes=0)
    if case.actuators:
        residual = residual_port_flexibility(case, x, derivative, layout)
        forces = port_forces(case, modes, motion)
        history = history + xp.tensordot(forces.T, residual, axes=1)
    return history


def _loads_history(case: Case, motion: Motion, x, derivative: int, layout: Layout):
    """Residual of the modes under the contact forces, (time, *position)."""
    on_beam = xp.isfinite(motion.load_position)  # wheels of vehicles press on the ground, too
    arms = load_set(case, layout).eccentricity if case.beam.twists else None
    if not all(map(is_numpy, jax.tree.leaves((case, motion, x)))):
        positions = xp.where(on_beam, motion.load_position, 0.0)
        residual = _under_loads(case, x, positions, derivative, layout, arms)
        return xp.einsum("tl,tl...->t...", xp.where(on_beam, motion.contact_force, 0.0), residual)
    time, load = np.nonzero(on_beam)
    positions, forces = motion.load_position[time, load], motion.contact_force[time, load]
    arms = None if arms is None else arms[load]
    residual = _under_loads(case, x, positions, derivative, layout, arms)
    history = xp.zeros((on_beam.shape[0], *x.shape))
    if not time.size:
        return history
    starts = np.flatnonzero(np.diff(time, prepend=-1))
    values = forces.reshape(-1, *(1,) * x.ndim) * residual
    return set_at(history, time[starts], np.add.reduceat(values, starts, axis=0))


def _under_loads(case: Case, x, positions, derivative: int, layout: Layout, arms):
    """Residual flexibility for the forces of loads at positions (m), as the track spreads them.

    `arms` are their eccentricities (m), which are broadcast to the positions.
    """
    if case.track is None and not case.beam.twists:
        return _residual_flexibility(case, x, positions, derivative, layout)
    return _spread_residual(case, layout, x, positions, derivative, arms)


@compiled_if_traced
def _spread_residual(case: Case, layout: Layout, x, positions, derivative: int, arms):
    influence = residual_influence(case, modal_model(case, layout), x, derivative)
    found = -influence.of_forces_at(positions, positions, eccentricity=arms)
    return found.reshape((*positions.shape, *x.shape))


def port_forces(
    case: Case, modes: Modes, motion: Motion, with_springs: bool = False
) -> Float[Array, "actuator time"]:
    """Force of each actuator on the beam along its displacement s: g u - c s' - m s'', g static.

    In N or N m; `with_springs` less k s too, which is part of the modes.
    """
    forces = []
    for i, actuator in enumerate(case.actuators):
        attachment = actuator.attachment()
        terms = (
            factor * modes.fields(x, (order,))[0]
            for x, order, factor in actuator.displacement_map()
        )
        shape = sum(terms, xp.zeros(motion.rates.shape[1]))
        force = attachment.static_gain * motion.command[:, i]
        force = force - attachment.damping * (motion.rates @ shape)
        if attachment.mass is not None:
            force = force - attachment.mass * (motion.accelerations @ shape)
        if with_springs:
            force = force - attachment.stiffness * (motion.coordinates @ shape)
        forces.append(force)
    return xp.array(forces).reshape(len(forces), motion.rates.shape[0])


def is_supported(case: Case, layout: Layout) -> bool:
    """Whether sums of modes are statically corrected: the beam is held, without a track of layers.

    A traced beam counts as held by the kinds of its supports.
    """
    if case.on_rail:
        return False
    unloaded = Case(case.beam, case.supports, case.actuators)
    if all(is_concrete(leaf) for leaf in jax.tree.leaves(unloaded)):
        try:
            check_supported(concrete_case(unloaded), layout)
        except ValueError:
            return False
        return True
    if has(case.beam, "foundation_stiffness"):
        return True
    held = sum(fixed for fixed, _ in layout.constrained) - len(case.beam.hinges)
    held += sum(support.stiffness is not None for support in case.supports)
    held += len(case.actuators)
    return held >= 2 or (held == 1 and any(clamped for _, clamped in layout.constrained))


# Section forces


@checks_classes
def bending_moment(case: Case, x, curvature, commands=None) -> Float[Array, "..."]:
    """Bending moment of the section at x (m), patches included, in N m; sagging is positive.

    M = E I w'' + active moments of the patches over x: in equilibrium with the external forces,
    hence zero for a patch alone on a statically determinate beam. `curvature` (..., *position) is
    w'' in 1/m, the second derivative of `corrected_history`, `static_deflection_per_command` or
    `influence_line`. `commands` (..., actuator) are in V or N, by default zero. At the end of a
    patch, the moment to the right of it.

    >>> import jaxbeam as jb
    >>> beam = jb.Case(jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0))
    >>> curvature = jb.influence_line(beam, x=0.5, load_positions=1.0, derivative=2)
    >>> print(f"{jb.sections.bending_moment(beam, 0.5, curvature):.3f} N m")  # F x / 2
    0.250 N m
    """
    x = xp.asarray(x, float)
    moment = section_stiffness(case, x) * curvature
    if commands is None or not case.actuators:
        return moment
    return moment + xp.tensordot(xp.asarray(commands, float), active_moments(case, x), axes=1)


def active_moments(case: Case, x) -> Float[Array, "actuator *position"]:
    """Active moment in the section at x (m) per unit of each command, in N m/V or m.

    Couples of a patch come in opposite pairs, and the section between them carries them.
    """
    x, moments = xp.asarray(x, float), []
    for actuator in case.actuators:
        couples = [(at, factor) for at, order, factor in actuator.displacement_map() if order == 1]
        steps = (factor * _unit_step(case, x, position) for position, factor in couples)
        moments.append(actuator.attachment().static_gain * sum(steps, xp.zeros(x.shape)))
    return xp.array(moments).reshape(-1, *x.shape)


@checks_classes
def shear_force(case: Case, x, third_derivative) -> Float[Array, "..."]:
    """Shear force of the section at x (m) in N: the x-derivative of the bending moment.

    `third_derivative` (..., *position) is that of the deflection by x, in 1/m^2. At a point force,
    the shear force to the right of it.

    >>> import jaxbeam as jb
    >>> beam = jb.Case(jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0))
    >>> third = jb.influence_line(beam, x=0.5, load_positions=1.0, derivative=3)
    >>> print(f"{jb.sections.shear_force(beam, 0.5, third):.3f} N")  # half of 1 N at midspan
    0.500 N
    """
    return section_stiffness(case, xp.asarray(x, float)) * third_derivative


def section_stiffness(case: Case, x) -> Float[Array, "*position"]:
    """Bending stiffness E I of the section at x (m) in N m^2, patches included."""
    x = xp.asarray(x, float)
    if case.beam.segments:
        rigidity = rigidity_at(case, x)
    else:
        rigidity = xp.full(x.shape, case.beam.bending_stiffness)
    for patch in filter(None, (actuator.section_stiffening() for actuator in case.actuators)):
        inside = _unit_step(case, x, patch.start) - _unit_step(case, x, patch.end)
        rigidity = rigidity + patch.bending_stiffness * inside
    return rigidity


def _unit_step(case: Case, x, position):
    """1 from a position on, 0 before it; at the right end, the value left of it."""
    return xp.where((x >= position) & (position < case.beam.length), 1.0, 0.0)
