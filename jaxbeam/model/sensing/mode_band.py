"""Modes that count for what a sensor measures: all, or those of EN 1990, A2.4.4.2.1.

For deck accelerations of railway bridges: frequencies up to the largest of 30 Hz, 1.5 f_1 and f_3.
"""

from jaxtyping import Float

from jaxbeam.model.modal_model import ModalModel
from jaxbeam.model.modes import Modes
from jaxbeam.runtime.arrays import Array, xp

LEAST_FREQUENCY = 30.0  # Hz
FIRST_MODE_FACTOR = 1.5
MODES_AT_LEAST = 3
ROUNDING = 1e-9  # of a frequency


def counted_frequency(frequencies: Float[Array, " mode"]) -> Float[Array, ""]:
    """Frequency (Hz) up to which modes count: the largest of 30 Hz, 1.5 f_1 and f_3.

    `frequencies` (Hz) ascend.
    """
    third = frequencies[min(MODES_AT_LEAST, frequencies.shape[0]) - 1]
    limit = xp.maximum(LEAST_FREQUENCY, FIRST_MODE_FACTOR * frequencies[0])
    return xp.maximum(limit, third) * (1 + ROUNDING)


def band_weights(modes: Modes, band: str) -> Float[Array, " mode"]:
    """1 for the modes of a band ("all" or "en1990"), 0 for the others."""
    frequencies = modes.frequencies
    if band == "all":
        return xp.ones(frequencies.shape)
    return xp.where(frequencies <= counted_frequency(frequencies), 1.0, 0.0)


def banded_fields(model: ModalModel, band: str):
    """Function like `ModalModel.fields` without the modes outside a band."""
    if band == "all":
        return model.fields
    weights = band_weights(model.modes, band)

    def fields(x, orders: tuple[int, ...]):
        rows = model.modes.fields(x, orders) * weights
        return rows if model.mode_map is None else rows @ model.mode_map

    return fields
