"""Load path in the steps of a chunk: wheels on the beam, their rows, and the surface under them.

Peaks of statically corrected outputs often are at an end of a step, where an axle stands on a
sensor. An extrapolation of the forces at the Gauss nodes is the least accurate there; the states
are the most accurate, of order 12, and so are the forces that the contact law gives for them.
"""

import dataclasses

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxbeam.model.contact import KinkSteps, SurfaceRows, solve_at_instants, surface_rows
from jaxbeam.model.load_set import LoadSet
from jaxbeam.model.modal_model import ModalModel
from jaxbeam.runtime.arrays import Array, Module, take, xp
from jaxbeam.simulation.integrator.discrete_model import (
    GAUSS_NODES,
    PEAK_NODES,
    DiscreteModel,
    end_weights,
)
from jaxbeam.simulation.integrator.time_grid import TimeGrid

# Fractions of a step for limits from within at its ends, where accelerations of loads jump.
END_FRACTIONS = (1e-9, 1.0 - 1e-9)


class EndRows(Module):
    """Rows of the wheels at the two ends of steps: mode shapes, accelerations, and profile.

    `accelerations` map states to the accelerations under the wheels, `surface` is the second rate
    of the profile's height there (m/s^2), None without a profile.
    """

    shapes: Float[Array, "step end load mode"]
    accelerations: Float[Array, "step end load state"]
    surface: Float[Array, "step end load"] | None


def end_rows(
    model: ModalModel, loads: LoadSet, start, length, load_index, on_beam
) -> EndRows | None:
    """Rows of the wheels at the ends of steps; None for massless forces and for vehicles."""
    if loads.massless or loads.wheels.vehicles:
        return None
    times = start[:, None] + length[:, None] * xp.asarray(END_FRACTIONS, length.dtype)
    index = load_index[:, None]
    position, speed, acceleration = (
        xp.take_along_axis(xp.moveaxis(part, 0, -1), index, axis=2)
        for part in loads.kinematics(times)
    )
    active = xp.broadcast_to(on_beam[:, None], position.shape)
    arms = None if loads.eccentricity is None else take(loads.eccentricity, index)
    rows = surface_rows(model, position, speed, acceleration, active, eccentricity=arms)
    surface = loads.surface_motion(position, speed, acceleration)
    return EndRows(
        rows.shape.reshape(*active.shape, -1),
        rows.acceleration.reshape(*active.shape, -1),
        None if surface is None else surface[2],
    )


def end_forces(
    rows: EndRows | None,
    inertia: Float[Array, "step row batch"],
    weight: Float[Array, "step load end batch"],
    before: Float[Array, "step state batch"],
    last: Float[Array, "state batch"],
    forces: Float[Array, "step row batch"],
) -> Float[Array, "step row_end batch"]:
    """Contact forces (N) of wheels at the ends of steps, from the states there.

    States are those `before` each step, and the `last` after all steps. Without `rows` forces are
    extrapolated from those at the Gauss nodes.
    """
    steps, count, batch = forces.shape
    nodes = end_weights().shape[0]
    by_load = (steps, count // nodes, nodes, batch)
    if rows is None:
        extrapolated = xp.einsum("tlfb,fe->tleb", forces.reshape(by_load), end_weights())
        return extrapolated.reshape(steps, -1, batch)
    mass = inertia.reshape(by_load)[:, None, :, 0]  # step, 1, load, batch
    acceleration = _at_ends(rows.accelerations, before, last)
    if rows.surface is not None:
        acceleration = acceleration + rows.surface[..., None]
    right = xp.swapaxes(weight, 1, 2) + mass * acceleration
    compliance = rows.shapes @ rows.shapes.mT
    matrix = np.eye(mass.shape[2])[..., None] + mass[:, :, :, None] * compliance[..., None]
    found = -solve_at_instants(matrix, right)
    return xp.swapaxes(found, 1, 2).reshape(steps, -1, batch)


def _at_ends(
    rows: Float[Array, "step end load state"],
    before: Float[Array, "step state batch"],
    last: Float[Array, "state batch"],
) -> Float[Array, "step end load batch"]:
    """Products of rows at the two ends of steps with the states there.

    A step ends where the next one begins, so that both rows act on the states before the steps.
    These states, by far the largest array, are read once and not copied.
    """
    at_end = rows[:, 1]
    of_former = xp.concatenate([xp.zeros_like(at_end[:1]), at_end[:-1]])
    starts, ends = xp.split(xp.concatenate([rows[:, 0], of_former], axis=1) @ before, 2, axis=1)
    ends = xp.concatenate([ends[1:], (at_end[-1] @ last)[None]])
    return xp.stack([starts, ends], axis=1)


class LoadPath(Module):
    """Load path in the steps of a chunk: rows at the wheels on the beam, and the surface.

    `length_index` is the index of a step's length among those of the grid; start and length are in
    s. `loads` are the indices of the wheels in the rows; `rows` of motion are only those of the
    first wheels, all others of a step being prescribed. `surface` is the height of the profile (m)
    under all wheels, and its first and second rate, where there is a profile. `influence` is the
    static influence of a force of each wheel at the peak nodes on corrected outputs, `ends` the
    rows of the wheels at the ends of steps; `kinks` mark the steps that are passages over kinks, if
    there are any.
    """

    length_index: Int[Array, " step"]
    start: Float[Array, " step"]
    length: Float[Array, " step"]
    loads: Int[Array, "step load"]
    on_beam: Bool[Array, "step load"]
    rows: SurfaceRows
    surface: Float[Array, "step 3 wheel node"] | None
    influence: Float[Array, "step load sample output"] | None = None
    ends: EndRows | None = None
    kinks: KinkSteps | None = None

    @property
    def pressing(self) -> Bool[Array, "step load"]:
        """Whether each wheel acts on the beam by a force, not by an impulse of a passage."""
        return self.on_beam if self.kinks is None else self.on_beam & ~self.kinks.here[:, None]


def wheels_on_beam(
    grid: TimeGrid, max_loads: int, prescribed: Bool[np.ndarray, " wheel"]
) -> Int[Array, "panel selected"]:
    """Indices of at most `max_loads` wheels in each panel, wheels on the beam first.

    Of these, `prescribed` ones are last. They do not depend on the step, so that compiled programs
    sort once.
    """
    order = 2 * ~grid.loads_on_beam + prescribed
    return xp.argsort(order, axis=1, stable=True)[:, :max_loads]


@jax.named_scope("load_path")
def load_path(
    discrete: DiscreteModel, loads: LoadSet, max_loads: int, index: Int[Array, " step"]
) -> LoadPath:
    """Load path in the steps with the given indices, for at most `max_loads` loads on the beam."""
    model, grid = discrete.model, discrete.grid
    panel, start, length_index = grid.locate_steps(index)
    length = take(grid.lengths, length_index)
    # As an array: JAX caches a NumPy constant in the precision of its first use.
    times = start[:, None] + length[:, None] * xp.asarray(GAUSS_NODES, length.dtype)
    position, speed, acceleration = (xp.moveaxis(p, 0, 1) for p in loads.kinematics(times))
    surface = loads.surface_motion(position, speed, acceleration)
    on_beam = take(grid.loads_on_beam, panel)  # step, load
    solved = min(max_loads, loads.solved_count)
    if max_loads < loads.wheel_count or 0 < solved < max_loads:
        load_index = take(wheels_on_beam(discrete.grid, max_loads, loads.prescribed), panel)
        selection = load_index[:, :, None]
        position, speed, acceleration = (
            xp.take_along_axis(part, selection, axis=1) for part in (position, speed, acceleration)
        )
        on_beam = xp.take_along_axis(on_beam, load_index, axis=1)
    else:
        load_index = xp.broadcast_to(xp.arange(max_loads), on_beam.shape)
    on_beam_at_nodes = xp.broadcast_to(on_beam[:, :, None], position.shape)
    motion = position, speed, acceleration, on_beam_at_nodes
    arms = None if loads.eccentricity is None else take(loads.eccentricity, load_index)[..., None]

    def rows_of(wheels, springs, inertia):
        position, speed, acceleration, active = (part[:, wheels] for part in motion)
        own_arms = None if arms is None else arms[:, wheels]
        return surface_rows(
            model, position, speed, acceleration, active, springs, inertia, own_arms
        )

    rows = rows_of(np.s_[: solved or max_loads], bool(loads.wheels.vehicles), not loads.massless)
    if 0 < solved < max_loads:
        shapes = rows.shape, rows_of(np.s_[solved:], False, False).shape
        rows = dataclasses.replace(rows, shape=xp.concatenate(shapes, axis=1))
    surface = None if surface is None else xp.stack(surface, axis=1)
    influence = ends = None
    if discrete.load_influence is not None:
        influence = _static_influence(discrete, loads, start, length, load_index, on_beam, arms)
        if discrete.modal_command_matrix is None:
            ends = end_rows(model, loads, start, length, load_index, on_beam)
    kinks = None
    if grid.kinks is not None and not loads.massless:
        passage = xp.where(grid.starts_panel(index, panel), take(grid.passage, panel), -1)
        kinks = grid.kinks.of_steps(passage, load_index, on_beam, speed[..., 0])
    return LoadPath(
        length_index, start, length, load_index, on_beam, rows, surface, influence, ends, kinks
    )


def _static_influence(
    discrete: DiscreteModel, loads: LoadSet, start, length, load_index, on_beam, arms
):
    """Static influence (step, load, sample, output) of wheels on corrected outputs at peak nodes.

    Values at the ends of a step are the limits within it: a wheel may pass a sensor there, where
    moments have a kink and shear forces jump.
    """
    nodes = xp.asarray([*PEAK_NODES, 0.5], length.dtype)
    position = xp.moveaxis(loads.kinematics(start[:, None] + length[:, None] * nodes)[0], 0, 1)
    position = xp.take_along_axis(position, load_index[:, :, None], axis=1)
    active = on_beam[:, :, None]
    position = xp.where(active, position, 0.0)
    middle = xp.broadcast_to(position[..., -1:], position[..., :-1].shape)
    at = position[..., :-1], middle
    influence = discrete.load_influence.of_forces_at(*at, eccentricity=arms)
    return xp.where(active[..., None], influence, 0.0)
