"""Feedback of readings with gains scheduled over the mass of the load, k(m), as in Fig. 6.7."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import (
    AbstractContinuousLaw,
    AbstractController,
    AbstractSampledLaw,
    ControlStep,
)
from jaxbeam.case.fields import (
    INCREASING,
    choice,
    concrete,
    count,
    deciding,
    is_concrete,
    number,
    part,
)
from jaxbeam.control.feedback import pairing_error, power_law
from jaxbeam.control.load_identification import LoadIdentification, identification_error
from jaxbeam.control.load_identifiers import AbstractLoadSource, given_load
from jaxbeam.runtime.arrays import Array, take, xp


class ScheduledFeedback(AbstractController):
    """Feedback of each actuator's own sensor with a gain for the load: u = -k(m) y |y|^(power - 1).

    The first actuator is fed by the first sensor, the second by the second, and so on. Each has a
    row of `gains`, one for each of the `masses` m of the load. Between these they are
    "interpolated" linearly, or "stepped": constant from each mass to the next, as in Fig. 6.7 of
    the thesis; beyond the first and last mass they are constant. The mass is that of the single
    load of the case, or the one identified by `load_identification`; until it is, the lightest mass
    is assumed.

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
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.859 mm
    """

    kind: ClassVar[str] = "feedback-scheduled"

    masses: Float[Array, " mass"] = number("kg", "masses for which there are gains", INCREASING)
    gains: Float[Array, "actuator mass"] = number(
        "command per reading^power", "gains, a row for each actuator, a column for each mass"
    )
    power: int = count("power of the reading", default=1)
    between: str = choice(
        "gains between the masses", "interpolated", "stepped", default="interpolated"
    )
    load_identification: LoadIdentification | None = part(
        "how the mass is identified", LoadIdentification
    )

    def validate(self, case):
        if len(case.loads) != 1 or case.loads[0].total_mass(case.run.gravity) is None:
            return "kind needs a single load, with a mass; or take kind 'feedback'"
        if self.masses.size == 0 or (
            is_concrete(self.masses) and np.any(concrete(self.masses) <= 0)
        ):
            return "masses must list at least one, and positive ones"
        if self.gains.shape[1] != self.masses.shape[0]:
            return (
                f"gains must list in each row a gain for each of {self.masses.shape[0]} masses,"
                f" not {self.gains.shape[1]}"
            )
        return pairing_error(self.gains[:, 0], case) or identification_error(self, case)

    def design_law(self, plant):
        if self.load_identification is None:
            source = given_load(plant.case.loads[0], plant.case.run.gravity)
        else:
            source = self.load_identification.identifier(plant, plant)
        interpolated = self.between == "interpolated"
        masses = self.masses if interpolated else deciding(self.masses, "controller.masses")
        return ScheduledFeedbackLaw(masses, self.gains, source, self.power, interpolated)


class ScheduledFeedbackLaw(AbstractSampledLaw, AbstractContinuousLaw):
    """Gains over the mass (kg), and the source of the mass, whose state is that of the law.

    In continuous time for a given load only, which has no state.
    """

    masses: Float[Array, " mass"]
    gains: Float[Array, "actuator mass"]
    load_source: AbstractLoadSource
    power: int = eqx.field(static=True)
    interpolated: bool = eqx.field(static=True)

    def initial_state(self):
        return self.load_source.initial_state()

    def gains_at(self, mass: Float[Array, ""]) -> Float[Array, " actuator"]:
        """Gains for a mass (kg)."""
        if self.interpolated:
            return xp.stack([xp.interp(mass, self.masses, row) for row in self.gains])
        last = self.masses.shape[0] - 1
        interval = xp.searchsorted(self.masses, mass, side="right") - 1
        return take(self.gains.T, xp.clip(interval, 0, last))

    def step(self, state, measurement, t):
        load, state = self.load_source.update(state, measurement, t)
        mass = xp.where(load.mass_identified, load.mass, self.masses[0])
        readings = measurement.readings[: self.gains.shape[0]]
        return ControlStep(power_law(self.gains_at(mass), self.power, readings), state)

    def command(self, state, measurement, t):
        return self.step(self.initial_state(), measurement, t).command
