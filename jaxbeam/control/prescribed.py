"""Commands that are known beforehand: sums of sines, tables, logs."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.controller import AbstractController
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, number


class Prescribed(AbstractController):
    """Open loop: the commands follow given signals, whatever the beam does.

    To every actuator, offset + sum of amplitudes sin(2 pi frequency t + phase) is given, and to
    it a table of values is added, joined by straight lines and zero outside its times (to hold a
    value, end the table late). Leave out what is not needed.
    """

    offsets: Float[Array, " actuator"] = number("unit of a command", "constant for each actuator")
    amplitudes: Float[Array, "actuator sine"] | None = number(
        "unit of a command", "amplitudes of sines, a list for each actuator", default=None
    )
    frequencies: Float[Array, " sine"] | None = number(
        "Hz", "frequencies of the sines", NOT_NEGATIVE, default=None
    )
    phases: Float[Array, "actuator sine"] | None = number(
        "rad", "phases of the sines at t = 0", default=None
    )
    times: Float[Array, " point"] | None = number("s", "table: times", INCREASING, default=None)
    values: Float[Array, "actuator point"] | None = number(
        "unit of a command", "table: a list of commands for each actuator", default=None
    )

    @property
    def stateless(self) -> bool:
        return True

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    @property
    def open_loop(self) -> bool:
        return True

    def validate(self, case):
        count = len(case.actuators)
        for name in ("offsets", "amplitudes", "phases", "values"):
            value = getattr(self, name)
            if value is not None and value.shape[0] != count:
                return f"{name} must have an entry for each of {count} actuators"
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

    def init(self, plant):
        return None

    def step(self, memory, measurement, t):
        command = self.offsets
        if self.amplitudes is not None:
            angle = 2 * jnp.pi * self.frequencies * t
            angle = angle if self.phases is None else angle + self.phases
            command = command + jnp.sum(self.amplitudes * jnp.sin(angle), axis=-1)
        if self.times is not None:
            tabulated = [jnp.interp(t, self.times, row, left=0.0, right=0.0) for row in self.values]
            command = command + jnp.stack(tabulated)
        return command, memory

    def breakpoints(self, case):
        return self.times
