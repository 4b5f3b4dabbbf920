"""Tracks of modes over many logs, by their frequencies and shapes."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy.optimize
from jaxtyping import Float, Int

from tuning.modal.result import mac_matrix
from tuning.monitoring.history import LogModes

MAX_STEP = 0.05  # relative change of a frequency from its last values; a day of frost is less
MIN_MAC = 0.7  # of a shape with the mean shape of its track
REMEMBERED = 5  # last frequencies, whose median is what the next is compared with
SHAPE_WEIGHT = 0.2  # of a new shape in the mean shape
GONE = 20  # logs without the mode, after which a track has ended
MIN_FRACTION = 0.3  # of the logs from its birth to its end in which a mode that counts is found
MIN_SEEN = 5  # logs in which it is found, or half of fewer than ten


@dataclasses.dataclass(frozen=True)
class ModeTrack:
    """One mode over the logs: frequencies (Hz), deviations and damping ratios, NaN where it is not.

    `mac` is that of each shape with the mean shape before. `born` and `last` are the indices of the
    first and the last log with it; it has `ended` if logs have gone on without it.
    """

    frequencies: Float[np.ndarray, " log"]
    deviations: Float[np.ndarray, " log"]
    damping_ratios: Float[np.ndarray, " log"]
    mac: Float[np.ndarray, " log"]
    born: int
    last: int
    ended: bool

    @property
    def seen(self) -> int:
        """Number of logs in which the mode is found."""
        return int(np.isfinite(self.frequencies).sum())


@dataclasses.dataclass
class _GrowingTrack:
    """A track while it grows: indices of logs and of modes in them."""

    logs: list[int]
    modes: list[int]
    mac: list[float]
    recent: list[float]
    shape: np.ndarray

    def add(self, log: int, mode: int, entry: LogModes, mac: float) -> None:
        shape = entry.shapes[mode]
        both = np.isfinite(shape) & np.isfinite(self.shape)
        phase = np.vdot(shape[both], self.shape[both])
        turned = shape * (phase / abs(phase) if abs(phase) > 0 else 1.0)
        scale = np.linalg.norm(turned[both]) or 1.0
        mixed = (1 - SHAPE_WEIGHT) * self.shape + SHAPE_WEIGHT * turned / scale
        self.shape = np.where(np.isfinite(mixed), mixed, self.shape)
        self.logs.append(log)
        self.modes.append(mode)
        self.mac.append(mac)
        self.recent = [*self.recent, float(entry.frequencies[mode])][-REMEMBERED:]


def tracks_of(entries: Sequence[LogModes]) -> list[ModeTrack]:
    """Tracks of the modes of logs in the order of time, ascending in frequency.

    Modes of a log are assigned to the tracks so that changes of frequency and shape (MAC) are least
    in sum; a mode without a track begins one, a track without a mode for GONE logs has ended. Those
    seen too seldom are left out.
    """
    growing: list[_GrowingTrack] = []
    for number, entry in enumerate(entries):
        alive = [track for track in growing if number - track.logs[-1] <= GONE]
        taken = _assigned(entry, alive)
        for mode in range(entry.frequencies.size):
            if mode in taken:
                track, mac = taken[mode]
                alive[track].add(number, mode, entry, mac)
                continue
            shape = entry.shapes[mode] / (np.linalg.norm(entry.shapes[mode]) or 1.0)
            frequency = float(entry.frequencies[mode])
            growing.append(_GrowingTrack([number], [mode], [1.0], [frequency], shape))
    tracks = [_finished(track, entries) for track in growing]
    least = min(MIN_SEEN, max(1, len(entries) // 2))
    kept = [
        track
        for track in tracks
        if track.seen >= least and track.seen >= MIN_FRACTION * (track.last - track.born + 1)
    ]
    return sorted(kept, key=lambda track: float(np.nanmedian(track.frequencies)))


def _assigned(entry: LogModes, alive: Sequence[_GrowingTrack]) -> dict[int, tuple[int, float]]:
    """ModeTrack and MAC of each mode of a log that continues one."""
    if not alive or not entry.frequencies.size:
        return {}
    sizes = [track.shape.size for track in alive]
    fits = [i for i, size in enumerate(sizes) if size == entry.shapes.shape[1]]
    if not fits:
        return {}
    before = np.array([np.median(alive[i].recent) for i in fits])
    steps = np.abs(np.log(entry.frequencies[:, None] / before)) / np.log1p(MAX_STEP)
    mac = mac_matrix(entry.shapes, np.array([alive[i].shape for i in fits]))
    allowed = (steps <= 1) & (mac >= MIN_MAC)
    cost = np.where(allowed, steps + (1 - mac) / (1 - MIN_MAC), 1e3)
    rows, columns = scipy.optimize.linear_sum_assignment(cost)
    return {
        int(row): (fits[column], float(mac[row, column]))
        for row, column in zip(rows, columns, strict=True)
        if allowed[row, column]
    }


def _finished(track: _GrowingTrack, entries: Sequence[LogModes]) -> ModeTrack:
    logs: Int[np.ndarray, " seen"] = np.array(track.logs)

    def over_time(values):
        found = np.full(len(entries), np.nan)
        found[logs] = values
        return found

    columns = [
        over_time([getattr(entries[i], name)[k] for i, k in zip(logs, track.modes, strict=True)])
        for name in ("frequencies", "frequency_sds", "damping_ratios")
    ]
    found, deviations, ratios = columns
    ended = len(entries) - 1 - track.logs[-1] > GONE
    parts = found, deviations, ratios, over_time(track.mac)
    return ModeTrack(*parts, track.logs[0], track.logs[-1], ended)
