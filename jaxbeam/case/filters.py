"""Low-pass filters of sensors: Butterworth, digital or analogue.

Both are cascades of second-order sections (and one of first order if the order is odd), each with
a static gain of one, that follow from the poles of the prototype with a cutoff of 1 rad/s. Cutoff
and sampling period may be traced, batched and differentiated.
"""

import functools

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import POSITIVE, choice, concrete, count, is_concrete, number
from jaxbeam.runtime.arrays import Array, Number, scan, xp


class Filter(ReprWithUnits):
    """Low-pass filter with gain 1 at low frequency and 1 / sqrt(2) at the cutoff.

    An analogue filter acts on the signal before it is sampled, a digital one on the samples.

    >>> import jaxbeam as jb
    >>> sensor = jb.Sensor(0.3, filter=jb.Filter(cutoff=40.0, order=2))
    >>> print(sensor.filter.cutoff, sensor.filter.kind)
    40.0 butterworth
    """

    cutoff: Float[Number, ""] = number("Hz", "frequency at which the gain is 1 / sqrt(2)", POSITIVE)
    order: int = count("order of the filter", default=2)
    kind: str = choice("characteristic", "butterworth", default="butterworth")
    realisation: str = choice("realisation", "digital", "analogue", default="digital")


def nyquist_error(
    name: str, frequency: Float[Array, ""], period: Float[Array, ""] | float
) -> str | None:
    """Error of a frequency (Hz) that is not below half the sampling frequency, or None.

    `period` (s) is that of sampling; traced numbers are skipped.
    """
    if not (is_concrete(frequency) and is_concrete(period)):
        return None
    nyquist, value = 0.5 / float(concrete(period)), float(concrete(frequency))
    if value < nyquist:
        return None
    return (
        f"{name} must be below half the sampling frequency, {nyquist:g} Hz; it is {value:g} Hz:"
        " lower it, or sample faster"
    )


@functools.cache
def _prototype_damping_ratios(order: int) -> tuple[np.ndarray, bool]:
    """Damping ratios of the second-order sections of the prototype with a cutoff of 1 rad/s.

    The flag is True if a first-order section precedes them.
    """
    # Poles are at equal angles on the left half of the unit circle. Sections of high damping first,
    # so that the resonant ones receive a filtered signal.
    angles = np.pi * np.arange(1 + order % 2, order, 2) / (2 * order)
    return np.cos(angles), order % 2 == 1


def second_order_sections(
    filter: Filter, period: Float[Array, ""] | float
) -> Float[Array, "section 6"]:
    """Second-order sections (b0, b1, b2, 1, a1, a2) of a digital filter at a sampling period (s).

    Bilinear transform of the analogue filter, prewarped at the cutoff: the filter of
    `scipy.signal.butter(order, cutoff, fs=1 / period, output="sos")`, except that each section has
    a static gain of one. Raises ValueError if the cutoff is not below half the sampling frequency
    (where both are concrete).
    """
    error = nyquist_error("the filter's cutoff", filter.cutoff, period)
    if error is not None:
        raise ValueError(error)
    ratios, odd = _prototype_damping_ratios(filter.order)
    warped = xp.tan(xp.pi * filter.cutoff * period)
    rows = []
    if odd:
        gain = warped / (1 + warped)
        rows.append([gain, gain, 0.0, 1.0, (warped - 1) / (warped + 1), 0.0])
    for ratio in ratios:
        denominator = 1 + 2 * ratio * warped + warped**2
        gain = warped**2 / denominator
        a1, a2 = (
            2 * (warped**2 - 1) / denominator,
            (1 - 2 * ratio * warped + warped**2) / denominator,
        )
        rows.append([gain, 2 * gain, gain, 1.0, a1, a2])
    return xp.stack([xp.stack([xp.asarray(x, float) for x in row]) for row in rows])


def steady_filter_state(
    sections: Float[Array, "section 6 ..."], value
) -> Float[Array, "section 2 *batch"]:
    """State of a digital filter in steady state under a constant input, which is its output."""
    value = xp.asarray(value, float)
    rows = [xp.stack([(1 - s[0]) * value, (s[2] - s[5]) * value]) for s in sections]
    return xp.stack(rows)


def filter_step(
    sections: Float[Array, "section 6 ..."],
    filter_state: Float[Array, "section 2 *batch"],
    sample: Float[Array, " *batch"],
) -> tuple[Float[Array, " *batch"], Float[Array, "section 2 *batch"]]:
    """Output of a digital filter for a sample, and its next state.

    Direct form II transposed, as in `scipy.signal.sosfilt`. Sections are shared by the batch, or
    have a batch axis as their last one.
    """
    next_state = []
    for s, (first, second) in zip(sections, filter_state, strict=True):
        output = s[0] * sample + first
        next_state.append(
            xp.stack([s[1] * sample - s[4] * output + second, s[2] * sample - s[5] * output])
        )
        sample = output
    return sample, xp.stack(next_state)


def filter_history(
    sections: Float[Array, "section 6 ..."],
    filter_state: Float[Array, "section 2 *batch"],
    samples: Float[Array, "time *batch"],
    new_samples: Bool[Array, " time"] | None = None,
    output_before: Float[Array, " *batch"] | None = None,
) -> Float[Array, "time *batch"]:
    """Output of a digital filter for a history of samples, from an initial state.

    With `new_samples`, only the samples marked True enter the filter, and its output is held in
    between; until the first it is the `output_before`.
    """

    def step(carry, at):
        held_output, state = carry
        sample, new = at
        output, next_state = filter_step(sections, state, sample)
        if new is not None:
            output = xp.where(new, output, held_output)
            next_state = xp.where(new, next_state, state)
        return (output, next_state), output

    before = xp.zeros(samples.shape[1:]) if output_before is None else output_before
    start = (before, filter_state)
    return scan(step, start, (samples, new_samples))[1]


def analogue_state_space(
    filter: Filter,
) -> tuple[
    Float[Array, "state state"], Float[Array, " state"], Float[Array, " state"], Float[Array, ""]
]:
    """State space (A, B, C, D) of an analogue filter: x' = A x + B u, y = C x + D u with D = 0.

    States of a section are its output and, if it is of second order, the rate of its output divided
    by the cutoff frequency (rad/s); all have the unit of the signal.
    """
    matrix, column, row, _ = _prototype_state_space(filter.order)
    cutoff = 2 * xp.pi * filter.cutoff
    return cutoff * matrix, cutoff * column, xp.asarray(row), xp.zeros(())


def analogue_steady_state(filter: Filter, value) -> Float[Array, "state *batch"]:
    """State of an analogue filter in steady state under a constant input."""
    return xp.tensordot(_prototype_state_space(filter.order)[3], xp.asarray(value, float), 0)


@functools.cache
def _prototype_state_space(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C and the steady state under a unit input, for a cutoff of 1 rad/s."""
    ratios, odd = _prototype_damping_ratios(order)
    first = [np.array([[-1.0]])] if odd else []
    blocks = first + [np.array([[0.0, 1.0], [-1.0, -2 * ratio]]) for ratio in ratios]
    bounds = np.cumsum([0, *map(len, blocks)])
    outputs, inputs = bounds[:-1], bounds[1:] - 1
    matrix = np.asarray(scipy.linalg.block_diag(*blocks))
    matrix[inputs[1:], outputs[:-1]] = 1.0
    states = np.eye(order)
    return matrix, states[inputs[0]], states[outputs[-1]], states[outputs].sum(axis=0)
