"""Creep of an actuator: what acts drifts on after a command, as a sum of first-order lags.

With the command v that acts at once, behind the hysteresis,

    z_i' = a_i (v - z_i),     y = v + sum of c_i z_i,

a chain of viscoelastic elements. With rates a_i a decade apart and equal weights, y rises as the
logarithm of time over the decades (Krejci and Kuhnen, IEE Proceedings - Control Theory and
Applications 148, 2001; the order hysteresis, then creep, is that of Croft, Shed and Devasia,
Journal of Dynamic Systems, Measurement, and Control 123, 2001).
"""

import numpy as np
from jaxtyping import Float

from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import NOT_NEGATIVE, POSITIVE, number
from jaxbeam.runtime.arrays import Array, xp

Lags = Float[Array, "lag *batch"]


class Creep(ReprWithUnits):
    """Sum of first-order lags added to the command that acts at once; both have its unit.

    A steady command of 1 acts as 1 at once and as 1 + sum of the weights in the end.

    >>> import jaxbeam as jb, numpy as np
    >>> creep = jb.Creep(rates=[10.0, 1.0, 0.1], weights=[0.02, 0.02, 0.02])
    >>> print(creep.outputs(np.ones(4), period=10.0).round(4))  # before, and 10, 20, 30 s after
    [1.     1.0526 1.0573 1.059 ]
    """

    rates: Float[Array, " lag"] = number("1/s", "rates of the lags", POSITIVE)
    weights: Float[Array, " lag"] = number("1", "weights of the lags", NOT_NEGATIVE)

    @property
    def final_gain(self) -> Float[Array, ""]:
        """What acts in the end over a steady command; no command makes more act."""
        return 1 + xp.sum(self.weights)

    def after(
        self, lags: Lags, command: Float[Array, "*batch"], duration: Float[Array, ""]
    ) -> Lags:
        """Lags after a command that was held for a time (s)."""
        left = self._column(xp.exp(-self.rates * duration), command)
        return command + (lags - command) * left

    def shares(self, period: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, " lag"]]:
        """Factors of a held command and of the lags at its start in its mean output over a period.

        The mean of z over the period is v + (z_0 - v) (1 - exp(-a T)) / (a T).
        """
        decay = self.rates * period
        kept = -xp.expm1(-decay) / decay
        return 1 + xp.sum(self.weights * (1 - kept)), self.weights * kept

    def outputs(self, commands, period: float) -> Float[np.ndarray, " time"]:
        """What acts at the start of each command, held for a period (s), from rest."""
        lags, found = xp.zeros_like(self.rates), []
        for command in np.asarray(commands, float):
            found.append(command + self.weights @ lags)
            lags = self.after(lags, command, xp.asarray(period))
        return np.array(found)

    def validate(self) -> str | None:
        """Error of these numbers, as "key must ...", or None."""
        if self.weights.shape != self.rates.shape or not self.rates.size:
            return (
                "weights must be as many as rates, one or more; they are"
                f" {self.weights.size} and {self.rates.size}"
            )
        return None

    @staticmethod
    def _column(values, command):
        return values.reshape(-1, *[1] * xp.ndim(command))
