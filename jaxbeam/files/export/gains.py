"""Gain tables as a controller evaluates them, and the check values of files."""

import dataclasses
import math
import zlib

import numpy as np
from numpy.typing import ArrayLike

ARRAYS = ("masses", "speeds", "shares", "table", "rest", "filters", "estimator")
TEST_SHARE = 0.37  # of the crossing
TEST_FRACTION = 0.3  # of the ranges of mass and speed


@dataclasses.dataclass(frozen=True, eq=False)
class Gains:
    """Gain tables as a controller evaluates them: u = -K(mass, speed, share) z.

    `table` (mass, speed, share, actuator, column) is K at the `masses` (kg), `speeds` (m/s) and
    fractions (`shares`) of the crossing, 0 at the entry of the first load, 1 at the last exit;
    `rest` (mass, speed, actuator, column) is K after the exit, which decays with the time constant
    `decay_time` (s) if that is finite. K is interpolated linearly over the share, and over mass and
    speed either linearly too (`interpolation` "interpolated") or by the "nearest" design; beyond
    the grid it is constant. A design for one load has one mass and one speed, both 0; a constant
    gain has one share as well.

    `crossing_time` (s) is that of the design, 0 for a constant gain. `columns` (of z) and
    `commands` are pairs of name and unit. Rows of `filters` are the index of a sensor and a section
    b0, b1, b2, a0, a1, a2 of its digital filter.

    `estimator` = [[A, B, B', L], [C, 0, D, o]], empty if there is none, has at each sample k the
    prediction x- = A x + B u[k-1] + B' u[k] and the update x = x- + L (y - C x- - D u[k] - o), with
    `reading_count` readings y, commands u[k] that acted until sample k, and o the first column of
    its block. Its first states are the first of z.
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
        """Commands for a state z, in the order of `columns`, at a fraction of the crossing.

        The `share` is negative before the entry, where commands are zero, and 1 or more from the
        exit on, which was `since_exit` s ago. `mass` (kg) and `speed` (m/s, absolute) are those of
        the load. Products are added in the order of the function `jaxbeam_command` of the C header,
        so results agree to the last bit (with a finite `decay_time`, if both use the same `exp`).
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
        """Number of states of the estimator."""
        return self.estimator.shape[0] - self.reading_count

    def estimate(
        self,
        state: ArrayLike,
        previous_command: ArrayLike,
        current_command: ArrayLike,
        readings: ArrayLike,
    ) -> np.ndarray:
        """State estimate at a sample, from that at the previous sample; zero initially.

        `previous_command` acted until the previous sample, `current_command` until this one. Sums
        are in the order of the function `jaxbeam_estimate` of the C header.
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
        """Gain of one mass and speed of the grid."""
        if share >= 1 and self.shares.size > 1:
            decay = (
                math.exp(-since_exit / self.decay_time) if math.isfinite(self.decay_time) else 1.0
            )
            return decay * self.rest[i, j]
        k, fraction = _index_and_fraction(self.shares, share)
        low = self.table[i, j, k]
        return low + fraction * (self.table[i, j, min(k + 1, self.shares.size - 1)] - low)

    def _grid_weights(self, grid: np.ndarray, value: float) -> list[tuple[int, float]]:
        """Indices into a grid and their weights, for the interpolation at a value."""
        if self.interpolation == "nearest":
            return [(int(np.argmin(np.abs(grid - value))), 1.0)]
        i, fraction = _index_and_fraction(grid, value)
        return [(i, 1.0 - fraction), (min(i + 1, grid.size - 1), fraction)]

    @property
    def test_input(self) -> dict:
        """Arguments of `command` for its check value: the state is 1, 1/2, 1/3, ..."""
        grids = self.masses, self.speeds
        mass, speed = (float(g[0] + TEST_FRACTION * (g[-1] - g[0])) for g in grids)
        state = (1 / np.arange(1.0, len(self.columns) + 1)).tolist()
        load = {"mass": mass, "speed": speed}
        return {"state": state, "share": TEST_SHARE, "since_exit": 0.0} | load

    @property
    def test_command(self) -> np.ndarray:
        """Check value: commands for the test input."""
        return self.command(**self.test_input)

    @property
    def test_estimate(self) -> np.ndarray:
        """Check value: estimate for states, commands and readings of 1, 1/2, 1/3, ... each."""
        counts = self.estimator_size, len(self.commands), len(self.commands)
        return self.estimate(*(1 / np.arange(1.0, n + 1) for n in (*counts, self.reading_count)))

    @property
    def checksum(self) -> int:
        """CRC-32 of period, crossing time, decay time and all arrays, as little-endian doubles."""
        numbers = [self.period, self.crossing_time, self.decay_time]
        parts = [numbers, *(getattr(self, name) for name in ARRAYS)]
        return zlib.crc32(b"".join(np.ravel(part).astype("<f8").tobytes() for part in parts))


def _accumulate(total: np.ndarray, matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Sum of a total and a matrix times values, column by column; further columns are ignored."""
    for column, value in zip(matrix.T, values, strict=False):
        total = total + column * value
    return total


def _index_and_fraction(grid: np.ndarray, value: float) -> tuple[int, float]:
    """Index of the last point of a grid that is not above a value, and fraction to the next."""
    i = max(int(np.searchsorted(grid, value, "right")) - 1, 0)
    if i + 1 >= grid.size or value <= grid[i]:
        return i, 0.0
    return i, float((value - grid[i]) / (grid[i + 1] - grid[i]))
