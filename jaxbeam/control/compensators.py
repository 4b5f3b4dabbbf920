"""Collocated compensators: PD, which is also a phase lead, and positive position feedback.

Each is given by its transfer function. With a period it is discretised by the bilinear transform,
so that a stable filter is stable at every period; in continuous time its states are integrated
with those of the plant. To add one, write a subclass with its `transfer_function`.
"""

import abc
import dataclasses
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Float
from numpy.polynomial import polynomial

from jaxbeam.case.controller import (
    AbstractContinuousLaw,
    AbstractController,
    AbstractSampledLaw,
    ControllerFilter,
    ControlStep,
)
from jaxbeam.case.fields import POSITIVE, axis_names, concrete, is_concrete, number
from jaxbeam.case.sensors import filter_step
from jaxbeam.control.feedback import pairing_error
from jaxbeam.runtime.arrays import Array, Number, xp

# In s (rad/s), coefficients ascending; filters actuator by actuator, then those added to them.
Polynomials = Float[Array, "power filter"]


class AbstractCompensator(AbstractController):
    """Feedback of each actuator's own sensor through a transfer function: u(s) = H(s) y(s).

    The first actuator is fed by the first sensor, the second by the second, and so on. Filters
    start from zero.
    """

    gains: Float[Number, " actuator"] = number("command per reading", "one gain for each actuator")

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    @abc.abstractmethod
    def transfer_function(self) -> tuple[Polynomials, Polynomials]:
        """Numerators and denominators of H(s), all of one degree, 1 or 2."""

    def bilinear_factor(self) -> Float[Array, " *filter"]:
        """The factor c (1/s) of the bilinear transform s = c (z - 1) / (z + 1)."""
        return 2 / self.period

    def validate(self, case):
        error = pairing_error(self.gains, case)
        if error is not None:
            return error
        loops = self.gains.shape[0]
        for field in dataclasses.fields(self):
            if "unit" in field.metadata and axis_names(field) == "*actuator":
                shape = xp.shape(getattr(self, field.name))
                if shape not in ((), (loops,)):
                    return (
                        f"{field.name} must be one number for all {loops} loops or one for each,"
                        f" not {shape[0]}"
                    )
        if self.period is not None:
            return None
        for i, sensor in enumerate(case.sensors[:loops]):
            if sensor.range is not None or (
                is_concrete(sensor.offset) and concrete(sensor.offset) != 0
            ):
                return f"period must be given, as sensors.{i} has an offset or a range"
        return None

    def design_law(self, plant):
        numerator, denominator = self.transfer_function()
        loops = self.gains.shape[0]
        if self.period is None:
            pairs = enumerate(zip(numerator.T, denominator.T, strict=True))
            return ContinuousCompensator(
                tuple(_reading_filter(i % loops, *pair) for i, pair in pairs), loops
            )
        numerator, denominator = (
            _bilinear_transform(part, self.bilinear_factor()) for part in (numerator, denominator)
        )
        section = xp.concatenate([numerator, denominator]) / denominator[0]
        return SampledCompensator(section[None], loops)

    def _per_loop(self, *coefficients) -> Polynomials:
        """Coefficients as rows with an entry for each loop; a single number holds for all loops."""
        return xp.stack([xp.broadcast_to(row, self.gains.shape) for row in coefficients])


class SampledCompensator(AbstractSampledLaw):
    """Second-order sections, those of each loop added up; the state is that of the sections."""

    sections: Float[Array, "1 6 filter"]
    loops: int = eqx.field(static=True)

    def initial_state(self):
        return xp.zeros((1, 2, self.sections.shape[-1]))

    def step(self, state, measurement, t):
        readings = measurement.readings[: self.loops]
        times = self.sections.shape[-1] // self.loops
        readings = readings if times == 1 else xp.concatenate([readings] * times)
        outputs, state = filter_step(self.sections, state, readings)
        return ControlStep(_of_loops(outputs, self.loops), state)


class ContinuousCompensator(AbstractContinuousLaw):
    """Filters of the readings; the commands are their outputs, those of each loop added up."""

    reading_filters: tuple[ControllerFilter, ...]
    loops: int = eqx.field(static=True)

    @property
    def filters(self):
        return self.reading_filters

    def command(self, state, measurement, t):
        return _of_loops(measurement.readings[-len(self.reading_filters) :], self.loops)


def _of_loops(outputs: Float[Array, " filter"], loops: int) -> Float[Array, " actuator"]:
    """Sums of the outputs of the filters of each loop."""
    return outputs if outputs.shape[0] == loops else xp.sum(outputs.reshape(-1, loops), axis=0)


class PD(AbstractCompensator):
    """Proportional feedback and a smoothed rate: u = -(g + r s / (lag s + 1)) y.

    With the lag 1 / p and r = g / z - g / p it is a phase lead, u = -g (1 + s / z) / (1 + s / p) y.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.PD(gains=[2e3], rate_gains=[20.0], lag=0.002, period=0.005),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.890 mm
    """

    kind: ClassVar[str] = "pd"

    rate_gains: Float[Number, " *actuator"] = number(
        "command per reading per s", "gain of the rate of the reading"
    )
    lag: Float[Number, " *actuator"] = number(
        "s", "time constant of the lag that smooths the rate", POSITIVE
    )

    def transfer_function(self):
        rate_numerator = self.gains * self.lag + self.rate_gains
        return self._per_loop(-self.gains, -rate_numerator), self._per_loop(1.0, self.lag)


class PositivePositionFeedback(AbstractCompensator):
    """Positive position feedback: a damped oscillator driven by the reading.

        u = g w^2 / (s^2 + 2 zeta w s + w^2) y

    (Goh and Caughey, International Journal of Control 41, 1985). Tuned to a mode it damps that
    mode and rolls off above it; at rest it lowers the stiffness. The bilinear transform is warped
    to be exact at the frequency of the oscillator. Several modes take several oscillators an
    actuator, whose outputs are added up: row after row, the `further_` numbers are those of one
    more oscillator at each actuator.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=2),
    ...     actuators=[jb.PointForce(0.3)],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.4, speed=4.0)],
    ...     controller=jb.PositivePositionFeedback(
    ...         gains=[-800.0], frequency=60.0, damping_ratio=0.5, period=0.005
    ...     ),
    ...     run=jb.Run(0.15),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    1.175 mm
    """

    kind: ClassVar[str] = "ppf"

    frequency: Float[Number, " *actuator"] = number("Hz", "frequency of the oscillator", POSITIVE)
    damping_ratio: Float[Number, " *actuator"] = number(
        "1", "damping ratio of the oscillator", POSITIVE
    )
    further_gains: Float[Number, "oscillator actuator"] | None = number(
        "command per reading", "gains of further oscillators", default=None
    )
    further_frequencies: Float[Number, "oscillator actuator"] | None = number(
        "Hz", "frequencies of further oscillators", POSITIVE, default=None
    )
    further_damping_ratios: Float[Number, "oscillator actuator"] | None = number(
        "1", "damping ratios of further oscillators", POSITIVE, default=None
    )

    def transfer_function(self):
        gains, frequencies, damping_ratios = self._oscillators()
        angular_frequencies = 2 * xp.pi * frequencies
        stiffness, zeros = angular_frequencies**2, xp.zeros_like(gains)
        damping = 2 * damping_ratios * angular_frequencies
        denominator = xp.stack([stiffness, damping, xp.ones_like(gains)])
        return xp.stack([gains * stiffness, zeros, zeros]), denominator

    def _oscillators(self) -> tuple[Float[Array, " filter"], ...]:
        """Gains, frequencies (Hz) and damping ratios of all oscillators, row after row."""
        firsts = self.gains, self.frequency, self.damping_ratio
        rows = [xp.broadcast_to(first, self.gains.shape) for first in firsts]
        further = self._further()
        if further[0] is None:
            return tuple(rows)
        pairs = zip(rows, further, strict=True)
        return tuple(xp.concatenate([row, others.reshape(-1)]) for row, others in pairs)

    def _further(self):
        return self.further_gains, self.further_frequencies, self.further_damping_ratios

    def bilinear_factor(self):
        angular_frequencies = 2 * xp.pi * self._oscillators()[1]
        return angular_frequencies / xp.tan(angular_frequencies * self.period / 2)

    def validate(self, case):
        error = super().validate(case)
        if error is not None:
            return error
        further, loops = [one for one in self._further() if one is not None], self.gains.shape[0]
        words = "further_gains, further_frequencies and further_damping_ratios"
        if len(further) % 3:
            return f"{words} belong together: give all three, or none"
        if any(one.shape != (further[0].shape[0], loops) for one in further):
            return (
                f"{words} must have as many rows, one for each further oscillator, of a number for"
                f" each of {loops} actuators"
            )
        for name in ("frequency", "further_frequencies"):
            given, period = getattr(self, name), self.period
            if given is None or period is None or not is_concrete(given) or not is_concrete(period):
                continue
            highest, nyquist = float(concrete(given).max()), 0.5 / float(concrete(period))
            if highest >= nyquist:
                return (
                    f"{name} must be below half the sampling frequency, {nyquist:g} Hz;"
                    f" it is {highest:g} Hz: lower it, or sample faster"
                )
        return None


def _reading_filter(
    sensor: int, numerator: Float[Array, " power"], denominator: Float[Array, " power"]
) -> ControllerFilter:
    """Filter of order 1 or 2 with a given transfer function; its states are x1, and x2 = x1' / w.

    In steady state x1 equals the reading.
    """
    feedthrough = numerator[-1] / denominator[-1]
    output_row = (numerator - feedthrough * denominator)[:-1] / denominator[0]
    if denominator.shape[0] == 2:
        rate = (denominator[0] / denominator[1])[None]
        return ControllerFilter(sensor, -rate[None], rate, output_row, feedthrough)
    angular_frequency = xp.sqrt(denominator[0] / denominator[2])
    damping_rate = denominator[1] / denominator[2]
    zero = xp.zeros(())
    matrix = xp.stack(
        [xp.stack([zero, angular_frequency]), xp.stack([-angular_frequency, -damping_rate])]
    )
    return ControllerFilter(
        sensor,
        matrix,
        xp.stack([zero, angular_frequency]),
        xp.stack([output_row[0], output_row[1] * angular_frequency]),
        feedthrough,
    )


def _bilinear_transform(coefficients: Polynomials, factor) -> Float[Array, "3 filter"]:
    """Bilinear transform of polynomials in s: coefficients in 1/z, with s = c (z - 1) / (z + 1).

    The factor (1 + 1/z)^degree that clears the denominator is included.
    """
    degree = coefficients.shape[0] - 1
    powers = np.arange(degree + 1)
    terms = np.stack(
        [
            polynomial.polymul(
                polynomial.polypow([1, -1], n), polynomial.polypow([1, 1], degree - n)
            )
            for n in powers
        ]
    )
    scaled = coefficients * xp.asarray(factor) ** powers[:, None]
    return xp.pad(terms.T @ scaled, ((0, 2 - degree), (0, 0)))
