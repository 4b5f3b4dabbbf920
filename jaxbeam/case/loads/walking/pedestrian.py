"""Pedestrian: a person who walks or jogs along the beam, or in one place."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.fields import ON_BEAM, number
from jaxbeam.case.loads.vehicle_model import plain_wheels
from jaxbeam.case.loads.walking.steps import AbstractWalkingLoad
from jaxbeam.case.trajectory import StandingTrajectory
from jaxbeam.runtime.arrays import Array, xp


class Pedestrian(AbstractWalkingLoad):
    """A person of a weight whose steps are harmonics of the pace; see `footfalls`.

    One step is at `step_time`, by default the `entry_time`. With a `position` the person stays
    there; with a speed or a table the force travels as other loads do.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 4e8, 1000.0, damping_ratio=0.01, modes=2),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.Pedestrian(pace=2.0, weight=700.0, speed=10.0)],
    ...     run=jb.Run(2.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.839 mm
    """

    kind: ClassVar[str] = "pedestrian"

    step_time: Float[Array, ""] | None = number("s", "time of a step", default=None, kw_only=True)
    position: Float[Array, ""] | None = number(
        "m", "place of a person who stays there", ON_BEAM, default=None, kw_only=True
    )

    def validate(self, address):
        error = self.step_error(address)
        if error is not None or self.position is None:
            return error or super().validate(address)
        for name in ("speed", "times", "start_position"):
            if getattr(self, name) is not None:
                return f"{address} has both position and {name}; leave one out"
        return None

    def trajectory(self, length):
        if self.position is None:
            return super().trajectory(length)
        return StandingTrajectory(self.position, self.entry_time, length)

    def vehicle(self, gravity):
        return plain_wheels(self.weight, xp.zeros(()))

    def force_histories(self):
        step = self.entry_time if self.step_time is None else self.step_time
        return {0: self.step_history(self.pace, step)}
