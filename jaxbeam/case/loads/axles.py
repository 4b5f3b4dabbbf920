"""Rows of forces: axles, trains of the library, line loads."""

import dataclasses
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case import fields
from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    POSITIVE,
    choice,
    concrete,
    is_concrete,
    number,
    suggestion,
)
from jaxbeam.case.library.published import LEFT_OUT, Train, line_loads, trains
from jaxbeam.case.loads.base import (
    AbstractRowLoad,
    AbstractStandingLoad,
    AbstractVehicleLoad,
    length_error,
    plain_wheels,
)
from jaxbeam.runtime.arrays import Number, xp


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
    offsets: Float[Number, " axle"] | None = number(
        "m", "distances of the axles behind the first one", INCREASING, default=None
    )
    forces: Float[Number, "*axle"] | None = number(
        "N", "forces of the axles, positive downwards", NOT_NEGATIVE, default=None
    )
    masses: Float[Number, "*axle"] | None = number(
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
                f"{address}.offsets is missing; with a table of times and positions give the"
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


class LineLoad(AbstractStandingLoad, AbstractVehicleLoad):
    """Forces per length in one or more parts, one behind the other, as many point forces each.

    A `model` of the library, LM71, SW/0, SW/2 or "unloaded-train", or own lists. Each part is
    replaced by `points` equal forces in the middles of as many pieces: for statics the error falls
    as the square of their length h; a travelling load excites the beam at the frequency v / h too.
    The front is at the position of the load; with a `position` it stands there, and parts beyond
    the ends of the beam do not count.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 1e10, 12e3, damping_ratio=0.01, modes=3),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.LineLoad(force_per_length=[80e3], lengths=[5.0], points=4, speed=20.0)],
    ...     run=jb.Run(1.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    6.708 mm
    """

    kind: ClassVar[str] = "line-load"

    model: str = choice("name of a line load of the library", default="")
    force_per_length: Float[Number, "*part"] | None = number(
        "N/m", "force per length of each part, positive downwards", NOT_NEGATIVE, default=None
    )
    lengths: Float[Number, "*part"] | None = number(
        "m", "lengths of the parts, front first", POSITIVE, default=None
    )
    gaps: Float[Number, "*part"] | None = number(
        "m", "gaps before the parts; 0 if left out", NOT_NEGATIVE, default=None
    )
    tail: Float[Number, ""] = number(
        "m", "length of parts of the library without an end", POSITIVE, default=50.0
    )
    points: int = fields.count("point forces of each part", default=100)
    position: Float[Number, ""] | None = number(
        "m", "place of the front of a load that does not travel", default=None
    )

    def validate(self, address):
        error = self._model_error(address) if self.model else self._list_error(address)
        return error or super().validate(address)

    def _model_error(self, address: str) -> str | None:
        if self.model not in line_loads():
            hint = suggestion(self.model, line_loads())
            return f"{address}.model cannot be {self.model!r}; {hint}"
        for name in ("force_per_length", "lengths", "gaps"):
            if getattr(self, name) is not None:
                return f"{address} has both model and {name}; leave one out"
        return None

    def _list_error(self, address: str) -> str | None:
        if self.force_per_length is None or self.lengths is None:
            return (
                f"{address} has neither model nor force_per_length with lengths; name a line load"
                " of the library, or give both"
            )
        if not np.ndim(self.lengths):
            for name in ("force_per_length", "gaps"):
                if np.ndim(getattr(self, name)):
                    return f"{address}.lengths must be a list as {name} is, one for each part"
            return None
        return length_error(address, self, "lengths", ("force_per_length", "gaps"))

    def vehicle(self, gravity):
        axle_offsets, axle_forces = np.zeros(0), np.zeros(0)
        if self.model:
            code = line_loads()[self.model]
            intensity, gaps = code.force_per_length, code.gaps
            lengths = xp.where(code.lengths == 0, self.tail, code.lengths)
            axle_offsets, axle_forces = lengths[0] + code.axle_offsets, code.axle_forces
        else:
            lengths = xp.reshape(self.lengths, -1)
            gaps = 0.0 * lengths if self.gaps is None else self.gaps * xp.ones_like(lengths)
            intensity = self.force_per_length * xp.ones_like(lengths)
        ends = xp.cumsum(gaps + lengths)
        middles = (np.arange(self.points) + 0.5) / self.points
        places = (ends - lengths)[:, None] + lengths[:, None] * middles
        forces = (intensity * lengths / self.points)[:, None] * np.ones(self.points)
        places = xp.concatenate([places.reshape(-1), axle_offsets])
        forces = xp.concatenate([forces.reshape(-1), axle_forces])
        return plain_wheels(forces, xp.zeros_like(forces), places)
