"""What the likelihood of a log is expected to gain from a mode, whatever the method.

The logarithm of the likelihood ratio of the true model and the best one without the mode is, on
average over logs, the least Kullback-Leibler divergence of their spectra.
"""

import numpy as np

from experiments.validation.least_errors import RandomResponse, information, random_response
from tests.oracles.planted_structures import Planted

MAX_ITERATIONS, MAX_TRIES, TOLERANCE = 60, 12, 1e-2
MAX_DAMPING_RATIO = 0.5
REACH = 5.0  # half-power widths, of both together, that another mode may move to replace one


def expected_gain(planted: Planted, mode: int, duration: float, shaken: bool = False) -> float:
    """Expected log likelihood of the log with the mode, above that of the best model without it.

    `shaken` is that of `random_response`. The search begins without the mode, and with the nearest
    other mode in its place; modes elsewhere stay there, also those that are too weak to tell.
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
    if not _are_possible(unknowns, places):
        return np.inf
    cost, damping = _cost(response, expected, unknowns), 1e-3
    for _ in range(MAX_ITERATIONS):
        gradient, fisher = information(response, expected, unknowns)
        scale = 1 / np.sqrt(np.diag(fisher) + 1e-300)
        scaled = fisher * np.outer(scale, scale)
        for _ in range(MAX_TRIES):
            matrix = scaled + damping * np.eye(len(scaled))
            step = scale * np.linalg.solve(matrix, scale * gradient)
            other = unknowns - step.reshape(unknowns.shape)
            found = np.inf
            if _are_possible(other, places):
                found = _cost(response, expected, other)
            if found < cost:
                break
            damping *= 8
        else:
            break
        gain, damping = cost - found, max(damping / 4, 1e-6)
        unknowns, cost = other, found
        if gain < TOLERANCE:
            break
    return cost
