"""One mode shape from parts of it, each with a scale of its own, by least squares.

What a setup measures is c_s Phi at its channels, Phi the shape and c_s a complex scale. Shape and
scales that fit all parts best, each weighted by its variance, are found by Gauss-Newton steps; that
is post-separate-estimation re-scaling (PoSER; Reynders, Magalhaes, De Roeck and Cunha 2009), with
all references of all setups at once. Errors of the parts are propagated to first order.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

STEPS = 12  # of Gauss and Newton, at most
MIN_VARIANCE = 1e-8  # of a component over the largest, for weights
OTHER_ERROR = 0.02  # of a component over the largest: calibration, added to its stated error
MIN_SIGNAL = 3.0  # size of a shape at the references over its error


class Part(NamedTuple):
    """A shape at some channels; `covariance` is that of its real parts, then imaginary parts."""

    shape: Complex[np.ndarray, " own"]
    covariance: Float[np.ndarray, "part part"]
    channels: Int[np.ndarray, " own"]

    @property
    def variances(self) -> Float[np.ndarray, " own"]:
        """Variance of each component: of its real and imaginary part together."""
        diagonal = np.diag(self.covariance)
        return diagonal[: self.shape.size] + diagonal[self.shape.size :]


class WholeShape(NamedTuple):
    """Shape with a largest component of one, NaN at channels without, and its covariance.

    `joined` are the parts that it is made of; `misfit` is the rms difference of the parts at common
    channels over that expected from their errors, which are widened by it beyond one.
    """

    shape: Complex[np.ndarray, " channel"]
    covariance: Float[np.ndarray, "part part"]
    joined: tuple[int, ...]
    misfit: float


def whole_shape(parts: Sequence[Part], count: int) -> WholeShape:
    """Whole shape at `count` channels, joined from its parts.

    A part whose common channels with the others are all near a node of the mode, or that has none,
    cannot be scaled and is left out.
    """
    start, scales = _joined(parts, count)
    used = tuple(sorted(scales))
    present = np.flatnonzero(np.isfinite(start))
    largest = int(present[np.argmax(np.abs(start[present]))])
    free = np.array([i for i in present if i != largest], int)
    shape = start / start[largest]
    scale = np.array([scales[k] for k in used]) * start[largest]
    own = [parts[k] for k in used]
    measured = np.concatenate([part.shape for part in own])
    which = np.concatenate([part.channels for part in own])
    by = np.repeat(np.arange(len(own)), [part.shape.size for part in own])
    weights = np.sqrt([1 / (part.variances.mean() + MIN_VARIANCE) for part in own])[by]
    rows = np.arange(measured.size)
    column = np.full(count, -1)
    column[free] = np.arange(free.size)
    moving = which != largest
    for _ in range(STEPS):
        slopes = np.zeros((measured.size, free.size + len(own)), complex)
        slopes[rows[moving], column[which[moving]]] = scale[by[moving]]
        slopes[rows, free.size + by] = shape[which]
        inverse = np.linalg.pinv(weights[:, None] * slopes) * weights
        step = inverse @ (measured - scale[by] * shape[which])
        shape[free] += step[: free.size]
        scale = scale + step[free.size :]
    covariance = _block_diagonal([part.covariance for part in own])
    rest = measured - scale[by] * shape[which]
    left = _real(weights[:, None] * (np.eye(measured.size) - slopes @ inverse))
    expected = np.trace(left @ covariance @ left.T)
    disagreement = float(np.sum(np.abs(weights * rest) ** 2))
    misfit = float(np.sqrt(disagreement / expected)) if expected > 0 else 0.0
    forward = _real(inverse[: free.size])
    errors = forward @ covariance @ forward.T * max(misfit, 1.0) ** 2
    all_errors = np.full((2 * count, 2 * count), np.nan)
    both = np.concatenate([present, count + present])
    all_errors[np.ix_(both, both)] = 0.0
    both = np.concatenate([free, count + free])
    all_errors[np.ix_(both, both)] = errors
    return WholeShape(shape, all_errors, used, misfit)


def _joined(parts: Sequence[Part], count: int):
    """A first shape, NaN where there is none, and the scales of the parts that it is made of."""
    first = max(range(len(parts)), key=lambda k: parts[k].shape.size)
    shape, variances = np.full(count, np.nan, complex), np.zeros(count)
    shape[parts[first].channels] = parts[first].shape
    variances[parts[first].channels] = parts[first].variances
    scales = {first: 1.0 + 0j}
    while True:
        signals = {
            k: _signal(part, shape, variances) for k, part in enumerate(parts) if k not in scales
        }
        best = max(signals, key=lambda k: signals[k], default=None)
        if best is None or signals[best] < MIN_SIGNAL:
            return shape, scales
        part = parts[best]
        common = np.isfinite(shape[part.channels])
        old = shape[part.channels[common]]
        scales[best] = np.vdot(old, part.shape[common]) / np.vdot(old, old).real
        new = part.channels[~common]
        shape[new] = part.shape[~common] / scales[best]
        variances[new] = part.variances[~common] / abs(scales[best]) ** 2


def _signal(part: Part, shape, variances) -> float:
    """Signal-to-error ratio of a part and of a shape at their common channels, the smaller one."""
    common = np.isfinite(shape[part.channels])
    if not common.any():
        return 0.0
    places = part.channels[common]
    pairs = (
        (np.abs(part.shape), part.shape[common], part.variances[common]),
        (np.abs(shape[np.isfinite(shape)]), shape[places], variances[places]),
    )
    return min(
        float(np.sqrt(np.sum(np.abs(one) ** 2) / np.sum(own + (OTHER_ERROR * whole.max()) ** 2)))
        for whole, one, own in pairs
    )


def _block_diagonal(covariances: Sequence[np.ndarray]) -> np.ndarray:
    """Covariance of all real parts, then all imaginary parts, of independent shapes."""
    sizes = [len(one) // 2 for one in covariances]
    total, start = sum(sizes), 0
    found = np.zeros((2 * total, 2 * total))
    for one, size in zip(covariances, sizes, strict=True):
        own = np.arange(start, start + size)
        both = np.concatenate([own, total + own])
        found[np.ix_(both, both)] = one
        start += size
    return found


def _real(matrix: np.ndarray) -> np.ndarray:
    """Real matrix on real, then imaginary parts that is equivalent to a complex one."""
    return np.block([[matrix.real, -matrix.imag], [matrix.imag, matrix.real]])
