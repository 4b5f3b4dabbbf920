"""Modes from the response to ambient excitation, by stochastic subspace identification.

A wide band is divided into bands of three octaves, each decimated to a rate of its own, so that the
lags of a Hankel matrix hold many cycles of the lowest mode without thousands of rows.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import linalg
from scipy.stats import norm, t as student

from tuning.modal.likelihood import Start, refine_modes
from tuning.modal.preprocessing import Prepared, check_length, prepare
from tuning.modal.result import (
    MIN_ENERGY,
    SAME_MAC,
    IdentifiedMode,
    frequency_and_damping,
    mac_matrix,
    rejection_reason,
)
from tuning.modal.subspace import (
    MIN_BLOCK_ROWS,
    Chain,
    Diagram,
    Poles,
    Spread,
    block_rows,
    decompose,
    poles_of_order,
    spreads,
    stabilise,
)

MAX_ORDER = 60  # of models in a stabilisation diagram, by default
MAX_BAND_RATIO = 8.0  # upper over lower end of the bands that are identified one by one
BAND_OVERLAP = 1.1  # factor by which such bands extend beyond their part
RECORD_OVER_ROWS = 4  # samples of a record over block rows, for covariances of all lags
MIN_LENGTH = RECORD_OVER_ROWS * MIN_BLOCK_ROWS
DUPLICATE_SDS = 2.0  # standard deviations within which two poles are one


class Candidate(NamedTuple):
    """A mode found, the reason for rejecting it (or none), and the length of its chain."""

    mode: IdentifiedMode
    reason: str
    length: int


def divided_band(band: tuple[float, float]) -> tuple[tuple[float, float], ...]:
    """Parts of a band (Hz) of three octaves at most."""
    count = max(int(np.ceil(np.log(band[1] / band[0]) / np.log(MAX_BAND_RATIO) - 1e-9)), 1)
    edges = np.geomspace(band[0], band[1], count + 1).tolist()
    return tuple(zip(edges[:-1], edges[1:], strict=True))


def subspace_modes(
    records: tuple[Float[np.ndarray, "time channel"], ...],
    starts: tuple[float, ...],
    rate: float,
    band: tuple[float, float],
    *,
    data_driven: bool = False,
    order: int | None = None,
    refine: bool = True,
    progress: Callable[[str], None] | None = None,
) -> tuple[tuple[Candidate, ...], tuple[Diagram, ...]]:
    """Candidate modes and the stabilisation diagram of each part of a band (Hz).

    Of rejected modes those are accepted that the likelihood of periodograms needs (`refine`), but
    not in free decays, whose periodograms are not random. There the modes are only those that a fit
    starts from, and orders are at most what the records allow.

    Raises ValueError for too few samples of records that are no decays.
    """
    found: list[Candidate] = []
    diagrams = []
    # Parts of a band, the lowest, whose samples are too few are left out.
    rows = _rows_of_order(order, records) if refine else 0
    least = max(RECORD_OVER_ROWS * rows, MIN_LENGTH)
    for low, high in divided_band(band):
        if progress:
            progress(f"modes from {low:.3g} Hz to {high:.4g} Hz")
        prepared = prepare(records, starts, rate, overlapping((low, high), band))
        if max(map(len, prepared.records)) < least:
            continue
        candidates, diagram = _modes_of_band(prepared, band, data_driven, order, refine)
        found += candidates
        diagrams.append(diagram)
    if refine and not diagrams:
        of_order = f"models of order {order} (lower ones need fewer)"
        check_length(prepared, least, of_order if order else "any model")
    return without_duplicates(found), tuple(diagrams)


def _rows_of_order(order: int | None, records) -> int:
    """Block rows of a Hankel matrix for models of an order; 0 for none."""
    return 0 if order is None else order // records[0].shape[1] + 1


def overlapping(part: tuple[float, float], band: tuple[float, float]) -> tuple[float, float]:
    """A part of a band (Hz) with a tenth of its neighbours."""
    low, high = part
    return max(low / BAND_OVERLAP, band[0]), min(high * BAND_OVERLAP, band[1])


def _modes_of_band(prepared: Prepared, whole, data_driven, order, refine):
    """Candidates and diagram of records prepared for one part of the band `whole`."""
    scale = np.sqrt(np.mean(np.concatenate(prepared.records) ** 2, axis=0))
    scale = np.where(scale > 0, scale, 1.0)
    records = tuple(record / scale for record in prepared.records)
    channels, longest = records[0].shape[1], max(map(len, records))
    rows = block_rows(prepared.rate, prepared.band[0], channels, longest)
    if order is not None:
        order = min(order, (longest // RECORD_OVER_ROWS - 1) * channels)
        rows = max(rows, _rows_of_order(order, records))
    subspace = decompose(records, prepared.rate, rows, data_driven)
    highest = order or min(MAX_ORDER, 2 * rows * channels // 3)
    parts = [poles_of_order(subspace, n) for n in range(2, highest + 1, 2)]
    poles = Poles(*(np.concatenate([getattr(p, name) for p in parts]) for name in Poles._fields))
    # Shapes in the units of the log.
    scaled = poles._replace(shapes=poles.shapes * scale)
    diagram = stabilise(scaled, prepared.band)
    duration = sum(map(len, records)) / prepared.rate
    spread_of = _all_spreads(subspace, poles, diagram.chains)
    modes = [mode_of_chain(poles, chain, spread_of, scale) for chain in diagram.chains]
    lengths = [chain.members.size for chain in diagram.chains]
    reasons = [rejection_reason(mode, duration, whole) for mode in modes]
    modes = [
        mode if reason else with_usual_spread(mode, poles, chain, spread_of)
        for mode, reason, chain in zip(modes, reasons, diagram.chains, strict=True)
    ]
    reasons = [rejection_reason(mode, duration, whole) for mode in modes]
    if refine:
        doubtful = [one or _overlap_words(k, modes, reasons) for k, one in enumerate(reasons)]
        if any(doubtful):
            refined = _decided(modes, doubtful, records, prepared.rate, scale, duration, whole)
            modes, reasons = _after_refinement(modes, reasons, *refined)
    candidates = [Candidate(*found) for found in zip(modes, reasons, lengths, strict=True)]
    return candidates, diagram


def _overlap_words(k, modes, reasons) -> str:
    """Words for an accepted mode of one channel whose interval overlaps that of another mode.

    With several channels the shapes decide whether two poles are one mode (`_is_same`).
    """
    if modes[k].shape.size > 1:
        return ""
    near = [
        other.frequency
        for j, other in enumerate(modes)
        if j != k and not reasons[j] and _is_same(modes[k], other)
    ]
    return f"not told from {near[0]:.4g} Hz" if near else ""


def _after_refinement(modes, reasons, refined, decided):
    """Modes and reasons after refinement; accepted modes that were not refined stay."""
    accepted = [mode for mode, reason in zip(refined, decided, strict=True) if not reason]
    for k, mode in enumerate(modes):
        if decided[k] and not reasons[k] and not any(_is_same(mode, one) for one in accepted):
            refined[k], decided[k] = mode, ""
    return refined, decided


def _decided(modes, reasons, records, rate, scale, duration, whole):
    """Modes and reasons after the likelihood has accepted the rejected modes that it needs.

    Modes without energy would not be accepted.
    """
    order = sorted(
        (k for k, mode in enumerate(modes) if mode.energy_share > MIN_ENERGY),
        key=lambda k: (bool(reasons[k]), modes[k].damping_sd / modes[k].damping_ratio),
    )
    start = Start(
        np.array([modes[k].pole for k in order], complex),
        np.array([modes[k].shape.real / scale for k in order]).reshape(-1, scale.size),
        np.array([modes[k].energy_share * scale.size for k in order]),
        np.array([not reasons[k] for k in order], bool),
    )
    modes, reasons = list(modes), list(reasons)
    for k, one in zip(order, refine_modes(records, rate, start), strict=True):
        if one is None:
            continue
        frequency, frequency_sd, damping, damping_sd = frequency_and_damping(
            one.pole, one.covariance
        )
        physical = one.shape * scale
        largest = int(np.argmax(np.abs(physical)))
        spread = linalg.block_diag(one.shape_covariance, np.zeros_like(one.shape_covariance))
        better = IdentifiedMode(
            frequency=frequency,
            frequency_sd=frequency_sd,
            damping_ratio=damping,
            damping_sd=damping_sd,
            energy_share=one.variance,
            shape=(physical / physical[largest]).astype(complex),
            shape_covariance=_rescaled(one.shape, spread, scale, largest),
            quantile=float(norm.ppf(0.975)),
        )
        if not rejection_reason(better, duration, whole):
            modes[k], reasons[k] = better, ""
    return modes, reasons


def _all_spreads(subspace, poles: Poles, chains: tuple[Chain, ...]) -> dict[int, Spread]:
    """Uncertainties of the members of chains, by index."""
    members = np.concatenate([chain.members for chain in chains]) if chains else np.zeros(0, int)
    found: dict[int, Spread] = {}
    for order in np.unique(poles.orders[members]):
        chosen = members[poles.orders[members] == order]
        found |= zip(
            chosen.tolist(), spreads(subspace, int(order), poles.poles[chosen]), strict=True
        )
    return found


def mode_of_chain(poles: Poles, chain: Chain, found: dict[int, Spread], scale) -> IdentifiedMode:
    """Mode of a chain: its pole with the least uncertainty, by the determinant of covariance."""
    which = min(chain.members.tolist(), key=lambda k: np.linalg.det(found[k].covariance))
    own = found[which]
    variances = np.diag(own.covariance)
    physical = own.shape * scale
    largest = int(np.argmax(np.abs(physical)))
    # The largest component in the units of the log may be another: the covariance follows.
    unit = physical / physical[largest]
    covariance = _rescaled(own.shape, own.shape_covariance, scale, largest)
    return IdentifiedMode(
        frequency=float(poles.frequencies[which]),
        frequency_sd=float(np.sqrt(variances[0])),
        damping_ratio=float(poles.damping_ratios[which]),
        damping_sd=float(np.sqrt(variances[1])),
        energy_share=float(poles.energies[which]),
        shape=unit,
        shape_covariance=covariance,
        quantile=float(student.ppf(0.975, own.degrees_of_freedom)),
    )


def with_usual_spread(
    mode: IdentifiedMode, poles: Poles, chain: Chain, found: dict[int, Spread]
) -> IdentifiedMode:
    """The mode with the usual uncertainty of its chain, and the scatter over model orders.

    The least uncertainty of a chain is too small by chance, so that its lower eighth is taken. A
    model of low order, in which close or weak modes are one, has biased poles that vary little from
    block to block: the mean square distance of the less uncertain half of the chain from the pole
    adds to its variance.
    """
    ranked = sorted(chain.members.tolist(), key=lambda k: np.linalg.det(found[k].covariance))
    usual, least = (np.diag(found[k].covariance) for k in (ranked[len(ranked) // 8], ranked[0]))
    half = ranked[: max(len(ranked) // 2, 1)]
    by_order = [
        np.mean((values[half] - own) ** 2)
        for values, own in (
            (poles.frequencies, mode.frequency),
            (poles.damping_ratios, mode.damping_ratio),
        )
    ]
    frequency_sd, damping_sd = np.sqrt(np.maximum(usual, least) + by_order).tolist()
    return mode._replace(frequency_sd=frequency_sd, damping_sd=damping_sd)


def _rescaled(shape, covariance, scale, largest):
    """Covariance of a shape after a change of units and of the component that is one."""
    count = shape.size
    unit = shape * scale / (shape[largest] * scale[largest])
    # d unit = S (d shape - shape d shape_L / shape_L) / (shape_L s_L), complex linear.
    transform = np.diag(scale + 0j)
    transform[:, largest] -= unit * scale[largest]
    transform = transform / (shape[largest] * scale[largest])
    real = np.block([[transform.real, -transform.imag], [transform.imag, transform.real]])
    return real @ covariance @ real.T if count else covariance


def without_duplicates(found: list[Candidate]) -> tuple[Candidate, ...]:
    """Candidates that differ by more than their uncertainties, ascending; the best are kept."""
    kept: list[Candidate] = []
    for one in sorted(found, key=lambda c: (bool(c.reason), c.mode.damping_sd / max(
        c.mode.damping_ratio, 1e-12))):  # fmt: skip
        same = any(_is_same(one.mode, other.mode) for other in kept)
        if not same:
            kept.append(one)
    return tuple(sorted(kept, key=lambda c: c.mode.frequency))


def _is_same(a: IdentifiedMode, b: IdentifiedMode) -> bool:
    """Whether two poles stand for one mode: similar in shape, and indistinguishable in frequency.

    They agree in frequency and damping within two standard deviations of the difference; or their
    95 % intervals of frequency overlap and the frequencies differ by less than half of the smaller
    half-power bandwidth, z f, however the damping ratios differ: no spectrum shows two peaks then.
    """
    if mac_matrix(a.shape[None], b.shape[None])[0, 0] < SAME_MAC:
        return False
    shift = abs(a.frequency - b.frequency)
    alike = shift < DUPLICATE_SDS * np.hypot(a.frequency_sd, b.frequency_sd) and abs(
        a.damping_ratio - b.damping_ratio
    ) < DUPLICATE_SDS * np.hypot(a.damping_sd, b.damping_sd)
    overlap = shift < a.quantile * a.frequency_sd + b.quantile * b.frequency_sd
    width = min(a.damping_ratio * a.frequency, b.damping_ratio * b.frequency)
    return bool(alike or (overlap and shift < width))
