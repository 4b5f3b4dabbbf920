"""A time-varying plant x' = A(t) x + B(t) u over a period with held inputs u, by scipy."""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.integrate import solve_ivp

INSIDE = 1e-12  # s: matrices are taken so far inside an interval, as they jump at events


def over_period(
    matrices_at: Callable, start: float, end: float, events: Sequence[float] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Transition and input matrix from one time (s) to another; no interval contains an event."""
    cuts = np.unique([start, *[t for t in events if start < t < end], end])
    states, inputs = matrices_at((start + end) / 2)[1].shape
    shape = states, states + inputs
    total = np.eye(*shape)
    for early, late in zip(cuts[:-1], cuts[1:], strict=True):

        def rate(t, flat, early=early, late=late):
            A, B = matrices_at(np.clip(t, early + INSIDE, late - INSIDE))
            rates = A @ flat.reshape(shape)
            rates[:, states:] += B
            return rates.ravel()

        settings = {"method": "DOP853", "rtol": 1e-10, "atol": 1e-13 * np.abs(total).max()}
        total = solve_ivp(rate, (early, late), total.ravel(), **settings).y[:, -1]
        total = total.reshape(shape)
    return total[:, :states], total[:, states:]
