"""Axle forces, distances and speed by generalised least squares.

With the readings u_s (`InfluenceLines.crossing`) of a force of one newton on axle a, the readings
of a crossing are

    y_s(t) = sum_a P_a u_s(t; v, t_0, x_a) + c_s + e_s(t),   cov e = S + d^2 B B' + E E'.

S is the covariance of the white noise of the sensors; the columns of B are readings of dynamic
wheel forces (see below), d is their fraction of the static forces, and the columns of E are
readings of the axle forces on the deviations of calibrated influence lines. The fraction d
maximises the restricted likelihood (Patterson and Thompson 1971, DOI 10.1093/biomet/58.3.545). The
covariance of all parameters is that of the weighted problem, times the excess of the residuals.

A prior helps where readings contain little information: axles of a group have similar loads and are
about 1.35 m apart.

Errors of weighing by the dynamic wheel forces of an unknown road.

Each axle force varies about its static value P_a as a random process of standard deviation d P_a,
with the spectrum S of quarter cars on a rough road, which has peaks at body bounce and axle hop. It
changes the readings by d B w, where the columns of B are readings of P_a sqrt(S df) cos(2 pi f t)
and sin(2 pi f t) on the influence lines, with the vibration of the bridge, and w is white. With
noise of standard deviation s, the readings have the covariance C = s^2 + d^2 B B', and parameters
fitted by least squares with the Jacobian J have

    (J'J)^-1 J' C J (J'J)^-1.

The fraction d follows from the residuals r = (1 - H) e, H = J (J'J)^-1 J': their power is that of
the noise, and d^2 |(1 - H) B|^2.
"""

import copy
import dataclasses
import functools
import itertools
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Bool, Float

from tuning.fit.least_squares import t_quantile
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines

# Hz, of bodies on air or leaf springs, which bounce and pitch, and of axles of lorries (OECD 1998).
BODIES, HOPS = (1.3, 1.6, 2.0, 2.5, 3.0), (9.0, 11.0, 13.5)
# Mass of the axle over that of the body on it; damping ratio of the body, loss factor of tyres.
UNSPRUNG, DAMPING, LOSS = 0.12, 0.16, 0.1
LOWEST, HIGHEST, SPACING = 0.6, 20.1, 0.3  # Hz, of the waves
DYNAMIC_LIMITS = 1e-4, 0.5  # of d, dynamic over static wheel forces; worst roads have 0.3


@functools.cache
def _total_power() -> float:
    return float(np.sum(_power(np.arange(LOWEST, HIGHEST, SPACING))) * SPACING)


def _power(f: Float[np.ndarray, " wave"]) -> Float[np.ndarray, " wave"]:
    """Spectrum of dynamic wheel forces at frequencies (Hz), up to a factor.

    It is that of quarter cars on a road of heights ~ 1 / frequency (ISO 8608), in the mean of usual
    bodies and axles, each with forces of one variance.
    """
    power = np.zeros(f.size)
    for body, hop in itertools.product(BODIES, HOPS):
        stiffness = UNSPRUNG * hop**2  # of tyres, over mass of the body
        spring = body**2 * stiffness / (stiffness - body**2)
        link, tyre = spring + 2j * DAMPING * np.sqrt(spring) * f, stiffness * (1 + 1j * LOSS)
        moving = (link - f**2) * (link + tyre - UNSPRUNG * f**2) - link**2
        own = np.abs(tyre * (1 - tyre * (link - f**2) / moving) / f) ** 2
        power += own / own.sum()
    return power


class DynamicErrors(NamedTuple):
    """Covariance of fitted parameters, and d, the ratio of dynamic to static wheel forces."""

    covariance: Float[np.ndarray, "parameter parameter"]
    share: float
    degrees_of_freedom: float

    @property
    def errors(self) -> Float[np.ndarray, " parameter"]:
        """Standard errors of the parameters."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def half_widths(self) -> Float[np.ndarray, " parameter"]:
        """Half widths of the 95 % intervals."""
        return t_quantile(self.degrees_of_freedom) * self.errors


def dynamic_waves(
    lines: InfluenceLines,
    geometry: AxleGeometry,
    forces: Float[np.ndarray, " axle"],
    times: Float[np.ndarray, " time"],
) -> Float[np.ndarray, "time wave sensor"]:
    """Readings B of dynamic axle forces as waves in time, with the vibration that they excite.

    The phase of a wave is zero at the entry of the first axle.
    """
    rate = (times.size - 1) / (times[-1] - times[0])
    frequencies = np.arange(LOWEST, min(HIGHEST, max(0.4 * rate, 2 * LOWEST)), SPACING)
    angle = 2 * np.pi * frequencies * (times[:, None] - geometry.entry_time)
    sizes = np.sqrt(_power(frequencies) * SPACING / _total_power())
    waves = np.concatenate([sizes * np.cos(angle), sizes * np.sin(angle)], axis=1)
    table = lines.modulated(geometry, times, waves) * forces[:, None, None]
    return table.reshape(times.size, -1, table.shape[3])


def by_sensor(
    table: Float[np.ndarray, "time column sensor"], weights: Float[np.ndarray, "time sensor"]
) -> Float[np.ndarray, "row column"]:
    """Weighted rows of a linear problem, sensor by sensor."""
    return np.concatenate([table[:, :, s] * weights[:, s, None] for s in range(weights.shape[1])])


def dynamic_errors(
    jacobian: Float[np.ndarray, "time parameter sensor"],
    waves: Float[np.ndarray, "time wave sensor"],
    residuals: Float[np.ndarray, "time sensor"],
    noise: Float[np.ndarray, " sensor"],
    weights: Float[np.ndarray, "time sensor"],
) -> DynamicErrors:
    """Errors of parameters that were fitted by least squares with `weights` of the readings.

    `noise` is the standard deviation of white noise of each sensor; weights are zero for samples
    that do not count. The error of a parameter on which no reading depends is infinite.
    """
    J, B = by_sensor(jacobian, weights), by_sensor(waves, weights)
    r = (residuals * weights).T.ravel()
    white = (weights * noise).T.ravel()
    sizes = np.linalg.norm(J, axis=0)
    unseen = sizes == 0
    sizes = np.where(unseen, 1.0, sizes)
    basis, triangle = np.linalg.qr(J / sizes)
    inside, outside = basis.T @ B, B - basis @ (basis.T @ B)
    squares = outside @ outside.T
    power = float(np.trace(squares))
    noise_power = np.sum(white**2) - np.sum((basis * white[:, None]) ** 2)
    excess = max(float(r @ r - noise_power), 0.0) / max(power, 1e-300)
    of_noise = (basis * white[:, None] ** 2).T @ basis
    middle = of_noise + excess * inside @ inside.T
    inverse = np.linalg.pinv(triangle)
    covariance = inverse @ middle @ inverse.T / np.outer(sizes, sizes)
    covariance[np.diag(unseen)] = np.inf
    freedom = power**2 / max(float(np.sum(squares**2)), 1e-300)
    samples = float(np.sum(weights > 0)) - J.shape[1]
    dominated = excess * power > noise_power
    return DynamicErrors(
        covariance, float(np.sqrt(excess)), max(freedom if dominated else samples, 1.0)
    )


LEAST_NOISE = 1e-4  # of the deviation of readings, whose resolution is no better


def white_noise(
    readings: Float[np.ndarray, "time sensor"], valid: np.ndarray
) -> Float[np.ndarray, " sensor"]:
    """Standard deviation of white noise by sensor, from second differences of the readings."""
    second = np.abs(np.diff(readings, 2, axis=0))
    counted = valid[2:] & valid[1:-1] & valid[:-2]
    levels = [np.median(second[has, s]) if has.any() else 0.0 for s, has in enumerate(counted.T)]
    return np.maximum(1.4826 * np.array(levels) / np.sqrt(6), LEAST_NOISE * readings.std(axis=0))


STEPS = 1e-4  # of finite differences, relative to length and duration of the crossing
ITERATIONS = 12  # of Gauss and Newton
MAX_ROWS, RATE = 900, 100.0  # samples of all sensors, and in a second; of more, means are taken
LOADED = 0.12  # fraction of the largest reading, above which there is something on the bridge
MARGIN = 5.0  # m, by which axles may enter earlier, or leave later, than readings show
# Fraction of the loaded time, and s, of readings used before and after the loaded time.
MARGIN_FRACTION, MARGIN_TIME = 0.15, 0.25
CORRELATION = 0.05  # s, correlation time of dynamic wheel forces
RATIO_SPREAD = 0.3  # standard deviation of the logarithm of d
SPEED_SPREAD = 0.03  # standard deviation of the initial speed, relative
FREQUENCY_SPREADS = 0.01, 0.03  # of the first mode of the bridge, and of others, relative
MOST_CHANGE = 0.1  # of logarithms of these
MIN_GAP = 0.6  # m, between axles: less than any tandem's
MIN_AXLE_FRACTION = 0.04  # of the gross weight, of a real axle
GROUP_GAP = 2.2  # m, of axles of one group (COST 323)
# Prior: standard deviation of the load difference of neighbours in a group, over their mean; mean
# and standard deviation of gaps (m) in a group.
EQUAL, GROUP_MEAN, GROUP_SPREAD = 0.12, 1.35, 0.1
LOAD_SPREAD = 0.35  # standard deviation of the logarithms of the axle loads of a vehicle


@dataclasses.dataclass(frozen=True, eq=False)
class AxleFit:
    """Axles on a bridge with the covariance of their forces (N), speed, entry time and offsets.

    `covariance` is that of forces, speed (m/s), entry time (s) and offsets (m) behind the first
    axle, in this order; `dynamic_share` is d. Residuals have `excess` times the variance of noise
    and usual dynamic wheel forces. `deviance` is minus twice the log-likelihood at the best
    parameters, up to a constant of the readings.
    """

    geometry: AxleGeometry
    forces: Float[np.ndarray, " axle"]
    covariance: Float[np.ndarray, "parameter parameter"]
    dynamic_share: float
    degrees_of_freedom: float
    deviance: float
    excess: float
    rows: int
    weights: "Weights"
    lines: InfluenceLines

    @property
    def is_plausible(self) -> bool:
        """Whether every axle is heavy enough to be a real one."""
        return bool(self.forces.min() > MIN_AXLE_FRACTION * self.forces.sum())

    @property
    def errors(self) -> Float[np.ndarray, " parameter"]:
        """Standard errors of forces, speed, entry time and offsets."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def values(self) -> Float[np.ndarray, " parameter"]:
        """Forces, speed, entry time and offsets."""
        at = self.geometry
        return np.concatenate([self.forces, [at.speed, at.entry_time], at.offsets[1:]])

    @property
    def half_widths(self) -> Float[np.ndarray, " parameter"]:
        """Half widths of the 95 % intervals."""
        return t_quantile(self.degrees_of_freedom) * self.errors

    @property
    def groups(self) -> list[list[int]]:
        """Axles (from 0) of groups, each less than 2.2 m behind the one before."""
        return axle_groups(self.geometry.offsets)

    @property
    def criterion(self) -> float:
        """Criterion of the number of axles (Schwarz 1978): deviance plus penalty; lower is better.

        An axle adds a load and a place, of which little is new in a group. Axles of one vehicle
        have loads within a factor of two or so: a wider range suggests several vehicles.
        """
        return self.deviance + unlikeliness(self.rows, self.geometry.offsets, self.forces)

    @property
    def gross_weight(self) -> tuple[float, float]:
        """Sum of the axle forces and its standard error (N)."""
        return self.group_weight(range(self.forces.size))

    def group_weight(self, axles) -> tuple[float, float]:
        """Sum of the forces of some axles and its standard error (N)."""
        own = np.array(list(axles), int)
        variance = self.covariance[np.ix_(own, own)].sum()
        return float(self.forces[own].sum()), float(np.sqrt(variance))


def axle_groups(offsets: Float[np.ndarray, " axle"]) -> list[list[int]]:
    """Axles (from 0) at offsets (m) of groups, each less than 2.2 m behind the one before."""
    apart = np.flatnonzero(np.diff(offsets) >= GROUP_GAP) + 1
    return [part.tolist() for part in np.split(np.arange(offsets.size), apart)]


def unlikeliness(rows: int, offsets, forces) -> float:
    """Penalty of the axles on the deviance in `AxleFit.criterion`, for a number of rows.

    Infinite for axles without force.
    """
    axles, groups = forces.size, len(axle_groups(offsets))
    if not np.any(forces > 0):
        return np.inf
    logs = np.log(np.maximum(forces, 1e-3 * forces.sum()))
    unlike = np.sum(((logs - logs.mean()) / LOAD_SPREAD) ** 2)
    return float((groups + axles) * np.log(rows) + unlike)


class Weights(NamedTuple):
    """Whitening of rows (in units of the noise) by the Cholesky factor of their covariance."""

    factor: Float[np.ndarray, "row row"]
    unlikely: float = 0.0  # deviance of d in its prior

    def __call__(self, rows):
        """Whitened rows."""
        return scipy.linalg.solve_triangular(self.factor, rows, lower=True, check_finite=False)

    @property
    def logarithm(self) -> float:
        """Logarithm of the determinant of the covariance."""
        return 2 * float(np.sum(np.log(np.diag(self.factor))))


class AxleTrain(NamedTuple):
    """Axles of one speed, their forces (N), influence lines, and d of the dynamic forces."""

    lines: InfluenceLines
    geometry: AxleGeometry
    forces: Float[np.ndarray, " axle"]
    dynamic_share: float


def interpolated(
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
    valid: Bool[np.ndarray, "time sensor"],
) -> Float[np.ndarray, "time sensor"]:
    """Readings at times (s) between the valid ones of each sensor; zero of one that has none.

    >>> readings, valid = np.array([[0.0], [9.0], [2.0]]), np.array([[True], [False], [True]])
    >>> print(interpolated(np.arange(3.0), readings, valid)[1])
    [1.]
    """
    found = np.zeros(readings.shape)
    for i, has in enumerate(valid.T):
        if has.any():
            found[:, i] = np.interp(times, times[has], readings[has, i])
    return found


def telling_sensors(
    readings: Float[np.ndarray, "time sensor"], valid: Bool[np.ndarray, "time sensor"]
) -> Bool[np.ndarray, " sensor"]:
    """Which sensors tell of a crossing: those with valid readings that are not all the same.

    >>> readings = np.array([[0.0, 1.0, 2.0], [0.0, 1.5, 3.0]])
    >>> valid = np.array([[True, True, False], [True, True, False]])
    >>> print(telling_sensors(readings, valid))
    [False  True False]
    """
    low, high = (np.where(valid, readings, sign * np.inf) for sign in (1, -1))
    return high.max(axis=0) > low.min(axis=0)


class CrossingLog:
    """Readings (SI units) of a crossing, in units of the white noise of each sensor.

    `speed` (m/s) is the speed before the fit, within some per cent; `seen` the geometry measured by
    axle detectors, with standard deviations of speed (m/s), entry time (s) and offsets (m). `fixed`
    is the covariance of other axles on the bridge and of noise.
    """

    speed: float | None = None
    seen: "tuple[AxleGeometry, Float[np.ndarray, ' number']] | None" = None

    def __init__(
        self,
        times: Float[np.ndarray, " time"],
        readings: Float[np.ndarray, "time sensor"],
        valid: np.ndarray,
    ):
        first, last = loaded_times(times, readings)
        margin = MARGIN_FRACTION * (last - first) + MARGIN_TIME
        near = (times > first - margin) & (times < last + margin)
        times, readings, valid = times[near], readings[near], valid[near]
        rate = (times.size - 1) / (times[-1] - times[0])
        block = max(times.size * readings.shape[1] // MAX_ROWS, int(rate / RATE))
        if block > 1:  # means of so many samples
            whole = times.size // block * block
            counted = np.where(valid, 1.0, 0.0)[:whole].reshape(-1, block, readings.shape[1])
            sums = np.where(valid, readings, 0.0)[:whole].reshape(counted.shape).sum(axis=1)
            times = times[:whole].reshape(-1, block).mean(axis=1)
            readings = sums / np.maximum(counted.sum(axis=1), 1.0)
            valid = counted.sum(axis=1) > block / 2
        self.times, self.readings, self.valid = times, readings, valid
        self.scale = (valid / white_noise(readings, valid)).T.ravel()
        self.used = self.scale > 0
        self.target = (readings.T.ravel() * self.scale)[self.used]
        self.loaded = first, last
        self.freedom = max((last - first) / CORRELATION, 3.0)
        sensors = readings.shape[1]
        self.shifts = self.rows(np.broadcast_to(np.eye(sensors), (times.size, sensors, sensors)))
        self.fixed = np.eye(self.target.size)

    def without(self, train: "AxleTrain") -> "CrossingLog":
        """Log without the readings of other axles, whose errors are added to the covariance."""
        lines, geometry, forces, share = train
        model, explained = _Model(lines, self, geometry), lines.crossing(geometry, self.times)
        columns, x = self.rows(explained), model.first(forces)
        spreads, count, speed = np.zeros(x.size), model.count, abs(geometry.speed)
        spreads[:count] = forces.max()
        spreads[count : 2 * count + 1] = [0.05 * speed, 1 / speed, *np.ones(count - 1)]
        spreads[x.size - model.modes :] = [FREQUENCY_SPREADS[min(i, 1)] for i in range(model.modes)]
        waves = self.rows(dynamic_waves(lines, geometry, forces, self.times))
        found = copy.copy(self)
        found.fixed = self.fixed + _square(model.jacobian(x, columns) * spreads)
        found.fixed += _square(share * waves)
        if lines.deviations is not None:
            found.fixed += _square(self.rows(_line_errors(lines, geometry, forces, self.times)))
        found.target = self.target - columns @ forces
        found.readings = self.readings - np.einsum("tas,a->ts", explained, forces)
        return found

    def places(self, speed: float, length: float) -> tuple[float, float]:
        """Least and largest distance (m) that axles lie behind the entry at time zero."""
        first, last = self.loaded
        return abs(speed) * first - MARGIN, max(
            abs(speed) * last - length, abs(speed) * first
        ) + MARGIN

    def rows(self, table: Float[np.ndarray, "time number sensor"]):
        """Rows (sensor by sensor) of the valid samples, in units of the noise."""
        flat = table.transpose(2, 0, 1).reshape(self.scale.size, -1)
        return (flat * self.scale[:, None])[self.used]

    def linear(self, lines: InfluenceLines, geometry: AxleGeometry, weights: Weights):
        """Weighted sum of squares with the best forces at a geometry, and these forces (N)."""
        columns = np.hstack([self.rows(lines.crossing(geometry, self.times)), self.shifts])
        columns, target = weights(columns), weights(self.target)
        sizes = _sizes(columns, geometry.offsets.size)
        found = np.linalg.lstsq(columns / sizes, target, rcond=None)[0]
        count = geometry.offsets.size
        if np.any(found[:count] < 0):
            low = np.concatenate([np.zeros(count), np.full(self.shifts.shape[1], -np.inf)])
            found = scipy.optimize.lsq_linear(columns / sizes, target, (low, np.inf)).x
        left = target - columns @ (found / sizes)
        return float(left @ left), (found / sizes)[:count]


def loaded_times(times, readings) -> tuple[float, float]:
    """First and last time (s) with something on the bridge; all of them if there is nothing."""
    level = np.abs(readings - np.median(readings[: max(times.size // 20, 3)], axis=0))
    on = np.flatnonzero(np.any(level > LOADED * level.max(axis=0), axis=1))
    ends = (on[0], on[-1]) if on.size > 2 else (0, -1)
    return float(times[ends[0]]), float(times[ends[1]])


class _Model:
    """Residuals and Jacobian of the readings of a crossing at parameters x.

    Parameters are forces, speed, entry time, offsets, shifts of the sensors, and changes of the
    logarithms of the frequencies of the bridge.
    """

    def __init__(self, lines: InfluenceLines, log: CrossingLog, start: AxleGeometry):
        self.lines, self.log, self.start = lines, log, start
        self.count, self.modes = start.offsets.size, len(lines.modes)

    def first(self, forces):
        """Initial parameters from forces (N) and the geometry of the start."""
        self.least = 0.01 * max(float(forces.sum()), 1e-12)
        at = self.start
        entry = [at.speed, at.entry_time, *at.offsets[1:]]
        return np.concatenate([forces, entry, np.zeros(self.log.shifts.shape[1] + self.modes)])

    def parts(self, x):
        """Geometry, forces (N), shifts and influence lines at parameters."""
        n = self.count
        geometry = AxleGeometry(
            x[n], x[n + 1], np.append(0.0, x[n + 2 : 2 * n + 1]), self.start.length
        )
        changes = x[x.size - self.modes :]
        return geometry, x[:n], x[2 * n + 1 : x.size - self.modes], self.lines.tuned(changes)

    def residual(self, x):
        """Residuals of the readings at parameters, and readings per unit axle force."""
        geometry, forces, shifts, lines = self.parts(x)
        columns = self.log.rows(lines.crossing(geometry, self.log.times))
        return self.log.target - columns @ forces - self.log.shifts @ shifts, columns

    def jacobian(self, x, columns):
        """Derivatives of the readings with respect to all parameters."""
        geometry, forces, _, lines = self.parts(x)
        times = self.log.times
        step = STEPS * geometry.length / abs(geometry.speed)  # in time

        def slopes(moved, size, lines=lines):
            return (self.log.rows(lines.crossing(moved, times)) - columns) / size * forces

        later = dataclasses.replace(geometry, entry_time=geometry.entry_time + step)
        speed = STEPS * geometry.speed
        faster = dataclasses.replace(geometry, speed=geometry.speed + speed)
        by_entry = slopes(later, step)
        parts = [columns, slopes(faster, speed).sum(axis=1, keepdims=True)]
        # An axle that is further behind enters later.
        parts += [by_entry.sum(axis=1, keepdims=True), by_entry[:, 1:] / abs(geometry.speed)]
        others = [lines.tuned(STEPS * row) for row in np.eye(self.modes)]
        tuned = [slopes(geometry, STEPS, one).sum(axis=1, keepdims=True) for one in others]
        return np.hstack([*parts, self.log.shifts, *tuned])

    def prior_residuals(self, x):
        """Residuals of the prior, in standard deviations, and their Jacobian."""
        n = self.count
        forces, offsets = x[:n], np.append(0.0, x[n + 2 : 2 * n + 1])
        close = np.flatnonzero(np.diff(offsets) < GROUP_GAP)
        rows, left = [], []
        for i in close:
            size = EQUAL * max(float(forces[i : i + 2].mean()), self.least)
            row = np.zeros(x.size)
            row[i], row[i + 1] = 1 / size, -1 / size
            rows.append(row)
            left.append(-(forces[i] - forces[i + 1]) / size)
            row = np.zeros(x.size)
            row[n + 2 + i] = 1 / GROUP_SPREAD
            if i:
                row[n + 1 + i] = -1 / GROUP_SPREAD
            rows.append(row)
            left.append(-(offsets[i + 1] - offsets[i] - GROUP_MEAN) / GROUP_SPREAD)
        if self.log.speed is not None:
            row, spread = np.zeros(x.size), SPEED_SPREAD * self.log.speed
            row[n] = np.sign(x[n]) / spread
            rows.append(row)
            left.append((self.log.speed - abs(x[n])) / spread)
        if self.log.seen is not None:
            seen, spreads = self.log.seen
            numbers = np.array([seen.speed, seen.entry_time, *seen.offsets[1:]])
            rows += list(np.eye(x.size)[n : 2 * n + 1] / spreads[:, None])
            left += list((numbers - x[n : 2 * n + 1]) / spreads)
        for i in range(self.modes):
            row, spread = np.zeros(x.size), FREQUENCY_SPREADS[min(i, 1)]
            row[i - self.modes] = 1 / spread
            rows.append(row)
            left.append(-x[i - self.modes] / spread)
        return np.array(left), np.array(rows).reshape(-1, x.size)

    def allowed(self, x):
        """Parameters moved into their bounds: forces that press, axles in order."""
        n, x = self.count, x.copy()
        x[:n] = np.maximum(x[:n], 0.0)
        gaps = np.maximum(np.diff(np.append(0.0, x[n + 2 : 2 * n + 1])), MIN_GAP)
        x[n + 2 : 2 * n + 1] = np.cumsum(gaps)
        speed = abs(self.start.speed)
        x[n] = np.sign(self.start.speed) * np.clip(abs(x[n]), 0.85 * speed, 1.15 * speed)
        low, high = self.log.places(x[n], self.start.length)
        first = np.clip(abs(x[n]) * x[n + 1], low, high)
        x[n + 1] = first / abs(x[n])
        room = max(high - first, (n - 1) * MIN_GAP)
        offsets = x[n + 2 : 2 * n + 1]
        if n > 1 and offsets[-1] > room:
            x[n + 2 : 2 * n + 1] = offsets * room / offsets[-1]
        x[x.size - self.modes :] = np.clip(x[x.size - self.modes :], -MOST_CHANGE, MOST_CHANGE)
        return x


def fit_axles(
    lines: InfluenceLines,
    start: AxleGeometry,
    forces: Float[np.ndarray, " axle"],
    log: CrossingLog,
    weights: Weights | None = None,
) -> AxleFit:
    """Axles fitted to the readings of a crossing, starting from a geometry and forces (N)."""
    model = _Model(lines, log, start)
    n = model.count
    x = model.first(forces)
    if weights is None:
        weights = _weights(model, x, first_time=True)[0]
    for _ in range(2):
        x, _ = _gauss_newton(model, x, weights)
        weights, share, excess = _weights(model, x)
    left, columns = model.residual(x)
    jacobian = weights(model.jacobian(x, columns))
    before, slopes = model.prior_residuals(x)
    jacobian = np.vstack([jacobian, slopes])
    sizes = np.linalg.norm(jacobian, axis=0)
    unseen = sizes < 1e-12 * sizes.max()
    sizes = np.where(unseen, 1.0, sizes)
    inverse = np.linalg.pinv(jacobian / sizes)
    covariance = (inverse @ inverse.T) / np.outer(sizes, sizes)
    # Readings do not depend on the place of an axle without force, or off the bridge.
    most = np.where(np.arange(sizes.size) < n, max(float(x[:n].sum()), 1e-300), start.length)
    covariance[unseen, unseen] = most[unseen] ** 2
    weighted = weights(left)
    deviance = weights.logarithm + weights.unlikely + weighted @ weighted + before @ before
    geometry, forces, _, _ = model.parts(x)
    own = covariance[: 2 * n + 1, : 2 * n + 1]
    return AxleFit(
        geometry,
        forces,
        own,
        share,
        log.freedom,
        float(deviance),
        excess,
        left.size,
        weights,
        lines,
    )


def refined(fit: AxleFit, start: AxleGeometry, forces, log: CrossingLog):
    """Deviance, geometry and forces (N) of axles refined from a start, at the weights of a fit."""
    model = _Model(fit.lines, log, start)
    x, squares = _gauss_newton(model, model.first(forces), fit.weights)
    return fit.weights.logarithm + fit.weights.unlikely + squares, *model.parts(x)[:2]


def _gauss_newton(model: _Model, x, weights: Weights):
    """Parameters of least weighted squares by damped Gauss-Newton steps, and the squares."""

    def cost(x):
        left, columns = model.residual(x)
        before = model.prior_residuals(x)
        weighted = weights(left)
        return float(weighted @ weighted + before[0] @ before[0]), weighted, columns, before

    value, left, columns, before = cost(x)
    damping = 1e-3
    for _ in range(ITERATIONS):
        jacobian = np.vstack([weights(model.jacobian(x, columns)), before[1]])
        sizes = _sizes(jacobian, model.count)
        scaled = jacobian / sizes
        normal, right = scaled.T @ scaled, scaled.T @ np.concatenate([left, before[0]])
        gained = 0.0
        for _ in range(5):
            step = np.linalg.solve(normal + damping * np.eye(x.size), right) / sizes
            trial = model.allowed(x + step)
            new = cost(trial)
            if new[0] < value:
                gained = value - new[0]
                x, (value, left, columns, before) = trial, new
                damping = max(damping / 5, 1e-9)
                break
            damping *= 10
        if gained < 0.01:
            break
    return x, value


def _weights(model: _Model, x, first_time=False) -> tuple[Weights, float, float]:
    """Weights from dynamic wheel forces at parameters, their ratio d, and excess of residuals."""
    log = model.log
    geometry, forces, _, lines = model.parts(x)
    fixed = log.fixed
    if lines.deviations is not None:
        fixed = fixed + _square(log.rows(_line_errors(lines, geometry, forces, log.times)))
    dynamic = _square(log.rows(dynamic_waves(lines, geometry, forces, log.times)))
    left, columns = model.residual(x)
    jacobian = model.jacobian(x, columns)
    jacobian = np.column_stack([jacobian / _sizes(jacobian, model.count), left])
    number = log.target.size - jacobian.shape[1] + 1
    usual = np.log(lines.dynamic_share)

    def at(log_share):
        """Deviance (Patterson and Thompson 1971), factor and level of the covariance."""
        factor = np.linalg.cholesky(fixed + np.exp(2 * log_share) * dynamic)
        triangle = np.linalg.qr(Weights(factor)(jacobian), mode="r")
        sizes = np.abs(np.diag(triangle))
        squares, determinant = sizes[-1] ** 2, Weights(factor).logarithm
        level = max(float(squares) / number, 1.0)
        unlikely = ((log_share + np.log(level) / 2 - usual) / RATIO_SPREAD) ** 2
        reduced = 2 * np.sum(np.log(np.maximum(sizes[:-1], 1e-12)))
        deviance = determinant + reduced + number * np.log(level) + squares / level + unlikely
        return deviance, factor, level, unlikely

    best = usual
    if not first_time:
        best = scipy.optimize.minimize_scalar(
            lambda log_share: at(log_share)[0], bounds=tuple(np.log(DYNAMIC_LIMITS)),
            method="bounded", options={"xatol": 0.1},
        ).x  # fmt: skip
    _, factor, level, unlikely = at(best)
    share = float(np.exp(best) * np.sqrt(level))
    return Weights(factor * np.sqrt(level), float(unlikely)), share, level


def _sizes(columns, count):
    """Norms of columns, with a lower limit for axles that are hardly on the bridge."""
    sizes = np.linalg.norm(columns, axis=0)
    sizes[:count] = np.maximum(sizes[:count], 1e-3 * sizes[:count].max())
    return np.maximum(sizes, 1e-300)


def _square(table):
    return table @ table.T


def _line_errors(lines: InfluenceLines, geometry: AxleGeometry, forces, times):
    """Readings (time, number, sensor) of the axle forces on the deviations of the lines."""
    assert lines.deviations is not None
    number, points, sensors = lines.deviations.shape
    table = lines.deviations.transpose(1, 0, 2).reshape(points, -1)
    still = InfluenceLines(lines.positions, table)
    readings = np.einsum("tak,a->tk", still.crossing(geometry, times), forces)
    return readings.reshape(times.size, number, sensors)
