"""Window of the free decay in a log, and the frequency band of its vibration."""

import functools

import numpy as np
from jaxtyping import Float

from tuning.logs.units import time_derivative

# Fall of the energy that makes a decay: random vibration under steady excitation rises and falls as
# well, but hardly by so much along a straight line.
MIN_FALL_NEPERS = 3.5
ENERGY_BLOCKS = 150  # blocks of a log over which energy is averaged
BAND_ITERATIONS = 4
DECAY_ENERGY_SHARE = 0.95  # of the energy, in the band in which a decay is searched
MIN_BLOCKS = 10  # blocks of a decay
BEAT_SCATTER_NEPERS = 0.25  # scatter of the log energy of a decay about a line, by beating modes


def energy_band(
    values: Float[np.ndarray, "time channel"],
    rate: float,
    quantities: tuple[str, ...],
    share: float = 0.98,
) -> tuple[float, float]:
    """Band (Hz) of the kinetic energy of a vibration, with a margin above.

    Its upper end is 1.5 times the frequency below which that `share` of the energy lies. The noise
    of the sensors, estimated from the upper half of the spectrum, is left out.
    """
    count = len(values)
    time = np.linspace(-1, 1, count)
    drift = np.polynomial.legendre.legvander(time, 3)
    level = values - drift @ np.linalg.lstsq(drift, values, rcond=None)[0]
    power = np.abs(np.fft.rfft(level * np.hanning(count)[:, None], axis=0)) ** 2
    bins = np.fft.rfftfreq(count, 1 / rate)
    noise = np.median(power[bins.size // 2 :], axis=0) / np.log(2)
    # Four cycles in a log distinguish a mode from drift.
    lowest = 4 * rate / count
    excess = np.where(power > 6 * noise, power - noise, 0.0)[bins >= lowest]
    bins = bins[bins >= lowest]
    powers = np.array([2 * (1 - time_derivative(quantity)) for quantity in quantities])
    kinetic = excess * (2 * np.pi * bins[:, None]) ** powers
    if not np.any(kinetic > 0):
        return lowest, 0.5 * rate
    # Channels of one quantity are added as they are; different quantities have equal weights.
    kinds = np.array(quantities)
    totals = np.array([np.sum(kinetic[:, kinds == kind]) for kind in quantities])
    kinetic = np.sum(kinetic / np.where(totals > 0, totals, 1.0), axis=1)
    cumulative_energy = np.cumsum(kinetic) / np.sum(kinetic)
    highest = 1.5 * bins[min(int(np.searchsorted(cumulative_energy, share)), bins.size - 1)]
    return lowest, float(min(max(highest, 8 * lowest), 0.5 * rate))


def band_pass(
    values: Float[np.ndarray, "time channel"],
    rate: float,
    band: tuple[float, float],
    powers: Float[np.ndarray, " channel"] | float = 0.0,
) -> Float[np.ndarray, "time channel"]:
    """Part of a signal with frequencies (Hz) in a band.

    The spectrum of each channel is multiplied by that power of the angular frequency (2: the
    acceleration of a deflection).
    """
    bins = np.fft.rfftfreq(len(values), 1 / rate)
    # Without the line from first to last sample the periodic signal has no jump.
    line = np.linspace(0, 1, len(values))[:, None]
    spectrum = np.fft.rfft(values - values[0] * (1 - line) - values[-1] * line, axis=0)
    inside = ((bins >= band[0]) & (bins <= band[1]))[:, None]
    weight = np.where(inside, np.maximum(2 * np.pi * bins, 1e-9)[:, None] ** powers, 0.0)
    return np.fft.irfft(spectrum * weight, len(values), axis=0)


@functools.cache
def _line_and_parabola(count: int):
    """Orthonormal line and parabola over so many points."""
    across = np.linspace(-1, 1, count)
    basis, triangle = np.linalg.qr(np.stack([np.ones(count), across, across**2], axis=1))
    return (basis * np.sign(np.diag(triangle)))[:, 1:].T


def find_decay_in_band(
    values: Float[np.ndarray, "time channel"],
    rate: float,
    band: tuple[float, float],
    quantities: tuple[str, ...],
) -> tuple[int, int] | None:
    """Free decay in a log: samples (start, stop) between which the energy falls steadily.

    Of all windows, the one along which the logarithm of the energy in the band falls farthest and
    most smoothly: along a line or, as fast modes decay first, a parabola that opens upwards (an end
    of excitation bends the other way). Energy is that of accelerations, in which the quasi-static
    response to a crossing load hardly shows. None if the energy falls far enough in no window.
    """
    powers = np.array([2.0 - time_derivative(quantity) for quantity in quantities])
    signal = band_pass(values, rate, band, powers)
    energy = np.sum(signal**2 / (np.mean(signal**2, axis=0) + 1e-300), axis=1)
    size = max(len(energy) // ENERGY_BLOCKS, 1)
    blocks = len(energy) // size
    level = np.log(energy[: blocks * size].reshape(blocks, size).mean(axis=1) + 1e-30)
    best, found = 0.0, None
    for length in range(MIN_BLOCKS, blocks + 1):
        pieces = np.lib.stride_tricks.sliding_window_view(level, length)[: blocks - MIN_BLOCKS]
        line, bend = _line_and_parabola(length)
        centred = pieces - pieces.mean(axis=1, keepdims=True)
        slopes, curvatures = centred @ line, np.maximum(centred @ bend, 0.0)
        fitted = slopes[:, None] * line + curvatures[:, None] * bend
        fall = fitted[:, 0] - fitted[:, -1]
        score = fall / (1 + np.mean((centred - fitted) ** 2, axis=1) / BEAT_SCATTER_NEPERS**2)
        for start in np.flatnonzero((fall > MIN_FALL_NEPERS) & (score > best)):
            # Under steady excitation the energy soon rises again.
            after = level[start + length : start + 2 * length]
            if score[start] > best and np.all(after < pieces[start].max() - fall[start] / 2):
                # The excitation may end within the first block.
                best, found = score[start], ((int(start) + 1) * size, (int(start) + length) * size)
    return found


def find_decay(
    values: Float[np.ndarray, "time channel"],
    rate: float,
    band: tuple[float, float] | None,
    quantities: tuple[str, ...],
) -> tuple[int, int] | None:
    """Free decay in a log (start, stop), in a given band (Hz) or in that of the decay.

    The excited part of a log contains higher frequencies than the decay: a band that is not given
    is computed again from the window found, until it is that of the decay.
    """
    limits = band or energy_band(values, rate, quantities, DECAY_ENERGY_SHARE)
    found = find_decay_in_band(values, rate, limits, quantities)
    for _ in range(0 if band or found is None else BAND_ITERATIONS):
        # The band is that of the second half of the window found so far.
        late = values[(found[0] + found[1]) // 2 : found[1]]
        limits = (
            limits[0],
            min(limits[1], energy_band(late, rate, quantities, DECAY_ENERGY_SHARE)[1]),
        )
        found = find_decay_in_band(values, rate, limits, quantities) or found
    return found
