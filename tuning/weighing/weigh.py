"""Weighing in motion: number, masses, speeds and entry times of loads, from readings alone.

Starts come from a matching pursuit: loads are added, singly and in pairs, where they explain most
of the residual as forces crossing the beam, and all are then refined together. The dynamic part of
the response stays in the residual, but for velocities and accelerations (see `influence_lines`).
Then all loads are fitted together with the full dynamics, and added until the residuals are white
noise or Schwarz's criterion (BIC) rises.

Moses' method: axle forces from influence lines, by linear least squares (Moses 1979).

With the positions x_a(t) of the axles and the influence lines I_s of the sensors,

    y_s(t) = sum_a P_a I_s(x_a(t)) + c_s,

with an offset c_s of each sensor. What the static forces P_a do not explain, such as the vibration
of bridge and vehicle, is residual.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete, refuses_traced
from jaxbeam.case.loads.base import AbstractLoad, MovingMass
from jaxbeam.runtime.printer import counted
from tuning.fit.dataset import WHITENESS_SIGNIFICANCE, sensor_readings
from tuning.fit.identify import identify
from tuning.fit.least_squares import t_quantile
from tuning.fit.model_validation import ModelCriteria, compare_fits
from tuning.fit.result import Fit
from tuning.logs.log import Log
from tuning.weighing.axle_fit import by_sensor, dynamic_errors, dynamic_waves, white_noise
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines, UnitForce

SPEED_COUNT = 16  # candidates in each direction,
VIBRATING_SPEED_COUNT = 64  # if a sensor measures vibration, whose phase depends on the speed
REFINED_COUNT = 4  # candidates of different speeds that are refined
ENTRY_TIME_COUNT = 80  # candidates for each speed at least,
ENTRIES_PER_PERIOD = 8  # and in a period of the first mode, if a sensor feels the vibration,
MAX_ENTRY_TIME_COUNT = 400  # and at most
MAX_PAIRED = 2000  # candidates that are tried in pairs
MAX_SAMPLES = 300  # of a log; a longer one is thinned out


class MatchingPursuitResult(NamedTuple):
    """Loads, and the root mean square of the residual, relative to that of the readings."""

    loads: list[MovingMass]
    residual_rms: float


class MatchingPursuit:
    """Readings of candidate loads on a beam, and those of a log.

    The mean is subtracted from all readings, and with it any offset; those of one quantity are
    divided by their root mean square.
    """

    def __init__(self, case: Case, log: Log, speeds: tuple[float, float], both_ways: bool):
        stride = max(log.times.size // MAX_SAMPLES, 1)
        self.times = log.times[::stride]
        self.unit_force = UnitForce(case, float(log.times[-1] - log.times[0]))
        self.length = self.unit_force.length
        readings = _centred(sensor_readings(case, log)[0][::stride])
        quantities = np.array([sensor.quantity for sensor in case.sensors])
        alike = quantities[:, None] == quantities[None, :]
        rms = np.sqrt(np.mean(readings**2, axis=0) @ alike / alike.sum(axis=0))
        self.scale = 1 / np.maximum(rms, 1e-300)
        self.readings = readings * self.scale
        self.weight = float(concrete(case.run.gravity))
        vibrates = bool(self.unit_force.vibrates.any())
        signs = (1.0, -1.0) if both_ways else (1.0,)
        count = VIBRATING_SPEED_COUNT if vibrates else SPEED_COUNT
        tried = [sign * speed for sign in signs for speed in np.geomspace(*speeds, count)]
        self.candidates = [(s, entry) for s in tried for entry in self._entry_times(s, vibrates)]
        self.candidate_readings = np.array(
            [self._unit_mass_readings(*each).ravel() for each in self.candidates]
        )
        self.candidate_norms = np.maximum(np.linalg.norm(self.candidate_readings, axis=1), 1e-300)

    def find(self, count: int) -> MatchingPursuitResult:
        """The `count` loads that together explain the readings best.

        Loads that are on the beam at once are hard to separate one by one, so the last two are also
        searched as a pair, among all pairs of candidates. Masses are positive, so that a fit can
        start from them.
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
        tried = [np.vstack([fewer, load]) for load in self._best_loads(self._residual(fewer))]
        if count > 1:
            fewer = self._find_loads(count - 2)
            tried.append(np.vstack([fewer, self._best_pair(self._residual(fewer))]))
        return min((self._refine(numbers) for numbers in tried), key=self._residual_rms)

    def _best_loads(
        self, residual: Float[np.ndarray, "time sensor"]
    ) -> list[Float[np.ndarray, "load 3"]]:
        """The loads of different speeds that explain most of the residual, each alone."""
        gains = np.maximum(self.candidate_readings @ residual.ravel(), 0.0) / self.candidate_norms
        found: dict[float, int] = {}
        for i in np.argsort(-gains, kind="stable").tolist():
            found.setdefault(self.candidates[i][0], i)
            if len(found) == REFINED_COUNT:
                break
        return [
            np.array([[gains[i] / self.candidate_norms[i], *self.candidates[i]]])
            for i in found.values()
        ]

    def _best_pair(self, residual: Float[np.ndarray, "time sensor"]) -> Float[np.ndarray, "load 3"]:
        """The two loads that explain most of the residual, by least squares for all pairs.

        Of many candidates only those are paired that explain most of the residual alone.
        """
        gains = self.candidate_readings @ residual.ravel() / self.candidate_norms
        chosen = np.sort(np.argsort(-gains, kind="stable")[:MAX_PAIRED])
        gains, norms = gains[chosen], self.candidate_norms[chosen]
        columns = self.candidate_readings[chosen] / norms[:, None]
        overlap = columns @ columns.T
        determinant = np.maximum(1 - overlap**2, 1e-3)
        first = (gains[:, None] - overlap * gains[None, :]) / determinant
        both = (first > 0) & (first.T > 0)
        explained = np.where(both, first * gains[:, None] + first.T * gains[None, :], -np.inf)
        i, j = np.unravel_index(np.argmax(explained), explained.shape)
        pair = (first[i, j] / norms[i], i), (first[j, i] / norms[j], j)
        return np.array([[mass, *self.candidates[chosen[n]]] for mass, n in pair])

    def _entry_times(self, speed: float, vibrates: bool) -> Float[np.ndarray, " entry"]:
        """Entry times (s) with which at least half of the crossing lies within the log."""
        half, count = self.length / abs(speed) / 2, ENTRY_TIME_COUNT
        if vibrates:
            period = 1 / self.unit_force.frequencies.min()
            needed = int(ENTRIES_PER_PERIOD * (self.times[-1] - self.times[0]) / period)
            count = min(max(count, needed), MAX_ENTRY_TIME_COUNT)
        return np.linspace(self.times[0] - half, self.times[-1] - half, count)

    def _unit_mass_readings(self, speed: float, entry: float) -> Float[np.ndarray, "time sensor"]:
        """Readings while the weight of one kilogram crosses."""
        readings = self.unit_force.readings(float(speed), self.times - entry)
        return _centred(self.weight * readings) * self.scale

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
            lambda x: self._residual(x.reshape(-1, 3)).ravel(),
            load_parameters.ravel(),
            bounds=(least.ravel(), most.ravel()),
            x_scale=np.maximum(np.abs(load_parameters), 1e-3).ravel(),
            diff_step=1e-4,
            max_nfev=60,
        )
        return found.x.reshape(-1, 3)


def _centred(table: Float[np.ndarray, "time sensor"]) -> Float[np.ndarray, "time sensor"]:
    return table - table.mean(axis=0)


@dataclasses.dataclass(frozen=True, eq=False)
class MosesFit:
    """Axle forces (N) with their covariance, at a geometry; residuals by sensor.

    The covariance is that of `dynamic_errors`: residuals are attributed to dynamic wheel forces,
    `dynamic_share` of the static ones (standard deviation).
    """

    geometry: AxleGeometry
    forces: Float[np.ndarray, " axle"]
    covariance: Float[np.ndarray, "axle axle"]
    residuals: Float[np.ndarray, "time sensor"]
    dynamic_share: float
    degrees_of_freedom: float

    @property
    def errors(self) -> Float[np.ndarray, " axle"]:
        """Standard errors of the axle forces (N)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def gross_weight(self) -> tuple[float, float]:
        """Sum of the axle forces and its standard error (N)."""
        return float(self.forces.sum()), float(np.sqrt(self.covariance.sum()))

    @property
    def intervals(self) -> Float[np.ndarray, "axle 2"]:
        """95 % intervals of the axle forces (N)."""
        half = t_quantile(self.degrees_of_freedom) * self.errors
        return np.stack([self.forces - half, self.forces + half], axis=1)


def moses(
    lines: InfluenceLines,
    geometry: AxleGeometry,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    valid: np.ndarray | None = None,
    found: bool = False,
) -> MosesFit:
    """Axle forces by Moses' method from the readings (SI units) of a crossing.

    The geometry is exact, or was `found` in the same readings, so that its errors add to those of
    the forces. Raises ValueError if the axles are on the beam at too few samples.
    """
    valid = np.ones(readings.shape, bool) if valid is None else valid
    columns = lines.at(geometry.positions(times))  # (time, axle, sensor)
    axles, sensors = columns.shape[1:]
    if valid.sum() < axles + sensors + 2:
        raise ValueError(f"{axles} axles need more samples than {int(valid.sum())}")
    shifts = np.broadcast_to(np.eye(sensors), (times.size, sensors, sensors))
    spread = np.where(valid, readings, np.nan)
    noise = np.maximum(np.nanstd(spread, axis=0), 1e-300)
    for _ in range(2):
        weights = valid / noise
        rows = by_sensor(np.concatenate([columns, shifts], axis=1), weights)
        sizes = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        target = (readings * weights).T.ravel()
        solution = np.linalg.lstsq(rows / sizes, target, rcond=None)[0] / sizes
        fitted = np.einsum("tas,a->ts", columns, solution[:axles]) + solution[axles:]
        residuals = readings - fitted
        share = 1 - (axles + sensors) / valid.sum()
        squares = np.sum(valid * residuals**2, axis=0) / np.maximum(valid.sum(axis=0), 1) / share
        noise = np.sqrt(np.maximum(squares, 1e-18 * noise**2))
    waves = dynamic_waves(lines, geometry, solution[:axles], times)
    parts = [columns]
    if found:
        parts.append(_geometry_slopes(lines, geometry, times, solution[:axles]))
    jacobian = np.concatenate([*parts, shifts], axis=1)
    errors = dynamic_errors(jacobian, waves, residuals, white_noise(readings, valid), weights)
    covariance = errors.covariance[:axles, :axles]
    share, freedom = errors.share, errors.degrees_of_freedom
    return MosesFit(geometry, solution[:axles], covariance, residuals, share, freedom)


def _geometry_slopes(lines, geometry: AxleGeometry, times, forces):
    """Derivatives (time, number, sensor) by speed, entry time and distances, as differences."""
    slopes = []
    numbers = np.array([geometry.speed, geometry.entry_time, *geometry.offsets[1:]])
    for i in range(numbers.size):
        step = 1e-3 * (geometry.length / abs(geometry.speed) if i == 1 else max(abs(numbers[i]), 1))
        readings = []
        for sign in (1, -1):
            moved = numbers + sign * step * (np.arange(numbers.size) == i)
            offsets = np.append(0.0, moved[2:])
            at = AxleGeometry(moved[0], moved[1], offsets, geometry.length)
            readings.append(np.einsum("tas,a->ts", lines.at(at.positions(times)), forces))
        slopes.append((readings[0] - readings[1]) / (2 * step))
    return np.stack(slopes, axis=1)


_LOAD_PARAMETERS = ("mass", "speed", "entry_time")
# Loads are added before the first fit as long as each reduces the residual to this ratio or less.
_MAX_MISFIT_RATIO = 0.7
# Residual over readings (RMS) above which no load is found.
_MAX_RELATIVE_RESIDUAL = 0.65


@dataclasses.dataclass(frozen=True, eq=False)
class Weighing:
    """Loads found in a log: the best fit, and criteria of all load counts tried, best first.

    `load_counts` is empty where the first count tried left white noise.
    """

    fit: Fit
    load_counts: list[ModelCriteria]

    @property
    def case(self) -> Case:
        """The case with the loads found."""
        return self.fit.case

    @property
    def loads(self) -> tuple[AbstractLoad, ...]:
        """The fitted loads, in the order in which they were found."""
        return self.fit.cases[0].loads

    def to_dict(self) -> dict:
        """Loads with standard errors and intervals (SI units), counts and verdict, for JSON."""
        parameters = self.fit.to_dict()["numbers"]
        loads = [
            {name: parameters[f"loads.{i}.{name}"] for name in _LOAD_PARAMETERS}
            for i in range(len(self.loads))
        ]
        counts = {count.name: count.bic for count in self.load_counts}
        return {"loads": loads, "bic": counts, "verdict": self.fit.verdict}

    def __str__(self) -> str:
        lines = [f"{counted(len(self.loads), 'load')} found"]
        lines += [f"BIC with {count.name}: {count.bic:.1f}" for count in self.load_counts]
        return "\n".join([*lines, str(self.fit)])


@refuses_traced("a weighing")
def weigh(
    case: Case, log: Log, speeds: tuple[float, float], max_count: int = 3, both_ways: bool = True
) -> Weighing:
    """Masses, speeds and entry times of the loads that crossed a known beam in a log.

    Sensors may measure any quantity of the beam: deflection, strain, acceleration, and so on.
    `speeds` (m/s) are the lowest and highest possible ones, in both directions or, without
    `both_ways`, from the left only; at most `max_count` loads are found. Offsets of the sensors are
    fitted as well. Loads of the case or the log are not used.

    Raises ValueError if there is no sensor, speeds are not 0 < low < high, or no load is found in
    the log, and as `identify` does.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(0.6, 12.0, 0.5, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(0.3, noise=1e-5)],
    ...     loads=[jb.MovingForce(force=4.0, speed=2.0)],
    ...     run=jb.Run(0.4, sample_rate=50.0),
    ... )
    >>> record = jb.simulate(case)
    >>> columns = ("w",), ("deflection",), ("m",), "log", (0,)
    >>> log = tuning.Log(record.times, record.measured, *columns)
    >>> found = tuning.weigh(case, log, (1.0, 3.0), max_count=1, both_ways=False)
    >>> print(f"{found.loads[0].mass:.1f} kg at {found.loads[0].speed:.1f} m/s")
    0.4 kg at 2.0 m/s
    """
    low, high = speeds
    if not 0 < low < high:
        raise ValueError(f"speeds must be 0 < low < high in m/s; they are {low:g} and {high:g}")
    if not case.sensors:
        raise ValueError("weighing needs a sensor on the beam; the case has none")
    case = dataclasses.replace(case, vehicle_sensors=())
    pursuit = MatchingPursuit(case, log, (low, high), both_ways)
    first = pursuit.find(1)
    if first.residual_rms > _MAX_RELATIVE_RESIDUAL:
        raise ValueError(f"{log.source}: no load is found in it at these speeds")
    found = first
    while len(found.loads) < max_count and (
        more := pursuit.find(len(found.loads) + 1)
    ).residual_rms < (_MAX_MISFIT_RATIO * found.residual_rms):
        found = more
    fits: dict[str, Fit] = {}
    while True:
        count = len(found.loads)
        fit = fits[counted(count, "load")] = _fit_loads(case, log, found.loads)
        if (
            min(channel.p_value for channel in fit.channel_residuals) > WHITENESS_SIGNIFICANCE
            or count >= max_count
        ):
            break
        if len(fits) > 1 and compare_fits(fits)[0].name != counted(count, "load"):
            break
        found = pursuit.find(count + 1)
    criteria = compare_fits(fits) if len(fits) > 1 else []
    return Weighing(fits[criteria[0].name] if criteria else fit, criteria)


def _fit_loads(case: Case, log: Log, loads: list[MovingMass]) -> Fit:
    """Fit of all loads together, and of the offsets of the sensors."""
    length, end = float(concrete(case.beam.length)), float(log.times[-1])
    free: dict[str, tuple[float, float] | None] = {}
    for i, load in enumerate(loads):
        speed = float(concrete(load.speed))
        low, high = sorted([0.3 * speed, 3 * speed])
        free[f"loads.{i}.mass"] = None
        free[f"loads.{i}.speed"] = low, high
        free[f"loads.{i}.entry_time"] = (-length / abs(speed), end)
    free |= {f"sensors.{i}.offset": None for i in range(len(case.sensors))}
    return identify(case, dataclasses.replace(log, loads=tuple(loads)), free)
