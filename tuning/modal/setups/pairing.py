"""Modes of several setups that are one mode of the structure."""

from collections.abc import Sequence

import numpy as np
import scipy.optimize

from tuning.modal.fit import ModalFit
from tuning.modal.result import MIN_ENERGY_SHARE, IdentifiedMode, mac_matrix
from tuning.modal.setups.shape import Part

MAX_FREQUENCY_CHANGE = 0.03  # between setups: temperature, traffic, the mass of moved sensors
MAX_SDS = 3.0  # standard deviations of the difference of two frequencies that may be more
MIN_MAC = 0.6  # at common channels, where errors of the shapes take nothing from it
OTHER_ERROR = 0.05  # of a component over the largest, by modes close by, beside its stated error
MIN_SHARE_ALONE = 0.05  # of the energy; a mode that one setup alone shows may else be noise
FAR = 1e6  # cost of a pair that is no pair


def paired_modes(setups: Sequence[ModalFit], indices: Sequence[np.ndarray]) -> list[dict[int, int]]:
    """For each mode of the structure, the mode (index) of each setup (index) that shows it.

    Modes of a setup are paired with those of the setups before by the least sum of distances, in
    frequency and in modal assurance criterion at the channels that both setups have, where these
    are two or more. `indices` say which of all channels those of each setup are.
    """
    groups: list[dict[int, int]] = []
    for number, setup in enumerate(setups):
        cost = np.full((len(groups), len(setup.modes)), FAR)
        for row, group in enumerate(groups):
            for column, mode in enumerate(setup.modes):
                distances = [
                    distance(setups[k].modes[i], mode, indices[k], indices[number])
                    for k, i in group.items()
                ]
                cost[row, column] = min(np.mean(distances), FAR)
        rows, columns = scipy.optimize.linear_sum_assignment(cost)
        pairs = {int(c): int(r) for r, c in zip(rows, columns, strict=True) if cost[r, c] < FAR}
        for column in range(len(setup.modes)):
            if column in pairs:
                groups[pairs[column]][number] = column
            else:
                groups.append({number: column})
    return groups


def lone_modes(
    setups: Sequence[ModalFit],
    indices: Sequence[np.ndarray],
    groups: Sequence[tuple[dict[int, int], dict]],
) -> dict[int, str]:
    """Groups (index) of a mode that one setup alone shows and that may be none, with the reason.

    `groups` are the pairs of each mode, and what `uncertain_modes` found for it. Such a mode may be
    noise if it is weak, or another estimate of a mode that several setups show.
    """
    several = [pairs for pairs, _ in groups if len(pairs) > 1]
    found = {}
    for number, (pairs, uncertain) in enumerate(groups):
        if len(pairs) + len(uncertain) > 1:
            continue
        ((own, index),) = pairs.items()
        mode = setups[own].modes[index]
        same = [
            setups[k].modes[i].frequency
            for group in several
            for k, i in group.items()
            if distance(setups[k].modes[i], mode, indices[k], indices[own], 0.0) < FAR
        ]
        if mode.energy_share < MIN_SHARE_ALONE:
            found[number] = f"found in {setups[own].source} alone, and weak"
        elif same:
            found[number] = f"found in {setups[own].source} alone, where {same[0]:.4g} Hz may be it"
    return found


def uncertain_modes(
    setups: Sequence[ModalFit], indices: Sequence[np.ndarray], pairs: dict[int, int]
) -> dict[int, tuple[IdentifiedMode, str]]:
    """The rejected mode, with the reason, of each setup where a mode is not well identified.

    It has the frequency of those of all other setups within errors, and their shape at common
    channels. Poles without energy, and those at harmonic lines, are no modes.
    """
    found = {}
    for number, setup in enumerate(setups):
        near = []
        for mode, reason in setup.rejected if number not in pairs else ():
            distances = [
                distance(setups[k].modes[i], mode, indices[k], indices[number], 0.0)
                for k, i in pairs.items()
            ]
            width = max(mode.damping_ratio * mode.frequency, mode.frequency_sd)
            line = any(abs(one.frequency - mode.frequency) < width for one in setup.lines)
            if mode.energy_share >= MIN_ENERGY_SHARE and not line and max(distances) < FAR:
                near.append((max(distances), len(near), mode, reason))
        if near:
            found[number] = min(near)[2:]
    return found


def distance(a: IdentifiedMode, b: IdentifiedMode, of_a, of_b, change=MAX_FREQUENCY_CHANGE):
    """Distance of two modes, of 2 at most; `FAR` if they are too unlike to be one.

    `of_a` and `of_b` are the channels of their shapes; `change` is the share by which frequencies
    may differ beside their errors.
    """
    errors = MAX_SDS * np.hypot(a.frequency_sd, b.frequency_sd)
    limit = max(change * min(a.frequency, b.frequency), errors)
    apart = abs(a.frequency - b.frequency) / limit
    _, first, second = np.intersect1d(of_a, of_b, return_indices=True)
    mac = 1.0
    if first.size > 1:
        one, other = a.shape[first], b.shape[second]
        left = _left_by_errors(a, first) * _left_by_errors(b, second)
        mac = min(float(mac_matrix(one[None], other[None])[0, 0]) + 1 - left, 1.0)
    return FAR if not apart <= 1 or mac < MIN_MAC else float(apart + 1 - mac)


def _left_by_errors(mode: IdentifiedMode, channels: np.ndarray) -> float:
    """What errors of a shape leave of its modal assurance criterion with the true one, expected."""
    variances = Part(mode.shape, mode.shape_covariance, channels).variances[channels]
    error = np.sum(variances + OTHER_ERROR**2)
    size = np.sum(np.abs(mode.shape[channels]) ** 2)
    return float(max(size - error, 0.0) / max(size, 1e-300))
