"""Open-loop commands prescribed over time: sums of sines and tables, such as those of a log."""

from typing import ClassVar

from jaxtyping import Float

from jaxbeam.case.controller import AbstractStaticController
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, number
from jaxbeam.runtime.arrays import Array, xp


class Prescribed(AbstractStaticController):
    """Commands as given functions of time.

    Each actuator receives its offset + sum of amplitudes sin(2 pi frequency t + phase), plus a
    table of values, interpolated linearly between its times and zero outside them (to hold a
    value, end the table after the run). Parts may be left out.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.Prescribed(
    ...         offsets=[2.0], amplitudes=[[0.5]], frequencies=[5.0], period=0.005
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.131 mm
    """

    kind: ClassVar[str] = "prescribed"
    open_loop: ClassVar[bool] = True

    offsets: Float[Array, " actuator"] = number(
        "unit of a command", "constant command of each actuator"
    )
    amplitudes: Float[Array, "actuator sine"] | None = number(
        "unit of a command", "amplitudes of the sines, a row for each actuator", default=None
    )
    frequencies: Float[Array, " sine"] | None = number(
        "Hz", "frequencies of the sines", NOT_NEGATIVE, default=None
    )
    phases: Float[Array, "actuator sine"] | None = number(
        "rad", "phases of the sines at t = 0", default=None
    )
    times: Float[Array, " point"] | None = number(
        "s", "times of the table", INCREASING, default=None
    )
    values: Float[Array, "actuator point"] | None = number(
        "unit of a command", "commands of the table, a row for each actuator", default=None
    )

    def validate(self, case):
        count = len(case.driven)
        for name in ("offsets", "amplitudes", "phases", "values"):
            value = getattr(self, name)
            if value is not None and value.shape[0] != count:
                return (
                    f"{name} must have an entry for each of {count} actuators that take commands,"
                    f" not {value.shape[0]}"
                )
        if (self.amplitudes is None) != (self.frequencies is None):
            return "amplitudes and frequencies belong together; give both or neither"
        if self.phases is not None and self.amplitudes is None:
            return "phases have no effect without amplitudes and frequencies"
        for name in ("amplitudes", "phases"):
            value = getattr(self, name)
            if value is not None and value.shape[1] != self.frequencies.shape[0]:
                return f"{name} must have a column for each of the frequencies"
        if (self.times is None) != (self.values is None):
            return "times and values belong together; give both or neither"
        if self.times is not None and self.values.shape[1] != self.times.shape[0]:
            return "values must have a column for each of the times"
        return None

    def command(self, state, measurement, t):
        command = self.offsets
        if self.amplitudes is not None:
            angle = 2 * xp.pi * self.frequencies * t
            angle = angle if self.phases is None else angle + self.phases
            command = command + xp.sum(self.amplitudes * xp.sin(angle), axis=-1)
        if self.times is not None:
            tabulated = [xp.interp(t, self.times, row, left=0.0, right=0.0) for row in self.values]
            command = command + xp.stack(tabulated)
        return command

    def breakpoints(self, case):
        return self.times
