"""Filter of mode shapes and influence functions by a track that spreads the force of an axle.

A force that acts in shares w_k at x + o_k has the influence sum_k w_k f(x + o_k) where f(x) is that
of a force at x, zero off the beam. An even one over a length s has (F(x + s/2) - F(x - s/2)) / s,
with the integral F of f from the left end. As f is a polynomial between the nodes of the beam,
both are polynomials between the nodes less the offsets: the filter is exact, for mode shapes, hence
forces on the modes, and for static influence alike.
"""

import functools
from collections.abc import Callable

import numpy as np
from jaxtyping import Float
from numpy.polynomial import chebyshev

from jaxbeam.case.track import Kernel
from jaxbeam.numerics.polynomials import chebyshev_polynomials
from jaxbeam.runtime.arrays import Array, add_at, take, xp
from jaxbeam.runtime.module import Module


class SpreadShapes(Module):
    """Series of filtered mode shapes (kg^-1/2) between nodes (m), over the position of an axle.

    `offsets` (m) are those of the track's kernel; `twist` is the series of the twist, if any.
    """

    nodes: Float[Array, " node"]
    series: Float[Array, "segment degree mode"]
    offsets: Float[Array, " share"]
    twist: Float[Array, "segment degree mode"] | None = None


def to_series(breaks, terms: int, function: Callable) -> Float[Array, "piece term output"]:
    """Chebyshev series between breaks (m) through the values (..., output) of a function."""
    points = chebyshev.chebpts1(terms)
    middle, half = (breaks[1:] + breaks[:-1]) / 2, xp.diff(breaks) / 2
    values = function(middle[:, None] + half[:, None] * points)
    scale = np.where(np.arange(terms) == 0, 1.0, 2.0)[:, None] / terms
    to_series = scale * chebyshev.chebvander(points, terms - 1).T
    return xp.einsum("kp,spo->sko", to_series, values)


@functools.cache
def _integration_matrix(terms: int) -> np.ndarray:
    """Matrix from a Chebyshev series to that of its integral from -1, one term longer."""
    return chebyshev.chebint(np.eye(terms), lbnd=-1)


def spread_series(
    kernel: Kernel, nodes: Float[Array, " node"], series: Float[Array, "segment term column"]
) -> tuple[Float[Array, " break"], Float[Array, "piece _ column"]]:
    """Breaks (m), and series between them, of a function filtered by the kernel of a track.

    The function is given by its `series` between `nodes` (m) and is zero beyond.
    """
    last = 0.0
    if kernel.integrated:
        integral = _integration_matrix(series.shape[1]) @ series
        integral = integral * (xp.diff(nodes) / 2)[:, None, None]
        ends = xp.cumsum(xp.sum(integral, axis=1), axis=0)
        first = xp.concatenate([xp.zeros_like(ends[:1]), ends[:-1]])
        series, last = add_at(integral, np.s_[:, 0], first), ends[-1]
    breaks = xp.sort((nodes[:, None] - kernel.offsets).reshape(-1))
    middle = (breaks[1:] + breaks[:-1]) / 2

    def values(x):
        total = xp.zeros((*x.shape, series.shape[2]))
        for offset, weight in zip(kernel.offsets, kernel.weights, strict=True):
            within = (middle + offset)[:, None]  # in which segment, whatever rounding does
            segment = xp.sum(within[..., None] >= nodes[1:-1], axis=-1)
            left, right = take(nodes, segment), take(nodes, segment + 1)
            width = xp.where(right > left, right - left, 1.0)
            local = xp.clip((2 * (x + offset) - left - right) / width, -1.0, 1.0)
            table = chebyshev_polynomials(local, series.shape[1])
            found = xp.einsum("spk,skc->spc", table, take(series, segment[:, 0]))
            found = xp.where((within < nodes[0])[..., None], 0.0, found)
            found = xp.where((within >= nodes[-1])[..., None], last, found)
            total = total + weight * found
        return total

    return breaks, to_series(breaks, series.shape[1], values)
