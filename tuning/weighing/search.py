"""Speed, entry time and distances of axles in readings, without a guess of any of them.

For each of many speeds the readings are explained by non-negative forces that enter at many times
(a comb). Groups of neighbouring forces are axles, or several: starts divide the heaviest groups
until there are as many axles as wanted. From each start all numbers are refined by least squares,
with the forces of each point by non-negative least squares (variable projection).
"""

import dataclasses
from typing import NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines

SPEED_COUNT = 24  # candidates
ENTRY_COUNT = 160  # candidates of each speed
STARTS = 6  # speeds from which the geometry is refined
KEPT, SAME_SPEED = 4, 0.02  # geometries of a search, of speeds that differ by more (relative)
MAX_ROWS = 600  # samples of all sensors
# Of the gross weight, in an axle: fewer are what the lines lack. Steering axles of loaded lorries
# and axles of their groups have a tenth or more.
MIN_AXLE_SHARE = 0.04
MIN_GROUP_SHARE = 0.02  # likewise, of a group of forces of a comb
LIGHT_GROUPS = 0.3, 0.1  # of the heaviest group, below which groups are no starts: tried in turn
PAIR = 1.3  # m, of axles for which a group is taken: that of a tandem
FREQUENCY_STEP = 0.015  # by which the frequency of the bridge is refined, relative
FREQUENCY_SHARES = np.linspace(0.85, 1.15, 121)  # of that of the lines, tried in free vibration
MIN_CYCLES = 3.0  # of free vibration that tell its frequency
MIN_EXPLAINED = 0.5  # share of its energy that one decaying mode explains
AT_EXIT = 0.1  # of the largest mean over two cycles, below which nothing is on the bridge
MIN_GAP, MAX_GAP = 0.6, 60.0  # m, between axles: less than any tandem's, more than any vehicle's


class Found(NamedTuple):
    """Axles of a search: geometry, forces (N), and what they leave of the variance of readings.

    `lines` are those of the search, with the frequency of the bridge that explains the log best.
    """

    lines: InfluenceLines
    geometry: AxleGeometry
    forces: Float[np.ndarray, " axle"]
    misfit: float

    @property
    def is_plausible(self) -> bool:
        """Whether no axle is so light that it stands for something else."""
        return bool(self.forces.min() > MIN_AXLE_SHARE * self.forces.sum())


class AxleSearch:
    """AxleSearch for axles in the readings (SI units) of one crossing, by influence lines.

    `speeds` (m/s) are the lowest and highest possible ones, from the left or, with `both_ways`, in
    both directions.
    """

    def __init__(
        self,
        lines: InfluenceLines,
        times: Float[np.ndarray, " time"],
        readings: Float[np.ndarray, "time sensor"],
        speeds: tuple[float, float],
        both_ways: bool = False,
    ):
        stride = max(times.size * readings.shape[1] // MAX_ROWS, 1)
        self.lines, self.speeds = lines, speeds
        self.times, readings = times[::stride], readings[::stride]
        self.scale = np.maximum(readings.std(axis=0), 1e-300)
        self.target = ((readings - readings.mean(axis=0)) / self.scale).T.ravel()
        directions = (1.0, -1.0) if both_ways else (1.0,)
        tried = [sign * v for v in np.geomspace(*speeds, SPEED_COUNT) for sign in directions]
        if lines.covariance is not None and lines.frequency is not None:
            # Slow runs, by which lines are calibrated, tell little of it, the log itself much.
            self.lines = lines._replace(frequency=free_frequency(lines, self.times, readings))
        self.combs = sorted((self._comb(speed) for speed in tried), key=lambda comb: comb[0])[
            :STARTS
        ]

    def axles(self, count: int, before: Found | None = None) -> list[Found]:
        """The best of `count` axles at different speeds, the best first, KEPT at most.

        Starts are those of the combs, and of one axle less `before`. Where none is plausible, the
        best are returned nevertheless.
        """
        starts = [
            AxleGeometry(speed, places[0] / abs(speed), places - places[0], self.length)
            for _, speed, groups in self.combs
            for least in LIGHT_GROUPS
            if (places := _places(groups, count, least)) is not None
        ]
        if before is not None:
            starts += _with_one_taken_for_two(before.geometry)
        found = sorted(map(self._refined, starts), key=lambda one: one.misfit)
        plausible = [one for one in found if one.is_plausible] or found
        kept: list[Found] = []
        for one in plausible:
            speed = one.geometry.speed
            if all(abs(speed / other.geometry.speed - 1) > SAME_SPEED for other in kept):
                kept.append(one)
        return kept[:KEPT]

    def with_one_more(self, before: Found) -> list[Found]:
        """Axles of which one has been taken for two, where they are, with the best forces."""
        found = []
        for geometry in _with_one_taken_for_two(before.geometry):
            table = self._columns(geometry, before.lines)
            forces, misfit = scipy.optimize.nnls(table, self.target)
            found.append(Found(before.lines, geometry, forces, misfit**2 / self.target.size))
        return found

    @property
    def length(self) -> float:
        """Length (m) of the beam."""
        return self.lines.length

    def _columns(self, geometry: AxleGeometry, lines: InfluenceLines | None = None):
        table = (lines or self.lines).crossing(geometry, self.times) / self.scale
        return (table - table.mean(axis=0)).transpose(2, 0, 1).reshape(self.target.size, -1)

    def _comb(self, speed):
        """Misfit of a comb, its speed, and the groups (place, weight) of its forces."""
        half = self.length / abs(speed) / 2
        entries = np.linspace(self.times[0] - half, self.times[-1] - half, ENTRY_COUNT)
        places = abs(speed) * entries
        comb = AxleGeometry(speed, 0.0, places, self.length)
        weights, misfit = scipy.optimize.nnls(self._columns(comb), self.target)
        used = np.flatnonzero(weights > 1e-6 * weights.max(initial=0.0))
        groups = []
        for group in np.split(used, np.flatnonzero(np.diff(used) > 2) + 1) if used.size else []:
            weight = weights[group]
            if weight.sum() > MIN_GROUP_SHARE * weights.sum():
                groups.append((float(np.average(places[group], weights=weight)), weight.sum()))
        return float(misfit), speed, groups

    def _refined(self, start: AxleGeometry) -> Found:
        sign, count = np.sign(start.speed), start.offsets.size

        free = self.lines.covariance is not None and self.lines.frequency is not None
        frequency = self.lines.frequency or 1.0

        def geometry_at(x):
            offsets = np.append(0.0, np.cumsum(np.exp(x[2 : count + 1])))
            return AxleGeometry(sign * np.exp(x[0]), x[1], offsets, start.length)

        def lines_at(x):
            return self.lines._replace(frequency=frequency * np.exp(x[-1])) if free else self.lines

        def residual(x):
            table = self._columns(geometry_at(x), lines_at(x))
            return table @ scipy.optimize.nnls(table, self.target)[0] - self.target

        gaps = np.log(np.clip(np.diff(start.offsets), 1.001 * MIN_GAP, 0.999 * MAX_GAP))
        first = np.array([np.log(abs(start.speed)), start.entry_time, *gaps, *[0.0] * free])
        low, high = np.log(np.array(self.speeds) * [0.9, 1.1])
        least = np.array(
            [low, -np.inf, *np.full(count - 1, np.log(MIN_GAP)), *[-FREQUENCY_STEP] * free]
        )
        most = np.array(
            [high, np.inf, *np.full(count - 1, np.log(MAX_GAP)), *[FREQUENCY_STEP] * free]
        )
        passage = start.length / abs(start.speed)
        found = scipy.optimize.least_squares(
            residual, np.clip(first, least + 1e-9, most - 1e-9), bounds=(least, most),
            x_scale=np.array([0.1, 0.1 * passage, *np.full(count - 1, 0.3), *[0.01] * free]),
            diff_step=1e-5, max_nfev=30,
        )  # fmt: skip
        geometry = geometry_at(found.x)
        lines = lines_at(found.x)
        forces = scipy.optimize.nnls(self._columns(geometry, lines), self.target)[0]
        return Found(lines, geometry, forces, float(2 * found.cost / self.target.size))


def free_frequency(
    lines: InfluenceLines,
    times: Float[np.ndarray, " time"],
    readings: Float[np.ndarray, "time sensor"],
) -> float | None:
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

    best = max((first * FREQUENCY_SHARES).tolist(), key=explained)
    return best if explained(best) > MIN_EXPLAINED else first


def _places(groups, count, least) -> np.ndarray | None:
    """Places (m) of `count` axles: the heaviest groups, of which the heaviest are several axles.

    Groups lighter than a share `least` of the heaviest do not count.
    """
    if not groups:
        return None
    heavy = sorted(groups, key=lambda group: -group[1])[:count]
    heavy = [group for group in heavy if group[1] >= least * heavy[0][1]]
    pieces = np.ones(len(heavy), int)
    while pieces.sum() < count:
        pieces[np.argmax([group[1] / n for group, n in zip(heavy, pieces, strict=True)])] += 1
    places = [
        place + PAIR * (k - (n - 1) / 2)
        for (place, _), n in zip(heavy, pieces.tolist(), strict=True)
        for k in range(n)
    ]
    return np.sort(places)


def _with_one_taken_for_two(geometry: AxleGeometry) -> list[AxleGeometry]:
    """Geometries with two axles in the place of one of those of a geometry."""
    found = []
    for i, at in enumerate(geometry.offsets):
        offsets = np.sort([*np.delete(geometry.offsets, i), at - PAIR / 2, at + PAIR / 2])
        entry = geometry.entry_time + offsets[0] / abs(geometry.speed)
        moved = dataclasses.replace(geometry, entry_time=entry, offsets=offsets - offsets[0])
        found.append(moved)
    return found
