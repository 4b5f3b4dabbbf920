"""Least errors that modes of a planted structure can have, whatever the method.

No unbiased method has smaller variances than the inverse of Fisher's information (Rao 1945, Cramer
1946). It is computed for a method that knows all that one can know: the noise, the strengths of
random forces and the frequencies of lines, the number of modes, and that shapes are real. Unknown
are frequencies, damping ratios, shapes and, of random forces, their places.

A mode is not identifiable from a log if the least interval of its damping ratio holds zero, if that
of its frequency holds a neighbour within its half-power bandwidth, if a model without it is
expected to do as well (`expected_gain`), or if it is nearer to a harmonic of a machine than the
resolution of the log: a harmonic of fluctuating amplitude and phase responds like the mode.

Expected gain of the log likelihood of a log by a mode, whatever the method.

The logarithm of the likelihood ratio of the true model and the best one without the mode is, on
average over logs, the least Kullback-Leibler divergence of their spectra.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy.stats import norm

from tests.oracles.planted_structures import FINER, WEAK, Planted, Structure, noise_spectrum
from tuning.modal.likelihood import damped_scoring

QUANTILE = 1.96
# Expected log likelihood that a mode gains if half of the logs identify it, where one of ten
# thousand without it may: with both models known the gain has mean D and variance 2 D with the
# mode, -D and 2 D without it.
TELLING_GAIN = float(norm.isf(1e-4) ** 2 / 2)
WIDTHS = 10.0  # half-power widths around a mode in which every bin counts; else one of some
SPARSE = 3000  # bins in all, about
STEP = 1e-4  # relative, of differences
MIN_DIRECTION = 1e-10  # of the scaled information; scales of shapes have none


class LeastErrors(NamedTuple):
    """Least standard deviations of the frequencies (Hz) and damping ratios of all modes."""

    frequencies: Float[np.ndarray, " mode"]
    damping_ratios: Float[np.ndarray, " mode"]


class RandomResponse(NamedTuple):
    """Spectral matrices (bin, channel, channel) of unknowns (mode, unknown), and their truth.

    `weights` are the bins that each bin stands for. Unknown are frequencies, damping ratios, and
    shapes at the channels and at the places of the forces.
    """

    spectra: Callable[[np.ndarray], np.ndarray]
    weights: Float[np.ndarray, " bin"]
    unknowns: Float[np.ndarray, "mode unknown"]


def random_response(planted: Planted, duration: float, shaken: bool = False) -> RandomResponse:
    """Spectra of the response to random forces in noise, and the unknowns that were planted.

    `shaken` tells that the random forces are those beside a shaker; lines are left out.
    """
    structure, rate = planted.structure, planted.rate
    bins, weights = _bins(planted, duration)
    inputs = structure.inputs * (WEAK if shaken else 1.0)
    channels = structure.shapes.shape[1]
    angles = 2 * np.pi * bins / rate
    noise = planted.noise**2 * noise_spectrum(angles)[:, None, None] * np.eye(channels)

    def spectra(values):
        found = noise.astype(complex)
        for alias in range(FINER):  # of samples at FINER times the rate
            one = _responses(values, channels, (angles + 2 * np.pi * alias) / FINER, FINER * rate)
            found = found + one @ one.conj().transpose(0, 2, 1) / FINER
        return found

    return RandomResponse(spectra, weights, _stacked(structure, structure.shapes, inputs))


def least_errors(planted: Planted, duration: float, shaken: bool = False) -> LeastErrors:
    """Least errors under random forces, from the distribution of spectra (Whittle 1953).

    `shaken` is that of `random_response`.
    """
    response = random_response(planted, duration, shaken)
    truth = response.unknowns
    fisher = information(response, response.spectra(truth), truth)[1]
    return _of_information(fisher, truth)


def information(response: RandomResponse, expected, unknowns):
    """Gradient of minus the expected log likelihood by all unknowns, and Fisher's information.

    `expected` are the spectra of the log.
    """
    inverse = np.linalg.inv(response.spectra(unknowns))
    relative = [inverse @ slope for slope in _slopes(response.spectra, unknowns)]
    misfit = np.eye(expected.shape[1]) - inverse @ expected
    weights = response.weights[:, None, None]
    left = np.array([(one * weights).ravel() for one in relative])
    right = np.array([one.transpose(0, 2, 1).ravel() for one in relative])
    gradient = left @ misfit.transpose(0, 2, 1).ravel()
    return gradient.real, (left @ right.T).real


def least_errors_of_forced(
    planted: Planted, forces: Float[np.ndarray, "time input"]
) -> LeastErrors:
    """Least errors of the response to measured forces, in noise."""
    structure, rate = planted.structure, planted.rate
    spectrum = np.fft.rfft(forces, axis=0) / np.sqrt(len(forces))
    bins = np.fft.rfftfreq(len(forces), 1 / rate)
    keep = (bins > 0.5 * structure.frequencies[0]) & (bins < 1.3 * structure.frequencies[-1])
    angles, channels = 2 * np.pi * bins[keep] / rate, structure.shapes.shape[1]
    unknowns = _stacked(structure, structure.shapes, structure.inputs[:, : forces.shape[1]])
    deviation = planted.noise * np.sqrt(noise_spectrum(angles))[:, None]

    def outputs(values):
        one = _responses(values, channels, angles, rate)
        return np.einsum("bci,bi->bc", one, spectrum[keep]) / deviation

    slopes = np.array([slope.ravel() for slope in _slopes(outputs, unknowns)])
    return _of_information(2 * (slopes.conj() @ slopes.T).real, unknowns)


def least_errors_of_decays(planted: Planted) -> LeastErrors:
    """Least errors of free decays together, whose beginnings are known, in noise.

    Unknown are frequencies, damping ratios, shapes, and size and phase of each mode in each decay.
    Raises ValueError if nothing decays freely, or the responses of the modes are not known.
    """
    if planted.parts is None or not planted.decays:
        raise ValueError(
            "the least errors of decays need their beginnings, and the modes' responses"
        )
    structure, count = planted.structure, len(planted.decays)
    modes, channels = structure.shapes.shape
    information, size = 0.0, 2 + channels + 2 * count
    for number, (start, stop) in enumerate(planted.decays):
        columns = np.zeros((stop - start, channels, modes, size))
        times = np.arange(stop - start) / planted.rate
        for k, (frequency, damping, shape) in enumerate(
            zip(structure.frequencies, structure.damping_ratios, structure.shapes, strict=True)
        ):
            root = -damping + 1j * np.sqrt(1 - damping**2)
            decaying = np.exp(2 * np.pi * frequency * root * times)
            basis = np.column_stack([decaying.real, -decaying.imag])
            part = planted.parts[k, start:stop] @ shape / (shape @ shape)
            amplitude = complex(*np.linalg.lstsq(basis, part, rcond=None)[0])
            by_pole = amplitude * times * decaying
            slopes = root, frequency * (-1 - 1j * damping / np.sqrt(1 - damping**2))
            for unknown, slope in enumerate(slopes):
                rate = (2 * np.pi * slope * by_pole).real
                columns[:, :, k, unknown] = np.multiply.outer(rate, shape)
            here = slice(2 + channels + 2 * number, 4 + channels + 2 * number)
            columns[:, :, k, here] = basis[:, None] * shape[:, None]
            columns[:, range(channels), k, range(2, 2 + channels)] = part[:, None]
        transforms = np.fft.rfft(columns.reshape(stop - start, channels, -1), axis=0)
        angles = 2 * np.pi * np.arange(len(transforms)) / (stop - start)
        deviation = planted.noise * np.sqrt(noise_spectrum(angles) * (stop - start) / 2)
        rows = (transforms / deviation[:, None, None])[1:-1].reshape(-1, modes * size)
        information = information + (rows.conj().T @ rows).real
    return _of_information(information, np.zeros((modes, size)))


def _bins(planted: Planted, duration):
    """Bins (Hz) without lines, all near modes and some elsewhere, and how many each stands for."""
    structure = planted.structure
    highest = min(1.3 * structure.frequencies[-1], 0.49 * planted.rate)
    bins = np.arange(1, int(duration * highest)) / duration
    for line in planted.lines:
        bins = bins[np.abs(bins - line) > 1.01 / duration]
    widths = structure.damping_ratios * structure.frequencies
    near = np.any(np.abs(bins[:, None] - structure.frequencies) < WIDTHS * widths, axis=1)
    every = max(bins.size // SPARSE, 1)
    keep = near | (np.arange(bins.size) % every == 0)
    return bins[keep], np.where(near, 1.0, every)[keep]


def _stacked(structure: Structure, shapes, inputs):
    """Unknowns (mode, unknown): frequency, damping ratio, shape at the channels, at the inputs."""
    return np.column_stack([structure.frequencies, structure.damping_ratios, shapes, inputs])


def _responses(unknowns, channels, angles, rate) -> Complex[np.ndarray, "bin channel input"]:
    """Transfer functions of the recursion of velocities (`planted_structures.response`)."""
    z = np.exp(-1j * angles)
    found = np.zeros((len(angles), channels, unknowns.shape[1] - 2 - channels), complex)
    for frequency, damping, *others in unknowns:
        pole = 2 * np.pi * frequency * (-damping + 1j * np.sqrt(1 - damping**2))
        root, residue = np.exp(pole / rate), -1j * pole / pole.imag
        above = residue.real - (residue * np.conj(root)).real * z
        own = above / (1 - 2 * root.real * z + abs(root) ** 2 * z**2)
        found = found + own[:, None, None] * np.outer(others[:channels], others[channels:])
    return found


def _slopes(function, unknowns):
    """Derivatives of a function by all unknowns, by central differences."""
    sizes = np.abs(unknowns)
    sizes[:, 2:] = sizes[:, 2:].max(axis=1, keepdims=True)
    for place in np.ndindex(unknowns.shape):
        change = np.zeros_like(unknowns)
        # A lightly damped mode is narrow: its damping ratio is the scale of its frequency.
        change[place] = STEP * sizes[place] * (unknowns[place[0], 1] if place[1] == 0 else 1.0)
        yield (function(unknowns + change) - function(unknowns - change)) / (2 * change[place])


def _of_information(information, unknowns) -> LeastErrors:
    scale = 1 / np.sqrt(np.diag(information) + 1e-300)
    product = np.outer(scale, scale)
    inverse = np.linalg.pinv(information * product, rcond=MIN_DIRECTION, hermitian=True)
    # A variance of nothing may be below zero by rounding, which differs between processors.
    variances = np.maximum(np.diag(inverse * product), 0.0)
    deviations = np.sqrt(variances).reshape(unknowns.shape)
    return LeastErrors(deviations[:, 0], deviations[:, 1])


def why_unidentifiable(
    planted: Planted, mode: int, errors: LeastErrors, duration: float, gain: float = np.inf
) -> str:
    """Reason why a mode is not identifiable from a log of a duration (s); empty if it may be.

    `gain` is its `expected_gain`.
    """
    structure = planted.structure
    frequency, damping = structure.frequencies[mode], structure.damping_ratios[mode]
    lines = [line for line in planted.lines if abs(line - frequency) < 1 / duration]
    if lines:
        return (
            f"{abs(lines[0] - frequency):.2g} Hz from a harmonic, resolution {1 / duration:.2g} Hz"
        )
    if QUANTILE * errors.damping_ratios[mode] > damping:
        return (
            f"damping ratio {damping:.2g} +- {QUANTILE * errors.damping_ratios[mode]:.2g} at best"
        )
    half = QUANTILE * errors.frequencies[mode]
    widths = structure.damping_ratios * structure.frequencies
    for other in np.flatnonzero(np.arange(widths.size) != mode):
        apart = abs(structure.frequencies[other] - frequency)
        if apart < min(half, widths[mode] + widths[other]):
            return f"{apart:.2g} Hz from another, +- {half:.2g} Hz at best"
    if gain < TELLING_GAIN:
        return (
            f"a model without it is as likely but for {gain:.1f}, of {TELLING_GAIN:.1f} that tell"
        )
    return ""


TOLERANCE = 1e-2  # of the expected log likelihood, at which the search ends
MAX_DAMPING_RATIO = 0.5
REACH = 5.0  # half-power widths, of both together, that another mode may move to replace one


def expected_gain(planted: Planted, mode: int, duration: float, shaken: bool = False) -> float:
    """Expected log likelihood of the log with the mode, above that of the best model without it.

    `shaken` is that of `random_response`. The search begins without the mode, and with the nearest
    other mode in its place; modes elsewhere stay there, also those that are too weak to identify.
    """
    response = random_response(planted, duration, shaken)
    unknowns = response.unknowns
    expected = response.spectra(unknowns)
    least = _cost(response, expected, unknowns)
    without = np.delete(unknowns, mode, axis=0)
    if not without.size:
        return _cost(response, expected, without) - least
    moved = without.copy()
    nearest = int(np.argmin(np.abs(without[:, 0] - unknowns[mode, 0])))
    moved[nearest, :2] = unknowns[mode, :2]
    reach = without[:, 0] * without[:, 1] + unknowns[mode, 0] * unknowns[mode, 1]
    places = without[:, 0], REACH * reach
    costs = [_least_cost(response, expected, start, places) for start in (without, moved)]
    return min(costs) - least


def _cost(response: RandomResponse, expected, unknowns) -> float:
    """Minus the expected log likelihood."""
    spectra = response.spectra(unknowns)
    level = np.linalg.slogdet(spectra)[1]
    fit = np.linalg.solve(spectra, expected).trace(axis1=1, axis2=2).real
    return float(np.sum(response.weights * (level + fit)))


def _are_possible(unknowns, places) -> bool:
    """Whether modes are damped, and within reach of their places (Hz)."""
    frequencies, damping = unknowns[:, 0], unknowns[:, 1]
    near = np.abs(frequencies - places[0]) < places[1]
    return bool(np.all(near & (frequencies > 0) & (damping > 0) & (damping < MAX_DAMPING_RATIO)))


def _least_cost(response: RandomResponse, expected, unknowns, places) -> float:
    """Least cost near a start, by damped Fisher scoring; infinite for a start out of reach."""

    def cost_at(unknowns):
        possible = _are_possible(unknowns, places)
        return _cost(response, expected, unknowns) if possible else np.inf

    def moved(unknowns, step):
        other = unknowns + step.reshape(unknowns.shape)
        return other, cost_at(other)

    def scored(unknowns):
        return information(response, expected, unknowns)

    cost = cost_at(unknowns)
    if np.isinf(cost):
        return cost
    return damped_scoring(unknowns, cost, scored, moved, TOLERANCE)[1]
