"""Pre-processing of logs for modal identification: offset and drift, band, decimation.

Every step is visible in the notes of a result and can be set by the user.

Samples of logs from which modes are identified: records in a window, with notes on faults.

The start of a log is left out while sensors settle: AC-coupled ones saturate when switched on.
"""

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import percentile_filter
from scipy.signal import butter, detrend, find_peaks, firwin, resample_poly, sosfiltfilt, welch

from jaxbeam.case.sensors import QUANTITIES
from tuning.logs.log import Log, even_records
from tuning.logs.quality import find_faults

RATE_OVER_BAND = 2.56  # sampling rate after decimation over the upper end of the band
MIN_SEGMENTS = 8  # segments averaged for the spectrum that decides the band
BACKGROUND_OCTAVES = 1.0  # width of the running quantile that is the background of resonances
BACKGROUND_PERCENT = 25  # below the peaks of a pair of modes, however much of an octave they fill
RESONANCE_RATIO = 6.0  # of the spectrum over its background: 8 dB
BAND_ENERGY = 0.99  # fraction of the energy of resonances below the upper end of the band
HALF_POWER = 2.0  # dip between resonances of the band in which decays are sought again
MAX_RESONANCES = 12  # in the band: the lowest, which a model of the structure has
BAND_MARGIN = 1.3  # of the ends of the band beyond the outermost resonances
MIN_CYCLES = 8.0  # cycles of the lowest frequency in the longest record


class Prepared(NamedTuple):
    """Records ready for identification, one rate (Hz), with the times of their first samples (s).

    `band` (Hz) is that in which modes are sought.
    """

    records: tuple[Float[np.ndarray, "time channel"], ...]
    starts: tuple[float, ...]
    rate: float
    band: tuple[float, float]


def kinetic_band(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    rate: float,
    derivatives: tuple[int, ...],
    dip: float = RESONANCE_RATIO,
) -> tuple[float, float]:
    """Band (Hz) of the lowest resonances of a vibration, MAX_RESONANCES at most.

    Two resonances are apart if the spectrum between them falls by a factor of `dip`; a small one
    counts the ragged flanks of one resonance as several. The band ends earlier where they hold
    nearly all of its kinetic energy.

    Resonances are where the spectrum exceeds its background (lower quartile over an octave) by
    8 dB; their excess is converted to velocities by `derivatives`, the order of each channel as a
    time derivative. Drift and noise, however strong, are background. The excess counts as a
    fraction of the power of a channel, averaged over channels, as a sensor near a node shows little
    of one mode and much of another. Without resonances the band is all that the log can show.
    """
    return _band_of_resonances(records, rate, (derivatives,), dip)


def energy_band(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    rate: float,
    derivatives: tuple[int, ...],
) -> tuple[float, float]:
    """Band (Hz) as `kinetic_band`, extended by resonances that have energy in the readings.

    A mode that dominates accelerations counts then, however little it moves.
    """
    as_read = (1,) * len(derivatives)
    return _band_of_resonances(records, rate, (derivatives, as_read), RESONANCE_RATIO)


def _band_of_resonances(records, rate, measures, dip: float) -> tuple[float, float]:
    """Band (Hz) of the lowest resonances with nearly all energy by each of some `derivatives`."""
    longest = max(len(record) for record in records)
    lowest = MIN_CYCLES * rate / longest
    bins, power = _average_spectrum(records, rate)
    keep = (bins >= lowest) & (bins <= 0.45 * rate)
    bins, power = bins[keep], power[keep]
    excess = resonance_excess(bins, power)
    if not excess.any():
        return lowest, 0.4 * rate
    ends = [_ends_of_energy(bins, excess, power, derivatives) for derivatives in measures]
    low, high = min(end[0] for end in ends), max(end[1] for end in ends)
    # Chance makes the flanks of one resonance ragged, but not by as much as a peak stands out.
    level = np.log(np.max(power / _backgrounds(bins, power), axis=1))
    least = np.log(RESONANCE_RATIO)
    tops = bins[find_peaks(level, height=least, prominence=np.log(dip))[0]]
    tops = tops[tops >= low]
    if tops.size > MAX_RESONANCES:
        high = min(high, float(tops[MAX_RESONANCES - 1]))
    high = min(high * BAND_MARGIN, 0.4 * rate)
    return float(max(low / BAND_MARGIN**2, lowest)), float(high)


def _ends_of_energy(bins, excess, power, derivatives) -> tuple[float, float]:
    """Frequencies (Hz) between which resonances have nearly all of their energy."""
    weights = (2 * np.pi * bins[:, None]) ** (2.0 * (1 - np.asarray(derivatives)))
    whole = np.sum(power * weights, axis=0)
    energy = np.mean(excess * weights / np.where(whole > 0, whole, 1.0), axis=1)
    fraction = np.cumsum(energy) / energy.sum()
    last = min(int(np.searchsorted(fraction, BAND_ENERGY)), bins.size - 1)
    return bins[np.searchsorted(fraction, 1 - BAND_ENERGY)], bins[last]


def strongest_frequency(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    rate: float,
    derivatives: tuple[int, ...],
    band: tuple[float, float],
) -> float:
    """Frequency (Hz) in a band of the resonance at which the spectrum of velocities is largest.

    Without resonances it is the geometric mean of the band.
    """
    bins, power = _average_spectrum(records, rate)
    keep = (bins >= band[0]) & (bins <= band[1]) & (bins > 0)
    if keep.sum() < 8:
        return float(np.sqrt(band[0] * band[1]))
    bins, power = bins[keep], power[keep]
    exponents = 2.0 * (1 - np.asarray(derivatives))
    kinetic = resonance_excess(bins, power) * (2 * np.pi * bins[:, None]) ** exponents
    if not kinetic.any():
        return float(np.sqrt(band[0] * band[1]))
    return float(bins[np.argmax(np.sum(kinetic, axis=1))])


def _average_spectrum(records, rate):
    """Frequencies (Hz) and power spectral densities (bin, channel), averaged over records."""
    total = sum(len(record) for record in records)
    size = min(max(2 * total // (MIN_SEGMENTS + 1), 64), max(len(r) for r in records))
    sums, weight = 0.0, 0
    for record in records:
        if len(record) >= size:
            # Zeros around it give the first and last samples, of a decay say, their full weight.
            padded = np.pad(detrend(record, axis=0), ((size // 2, size // 2), (0, 0)))
            bins, power = welch(padded, rate, "hann", size, detrend="constant", axis=0)
            sums, weight = sums + len(padded) * power, weight + len(record)
    return bins, sums / weight


def resonance_excess(
    bins: Float[np.ndarray, " bin"], power: Float[np.ndarray, "bin channel"]
) -> Float[np.ndarray, "bin channel"]:
    """Power above the background where it stands out by 8 dB, else zero."""
    background = _backgrounds(bins, power)
    return np.where(power > RESONANCE_RATIO * background, power - background, 0.0)


def _backgrounds(bins, power):
    """Lower quartile of the power (bin, channel) over an octave about each bin."""
    points = max(512, 2 * bins.size)
    grid = np.geomspace(bins[0], bins[-1], points)
    width = max(int(BACKGROUND_OCTAVES * points / np.log2(bins[-1] / bins[0])), 3)
    found = []
    for column in power.T:
        level = np.interp(grid, bins, np.log(column + 1e-300))
        quartile = percentile_filter(level, BACKGROUND_PERCENT, width, mode="nearest")
        found.append(np.exp(np.interp(bins, grid, quartile)))
    return np.stack(found, axis=1)


def prepare(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    starts: tuple[float, ...],
    rate: float,
    band: tuple[float, float],
) -> Prepared:
    """Records without offset and drift, decimated for a band (Hz).

    The anti-alias filter is a linear-phase FIR filter (Kaiser window, 80 dB), applied without
    delay; the lower end of the band is that of a Butterworth high-pass filter of order 2, applied
    forwards and backwards at half of it.
    """
    target = RATE_OVER_BAND * band[1]
    ratio = Fraction(min(target / rate, 1.0)).limit_denominator(200)
    if ratio < 1 and ratio * 200 < 1:
        ratio = Fraction(1, int(rate / target))
    found = []
    new_rate = rate * float(ratio)
    sos = butter(2, min(band[0] / 2, 0.4 * new_rate), "highpass", fs=new_rate, output="sos")
    for record in records:
        values = detrend(record, axis=0)
        if ratio < 1:
            up, down = ratio.numerator, ratio.denominator
            taps = firwin(20 * max(up, down) + 1, 0.9 / max(up, down), window=("kaiser", 8.0))
            values = resample_poly(values, up, down, axis=0, window=taps)
        if len(values) > 60:
            values = sosfiltfilt(sos, values, axis=0)
        found.append(values)
    return Prepared(tuple(found), starts, new_rate, band)


def check_length(prepared: Prepared, least: int, what: str) -> None:
    """Check that the longest record has samples enough for a method.

    Raises ValueError if it has not.
    """
    longest = max(map(len, prepared.records))
    if longest < least:
        raise ValueError(
            f"{longest} samples, at the {prepared.rate:.4g} Hz that a band to "
            f"{prepared.band[1]:.4g} Hz needs, are too few for {what}: at least {least} are "
            "needed; take a longer window, or a band to higher frequencies"
        )


MIN_STUCK_SAMPLES = 12  # equal samples at the start of a channel that is saturated
MAX_LEFT_OUT = 0.5  # of a record


def settled_from(values: Float[np.ndarray, "time channel"]) -> int:
    """First sample from which all channels have settled; 0 if none starts at one stuck value.

    In a channel that starts stuck, so many samples are left out that the standard error of the mean
    of the others is least (White, An effective truncation heuristic for bias reduction in
    simulation output, 1997), half of them at most.
    """
    starts = [_settled(column) for column in values.T if _is_stuck(column)]
    return max(starts, default=0)


def _is_stuck(column) -> bool:
    first = column[:MIN_STUCK_SAMPLES]
    return column.size > 2 * MIN_STUCK_SAMPLES and bool(
        np.all(first == first[0]) and np.ptp(column)
    )


def _settled(column) -> int:
    """Truncation d with the least sum of squared deviations of x[d:] over (n - d)^2."""
    backwards = column[::-1] - np.median(column)
    count = np.arange(1, column.size + 1)
    squares = np.cumsum(backwards**2) - np.cumsum(backwards) ** 2 / count
    left_out = column.size - count
    error = np.where(left_out <= MAX_LEFT_OUT * column.size, squares / count**2, np.inf)
    return int(left_out[np.argmin(error)])


MIN_SAMPLES = 64  # of a log
MAX_RATE_CHANGE = 1e-3  # of the sampling rate, between logs that are used together


class Samples(NamedTuple):
    """Records of all logs in SI units, with the times of their first samples (s)."""

    records: tuple[Float[np.ndarray, "time channel"], ...]
    starts: tuple[float, ...]
    rate: float
    notes: tuple[str, ...]

    def with_notes(self, notes: Sequence[str]) -> "Samples":
        """The samples with further notes."""
        return self._replace(notes=(*self.notes, *notes))


def samples_of(logs: Sequence[Log], window: tuple[float, float] | None) -> Samples:
    """Records of the logs in a window (s), and notes on the logs and their faults.

    Raises ValueError for logs too short, not evenly sampled, or different in channels or rate, and
    a window outside a log.
    """
    records, starts, rates, notes = [], [], [], []
    for log in logs:
        part = part_of_window(log, window)
        rate, found, said = even_records(part)
        rates.append(rate)
        settled = settled_from(found[0].values) if window is None else 0
        if settled:
            said = (
                *said,
                f"the first {settled / rate:.3g} s are left out, while a sensor settles  [--from]",
            )
        for i, record in enumerate(found):
            skipped = 0 if i else settled
            records.append(record.values[skipped:])
            starts.append(record.start + skipped / rate)
        faults = (str(fault).removeprefix(f"{log.source}: ") for fault in find_faults(part))
        notes += [*log.notes, *said, *faults]
        if not same_channels(log, logs[0]) or abs(rate / rates[0] - 1) > MAX_RATE_CHANGE:
            raise ValueError(
                f"{log.source}: logs identified together must have the same channels, positions "
                f"and sampling rate; {logs[0].source} has {', '.join(logs[0].names)} at "
                f"{rates[0]:.6g} Hz, this one {', '.join(log.names)} at {rate:.6g} Hz. Modes of "
                "setups with other sensors are found one by one and merged by"
                " tuning.modal.merge_setups"
            )
    return Samples(tuple(records), tuple(starts), rates[0], tuple(dict.fromkeys(notes)))


def same_channels(a: Log, b: Log) -> bool:
    """Whether two logs have channels of the same names, quantities and places."""
    return all(
        getattr(a, field) == getattr(b, field)
        for field in ("names", "quantities", "positions", "sensors")
    )


def part_of_window(log: Log, window: tuple[float, float] | None) -> Log:
    """The part of a log in a window (s), by default all.

    Raises ValueError for a window outside the log, and for too few samples.
    """
    start, stop = _sample_range(log, window)
    if stop - start < MIN_SAMPLES:
        raise ValueError(
            f"{log.source}: {stop - start} samples are too few to identify modes from; "
            f"at least {MIN_SAMPLES} are needed"
        )
    if (start, stop) == (0, log.times.size):
        return log
    return Log(
        log.times[start:stop], log.values[start:stop], log.names, log.quantities, log.units,
        log.source, valid=log.valid[start:stop],
    )  # fmt: skip


def with_channels(log: Log, channels: Sequence[str] | None) -> Log:
    """The log with the channels of some names, by default all that are no commands.

    Raises ValueError for a channel that the log has not.
    """
    if channels is None:
        kept = [i for i, actuator in enumerate(log.actuators) if actuator is None]
    else:
        unknown = [name for name in channels if name not in log.names]
        if unknown:
            raise ValueError(
                f"{log.source}: the log has no channel {unknown[0]!r}; it has "
                f"{', '.join(log.names)}"
            )
        kept = [log.names.index(name) for name in channels]
    if kept == list(range(len(log.names))):
        return log

    def pick(entries):
        return tuple(entries[i] for i in kept)

    return Log(
        log.times, log.values[:, kept], pick(log.names), pick(log.quantities), pick(log.units),
        log.source, pick(log.sensors), pick(log.positions), pick(log.actuators), log.loads,
        log.valid[:, kept], log.notes,
    )  # fmt: skip


def without_constant(logs: Sequence[Log]) -> tuple[list[Log], tuple[str, ...]]:
    """Logs without the channels that are constant in all of them, and notes on these.

    Raises ValueError if no channel is left.
    """
    names, dead = logs[0].names, []
    if all(same_channels(log, logs[0]) for log in logs):  # others are refused later
        constant = np.all([np.ptp(log.values, axis=0) == 0 for log in logs], axis=0)
        dead = [name for name, one in zip(names, constant, strict=True) if one]
    if not dead:
        return list(logs), ()
    if len(dead) == len(names):
        raise ValueError(
            f"{logs[0].source}: each channel stays at one value: {', '.join(names)}; give others"
        )
    kept = [with_channels(log, [name for name in log.names if name not in dead]) for log in logs]
    return kept, tuple(f"{name} stays at one value: left out" for name in dead)


def _sample_range(log: Log, window) -> tuple[int, int]:
    """First and last (exclusive) sample of a window (s)."""
    if window is None:
        return 0, log.times.size
    step = log.duration / (log.times.size - 1)
    if not (log.times[0] <= window[0] < window[1] <= log.times[-1] + step):
        raise ValueError(
            f"{log.source}: the window from {window[0]:g} s to {window[1]:g} s is not within the "
            f"log, {log.times[0]:.6g} s to {log.times[-1]:.6g} s"
        )
    start, stop = np.searchsorted(log.times, window)
    return int(start), int(stop)


def time_derivative(quantity: str) -> int:
    """Order of a quantity as a time derivative: 1 for velocity, 2 for acceleration, else 0."""
    return QUANTITIES[quantity].time_derivative if quantity in QUANTITIES else 0
