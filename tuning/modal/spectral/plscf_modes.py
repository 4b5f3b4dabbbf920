"""Modes by p-LSCF of output correlations: positive spectra fitted by matrix fractions.

A wide band is divided into bands of three octaves, each decimated to a rate of its own, as for
subspace identification. Poles of polynomials of rising degree are a stabilisation diagram; shapes
are residues by least squares at the poles that were chosen.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from tuning.modal.ambient import (
    Candidate,
    divided_band,
    mean_square,
    overlapping,
    without_duplicates,
)
from tuning.modal.preprocessing import RATE_OVER_BAND, Prepared, check_length, prepare
from tuning.modal.result import IdentifiedMode, rejection_reason
from tuning.modal.spectral.chains import mode_of_best_half, spread_of_changes
from tuning.modal.spectral.impulse_responses import (
    FrequencyResponses,
    frequency_responses,
    output_correlations,
)
from tuning.modal.spectral.matrix_fraction import (
    Equations,
    Fraction,
    equations,
    fit_fraction,
    pole_changes,
)
from tuning.modal.spectral.residues import shapes_with_covariance
from tuning.modal.stabilisation import Diagram, stabilise
from tuning.modal.subspace import Poles, Spread

LAG_CYCLES = 15.0  # cycles of the lowest frequency in the lags of correlations
MIN_LAGS, MAX_LAGS = 32, 1000
RECORD_OVER_LAGS, MIN_RECORD_OVER_LAGS = 8, 3  # of the longest record; at least
MAX_ORDER = 60
MIN_DEGREES = 12  # degrees of the polynomials, however many channels there are


def plscf_modes(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    starts: tuple[float, ...],
    rate: float,
    band: tuple[float, float],
    *,
    order: int | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[tuple[Candidate, ...], tuple[Diagram, ...]]:
    """Candidate modes and the stabilisation diagram of each part of a band (Hz).

    Raises ValueError for too few samples.
    """
    found: list[Candidate] = []
    diagrams = []
    for low, high in divided_band(band):
        if progress:
            progress(f"modes from {low:.3g} Hz to {high:.4g} Hz")
        prepared = prepare(records, starts, rate, overlapping((low, high), band))
        check_length(prepared, MIN_RECORD_OVER_LAGS * MIN_LAGS, "method 'plscf'")
        candidates, diagram = _modes_of_band(prepared, band, order)
        found += candidates
        diagrams.append(diagram)
    return without_duplicates(found), tuple(diagrams)


def _modes_of_band(prepared: Prepared, whole, order):
    """Candidates and diagram of records prepared for one part of the band `whole`."""
    scale = np.sqrt(mean_square(prepared.records))
    scale = np.where(scale > 0, scale, 1.0)
    records = tuple(record / scale for record in prepared.records)
    most = min(max(map(len, records)) // RECORD_OVER_LAGS, MAX_LAGS)
    lags = max(min(int(LAG_CYCLES * prepared.rate / prepared.band[0]), most), MIN_LAGS)
    correlations = output_correlations(records, prepared.rate, lags)
    lines = prepared.band[0] / 2, 0.45 * RATE_OVER_BAND * prepared.band[1]
    responses = frequency_responses(correlations, lines)
    channels = scale.size
    highest = max(MAX_ORDER // channels, MIN_DEGREES)
    if order is not None:
        highest = max(order // channels, 2)
    degrees = range(1, min(highest, len(responses.z) // 2) + 1)
    system = equations(responses, degrees[-1])
    fractions = [fit_fraction(system, degree) for degree in degrees]
    sizes = [fraction.poles.size for fraction in fractions]
    poles = Poles(
        np.repeat(np.array(degrees) * channels, sizes),
        np.concatenate([fraction.poles for fraction in fractions]),
        np.concatenate([fraction.shapes for fraction in fractions]),
        np.zeros(sum(sizes)),
    )
    diagram = stabilise(poles._replace(shapes=poles.shapes * scale), prepared.band)
    chosen = _Chosen(system, fractions, poles, diagram)
    modes = [mode_of_best_half(poles, chain, chosen.spreads, scale) for chain in diagram.chains]
    if modes:
        modes = _with_residues(modes, chosen, scale, np.diag(correlations.values[0]))
    duration = sum(map(len, records)) / prepared.rate
    candidates = [
        Candidate(mode, rejection_reason(mode, duration, whole), chain.members.size)
        for mode, chain in zip(modes, diagram.chains, strict=True)
    ]
    return candidates, diagram


class _Chosen:
    """Poles of the chains of a diagram: uncertainties, changes by blocks and participations."""

    def __init__(self, system: Equations, fractions: list[Fraction], poles: Poles, diagram):
        self.responses: FrequencyResponses = system.responses
        self.poles = poles
        self.changes: dict[int, np.ndarray] = {}
        self.participations: dict[int, np.ndarray] = {}
        self.spreads: dict[int, Spread] = {}
        members = {int(k) for chain in diagram.chains for k in chain.members}
        first = 0
        for fraction in fractions:
            inside = [k for k in range(first, first + fraction.poles.size) if k in members]
            if inside:
                changes = pole_changes(system, fraction)
                for k in inside:
                    self.changes[k] = changes[:, k - first]
                    self.participations[k] = fraction.left[k - first].conj()
                    self.spreads[k] = spread_of_changes(
                        poles.poles[k], self.changes[k], poles.shapes[k]
                    )
            first += fraction.poles.size

    def member(self, mode: IdentifiedMode) -> int:
        """Index of the pole of a mode."""
        members = np.array(list(self.spreads))
        return int(members[np.argmin(np.abs(self.poles.poles[members] - mode.pole))])


def _with_residues(modes, chosen: _Chosen, scale, variances):
    """Modes with shapes by residues, and their shares in the variances of the outputs."""
    responses = chosen.responses
    members = [chosen.member(mode) for mode in modes]
    poles = chosen.poles.poles[members]
    changes = np.stack([chosen.changes[k] for k in members], axis=1)
    participations = np.stack([chosen.participations[k] for k in members])
    # Responses in the units of the log: shapes and their covariance are in them, too.
    physical = responses._replace(
        values=responses.values * scale[:, None], changes=responses.changes * scale[:, None]
    )
    roots = np.exp(poles * responses.step)
    shapes, covariances = shapes_with_covariance(
        physical, roots, changes * roots * responses.step, participations
    )
    # R_l = sum_r 2 Re(psi_r l_r^T z_r^(l-1)); continued to l = 0 it is the variance without noise.
    own = 2 * np.real(shapes / scale * participations / roots[:, None])
    shares = np.mean(own / np.maximum(variances, 1e-300), axis=1)
    return [
        mode._replace(
            shape=shape / shape[np.argmax(np.abs(shape))],
            shape_covariance=covariance,
            energy_share=float(share),
        )
        for mode, shape, covariance, share in zip(modes, shapes, covariances, shares, strict=True)
    ]
