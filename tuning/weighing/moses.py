"""Moses' method: axle forces from influence lines, by linear least squares (Moses 1979).

With the positions x_a(t) of the axles and the influence lines I_s of the sensors,

    y_s(t) = sum_a P_a I_s(x_a(t)) + c_s,

with an offset c_s of each sensor. What the static forces P_a do not explain, such as the vibration
of bridge and vehicle, is residual.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import scipy.optimize
from jaxtyping import Float

from tuning.fit.uncertainty.covariance import t_quantile
from tuning.weighing.dynamic_forces import dynamic_errors, dynamic_readings, white_noise
from tuning.weighing.influence_lines import InfluenceLines

SPEED_COUNT = 24  # candidates
ENTRY_COUNT = 160  # candidates of each speed
REFINED_COUNT = 3  # speeds from which the geometry is refined
MAX_ROWS = 600  # samples of all sensors, for the search


@dataclasses.dataclass(frozen=True)
class AxleGeometry:
    """Speed (m/s), time (s) at which the first axle enters, distances (m) of the axles behind it.

    At a negative speed the axles enter at the right end of the beam of a length (m).
    """

    speed: float
    entry_time: float
    offsets: Float[np.ndarray, " axle"]
    length: float

    def positions(self, times: Float[np.ndarray, " time"]) -> Float[np.ndarray, "time axle"]:
        """Positions (m) of the axles at times (s)."""
        travelled = abs(self.speed) * (times[:, None] - self.entry_time) - self.offsets
        return travelled if self.speed > 0 else self.length - travelled


@dataclasses.dataclass(frozen=True, eq=False)
class MosesFit:
    """Axle forces (N) with their covariance, at a geometry; residuals by sensor.

    The covariance is that of `dynamic_forces`, for which the residuals are due to dynamic wheel
    forces, `dynamic_share` of the static ones (standard deviation).
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

    The geometry is known, or was `found` in the same readings: its errors then are part of those of
    the forces. Raises ValueError if the axles are on the beam at too few samples.
    """
    valid = np.ones(readings.shape, bool) if valid is None else valid
    columns = lines.at(geometry.positions(times))  # (time, axle, sensor)
    axles, sensors = columns.shape[1:]
    if valid.sum() < axles + sensors + 2:
        raise ValueError(f"{axles} axles need more samples than {int(valid.sum())}")
    spread = np.where(valid, readings, np.nan)
    noise = np.maximum(np.nanstd(spread, axis=0), 1e-300)
    for _ in range(2):
        weights = valid / noise
        rows = _with_offsets(columns, weights)
        sizes = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
        target = (readings * weights).T.ravel()
        solution = np.linalg.lstsq(rows / sizes, target, rcond=None)[0] / sizes
        fitted = np.einsum("tas,a->ts", columns, solution[:axles]) + solution[axles:]
        residuals = readings - fitted
        share = 1 - (axles + sensors) / valid.sum()
        squares = np.sum(valid * residuals**2, axis=0) / np.maximum(valid.sum(axis=0), 1) / share
        noise = np.sqrt(np.maximum(squares, 1e-18 * noise**2))
    waves = dynamic_readings(columns, solution[:axles], times)
    parts = [columns]
    if found:
        parts.append(_geometry_slopes(lines, geometry, times, solution[:axles]))
    shifts = np.broadcast_to(np.eye(sensors), (times.size, sensors, sensors))
    jacobian = np.concatenate([*parts, shifts], axis=1)
    errors = dynamic_errors(jacobian, waves, residuals, white_noise(readings, valid), weights)
    covariance = errors.covariance[:axles, :axles]
    share, freedom = errors.share, errors.degrees_of_freedom
    return MosesFit(geometry, solution[:axles], covariance, residuals, share, freedom)


def _geometry_slopes(lines, geometry: AxleGeometry, times, forces):
    """Derivatives (time, number, sensor) by speed, entry time and distances, by differences."""
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


def _with_offsets(columns, weights):
    """Rows (sensor by sensor) of the linear problem: axles, then the offsets of the sensors."""
    axles, sensors = columns.shape[1:]
    blocks = []
    for s in range(sensors):
        offsets = np.zeros((columns.shape[0], sensors))
        offsets[:, s] = 1.0
        blocks.append(np.hstack([columns[:, :, s], offsets]) * weights[:, s, None])
    return np.vstack(blocks)


def find_geometry(
    lines: InfluenceLines,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    speeds: tuple[float, float],
    axles: int,
    both_ways: bool = False,
) -> AxleGeometry:
    """Speed, entry time and distances of axles that explain readings best by static forces."""
    length = float(lines.positions[-1])

    def by_lines(geometry, times):
        return lines.at(geometry.positions(times))

    return search_geometry(by_lines, length, times, readings, speeds, axles, both_ways)[0]


def search_geometry(
    unit_readings: Callable[[AxleGeometry, np.ndarray], Float[np.ndarray, "time axle sensor"]],
    length: float,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    speeds: tuple[float, float],
    axles: int,
    both_ways: bool = False,
    more_starts: Sequence[AxleGeometry] = (),
) -> tuple[AxleGeometry, float, Float[np.ndarray, " axle"]]:
    """Speed, entry time and distances of axles on a beam of a length (m), from `unit_readings`.

    These are the readings of a force of one newton at each axle. For each of many speeds (m/s,
    between two) the readings are explained by non-negative forces that enter at many times; those
    of the best speeds, gathered to the number of axles, and `more_starts` are the starts of a
    search by least squares in speed, entry time and distances, with the forces of each point by
    Moses' method (variable projection). Also the mean square of what remains, relative to the
    variance of each sensor, and the forces (N).
    """
    stride = max(times.size * readings.shape[1] // MAX_ROWS, 1)
    times, readings = times[::stride], readings[::stride]
    scale = np.maximum(readings.std(axis=0), 1e-300)
    target = ((readings - readings.mean(axis=0)) / scale).T.ravel()

    def columns(geometry):
        table = unit_readings(geometry, times) / scale
        return (table - table.mean(axis=0)).transpose(2, 0, 1).reshape(target.size, -1)

    starts = []
    for speed in np.geomspace(*speeds, SPEED_COUNT):
        for sign in (1.0, -1.0) if both_ways else (1.0,):
            half = length / speed / 2
            entries = np.linspace(times[0] - half, times[-1] - half, ENTRY_COUNT)
            comb = AxleGeometry(sign * speed, 0.0, speed * entries, length)
            weights, misfit = scipy.optimize.nnls(columns(comb), target)
            offsets = _gathered(speed * entries, weights, axles)
            entry = float(offsets[0] / speed)
            starts.append((misfit, AxleGeometry(sign * speed, entry, offsets - offsets[0], length)))
    starts.sort(key=lambda start: start[0])

    def geometry_at(x, sign):
        gaps = np.exp(x[2:])
        return AxleGeometry(sign * np.exp(x[0]), x[1], np.append(0.0, np.cumsum(gaps)), length)

    best = None
    for start in [*(start for _, start in starts[:REFINED_COUNT]), *more_starts]:
        sign = np.sign(start.speed)

        def residual(x, sign=sign):
            table = columns(geometry_at(x, sign))
            forces = scipy.optimize.nnls(table, target)[0]
            return table @ forces - target

        first = [np.log(abs(start.speed)), start.entry_time, *np.log(np.diff(start.offsets))]
        low, high = np.log(np.array(speeds) * [0.9, 1.1])
        least = np.array([low, -np.inf, *np.full(axles - 1, np.log(0.3))])
        most = np.array([high, np.inf, *np.full(axles - 1, np.log(10 * length))])
        found = scipy.optimize.least_squares(
            residual, np.clip(first, least + 1e-9, most - 1e-9), bounds=(least, most),
            x_scale=np.array([0.1, 0.1 * length / abs(start.speed), *np.full(axles - 1, 0.3)]),
            diff_step=1e-5, max_nfev=60,
        )  # fmt: skip
        if best is None or found.cost < best[0]:
            best = found.cost, geometry_at(found.x, sign)
    assert best is not None
    forces = scipy.optimize.nnls(columns(best[1]), target)[0]
    return best[1], float(2 * best[0] / target.size), forces


def _gathered(places, weights, axles) -> Float[np.ndarray, " axle"]:
    """Places (m) of the heaviest groups of neighbouring forces, as many as axles, ascending."""
    used = np.flatnonzero(weights > 1e-6 * weights.max(initial=0.0))
    spacing = places[1] - places[0]
    if not used.size:
        return places[0] + spacing * np.arange(axles)
    groups = np.split(used, np.flatnonzero(np.diff(used) > 2) + 1)
    heavy = sorted(groups, key=lambda group: -weights[group].sum())[:axles]
    found = [float(np.average(places[group], weights=weights[group])) for group in heavy]
    while len(found) < axles:  # two axles in one group
        found += [found[0] + spacing * (1 + len(found) - len(heavy))]
    found = np.sort(found)
    return found[0] + np.maximum.accumulate(
        np.append(0.0, np.cumsum(np.maximum(np.diff(found), 0.5 * spacing)))
    )
