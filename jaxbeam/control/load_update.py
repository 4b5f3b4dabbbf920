"""Listening to the deflections under a load: what all ways of recognising one have in common."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.controller import Measurement


class AbstractLoadIdentifier(eqx.Module):
    """What is known of a load by now.

    `influence_lines` are the influence lines (m/N) of the sensors `sensor_indices` at places all along the beam, by the
    modes of the design (`static.influence_line` is exact), `static_lift` the static deflections there per
    unit of the commands. `sums` gathers the sums of the least squares, the only part that changes.
    """

    length: Float[Array, ""]
    gravity: Float[Array, ""]
    influence_lines: Float[Array, "sensor place"]
    static_lift: Float[Array, "sensor actuator"]
    offset: Float[Array, " sensor"]
    sums: Float[Array, " sum"]
    sensor_indices: tuple[int, ...] = eqx.field(static=True)

    @property
    @abc.abstractmethod
    def speed(self) -> Float[Array, ""]:
        """The speed (m/s), negative to the left; what it is until it is known, is of no meaning."""

    @property
    @abc.abstractmethod
    def entry_time(self) -> Float[Array, ""]:
        """When the load enters the beam (s), if it keeps its speed."""

    @property
    @abc.abstractmethod
    def mass(self) -> Float[Array, ""]:
        """The mass (kg) that fits what was heard; zero where nothing was."""

    @abc.abstractmethod
    def identified(self, t: Float[Array, ""]) -> tuple[Array, Array]:
        """Whether speed and mass are known at a time (s)."""

    @abc.abstractmethod
    def innovation(
        self, deflections: Float[Array, " sensor"], t: Float[Array, ""]
    ) -> Float[Array, " sum"]:
        """What is added to the sums for the deflections (m) under the load alone, at t (s)."""

    def update(self, measurement: Measurement, t: Float[Array, ""]) -> "AbstractLoadIdentifier":
        """The same after the readings of a tick at t (s)."""
        readings = measurement.readings[np.array(self.sensor_indices)] - self.offset
        increments = self.innovation(readings - self.static_lift @ measurement.command, t)
        return eqx.tree_at(lambda listener: listener.fit, self, self.sums + increments)

    def fitted_mass(self, influence_reading_sum, squared_influence_sum) -> Float[Array, ""]:
        """The mass (kg) for the sums of line times reading, and of squares of the line."""
        weight = jnp.where(
            squared_influence_sum > 0,
            influence_reading_sum
            / jnp.where(squared_influence_sum > 0, squared_influence_sum, 1.0),
            0.0,
        )
        return weight / self.gravity
