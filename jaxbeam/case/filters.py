"""Low-pass filters of sensors: Butterworth, digital or analogue.

Both kinds come from one prototype, the poles that scipy gives a filter of cutoff 1 rad/s, and are
cascades of sections of second order (and one of first order if the order is odd), each with gain
one at rest. Everything after the prototype is arithmetic, so cutoff and sampling period may be
traced, batched and differentiated like all numbers of a case.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float

from jaxbeam.case.fields import POSITIVE, choice, concrete, count, is_concrete, number


class Filter(eqx.Module):
    """A low-pass filter: 1 at low frequency, 1 / sqrt(2) at the cutoff.

    An analogue filter acts on the signal before it is sampled, a digital one on the samples.
    """

    cutoff: Float[Array, ""] = number("Hz", "frequency at which it passes 1 / sqrt(2)", POSITIVE)
    order: int = count("order of the filter", default=2)
    kind: str = choice("characteristic", "butterworth", default="butterworth")
    realisation: str = choice("how it is made", "digital", "analogue", default="digital")


@functools.cache
def _prototype_damping_ratios(order: int) -> tuple[np.ndarray, bool]:
    """Damping ratios of the second-order sections at 1 rad/s, and whether one of first order."""
    from scipy.signal import buttap  # here, as it takes half a second and most cases have no filter

    _, poles, _ = buttap(order)
    # Well-damped sections first: the resonant ones then see what is already filtered.
    return np.sort(-poles[poles.imag > 1e-9].real)[::-1], order % 2 == 1


def second_order_sections(
    filter: Filter, period: Float[Array, ""] | float
) -> Float[Array, "section 6"]:
    """Second-order sections (b0, b1, b2, 1, a1, a2) of a digital filter at a sampling period (s).

    The bilinear transform of the analogue filter, warped to meet it at the cutoff: what
    `scipy.signal.butter(order, cutoff, fs=1 / period, output="sos")` makes, except that each
    section has gain one at rest. Raises ValueError if the cutoff is not below half the sampling
    frequency (where both are known).
    """
    if is_concrete(filter.cutoff) and is_concrete(period):
        nyquist = 0.5 / float(concrete(period))
        if float(concrete(filter.cutoff)) >= nyquist:
            raise ValueError(
                f"the filter's cutoff must be below half the sampling frequency, {nyquist:g} Hz;"
                f" it is {float(concrete(filter.cutoff)):g} Hz: lower it, or sample faster"
            )
    ratios, odd = _prototype_damping_ratios(filter.order)
    warped = jnp.tan(jnp.pi * filter.cutoff * period)
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
    return jnp.stack([jnp.stack([jnp.asarray(x, float) for x in row]) for row in rows])


def steady_filter_state(
    sections: Float[Array, "section 6 ..."], value
) -> Float[Array, "section 2 *lane"]:
    """Memory of a digital filter that has long been fed a constant value, which it gives back."""
    value = jnp.asarray(value, float)
    rows = [jnp.stack([(1 - s[0]) * value, (s[2] - s[5]) * value]) for s in sections]
    return jnp.stack(rows)


def filter_step(
    sections: Float[Array, "section 6 ..."],
    filter_state: Float[Array, "section 2 *lane"],
    sample: Float[Array, " *lane"],
) -> tuple[Float[Array, " *lane"], Float[Array, "section 2 *lane"]]:
    """Put one sample through a digital filter; return its output and its memory afterwards.

    Direct form II transposed, as in `scipy.signal.sosfilt`. Sections may be shared by all lanes
    or have lanes of their own.
    """
    next_state = []
    for s, (first, second) in zip(sections, filter_state, strict=True):
        output = s[0] * sample + first
        next_state.append(
            jnp.stack([s[1] * sample - s[4] * output + second, s[2] * sample - s[5] * output])
        )
        sample = output
    return sample, jnp.stack(next_state)


def filter_history(
    sections: Float[Array, "section 6 ..."],
    filter_state: Float[Array, "section 2 *lane"],
    samples: Float[Array, "time *lane"],
    new_samples: Bool[Array, " time"] | None = None,
) -> Float[Array, "time *lane"]:
    """Output of a digital filter for a whole history, from a given memory.

    With `new_samples`, only the samples so marked enter the filter; in between its output is held. The
    first one must be.
    """

    def step(carry, at):
        held, memory = carry
        sample, new = at
        output, after = filter_step(sections, memory, sample)
        if new is not None:
            output, after = jnp.where(new, output, held), jnp.where(new, after, memory)
        return (output, after), output

    start = (jnp.zeros(samples.shape[1:]), filter_state)
    return jax.lax.scan(step, start, (samples, new_samples))[1]


def analogue_state_space(
    filter: Filter,
) -> tuple[
    Float[Array, "state state"], Float[Array, " state"], Float[Array, " state"], Float[Array, ""]
]:
    """Continuous state space (A, B, C, D) of an analogue filter: x' = A x + B u, y = C x + D u.

    D is zero. Each section has its output as a state, and the rate of that over the cutoff
    frequency as another if it is of second order: all states are of the size of the signal.
    """
    matrix, column, row, _ = _prototype_state_space(filter.order)
    cutoff = 2 * jnp.pi * filter.cutoff
    return cutoff * matrix, cutoff * column, jnp.asarray(row), jnp.zeros(())


def analogue_steady_state(filter: Filter, value) -> Float[Array, "state *lane"]:
    """State of an analogue filter that has long been fed a constant value."""
    return jnp.multiply.outer(_prototype_state_space(filter.order)[3], jnp.asarray(value, float))


@functools.cache
def _prototype_state_space(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B and C of the analogue filter with a cutoff of 1 rad/s, and its state at rest under 1."""
    ratios, odd = _prototype_damping_ratios(order)
    first = [np.array([[-1.0]])] if odd else []
    blocks = first + [np.array([[0.0, 1.0], [-1.0, -2 * ratio]]) for ratio in ratios]
    bounds = np.cumsum([0, *map(len, blocks)])
    outputs, inputs = bounds[:-1], bounds[1:] - 1
    matrix = np.asarray(scipy.linalg.block_diag(*blocks))
    matrix[inputs[1:], outputs[:-1]] = 1.0
    states = np.eye(order)
    return matrix, states[inputs[0]], states[outputs[-1]], states[outputs].sum(axis=0)
