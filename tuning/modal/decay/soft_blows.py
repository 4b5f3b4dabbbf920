"""Blows too soft, or in too much noise, to be found by their errors: the energy rises at once."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

MIN_ENERGY_RISE = 2.0  # energy in two cycles after a blow over that before it
RISE_WIDTHS = 5  # of two cycles each, before such a rise
MIN_START_RATIO = 10.0  # energy right after a blow over that of a structure at rest
MAX_HARDER = 10.0  # energy right after the hardest blow over that after the softest; less is noise


def vibration_energy(
    record: Float[np.ndarray, "sample channel"], width: int
) -> Float[np.ndarray, " sample"]:
    """Energy of a record around each sample, each channel relative to its own."""
    scaled = record / np.maximum(record.std(axis=0), 1e-300)
    return moving_mean(np.sum(scaled**2, axis=1), width)


def moving_mean(values: Float[np.ndarray, " sample"], width: int) -> Float[np.ndarray, " sample"]:
    """Means of the values around each sample; fewer at the ends."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    index = np.arange(values.size)
    low, high = np.maximum(index - width // 2, 0), np.minimum(index + width // 2 + 1, values.size)
    return (total[high] - total[low]) / (high - low)


def until_soft_blow(record: Float[np.ndarray, "sample channel"], width: int) -> int:
    """Samples of a record before a blow too soft to be found by its errors; all if there is none.

    `width` are two cycles of the strongest vibration in samples.
    """
    return until_blow(vibration_energy(record, width), width)


def after_first_blow(energy: Float[np.ndarray, " sample"], width: int) -> int | None:
    """Sample of most energy after a blow that strikes a structure at rest; None without one."""
    rise = _until_rise(energy, width, width, MIN_START_RATIO)
    if rise == energy.size:
        return None
    highest = _highest_after(energy, rise, width)
    return highest if MAX_HARDER * energy[highest] > energy.max() else None


def between_soft_blows(
    energy: Float[np.ndarray, " sample"], first: int, last: int, width: int
) -> Iterator[tuple[int, int]]:
    """First and last samples of the parts of a stretch before and after soft blows."""
    while True:
        rise = first + until_blow(energy[first:last], width)
        yield first, rise
        if rise == last:
            return
        first = _highest_after(energy[:last], rise, width)


def _highest_after(energy, rise, width) -> int:
    """Sample of most energy after a blow, where nothing acts any longer."""
    return rise + int(np.argmax(energy[rise : rise + 4 * width]))


def until_blow(energy: Float[np.ndarray, " sample"], width: int) -> int:
    """Samples before a blow too soft to be found by its errors.

    Close modes make the energy rise, too, but not above what it was as long before its least.
    """
    return _until_rise(energy, width, RISE_WIDTHS * width, MIN_ENERGY_RISE)


def _until_rise(energy, width, past, ratio) -> int:
    """Samples before the energy rises within `width` above a multiple of all in the `past`."""
    if energy.size < past + 2 * width:
        return energy.size
    before = sliding_window_view(energy, past).max(axis=-1)[: -2 * width]
    risen = energy[past + 2 * width - 1 :][: before.size] > ratio * before
    return past + int(np.argmax(risen)) if risen.any() else energy.size
