"""Influence lines of the sensors of a bridge: of its model, or calibrated by known vehicles."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.model.load_set import load_set
from tuning.logs.log import Log
from tuning.logs.pairing import sensor_readings
from tuning.weighing.unit_force import UnitForce, driven

MODEL_POINTS = 201
# The bridge vibrates in as many modes as hold this share of the squares of its influence lines, in
# so many at most: vehicles change the frequencies of higher ones by more than their part is known.
MODE_SHARE, MODES = 0.8, 4
SMOOTHNESS = np.logspace(-8, 4, 49)  # tried weights of second differences
FREQUENCY_SHARES = np.geomspace(0.7, 1.8, 40)  # of the model's first frequency, likewise
DYNAMIC_RATE = 6.0  # Hz, of independent errors: body bounce and vibration have two to four
FORMAT = "jaxbeam influence lines 1"


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


class InfluenceLines(NamedTuple):
    """Readings of sensors (SI unit per newton downwards) with a force at positions (m).

    `covariance` is that of the ordinates (sensor, point, point) of calibrated lines. The bridge
    vibrates about what the lines tell in modes of these `shapes`, of `ratios` times the first
    `frequency` (Hz), and `damping_ratios`; without a frequency it does not.

    >>> import numpy as np
    >>> import tuning
    >>> lines = tuning.weighing.InfluenceLines(
    ...     np.array([0.0, 5.0, 10.0]), np.array([[0.0], [-2e-8], [0.0]])
    ... )
    >>> print(lines.at(np.array([2.5])))
    [[-1.e-08]]
    """

    positions: Float[np.ndarray, " point"]
    values: Float[np.ndarray, "point sensor"]
    covariance: Float[np.ndarray, "sensor point point"] | None = None
    frequency: float | None = None
    shapes: Float[np.ndarray, "point mode"] | None = None
    ratios: Float[np.ndarray, " mode"] | None = None
    damping_ratios: Float[np.ndarray, " mode"] | None = None

    def at(self, x: Float[np.ndarray, "*force"]) -> Float[np.ndarray, "*force sensor"]:
        """Readings per newton with the force at x (m), zero off the beam."""
        lines = (np.interp(x, self.positions, line, 0.0, 0.0) for line in self.values.T)
        return np.stack(list(lines), axis=-1)

    @property
    def length(self) -> float:
        """Length (m) of the beam."""
        return float(self.positions[-1])

    def crossing(
        self, geometry: AxleGeometry, times: Float[np.ndarray, " time"]
    ) -> Float[np.ndarray, "time axle sensor"]:
        """Readings of a force of one newton at each axle, with the vibration that it leaves."""
        found = self.at(geometry.positions(times))
        since = times[:, None] - geometry.entry_time - geometry.offsets / abs(geometry.speed)
        for mode in self.modes:
            found = found + mode.swing(since, geometry.speed)[:, :, None] * (
                mode.parts @ self.values
            )
        return found

    def modulated(
        self,
        geometry: AxleGeometry,
        times: Float[np.ndarray, " time"],
        waves: Float[np.ndarray, "time wave"],
    ) -> Float[np.ndarray, "time axle wave sensor"]:
        """Readings of forces at the axles that vary in time as `waves` (N), with vibration."""
        x = geometry.positions(times)
        found = waves[:, None, :, None] * self.at(x)[:, :, None, :]
        grid = np.linspace(times[0], times[-1], times.size)
        for mode in self.modes:
            shape = np.interp(x, self.positions, mode.shape, 0.0, 0.0)
            force = (shape[:, :, None] * waves[:, None, :]).reshape(times.size, -1)
            even = np.stack([np.interp(grid, times, one) for one in force.T], axis=1)
            motion = mode.motion(even, grid[1] - grid[0])
            swing = np.stack([np.interp(times, grid, one) for one in (motion - even).T], axis=1)
            swing = swing.reshape(*shape.shape, -1)
            found = found + swing[..., None] * (mode.parts @ self.values)
        return found

    @property
    def modes(self) -> "list[_Mode]":
        """Modes in which the bridge vibrates."""
        if self.frequency is None:
            return []
        assert self.shapes is not None
        # An influence line is the sum of the shapes times what these rows make of it.
        parts = np.linalg.pinv(self.shapes)
        rows = zip(self.shapes.T, self.ratios, self.damping_ratios, parts, strict=True)
        return [
            _Mode(self.positions, shape, float(self.frequency * ratio), float(damping), part)
            for shape, ratio, damping, part in rows
        ]

    def to_dict(self) -> dict:
        """Plain numbers, from which `lines_from_dict` makes the lines again."""
        return {
            "format": FORMAT,
            "positions_m": self.positions.tolist(),
            "ordinates": self.values.T.tolist(),
            "covariances": _listed(self.covariance),
            "frequency_hz": self.frequency,
            "shapes": _listed(self.shapes),
            "frequency_ratios": _listed(self.ratios),
            "damping_ratios": _listed(self.damping_ratios),
        }


def _listed(table: np.ndarray | None) -> list | None:
    return None if table is None else table.tolist()


def lines_from_dict(content: dict) -> InfluenceLines:
    """Influence lines from the numbers of `InfluenceLines.to_dict`.

    Raises ValueError for content of another format.
    """
    found = content.get("format") if isinstance(content, dict) else None
    if found != FORMAT:
        raise ValueError(
            f"these are no calibrated influence lines: format {found!r}, not {FORMAT!r}; write them"
            " by weigh --calibration LOG --lines FILE"
        )
    names = "covariances", "shapes", "frequency_ratios", "damping_ratios"
    tables = [None if content[name] is None else np.array(content[name]) for name in names]
    return InfluenceLines(
        np.array(content["positions_m"]), np.array(content["ordinates"]).T, tables[0],
        content["frequency_hz"], *tables[1:],
    )  # fmt: skip


class _Mode(NamedTuple):
    """z'' + 2 zeta w z' + w^2 z = w^2 s for a mode of a shape, of which `parts` is in a line."""

    positions: Float[np.ndarray, " point"]
    shape: Float[np.ndarray, " point"]
    frequency: float
    damping_ratio: float
    parts: Float[np.ndarray, " point"]

    def swing(self, since: Float[np.ndarray, "*time"], speed: float) -> Float[np.ndarray, "*time"]:
        """Response z less the static one s to a force that crosses, since its entry (s)."""
        passage = float(self.positions[-1]) / abs(speed)
        last = max(float(since.max()), passage)
        fine = min(passage / 200, 1 / (24 * self.frequency), last / 8)
        step = passage / np.ceil(passage / fine)
        times = step * np.arange(int(np.ceil(last / step)) + 2)
        place = times * abs(speed)
        if speed < 0:
            place = self.positions[-1] - place
        force = np.interp(place, self.positions, self.shape, 0.0, 0.0)
        motion = self.motion(force[:, None], step)[:, 0]
        return np.interp(since, times, motion - force, left=0.0)

    def motion(
        self, force: Float[np.ndarray, "time number"], step: float
    ) -> Float[np.ndarray, "time number"]:
        """Motion z by forces s at equal steps (s), from rest."""
        w, damping = 2 * np.pi * self.frequency, self.damping_ratio
        pole = complex(-damping * w, w * np.sqrt(1 - damping**2))
        # z is the imaginary part of the response of one pole to w^2 / w_d times the force.
        inputs = (force * w**2 / pole.imag).astype(complex)
        return driven(np.full(force.shape[1], pole), inputs, step).imag


def model_influence_lines(case: Case) -> InfluenceLines:
    """Influence lines of a case at 201 points, linear in between, and its first modes.

    Those of moments and the like are corrected statically; those of deflections are sums of the
    modes of the case.

    Raises ValueError for a sensor of velocity or acceleration, and a beam that can move as a rigid
    body.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(jb.Beam(20.0, 8e9, 12e3), sensors=[jb.Sensor(10.0)])
    >>> lines = tuning.weighing.model_influence_lines(case)
    >>> print(f"{lines.at(np.array([10.0]))[0, 0]:.2e} m/N, {-(20**3) / 48 / 8e9:.2e} m/N")
    -2.08e-08 m/N, -2.08e-08 m/N
    """
    check_static(case)
    unit_force = UnitForce(case, 1.0)
    shares = np.linspace(0.0, 1.0, MODEL_POINTS)
    values = unit_force.readings(unit_force.length, shares)
    positions = shares * unit_force.length
    return InfluenceLines(positions, values, None, *_first_modes(case, positions))


def _first_modes(case: Case, positions: Float[np.ndarray, " point"]) -> tuple:
    """First modes that hold MODE_SHARE of the squares of the influence lines of a case."""
    unit_force = UnitForce(case, 1.0)
    values = unit_force.readings(unit_force.length, positions / unit_force.length)
    count, left = 0, np.inf
    while count < MODES and left > 1 - MODE_SHARE:
        count += 1
        modes = unit_force.modes(positions, count)
        rest = values - modes[1] @ np.linalg.lstsq(modes[1], values, rcond=None)[0]
        left = float(np.mean(np.sum(rest**2, axis=0) / np.sum(values**2, axis=0)))
    return modes


def calibrate_influence_lines(
    case: Case, logs: Log | Sequence[Log], points: int = 41
) -> InfluenceLines:
    """Influence lines from logs of vehicles of known wheel loads, speeds and entry times.

    Ordinates at equally spaced points, linear in between and zero at both ends, are fitted by least
    squares with a weight on their second differences, found by generalised cross-validation (Golub,
    Heath and Wahba 1979), and offsets of each sensor in each log. The bridge vibrates meanwhile in
    its first modes, whose frequencies are found with the lines: shapes, damping and ratios of
    frequencies are those of the case.
    The covariance of the lines is that of the posterior with the same weight (Wahba 1983), of
    errors that are independent DYNAMIC_RATE times a second. Loads are those of each log, or else of
    the case.

    Raises ValueError if no load is known, for a sensor of velocity or acceleration, and for less
    than five points.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> import tuning
    >>> beam, truck = jb.Beam(20.0, 8e9, 12e3, 0.02), jb.MovingForce(force=3e5, speed=2.0)
    >>> case = jb.Case(beam, sensors=[jb.Sensor(10.0)], loads=[truck], run=jb.Run(10.0, 20.0))
    >>> record = jb.simulate(case)
    >>> columns = ("w1",), ("deflection",), ("m",)
    >>> log = tuning.Log(record.times, record.deflection, *columns, sensors=(0,))
    >>> lines = tuning.weighing.calibrate_influence_lines(case, log)
    >>> print(f"{lines.at(np.array([10.0]))[0, 0]:.2g} m/N")
    -2.1e-08 m/N
    """
    check_static(case)
    if points < 5:
        raise ValueError(f"influence lines need at least 5 points, not {points}")
    logs = [logs] if isinstance(logs, Log) else list(logs)
    length = float(concrete(case.beam.length))
    positions = np.linspace(0.0, length, points)
    runs = [_Run(case, log, positions) for log in logs]
    first, *others = _first_modes(case, positions)
    zero = np.zeros((points, len(case.sensors)))
    vibrating = InfluenceLines(positions, zero, None, first, *others)

    def solved(share):
        return _lines_of_runs(runs, vibrating._replace(frequency=float(share * first)).modes)

    def misfit(share):
        return sum(one.misfit for one in solved(share))

    start = min(FREQUENCY_SHARES.tolist(), key=misfit)
    share = scipy.optimize.minimize_scalar(
        misfit, bounds=(0.97 * start, 1.03 * start), method="bounded", options={"xatol": 1e-4}
    ).x
    best = solved(share)
    values = np.stack([one.ordinates for one in best], axis=1)
    covariance = np.stack([one.covariance for one in best])
    return InfluenceLines(positions, values, covariance, float(share * first), *others)


class _Run:
    """A calibration run: readings, and what ordinates at some positions make of them."""

    def __init__(self, case: Case, log: Log, positions):
        loads = case.loads if log.loads is None else tuple(log.loads)
        if not loads:
            raise ValueError(
                f"{log.source}: no load is known; calibration needs a vehicle of known wheel loads,"
                " in the case or in the TOML file beside the log"
            )
        wheels = load_set(dataclasses.replace(case, loads=loads))
        self.readings, self.valid = sensor_readings(case, log)
        x, rates = (np.asarray(part).T for part in wheels.kinematics(log.times)[:2])
        weights = np.asarray(wheels.weight)[:, 0]
        hats = np.eye(positions.size)
        static = [_interpolated(positions, hats, x[:, i]) for i in range(len(weights))]
        self.static = sum(w * own for w, own in zip(weights, static, strict=True))
        self.wheels = []
        for i, w in enumerate(weights):
            speed = float(np.median(rates[:, i]))
            travelled = x[:, i] if speed > 0 else positions[-1] - x[:, i]
            self.wheels.append((w, travelled / abs(speed), speed))
        rate = (log.times.size - 1) / log.duration
        self.counted = min(DYNAMIC_RATE / rate, 1.0)

    def matrix(self, modes: list[_Mode]):
        """Readings of unit ordinates (time, point), centred later."""
        found = self.static
        for mode in modes:
            swing = sum(w * mode.swing(since, speed) for w, since, speed in self.wheels)
            found = found + np.outer(swing, mode.parts)
        return found


def _lines_of_runs(runs: list[_Run], modes: list[_Mode]) -> "list[_Ordinates]":
    """Ordinates of each sensor from all runs together."""
    matrices = [run.matrix(modes) for run in runs]
    found = []
    for i in range(runs[0].readings.shape[1]):
        rows, targets = [], []
        for run, matrix in zip(runs, matrices, strict=True):
            used = run.valid[:, i]
            rows.append(matrix[used, 1:-1] - matrix[used, 1:-1].mean(axis=0))
            targets.append(run.readings[used, i] - run.readings[used, i].mean())
        counted = float(np.mean([run.counted for run in runs]))
        found.append(_smooth_ordinates(np.vstack(rows), np.concatenate(targets), counted))
    return found


def check_static(case: Case) -> None:
    """Raises ValueError, naming the sensor, for one whose influence line is zero, or for none."""
    if not case.sensors:
        raise ValueError("weighing needs a sensor on the beam; the case has none")
    for i, sensor in enumerate(case.sensors):
        if sensor.quantity in ("velocity", "acceleration"):
            raise ValueError(
                f"sensors.{i} measures {sensor.quantity}, which has no influence line; weigh axles"
                " by deflection, strain and the like"
            )


def _interpolated(positions, hats, x):
    return np.stack([np.interp(x, positions, hat, 0.0, 0.0) for hat in hats.T], axis=1)


class _Ordinates(NamedTuple):
    """Ordinates with zeros at the ends, their covariance, and what they leave of the readings."""

    ordinates: Float[np.ndarray, " point"]
    covariance: Float[np.ndarray, "point point"]
    misfit: float


def _smooth_ordinates(centred, target, counted) -> _Ordinates:
    """Ordinates that fit a reading, by penalised least squares with the weight of least GCV.

    `counted` is the share of samples whose errors are independent.
    """
    count = centred.shape[1]
    second = np.diff(np.eye(count + 2), 2, axis=0)[:, 1:-1]
    penalty = second.T @ second
    normal, right = centred.T @ centred, centred.T @ target
    penalty = penalty * np.trace(normal) / np.trace(penalty)
    values, vectors = scipy.linalg.eigh(normal, penalty)
    values, projected = np.maximum(values, 0.0), vectors.T @ right
    whole = float(target @ target)

    def squares(weight):
        shrunk = projected / (values + weight)
        return max(whole - 2 * shrunk @ projected + shrunk @ (values * shrunk), 1e-12 * whole)

    def criterion(weight):
        freedom = np.sum(values / (values + weight))
        return squares(weight) / (len(target) - 1 - freedom) ** 2

    best = min(SMOOTHNESS, key=criterion)
    freedom = np.sum(values / (values + best))
    variance = squares(best) / (len(target) - 1 - freedom) / counted
    ordinates, covariance = np.zeros(count + 2), np.zeros((count + 2, count + 2))
    ordinates[1:-1] = vectors @ (projected / (values + best))
    covariance[1:-1, 1:-1] = variance * (vectors / (values + best)) @ vectors.T
    return _Ordinates(ordinates, covariance, squares(best) / whole)
