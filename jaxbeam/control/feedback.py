"""Feedback of sensor readings through a power law or an odd polynomial."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.controller import AbstractStaticController
from jaxbeam.case.fields import count, number
from jaxbeam.runtime.arrays import Array, xp


def pairing_error(gains: Float[Array, " actuator"], case) -> str | None:
    """Error unless each actuator has one gain and a sensor of the same index, or None."""
    loops, actuators = gains.shape[0], len(case.driven)
    if loops != actuators:
        return f"gains must list one gain for each of {actuators} actuators, not {loops}"
    if loops > len(case.sensors):
        return f"gains has {loops} entries, but there are only {len(case.sensors)} sensors"
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

    gains: Float[Array, " actuator"] = number(
        "command per reading^power", "one gain for each actuator"
    )
    power: int = count("power of the reading", default=1)
    higher_gains: Float[Array, "term actuator"] | None = number(
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
