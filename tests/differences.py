"""Derivatives by central differences, independent of automatic differentiation."""

import numpy as np


def central(function, point, step: float = 1e-3, order: int = 6) -> np.ndarray:
    """Jacobian of a function of a vector, (result..., entry), by central differences.

    The step is absolute. The error is step^order, plus rounding divided by the step.
    """
    weights = {2: (1 / 2,), 4: (2 / 3, -1 / 12), 6: (3 / 4, -3 / 20, 1 / 60)}[order]
    point, columns = np.asarray(point, float), []
    for i in range(point.size):
        unit = step * np.eye(point.size)[i]
        columns.append(
            sum(
                w * (np.asarray(function(point + n * unit)) - function(point - n * unit)) / step
                for n, w in enumerate(weights, 1)
            )
        )
    return np.stack(columns, axis=-1)
