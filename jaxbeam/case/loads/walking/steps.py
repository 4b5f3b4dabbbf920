"""Interface of loads of walking or jogging people, with the numbers of their steps."""

import numpy as np
from jaxtyping import Float

from jaxbeam.case import fields
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, choice, concrete, is_concrete, number
from jaxbeam.case.loads.base import AbstractVehicleLoad
from jaxbeam.case.loads.force_history import ForceHistory
from jaxbeam.case.loads.vehicle_checks import length_error
from jaxbeam.case.loads.walking.footfalls import (
    LEAST_WALKING_PACE,
    WEIGHT,
    contact_time,
    jogging_factors,
    walking_factors,
)
from jaxbeam.runtime.arrays import Array, xp


class AbstractWalkingLoad(AbstractVehicleLoad):
    """People who walk or jog, their weights and steps; see `footfalls` for equations and sources.

    With own `factors` the phases are `phases`, 0 if left out. While both feet of a jogger are off
    the ground, the sum of a few harmonics may be slightly negative, and counts as lost contact.
    """

    pace: Float[Array, ""] = number("Hz", "steps a second", POSITIVE, kw_only=True)
    weight: Float[Array, ""] = number(
        "N", "weight of a person", POSITIVE, default=WEIGHT, kw_only=True
    )
    activity: str = choice("how people move", "walking", "jogging", default="walking", kw_only=True)
    factors: Float[Array, " harmonic"] | None = number(
        "1",
        "amplitudes of the harmonics of the pace, as shares of the weight",
        NOT_NEGATIVE,
        default=None,
        kw_only=True,
    )
    phases: Float[Array, " harmonic"] | None = number(
        "rad", "phases of these harmonics at a step", default=None, kw_only=True
    )
    contact_time: Float[Array, ""] | None = number(
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
