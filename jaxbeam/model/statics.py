"""Exact static solutions without modes: deflections, influence lines, static gains of actuators,
and peaks of a slow crossing (see `flexibility`).
"""

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.declared_checks import check_on_beam
from jaxbeam.case.fields import is_concrete
from jaxbeam.case.trajectory import NEVER
from jaxbeam.case.validation import check_case
from jaxbeam.model.flexibility import check_supported, flexibility
from jaxbeam.model.load_set import load_set
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.numerics.peak_search import refine_peak
from jaxbeam.runtime.arrays import Array, set_at, xp
from jaxbeam.runtime.compiling import compiled_if_traced

# Positions on an interval between events that determine the deflection exactly there: ten for a
# cubic (flexibility) of a cubic (trajectory), a polynomial of degree nine.
PEAK_POSITIONS = tuple(float(share) for share in np.linspace(0, 1, 10))


@compiled_if_traced
def unchecked_influence_line(case: Case, layout: Layout, x, load_positions, derivative: int):
    """`influence_line` of a case and positions (arrays) that are known to be valid."""
    greens = flexibility(case, layout, x.reshape(-1), derivative)
    length = case.beam.length
    order = abs(derivative)  # that of the slope is 1, too
    line = -greens(load_positions / length) * length ** (3 - order) / case.beam.bending_stiffness
    return line.reshape((*load_positions.shape, *x.shape))


def influence_line(
    case: Case, x, load_positions, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "..."]:
    """Influence line: static deflection at x under 1 N downwards at each load position, in m/N.

    Exact for E I w'''' = p with the case's supports, bonded patches and suspensions; commands are
    zero. `x` and `load_positions` (m from the left end) may have any shapes; the result has the
    shape (load position..., x...). `derivative` (up to 3) gives that x-derivative instead, in
    m^(1-derivative)/N. By reciprocity the line is also the deflected shape under 1 N at x.
    Differentiable in every number. Inside `jit`, pass the `layout` found outside by
    `model.modes.mesh_layout(case)`.

    Raises ValueError for an invalid case, a position off the beam, or a beam that can move as a
    rigid body.

    >>> import jaxbeam as jb
    >>> beam = jb.Case(jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0))
    >>> print(f"{jb.influence_line(beam, x=1.0, load_positions=1.0):.6f}")  # -L^3 / (48 E I)
    -0.027778
    """
    x, load_positions = xp.asarray(x, float), xp.asarray(load_positions, float)
    layout = validated_layout(case, layout, x=x, positions=load_positions)
    return unchecked_influence_line(case, layout, x, load_positions, derivative)


def static_deflection(
    case: Case,
    x,
    load_positions,
    forces=None,
    derivative: int = 0,
    layout: Layout | None = None,
) -> Float[Array, "*position"]:
    """Static deflection at x (m) under stationary forces, in m, positive upwards.

    `forces` (load,) are in N, positive downwards, at `load_positions` (load,) in m; by default the
    static loads of the wheels of the case. `derivative` and `layout` are those of `influence_line`.

    Raises ValueError as `influence_line` does, and where forces and positions differ in number.

    >>> import jaxbeam as jb
    >>> beam = jb.Case(jb.Beam(length=2.0, flexural_rigidity=6.0, mass_per_length=1.0))
    >>> print(f"{jb.static_deflection(beam, 1.0, load_positions=[1.0], forces=[18.0]):.3f}")
    -0.500
    """
    positions = xp.atleast_1d(xp.asarray(load_positions, float))
    if forces is None:
        forces = load_set(case).weight[:, 0]
        described = "wheels of the case"
    else:
        forces = xp.atleast_1d(xp.asarray(forces, float))
        described = "forces"
    if forces.shape != positions.shape or forces.ndim != 1:
        raise ValueError(
            f"load_positions must be one for each of the {forces.size} {described};"
            f" their shape is {positions.shape}"
        )
    return xp.tensordot(forces, influence_line(case, x, positions, derivative, layout), axes=1)


def static_deflection_per_command(
    case: Case, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "actuator *position"]:
    """Static deflection at x (m) per unit of each actuator's steady command, in m/V or m/N.

    Exact, without the loads of the case. `derivative` (up to 3) gives that x-derivative instead; at
    a discontinuity, such as that of the curvature at the end of a patch, its value to the right.
    Inside `jit`, pass the `layout`. Raises ValueError as `influence_line` does.
    """
    per_force = static_deflection_per_port_force(case, x, derivative, layout)
    gains = xp.array([a.attachment().static_gain for a in case.actuators]).reshape(-1)
    return gains.reshape(-1, *(1,) * (per_force.ndim - 1)) * per_force


def static_deflection_per_port_force(
    case: Case, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "actuator *position"]:
    """Static deflection at x (m) per unit of each actuator's generalised force on the beam.

    In m/N for a force, 1/N for a couple; otherwise as `static_deflection_per_command`.
    """
    x = xp.asarray(x, float)
    layout = validated_layout(case, layout, x=x)
    return _deflection_per_port_force(case, layout, x, derivative)


@compiled_if_traced
def _deflection_per_port_force(case: Case, layout: Layout, x, derivative: int):
    length = case.beam.length
    greens = flexibility(case, layout, x.reshape(-1), derivative)  # by reciprocity: forces at x
    gains = xp.zeros((len(case.actuators), x.size))
    for i, actuator in enumerate(case.actuators):
        terms = actuator.displacement_map()
        displacement = sum(f / length**d * greens(position / length, d) for position, d, f in terms)
        gains = set_at(gains, i, displacement)
    return (gains * length ** (3 - derivative) / case.beam.bending_stiffness).reshape(-1, *x.shape)


def static_peak(
    case: Case, x, layout: Layout | None = None, derivative: int = 0
) -> Float[Array, "*position"]:
    """Largest absolute static deflection (m) at x (m) over the whole crossing of the case's loads.

    At every instant the loads press with their weights at their positions, without inertia of loads
    and beam: the denominator of the dynamic amplification, and for one load or loads of equal speed
    the limit of a slow crossing. The crossing is that from the first entry to the last exit (or
    stop), whatever the duration of the run.

    `derivative` (up to 2) gives that x-derivative instead. The maximum is exact: between the events
    of a crossing the deflection is a polynomial in time. Differentiable in every number where the
    maximum is unique. Raises ValueError as `influence_line` does.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(f"{1e3 * jb.static_peak(case, 0.3):.2f} mm")
    1.89 mm
    """
    x = xp.asarray(x, float)
    layout = validated_layout(case, layout, x=x)
    if not case.loads:
        return xp.zeros(x.shape)
    return _static_peak(case, layout, x, derivative)


@compiled_if_traced
def _static_peak(case: Case, layout: Layout, x, derivative: int):
    length, order = case.beam.length, abs(derivative)
    greens = flexibility(case, layout, x.reshape(-1), derivative)
    loads = load_set(case)
    windows = loads.entry_exit_times()
    nodes = greens.breakpoints
    table_times = [load.times for load in case.loads if load.times is not None]
    passages = loads.passage_times(nodes * length)
    events = xp.concatenate([windows.reshape(-1), passages, *table_times])
    event_times = xp.sort(xp.where(events < NEVER, events, windows[0, 0]))
    starts, ends = event_times[:-1], event_times[1:]
    middle = (starts + ends) / 2
    times = starts + (ends - starts) * np.array(PEAK_POSITIONS)[:, None]
    total = xp.zeros((*times.shape, x.size))
    positions = xp.clip(loads.kinematics(times)[0] / length, 0.0, 1.0)
    for wheel in range(loads.wheel_count):
        active = (windows[wheel, 0] < middle) & (middle < windows[wheel, 1])
        total = total + loads.weight[wheel] * active[:, None] * greens(positions[wheel])
    highest = xp.max(refine_peak(total, PEAK_POSITIONS)[0], axis=0)
    return (highest * length ** (3 - order) / case.beam.bending_stiffness).reshape(x.shape)


def validated_layout(case: Case, layout: Layout | None, **positions) -> Layout:
    """Layout of a case, after checks of its concrete numbers, positions and supports.

    Raises ValueError as `influence_line` does.
    """
    check_case(case)
    for name, position in positions.items():
        check_on_beam(name, position, case.beam.length)
    layout = mesh_layout(case) if layout is None else layout
    unloaded_case = Case(case.beam, case.supports, case.actuators)
    if all(is_concrete(leaf) for leaf in jax.tree.leaves(unloaded_case)):
        check_supported(concrete_case(unloaded_case), layout)
    return layout
