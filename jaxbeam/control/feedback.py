"""Feedback of readings: odd polynomials, matrices of gains, and gains scheduled over the mass."""

from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxbeam.case.controller import (
    AbstractContinuousLaw,
    AbstractController,
    AbstractSampledLaw,
    AbstractStaticController,
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
from jaxbeam.control.load_identification import (
    AbstractLoadSource,
    LoadIdentification,
    given_load,
    identification_error,
)
from jaxbeam.runtime.arrays import Array, Number, take, xp
from jaxbeam.runtime.printer import counted


def pairing_error(gains: Float[Array, " actuator"], case) -> str | None:
    """Error message unless each actuator has one gain and a sensor of the same index, or None."""
    loops, actuators = gains.shape[0], len(case.driven)
    if loops != actuators:
        return f"gains must list one gain for each of {actuators} actuators, not {loops}"
    if loops > len(case.sensors):
        return (
            f"gains has {counted(loops, 'entry', 'entries')}, but there are only"
            f" {counted(len(case.sensors), 'sensor')}"
        )
    return None


def power_law(
    gains: Float[Array, " actuator"], power: int, readings: Float[Array, " actuator"]
) -> Float[Array, " actuator"]:
    """Commands -k y |y|^(power - 1); the derivative at y = 0 is finite for every power."""
    magnitude = xp.abs(readings) ** (power - 1) if power > 1 else 1.0
    return -gains * readings * magnitude


class Feedback(AbstractStaticController):
    """Feedback of the reading y of each actuator's own sensor: u = -sum_k g_k y |y|^(p_k - 1).

    The first actuator is fed by the first sensor, the second by the second, and so on. The first
    term has `gains` and `power`: 1 is linear feedback, 3 the cubic law of chapter 6 of the thesis
    (corrected sign: eq. 2.46 with u = -k w). Row after row, `higher_gains` are those of the powers
    power + 2, power + 4, ...: linear plus cubic feedback has power 1 and one row.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Feedback(gains=[2e3], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.900 mm
    """

    kind: ClassVar[str] = "feedback"

    gains: Float[Number, " actuator"] = number(
        "command per reading^power", "one gain for each actuator"
    )
    power: int = count("power of the reading", default=1)
    higher_gains: Float[Number, "term actuator"] | None = number(
        "command per reading^(power + 2, power + 4, ...)",
        "row of gains for each further odd power",
        default=None,
    )

    def validate(self, case):
        actuators = len(case.driven)
        error = pairing_error(self.gains, case)
        if error is not None:
            return error
        if self.higher_gains is not None and self.higher_gains.shape[1] != actuators:
            return (
                f"higher_gains must have in each row a gain for each of {actuators} actuators,"
                f" not {self.higher_gains.shape[1]}"
            )
        return None

    def command(self, state, measurement, t):
        readings = measurement.readings[: self.gains.shape[0]]
        rows = [self.gains, *([] if self.higher_gains is None else self.higher_gains)]
        gains = rows[-1]
        for row in rows[-2::-1]:  # Horner's scheme in y^2
            gains = row + gains * readings**2
        return power_law(gains, self.power, readings)


class OutputFeedback(AbstractStaticController):
    """Linear feedback of all readings: u = K y, with a row of `gains` for each actuator.

    Gains multiply as they are: a negative gain opposes a reading. Sensors of deflection and
    velocity make it the law of the receptance method (`receptance_feedback`).

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.OutputFeedback(gains=[[-2e3]], period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.900 mm
    """

    kind: ClassVar[str] = "output-feedback"

    gains: Float[Number, "actuator sensor"] = number(
        "command per reading", "row of gains of the sensors for each actuator"
    )

    def validate(self, case):
        wanted = len(case.driven), len(case.sensors)
        if self.gains.shape != wanted:
            return (
                f"gains must have a row for each of {wanted[0]} actuators, with a gain for each of"
                f" {wanted[1]} sensors, not the shape {self.gains.shape}"
            )
        return None

    def command(self, state, measurement, t):
        return self.gains @ measurement.readings


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

    masses: Float[Number, " mass"] = number("kg", "masses for which there are gains", INCREASING)
    gains: Float[Number, "actuator mass"] = number(
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
