"""Axles in a row: forces or masses that travel together."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case.declared_checks import suggestion
from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    choice,
    concrete,
    is_concrete,
    number,
)
from jaxbeam.case.loads.row import AbstractRowLoad
from jaxbeam.case.loads.vehicle_checks import length_error
from jaxbeam.case.loads.vehicle_model import plain_wheels
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.vehicles.trains import LEFT_OUT, Train, trains


class Axles(AbstractRowLoad):
    """Moving forces or moving masses in a row: those of a named `train`, or of lists.

    `offsets` are distances behind the first axle; without a table of times they may be called
    `positions`. One entry of `forces` or `masses` may stand for all axles. With `masses` alone they
    are moving masses, whose weights are the forces; with both, the masses follow the surface and
    the forces are the static loads. `count` repeats wagons; those of the library know their length.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.Axles(offsets=[0.0, 3.0, 4.2], forces=[60e3, 110e3, 110e3], speed=20.0)],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    4.864 mm
    """

    kind: ClassVar[str] = "axles"

    train: str = choice("name of a train of the library", default="")
    offsets: Float[Array, " axle"] | None = number(
        "m", "distances of the axles behind the first one", INCREASING, default=None
    )
    forces: Float[Array, "*axle"] | None = number(
        "N", "forces of the axles, positive downwards", NOT_NEGATIVE, default=None
    )
    masses: Float[Array, "*axle"] | None = number(
        "kg", "masses of the axles", NOT_NEGATIVE, default=None
    )

    def __post_init__(self):
        if self.times is None and self.offsets is None:
            self.offsets, self.positions = self.positions, None

    def _library(self) -> Train:
        return trains()[self.train]

    def row_spacing(self):
        if self.spacing is None and self.train:
            return self._library().spacing
        return self.spacing

    def by_numbers(self):
        train = self._library() if self.train else None
        if train is None or train.forces is None:  # weights of masses depend on gravity
            return self
        return dataclasses.replace(
            self, train="", offsets=train.offsets, forces=train.forces, spacing=self.row_spacing()
        )

    def validate(self, address):
        error = self._train_error(address) if self.train else self._list_error(address)
        if error is not None:
            return error
        if self.count > 1 and self.row_spacing() is None and self.train:
            return (
                f"{address}.count must be 1 for {self.train}, which is a whole train; or give the"
                " spacing"
            )
        offsets = self._library().offsets if self.train else self.offsets
        error = super().validate(address)
        return error or self.overlap_error(address, offsets[-1] - offsets[0], "axles")

    def _train_error(self, address: str) -> str | None:
        if self.train in LEFT_OUT:
            return (
                f"{address}.train cannot be {self.train!r}, which the library leaves out:"
                f" {LEFT_OUT[self.train]}; give positions and forces"
            )
        if self.train not in trains():
            return f"{address}.train cannot be {self.train!r}; {suggestion(self.train, trains())}"
        for name in ("offsets", "forces", "masses"):
            if getattr(self, name) is not None:
                return f"{address} has both train and {name}; leave one out"
        return None

    def _list_error(self, address: str) -> str | None:
        if self.offsets is None and self.times is not None:
            return (
                f"{address}.offsets is missing; beside a table of times and positions give the"
                " distances of the axles behind the first one"
            )
        if self.offsets is None:
            return (
                f"{address} has neither train nor positions; name a train of the library, or give"
                " the distances of the axles behind the first one"
            )
        if self.forces is None and self.masses is None:
            return f"{address} has neither forces nor masses; give one of them"
        if not len(self.offsets):
            return f"{address}.offsets has no axle; give at least one, at 0"
        if is_concrete(self.offsets) and concrete(self.offsets)[0] != 0:
            return (
                f"{address}.offsets must begin with 0: they are distances in m behind the first"
                f" axle; the first is {concrete(self.offsets)[0]:g} m"
            )
        return length_error(address, self, "offsets", ("forces", "masses"))

    def vehicle(self, gravity):
        if self.train:
            train = self._library()
            masses = np.zeros(len(train.offsets))
            forces = train.masses * gravity if train.forces is None else train.forces
            return plain_wheels(forces, masses, train.offsets)
        each = np.ones(len(self.offsets))
        masses = 0.0 * each if self.masses is None else self.masses * each
        forces = masses * gravity if self.forces is None else self.forces * each
        return plain_wheels(xp.asarray(forces), xp.asarray(masses), self.offsets)
