"""Damped Fisher scoring: steps of the information, in which each unknown has its own scale."""

from collections.abc import Callable
from typing import TypeVar

import numpy as np
from jaxtyping import Float

MAX_ITERATIONS = 40
MAX_TRIES, MIN_DAMPING = 10, 1e-6  # of a step, whose damping grows by eight each time

Point = TypeVar("Point")
Information = tuple[Float[np.ndarray, " unknown"], Float[np.ndarray, "unknown unknown"]]


def damped_scoring(
    point: Point,
    cost: float,
    information: Callable[[Point], Information],
    moved: Callable[[Point, Float[np.ndarray, " unknown"]], tuple[Point, float]],
    tolerance: float,
    largest_steps: Callable[[Point, int], Float[np.ndarray, " unknown"] | float] | None = None,
) -> tuple[Point, float]:
    """Point of the least cost near a start, and its cost; it is at the minimum to a `tolerance`.

    `information` returns the gradient of the cost and Fisher's information at a point, `moved` the
    point after a step of its unknowns with its cost, infinite where it may not be;
    `largest_steps` those of so many unknowns, where they are limited.
    """
    damping = 1e-3
    for _ in range(MAX_ITERATIONS):
        gradient, fisher = information(point)
        scale = 1 / np.sqrt(np.diag(fisher) + 1e-300)
        if largest_steps is not None:
            scale = np.minimum(scale, largest_steps(point, len(fisher)))
        scaled = fisher * np.multiply.outer(scale, scale)
        for _ in range(MAX_TRIES):
            matrix = scaled + damping * np.eye(len(scaled))
            other, found = moved(point, -scale * np.linalg.solve(matrix, scale * gradient))
            if found < cost:
                break
            damping *= 8
        else:
            break
        gain, damping = cost - found, max(damping / 4, MIN_DAMPING)
        point, cost = other, found
        if gain < tolerance:
            break
    return point, cost
