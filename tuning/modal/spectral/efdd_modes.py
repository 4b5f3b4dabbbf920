"""Modes by enhanced frequency-domain decomposition, with jackknife uncertainties.

Each group of segments is left out in turn; the spread of the results is that of chance in the
spectra. The bias of the method, which cuts a bell out of a spectrum, is not in it.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import t as student

from tuning.modal.ambient import Candidate, divided_band, overlapping, without_duplicates
from tuning.modal.preprocessing import check_length, prepare
from tuning.modal.result import IdentifiedMode, rejection_reason
from tuning.modal.spectral.cross_spectra import MIN_SEGMENT, CrossSpectra, cross_spectra
from tuning.modal.spectral.decomposition import (
    Bell,
    along_shape,
    bells,
    single_mode,
    singular_values,
)

MIN_SEGMENTS = 4  # side by side, for groups of them to be left out in turn


class SingularValues(NamedTuple):
    """Singular values of the cross-spectral matrix over frequency (Hz), the largest first."""

    frequencies: Float[np.ndarray, " bin"]
    values: Float[np.ndarray, "bin value"]


def efdd_modes(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    starts: tuple[float, ...],
    rate: float,
    band: tuple[float, float],
    *,
    progress: Callable[[str], None] | None = None,
) -> tuple[tuple[Candidate, ...], tuple[SingularValues, ...]]:
    """Candidate modes, and the singular values of each part of a band (Hz).

    Raises ValueError for too few samples.
    """
    found: list[Candidate] = []
    drawn = []
    for low, high in divided_band(band):
        if progress:
            progress(f"modes from {low:.3g} Hz to {high:.4g} Hz")
        prepared = prepare(records, starts, rate, overlapping((low, high), band))
        check_length(prepared, MIN_SEGMENTS * MIN_SEGMENT, "method 'fdd'")
        spectra = cross_spectra(prepared.records, prepared.rate)
        duration = sum(map(len, prepared.records)) / prepared.rate
        inside = (spectra.bins >= low) & (spectra.bins <= high)
        power = np.einsum("bcc->c", spectra.mean[inside].real)
        for bell in bells(spectra, prepared.band):
            mode = _mode(spectra, bell, power)
            if mode is not None:
                found.append(Candidate(mode, rejection_reason(mode, duration, band), 1))
        drawn.append(SingularValues(spectra.bins[inside], singular_values(spectra.mean[inside])[0]))
    return without_duplicates(found), tuple(drawn)


def _mode(spectra: CrossSpectra, bell: Bell, power) -> IdentifiedMode | None:
    """Mode of a bell, with the jackknife over groups of segments; None without enough extremes."""
    window, groups = spectra.correlation_window, len(spectra.groups)
    densities = along_shape(spectra.groups, bell.along)
    whole = single_mode(densities.sum(axis=0), bell, spectra.rate, window)
    if whole is None:
        return None
    left_out = [
        single_mode(densities.sum(axis=0) - density, bell, spectra.rate, window)
        for density in densities
    ]
    largest = int(np.argmax(np.abs(bell.shape)))
    unit = bell.shape / bell.shape[largest]
    shapes = _shapes_without_each(spectra, bell)
    shapes = shapes / shapes[:, [largest]] - unit
    known = [one for one in left_out if one is not None]
    spread = np.cov(np.array(known).T, bias=True) if len(known) == groups > 1 else np.eye(2)
    deviations = np.sqrt((groups - 1) * np.diag(spread))
    parts = np.concatenate([shapes.real, shapes.imag], axis=1)
    # Along another vector than the shape a mode has a part of its power only.
    part = np.abs(bell.along.conj() @ bell.shape) ** 2
    own = np.sum(densities[:, bell.first : bell.last]) * np.abs(bell.shape) ** 2 / part
    return IdentifiedMode(
        frequency=whole.frequency,
        frequency_sd=float(deviations[0]),
        damping_ratio=whole.damping_ratio,
        damping_sd=float(deviations[1]),
        energy_share=float(np.mean(own / np.maximum(power, 1e-300))),
        shape=unit,
        shape_covariance=(groups - 1) / groups * parts.T @ parts,
        quantile=float(student.ppf(0.975, max(groups - 1, 1))),
    )


def _shapes_without_each(spectra: CrossSpectra, bell: Bell):
    """Shapes (group, channel) of a bell without each group of segments."""
    if bell.of_pair:
        in_bell = np.sum(spectra.groups[:, bell.first : bell.last], axis=1)
        return (in_bell.sum(axis=0) - in_bell) @ bell.along
    at_peak = spectra.groups[:, bell.peak]
    return singular_values(at_peak.sum(axis=0) - at_peak)[1][:, 0]
