"""Feedback of readings through a filter of each loop's own: PD, lead, positive position feedback.

Each is given by its continuous transfer function. With a period it is made sampled by the bilinear
transform, so a stable filter stays stable at every period; without one it acts at every instant,
and its states join those of the plant. To add one, write a subclass with its `transfer`.
"""

import abc
import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import polynomial

from jaxbeam.case.controller import AbstractController, ControllerFilter
from jaxbeam.case.fields import POSITIVE, axis_names, concrete, is_concrete, number
from jaxbeam.case.filters import filter_step
from jaxbeam.control.feedback import pairing_error

Polynomials = Float[Array, "power actuator"]  # in s (rad/s), the coefficients ascending


class AbstractCompensator(AbstractController):
    """Each actuator answers the readings y of its own sensor through a filter: u(s) = H(s) y(s).

    The first actuator listens to the first sensor, the second to the second, and so on. Before its
    first tick the filters have seen nothing but zero.
    """

    gains: Float[Array, " actuator"] = number("command per reading", "one gain for each actuator")

    @property
    def design_depends_on_loads(self) -> bool:
        return False

    @property
    def stateless(self) -> bool:
        return self.period is None

    @abc.abstractmethod
    def transfer_function(self) -> tuple[Polynomials, Polynomials]:
        """Numerators and denominators of H(s), all of one degree, 1 or 2."""

    def bilinear_factor(self) -> Float[Array, " *actuator"]:
        """The factor c (1/s) of the bilinear transform s = c (z - 1) / (z + 1)."""
        return 2 / self.period

    def validate(self, case):
        error = pairing_error(self.gains, case)
        if error is not None:
            return error
        loops = self.gains.shape[0]
        for field in dataclasses.fields(self):
            if "unit" in field.metadata and axis_names(field) == "*actuator":
                shape = jnp.shape(getattr(self, field.name))
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

    def own_filters(self):
        if self.period is not None:
            return ()
        numerator, denominator = self.transfer_function()
        return tuple(
            _reading_filter(i, numerator[:, i], denominator[:, i])
            for i in range(self.gains.shape[0])
        )

    def init(self, plant):
        if self.period is None:
            return None
        numerator, denominator = (
            _bilinear_transform(part, self.bilinear_factor()) for part in self.transfer_function()
        )
        section = jnp.concatenate([numerator, denominator]) / denominator[0]
        return section[None], jnp.zeros((1, 2, self.gains.shape[0]))

    def step(self, memory, measurement, t):
        if self.period is None:
            return measurement.readings[-self.gains.shape[0] :], memory
        sections, filter_states = memory
        readings = measurement.readings[: self.gains.shape[0]]
        command, filter_states = filter_step(sections, filter_states, readings)
        return command, (sections, filter_states)

    def _per_loop(self, *coefficients) -> Polynomials:
        """Coefficients, each one number or one for each loop, as rows of such for each."""
        return jnp.stack([jnp.broadcast_to(row, self.gains.shape) for row in coefficients])


class PD(AbstractCompensator):
    """Proportional feedback and a rate that is smoothed: u = -(g + r s / (lag s + 1)) y."""

    rate_gains: Float[Array, " *actuator"] = number(
        "command per reading per s", "gain of the rate of the reading"
    )
    lag: Float[Array, " *actuator"] = number(
        "s", "time constant with which the rate is smoothed", POSITIVE
    )

    def transfer_function(self):
        rate_numerator = self.gains * self.lag + self.rate_gains
        return self._per_loop(-self.gains, -rate_numerator), self._per_loop(1.0, self.lag)


class Lead(AbstractCompensator):
    """Phase lead: u = -g (1 + s / z) / (1 + s / p) y; a phase lag if the zero z is above p."""

    zero: Float[Array, " *actuator"] = number("Hz", "where the gain starts to rise", POSITIVE)
    pole: Float[Array, " *actuator"] = number("Hz", "where it stops to rise", POSITIVE)

    def transfer_function(self):
        zero_time_constant, pole_time_constant = (
            1 / (2 * jnp.pi * self.zero),
            1 / (2 * jnp.pi * self.pole),
        )
        return self._per_loop(-self.gains, -self.gains * zero_time_constant), self._per_loop(
            1.0, pole_time_constant
        )


class PositivePositionFeedback(AbstractCompensator):
    """A damped oscillator, driven by the reading, that pushes with it.

        u = g w^2 / (s^2 + 2 zeta w s + w^2) y

    (Goh and Caughey, International Journal of Control 41, 1985). Tuned to a mode it damps that,
    and adds nothing to the gain above it; at rest it lowers the stiffness. The bilinear transform
    is warped to meet it at its frequency.
    """

    frequency: Float[Array, " *actuator"] = number("Hz", "frequency of the oscillator", POSITIVE)
    damping_ratio: Float[Array, " *actuator"] = number(
        "1", "damping ratio of the oscillator", POSITIVE
    )

    def transfer_function(self):
        angular_frequency = 2 * jnp.pi * self.frequency
        stiffness = angular_frequency**2
        denominator = self._per_loop(stiffness, 2 * self.damping_ratio * angular_frequency, 1.0)
        return self._per_loop(self.gains * stiffness, 0.0, 0.0), denominator

    def bilinear_factor(self):
        angular_frequency = 2 * jnp.pi * self.frequency
        return angular_frequency / jnp.tan(angular_frequency * self.period / 2)

    def validate(self, case):
        frequency, period = self.frequency, self.period
        if period is not None and is_concrete(frequency) and is_concrete(period):
            highest, nyquist = float(concrete(frequency).max()), 0.5 / float(concrete(period))
            if highest >= nyquist:
                return (
                    f"frequency must be below half the sampling frequency, {nyquist:g} Hz;"
                    f" it is {highest:g} Hz: lower it, or sample faster"
                )
        return super().validate(case)


def _reading_filter(
    sensor: int, numerator: Float[Array, " power"], denominator: Float[Array, " power"]
) -> ControllerFilter:
    """States of a transfer function: x1 follows the reading, x2 is its rate over a frequency.

    At rest x1 is the reading; denominators are of degree 1 or 2.
    """
    feedthrough = numerator[-1] / denominator[-1]
    output_row = (numerator - feedthrough * denominator)[:-1] / denominator[0]
    if denominator.shape[0] == 2:
        rate = (denominator[0] / denominator[1])[None]
        return ControllerFilter(sensor, -rate[None], rate, output_row, feedthrough)
    angular_frequency, damping_rate = (
        jnp.sqrt(denominator[0] / denominator[2]),
        denominator[1] / denominator[2],
    )
    zero = jnp.zeros(())
    matrix = jnp.stack(
        [jnp.stack([zero, angular_frequency]), jnp.stack([-angular_frequency, -damping_rate])]
    )
    return ControllerFilter(
        sensor,
        matrix,
        jnp.stack([zero, angular_frequency]),
        jnp.stack([output_row[0], output_row[1] * angular_frequency]),
        feedthrough,
    )


def _bilinear_transform(coefficients: Polynomials, factor) -> Float[Array, "3 actuator"]:
    """Coefficients in 1/z of (1 + 1/z)^degree times a polynomial at s = c (z - 1) / (z + 1)."""
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
    scaled = coefficients * jnp.asarray(factor) ** powers[:, None]
    return jnp.pad(terms.T @ scaled, ((0, 2 - degree), (0, 0)))
