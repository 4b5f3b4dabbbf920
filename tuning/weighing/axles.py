"""Axle loads and spacings of a vehicle or train from readings of a bridge.

Influence lines and first modes, of the model or calibrated by known vehicles, serve all steps: the
search of speed, entry time and distances, Moses' method, and the fit, in which dynamic wheel forces
on an unknown road and errors of calibrated lines are noise (`axle_fit`).

The search has no initial guesses. Readings of two sensors are y_1 = u_1 * F and y_2 = u_2 * F, with
the readings u of one force that crosses at a speed, and the train of axles F: at the right speed
y_1 * u_2 = y_2 * u_1, whatever the axles (the cross relation of blind identification, Xu, Liu, Tong
and Kailath 1995, DOI 10.1109/78.476442). A single sensor has the speed at which non-negative forces
that enter at many times (a comb) leave least. Neighbouring forces of a comb at this speed are one
axle. All axles are then fitted, the comb is repeated with the weights of the fit, which see the
kinks of the lines through vibration, and axles are one by one split or left out, as long as the
number becomes more likely (`AxleFit.criterion`).
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import refuses_traced
from jaxbeam.case.loads.axles import Axles
from jaxbeam.runtime.printer import counted, text_table
from tuning.fit.dataset import sensor_readings
from tuning.logs.log import Log
from tuning.weighing.axle_fit import (
    GROUP_MEAN,
    AxleFit,
    AxleTrain,
    CrossingLog,
    axle_groups,
    fit_axles,
    interpolated,
    refined,
    telling_sensors,
    unlikeliness,
)
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines, lines_for
from tuning.weighing.weigh import MosesFit, moses

SPEED_STEP, SINGLE_STEP = 0.01, 0.04  # of the speeds tried, relative; with a single sensor
NEAR = 0.97, 0.985, 1.0, 1.015, 1.03  # times this speed, tried by combs
SPACING, SPACING_FRACTION = 0.35, 0.05  # m, between the forces of combs; of a beam at most
MOST_AXLES = 9  # of a comb: the heaviest
JOINED = 15 / 7  # spacings of a comb between forces of one axle: 0.75 m
LEAST_AXLE = 0.1  # force of an axle of a comb over that of the heaviest
ROUNDS = 2  # of fewer and of more axles
LEAST_GAIN = 1.0  # decrease of the criterion for which a change of axles is kept
TRIED = 3  # best changes, which are fitted
COMBS = 3  # fitted one after the other
FREQUENCY_RATIOS = np.linspace(0.85, 1.15, 121)  # to that of the lines, tried in free vibration
MIN_CYCLES = 3.0  # of free vibration from which its frequency is found
MIN_EXPLAINED = 0.5  # fraction of its energy that one decaying mode explains
AT_EXIT = 0.1  # of the largest mean over two cycles, below which nothing is on the bridge
MAX_ROWS = 600  # samples of all sensors in a comb
MOST_EXCESS = 1.5  # of the variance of residuals, above which axles or lines are unlikely
# Of two combs at once: speeds, relative; m; samples.
PAIR_STEP, PAIR_SPACING, PAIR_ROWS = 0.06, 0.7, 300


class _Comb(NamedTuple):
    """Comb of forces: misfit (fraction of the variance), speed (m/s), places (m), forces (N)."""

    misfit: float
    speed: float
    places: Float[np.ndarray, " force"]
    forces: Float[np.ndarray, " force"]


def find_axles(
    lines: InfluenceLines,
    log: CrossingLog,
    speeds: tuple[float, float],
    both_ways: bool = False,
    number: int | None = None,
) -> tuple[dict[int, AxleFit], dict[int, float]]:
    """Best fits by number of axles, and criteria of all numbers that were tried.

    The fits include the given `number`, if any. `speeds` (m/s) are the lowest and highest possible
    ones, from the left or, with `both_ways`, in both directions. Empty if nothing crosses.
    """
    comb = _best_comb(lines, log, speeds, both_ways)
    fit, fits, tried = None, {}, {}
    for _ in range(COMBS):  # with the weights of the previous fit
        places, forces = _axles_of(comb, _spacing(lines))
        if places.size == 0:
            return {}, {}
        speed = abs(comb.speed)
        log.speed = speed
        start = AxleGeometry(comb.speed, places[0] / speed, places - places[0], lines.length)
        own = fit_axles(lines, start, forces, log, fit and fit.weights)
        if fit is None or own.criterion < fit.criterion:
            fit = own
        former = fits.get(own.forces.size)
        if former is None or own.criterion < former.criterion:
            fits[own.forces.size] = own
        comb = _weighted_comb(fit, log)
    assert fit is not None
    log.speed = abs(fit.geometry.speed)
    while number and fit.forces.size != number:
        change = _with_one_more if fit.forces.size < number else _with_one_less
        best = _changed(_Trial.of(fit), change, fit, log)
        fit = fits[best.forces.size] = fit_axles(lines, *best[1:], log, fit.weights)
    less, more = _with_one_less, _with_one_more
    # A given number is kept by pairs of changes.
    changes = ((less, more), (more, less)) if number else ((less,), (more,))
    for steps in ROUNDS * (*changes, (_with_one_moved,)):
        while fit.forces.size > 1 or steps[0] is more:
            trial = _Trial.of(fit)
            for change in steps:
                trial = _changed(trial, change, fit, log)
            count = trial.forces.size
            tried[count] = min(trial.criterion, tried.get(count, np.inf))
            if count > MOST_AXLES or trial.criterion > fit.criterion - LEAST_GAIN:
                break
            own = fit_axles(lines, *trial[1:], log, fit.weights)
            if count not in fits or own.criterion < fits[count].criterion:
                fits[count] = own
            if most_likely({0: fit, 1: own}) is fit:
                break
            fit = own
    return fits, tried | {count: own.criterion for count, own in fits.items()}


def most_likely(fits: dict[int, AxleFit]) -> AxleFit:
    """Fit with the most likely number of axles."""
    return min(fits.values(), key=lambda fit: (not fit.is_plausible, fit.criterion))


class _Trial(NamedTuple):
    """Trial axles with the weights of a fit, and their criterion."""

    criterion: float
    geometry: AxleGeometry
    forces: Float[np.ndarray, " axle"]

    @classmethod
    def of(cls, fit: AxleFit) -> "_Trial":
        return cls(fit.criterion, fit.geometry, fit.forces)


def _changed(trial: _Trial, change, fit: AxleFit, log: CrossingLog) -> _Trial:
    """Best trial after a change of the axles of a trial, with the weights of a fit."""
    speed, ranked = trial.geometry.speed, []
    for places in change(trial.geometry.offsets, trial.forces):
        entry = trial.geometry.entry_time + places[0] / abs(speed)
        geometry = AxleGeometry(speed, entry, places - places[0], fit.lines.length)
        ranked.append((*log.linear(fit.lines, geometry, fit.weights), geometry))
    ranked.sort(key=lambda one: one[0] + unlikeliness(fit.rows, one[2].offsets, one[1]))
    trials = []
    for _, forces, start in ranked[:TRIED]:
        deviance, geometry, forces = refined(fit, start, forces, log)
        new = unlikeliness(fit.rows, geometry.offsets, forces)
        trials.append(_Trial(deviance + new, geometry, forces))
    return min(trials, key=lambda one: one.criterion)


def _with_one_less(places, forces) -> list[np.ndarray]:
    """Trial places with one axle fewer: one is left out, or joined with the next."""
    trials = []
    for i in range(places.size):
        trials.append(np.delete(places, i))
        if i + 1 < places.size:
            share = forces[i + 1] / max(float(forces[i : i + 2].sum()), 1e-300)
            joined = np.delete(places, i + 1)
            joined[i] += share * (places[i + 1] - places[i])
            trials.append(joined)
    return trials


def _with_one_more(places, forces) -> list[np.ndarray]:
    """Trial places with one axle more: one axle, or a group, becomes a group of one more."""
    trials = []
    for group in axle_groups(places):
        for own in [group] if len(group) == 1 else [group, *([i] for i in group)]:
            middle = np.average(places[own], weights=np.maximum(forces[own], 1e-300))
            new = middle + GROUP_MEAN * (np.arange(len(own) + 1) - len(own) / 2)
            trials.append(np.sort(np.concatenate([np.delete(places, own), new])))
    return trials


def _with_one_moved(places, forces) -> list[np.ndarray]:
    """Trial places with one axle moved: one is left out, and a group gets one more."""
    trials = []
    for i in range(places.size):
        trials += _with_one_more(np.delete(places, i), np.delete(forces, i))
    return trials


def _best_comb(lines: InfluenceLines, log: CrossingLog, speeds, both_ways: bool) -> _Comb:
    """Comb of the best speed."""
    stride = max(log.times.size * log.readings.shape[1] // MAX_ROWS, 1)
    times, readings = log.times[::stride], log.readings[::stride]
    scale, spacing = np.maximum(readings.std(axis=0), 1e-300), _spacing(lines)
    target = ((readings - readings.mean(axis=0)) / scale).T.ravel()

    def comb(speed) -> _Comb:
        low, high = log.places(speed, lines.length)
        places = np.arange(low, high + spacing, spacing)
        table = lines.crossing(AxleGeometry(speed, 0.0, places, lines.length), times) / scale
        rows = (table - table.mean(axis=0)).transpose(2, 0, 1).reshape(target.size, -1)
        forces, misfit = scipy.optimize.nnls(rows, target)
        used = forces > 1e-6 * forces.max(initial=0.0)
        return _Comb(float(misfit**2 / target.size), speed, places[used], forces[used])

    single = readings.shape[1] == 1
    step = SINGLE_STEP if single else SPEED_STEP
    count = int(np.ceil(np.log(speeds[1] / speeds[0]) / step)) + 1
    directions = (1.0, -1.0) if both_ways else (1.0,)
    tried = [
        sign * float(v) for v in np.geomspace(speeds[0], speeds[1], count) for sign in directions
    ]
    if single:
        best = min((comb(speed) for speed in tried), key=lambda one: one.misfit).speed
    else:
        even = np.linspace(times[0], times[-1], times.size)
        table = np.stack([np.interp(even, times, own) for own in readings.T], axis=1)
        best = min(tried, key=lambda speed: _cross_relation(lines, even, table, speed))
    return min((comb(best * near) for near in NEAR), key=lambda one: one.misfit)


def two_trains(
    lines: InfluenceLines, log: CrossingLog, speeds: tuple[float, float], both_ways: bool
) -> list[AxleTrain]:
    """Two trains of axles of two speeds that explain readings best, each by a comb of forces."""
    stride = max(log.times.size * log.readings.shape[1] // PAIR_ROWS, 1)
    times, readings = log.times[::stride], log.readings[::stride]
    scale = np.maximum(readings.std(axis=0), 1e-300)
    target = ((readings - readings.mean(axis=0)) / scale).T.ravel()
    count = int(np.ceil(np.log(speeds[1] / speeds[0]) / PAIR_STEP)) + 1
    directions = (1.0, -1.0) if both_ways else (1.0,)
    tables = {}
    for speed in np.outer(directions, np.geomspace(*speeds, count)).ravel().tolist():
        low, high = log.places(speed, lines.length)
        places = np.arange(low, high + PAIR_SPACING, PAIR_SPACING)
        table = lines.crossing(AxleGeometry(speed, 0.0, places, lines.length), times) / scale
        rows = (table - table.mean(axis=0)).transpose(2, 0, 1).reshape(target.size, -1)
        tables[speed] = places, rows

    def misfit(*pair):
        return scipy.optimize.nnls(np.hstack([tables[speed][1] for speed in pair]), target)

    first = min(tables, key=lambda speed: misfit(speed)[1])
    second = min(tables, key=lambda speed: misfit(first, speed)[1])
    first = min(tables, key=lambda speed: misfit(speed, second)[1])
    forces, left = misfit(first, second)
    found, begin = [], 0
    for speed in (first, second):
        places = tables[speed][0]
        own, begin = forces[begin : begin + places.size], begin + places.size
        used = own > 1e-6 * own.max(initial=0.0)
        comb = _Comb(float(left), speed, places[used], own[used])
        at, own = _axles_of(comb, PAIR_SPACING)
        if at.size:
            geometry = AxleGeometry(speed, at[0] / abs(speed), at - at[0], lines.length)
            found.append(AxleTrain(lines, geometry, own, lines.dynamic_share))
    return found


def _weighted_comb(fit: AxleFit, log: CrossingLog) -> _Comb:
    """Comb of the best speed near that of a fit, with the weights of the fit."""
    shifts, target = fit.weights(log.shifts), fit.weights(log.target)
    basis, spacing = np.linalg.qr(shifts)[0], _spacing(fit.lines)

    def comb(speed) -> _Comb:
        low, high = log.places(speed, fit.lines.length)
        places = np.arange(low, high + spacing, spacing)
        at = AxleGeometry(speed, 0.0, places, fit.lines.length)
        rows = fit.weights(log.rows(fit.lines.crossing(at, log.times)))
        rows, own = rows - basis @ (basis.T @ rows), target - basis @ (basis.T @ target)
        forces, misfit = scipy.optimize.nnls(rows, own)
        used = forces > 1e-6 * forces.max(initial=0.0)
        return _Comb(float(misfit**2), speed, places[used], forces[used])

    return min((comb(fit.geometry.speed * near) for near in NEAR), key=lambda one: one.misfit)


def _cross_relation(lines: InfluenceLines, times, readings, speed: float) -> float:
    """Squares of y_1 * u_2 - y_2 * u_1 of all pairs of sensors over the squares of its terms."""
    still = AxleGeometry(speed, float(times[0]), np.zeros(1), lines.length)
    unit = lines.crossing(still, times)[:, 0]
    size = 2 * times.size
    level = np.median(readings[: max(times.size // 20, 3)], axis=0)
    Y, U = np.fft.rfft(readings - level, size, axis=0), np.fft.rfft(unit, size, axis=0)
    products = Y[:, :, None] * U[:, None, :]
    unlike = products - products.transpose(0, 2, 1)
    terms = np.sum(np.abs(products) ** 2) - np.sum(np.abs(Y * U) ** 2)
    return float(np.sum(np.abs(unlike) ** 2) / max(2 * terms, 1e-300))


def _spacing(lines: InfluenceLines) -> float:
    """Spacing (m) of the forces of combs on a beam."""
    return min(SPACING, SPACING_FRACTION * float(lines.length))


def _axles_of(comb: _Comb, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Places (m) and forces (N) of the heaviest axles of a comb; neighbouring forces are joined."""
    if comb.places.size == 0:
        return comb.places, comb.forces
    parts = np.flatnonzero(np.diff(comb.places) > JOINED * spacing) + 1
    groups = np.split(np.arange(comb.places.size), parts)
    forces = np.array([comb.forces[own].sum() for own in groups])
    places = np.array([np.average(comb.places[own], weights=comb.forces[own]) for own in groups])
    order = np.argsort(-forces)[:MOST_AXLES]
    order = np.sort(order[forces[order] > LEAST_AXLE * forces.max()])
    return places[order], forces[order]


def with_free_frequency(
    lines: InfluenceLines,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
) -> InfluenceLines:
    """Calibrated lines with the first frequency found in the free vibration after a crossing.

    Slow runs, by which lines are calibrated, contain little vibration.
    """
    if lines.deviations is None or lines.frequency is None:
        return lines
    change = np.log(_free_frequency(lines, times, readings) / lines.frequency)
    return lines.tuned(change * (np.arange(len(lines.modes)) == 0))


def _free_frequency(
    lines: InfluenceLines,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
) -> float:
    """Frequency (Hz) of the free vibration after a crossing; that of the lines if none is clear."""
    first = lines.frequency
    assert first is not None
    step = (times[-1] - times[0]) / (times.size - 1)
    cycle = max(round(1 / (first * step)), 1)
    level = readings - np.median(readings[: max(cycle, times.size // 20)], axis=0)
    twice = np.convolve(np.ones(cycle), np.ones(cycle)) / cycle**2
    smooth = np.abs([np.convolve(own, twice, "same") for own in level.T]).T[:-cycle]
    on = np.flatnonzero(np.any(smooth > AT_EXIT * smooth.max(axis=0), axis=1))
    begin = int(on[-1]) + 1 if on.size else 0
    rest = level[begin:] - level[begin:].mean(axis=0)
    if len(rest) < MIN_CYCLES * cycle:
        return first
    since = times[begin:] - times[begin]

    assert lines.damping_ratios is not None
    damping = float(lines.damping_ratios[0])

    def explained(frequency):
        w = 2 * np.pi * frequency
        wave = np.exp((1j * np.sqrt(1 - damping**2) - damping) * w * since)
        basis = np.linalg.qr(np.stack([wave.real, wave.imag, np.ones(since.size)], axis=1))[0]
        return float(np.sum((basis.T @ rest) ** 2) / max(np.sum(rest**2), 1e-300))

    best = max((first * FREQUENCY_RATIOS).tolist(), key=explained)
    return best if explained(best) > MIN_EXPLAINED else first


@dataclasses.dataclass(frozen=True, eq=False)
class AxleWeighing:
    """Axle loads found in a log, and those of Moses' method at the same geometry.

    `case` has the axles found as its load. `bic` are criteria by number of axles, of which the
    lowest is taken; empty if the number was given.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 8e9, 12e3, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(10.0, noise=2e-5)],
    ...     loads=[jb.MovingForce(force=1e5, speed=20.0)],
    ...     run=jb.Run(1.6, sample_rate=50.0),
    ... )
    >>> record = jb.simulate(case)
    >>> columns = ("w",), ("deflection",), ("m",), "log", (0,)
    >>> log = tuning.Log(record.times, record.measured, *columns)
    >>> found = tuning.weighing.weigh_axles(case, log, (10.0, 30.0), axles=1)
    >>> print(f"{found.fit.gross_weight[0] / 1e3:.0f} kN")
    100 kN
    """

    case: Case
    fit: AxleFit
    moses: MosesFit
    bic: dict[int, float]

    @property
    def load(self) -> Axles:
        """The axles found."""
        load = self.case.loads[0]
        assert isinstance(load, Axles)
        return load

    @property
    def intervals(self) -> Float[np.ndarray, "parameter 2"]:
        """95 % intervals of axle forces (N), speed (m/s), entry time (s), offsets (m)."""
        half = self.fit.half_widths
        return np.stack([self.fit.values - half, self.fit.values + half], axis=1)

    @property
    def groups(self) -> list[list[int]]:
        """Axles (from 0) of groups, each less than 2.2 m behind the one before."""
        return self.fit.groups

    def to_dict(self) -> dict:
        """Axle loads with intervals by both methods, groups, spacings, speed (SI), for JSON."""
        fit, count = self.fit, self.fit.forces.size
        numbers = _numbers(fit.values, fit.errors, self.intervals)
        by_moses = _numbers(self.moses.forces, self.moses.errors, self.moses.intervals)
        return {
            "axles": numbers[:count],
            "groups": [{"axles": own, **_of_weight(fit.group_weight(own))} for own in self.groups],
            "gross_weight": _of_weight(fit.gross_weight),
            "speed": numbers[count],
            "entry_time": numbers[count + 1],
            "offsets": numbers[count + 2 :],
            "moses": {"axles": by_moses, "gross_weight": _of_weight(self.moses.gross_weight)},
            "dynamic_fraction": fit.dynamic_share,
            "excess_variance": fit.excess,
            "bic": {str(number): value for number, value in self.bic.items()},
        }

    def __str__(self) -> str:
        fit, count = self.fit, self.fit.forces.size
        rows = [
            (
                str(i + 1),
                f"{fit.geometry.offsets[i]:.4g}",
                f"{fit.forces[i] / 1e3:.4g}",
                "{:.4g} to {:.4g}".format(*self.intervals[i] / 1e3),
                f"{self.moses.forces[i] / 1e3:.4g}",
                "{:.4g} to {:.4g}".format(*self.moses.intervals[i] / 1e3),
            )
            for i in range(count)
        ]
        header = ("axle", "at (m)", "load (kN)", "95 % interval", "Moses (kN)", "95 % interval")
        (gross, error), (by_moses, moses_error) = fit.gross_weight, self.moses.gross_weight
        criteria = ", ".join(f"{n}: {value:.1f}" for n, value in self.bic.items())
        lines = [
            f"{counted(count, 'axle')} found, at {fit.geometry.speed:.4g} m/s",
            *text_table(header, rows, ">>><><"),
            f"gross weight {gross / 1e3:.5g} kN, standard error {error / 1e3:.3g} kN; by"
            f" Moses' method {by_moses / 1e3:.5g} kN, standard error {moses_error / 1e3:.3g} kN",
            f"intervals allow for dynamic wheel forces of {fit.dynamic_share:.2g} of the static"
            " ones (standard deviation)",
        ]
        if fit.excess > MOST_EXCESS:
            lines.append(
                f"residuals have {fit.excess:.3g} times the variance that noise and dynamic wheel"
                " forces give them: number of axles, range of speeds, signs of sensors or influence"
                " lines are wrong, and intervals too narrow; calibrate by more runs"
            )
        if self.bic:
            lines.append(
                f"criterion by number of axles, of which the lowest is taken: {criteria}"
                "  [--axles NUMBER]"
            )
        return "\n".join(lines)


def _numbers(values, errors, intervals) -> list[dict]:
    return [
        {"value": float(value), "standard_error": float(error), "interval_95": pair.tolist()}
        for value, error, pair in zip(values, errors, intervals, strict=True)
    ]


def _of_weight(weight: tuple[float, float]) -> dict:
    return {"value": weight[0], "standard_error": weight[1]}


@refuses_traced("a weighing")
def weigh_axles(
    case: Case,
    log: Log,
    speeds: tuple[float, float],
    axles: int | None = None,
    *,
    both_ways: bool = False,
    influence_lines: InfluenceLines | None = None,
) -> AxleWeighing:
    """Forces and distances of the axles of one vehicle or train that crossed a known beam in a log.

    `speeds` (m/s) are the lowest and highest possible ones, from the left or, with `both_ways`, in
    both directions; `axles` is their number, by default the most likely one, at most 9. All steps
    use the `influence_lines`, by default those of the case (see `calibrate_influence_lines`).
    Loads and profile of case and log are not used. An axle has at least a twenty-fifth of the gross
    weight, unless no others explain the readings. Distances and weights are sought as road and rail
    vehicles have them: on a rig of a laboratory use `tuning.identify`.

    Raises ValueError if speeds are not 0 < low < high, there is no axle, a sensor measures velocity
    or acceleration, the influence lines are of other sensors, no sensor has readings that vary, or
    nothing crosses in the log.

    >>> import jaxbeam as jb
    >>> import tuning
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 8e9, 12e3, damping_ratio=0.02, modes=1),
    ...     sensors=[jb.Sensor(10.0, noise=2e-5)],
    ...     loads=[jb.MovingForce(force=1e5, speed=20.0)],
    ...     run=jb.Run(1.6, sample_rate=50.0),
    ... )
    >>> record = jb.simulate(case)
    >>> columns = ("w",), ("deflection",), ("m",), "log", (0,)
    >>> log = tuning.Log(record.times, record.measured, *columns)
    >>> found = tuning.weighing.weigh_axles(case, log, (10.0, 30.0), axles=1)
    >>> print(f"{found.load.forces[0] / 1e3:.0f} kN at {found.load.speed:.1f} m/s")
    100 kN at 20.0 m/s
    """
    low, high = speeds
    if not 0 < low < high:
        raise ValueError(f"speeds must be 0 < low < high in m/s; they are {low:g} and {high:g}")
    if axles is not None and axles < 1:
        raise ValueError(f"the number of axles must be 1 or more, not {axles}")
    case = dataclasses.replace(case, loads=(), vehicle_sensors=(), profile=None)
    lines = lines_for(case, influence_lines)
    readings, valid = sensor_readings(case, log)
    telling = telling_sensors(readings, valid)
    if not telling.any():
        raise ValueError(f"{log.source}: no sensor has valid readings that vary: take another log")
    readings = interpolated(log.times, readings, valid)[:, telling]
    valid = valid[:, telling]
    lines = with_free_frequency(lines.of_sensors(telling), log.times, readings)
    crossing = CrossingLog(log.times, readings, valid)
    fits, tried = find_axles(lines, crossing, speeds, both_ways, axles)
    if not fits:
        raise ValueError(
            f"{log.source}: no load is found in it at {low:g} to {high:g} m/s: other speeds,"
            " or sensors of the opposite sign?"
        )
    criteria = dict(sorted(tried.items())) if axles is None else {}
    fit = fits[axles] if axles else most_likely(fits)
    static = moses(
        lines, fit.geometry, crossing.times, crossing.readings, crossing.valid, found=True
    )
    geometry = fit.geometry
    load = Axles(
        offsets=geometry.offsets,
        forces=np.maximum(fit.forces, 1e-6 * fit.forces.sum()),
        speed=geometry.speed,
        entry_time=geometry.entry_time,
    )
    return AxleWeighing(dataclasses.replace(case, loads=(load,)), fit, static, criteria)
