"""Load identification: settings of a case file, and its replay on the record of a run.

In a simulation the gate times are computed from the trajectory of the load.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.controller import Measurement
from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import POSITIVE, concrete, deciding, is_concrete, number
from jaxbeam.control.load_identifiers import (
    AbstractLoadIdentifier,
    DeflectionIdentifier,
    GateIdentifier,
)
from jaxbeam.estimation.constant_gain import sensor_offsets
from jaxbeam.estimation.observability import deflection_outputs
from jaxbeam.model.modes import mesh_layout
from jaxbeam.model.state_space import Plant, state_space
from jaxbeam.runtime.arrays import Array, scan, xp
from jaxbeam.runtime.compiling import compiled_if_traced

INFLUENCE_POSITIONS = 201  # load positions along the beam at which influence lines are tabulated


class LoadIdentification(ReprWithUnits):
    """Settings for identifying speed and mass of a load while it crosses.

    The speed follows from two `gates`, which may lie before the beam (at a negative position if the
    load enters at the left), and is assumed to stay constant; or, without gates, from the
    deflections at two sensors or more where they exceed a `threshold`. While the load is on the
    first part of the crossing, `until`, its weight is the one whose static deflections fit the
    readings of the deflection sensors best, less the static deflections due to the commands. The
    beam must not be able to move as a rigid body.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.ScheduledFeedback(
    ...         masses=[0.2, 0.5],
    ...         gains=[[1e3, 3e3]],
    ...         load_identification=jb.LoadIdentification(gates=[-0.1, -0.05]),
    ...         period=0.005,
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.019 mm
    """

    gates: Float[Array, "2"] | None = number(
        "m", "positions of the gates, in the order of passage", default=None
    )
    until: Float[Array, ""] = number(
        "1", "share of the crossing after which the mass is identified", POSITIVE, default=0.3
    )
    threshold: Float[Array, ""] | None = number(
        "m", "deflection above which a load is on the beam, without gates", POSITIVE, default=None
    )
    gate_errors: Float[Array, "2"] = number(
        "m", "distance by which each gate is farther along than the law has it", default=(0.0, 0.0)
    )

    def validate(self, case: Any) -> str | None:
        """Error of these settings in a case, as "key must ...", or None."""
        deflection_sensors = sum(sensor.quantity == "deflection" for sensor in case.sensors)
        if not deflection_sensors:
            return "until needs a sensor of deflection; add one"
        if (self.gates is None) == (self.threshold is None):
            return "gates or threshold must be given, and not both"
        if self.gates is None:
            if deflection_sensors < 2:
                return "threshold needs two sensors of deflection or more; add one, or give gates"
            return None
        numbers = (self.gates, self.until, case.beam.length, case.loads[0].speed)
        if not all(is_concrete(value) for value in numbers):
            return None
        gates, until, length, speed = (concrete(value) for value in numbers)
        gate_shares = np.sign(speed) * (gates - (length if speed < 0 else 0.0)) / length
        if gate_shares[1] <= gate_shares[0]:
            return (
                "gates must be two positions, the one that the load passes first before the other"
            )
        if not gate_shares[1] < until <= 1:
            return (
                f"until must be beyond the second gate, at {gate_shares[1]:.3g} of the crossing,"
                " and at most 1"
            )
        return None

    def identifier(self, plant: Plant, design_plant: Plant) -> AbstractLoadIdentifier:
        """Identifier of the first load of a plant, with the deflections of the design plant."""
        system, modes = design_plant.unloaded, design_plant.coordinate_scale.shape[0]
        length, sensor_indices = plant.case.beam.length, deflection_outputs(system)
        positions = length * np.linspace(0, 1, INFLUENCE_POSITIONS)
        shapes = design_plant.modal_model.shapes(positions, (0,))[0]
        response = system.static_response(sensor_indices)
        common = {
            "length": length,
            "gravity": design_plant.case.run.gravity,
            # Weights act downwards, against the deflection.
            "influence_lines": -response[:, modes : 2 * modes]
            @ (design_plant.coordinate_scale[:, None] * shapes.T),
            "static_lift": response @ system.B,
            "offset": sensor_offsets(design_plant)[sensor_indices],
            "until": deciding(self.until, "load_identification.until"),
            "sensor_indices": tuple(int(i) for i in sensor_indices),
        }
        if self.gates is None:
            threshold = deciding(self.threshold, "load_identification.threshold")
            return DeflectionIdentifier(threshold=threshold, **common)
        true_gates = self.gates + self.gate_errors
        gate_times = plant.loads.trajectories[0].passage_times(true_gates)[:2]
        return GateIdentifier(gates=self.gates, gate_times=gate_times, **common)


def identification_error(controller: Any, case: Any) -> str | None:
    """Error of the `load_identification` of a controller in a case, as "key must ...", or None."""
    if controller.load_identification is None:
        return None
    if controller.period is None:
        return "period must be given: load identification acts at samples"
    error = controller.load_identification.validate(case)
    return None if error is None else f"load_identification.{error}"


class IdentifiedLoad(NamedTuple):
    """Identified mass (kg) and speed (m/s) of a load, and their relative errors."""

    mass: float
    speed: float
    mass_error: float
    speed_error: float


def identified_load(record: Any, settings: LoadIdentification) -> IdentifiedLoad:
    """Mass and speed of the first load, identified from the readings and commands of a record.

    The same as in the control loop if the record has a sample at every sample of the controller,
    and commands change at these samples only. Errors refer to the speed at entry.

    Raises ValueError for settings that do not suit the case.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.ScheduledFeedback(
    ...         masses=[0.2, 0.5], gains=[[1e3, 3e3]], period=0.005
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> settings = jb.LoadIdentification(gates=[-0.1, -0.05])
    >>> found = jb.identified_load(jb.simulate(case), settings)
    >>> print(f"{found.mass:.2f} kg at {found.speed:.2f} m/s")
    0.41 kg at 4.00 m/s
    """
    case = record.case
    error = settings.validate(case)
    if error is not None:
        raise ValueError(f"load_identification.{error}")
    mass, speed = (float(value) for value in _replay(settings, case, mesh_layout(case), record))
    load = case.loads[0]
    true_mass, true_speed = float(load.total_mass(case.run.gravity)), float(load.speed)
    return IdentifiedLoad(mass, speed, mass / true_mass - 1, speed / true_speed - 1)


@compiled_if_traced
def _replay(settings: LoadIdentification, case: Case, layout, record):
    """Mass (kg) and speed (m/s) after the last sample of a record."""
    plant = state_space(case, layout=layout)
    identifier = settings.identifier(plant, plant)
    no_state = xp.zeros(plant.modal_model.state_count)

    def update(sums, sample):
        readings, command, t = sample
        return identifier.update(sums, Measurement(readings, no_state, command), t)[1], None

    # A sample of a record holds the command that begins there; the law received the previous one.
    previous_commands = xp.concatenate([xp.zeros_like(record.command[:1]), record.command[:-1]])
    samples = record.measured, previous_commands, record.times
    sums, _ = scan(update, identifier.initial_state(), samples)
    estimate = identifier.estimate(sums, record.times[-1])
    return estimate.mass, estimate.speed
