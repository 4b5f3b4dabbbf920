"""Influence lines calibrated by known vehicles, on a road that nobody measured.

The line of a sensor is a multiple of that of the case, which has the kinks, plus a smooth part g
that is zero at the ends of the beam. Ends and rigidity unlike those of the case add cubics, so that
fourth differences of g are penalised. Readings of a run r are

    y_r = A_r h + c_r + B_r w + e,   w ~ N(0, d^2),   fourth differences of g ~ N(0, 1 / l),

with known axle loads in A_r and waves of dynamic wheel forces in B_r (`dynamic_waves`). These
forces are the same at the same place whenever a vehicle crosses one road at one speed: repeated
runs of a vehicle at nearly the same speed count as one. Higher modes have the frequency of a clear
peak of the residuals; all are refined by the likelihood. Shares d, l and the level of e have the
greatest restricted likelihood (Patterson and Thompson 1971, DOI 10.1093/biomet/58.3.545); the
errors of the lines of all sensors are those of the mixed model (Henderson 1975,
DOI 10.2307/2529430).
"""

import dataclasses
import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import refuses_traced
from jaxbeam.model.load_set import load_set
from tuning.fit.dataset import check_loads, sensor_readings
from tuning.logs.log import Log
from tuning.weighing.axle_fit import DYNAMIC_LIMITS, CrossingLog, dynamic_waves, white_noise
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines, model_influence_lines

KNOTS = 41  # of the smooth part
FREQUENCY_RATIOS = np.geomspace(0.7, 1.8, 40)  # to the model's first frequency, that are tried
NEAR, STEP = 0.08, 0.02  # of logarithms of the first frequency tried again
NEAR_PEAK, FINE = 0.03, 0.01  # likewise, of others
FARTHEST = 0.4  # of logarithms of frequencies, from the first ones
FAR = np.exp(np.arange(-0.25, 0.2501, 0.005))  # ratios to the model's, at which others may peak
PEAK = 12.0  # times the median, of a clear peak of a periodogram
SAME_SPEED = 0.1  # relative difference of speeds at which dynamic forces of a vehicle repeat
KEPT = 1e-8  # fraction of the largest variance below which a deviation is left out
STIFFNESSES = 1e9, 1e12


@refuses_traced("a table of influences")
def calibrate_influence_lines(case: Case, logs: Log | Sequence[Log]) -> InfluenceLines:
    """Influence lines from logs of vehicles of known wheel loads, speeds and entry times.

    The bridge vibrates meanwhile in its first modes, whose frequencies are found with the lines:
    shapes, damping and ratios of frequencies are those of the case. Errors of the lines are those
    by noise and by dynamic wheel forces, which only runs at other speeds average out. Loads are
    those of each log, or else of the case.

    Raises ValueError if no load is known or has crossed within a log, and for a sensor of velocity
    or acceleration.

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
    model = model_influence_lines(case)
    logs = [logs] if isinstance(logs, Log) else list(logs)
    runs = [_Run(case, log) for log in logs]
    x = model.positions / model.length
    cubics = np.stack([x * (1 - x), x * (1 - x) * (1 - 2 * x)], axis=1)
    first = float(model.frequency or 0.0)

    def rough(ratio):
        """Misfit of the lines of the model plus cubics at a frequency ratio, and these lines."""
        vibrating = model._replace(frequency=ratio * first)
        found, left = [], 0.0
        tables = [run.static(vibrating, np.hstack([model.values, cubics])) for run in runs]
        sensors = model.values.shape[1]
        for s in range(sensors):
            own = [s, sensors, sensors + 1]
            rows = np.vstack(
                [run.centred(t[:, own], s) for run, t in zip(runs, tables, strict=True)]
            )
            target = np.concatenate([run.centred(run.readings[:, s], s) for run in runs])
            sizes = np.linalg.norm(rows, axis=0)
            factors = np.linalg.lstsq(rows / sizes, target, rcond=None)[0] / sizes
            left += float(np.sum((rows @ factors - target) ** 2) / np.sum(target**2))
            found.append(np.hstack([model.values[:, [s]], cubics]) @ factors)
        return left, vibrating._replace(values=np.stack(found, axis=1))

    start = min(FREQUENCY_RATIOS.tolist(), key=lambda ratio: rough(ratio)[0])
    ratio = scipy.optimize.minimize_scalar(
        lambda ratio: rough(ratio)[0], bounds=(0.97 * start, 1.03 * start), method="bounded",
        options={"xatol": 1e-4},
    ).x  # fmt: skip
    lines = _with_peaks(rough(ratio)[1], runs)
    logs_of_first = _Problem(model, lines, runs).best_logs()
    # Again with dynamic wheel forces as noise: those of a rough road would pass for vibration.
    for mode in range(len(lines.modes)):
        lines = _tuned(lines, mode, lambda one: _Problem(model, one, runs).solved(logs_of_first))
    last = _Problem(model, lines, runs)
    return last.lines(last.best_logs())


def _with_peaks(lines: InfluenceLines, runs: "list[_Run]") -> InfluenceLines:
    """Lines with higher modes where the residuals have a clear peak."""
    if lines.frequency is None or lines.ratios is None:
        return lines
    ratios = np.array(lines.ratios)
    for i in range(1, ratios.size):
        tried = FAR * ratios[i]
        power = np.zeros(tried.size)
        for run in runs:
            left = run.readings - run.fitted(lines)
            left = np.where(run.valid, left, 0.0) * np.hanning(len(left))[:, None]
            waves = np.exp(-2j * np.pi * lines.frequency * tried[:, None] * run.times)
            power += np.sum(np.abs(waves @ (left / run.noise)) ** 2, axis=1)
        if power.max() > PEAK * np.median(power):
            ratios[i] = tried[np.argmax(power)]
    return lines._replace(ratios=ratios)


def _tuned(lines: InfluenceLines, mode: int, solved) -> InfluenceLines:
    """Lines with the frequency of a mode at which the deviance is least."""
    near, step = (NEAR_PEAK, FINE) if mode else (NEAR, STEP)

    def at(log):
        return lines.tuned(log * (np.arange(len(lines.modes)) == mode))

    logs = np.arange(-near, near + step / 2, step)
    misfits = [solved(at(log)).deviance for log in logs]
    for end, sign in ((0, -1), (-1, 1)):  # on, as long as it falls towards an end
        while np.argmin(misfits) == range(len(misfits))[end] and abs(logs[end]) < FARTHEST:
            place = 0 if end == 0 else len(logs)
            logs = np.insert(logs, place, logs[end] + sign * step)
            misfits.insert(place, solved(at(logs[end])).deviance)
    i = int(np.clip(np.argmin(misfits), 1, len(logs) - 2))
    low, middle, high = misfits[i - 1 : i + 2]
    bend = max(low - 2 * middle + high, 1e-300)
    return at(logs[i] + step * np.clip((low - high) / (2 * bend), -1.0, 1.0))


class _Run:
    """Calibration run: readings of sensors, and the given axles."""

    def __init__(self, case: Case, log: Log):
        loads = case.loads if log.loads is None else tuple(log.loads)
        if not loads:
            raise ValueError(
                f"{log.source}: no load is known; calibration needs a vehicle of known wheel loads,"
                " in the case or in the TOML file beside the log"
            )
        check_loads(log, dataclasses.replace(case, loads=loads))
        crossing = CrossingLog(log.times, *sensor_readings(case, log))
        self.times, self.readings, self.valid = crossing.times, crossing.readings, crossing.valid
        self.vehicles = [_vehicle(case, load, self.times) for load in loads]
        self.noise = white_noise(self.readings, self.valid)

    def static(self, lines: InfluenceLines, basis) -> Float[np.ndarray, "time number"]:
        """Readings of a sensor whose influence line is each column of a basis."""
        parts = [
            np.einsum("tak,a->tk", lines._replace(values=basis).crossing(at, self.times), forces)
            for at, forces in self.vehicles
        ]
        return np.sum(parts, axis=0)

    def repeats(self, other: "_Run") -> bool:
        """Whether the same vehicles crossed at nearly the same speeds."""
        return len(self.vehicles) == len(other.vehicles) and all(
            own.offsets.size == at.offsets.size
            and np.allclose(own.offsets, at.offsets, atol=0.1)
            and np.allclose(forces, loads, rtol=0.05)
            and abs(own.speed / at.speed - 1) < SAME_SPEED
            for (own, forces), (at, loads) in zip(self.vehicles, other.vehicles, strict=True)
        )

    def fitted(self, lines: InfluenceLines) -> Float[np.ndarray, "time sensor"]:
        """Readings of the given axles by influence lines, without offsets of the sensors."""
        return self.static(lines, lines.values)

    def rows(self, table, sensor):
        """Valid rows of a table in units of the noise of a sensor."""
        return table[self.valid[:, sensor]] / self.noise[sensor]

    def centred(self, table, sensor):
        """Valid rows of a table in units of the noise, less their mean."""
        rows = self.rows(table, sensor)
        return rows - rows.mean(axis=0)


def _vehicle(case: Case, load, times) -> tuple[AxleGeometry, Float[np.ndarray, " axle"]]:
    wheels = load_set(dataclasses.replace(case, loads=(load,)))
    x, rates = (np.asarray(part) for part in wheels.kinematics(times)[:2])
    length, speed = float(case.beam.length), float(np.median(rates))
    travelled = x[:, 0] if speed > 0 else length - x[:, 0]
    offsets = travelled[0] - travelled
    entry = float(times[0] - travelled[0] / abs(speed))
    return AxleGeometry(speed, entry, offsets, length), np.asarray(wheels.weight)[:, 0]


class _Solution(NamedTuple):
    """Least-squares parameters, their covariance, and the restricted deviance."""

    numbers: Float[np.ndarray, " number"]
    covariance: Float[np.ndarray, "number number"]
    deviance: float


class _Problem:
    """Mixed model of influence lines for all runs and sensors, with dynamic wheel forces as noise.

    Waves of dynamic forces and vibration are computed by the lines of the `start`.
    """

    def __init__(self, model: InfluenceLines, start: InfluenceLines, runs: list[_Run]):
        self.start, self.sensors = start, model.values.shape[1]
        hats = _hats(model.positions) * np.abs(start.values).max()
        self.own = 1 + hats.shape[1]
        self.columns = [np.hstack([model.values[:, [s]], hats]) for s in range(self.sensors)]
        self.parts = []  # of each run: numbers and readings, covariance of dynamic wheel forces
        for run in runs:
            static = run.static(start, np.hstack([model.values, hats]))
            tables = [
                run.rows(np.hstack([static[:, [s]], static[:, self.sensors :]]), s)
                for s in range(self.sensors)
            ]
            targets = [run.rows(run.readings[:, [s]], s) for s in range(self.sensors)]
            block, ones = scipy.linalg.block_diag, np.ones((run.times.size, 1))
            shifts = [run.rows(ones, s) for s in range(self.sensors)]
            parts = [block(*tables), block(*shifts), np.vstack(targets)]
            rows = np.concatenate([np.asarray(part) for part in parts], axis=1)
            waves = np.concatenate(
                [dynamic_waves(start, *one, run.times) for one in run.vehicles], axis=1
            )
            waves = np.vstack([run.rows(waves[:, :, s], s) for s in range(self.sensors)])
            self.parts.append((rows, waves @ waves.T))
        # Repeated runs count as one: their dynamic wheel forces are the same.
        self.counted = [1 / sum(run.repeats(one) for one in runs) for run in runs]
        self.freedom = sum(
            counted * (len(rows) - self.sensors)
            for counted, (rows, _) in zip(self.counted, self.parts, strict=True)
        )
        differences = np.diff(np.eye(KNOTS), 4, axis=0)[:, 1:-1]
        self.rank = len(differences) * self.sensors
        penalty = differences.T @ differences
        self.penalty = scipy.linalg.block_diag(*[[[0.0]], penalty] * self.sensors)
        self.weighted = functools.lru_cache(maxsize=64)(self._weighted)

    def _weighted(self, log_share: float):
        """Gram matrix of parameters and readings, and log-determinant of the covariance, at a d."""
        gram, determinant = 0.0, 0.0
        for counted, (rows, dynamic) in zip(self.counted, self.parts, strict=True):
            factor = np.linalg.cholesky(np.eye(len(rows)) + np.exp(2 * log_share) * dynamic)
            table = scipy.linalg.solve_triangular(factor, rows, lower=True, check_finite=False)
            basis, triangle = np.linalg.qr(table[:, -1 - self.sensors : -1])
            table = np.delete(table, np.s_[-1 - self.sensors : -1], axis=1)
            table -= basis @ (basis.T @ table)
            gram = gram + counted * table.T @ table
            sizes = np.concatenate([np.diag(factor), np.abs(np.diag(triangle))])
            determinant += counted * 2 * float(np.sum(np.log(sizes)))
        return gram, determinant

    def solved(self, logs) -> _Solution:
        """Solution at the logarithms of d (dynamic over static forces), and of the stiffness."""
        gram, determinant = self.weighted(round(float(logs[0]), 3))
        stiffness = np.exp(logs[1])
        normal = gram[:-1, :-1] + stiffness * self.penalty
        size = np.sqrt(np.diag(normal))
        factor = scipy.linalg.cho_factor(normal / np.outer(size, size), lower=True)
        right = gram[:-1, -1] / size
        numbers = scipy.linalg.cho_solve(factor, right)
        squares = float(gram[-1, -1] - right @ numbers)
        determinant += 2 * float(np.sum(np.log(np.diag(factor[0]) * size)))
        deviance = determinant - self.rank * logs[1] + self.freedom * np.log(squares)
        inverse = scipy.linalg.cho_solve(factor, np.eye(len(size))) / np.outer(size, size)
        level = max(squares / self.freedom, 1.0)
        return _Solution(numbers / size, inverse * level, float(deviance))

    def best_logs(self) -> Float[np.ndarray, "2"]:
        """Logarithms of d and of the stiffness that maximise the restricted likelihood."""
        limits = np.log([DYNAMIC_LIMITS, STIFFNESSES])
        stiffnesses = np.linspace(limits[1, 0], limits[1, 1], 7)

        def best(log_share):
            return min((self.solved([log_share, one]).deviance, one) for one in stiffnesses)

        trials = np.linspace(limits[0, 0], limits[0, 1], 9)
        first = min(trials, key=lambda one: best(one)[0])
        apart = trials[1] - trials[0]
        share = scipy.optimize.minimize_scalar(
            lambda one: best(one)[0], method="bounded", options={"xatol": 0.05},
            bounds=(max(first - apart, limits[0, 0]), min(first + apart, limits[0, 1])),
        ).x  # fmt: skip
        return np.array([share, best(share)[1]])

    def lines(self, logs) -> InfluenceLines:
        """Influence lines with their deviations, at logarithms of d and of the stiffness."""
        found = self.solved(logs)
        sizes, vectors = np.linalg.eigh(found.covariance)
        kept = sizes > KEPT * sizes.max()
        factors = (vectors[:, kept] * np.sqrt(sizes[kept])).T.reshape(-1, self.sensors, self.own)
        numbers = found.numbers.reshape(self.sensors, self.own)
        values = [table @ x for table, x in zip(self.columns, numbers, strict=True)]
        parts = [factors[:, s] @ table.T for s, table in enumerate(self.columns)]
        return self.start._replace(
            values=np.stack(values, axis=1), deviations=np.stack(parts, axis=2),
            dynamic_share=float(np.exp(logs[0])),
        )  # fmt: skip


def _hats(positions) -> Float[np.ndarray, "point knot"]:
    """Piecewise linear functions of the inner knots, at positions."""
    knots = np.linspace(positions[0], positions[-1], KNOTS)
    return np.stack([np.interp(positions, knots, hat) for hat in np.eye(KNOTS)[1:-1]], axis=1)
