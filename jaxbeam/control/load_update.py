"""Listening to the deflections under a load: what all ways of recognising one have in common."""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.controller import Measurement


class Listener(eqx.Module):
    """What is known of a load by now.

    `line` are the influence lines (m/N) of the sensors `seen` at places all along the beam, by the
    modes of the design (`static.influence_line` is exact), `lift` the static deflections there per
    unit of the commands. `fit` gathers the sums of the least squares, the only part that changes.
    """

    length: Float[Array, ""]
    gravity: Float[Array, ""]
    line: Float[Array, "sensor place"]
    lift: Float[Array, "sensor actuator"]
    offset: Float[Array, " sensor"]
    fit: Float[Array, " sum"]
    seen: tuple[int, ...] = eqx.field(static=True)

    @property
    @abc.abstractmethod
    def speed(self) -> Float[Array, ""]:
        """The speed (m/s), negative to the left; what it is until it is known, is of no meaning."""

    @property
    @abc.abstractmethod
    def entry(self) -> Float[Array, ""]:
        """When the load enters the beam (s), if it keeps its speed."""

    @property
    @abc.abstractmethod
    def mass(self) -> Float[Array, ""]:
        """The mass (kg) that fits what was heard; zero where nothing was."""

    @abc.abstractmethod
    def told(self, t: Float[Array, ""]) -> tuple[Array, Array]:
        """Whether speed and mass are known at a time (s)."""

    @abc.abstractmethod
    def news(
        self, deflections: Float[Array, " sensor"], t: Float[Array, ""]
    ) -> Float[Array, " sum"]:
        """What is added to the sums for the deflections (m) under the load alone, at t (s)."""

    def hear(self, measurement: Measurement, t: Float[Array, ""]) -> "Listener":
        """The same after the readings of a tick at t (s)."""
        readings = measurement.readings[np.array(self.seen)] - self.offset
        news = self.news(readings - self.lift @ measurement.command, t)
        return eqx.tree_at(lambda listener: listener.fit, self, self.fit + news)

    def mass_of(self, across, along) -> Float[Array, ""]:
        """The mass (kg) for the sums of line times reading, and of squares of the line."""
        weight = jnp.where(along > 0, across / jnp.where(along > 0, along, 1.0), 0.0)
        return weight / self.gravity
