"""p-LSCF where forces were measured: spectra of responses over those of forces, without windows.

Transforms of whole records obey

    a(z) Y_o(z) = sum_i b_oi(z) U_i(z) + t_o(z),   z = exp(i w T),

with polynomials of one degree: a is the common denominator, b / a are the frequency responses, and
t is what the states at the start and the end of a record leave (Pintelon and Schoukens 2012,
section 6.3), so that there is no leakage however lightly the structure is damped. The polynomials
are found by linear least squares over all lines (Guillaume et al. 2003), first unweighted, then
weighted by 1 / |a|, which makes the error that of the outputs (Sanathanan and Koerner 1963). With a
lowest coefficient of one, poles that stand for noise are unstable, and fall away.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

HIGHEST_LINE = 1.15  # of transforms, over the upper end of a band
MAX_ANGLE = 2.8  # of z on the circle, of a band from 0
PART_LINES = 4096  # lines whose products are formed at once
# Products of driving signals over the largest, below which they are none: a thousandth of the
# signals, less than noise. Early impacts are nearly powers of z; a shape would be a difference of
# large gains of them and of the transient, whatever their sum fits.
MIN_DRIVING = 1e-6


class Lines(NamedTuple):
    """Lines of the transforms of all records: spectra (line, output), (line, input), z and record.

    `step` is the sampling step (s); `level`, if any, is what spectra of each line were multiplied
    by, so that errors of all lines have one variance.
    """

    outputs: Complex[np.ndarray, "line output"]
    inputs: Complex[np.ndarray, "line input"]
    z: Complex[np.ndarray, " line"]
    record: Int[np.ndarray, " line"]
    step: float
    level: Float[np.ndarray, " line"] | None = None

    @property
    def spacing(self) -> float:
        """Typical distance (1/s) of neighbouring lines."""
        return float(np.median(np.abs(np.diff(np.angle(self.z)))) / self.step)

    @property
    def unforced(self) -> Float[np.ndarray, "line record"]:
        """Columns of one at the lines of each record, for its transient."""
        own = (self.record[:, None] == np.arange(self.record.max() + 1)).astype(float)
        return own if self.level is None else own * self.level[:, None]

    def part(self, lines: Bool[np.ndarray, " line"]) -> "Lines":
        """Some of the lines."""
        level = None if self.level is None else self.level[lines]
        return Lines(
            self.outputs[lines], self.inputs[lines], self.z[lines], self.record[lines], self.step,
            level,
        )  # fmt: skip


class Products(NamedTuple):
    """Products (signal, power, signal, power) of z^j and z^m times signals, summed over lines.

    Signals are outputs, inputs, and one for each record, of the `lines`.
    """

    gram: Float[np.ndarray, "signal power signal power"]
    outputs: int
    lines: Lines


class CommonDenominator(NamedTuple):
    """Denominator a, lowest power first; poles (1/s) in the upper half plane; unit shapes."""

    denominator: Float[np.ndarray, " power"]
    poles: Complex[np.ndarray, " pole"]
    shapes: Complex[np.ndarray, "pole output"]


def transforms(
    records: tuple[Float[np.ndarray, "_ output"], ...],
    forces: tuple[Float[np.ndarray, "_ input"], ...],
    rate: float,
    band: tuple[float, float],
) -> Lines:
    """Discrete Fourier transforms of records and forces at the lines of a band (Hz).

    These are of whole records as sampled. The step of z is stretched, so that the band fills most
    of the circle, which powers of z need.
    """
    step = max(MAX_ANGLE / (2 * np.pi * band[1]), 1 / rate)
    outputs, inputs, z, numbers = [], [], [], []
    for number, (record, force) in enumerate(zip(records, forces, strict=True)):
        bins = np.fft.rfftfreq(len(record), 1 / rate)
        lines = (bins >= band[0]) & (bins <= band[1])
        scale = 1 / np.sqrt(len(record))
        outputs.append(scale * np.fft.rfft(record, axis=0)[lines])
        inputs.append(scale * np.fft.rfft(force, axis=0)[lines])
        z.append(np.exp(2j * np.pi * bins[lines] * step))
        numbers.append(np.full(lines.sum(), number))
    return Lines(
        np.concatenate(outputs), np.concatenate(inputs), np.concatenate(z),
        np.concatenate(numbers), step,
    )  # fmt: skip


def products(
    lines: Lines, degree: int, weights: Float[np.ndarray, " line"] | None = None
) -> Products:
    """Products for all degrees to the highest, by default with equal weights of the lines."""
    signals = np.concatenate([lines.outputs, lines.inputs, lines.unforced], axis=1)
    if weights is not None:
        signals = signals * weights[:, None]
    count = signals.shape[1]
    sums = np.zeros((count * count, 2 * degree + 1))
    for first in range(0, len(signals), PART_LINES):
        own, z = signals[first : first + PART_LINES], lines.z[first : first + PART_LINES]
        pairs = (own.conj()[:, :, None] * own[:, None, :]).reshape(len(own), -1)
        powers = z[:, None] ** np.arange(-degree, degree + 1)
        sums += pairs.real.T @ powers.real - pairs.imag.T @ powers.imag
    # Products depend on the difference of the powers only.
    shift = np.arange(degree + 1) - np.arange(degree + 1)[:, None] + degree
    gram = sums.reshape(count, count, -1)[:, :, shift].transpose(0, 2, 1, 3)
    return Products(gram, lines.outputs.shape[1], lines)


def fit_common_denominator(system: Products, degree: int) -> CommonDenominator:
    """Polynomials of a degree, at most that of the products.

    A shape is what all numerators at a root make of the signals at the line nearest to it: how much
    is forced and how much free, which one impact leaves open, does not matter.
    """
    size, outputs = degree + 1, system.outputs
    part = system.gram[:, :size, :, :size]
    driving = part[outputs:, :, outputs:].reshape(-1, (part.shape[0] - outputs) * size)
    crossed = part[outputs:, :, :outputs].reshape(len(driving), -1)
    gains = np.linalg.lstsq(driving, crossed, rcond=MIN_DRIVING)[0]
    crossed, gains = (one.reshape(len(driving), outputs, size) for one in (crossed, gains))
    matrix = np.einsum("ojok->jk", part[:outputs, :, :outputs])
    matrix = matrix - np.tensordot(crossed, gains, axes=((0, 1), (0, 1)))
    free = np.linalg.lstsq(matrix[1:, 1:], -matrix[1:, 0], rcond=1e-15)[0]
    denominator = np.concatenate([[1.0], free])
    roots = np.roots(denominator[::-1])
    roots = roots[(roots.imag > 0) & (np.abs(roots) < 1e6)]
    numerators = (gains @ denominator).reshape(-1, size, outputs)
    at_roots = roots[:, None] ** np.arange(size)
    responses = np.einsum(
        "rp,xpo,rkx->rok", at_roots, numerators, _signals_at(system.lines, roots), optimize=True
    )
    shapes = np.linalg.svd(responses)[0][:, :, 0]
    return CommonDenominator(denominator, np.log(roots) / system.lines.step, shapes)


def _signals_at(lines: Lines, roots):
    """Inputs and unforced terms (root, record, signal) at the lines nearest to roots."""
    signals = np.concatenate([lines.inputs, lines.unforced], axis=1)
    found = []
    for record in range(int(lines.record.max()) + 1):
        own = np.flatnonzero(lines.record == record)
        distance = np.abs(np.angle(lines.z[own])[:, None] - np.angle(roots))
        found.append(signals[own[np.argmin(distance, axis=0)]])
    return np.stack(found, axis=1)
