"""Earlier starts of a free decay, from which its modes explain the samples as well.

The end of an excitation is found from errors of prediction, or of simple models, some cycles late;
modes that decay fast are gone by then. Once modes of the decay are known, starts are tried back to
where forces act, cycle by cycle: without forces the modes explain the new samples, too, or do so
beside one more, which then has to explain those before them.
"""

import numpy as np
from jaxtyping import Complex, Float
from scipy.signal import detrend

from tuning.modal.decay.fit import inverse_transform
from tuning.modal.decay.poles import (
    PoleFit,
    Spectrum,
    band_spectrum,
    find_poles,
    same_poles,
    with_one_more,
)

PARTS = 10  # of the rest
MAX_TRIED = 16  # starts, a cycle of the strongest mode apart
BEGINNING_CYCLES = 2.0  # whose errors are compared with those of the rest
MIN_INDEPENDENT = 16.0  # samples of the beginning; of fewer, one more mode would explain any
RATIO_SDS = 3.0  # of the errors of the beginning to those of the rest, beyond which they differ
CLEAR_RATIO = 10.0  # that ends the search
MIN_NEPERS = 0.7  # by which a mode that was not found has decayed where it was not
MAX_REFUSED = 3  # starts one after another, likewise: a second mode is told some cycles late
MAX_MORE = 2  # modes than were found
MARGIN_CYCLES = 1.0  # by which the decay begins after the earliest start, as forces set in slowly


def earlier_start(
    values: Float[np.ndarray, "sample channel"],
    start: int,
    rate: float,
    band: tuple[float, float],
    poles: Complex[np.ndarray, " mode"],
    cycle: float,
) -> int:
    """Sample, `start` or before it, from which on values decay freely in a band (Hz).

    `values` end with the decay; `poles` (1/s) are those found from `start` on; `cycle` is that of
    the strongest mode, in samples.
    """
    independent = 2 * (band[1] - band[0]) / rate * BEGINNING_CYCLES * cycle * values.shape[1]
    if independent < MIN_INDEPENDENT:
        return start
    limit = 1 + RATIO_SDS * np.sqrt(2 / independent)
    size = int(BEGINNING_CYCLES * cycle)
    most = poles.size + MAX_MORE
    earliest, refused, more = start, 0, None
    for k in range(1, MAX_TRIED + 1):
        tried = start - int(k * cycle)
        if tried < 0:
            break
        spectrum = band_spectrum(detrend(values[tried:], axis=0), rate, band)
        fit = same_poles(poles if more is None else more, spectrum)
        ratio = _error_ratio(fit, spectrum, size)
        if ratio <= limit and (more is not None or not refused):
            poles, more, earliest, refused = fit.poles, None, tried, 0
            continue
        refused += 1
        if more is None and poles.size < most:
            fit = with_one_more(fit, spectrum)
            ratio = _error_ratio(fit, spectrum, size)
            gone = -fit.poles[-1].real * (start - tried) / rate > MIN_NEPERS
            more = fit.poles if ratio <= limit and gone else None
        else:
            more = None
        if more is None and (ratio > CLEAR_RATIO or refused >= MAX_REFUSED):
            break
    begins = min(start, earliest + int(MARGIN_CYCLES * cycle))
    if begins < start:
        # Forces would be explained as well, by more modes.
        spectrum = band_spectrum(detrend(values[begins:], axis=0), rate, band)
        if find_poles(spectrum, start=poles).poles.size > most:
            return start
    return begins


def _error_ratio(fit: PoleFit, spectrum: Spectrum, size: int) -> float:
    """Mean square of the errors of the first samples over the median of those of the rest."""
    scale = np.sqrt(np.mean(np.abs(spectrum.values) ** 2, axis=0))
    errors = np.mean(inverse_transform(fit.residual / scale, spectrum) ** 2, axis=1)
    usual = np.median([np.mean(part) for part in np.array_split(errors[size:], PARTS)])
    return float(np.mean(errors[:size]) / usual)
