"""Ride measures: weighted accelerations of ISO 2631-1, Sperling's index, unloading of wheels.

All are vertical. Accelerations are histories at equally spaced times from rest, of a body of a
vehicle, a point of it, or the deck under a pedestrian. Limits to compare with are not here, for
want of an open source.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxbeam.case.arguments import checks_classes
from jaxbeam.case.fields import concrete, is_concrete, real_numbers
from jaxbeam.runtime.arrays import Array, not_differentiated, xp
from jaxbeam.simulation.record import Record

__all__ = [
    "RideMeasures",
    "ride_measures",
    "sperling_index",
    "vibration_dose",
    "weighted_acceleration",
    "weighted_rms",
    "wheel_unloading",
]

# Weighting W_k: frequencies (Hz) and quality factors of its filters, from table 3.1 of the HVM200
# manual of Larson Davis (easymanua.ls/larson-davis/hvm200/manual, page 30), which names ISO 8041.
HIGH_PASS, LOW_PASS, BUTTERWORTH = 0.4, 100.0, 1 / np.sqrt(2)
TRANSITION_ZERO, TRANSITION_POLE, TRANSITION_QUALITY = 12.5, 12.5, 0.63
STEP_ZERO, STEP_ZERO_QUALITY, STEP_POLE, STEP_POLE_QUALITY = 2.37, 0.91, 3.35, 0.91
WEIGHTED_BAND = 80.0  # Hz, upper end of the band of ISO 2631-1
MEMORY = 15.0  # s, after which the slowest of the filters has forgotten all but 1e-11

# Sperling's index: band (Hz) and exponent of `sperling.m` in janiex/SimulinkMatlab on GitHub.
SPERLING_BAND, SPERLING_EXPONENT = (0.5, 30.0), 1 / 6.67
UNKNOWN = "must be concrete numbers"
CENTIMETRES = 100.0  # of a metre: the index is defined for cm/s^2


def vertical_weighting(frequency: Float[Array, "*shape"] | float) -> Complex[Array, "*shape"]:
    """Transfer function W_k of ISO 2631-1 for vertical vibration, at frequencies f (Hz).

    Product of a high and a low pass, a transition from acceleration to velocity, and an upward
    step, with s = i 2 pi f and the w_i = 2 pi f_i and Q_i of the module:

        s^2 / (s^2 + s w_1 / Q + w_1^2),            1 / (1 + s / (Q w_2) + (s / w_2)^2),
        (1 + s / w_3) / (1 + s / (Q_4 w_4) + (s / w_4)^2),
        (1 + s / (Q_5 w_5) + (s / w_5)^2) / (1 + s / (Q_6 w_6) + (s / w_6)^2) (w_5 / w_6)^2

    (manual of the HVM200, Larson Davis, table 3.1, after ISO 8041).
    """

    def second_order(corner, quality):
        ratio = 1j * xp.asarray(frequency) / corner
        return 1 + ratio / quality + ratio**2

    high_pass = -((xp.asarray(frequency) / HIGH_PASS) ** 2) / second_order(HIGH_PASS, BUTTERWORTH)
    transition = 1 + 1j * xp.asarray(frequency) / TRANSITION_ZERO
    step = second_order(STEP_ZERO, STEP_ZERO_QUALITY) * (STEP_ZERO / STEP_POLE) ** 2
    return (
        high_pass
        / second_order(LOW_PASS, BUTTERWORTH)
        * (transition / second_order(TRANSITION_POLE, TRANSITION_QUALITY))
        * (step / second_order(STEP_POLE, STEP_POLE_QUALITY))
    )


def sperling_weighting(frequency: Float[Array, "*shape"] | float) -> Float[Array, "*shape"]:
    """Weighting B of vertical acceleration in Sperling's index of comfort, at f (Hz).

        B = 0.588 sqrt((1.911 f^2 + (0.25 f^2)^2) / ((1 - 0.277 f^2)^2 + (1.563 f - 0.0368 f^3)^2))

    (`Bz` of comfpy/filters.py in tobias-bettinger/comfpy on GitHub).
    """
    square = xp.asarray(frequency) ** 2
    above = 1.911 * square + (0.25 * square) ** 2
    below = (1 - 0.277 * square) ** 2 + square * (1.563 - 0.0368 * square) ** 2
    return 0.588 * xp.sqrt(above / below)


def weighted_acceleration(
    times: Float[Array, " time"], acceleration: Float[Array, "time *shape"]
) -> Float[Array, "time *shape"]:
    """Vertical accelerations (m/s^2) after the filters W_k of ISO 2631-1, which start at rest.

    The signal between samples is the one without content above half of their rate. Raises
    ValueError for times (s) that are not equally spaced, or less than 160 a second, or not as many
    as the accelerations.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> times = np.arange(0.0, 20.0, 1 / 400)
    >>> shaking = np.sqrt(2) * np.sin(2 * np.pi * 6.0 * times)  # rms 1 m/s^2, where W_k is about 1
    >>> print(jb.ride.weighted_acceleration(times, shaking).shape)
    (8000,)
    """
    step, acceleration = _step_and_signal(times, acceleration, WEIGHTED_BAND)
    count = acceleration.shape[0]
    padded = count + int(np.ceil(MEMORY / step))  # the end of the record does not reach its start
    response = vertical_weighting(np.fft.rfftfreq(padded, step))
    response = response.reshape(-1, *(1,) * (acceleration.ndim - 1))
    spectrum = xp.fft.rfft(acceleration, padded, axis=0)
    return xp.fft.irfft(response * spectrum, padded, axis=0)[:count]


def weighted_rms(
    times: Float[Array, " time"], acceleration: Float[Array, "time *shape"]
) -> Float[Array, "*shape"]:
    """Root mean square a_w (m/s^2) of accelerations weighted by W_k, over the whole record.

    a_w^2 = 1/T int a_w(t)^2 dt (ISO 2631-1, basic evaluation). Raises ValueError as
    `weighted_acceleration`.

    `times` (s) are equally spaced.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> times = np.arange(0.0, 20.0, 1 / 400)
    >>> shaking = np.sqrt(2) * np.sin(2 * np.pi * 6.0 * times)  # rms 1 m/s^2, where W_k is about 1
    >>> print(f"{jb.ride.weighted_rms(times, shaking):.2f}")
    1.05
    """
    weighted = weighted_acceleration(times, acceleration)
    return xp.sqrt(xp.trapezoid(weighted**2, times, axis=0) / (times[-1] - times[0]))


def vibration_dose(
    times: Float[Array, " time"], acceleration: Float[Array, "time *shape"]
) -> Float[Array, "*shape"]:
    """Vibration dose value (m/s^1.75) of accelerations weighted by W_k: (int a_w(t)^4 dt)^(1/4).

    The fourth power tells shocks from steady vibration (acoustic-glossary.co.uk, vibration dose).
    Raises ValueError as `weighted_acceleration`.

    `times` (s) are equally spaced.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> times = np.arange(0.0, 20.0, 1 / 400)
    >>> shaking = np.sqrt(2) * np.sin(2 * np.pi * 6.0 * times)  # rms 1 m/s^2, where W_k is about 1
    >>> print(f"{jb.ride.vibration_dose(times, shaking):.2f}")
    2.47
    """
    weighted = weighted_acceleration(times, acceleration)
    return xp.trapezoid(weighted**4, times, axis=0) ** 0.25


def sperling_index(
    times: Float[Array, " time"], acceleration: Float[Array, "time *shape"]
) -> Float[Array, "*shape"]:
    """Sperling's index W_z of vertical comfort, of accelerations (m/s^2) over the whole record.

        W_z = (2 int B(f)^2 G(f) df)^(1/6.67) = (sum of B(f)^2 a_f^2)^(1/6.67)

    from 0.5 to 30 Hz, with the one-sided density G of the acceleration in (cm/s^2)^2/Hz, or the
    amplitudes a_f of its Fourier series: 4.42 times the weighted rms (m/s^2) to the power 0.3.
    Raises ValueError for times (s) that are not equally spaced, or less than 60 a second, or not as
    many as the accelerations.

    >>> import numpy as np
    >>> import jaxbeam as jb
    >>> times = np.arange(0.0, 20.0, 1 / 400)
    >>> shaking = np.sqrt(2) * np.sin(2 * np.pi * 6.0 * times)  # rms 1 m/s^2, where W_k is about 1
    >>> print(f"{jb.ride.sperling_index(times, shaking):.2f}")
    4.12
    """
    low, high = SPERLING_BAND
    step, acceleration = _step_and_signal(times, acceleration, high)
    count = acceleration.shape[0]
    frequency = np.fft.rfftfreq(count, step)
    in_band = (frequency >= low) & (frequency <= high)
    amplitude = 2 / count * xp.abs(xp.fft.rfft(acceleration, axis=0)[in_band])
    weight = sperling_weighting(frequency[in_band]).reshape(-1, *(1,) * (acceleration.ndim - 1))
    return xp.sum((CENTIMETRES * weight * amplitude) ** 2, axis=0) ** SPERLING_EXPONENT


@checks_classes
def wheel_unloading(record: Record) -> Float[Array, " load"]:
    """Largest fraction dQ/Q by which the contact force of each wheel falls below its static load.

    On the beam in continuous time, for vehicles on the ground before and behind it at the samples.
    1 means that a wheel just lifts; above 1 it would have to pull. NaN for wheels that never press
    on the beam, and for those without static load.

    >>> import jaxbeam as jb
    >>> beam = jb.Beam(length=0.6, flexural_rigidity=11.68, mass_per_length=0.535)
    >>> case = jb.Case(
    ...     beam, sensors=[jb.Sensor(0.3)], loads=[jb.MovingMass(mass=0.5, speed=2.0)]
    ... )
    >>> print(jb.ride.wheel_unloading(jb.simulate(case)).shape)
    (1,)
    """
    loads = record.loads
    static = loads.weight[:, 0]
    entry, leave = loads.entry_exit_times().T
    crosses = (entry < record.times[-1]) & (leave > 0)
    # Forces of plain wheels off the beam are zeros.
    seen = ~xp.isnan(record.load_position) | loads.on_ground
    sampled = xp.min(xp.where(seen, record.contact_force, xp.inf), axis=0, initial=xp.inf)
    least = xp.where(crosses, xp.minimum(sampled, record.lowest_contact_force), sampled)
    defined = xp.isfinite(least) & (static > 0)
    least, static = xp.where(defined, least, 0.0), xp.where(defined, static, 1.0)
    return xp.where(defined, 1 - least / static, xp.nan)


class RideMeasures(NamedTuple):
    """Ride measures of a record, by body of its vehicles and by wheel.

    `bodies` are the names of heights, as in `Record.bodies` without the pitches; the measures are
    those at the centre of mass.

    >>> import jaxbeam as jb
    >>> wagon = jb.vehicles.VehicleLoad(model="manchester-wagon", speed=50.0)
    >>> case = jb.Case(jb.Beam(20.0, 1e10, 12e3), loads=[wagon], run=jb.Run(1.5))
    >>> ride = jb.ride.ride_measures(jb.simulate(case))
    >>> print(ride.bodies, f"{ride.wheel_unloading.max():.3f}")
    ['loads.0 body', 'loads.0 front bogie', 'loads.0 rear bogie'] 0.032
    """

    bodies: list[str]
    weighted_rms: Float[Array, " body"]
    vibration_dose: Float[Array, " body"]
    sperling_index: Float[Array, " body"]
    wheel_unloading: Float[Array, " load"]


@checks_classes
def ride_measures(record: Record) -> RideMeasures:
    """Weighted rms (m/s^2), dose (m/s^1.75) and Sperling's index by body, unloading by wheel.

    For another point of a body, or another interval, give its acceleration to the functions of this
    module: `body_acceleration` of the height plus the lever (m) times that of the pitch. Raises
    ValueError for samples that are not equally spaced, or less than 160 a second.

    >>> import jaxbeam as jb
    >>> car = jb.QuarterCar(16e3, 1.2e3, 8e5, 2e4, 3.5e6, 1e4, speed=20.0, start_position=-40.0)
    >>> case = jb.Case(
    ...     jb.Beam(length=20.0, flexural_rigidity=4.8e10, mass_per_length=18358.0),
    ...     loads=[car],
    ...     profile=jb.profiles.SineProfile(amplitude=0.003, wavelength=10.0),
    ...     run=jb.Run(duration=3.0),
    ... )
    >>> ride = jb.ride.ride_measures(jb.simulate(case))
    >>> print(ride.bodies[0], f"{ride.weighted_rms[0]:.2f} m/s^2")
    loads.0 body 0.07 m/s^2
    """
    names, times = record.bodies, record.times
    of_loads = [name for name in names if not name.startswith("absorbers.")]
    heights = np.flatnonzero([not name.endswith(" pitch") for name in of_loads])
    acceleration = record.body_acceleration[:, heights]
    return RideMeasures(
        [names[i] for i in heights],
        weighted_rms(times, acceleration),
        vibration_dose(times, acceleration),
        sperling_index(times, acceleration),
        wheel_unloading(record),
    )


def _step_and_signal(times, acceleration, highest_frequency: float):
    """Spacing (s) of concrete times that resolve frequencies up to the highest one, and signal."""
    times = real_numbers("times", times, "s")
    acceleration = real_numbers("acceleration", acceleration, "m/s^2")
    if times.ndim != 1 or acceleration.shape[:1] != times.shape:
        raise ValueError(
            "acceleration must be (time, ...), one for each of the times (time,); their shapes are"
            f" {acceleration.shape} and {times.shape}"
        )
    if not is_concrete(times):
        raise ValueError(f"times of ride measures {UNKNOWN}, not traced ones")
    not_differentiated(times, f"times of ride measures {UNKNOWN}: there are no derivatives by them")
    steps = np.diff(np.asarray(concrete(times), float))
    if steps.size == 0 or steps[0] <= 0 or np.ptp(steps) > 1e-6 * np.max(np.abs(steps)):
        raise ValueError(
            "times must ascend and be equally spaced for ride measures; simulate with"
            " run.sample_rate and without a list of times"
        )
    rate, needed = 1 / np.mean(steps), 2 * highest_frequency
    if rate < needed * (1 - 1e-9):
        raise ValueError(
            f"times must be at least {needed:g} a second for vibration up to"
            f" {highest_frequency:g} Hz; there are {rate:g}: give a larger run.sample_rate"
        )
    return float(np.mean(steps)), acceleration
