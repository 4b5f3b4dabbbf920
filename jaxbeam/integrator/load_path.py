"""Load path in the steps of a chunk: wheels on the beam, their rows, and the surface under them."""

import jax
from jaxtyping import Bool, Float, Int

from jaxbeam.integrator.contact_forces import EndRows, end_rows
from jaxbeam.integrator.discrete_model import DiscreteModel
from jaxbeam.integrator.kinks import KinkSteps
from jaxbeam.integrator.propagators import GAUSS_NODES, PEAK_NODES
from jaxbeam.integrator.time_grid import TimeGrid
from jaxbeam.model.contact import SurfaceRows, surface_rows
from jaxbeam.model.load_set import LoadSet
from jaxbeam.runtime.arrays import Array, Module, take, xp


class LoadPath(Module):
    """Load path in the steps of a chunk: rows at the wheels on the beam, and the surface.

    `length_index` is the index of a step's length among those of the grid; start and length are in
    s. `loads` are the indices of the wheels in the rows. `surface` is the height of the profile (m)
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


def wheels_on_beam(grid: TimeGrid, max_loads: int) -> Int[Array, "panel wheel"]:
    """Indices of at most `max_loads` wheels in each panel, wheels on the beam first.

    They do not depend on the step, so that compiled programs sort once.
    """
    return xp.argsort(~grid.loads_on_beam, axis=1, stable=True)[:, :max_loads]


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
    if max_loads < loads.wheel_count:
        load_index = take(wheels_on_beam(discrete.grid, max_loads), panel)
        selection = load_index[:, :, None]
        position, speed, acceleration = (
            xp.take_along_axis(part, selection, axis=1) for part in (position, speed, acceleration)
        )
        on_beam = xp.take_along_axis(on_beam, load_index, axis=1)
    else:
        load_index = xp.broadcast_to(xp.arange(max_loads), on_beam.shape)
    on_beam_at_nodes = xp.broadcast_to(on_beam[:, :, None], position.shape)
    springs = bool(loads.wheels.vehicles)
    motion = position, speed, acceleration, on_beam_at_nodes
    arms = None if loads.eccentricity is None else take(loads.eccentricity, load_index)[..., None]
    rows = surface_rows(model, *motion, springs, not loads.massless, arms)
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
