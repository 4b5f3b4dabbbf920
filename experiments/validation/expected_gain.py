"""Expected gain of the log likelihood of a log by a mode, whatever the method.

The logarithm of the likelihood ratio of the true model and the best one without the mode is, on
average over logs, the least Kullback-Leibler divergence of their spectra.
"""

import numpy as np

from experiments.validation.least_errors import RandomResponse, information, random_response
from tests.oracles.planted_structures import Planted
from tuning.modal.likelihood.model import damped_scoring

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
