"""Discrete-time equivalents of x' = A x + B u, exact for inputs polynomial between samples."""

import math

import numpy as np
from jaxtyping import Float

from jaxbeam.numerics.matrices import expm
from jaxbeam.numerics.polynomials import powers
from jaxbeam.runtime.arrays import (
    Array,
    fori_loop,
    is_jax,
    scan,
    set_at,
    stop_gradient,
    take,
    xp,
)

DOUBLINGS = 14  # of the short interval of the series
SERIES_ROUNDING = 1e-16  # of a term of a series of exp(M), below which it is the last
MAX_SERIES_TERMS = 20  # while the norm of M is below 1
SERIES_TERMS = 10  # exact to rounding while the norm of the matrix over that interval is below 0.05


def c2d(
    A: Float[Array, "state state"],
    B: Float[Array, "state input"],
    period: Float[Array, ""] | float,
    degree: int = 0,
) -> tuple[Float[Array, "state state"], Float[Array, "power state input"]]:
    """Transition Phi and input matrices Gamma over a period h: x(h) = Phi x(0) + sum_k Gamma_k c_k.

    The input is u(s) = sum_k c_k (s / h)^k with k up to `degree`: 0 is a zero-order hold, 1 a
    first-order hold with c_0 = u(0) and c_1 = u(h) - u(0). Exact, by one matrix exponential
    (Van Loan, IEEE Trans. Automatic Control 1978) of the balanced system.
    """
    scale = balance(A)
    A, B = A * scale / scale[:, None], B / scale[:, None]
    states, inputs = B.shape
    powers = degree + 1
    # The derivatives of the input by s / h are further states, each the rate of the previous one.
    block = xp.zeros((states + inputs * powers,) * 2)
    block = set_at(block, np.s_[:states, :states], A * period)
    block = set_at(block, np.s_[:states, states : states + inputs], B * period)
    block = set_at(block, np.s_[states:, states:], np.kron(np.eye(powers, k=1), np.eye(inputs)))
    exponential = expm(block)
    input_matrix = exponential[:states, states:].reshape(states, powers, inputs)
    factorials = np.array([math.factorial(k) for k in range(powers)], float)
    transition = exponential[:states, :states] * scale[:, None] / scale
    return transition, xp.moveaxis(input_matrix, 1, 0) * factorials[:, None, None] * scale[:, None]


def exponential_and_gramian(
    matrix: Float[Array, "*batch state state"], intensity: Float[Array, "*batch state state"]
) -> tuple[Float[Array, "*batch state state"], Float[Array, "*batch state state"]]:
    """exp(M) and the integral of exp(M s) N exp(M's) over s from 0 to 1; N is the intensity.

    By the series of a small fraction of M and doubling: unlike the blocks of one larger exponential
    (Van Loan 1978), this is accurate however fast the plant decays.
    """
    scaled_matrix, scaled_intensity = matrix / 2**DOUBLINGS, intensity / 2**DOUBLINGS
    identity = xp.broadcast_to(xp.eye(matrix.shape[-1]), matrix.shape)

    def horner(sums, k):
        exponential, integral = sums
        product = scaled_matrix @ integral
        return (
            identity + scaled_matrix @ exponential / k,
            scaled_intensity + (product + product.mT) / (k + 1),
        ), None

    def double(sums, _):
        exponential, integral = sums
        return (exponential @ exponential, integral + exponential @ integral @ exponential.mT), None

    sums, _ = scan(horner, (identity, scaled_intensity), np.arange(SERIES_TERMS, 0.0, -1.0))
    return scan(double, sums, length=DOUBLINGS)[0]


def balance(matrix: Float[Array, "state state"]) -> Float[Array, " state"]:
    """Scale of the states with which rows and columns of the matrix have similar norms.

    Without it, squaring an exponential of deflections in m and their rates in m/s loses digits.
    The balanced matrix is A * scale / scale[:, None]. The scale has no derivative: use it where
    results depend on it by rounding only, else `differentiable_balance`.
    """
    return stop_gradient(differentiable_balance(matrix))


def differentiable_balance(matrix: Float[Array, "state state"]) -> Float[Array, " state"]:
    """Scale of the states as `balance` returns it, with its derivative."""
    size = xp.abs(matrix) * (1 - np.eye(matrix.shape[0]))

    def equalise(_, scale):
        scaled = size * scale / scale[:, None]
        rows, columns = xp.sum(scaled, axis=1), xp.sum(scaled, axis=0)
        both = (rows > 0) & (columns > 0)
        ratio = xp.where(both, rows, 1.0) / xp.where(both, columns, 1.0)
        return scale * ratio**0.25  # half the step for one state, as all change at once

    start = xp.ones_like(xp.diagonal(matrix))
    return fori_loop(0, 20, equalise, start)


def propagate(matrix, t, duration, substeps: int, start):
    """State x(t + duration) of x' = matrix(time) x from x(t) = start, a vector or matrix.

    Each substep is two exponentials of matrices at Gauss nodes (order 4; Blanes and Moan, Applied
    Numerical Mathematics 56, 2006), exact for a constant matrix. For several concrete times t at
    once, `matrix` and `start` have them as their first axis.
    """
    step = duration / substeps
    first_node, second_node = 0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6
    larger_weight, smaller_weight = (
        (0.25 + math.sqrt(3) / 6) * step,
        (0.25 - math.sqrt(3) / 6) * step,
    )

    def step_state(state, time):
        first, second = matrix(time + first_node * step), matrix(time + second_node * step)
        for part in (
            larger_weight * first + smaller_weight * second,
            smaller_weight * first + larger_weight * second,
        ):
            state = exponential_times(part, state)
        return state, None

    starts = np.arange(substeps).reshape(-1, *(1,) * xp.ndim(t))
    return scan(step_state, start, t + step * starts)[0]


def exponential_times(matrix, state):
    """Product exp(M) X; for a stack of concrete matrices by the series of the product."""
    if is_jax(matrix) or matrix.ndim == 2:
        return expm(matrix) @ state
    scale = balance(np.max(np.abs(matrix), axis=0))
    matrix, state = matrix * scale / scale[:, None], state / scale[:, None]
    # Inputs, whose rates are zero, add nothing to powers of the matrix.
    varies = np.any(matrix, axis=(0, 2))
    norm = np.max(np.sum(np.abs(matrix[:, :, varies]), axis=1), initial=0.0)
    parts = max(1, math.ceil(norm))
    bounds = np.cumprod(norm / parts / np.arange(1, MAX_SERIES_TERMS))
    terms = 2 + int(np.sum(bounds > SERIES_ROUNDING))
    matrix = matrix / parts
    for _ in range(parts):
        series = state
        for power in range(terms, 0, -1):
            series = matrix @ series
            series /= power
            series += state
        state = series
    return state * scale[:, None]


def hermite_cubics(
    times: Float[Array, " time"],
    values: Float[Array, " time"],
    rates: Float[Array, " time"] | None = None,
) -> Float[Array, "interval power"]:
    """Coefficients c_k of the cubics in s / h through samples and their rates (per s).

    Without rates they are straight lines.
    """
    difference = xp.diff(values)
    start, end = (difference, difference)
    if rates is not None:
        duration = xp.diff(times)
        start, end = rates[:-1] * duration, rates[1:] * duration
    return xp.stack(
        [values[:-1], start, 3 * difference - 2 * start - end, start + end - 2 * difference], -1
    )


def evaluate_cubics(
    times: Float[Array, " time"],
    coefficients: Float[Array, "interval power"],
    query_times: Float[Array, " *query"],
) -> Float[Array, " *query"]:
    """Values of piecewise cubics at any times (s); held before the first and after the last."""
    interval = xp.clip(
        xp.searchsorted(times, query_times, side="right") - 1, 0, coefficients.shape[0] - 1
    )
    start = take(times, interval)
    fraction = (query_times - start) / (take(times, interval + 1) - start)
    own = xp.moveaxis(take(coefficients, interval), -1, 0)
    return xp.sum(own * powers(xp.clip(fraction, 0.0, 1.0), own.shape[0]), axis=0)
