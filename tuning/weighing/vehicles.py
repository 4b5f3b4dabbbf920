"""Vehicles on a beam in a part of a log: one by one, one behind the other, or meeting each other.

The axles of one speed are found first (`axles`). A gap too long for one vehicle separates two.
If residuals exceed noise and dynamic wheel forces, or these forces exceed those of usual roads, two
trains of axles of two speeds are tried instead. Each vehicle is then weighed in the readings less
those of the others, whose parameters get a wide prior, so that its covariance is the marginal one.
Two vehicles are taken if they are more likely than one. Detectors give number and places of axles.

Detectors are strain gauges under the deck, tubes, loops or piezoelectric strips across the road,
which give a pulse for each axle. The pulses of a vehicle reach the second detector in the pattern
of the first, later by one delay: the peak of the cross-correlation of both signals. The sign of the
delay is the direction. The largest set of pulses with one delay is removed as a vehicle, then the
next: vehicles may overtake or meet.
"""

import copy

import numpy as np
import scipy.optimize
import scipy.signal
from jaxtyping import Float

from tuning.weighing.axle_fit import AxleFit, AxleTrain, CrossingLog, fit_axles, unlikeliness
from tuning.weighing.axles import MOST_EXCESS, find_axles, most_likely, two_trains
from tuning.weighing.influence_lines import AxleGeometry, InfluenceLines

LEAST_PULSE = 6.0, 0.15  # smallest pulse: times the noise; fraction of the largest pulse
MOST_GAP = 12.0  # m, between the axles of one vehicle
LEAST_GAP = 0.6  # m, between axles
TOLERANCE = 0.2  # m, of the place of an axle, by a varying speed and the width of pulses


def pulse_times(
    times: Float[np.ndarray, " time"], signal: Float[np.ndarray, " time"], apart: float
) -> Float[np.ndarray, " pulse"]:
    """Times (s) of the pulses of a detector, of either sign, at least `apart` (s) from each other.

    `times` (s) are those of the samples of the `signal`, whose unit does not matter.

    >>> times = np.arange(200) / 100
    >>> signal = np.exp(-(((times - 0.502) / 0.02) ** 2))
    >>> print(pulse_times(times, signal, 0.1).round(3))
    [0.502]
    """
    step = float(times[-1] - times[0]) / (times.size - 1)
    level = signal - np.median(signal)
    # A median filter removes the slow bending of the deck and leaves the pulses.
    wide = max(2 * round(apart / step) + 1, 5)
    level = level - scipy.signal.medfilt(level, min(2 * wide + 1, level.size - 1 | 1))
    level *= np.sign(level[np.argmax(np.abs(level))])
    noise = 1.4826 * float(np.median(np.abs(level)))
    least = max(LEAST_PULSE[0] * noise, LEAST_PULSE[1] * float(level.max()))
    peaks = scipy.signal.find_peaks(level, max(least, 1e-300), distance=max(apart / step, 1))[0]
    peaks = peaks[(peaks > 0) & (peaks < level.size - 1)]
    low, middle, high = level[peaks - 1], level[peaks], level[peaks + 1]
    bend = np.maximum(2 * middle - low - high, 1e-300)
    return times[peaks] + step * np.clip((high - low) / (2 * bend), -0.5, 0.5)


def axles_of_pulses(
    pulses: tuple[Float[np.ndarray, " first"], Float[np.ndarray, " second"]],
    places: tuple[float, float],
    speeds: tuple[float, float],
    length: float,
) -> list[AxleGeometry]:
    """Axles of vehicles from `pulses` (s) of two detectors at `places` (m) on a beam of a `length`.

    `speeds` (m/s) are the lowest and highest ones, in both directions. Pulses that have no partner
    at the other detector are left out.

    >>> first, second = np.array([1.0, 1.2]), np.array([1.5, 1.7])
    >>> (found,) = axles_of_pulses((first, second), (5.0, 15.0), (10.0, 30.0), 20.0)
    >>> print(f"{found.speed:.1f} m/s, axles {found.offsets[1]:.1f} m apart")
    20.0 m/s, axles 4.0 m apart
    """
    first, second = (np.sort(one) for one in pulses)
    apart = places[1] - places[0]
    found = []
    while True:
        best: tuple[float, list[tuple[int, int]]] = (0.0, [])
        for i in range(first.size):
            for k in range(second.size):
                delay = second[k] - first[i]
                if delay == 0 or not speeds[0] <= abs(apart / delay) <= speeds[1]:
                    continue
                pairs = _train(first, second, i, k, abs(apart / delay))
                delays = np.array([second[b] - first[a] for a, b in pairs])
                # Among sets of equally many pairs, the one with the smallest spread of delays.
                score = len(pairs) - float(delays.std()) * abs(apart / delay) / TOLERANCE / 2
                if score > best[0]:
                    best = score, pairs
        if not best[1]:
            return sorted(found, key=lambda one: one.entry_time)
        own, other = (np.array([pair[i] for pair in best[1]]) for i in (0, 1))
        found.append(_vehicle(first[own], second[other], places, length))
        first, second = np.delete(first, own), np.delete(second, other)


def _train(first, second, i: int, k: int, speed: float) -> list[tuple[int, int]]:
    """Indices of pairs of pulses with about the delay of pair (i, k): the axles of a vehicle."""
    delay, pairs = second[k] - first[i], [(i, k)]
    for way in (1, -1):
        last, at = first[i], i + way
        while 0 <= at < first.size and abs(first[at] - last) * speed < MOST_GAP:
            near = int(np.argmin(np.abs(second - first[at] - delay)))
            late = abs(second[near] - first[at] - delay) * speed
            if late < TOLERANCE and near not in [b for _, b in pairs]:
                pairs.append((at, near))
                last = first[at]
            at += way
    return sorted(pairs)


def _vehicle(first, second, places: tuple[float, float], length: float) -> AxleGeometry:
    """Axles of one vehicle from the times (s) of its pulses at both detectors."""
    speed = (places[1] - places[0]) / float(np.mean(second - first))
    # Entry time of each axle, from both detectors.
    start = 0.0 if speed > 0 else length
    entries = (first - (places[0] - start) / speed + second - (places[1] - start) / speed) / 2
    offsets = abs(speed) * (entries - entries[0])
    return AxleGeometry(speed, float(entries[0]), offsets, length)


MOST_SHARE = 2.0  # times the usual dynamic wheel forces
ROUNDS = 2  # of weighing each vehicle in the readings less those of the others
NEAR = 0.88, 1.12  # range of speeds of a second search, over the speed of a vehicle
# Standard deviations of places of axles by detectors (m), and of their speed (relative).
SEEN, SEEN_SPEED = 0.05, 0.02


def vehicles_in(
    lines: InfluenceLines,
    log: CrossingLog,
    speeds: tuple[float, float],
    both_ways: bool = True,
    seen: list[AxleGeometry] | None = None,
    least_weight: float = 0.0,
) -> list[AxleFit]:
    """Vehicles in a part of a log, in the order of their entries; empty if nothing crosses.

    `speeds` (m/s) are the lowest and highest ones, from the left or, with `both_ways`, in both
    directions; `seen` are the axles by detectors, if there are any. Of several vehicles, those
    below the `least_weight` (N) are left out.

    >>> import numpy as np
    >>> from tuning.weighing.axle_fit import CrossingLog
    >>> from tuning.weighing.influence_lines import InfluenceLines
    >>> lines = InfluenceLines(np.array([0.0, 5, 10]), np.array([[0.0], [-1e-8], [0]]))
    >>> times = np.arange(200) / 100
    >>> readings = 5e4 * lines.at(20 * (times - 0.5)) + 1e-6 * np.sin(1e3 * times[:, None])
    >>> log = CrossingLog(times, readings, np.ones((200, 1), bool))
    >>> (found,) = vehicles_in(lines, log, (10.0, 30.0), both_ways=False)
    >>> print(f"{found.gross_weight[0] / 1e3:.0f} kN at {found.geometry.speed:.0f} m/s")
    50 kN at 20 m/s
    """
    if seen is not None:
        start = [AxleTrain(lines, at, np.ones(at.offsets.size), lines.dynamic_share) for at in seen]
        return _weighed(log, _with_forces(log, start), _seen, least_weight)
    fits, _ = find_axles(lines, log, speeds, both_ways)
    if not fits:
        return []
    alone = most_likely(fits)
    parts = _separated(alone)
    found = [alone] if len(parts) == 1 else _weighed(log, parts, _found_again, least_weight)
    usual = MOST_SHARE * lines.dynamic_share
    if alone.is_plausible and max(alone.excess / MOST_EXCESS, alone.dynamic_share / usual) < 1:
        return found
    pair = _weighed(log, two_trains(lines, log, speeds, both_ways), _found_again, least_weight)
    if len(pair) > 1 and _criterion(pair) < _criterion(found):
        found = pair
    return sorted(found, key=lambda fit: fit.geometry.entry_time)


def _criterion(fits: list[AxleFit]) -> float:
    """Criterion (see `AxleFit.criterion`) of all vehicles together; lower is better.

    That of the last vehicle is conditional on the others; each of these adds its penalty.
    """
    *others, last = fits
    more = [unlikeliness(fit.rows, fit.geometry.offsets, fit.forces) for fit in others]
    return last.criterion + sum(more)


def _weighed(
    log: CrossingLog, trains: list[AxleTrain], weigh, least_weight: float
) -> list[AxleFit]:
    """Vehicles of trains, each weighed by `weigh` in the log less the readings of the others."""
    fits: list[AxleFit] = []
    for _ in range(ROUNDS if len(trains) > 1 else 1):
        fits = []
        for train in trains[:]:
            own = copy.copy(log)
            for other in trains:
                own = own if other is train else own.without(other)
            fit = weigh(own, train)
            at = [one is train for one in trains].index(True)
            if fit is None or len(trains) > 1 and fit.gross_weight[0] < least_weight:
                del trains[at]
                continue
            fits.append(fit)
            trains[at] = AxleTrain(fit.lines, fit.geometry, fit.forces, fit.dynamic_share)
    return fits


def _found_again(log: CrossingLog, train: AxleTrain) -> AxleFit | None:
    """Axles of a train, found again near its speed; None if there are none."""
    speed = train.geometry.speed
    fits, _ = find_axles(train.lines, log, (NEAR[0] * speed, NEAR[1] * speed))
    return most_likely(fits) if fits else None


def _seen(log: CrossingLog, train: AxleTrain) -> AxleFit:
    """Vehicle fitted from the axles of a train, with their places by detectors as a prior."""
    at = train.geometry
    speed, more = abs(at.speed), at.offsets.size - 1
    log.seen = at, np.array([SEEN_SPEED * speed, SEEN / speed, *(SEEN * np.ones(more))])
    return fit_axles(train.lines, at, train.forces, log)


def _with_forces(log: CrossingLog, trains: list[AxleTrain]) -> list[AxleTrain]:
    """Trains with axle forces (N) from one nonnegative least-squares problem."""
    if not trains:
        return []
    tables = [log.rows(one.lines.crossing(one.geometry, log.times)) for one in trains]
    columns = np.hstack([*tables, log.shifts])
    least = np.append(
        np.zeros(columns.shape[1] - log.shifts.shape[1]), [-np.inf] * len(log.shifts.T)
    )
    sizes = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    x = scipy.optimize.lsq_linear(columns / sizes, log.target, (least, np.inf)).x / sizes
    parts = np.cumsum([one.forces.size for one in trains])
    return [
        one._replace(forces=np.maximum(own, 1e-3 * x[: parts[-1]].max()))
        for one, own in zip(trains, np.split(x, parts)[:-1], strict=True)
    ]


def _separated(fit: AxleFit) -> list[AxleTrain]:
    """Trains of the axles of a fit, separated at gaps too long for one vehicle."""
    at = fit.geometry
    cuts = np.flatnonzero(np.diff(at.offsets) > MOST_GAP) + 1
    found = []
    for own in np.split(np.arange(fit.forces.size), cuts):
        entry = at.entry_time + at.offsets[own[0]] / abs(at.speed)
        geometry = AxleGeometry(at.speed, entry, at.offsets[own] - at.offsets[own[0]], at.length)
        found.append(AxleTrain(fit.lines, geometry, fit.forces[own], fit.dynamic_share))
    return found
