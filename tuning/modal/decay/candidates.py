"""Modes of fitted decays as candidates, with the reasons for rejecting them, and their energies."""

import numpy as np

from tuning.modal.ambient import Candidate, without_duplicates
from tuning.modal.decay.fit import DecayFit
from tuning.modal.decay.leaving import PARTS
from tuning.modal.result import (
    MAX_DAMPING_RATIO,
    MIN_COLLINEARITY,
    IdentifiedMode,
    rejection_reason,
)
from tuning.modal.shapes import mac_matrix

NOT_REPRODUCED = "not the same in parts of the window"
NONLINEARITY = "what nonlinearity adds to the mode of"
NONLINEAR_DECAY = 2.5, 4.5  # decay rates over that of a mode, of what its nonlinearity adds to it
SKIRT_BANDWIDTHS = 4.0  # half widths of a peak, to where its amplitude has fallen to a quarter
NONLINEAR_MAC = 0.95
# Over that of the mode. Its phase moves by k in all, so that k^2 / 3 of its energy is that of the
# first such term; fits of more than two terms that Duffing's equation asks for give up to four.
MAX_CUBE_ENERGY = 4.0
MAX_CUBE_SPREAD = 3.0  # of energies of several decays over what they would be of cubes

BandFits = list[tuple[tuple[float, float], DecayFit]]  # of parts of a band (Hz)


def decay_candidates(
    fits: BandFits,
    decays: int,
    channels: int,
    duration: float,
    band: tuple[float, float],
    is_free: bool = False,
) -> tuple[Candidate, ...]:
    """Modes of each part of the band, with their shares in its energy of the channels.

    In decays that are free for sure (`is_free`) a shape may be complex, and frequency and damping
    depend on amplitude, which widens their intervals: no force makes it so.
    Columns of the fits are the `channels` of each of several `decays`, or of combinations of these.
    """
    found, by_decay = [], []
    collinear = 0.0 if is_free else MIN_COLLINEARITY
    for part, fit in fits:
        total = np.sum(fit.measured**2, axis=0).reshape(-1, channels).sum(axis=0)
        parts = fit.energies.shape[1] // channels
        columns = fit.energies.reshape(-1, parts, channels)
        shares = np.mean(columns.sum(axis=1) / np.maximum(total, 1e-300), axis=1)
        energies = columns.sum(axis=2)
        if parts != decays:  # combinations of decays
            energies = energies.sum(axis=1, keepdims=True)
        changing = fit.gone
        if is_free:
            changing = tuple(
                gone and _is_beside_stronger(k, fit.modes, shares)
                for k, gone in enumerate(fit.gone)
            )
        for mode, share, gone, energy in zip(
            fit.modes, shares.tolist(), changing, energies, strict=True
        ):
            if part[0] <= mode.frequency < part[1] or len(fits) == 1:
                mode = mode._replace(energy_share=share)
                reason = rejection_reason(mode, duration, band, collinear) or (
                    NOT_REPRODUCED if gone else ""
                )
                found.append(Candidate(mode, reason, 1))
                by_decay.append(energy)
    return without_duplicates(_without_nonlinearity(found, by_decay))


def _is_beside_stronger(k, modes, shares) -> bool:
    """Whether a mode may stand for what nonlinearity makes of a stronger one about its peak."""
    return any(
        shares[j] > shares[k]
        and abs(one.frequency - modes[k].frequency)
        < SKIRT_BANDWIDTHS * max(one.damping_ratio, 0.0) * one.frequency
        for j, one in enumerate(modes)
    )


def share_of_modes(found: tuple[Candidate, ...], fits: BandFits, duration: float) -> float:
    """Share of identified modes in the energy at the beginning of decays, beside rejected ones.

    What nonlinearity adds to a mode is a part of it.

    That is the first tenth: the energy over all of a decay would count steady hum for more, that at
    the first sample a pole that is gone at the next. Poles damped too strongly for modes, which
    stand for leakage into the band or the end of a blow, do not count.
    """
    good = rejected = 0.0
    for part, fit in fits:
        inside = [one for one in found if len(fits) == 1 or part[0] <= one.mode.frequency < part[1]]
        for one in inside:
            if one.mode.damping_ratio > MAX_DAMPING_RATIO:
                continue
            nepers = 4 * np.pi * one.mode.frequency * one.mode.damping_ratio * duration
            early = np.expm1(-nepers / PARTS) / np.expm1(-nepers) if nepers > 1e-6 else 1 / PARTS
            energy = early * np.sum(fit.measured**2)
            if one.reason and not one.reason.startswith(NONLINEARITY):
                # Poles side by side may cancel each other, each with many times the energy of all.
                rejected += min(one.mode.energy_share, 1.0) * energy
            else:
                good += one.mode.energy_share * energy
    return float(good / max(good + rejected, 1e-300))


def _without_nonlinearity(found: list[Candidate], by_decay) -> list[Candidate]:
    """Candidates; those that a nonlinear restoring force makes of others are rejected.

    The cube of a decaying vibration has its frequency and shape, three times its decay rate, and
    less energy, as what it adds is a correction; of several decays, it grows as the cube of theirs.
    """
    good = [(one.mode, own) for one, own in zip(found, by_decay, strict=True) if not one.reason]
    return [
        one if one.reason else one._replace(reason=next(
            (f"{NONLINEARITY} {other.frequency:.4g} Hz"
             for other, theirs in good
             if _is_cube(one.mode, other) and _grows_as_cube(own, theirs)), ""))
        for one, own in zip(found, by_decay, strict=True)
    ]  # fmt: skip


def _is_cube(mode: IdentifiedMode, other: IdentifiedMode) -> bool:
    """Whether a mode decays as the cube of another does, within its half-power bandwidth."""
    rate = mode.pole.real / other.pole.real
    near = abs(mode.frequency - other.frequency) < mode.damping_ratio * mode.frequency
    alike = mac_matrix(mode.shape[None], other.shape[None])[0, 0] > NONLINEAR_MAC
    less = mode.energy_share < MAX_CUBE_ENERGY * other.energy_share
    return bool(near and alike and less and NONLINEAR_DECAY[0] < rate < NONLINEAR_DECAY[1])


def _grows_as_cube(energies, others) -> bool:
    """Whether energies of a mode in several decays are in proportion to the cubes of another's."""
    ratios = energies / np.maximum(others, 1e-300) ** 3
    return bool(ratios.max() < MAX_CUBE_SPREAD * ratios.min())


def information_of_modes(found: tuple[Candidate, ...]) -> float:
    """Logarithm of the determinant of the information on damping ratios of modes (D-optimality).

    Each counts by how much narrower than itself its 95 % interval is, and rejected ones not at all.
    """
    modes = [one.mode for one in found if not one.reason]
    return float(
        sum(2 * np.log(one.damping_ratio / (one.quantile * one.damping_sd)) for one in modes)
    )
