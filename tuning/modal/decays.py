"""Free decays in a log: stretches after blows, or after a load has left, without excitation.

Between blows the samples are predicted by the past ones, but for noise. An autoregressive model of
each channel tells excitation by its prediction errors: a blow is an error far beyond those of the
quietest parts of the log and not small beside the signal itself.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

AR_ORDER = 24
AR_ITERATIONS = 6
QUIET_QUANTILE = 0.2  # of the blocks, by their prediction errors
BLOW_SD = 10.0  # prediction errors of quiet blocks, beyond which the structure is struck
BLOW_SIGNAL_SHARE = 0.25  # of the rms of the signal around, likewise
MIN_DECAY_CYCLES = 8.0  # of the strongest vibration
MIN_FALL_NEPERS = 1.5  # of the energy over a decay
MIN_LINEARITY = 0.6  # share of the variance of the log energy that a straight line explains
MAX_COLUMNS = 24  # channels times decays that are fitted together
FLOOR_RATIO = 2.0  # energy at which a decay ends, over that of the quietest parts


class Stretch(NamedTuple):
    """Samples (start, stop) of a record between excitations, and the fall of energy in nepers."""

    record: int
    start: int
    stop: int
    fall: float


def excited_samples(
    record: Float[np.ndarray, "time channel"], rate: float, cycle: float
) -> Bool[np.ndarray, " time"]:
    """Samples at which the structure is struck; `cycle` (s) is that of its strongest vibration.

    Neither the past samples predict them nor the coming ones: after a blow the past fails for as
    many samples as the model has coefficients, before it the future.
    """
    span = max(int(2 * cycle * rate), 16)
    struck = np.zeros(len(record), bool)
    for values in record.T:
        around = np.sqrt(_moving_mean(values**2, span)) + 1e-12 * np.abs(values).max() + 1e-300
        forward = _is_large(_prediction_errors(values, around), around, span)
        backward = _is_large(_prediction_errors(values[::-1], around[::-1])[::-1], around, span)
        struck |= _widened(forward) & _widened(backward)
    return struck


def _is_large(error, around, span):
    """Errors beyond those of the quietest blocks, and not small beside the signal."""
    size = max(span, 32)
    blocks = (error**2)[: error.size // size * size].reshape(-1, size).mean(axis=1)
    quiet = np.sqrt(np.quantile(blocks, QUIET_QUANTILE)) if blocks.size else 0.0
    return (np.abs(error) > BLOW_SD * quiet) & (np.abs(error) > BLOW_SIGNAL_SHARE * around)


def _widened(samples):
    """Samples and their neighbours on either side."""
    wide = samples.copy()
    wide[1:] |= samples[:-1]
    wide[:-1] |= samples[1:]
    return wide


def _prediction_errors(values, around):
    """Errors of an autoregressive model, zero where the past is too short.

    The model has the least sum of absolute errors over the local rms of the signal (by iteratively
    reweighted least squares), so that excited samples, however strong, do not shape it.
    """
    order = min(AR_ORDER, values.size // 8)
    past = np.lib.stride_tricks.sliding_window_view(values, order)[:-1]
    target, scale = values[order:], around[order:]
    weight = 1 / scale**2
    for _ in range(AR_ITERATIONS):
        weighted = past * weight[:, None]
        gram = past.T @ weighted
        coefficients = np.linalg.lstsq(gram, weighted.T @ target, rcond=1e-14)[0]
        error = target - past @ coefficients
        weight = 1 / (scale * np.maximum(np.abs(error), 1e-3 * scale))
    return np.concatenate([np.zeros(order), error])


def _moving_mean(values, width):
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(values.size)
    low, high = np.maximum(index - width // 2, 0), np.minimum(index + width // 2 + 1, values.size)
    return (total[high] - total[low]) / (high - low)


def free_decays(
    records: tuple[Float[np.ndarray, "time channel"], ...], rate: float, frequency: float
) -> tuple[tuple[Stretch, ...], float]:
    """Decays in the records, and the share of samples at which the structure is struck.

    `frequency` (Hz) is that of the strongest vibration. A decay lasts at least eight cycles, in
    which the energy falls by 1.5 nepers along a line; it ends where the energy is twice that of the
    quietest parts.
    """
    found, struck_count, total = [], 0, 0
    shortest = int(np.ceil(MIN_DECAY_CYCLES * rate / frequency))
    width = max(int(2 * rate / frequency), 4)
    for number, record in enumerate(records):
        struck = excited_samples(record, rate, 1 / frequency)
        struck_count, total = struck_count + int(struck.sum()), total + struck.size
        scaled = record / np.maximum(record.std(axis=0), 1e-300)
        energy = _moving_mean(np.sum(scaled**2, axis=1), width)
        floor = float(np.quantile(energy, 0.05))
        edges = np.concatenate([[-1], np.flatnonzero(struck), [len(record)]])
        for before, after in zip(edges[:-1], edges[1:], strict=True):
            start, stop = int(before) + 2, int(after) - 1
            if before < 0:
                start = 0
            if after == len(record):
                stop = len(record)
            if stop - start < shortest:
                continue
            quiet = np.flatnonzero(energy[start:stop] < FLOOR_RATIO * floor)
            if quiet.size and energy[start] > 10 * floor:
                stop = max(start + int(quiet[0]), min(start + shortest, stop))
            fall, linearity = _fall(energy[start:stop], width)
            if fall > MIN_FALL_NEPERS and linearity > MIN_LINEARITY:
                found.append(Stretch(number, start, stop, fall))
    return tuple(found), struck_count / max(total, 1)


def _fall(energy, width):
    """Fall of the logarithm of the energy along its straight line, and how linear it is."""
    level = np.log(energy[width // 2 :: max(width, 1)] + 1e-300)
    if level.size < 3:
        return 0.0, 0.0
    across = np.linspace(-1, 1, level.size)
    slope, middle = np.polyfit(across, level, 1)
    misfit = np.var(level - middle - slope * across)
    return float(-2 * slope), float(1 - misfit / max(np.var(level), 1e-300))


def stacked(
    records: tuple[Float[np.ndarray, "time channel"], ...], decays: tuple[Stretch, ...]
) -> tuple[Float[np.ndarray, "sample column"], tuple[Stretch, ...]]:
    """Decays of one length side by side, channels of the first before those of the second ...

    The common length is the median; decays of less than half of it are left out, and those between
    shorten it. Of more than 24 columns in all, the decays with most energy are kept.
    """
    lengths = np.array([one.stop - one.start for one in decays])
    used = tuple(
        one for one, length in zip(decays, lengths, strict=True) if 2 * length >= np.median(lengths)
    )
    most = max(MAX_COLUMNS // records[0].shape[1], 1)
    energies = [np.sum(records[one.record][one.start : one.stop] ** 2) for one in used]
    kept = np.sort(np.argsort(energies)[::-1][:most])
    used = tuple(used[i] for i in kept)
    length = min(int(np.median(lengths)), min(one.stop - one.start for one in used))
    parts = [records[one.record][one.start : one.start + length] for one in used]
    return np.hstack(parts), used
