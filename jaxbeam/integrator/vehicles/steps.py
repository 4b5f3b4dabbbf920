"""Steps of vehicles on the beam: contact forces at the Gauss nodes, and states at the end.

See `vehicle_propagators` for the response of a vehicle to the surface under its wheels.
"""

from jaxtyping import Bool, Float, Int

from jaxbeam.integrator.step_matrices import StepMatrices
from jaxbeam.integrator.vehicles.propagators import (
    VehiclePropagators,
    vehicle_propagators,
)
from jaxbeam.model.load_set import LoadSet
from jaxbeam.runtime.arrays import (
    Array,
)
from jaxbeam.runtime.module import Module

MAX_UNROLLED_ROWS = 24  # of contact equations whose elimination is spelt out


class VehicleStep(Module):
    """Wheels of the rows of a step, and the surface, for each step of a chunk.

    `length_index` is that of the step's length; `on_beam` tells which wheels are there; `surface`
    is the motion of the profile under all wheels (see `LoadPath`).
    """

    length_index: Int[Array, " *step"]
    wheels: Int[Array, "*step wheel"]
    on_beam: Bool[Array, "*step wheel"]
    surface: Float[Array, "*step 3 all node"] | None


class StepInput(Module):
    """What a step of a batch takes: matrices, and inertia (kg) and weight (N) of the rows.

    The weight includes the inertia forces of the profile. Without vehicles, `vehicles` is None.
    """

    matrices: StepMatrices
    inertia: Float[Array, "*step row batch"]
    weight: Float[Array, "*step row batch"]
    vehicles: VehicleStep | None


class Vehicles(Module):
    """Loads with vehicles, and the propagators of the vehicles of each for all step lengths."""

    loads: LoadSet
    propagators: tuple[VehiclePropagators, ...]


def vehicles_of(loads: LoadSet, lengths: Float[Array, " length"]) -> Vehicles | None:
    """Vehicles of the loads for steps of the given lengths (s); None without any."""
    groups = loads.wheels.vehicles
    if not groups:
        return None
    return Vehicles(loads, tuple(vehicle_propagators(group, lengths) for group in groups))
