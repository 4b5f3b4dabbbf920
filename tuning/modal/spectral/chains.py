"""Modes of chains of a stabilisation diagram, with uncertainties from changes by blocks."""

import numpy as np
from jaxtyping import Complex, Float

from tuning.modal.ambient import mode_of_chain
from tuning.modal.result import IdentifiedMode
from tuning.modal.stabilisation import Chain
from tuning.modal.subspace import Poles, Spread


def mode_of_best_half(
    poles: Poles,
    chain: Chain,
    spreads: dict[int, Spread],
    scale: Float[np.ndarray, " channel"],
) -> IdentifiedMode:
    """Mode of a chain: the median pole of the half that is determined best.

    The scatter of that half over the degrees adds to its uncertainty, as the choice among them is
    not free of it.
    """
    ranked = sorted(chain.members.tolist(), key=lambda k: np.linalg.det(spreads[k].covariance))
    half = np.array(ranked[: max(len(ranked) // 2, 1)])
    values = poles.poles[half]
    centre = np.median(values.real) + 1j * np.median(values.imag)
    which = half[[np.argmin(np.abs(values - centre))]]
    mode = mode_of_chain(poles, Chain(which, int(which[0])), spreads, scale)
    return mode._replace(
        frequency_sd=float(np.hypot(mode.frequency_sd, poles.frequencies[half].std())),
        damping_sd=float(np.hypot(mode.damping_sd, poles.damping_ratios[half].std())),
    )


def spread_of_changes(
    pole: complex,
    changes: Complex[np.ndarray, " block"],
    shape: Complex[np.ndarray, " channel"],
) -> Spread:
    """Uncertainty of frequency and damping ratio of a pole from its changes by blocks.

    The covariance of the shape is left zero.
    """
    size = np.abs(pole)
    radial = np.real(np.conj(pole) * changes) / size
    by_damping = -changes.real / size + pole.real * radial / size**2
    stacked = np.stack([radial / (2 * np.pi), by_damping], axis=-1)
    parts = 2 * shape.size
    return Spread(
        stacked.T @ stacked,
        shape / shape[np.argmax(np.abs(shape))],
        np.zeros((parts, parts)),
        float(max(len(changes) - 1, 1)),
    )
