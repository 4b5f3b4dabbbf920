"""Axles from the pulses of two detectors across the road, as in weighing with nothing on the road.

Strain gauges under the deck, tubes, loops or piezoelectric strips give a pulse for each axle. The
pulses of a vehicle reach the second detector in the pattern of the first, later by one delay: the
peak of the cross-correlation of both signals. The sign of the delay is the direction. The largest
set of pulses with one delay is removed as a vehicle, then the next: vehicles may overtake or meet.
"""

import numpy as np
import scipy.signal
from jaxtyping import Float

from tuning.weighing.influence_lines import AxleGeometry

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
