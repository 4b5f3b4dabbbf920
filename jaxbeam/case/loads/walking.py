"""Pedestrians and crowds: the forces of their steps.

    F(t) = G (1 + sum over i of a_i sin(2 pi i f (t - t_0) + phase_i))

with the weight G (N), the pace f (Hz, steps a second), the time t_0 of a step, and the dynamic load
factors a_i, the amplitudes as fractions of the weight.

Walking: the design factors of Young (2001) and CCIP-016, as coded in StructuralDesignKit_Holz,
Vibrations - Legacy.cs (github.com/knippershelbig, commit 3b7def4):

    a_1 = 0.41 (f - 0.95), at most 0.56;    a_2 = 0.069 + 0.0056 (2 f);
    a_3 = 0.033 + 0.0064 (3 f);             a_4 = 0.013 + 0.0065 (4 f),

whose phases are not given there: zero. Jogging: half-sine pulses of the contact time t_c, in which
the mean force is the weight (Bachmann and Ammann 1987), whose Fourier series has

    a_i = 2 cos(pi u) / (1 - (2 u)^2),    phase_i = pi / 2 - pi u,    u = i f t_c,

with t_0 the time at which a foot comes down, and t_c = 1.8 s f^-2.05 (f in Hz) if it is not given
(Rebelo, Negrao and Rigueiro 2005, figure 2, as coded in EC1_pedestrian_load_models.py of
github.com/xcfem/xc, commit 25a7afe; the factors of that file are not those of a half-sine).
"""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case import fields
from jaxbeam.case.fields import (
    NOT_NEGATIVE,
    ON_BEAM,
    POSITIVE,
    choice,
    concrete,
    is_concrete,
    number,
)
from jaxbeam.case.loads.base import (
    AbstractStandingLoad,
    AbstractVehicleLoad,
    ForceHistory,
    length_error,
    plain_wheels,
)
from jaxbeam.runtime.arrays import Array, Number, xp

WEIGHT = 700.0  # N, of the reference pedestrian of prEN 1991-2, annex X, as coded in xcfem/xc
LEAST_WALKING_PACE = 0.95  # Hz, at which the first factor of walking is zero

Factors = Float[Array, "*person harmonic"]


def walking_factors(pace: Float[Array, "*person"]) -> Factors:
    """Dynamic load factors a_1 to a_4 of walking at a pace (Hz); see the module."""
    first = xp.clip(0.41 * (pace - LEAST_WALKING_PACE), 0.0, 0.56)
    further = 0.069 + 0.0056 * 2 * pace, 0.033 + 0.0064 * 3 * pace, 0.013 + 0.0065 * 4 * pace
    return xp.stack([first, *further], axis=-1)


def contact_time(pace: Float[Array, "*person"]) -> Float[Array, "*person"]:
    """Time (s) for which a foot of a jogger is on the ground, at a pace (Hz)."""
    return 1.8 * pace**-2.05


def jogging_factors(
    pace: Float[Array, "*person"], contact: Float[Array, "*person"], harmonics: int
) -> tuple[Factors, Factors]:
    """Dynamic load factors of half-sine pulses, and their phases (rad); see the module.

    `contact` is the contact time (s).
    """
    u = xp.asarray((pace * contact)[..., None] * np.arange(1, harmonics + 1))
    # cos(pi u) / (1 - 4 u^2), which is finite at u = 1/2 too.
    factors = np.pi / 2 * (xp.sinc(u - 0.5) + xp.sinc(u + 0.5))
    return factors, xp.asarray(np.pi / 2 - np.pi * u)


class AbstractWalkingLoad(AbstractVehicleLoad):
    """People who walk or jog, their weights and steps; see `footfalls` for equations and sources.

    With own `factors` the phases are `phases`, 0 if left out. While both feet of a jogger are off
    the ground, the sum of a few harmonics may be slightly negative, and counts as lost contact.
    """

    pace: Float[Number, ""] = number("Hz", "steps a second", POSITIVE, kw_only=True)
    weight: Float[Number, ""] = number(
        "N", "weight of a person", POSITIVE, default=WEIGHT, kw_only=True
    )
    activity: str = choice("how people move", "walking", "jogging", default="walking", kw_only=True)
    factors: Float[Number, " harmonic"] | None = number(
        "1",
        "amplitudes of the harmonics of the pace, as fractions of the weight",
        NOT_NEGATIVE,
        default=None,
        kw_only=True,
    )
    phases: Float[Number, " harmonic"] | None = number(
        "rad", "phases of these harmonics at a step", default=None, kw_only=True
    )
    contact_time: Float[Number, ""] | None = number(
        "s", "time of a foot of a jogger on the ground", POSITIVE, default=None, kw_only=True
    )
    harmonics: int = fields.count("harmonics of jogging", default=4, kw_only=True)

    def step_history(self, pace, step_time) -> ForceHistory:
        """Force over time of a person with a pace (Hz) who steps at a time (s)."""
        factors, phases = self._factors(pace)
        frequencies = pace * np.arange(1, factors.shape[0] + 1)
        angles = phases - 2 * np.pi * frequencies * step_time
        return ForceHistory(frequencies, self.weight * factors, angles, np.zeros(0), np.zeros(0))

    def _factors(self, pace):
        if self.factors is not None:
            none = xp.zeros_like(self.factors)
            return self.factors, none if self.phases is None else self.phases
        if self.activity == "walking":
            factors = walking_factors(pace)
            return factors, xp.zeros_like(factors)
        contact = contact_time(pace) if self.contact_time is None else self.contact_time
        return jogging_factors(pace, contact, self.harmonics)

    def step_error(self, address: str) -> str | None:
        """First inconsistency between the numbers of its steps as an error message, or None."""
        if self.factors is None and self.phases is not None:
            return f"{address}.phases belong to own factors; give both, or neither"
        if self.factors is not None:
            return length_error(address, self, "factors", ("phases",))
        if self.activity == "walking" and self.contact_time is not None:
            return f"{address}.contact_time is that of activity = 'jogging'; leave it out"
        contact, pace = self.contact_time, self.pace
        if not is_concrete(pace):
            return None
        if self.activity == "walking" and concrete(pace) <= LEAST_WALKING_PACE:
            return (
                f"{address}.pace must exceed {LEAST_WALKING_PACE:g} Hz, from which on the"
                f" factors of walking hold; it is {concrete(pace):g} Hz: give factors"
            )
        if contact is None or not is_concrete(contact) or concrete(contact * pace) < 1:
            return None
        return (
            f"{address}.contact_time must be less than the time of a step, 1 / pace ="
            f" {1 / concrete(pace):g} s; it is {concrete(contact):g} s"
        )


class Pedestrian(AbstractStandingLoad, AbstractWalkingLoad):
    """A person of a weight whose steps are harmonics of the pace; see `footfalls`.

    One step is at `step_time`, by default the `entry_time`. With a `position` the person stays
    there; with a speed or a table the force travels as other loads do.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(20.0, 4e8, 1000.0, damping_ratio=0.01, modes=2),
    ...     sensors=[jb.Sensor(10.0)],
    ...     loads=[jb.Pedestrian(pace=2.0, weight=700.0, speed=10.0)],
    ...     run=jb.Run(2.0),
    ... )
    >>> print(f"{1e3 * jb.simulate(case).peak_deflection[0]:.3f} mm")
    0.839 mm
    """

    kind: ClassVar[str] = "pedestrian"

    step_time: Float[Number, ""] | None = number("s", "time of a step", default=None, kw_only=True)
    position: Float[Number, ""] | None = number(
        "m", "place of a person who stays there", ON_BEAM, default=None, kw_only=True
    )

    def validate(self, address):
        error = self.step_error(address)
        return error or super().validate(address)

    def vehicle(self, gravity):
        return plain_wheels(self.weight, xp.zeros(()))

    def force_histories(self):
        step = self.entry_time if self.step_time is None else self.step_time
        return {0: self.step_history(self.pace, step)}


class Crowd(AbstractWalkingLoad):
    """A stream of `people` over a `length` (m), the first of whom enters at the entry time.

    The others are anywhere in the stream, with the same chance; their paces are normal with the
    mean `pace` and the deviation `pace_deviation`, at most three deviations off, and they step at
    any time. All numbers drawn are those of the `seed`. Streams of different speeds, or in opposite
    directions, are several loads.

    >>> import jaxbeam as jb
    >>> load = jb.Crowd(pace=1.9, people=5, length=10.0, speed=1.4)
    >>> print(load.vehicle(9.81).offsets.size, "people")
    5 people
    """

    kind: ClassVar[str] = "crowd"

    people: int = fields.count("number of people", kw_only=True)
    length: Float[Number, ""] = number("m", "length of the stream", POSITIVE, kw_only=True)
    pace_deviation: Float[Number, ""] = number(
        "Hz", "standard deviation of the paces", NOT_NEGATIVE, default=0.0, kw_only=True
    )
    seed: int = fields.count("seed of places, paces and steps", minimum=0, default=0, kw_only=True)

    def validate(self, address):
        error = self.step_error(address)
        deviation = self.pace_deviation
        if error is None and is_concrete(self.pace) and is_concrete(deviation):
            slowest = concrete(self.pace) - 3 * concrete(deviation)
            walking = self.factors is None and self.activity == "walking"
            if slowest <= (LEAST_WALKING_PACE if walking else 0):
                return (
                    f"{address}.pace_deviation is too large: the slowest pace, three deviations"
                    f" below the mean, would be {slowest:g} Hz; give a smaller one"
                )
        return error or super().validate(address)

    def _draws(self):
        """Random places and step times of all people (0 to 1), and deviates of their paces."""
        random = np.random.default_rng(self.seed)
        places = np.append(0.0, np.sort(random.uniform(size=self.people - 1)))
        return places, random.uniform(size=self.people), random.standard_normal(self.people)

    def vehicle(self, gravity):
        places = self._draws()[0]
        weights = self.weight * np.ones(self.people)
        return plain_wheels(weights, xp.zeros_like(weights), self.length * places)

    def force_histories(self):
        _, steps, deviates = self._draws()
        paces = self.pace + self.pace_deviation * np.clip(deviates, -3.0, 3.0)
        return {i: self.step_history(paces[i], steps[i] / paces[i]) for i in range(self.people)}
