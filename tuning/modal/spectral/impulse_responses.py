"""Output correlations, lag by lag, and their Fourier transforms: positive spectra.

Correlations of the response to broadband excitation are sums of decaying exponentials, C A^(l-1) G
from the first lag on. Their discrete Fourier transform is rational in z = exp(i w T) with the poles
of the structure at the bins of the transform, though the lags are cut off: as z^N = 1 there, what
is cut off changes numerators only. So there is no leakage, and damping ratios are not biased by a
window (Peeters and Van der Auweraer 2005 fit such positive spectra).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from tuning.modal.subspace import MAX_BLOCKS, MIN_BLOCK_LAGS, block_covariances


class ImpulseResponses(NamedTuple):
    """Responses (lag, output, input) at steps of `step` s, and their deviations by blocks.

    Correlations of outputs are such responses, whose inputs are the outputs again. The sum of the
    squares of `changes` over blocks is the variance.
    """

    values: Float[np.ndarray, "lag output input"]
    changes: Float[np.ndarray, "block lag output input"]
    step: float


class FrequencyResponses(NamedTuple):
    """Values (line, output, input) at z = exp(i w T), T = `step` (s), with deviations by blocks."""

    values: Complex[np.ndarray, "line output input"]
    changes: Complex[np.ndarray, "block line output input"]
    z: Complex[np.ndarray, " line"]
    step: float


def output_correlations(
    records: tuple[Float[np.ndarray, "time channel"], ...], rate: float, lags: int
) -> ImpulseResponses:
    """Correlations E y(t + l) y(t)^T of the outputs for l = 0 ... `lags`, of all records."""
    usable = sum(max(len(record) - lags, 0) for record in records)
    wanted = int(np.clip(usable // (MIN_BLOCK_LAGS * lags), 4, MAX_BLOCKS))
    sums, counts = block_covariances(records, lags, wanted)
    total, blocks = counts.sum(), len(counts)
    mean = sums.sum(axis=0) / total
    scale = np.sqrt(blocks / max(blocks - 1, 1))
    changes = scale * (sums - counts[:, None, None, None] * mean) / total
    return ImpulseResponses(mean, changes, 1 / rate)


def frequency_responses(
    responses: ImpulseResponses, band: tuple[float, float]
) -> FrequencyResponses:
    """Discrete Fourier transform of impulse responses at the lines of a band (Hz)."""
    count = len(responses.values)
    bins = np.arange(count) / (count * responses.step)
    lines = np.flatnonzero((bins >= band[0]) & (bins <= min(band[1], 0.5 / responses.step)))
    return FrequencyResponses(
        np.fft.fft(responses.values, axis=0)[lines],
        np.fft.fft(responses.changes, axis=1)[:, lines],
        np.exp(2j * np.pi * bins[lines] * responses.step),
        responses.step,
    )
