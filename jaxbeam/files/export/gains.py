"""Gain tables as a controller runs them, and the numbers by which copies of them are checked."""

import dataclasses
import math
import zlib

import numpy as np
from numpy.typing import ArrayLike

ARRAYS = ("masses", "speeds", "shares", "table", "rest", "filters", "estimator")
TEST_SHARE = 0.37  # of the crossing
TEST_FRACTION = 0.3  # of the way from the smallest to the largest mass, and speed


@dataclasses.dataclass(frozen=True, eq=False)
class Gains:
    """Gain tables as a controller runs them: u = -K(mass, speed, share) z.

    `table` (mass, speed, share, actuator, column) has K at the `masses` (kg), `speeds` (m/s) and
    `shares` of the crossing, from the entry of the first load to the exit of the last; `rest`
    (mass, speed, actuator, column) is from the exit on, and dies away with the time constant `decay_time`
    (s) if that is finite. K is linear between the shares, and `interpolation` masses and speeds either
    "interpolated", too, or that of the "nearest"; beyond the grid it is held. A table for one load
    has one mass and one speed, zero, which nobody asks for; a constant gain has one share as well.

    `crossing_time` (s) is that of the load designed for, zero for a constant gain; a crossing of another
    length stretches the table. `columns` and `commands` are (name, unit). Rows of `filters` are the
    index of a sensor and its section b0, b1, b2, a0, a1, a2.

    The `estimator`, empty if there is none, is [[A, B, B', L], [C, 0, D, o]]: from tick to tick its
    states x become A x + B u + B' u', u being the commands that acted until the tick before and u'
    those until this, and then, with so many `reading_count` y, by L (y - C x - D u' - o) more (o is the
    first column of its block). The first of them are the first `columns`.
    """

    masses: np.ndarray
    speeds: np.ndarray
    shares: np.ndarray
    table: np.ndarray
    rest: np.ndarray
    filters: np.ndarray
    period: float
    crossing_time: float
    decay_time: float
    interpolation: str
    columns: tuple[tuple[str, str], ...]
    commands: tuple[tuple[str, str], ...]
    estimator: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    reading_count: int = 0

    def command(
        self,
        state: ArrayLike,
        share: float = 0.0,
        since_exit: float = 0.0,
        mass: float = 0.0,
        speed: float = 0.0,
    ) -> np.ndarray:
        """Commands for a state, in the order of `columns`, at a share of the crossing.

        From the exit on, which was `since_exit` s ago, the share is 1 or more. `mass` (kg) and
        `speed` (m/s, its size) are those of the load. Zero before the entry. Products are added one
        by one, as the C header does, so results agree to the last bit (with a `fade`, where both
        take exp from the same library).
        """
        total = np.zeros(len(self.commands))
        if share < 0:
            return total
        gain = np.zeros(self.rest.shape[2:])
        for i, mass_weight in self._grid_weights(self.masses, mass):
            for j, speed_weight in self._grid_weights(self.speeds, speed):
                gain = gain + mass_weight * speed_weight * self._gain_at(i, j, share, since_exit)
        for column, value in zip(gain.T, np.asarray(state, float), strict=True):
            total = total - column * value
        return total

    @property
    def estimator_size(self) -> int:
        """How many states the estimator has."""
        return self.estimator.shape[0] - self.reading_count

    def estimate(
        self,
        state: ArrayLike,
        previous_command: ArrayLike,
        current_command: ArrayLike,
        readings: ArrayLike,
    ) -> np.ndarray:
        """The estimator's states at a tick, from those at the tick before; zero at the start.

        `previous_command` are the commands that acted until the tick before, `current_command` those until this one. Sums
        are taken one by one, as the C header does.
        """
        size, inputs = self.estimator_size, len(self.commands)
        if not size:
            return np.zeros(0)
        stacked = np.concatenate(
            [np.ravel(state), np.ravel(previous_command), np.ravel(current_command)]
        )
        prior = _accumulate(np.zeros(size), self.estimator[:size], stacked)
        output_rows, offset_column = self.estimator[size:], size + 2 * inputs
        output_inputs = np.concatenate([prior, np.zeros(inputs), np.ravel(current_command)])
        innovation = _accumulate(
            np.ravel(readings) - output_rows[:, offset_column], -output_rows, output_inputs
        )
        return _accumulate(prior, self.estimator[:size, offset_column:], innovation)

    def _gain_at(self, i: int, j: int, share: float, since_exit: float) -> np.ndarray:
        """The gain of one mass and speed of the grid."""
        if share >= 1 and self.shares.size > 1:
            decay = (
                math.exp(-since_exit / self.decay_time) if math.isfinite(self.decay_time) else 1.0
            )
            return decay * self.rest[i, j]
        k, fraction = _index_and_fraction(self.shares, share)
        low = self.table[i, j, k]
        return low + fraction * (self.table[i, j, min(k + 1, self.shares.size - 1)] - low)

    def _grid_weights(self, grid: np.ndarray, value: float) -> list[tuple[int, float]]:
        """Designs of a grid that contribute at a value, and what each contributes."""
        if self.interpolation == "nearest":
            return [(int(np.argmin(np.abs(grid - value))), 1.0)]
        i, fraction = _index_and_fraction(grid, value)
        return [(i, 1.0 - fraction), (min(i + 1, grid.size - 1), fraction)]

    @property
    def test_input(self) -> dict:
        """The input of the check: state 1, 1/2, 1/3, ..., and what else `command` takes."""
        grids = self.masses, self.speeds
        mass, speed = (float(g[0] + TEST_FRACTION * (g[-1] - g[0])) for g in grids)
        state = (1 / np.arange(1.0, len(self.columns) + 1)).tolist()
        load = {"mass": mass, "speed": speed}
        return {"state": state, "share": TEST_SHARE, "since_exit": 0.0} | load

    @property
    def test_command(self) -> np.ndarray:
        """The commands that answer the test input."""
        return self.command(**self.test_input)

    @property
    def test_estimate(self) -> np.ndarray:
        """The estimator's states after 1, 1/2, 1/3, ... in each: states, commands and readings."""
        counts = self.estimator_size, len(self.commands), len(self.commands)
        return self.estimate(*(1 / np.arange(1.0, n + 1) for n in (*counts, self.reading_count)))

    @property
    def checksum(self) -> int:
        """CRC-32 of period, crossing, fade and all arrays in turn, as little-endian doubles."""
        numbers = [self.period, self.crossing_time, self.decay_time]
        parts = [numbers, *(getattr(self, name) for name in ARRAYS)]
        return zlib.crc32(b"".join(np.ravel(part).astype("<f8").tobytes() for part in parts))


def _accumulate(total: np.ndarray, matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A sum and the products of a matrix, whose further columns do not count, one by one."""
    for column, value in zip(matrix.T, values, strict=False):
        total = total + column * value
    return total


def _index_and_fraction(grid: np.ndarray, value: float) -> tuple[int, float]:
    """The last point of a grid that is not above a value, and how far on to the next it is."""
    i = max(int(np.searchsorted(grid, value, "right")) - 1, 0)
    if i + 1 >= grid.size or value <= grid[i]:
        return i, 0.0
    return i, float((value - grid[i]) / (grid[i + 1] - grid[i]))
