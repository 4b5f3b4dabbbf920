"""Point sensors on the beam: their quantities, low-pass filters, and the sensors.

QUANTITIES is the only list of quantities, in terms of deflection w(x, t) and twist theta(x, t):
names and units of sensors, outputs of state spaces and of frequency responses, and histories of
records derive from it (rows: `model.output_rows`).

Filters are Butterworth, digital or analogue: cascades of second-order sections (and one of first
order if the order is odd), each with a static gain of one, that follow from the poles of the
prototype with a cutoff of 1 rad/s. Cutoff and sampling period may be traced, batched and
differentiated.
"""

import functools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import (
    INCREASING,
    NOT_NEGATIVE,
    OF_QUANTITY,
    ON_BEAM,
    POSITIVE,
    PROBABILITY,
    choice,
    concrete,
    count,
    is_concrete,
    number,
    part,
)
from jaxbeam.case.toml_file import in_si
from jaxbeam.runtime.arrays import Array, Module, Number, scan, xp

SIDES = ("left", "right")  # of a position
# Orders of fields of the beam that are no x-derivatives of the deflection: see `Modes.fields`.
SLOPE, TWIST, TWIST_RATE = -1, -2, -3
NO_TORSION = (
    "the beam does not twist: give beam.torsional_rigidity (G J) and beam.polar_inertia for"
    " twist, torque and eccentric loads"
)


class Quantity(NamedTuple):
    """Unit of a quantity, and its orders of derivation of w by position and by time.

    The derivative is multiplied by -z `at_fibre`, z (m) being the height of a fibre above the
    neutral axis; by the bending stiffness E I if it is a `section_force`, to which active moments
    of patches belong; and divided by the section modulus (m^3) if it is `over_modulus`. A slope
    `of_axis` is w' also where a section that is flexible in shear has another rotation. Those
    `of_twist` are theta, and its x-derivative times the torsional rigidity G J.
    """

    unit: str
    x_derivative: int = 0
    time_derivative: int = 0
    at_fibre: bool = False
    section_force: bool = False
    over_modulus: bool = False
    of_axis: bool = False
    of_twist: bool = False

    @property
    def field(self) -> int:
        """Order of the field of the beam (see `model.modes.Modes.fields`)."""
        if self.of_twist:
            return TWIST_RATE if self.x_derivative else TWIST
        return SLOPE if self.of_axis else self.x_derivative

    @property
    def bends(self) -> bool:
        """Whether it is a curvature, a derivative of one, twist or torque: statically corrected."""
        return (self.x_derivative >= 2 or self.of_twist) and self.time_derivative == 0

    @property
    def jumps(self) -> bool:
        """Whether it jumps under a load: a shear force or torque."""
        return self.x_derivative == 3 or self.field == TWIST_RATE

    @property
    def has_active_moment(self) -> bool:
        """Whether the active moment of a patch over the section is part of it."""
        return self.section_force and self.x_derivative == 2


QUANTITIES = {
    "deflection": Quantity("m"),
    "velocity": Quantity("m/s", time_derivative=1),
    "acceleration": Quantity("m/s^2", time_derivative=2),
    "slope": Quantity("rad", x_derivative=1, of_axis=True),
    "rotation": Quantity("rad", x_derivative=1),
    "curvature": Quantity("1/m", x_derivative=2),
    "strain": Quantity("1", x_derivative=2, at_fibre=True),
    "moment": Quantity("N m", x_derivative=2, section_force=True),
    "shear": Quantity("N", x_derivative=3, section_force=True),
    "stress": Quantity("Pa", x_derivative=2, section_force=True, over_modulus=True),
    "twist": Quantity("rad", of_twist=True),
    "torque": Quantity("N m", x_derivative=1, of_twist=True),
}

# Quantities of the bodies of vehicles and absorbers, and those of the beam in the same units; a
# stroke, relative to the beam, is that of an absorber.
BODY_QUANTITIES = {
    "acceleration": "acceleration",
    "velocity": "velocity",
    "displacement": "deflection",
    "stroke": "deflection",
}


def unit_of(name: str) -> str | None:
    """SI unit of a quantity of the beam or of a body, None for any other name."""
    quantity = QUANTITIES.get(BODY_QUANTITIES.get(name, name))
    return None if quantity is None else quantity.unit


def quantity_of(
    name: str, fibre_distance: object = None, section_modulus: object = None
) -> Quantity:
    """The quantity of a name.

    Raises ValueError for an unknown name, for a quantity at a fibre without the distance (m) of the
    fibre, for a stress without the section modulus (m^3), and for a rate of a curvature, whose sum
    of modes would need the rates of all forces on the beam.
    """
    if name not in QUANTITIES:
        raise ValueError(f"no quantity {name!r}; there are {', '.join(QUANTITIES)}")
    quantity = QUANTITIES[name]
    if quantity.at_fibre and fibre_distance is None:
        raise ValueError(f"{name} needs fibre_distance, the height above the neutral axis in m")
    if quantity.x_derivative >= 2 and quantity.time_derivative:
        raise ValueError(
            f"{name} is a rate of a curvature, which has no static correction: take differences of"
            " the curvature over time"
        )
    if quantity.over_modulus and section_modulus is None:
        raise ValueError(f"{name} needs section_modulus, bending moment over stress in m^3")
    return quantity


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
        next_state.append([s[1] * sample - s[4] * output + second, s[2] * sample - s[5] * output])
        sample = output
    return sample, xp.array(next_state)


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


class Sensor(ReprWithUnits, Module):
    """Point sensor of a quantity at a position on the beam; deflections are positive upwards.

    `strain` is the bending strain -z d2w/dx2 of the fibre at z = `fibre_distance` above the neutral
    axis, `moment` the bending moment, positive where the beam sags, `shear` its x-derivative, and
    `stress` the moment over the `section_modulus`. What jumps at the position, as a shear force at
    a support, is read on one `side` of it, by default the right one. Deflections and their rates at
    an `eccentricity` e are w + e theta on a beam that twists. `name` is the label in results.
    `offset` and noise are added to the quantity; the reading is limited to the range and rounded to
    the resolution (see `jaxbeam.model.sensor_signals`). With the probability `dropout` a
    reading is lost: the last one stays, and a controller knows that it is missing. The others are
    up to `jitter` older than `delay`, equally distributed. Both are drawn by the seed of the run.
    What is left out is ideal.

    >>> import jaxbeam as jb
    >>> sensor = jb.Sensor(0.3, quantity="strain", fibre_distance=0.0025, name="midspan")
    >>> print(sensor.name, sensor.unit)
    midspan 1
    """

    position: Float[Number, ""] = number("m", "distance from the left end", ON_BEAM)
    quantity: str = choice("measured quantity", *QUANTITIES, default="deflection")
    offset: Float[Number, ""] = number(OF_QUANTITY, "constant added", default=0.0)
    fibre_distance: Float[Number, ""] | None = number(
        "m", "height of the strain gauge above the neutral axis", default=None
    )
    noise: Float[Number, ""] | None = number(
        OF_QUANTITY, "standard deviation of white noise", NOT_NEGATIVE, default=None
    )
    range: Float[Number, "2"] | None = number(
        OF_QUANTITY, "smallest and largest reading", INCREASING, default=None
    )
    resolution: Float[Number, ""] | None = number(
        OF_QUANTITY, "step between readings", POSITIVE, default=None
    )
    filter: Filter | None = part("filter of the signal or of its samples", Filter)
    sampling_period: Float[Number, ""] | None = number(
        "s", "time between readings; that of controller or run if left out", POSITIVE, default=None
    )
    delay: Float[Number, ""] | None = number(
        "s", "from deflection to reading", NOT_NEGATIVE, default=None
    )
    section_modulus: Float[Number, ""] | None = number(
        "m^3", "bending moment over stress; negative for a fibre above the axis", default=None
    )
    mode_band: str = choice(
        "modes of the reading: all, or those up to the largest of 30 Hz, 1.5 f_1 and f_3"
        " (EN 1990, A2.4.4.2.1)",
        "all",
        "en1990",
        default="all",
    )
    name: str = choice("label in results; its number and quantity if left out", default="")
    side: str = choice(
        "side of the position on which it reads what jumps there; the right one if left out",
        "",
        *SIDES,
        default="",
        kw_only=True,
    )
    eccentricity: Float[Number, ""] | None = number(
        "m",
        "distance left of the axis of twist, looking right, as of an edge of the deck",
        default=None,
        kw_only=True,
    )
    dropout: Float[Number, ""] | None = number(
        "1", "probability that a reading is lost", PROBABILITY, default=None, kw_only=True
    )
    jitter: Float[Number, ""] | None = number(
        "s", "largest random delay of a reading", NOT_NEGATIVE, default=None, kw_only=True
    )

    def __post_init__(self):
        for name in ("offset", "noise", "range", "resolution"):
            value = getattr(self, name)
            if isinstance(value, str | list | tuple) and self.quantity in QUANTITIES:
                setattr(self, name, in_si(value, self.unit, name))

    @property
    def unit(self) -> str:
        """SI unit of the readings."""
        return QUANTITIES[self.quantity].unit

    @property
    def has_feedthrough(self) -> bool:
        """Whether forces and commands change the reading at once, as they change accelerations."""
        return QUANTITIES[self.quantity].time_derivative == 2

    @property
    def bends(self) -> bool:
        """Whether it measures curvature, or what follows from it by the section."""
        return QUANTITIES[self.quantity].bends

    @property
    def has_digital_filter(self) -> bool:
        """Whether a filter acts on its samples."""
        return self.filter is not None and self.filter.realisation == "digital"

    def sampled_features(self, address: str) -> Iterator[str]:
        """Features that a sensor has at samples only, each as the subject of an error message."""
        if self.has_digital_filter:
            yield f"{address}.filter, which is digital,"
        for name in ("sampling_period", "delay", "noise", "resolution", "dropout", "jitter"):
            if getattr(self, name) is not None:
                yield f"{address}.{name}"
        if self.has_feedthrough:
            yield f"the {self.quantity} of {address}"

    @property
    def noise_variance(self) -> Float[Array, ""]:
        """Variance of the noise of a reading, in the square of its unit; R of a Kalman filter."""
        return xp.zeros(()) if self.noise is None else self.noise**2

    def validate(self, address: str) -> str | None:
        """First inconsistency between its fields as an error message, or None."""
        quantity, words = QUANTITIES[self.quantity], f"a sensor of {self.quantity}"
        if quantity.at_fibre and self.fibre_distance is None:
            return (
                f"{address}.fibre_distance is missing: {self.quantity} needs the height of the"
                " gauge above the neutral axis in m"
            )
        if not quantity.at_fibre and self.fibre_distance is not None:
            return (
                f"{address}.fibre_distance would have no effect on {words};"
                " leave it out, or set quantity to 'strain'"
            )
        modulus = self.section_modulus
        if quantity.over_modulus and modulus is None:
            return (
                f"{address}.section_modulus is missing: {self.quantity} needs bending moment over"
                " stress in m^3, negative for a fibre above the neutral axis"
            )
        if not quantity.over_modulus and modulus is not None:
            return (
                f"{address}.section_modulus would have no effect on {words};"
                " leave it out, or set quantity to 'stress'"
            )
        if self.mode_band != "all" and self.bends:
            return (
                f"{address}.mode_band would have no effect on {words}, which has all modes by the"
                " static correction; leave it out"
            )
        if self.side and not quantity.x_derivative:
            return (
                f"{address}.side would have no effect on {words}, which is the same on both sides;"
                " leave it out"
            )
        if self.eccentricity is not None and (quantity.x_derivative or quantity.of_twist):
            return (
                f"{address}.eccentricity would have no effect on {words}, which is that of the"
                " section; leave it out"
            )
        if modulus is not None and is_concrete(modulus) and concrete(modulus) == 0:
            return f"{address}.section_modulus must not be zero"
        return None


def sensor_labels(sensors: Sequence[Sensor]) -> list[str]:
    """Labels of sensors in results: their names, or number and quantity, as in "0: deflection"."""
    return [sensor.name or f"{i}: {sensor.quantity}" for i, sensor in enumerate(sensors)]
