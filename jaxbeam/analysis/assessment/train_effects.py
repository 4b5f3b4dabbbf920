"""Effects of trains over speed: the largest values of each at sections, with their limits."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxbeam.files.report import text_table


class TrainCurve(NamedTuple):
    """Largest absolute values of all effects under a train over its speeds (m/s).

    The factor for the state of the track is part of them.
    """

    train: str
    speeds: Float[np.ndarray, " speed"]
    values: Float[np.ndarray, "speed effect"]


class TrainEffects(NamedTuple):
    """Effects by name, with quantity, SI unit and limit of each, under some trains.

    Limits are that of the deck acceleration, and the effects of LM71 with its factors.
    """

    names: tuple[str, ...]
    quantities: tuple[str, ...]
    units: tuple[str, ...]
    limits: tuple[float, ...]
    curves: tuple[TrainCurve, ...]

    def largest(self) -> Float[np.ndarray, "train effect"]:
        """Largest values of the effects over the speeds of each train."""
        return np.stack([curve.values.max(axis=0) for curve in self.curves])

    def rows(self) -> list[list[str]]:
        """Rows of a table: head, then an effect each with its unit, limit and every train."""
        head = ["effect", "unit", "limit", *(curve.train for curve in self.curves)]
        numbers = np.column_stack([self.limits, self.largest().T])
        return [
            head,
            *(
                [name, unit, *(f"{value:.4g}" for value in row)]
                for name, unit, row in zip(self.names, self.units, numbers, strict=True)
            ),
        ]

    @property
    def lines(self) -> list[str]:
        """The table as lines of text."""
        head, *rows = self.rows()
        return text_table(head, rows, "<<" + ">" * (len(head) - 2))

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and texts by name."""
        curves = [
            {"train": one.train, "speeds": one.speeds.tolist(), "values": one.values.tolist()}
            for one in self.curves
        ]
        return self._asdict() | {"curves": curves}
