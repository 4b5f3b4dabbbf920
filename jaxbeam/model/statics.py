"""Exact static solutions: deflections, influence lines, lifts of actuators, and peaks while loads
travel slowly. No modes here; see `flexibility`.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.case import Case, concrete_case
from jaxbeam.case.declared_checks import check_on_beam
from jaxbeam.case.fields import is_concrete
from jaxbeam.case.loads import trajectory
from jaxbeam.case.trajectory import NEVER
from jaxbeam.case.validation import check_case
from jaxbeam.model.flexibility import check_supported, flexibility
from jaxbeam.model.modes import Layout, mesh_layout
from jaxbeam.numerics.peak_search import refine_peak
from jaxbeam.runtime.compiling import compiled

# On a stretch of a crossing: a cubic of a cubic is known exactly by ten.
PEAK_POSITIONS = tuple(float(share) for share in np.linspace(0, 1, 10))


@compiled
def _influence_line(case: Case, layout: Layout, x, load_positions, derivative: int):
    greens = flexibility(case, layout, x.reshape(-1), derivative)
    length = case.beam.length
    line = (
        -greens(load_positions / length) * length ** (3 - derivative) / case.beam.bending_stiffness
    )
    return line.reshape(*load_positions.shape, *x.shape)


def influence_line(
    case: Case, x, load_positions, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "..."]:
    """Static deflection at x per newton that presses at each position, in m/N.

    Exact for E I w'''' = p with the case's supports, bonded patches and suspensions, commands
    zero. `x` and `load_positions` are in m from the left end and may have any shapes; the result is
    (position..., place...). `derivative` (up to 3)
    gives that x-derivative instead, in m^(1-derivative)/N. By reciprocity the line of deflections
    is also the deflected shape under 1 N at x. Differentiable in every number. Inside `jit`, give
    the `layout` found outside by `modes.lay_out(case)`.

    Raises ValueError for a faulty case, a place off the beam, or a beam that can move as a rigid
    body.
    """
    x, load_positions = jnp.asarray(x, float), jnp.asarray(load_positions, float)
    layout = _validated_layout(case, layout, x=x, positions=load_positions)
    return _influence_line(case, layout, x, load_positions, derivative)


def static_deflection(
    case: Case,
    x,
    load_positions,
    forces=None,
    derivative: int = 0,
    layout: Layout | None = None,
) -> Float[Array, "*place"]:
    """Static deflection at x (m) under forces that stand on the beam, in m, positive upwards.

    `forces` (load,) are in N, positive downwards, at `load_positions` (load,) in m; without them,
    each load of the case presses with its weight. The rest is as for `influence_line`.

    Raises ValueError as `influence_line` does, and where forces and positions differ in number.
    """
    positions = jnp.atleast_1d(jnp.asarray(load_positions, float))
    if forces is None:
        forces = jnp.array([load.weight(case.run.gravity) for load in case.loads]).reshape(-1)
        described = "loads of the case"
    else:
        forces = jnp.atleast_1d(jnp.asarray(forces, float))
        described = "forces"
    if forces.shape != positions.shape or forces.ndim != 1:
        raise ValueError(
            f"load_positions must be one for each of the {forces.size} {described};"
            f" their shape is {positions.shape}"
        )
    return jnp.tensordot(forces, influence_line(case, x, positions, derivative, layout), axes=1)


def static_deflection_per_command(
    case: Case, x, derivative: int = 0, layout: Layout | None = None
) -> Float[Array, "actuator *place"]:
    """Static deflection at x (m) per unit of each actuator's steady command, in m/V or m/N.

    Exact, the loads of the case away; `derivative` (up to 3) gives that x-derivative instead. At
    a point where it jumps, such as the curvature at the edge of a patch, it is that to the right.
    Inside `jit`, give the `layout`. Raises ValueError as `influence_line` does.
    """
    x = jnp.asarray(x, float)
    layout = _validated_layout(case, layout, x=x)
    return _deflection_per_command(case, layout, x, derivative)


@compiled
def _deflection_per_command(case: Case, layout: Layout, x, derivative: int):
    length = case.beam.length
    greens = flexibility(case, layout, x.reshape(-1), derivative)  # by reciprocity, forces at x
    gains = jnp.zeros((len(case.actuators), x.size))
    for i, actuator in enumerate(case.actuators):
        terms = actuator.displacement_map()
        displacement = sum(f / length**d * greens(position / length, d) for position, d, f in terms)
        gains = gains.at[i].set(actuator.attachment().static_gain * displacement)
    return (gains * length ** (3 - derivative) / case.beam.bending_stiffness).reshape(-1, *x.shape)


def static_peak(case: Case, x, layout: Layout | None = None) -> Float[Array, "*place"]:
    """Largest absolute static deflection at x (m) while the case's loads travel, in m.

    At every instant the loads press with their weights where their motions put them, as if the
    beam followed without inertia: loads of equal speed keep their distances, so with one load or
    a stream of equal speed this is the limit of slow travel. All the way counts, from the first
    entry to the last exit (or stop), however long the run. What dynamic amplification divides by.

    The maximum is exact: between the events of a crossing the deflection is a polynomial in time.
    Differentiable in every number where one instant is the highest. Raises ValueError as
    `influence_line` does.
    """
    x = jnp.asarray(x, float)
    layout = _validated_layout(case, layout, x=x)
    if not case.loads:
        return jnp.zeros(x.shape)
    return _static_peak(case, layout, x)


@compiled
def _static_peak(case: Case, layout: Layout, x):
    length = case.beam.length
    greens = flexibility(case, layout, x.reshape(-1), 0)
    trajectories = [trajectory(load, length) for load in case.loads]
    windows = jnp.stack([jnp.stack(path.entry_exit_times()) for path in trajectories])
    nodes = jnp.concatenate([greens.nodes, greens.sources.positions])
    table_times = [load.times for load in case.loads if load.times is not None]
    events = [
        windows.ravel(),
        *(path.passage_times(nodes * length) for path in trajectories),
        *table_times,
    ]
    events = jnp.concatenate(events)
    event_times = jnp.sort(jnp.where(events < NEVER, events, windows[0, 0]))
    starts, ends = event_times[:-1], event_times[1:]
    middle = (starts + ends) / 2
    times = starts + (ends - starts) * np.array(PEAK_POSITIONS)[:, None]
    total = jnp.zeros((*times.shape, x.size))
    for load, path, window in zip(case.loads, trajectories, windows, strict=True):
        active = (window[0] < middle) & (middle < window[1])
        relative_position = jnp.clip(path.kinematics(times)[0] / length, 0.0, 1.0)
        load_deflection = (
            load.weight(case.run.gravity) * active[:, None] * greens(relative_position)
        )
        total = total + load_deflection
    highest = jnp.max(refine_peak(total, PEAK_POSITIONS)[0], axis=0)
    return (highest * length**3 / case.beam.bending_stiffness).reshape(x.shape)


def _validated_layout(case: Case, layout: Layout | None, **positions) -> Layout:
    """The layout of a case that is fit for statics, as far as its numbers are known."""
    check_case(case)
    for name, position in positions.items():
        check_on_beam(name, position, case.beam.length)
    layout = mesh_layout(case) if layout is None else layout
    unloaded_case = Case(case.beam, case.supports, case.actuators)
    if all(is_concrete(leaf) for leaf in jax.tree.leaves(unloaded_case)):
        check_supported(concrete_case(unloaded_case), layout)
    return layout
