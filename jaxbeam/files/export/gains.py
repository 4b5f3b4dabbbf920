"""Gain tables as a controller runs them, and the numbers by which copies of them are checked."""

import dataclasses
import math
import zlib

import numpy as np
from numpy.typing import ArrayLike

ARRAYS = ("masses", "speeds", "shares", "table", "rest", "filters", "estimator")
TEST_SHARE = 0.37  # of the crossing
TEST_PLACE = 0.3  # of the way from the smallest to the largest mass, and speed


@dataclasses.dataclass(frozen=True, eq=False)
class Gains:
    """Gain tables as a controller runs them: u = -K(mass, speed, share) z.

    `table` (mass, speed, share, actuator, column) has K at the `masses` (kg), `speeds` (m/s) and
    `shares` of the crossing, from the entry of the first load to the exit of the last; `rest`
    (mass, speed, actuator, column) is from the exit on, and dies away with the time constant `fade`
    (s) if that is finite. K is linear between the shares, and `between` masses and speeds either
    "interpolated", too, or that of the "nearest"; beyond the grid it is held. A table for one load
    has one mass and one speed, zero, which nobody asks for; a constant gain has one share as well.

    `crossing` (s) is that of the load designed for, zero for a constant gain; a crossing of another
    length stretches the table. `columns` and `commands` are (name, unit). Rows of `filters` are the
    index of a sensor and its section b0, b1, b2, a0, a1, a2.

    The `estimator`, empty if there is none, is [[A, B, B', L], [C, 0, D, o]]: from tick to tick its
    states x become A x + B u + B' u', u being the commands that acted until the tick before and u'
    those until this, and then, with so many `readings` y, by L (y - C x - D u' - o) more (o is the
    first column of its block). The first of them are the first `columns`.
    """

    masses: np.ndarray
    speeds: np.ndarray
    shares: np.ndarray
    table: np.ndarray
    rest: np.ndarray
    filters: np.ndarray
    period: float
    crossing: float
    fade: float
    between: str
    columns: tuple[tuple[str, str], ...]
    commands: tuple[tuple[str, str], ...]
    estimator: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    readings: int = 0

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
        for i, mine in self._shares(self.masses, mass):
            for j, other in self._shares(self.speeds, speed):
                gain = gain + mine * other * self._member(i, j, share, since_exit)
        for column, value in zip(gain.T, np.asarray(state, float), strict=True):
            total = total - column * value
        return total

    @property
    def estimated(self) -> int:
        """How many states the estimator has."""
        return self.estimator.shape[0] - self.readings

    def estimate(
        self, state: ArrayLike, before: ArrayLike, now: ArrayLike, readings: ArrayLike
    ) -> np.ndarray:
        """The estimator's states at a tick, from those at the tick before; zero at the start.

        `before` are the commands that acted until the tick before, `now` those until this one. Sums
        are taken one by one, as the C header does.
        """
        size, inputs = self.estimated, len(self.commands)
        if not size:
            return np.zeros(0)
        given = np.concatenate([np.ravel(state), np.ravel(before), np.ravel(now)])
        prior = _summed(np.zeros(size), self.estimator[:size], given)
        expected, last = self.estimator[size:], size + 2 * inputs
        seen = np.concatenate([prior, np.zeros(inputs), np.ravel(now)])
        surprise = _summed(np.ravel(readings) - expected[:, last], -expected, seen)
        return _summed(prior, self.estimator[:size, last:], surprise)

    def _member(self, i: int, j: int, share: float, since_exit: float) -> np.ndarray:
        """The gain of one mass and speed of the grid."""
        if share >= 1 and self.shares.size > 1:
            left = math.exp(-since_exit / self.fade) if math.isfinite(self.fade) else 1.0
            return left * self.rest[i, j]
        k, part = _bracket(self.shares, share)
        low = self.table[i, j, k]
        return low + part * (self.table[i, j, min(k + 1, self.shares.size - 1)] - low)

    def _shares(self, grid: np.ndarray, value: float) -> list[tuple[int, float]]:
        """Designs of a grid that contribute at a value, and what each contributes."""
        if self.between == "nearest":
            return [(int(np.argmin(np.abs(grid - value))), 1.0)]
        i, part = _bracket(grid, value)
        return [(i, 1.0 - part), (min(i + 1, grid.size - 1), part)]

    @property
    def test_input(self) -> dict:
        """The input of the check: state 1, 1/2, 1/3, ..., and what else `command` takes."""
        grids = self.masses, self.speeds
        mass, speed = (float(g[0] + TEST_PLACE * (g[-1] - g[0])) for g in grids)
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
        counts = self.estimated, len(self.commands), len(self.commands)
        return self.estimate(*(1 / np.arange(1.0, n + 1) for n in (*counts, self.readings)))

    @property
    def checksum(self) -> int:
        """CRC-32 of period, crossing, fade and all arrays in turn, as little-endian doubles."""
        numbers = [self.period, self.crossing, self.fade]
        parts = [numbers, *(getattr(self, name) for name in ARRAYS)]
        return zlib.crc32(b"".join(np.ravel(part).astype("<f8").tobytes() for part in parts))


def _summed(total: np.ndarray, matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A sum and the products of a matrix, whose further columns do not count, one by one."""
    for column, value in zip(matrix.T, values, strict=False):
        total = total + column * value
    return total


def _bracket(grid: np.ndarray, value: float) -> tuple[int, float]:
    """The last point of a grid that is not above a value, and how far on to the next it is."""
    i = max(int(np.searchsorted(grid, value, "right")) - 1, 0)
    if i + 1 >= grid.size or value <= grid[i]:
        return i, 0.0
    return i, float((value - grid[i]) / (grid[i + 1] - grid[i]))
