"""Where in a log the structure vibrates freely, and in which band of frequencies."""

import functools

import numpy as np
from jaxtyping import Float

# Energy must fall by this many nepers to be called a decay: random vibration under steady
# excitation swells and fades as well, but hardly by so much along a straight line.
MIN_FALL_NEPERS = 3.5
ENERGY_BLOCKS = 150
BAND_ITERATIONS = 4
DECAY_ENERGY_SHARE = 0.95  # of the energy, to look for the decay in
MIN_BLOCKS = 10
# The logarithm of a decay's energy strays by about this much from a line, because modes beat.
BEAT_SCATTER_NEPERS = 0.25
# Powers of angular frequency that turn a quantity's spectrum into one of velocity.
_VELOCITY_EXPONENT = {"acceleration": -1, "velocity": 0}


def energy_band(
    values: Float[np.ndarray, "time channel"],
    rate: float,
    quantities: tuple[str, ...],
    share: float = 0.98,
) -> tuple[float, float]:
    """Return the band (Hz) in which the vibration has its kinetic energy, with a margin above.

    Up to 1.5 times the frequency below which that `share` of the energy lies, leaving out the
    sensors' noise, which is what is seen in the upper half of the spectrum.
    """
    count = len(values)
    time = np.linspace(-1, 1, count)
    drift = np.polynomial.legendre.legvander(time, 3)
    level = values - drift @ np.linalg.lstsq(drift, values, rcond=None)[0]
    power = np.abs(np.fft.rfft(level * np.hanning(count)[:, None], axis=0)) ** 2
    bins = np.fft.rfftfreq(count, 1 / rate)
    noise = np.median(power[bins.size // 2 :], axis=0) / np.log(2)
    # A mode must swing a few times in a log to be told from drift.
    lowest = 4 * rate / count
    excess = np.where(power > 6 * noise, power - noise, 0.0)[bins >= lowest]
    bins = bins[bins >= lowest]
    powers = np.array([2 * _VELOCITY_EXPONENT.get(quantity, 1) for quantity in quantities])
    kinetic = excess * (2 * np.pi * bins[:, None]) ** powers
    if not np.any(kinetic > 0):
        return lowest, 0.5 * rate
    # Channels of one quantity add up as they are; different quantities count the same.
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
    """Keep the part of a signal whose frequencies (Hz) lie in a band.

    Each channel is multiplied by that power of angular frequency (2: a deflection's acceleration).
    """
    bins = np.fft.rfftfreq(len(values), 1 / rate)
    # Without the line from first to last sample the signal has no jump where it wraps round.
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
    """Find the free decay in a log: the samples (start, stop) between which energy falls steadily.

    Of all windows, the one along which the logarithm of the energy in the band falls farthest and
    most smoothly: along a line or, as fast modes die first, a parabola that opens upwards (an end
    of excitation bends the other way). Accelerations are looked at, because in them the slow path
    of a load over the beam hardly shows. None if in no window the energy falls far enough.
    """
    powers = np.array([1.0 + _VELOCITY_EXPONENT.get(quantity, 1) for quantity in quantities])
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
            # Under steady excitation what fades soon swells again.
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
    """Find the free decay (start, stop) in a log, in a given band (Hz) or the decay's own.

    The whole log, with its excitation, reaches higher in frequency than the decay that follows:
    unless it is given, the band is taken again from what was found, until that is the decay.
    """
    limits = band or energy_band(values, rate, quantities, DECAY_ENERGY_SHARE)
    found = find_decay_in_band(values, rate, limits, quantities)
    for _ in range(0 if band or found is None else BAND_ITERATIONS):
        # What lasts longest tells: the second half of what was found so far.
        late = values[(found[0] + found[1]) // 2 : found[1]]
        limits = (
            limits[0],
            min(limits[1], energy_band(late, rate, quantities, DECAY_ENERGY_SHARE)[1]),
        )
        found = find_decay_in_band(values, rate, limits, quantities) or found
    return found
