"""Crowd: a stream of people who walk or jog along the beam at one speed, each at an own pace."""

from typing import ClassVar

import numpy as np
from jaxtyping import Float

from jaxbeam.case import fields
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, concrete, is_concrete, number
from jaxbeam.case.loads.vehicle_model import plain_wheels
from jaxbeam.case.loads.walking.footfalls import LEAST_WALKING_PACE
from jaxbeam.case.loads.walking.steps import AbstractWalkingLoad
from jaxbeam.runtime.arrays import Array, xp


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
    length: Float[Array, ""] = number("m", "length of the stream", POSITIVE, kw_only=True)
    pace_deviation: Float[Array, ""] = number(
        "Hz", "standard deviation of the paces", NOT_NEGATIVE, default=0.0, kw_only=True
    )
    seed: int = fields.count("seed of places, paces and steps", minimum=0, default=0, kw_only=True)

    def validate(self, address):
        error = self.step_error(address)
        deviation = self.pace_deviation
        if error is None and is_concrete(self.pace) and is_concrete(deviation):
            slowest = concrete(self.pace) - 3 * concrete(deviation)
            if slowest <= (LEAST_WALKING_PACE if self._has_walking_factors() else 0):
                return (
                    f"{address}.pace_deviation is too large: the slowest pace, three deviations"
                    f" below the mean, would be {slowest:g} Hz; give a smaller one"
                )
        return error or super().validate(address)

    def _has_walking_factors(self) -> bool:
        return self.factors is None and self.activity == "walking"

    def _draws(self):
        """Places and steps of all people as shares from 0 to 1, and deviates of the paces."""
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
