"""Where loads may have crossed: a quick look at a log with static influence lines only.

Loads are added, singly and in pairs, where they explain most of what is left (matching pursuit),
and all of them are moved together after that. What the beam's inertia does is left over.
"""

from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import known
from jaxbeam.case.loads import MovingMass
from jaxbeam.model.statics import influence_line
from tuning.logs.log import Log

PLACES = 201  # along the beam, at which influence lines are tabulated
SPEEDS = 16  # tried in each direction
ENTRIES = 80  # tried for each speed
SAMPLES = 300  # of a log, at most, that are looked at


class Found(NamedTuple):
    """Loads, and the root mean square (m) of what they leave."""

    loads: list[MovingMass]
    left: float


class Pursuit:
    """Readings of slow loads on a beam, to be held against those of a log.

    Constant parts of the readings, such as offsets, are left out on both sides. `deviation` (m) is
    the root mean square of the readings themselves.
    """

    def __init__(self, case: Case, log: Log, speeds: tuple[float, float], both_ways: bool):
        stride = max(log.times.size // SAMPLES, 1)
        chosen = [i for i, actuator in enumerate(log.actuators) if actuator is None]
        self.times = log.times[::stride]
        self.target = _centred(log.values[::stride, chosen])
        self.deviation = float(np.sqrt(np.mean(self.target**2)))
        self.length = float(known(case.beam.length))
        self.places = np.linspace(0, self.length, PLACES)
        sensors = np.array([float(known(sensor.position)) for sensor in case.sensors])
        weight = float(known(case.run.gravity))
        self.lines = np.asarray(influence_line(case, sensors, self.places)) * weight
        signs = (1.0, -1.0) if both_ways else (1.0,)
        tried = [sign * speed for sign in signs for speed in np.geomspace(*speeds, SPEEDS)]
        self.candidates = [(s, entry) for s in tried for entry in self._entries(s)]
        self.columns = np.array([self._reading(*each).ravel() for each in self.candidates])
        self.sizes = np.maximum(np.linalg.norm(self.columns, axis=1), 1e-300)

    def find(self, count: int) -> Found:
        """So many loads that together explain the readings as well as slow loads can.

        Loads that are on the beam together are hard to tell apart one by one, so the last two are
        also looked for as a pair, among all pairs that are tried. Masses are a little above zero,
        so that a fit may start there.
        """
        numbers = self._search(count)
        least = 1e-3 * max(np.max(numbers[:, 0]), 1e-12)
        loads = [
            MovingMass(mass=max(mass, least), speed=speed, entry_time=entry)
            for mass, speed, entry in numbers.tolist()
        ]
        return Found(loads, self._misfit(numbers))

    def _search(self, count: int) -> Float[np.ndarray, "load 3"]:
        """Masses, speeds and entry times of so many loads."""
        if count == 0:
            return np.empty((0, 3))
        fewer = self._search(count - 1)
        tried = [np.vstack([fewer, self._single(self._left(fewer))])]
        if count > 1:
            fewer = self._search(count - 2)
            tried.append(np.vstack([fewer, self._pair(self._left(fewer))]))
        return min((self._refined(numbers) for numbers in tried), key=self._misfit)

    def _single(self, left: Float[np.ndarray, "time sensor"]) -> Float[np.ndarray, "load 3"]:
        """The load that explains most of what is left."""
        gains = np.maximum(self.columns @ left.ravel(), 0.0) / self.sizes
        best = int(np.argmax(gains))
        return np.array([[gains[best] / self.sizes[best], *self.candidates[best]]])

    def _pair(self, left: Float[np.ndarray, "time sensor"]) -> Float[np.ndarray, "load 3"]:
        """The two loads that explain most of what is left: least squares for all pairs at once."""
        columns = self.columns / self.sizes[:, None]
        gains, overlap = columns @ left.ravel(), columns @ columns.T
        lone = np.maximum(1 - overlap**2, 1e-3)
        first = (gains[:, None] - overlap * gains[None, :]) / lone
        both = (first > 0) & (first.T > 0)
        explained = np.where(both, first * gains[:, None] + first.T * gains[None, :], -np.inf)
        i, j = np.unravel_index(np.argmax(explained), explained.shape)
        masses = first[i, j] / self.sizes[i], first[j, i] / self.sizes[j]
        return np.array([[masses[0], *self.candidates[i]], [masses[1], *self.candidates[j]]])

    def _entries(self, speed: float) -> Float[np.ndarray, " entry"]:
        """Times of entry with which most of the crossing lies within the log."""
        half = self.length / abs(speed) / 2
        return np.linspace(self.times[0] - half, self.times[-1] - half, ENTRIES)

    def _reading(self, speed: float, entry: float) -> Float[np.ndarray, "time sensor"]:
        """What the sensors read while one kilogram crosses slowly."""
        start = 0.0 if speed > 0 else self.length
        place = start + speed * (self.times - entry)
        table = [np.interp(place, self.places, line, 0.0, 0.0) for line in self.lines.T]
        return _centred(np.stack(table, axis=1))

    def _left(self, numbers: Float[np.ndarray, "load 3"]) -> Float[np.ndarray, "time sensor"]:
        """What loads of these masses, speeds and entry times leave unexplained."""
        left = self.target
        for mass, speed, entry in numbers:
            left = left - mass * self._reading(speed, entry)
        return left

    def _misfit(self, numbers: Float[np.ndarray, "load 3"]) -> float:
        return float(np.sqrt(np.mean(self._left(numbers) ** 2)))

    def _refined(self, numbers: Float[np.ndarray, "load 3"]) -> Float[np.ndarray, "load 3"]:
        """The loads moved together to where they explain most."""
        least, most = numbers.copy(), numbers.copy()
        taken = self.length / np.abs(numbers[:, 1])
        least[:, 0], most[:, 0] = 0.0, np.inf
        least[:, 1] = np.minimum(0.5 * numbers[:, 1], 2 * numbers[:, 1])
        most[:, 1] = np.maximum(0.5 * numbers[:, 1], 2 * numbers[:, 1])
        least[:, 2], most[:, 2] = numbers[:, 2] - taken, numbers[:, 2] + taken
        found = scipy.optimize.least_squares(
            lambda x: self._left(x.reshape(-1, 3)).ravel() / self.deviation,
            numbers.ravel(),
            bounds=(least.ravel(), most.ravel()),
            x_scale=np.maximum(np.abs(numbers), 1e-3).ravel(),
            diff_step=1e-4,
            max_nfev=60,
        )
        return found.x.reshape(-1, 3)


def _centred(table: Float[np.ndarray, "time sensor"]) -> Float[np.ndarray, "time sensor"]:
    return table - table.mean(axis=0)
