"""Matching pursuit: loads that explain the readings of a log by static influence lines.

Loads are added, singly and in pairs, where they explain most of the residual, and all are then
refined together. The dynamic part of the response stays in the residual.
"""

from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.loads.mass import MovingMass
from jaxbeam.model.statics import influence_line
from tuning.logs.log import Log

POSITION_COUNT = 201  # points of an influence line
SPEED_COUNT = 16  # candidates in each direction
ENTRY_TIME_COUNT = 80  # candidates for each speed
MAX_SAMPLES = 300  # of a log; a longer one is thinned out


class MatchingPursuitResult(NamedTuple):
    """Loads, and the root mean square (m) of the residual."""

    loads: list[MovingMass]
    residual_rms: float


class MatchingPursuit:
    """Quasi-static readings of candidate loads on a beam, and those of a log.

    The mean is subtracted from all readings, and with it any offset. `readings_rms` (m) is the root
    mean square of the readings of the log.
    """

    def __init__(self, case: Case, log: Log, speeds: tuple[float, float], both_ways: bool):
        stride = max(log.times.size // MAX_SAMPLES, 1)
        chosen = [i for i, actuator in enumerate(log.actuators) if actuator is None]
        self.times = log.times[::stride]
        self.readings = _centred(log.values[::stride, chosen])
        self.readings_rms = float(np.sqrt(np.mean(self.readings**2)))
        self.length = float(concrete(case.beam.length))
        self.positions = np.linspace(0, self.length, POSITION_COUNT)
        sensors = np.array([float(concrete(sensor.position)) for sensor in case.sensors])
        weight = float(concrete(case.run.gravity))
        self.influence_lines = np.asarray(influence_line(case, sensors, self.positions)) * weight
        signs = (1.0, -1.0) if both_ways else (1.0,)
        tried = [sign * speed for sign in signs for speed in np.geomspace(*speeds, SPEED_COUNT)]
        self.candidates = [(s, entry) for s in tried for entry in self._entry_times(s)]
        self.candidate_readings = np.array(
            [self._unit_mass_readings(*each).ravel() for each in self.candidates]
        )
        self.candidate_norms = np.maximum(np.linalg.norm(self.candidate_readings, axis=1), 1e-300)

    def find(self, count: int) -> MatchingPursuitResult:
        """The `count` loads that together explain the readings best.

        Loads that are on the beam at once are hard to tell apart one by one, so the last two are
        also searched as a pair, among all pairs of candidates. Masses are positive, so that a fit
        can start from them.
        """
        load_parameters = self._find_loads(count)
        least = 1e-3 * max(np.max(load_parameters[:, 0]), 1e-12)
        loads = [
            MovingMass(mass=max(mass, least), speed=speed, entry_time=entry)
            for mass, speed, entry in load_parameters.tolist()
        ]
        return MatchingPursuitResult(loads, self._residual_rms(load_parameters))

    def _find_loads(self, count: int) -> Float[np.ndarray, "load 3"]:
        """Masses (kg), speeds (m/s) and entry times (s) of `count` loads."""
        if count == 0:
            return np.empty((0, 3))
        fewer = self._find_loads(count - 1)
        tried = [np.vstack([fewer, self._best_load(self._residual(fewer))])]
        if count > 1:
            fewer = self._find_loads(count - 2)
            tried.append(np.vstack([fewer, self._best_pair(self._residual(fewer))]))
        return min((self._refine(numbers) for numbers in tried), key=self._residual_rms)

    def _best_load(self, residual: Float[np.ndarray, "time sensor"]) -> Float[np.ndarray, "load 3"]:
        """The load that explains most of the residual."""
        gains = np.maximum(self.candidate_readings @ residual.ravel(), 0.0) / self.candidate_norms
        best = int(np.argmax(gains))
        return np.array([[gains[best] / self.candidate_norms[best], *self.candidates[best]]])

    def _best_pair(self, residual: Float[np.ndarray, "time sensor"]) -> Float[np.ndarray, "load 3"]:
        """The two loads that explain most of the residual, by least squares for all pairs."""
        columns = self.candidate_readings / self.candidate_norms[:, None]
        gains, overlap = columns @ residual.ravel(), columns @ columns.T
        determinant = np.maximum(1 - overlap**2, 1e-3)
        first = (gains[:, None] - overlap * gains[None, :]) / determinant
        both = (first > 0) & (first.T > 0)
        explained = np.where(both, first * gains[:, None] + first.T * gains[None, :], -np.inf)
        i, j = np.unravel_index(np.argmax(explained), explained.shape)
        masses = first[i, j] / self.candidate_norms[i], first[j, i] / self.candidate_norms[j]
        return np.array([[masses[0], *self.candidates[i]], [masses[1], *self.candidates[j]]])

    def _entry_times(self, speed: float) -> Float[np.ndarray, " entry"]:
        """Entry times (s) with which at least half of the crossing lies within the log."""
        half = self.length / abs(speed) / 2
        return np.linspace(self.times[0] - half, self.times[-1] - half, ENTRY_TIME_COUNT)

    def _unit_mass_readings(self, speed: float, entry: float) -> Float[np.ndarray, "time sensor"]:
        """Quasi-static readings (m) while one kilogram crosses."""
        start = 0.0 if speed > 0 else self.length
        position = start + speed * (self.times - entry)
        table = [
            np.interp(position, self.positions, line, 0.0, 0.0) for line in self.influence_lines.T
        ]
        return _centred(np.stack(table, axis=1))

    def _residual(
        self, load_parameters: Float[np.ndarray, "load 3"]
    ) -> Float[np.ndarray, "time sensor"]:
        """Readings that loads of these masses, speeds and entry times do not explain."""
        residual = self.readings
        for mass, speed, entry in load_parameters:
            residual = residual - mass * self._unit_mass_readings(speed, entry)
        return residual

    def _residual_rms(self, load_parameters: Float[np.ndarray, "load 3"]) -> float:
        return float(np.sqrt(np.mean(self._residual(load_parameters) ** 2)))

    def _refine(self, load_parameters: Float[np.ndarray, "load 3"]) -> Float[np.ndarray, "load 3"]:
        """All loads refined together by least squares."""
        least, most = load_parameters.copy(), load_parameters.copy()
        crossing_time = self.length / np.abs(load_parameters[:, 1])
        least[:, 0], most[:, 0] = 0.0, np.inf
        least[:, 1] = np.minimum(0.5 * load_parameters[:, 1], 2 * load_parameters[:, 1])
        most[:, 1] = np.maximum(0.5 * load_parameters[:, 1], 2 * load_parameters[:, 1])
        least[:, 2], most[:, 2] = (
            load_parameters[:, 2] - crossing_time,
            load_parameters[:, 2] + crossing_time,
        )
        found = scipy.optimize.least_squares(
            lambda x: self._residual(x.reshape(-1, 3)).ravel() / self.readings_rms,
            load_parameters.ravel(),
            bounds=(least.ravel(), most.ravel()),
            x_scale=np.maximum(np.abs(load_parameters), 1e-3).ravel(),
            diff_step=1e-4,
            max_nfev=60,
        )
        return found.x.reshape(-1, 3)


def _centred(table: Float[np.ndarray, "time sensor"]) -> Float[np.ndarray, "time sensor"]:
    return table - table.mean(axis=0)
