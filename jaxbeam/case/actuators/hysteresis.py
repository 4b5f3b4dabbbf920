"""Hysteresis and creep of patches, and their compensation.

With plays p_i of thresholds r_i, which follow the command u where it leaves their dead band,

    p_i <- max(u - r_i, min(u + r_i, p_i)),     H[u] = sum of w_i p_i.

The first threshold is zero: that play is the command itself. The output does not depend on the
rate of the command, and its inverse is an operator of the same kind (Krejci and Kuhnen, IEE
Proceedings - Control Theory and Applications 148, 2001).

With the command v that acts at once, behind the hysteresis,

    z_i' = a_i (v - z_i),     y = v + sum of c_i z_i,

a chain of viscoelastic elements. With rates a_i a decade apart and equal weights, y rises as the
logarithm of time over the decades (Krejci and Kuhnen, IEE Proceedings - Control Theory and
Applications 148, 2001; the order hysteresis, then creep, is that of Croft, Shed and Devasia,
Journal of Dynamic Systems, Measurement, and Control 123, 2001).
"""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.case.display import ReprWithUnits
from jaxbeam.case.fields import INCREASING, NOT_NEGATIVE, POSITIVE, concrete, is_concrete, number
from jaxbeam.runtime.arrays import Array, Number, xp

Plays = Float[Array, "play *batch"]


class Hysteresis(ReprWithUnits):
    """Prandtl-Ishlinskii operator, from the command of an actuator to the command that acts.

    Both have the unit of the command. Its slope is the first weight where the command turns, and
    approaches the sum of the weights under a command that keeps rising. Plays start from zero.

    >>> import jaxbeam as jb
    >>> patch = jb.Patch(0.25, 0.35, moment_per_volt=8e-4)
    >>> hysteresis = jb.actuators.Hysteresis(thresholds=[0.0, 1.0], weights=[0.8, 0.4])
    >>> print(hysteresis.outputs([0.0, 5.0, 3.0, 0.0]))
    [0.  5.6 4.  0.4]
    """

    thresholds: Float[Number, " play"] = number(
        "unit of a command", "thresholds of the plays; the first is zero", INCREASING
    )
    weights: Float[Number, " play"] = number("1", "weights of the plays")

    def follow(self, plays: Plays, command: Float[Array, "*batch"]) -> Plays:
        """States of the plays after a command."""
        r = self.thresholds.reshape(-1, *[1] * xp.ndim(command))
        return xp.maximum(command - r, xp.minimum(command + r, plays))

    def output(self, plays: Plays) -> Float[Array, "*batch"]:
        """Command that acts, the weighted sum of the states of the plays."""
        return xp.tensordot(self.weights, plays, axes=1)

    def outputs(self, commands: ArrayLike) -> Float[np.ndarray, " time"]:
        """Commands that act (time,) for a history of commands (time,), from rest."""
        plays, found = xp.zeros_like(self.thresholds), []
        for command in np.asarray(commands, float):
            plays = self.follow(plays, command)
            found.append(self.output(plays))
        return np.array(found)

    def first_output(self, command: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """Output of the first excursion from rest to a command, the largest it can have there."""
        command = xp.asarray(command)
        plays = xp.zeros((self.thresholds.shape[0], *command.shape))
        return self.output(self.follow(plays, command))

    def inverse(self) -> "Hysteresis":
        """Inverse operator: from the command that is to act to the command to give.

        Its thresholds are the first outputs at the thresholds of this operator.
        """
        sums = xp.cumsum(self.weights)
        later = -self.weights[1:] / (sums[1:] * sums[:-1])
        weights = xp.concatenate([1 / self.weights[:1], later])
        return Hysteresis(self.first_output(self.thresholds), weights)

    def validate(self) -> str | None:
        """Error of these numbers, as "key must ...", or None."""
        if self.weights.shape != self.thresholds.shape or not self.thresholds.size:
            return (
                "weights must be as many as thresholds, one or more; they are"
                f" {self.weights.size} and {self.thresholds.size}"
            )
        if is_concrete(self.thresholds) and concrete(self.thresholds)[0] != 0:
            return "thresholds must begin with 0, the play that is the command itself"
        if is_concrete(self.weights):
            weights = concrete(self.weights)
            if weights[0] <= 0 or np.any(weights < 0):
                return "weights must not be negative, and the first positive, for an inverse"
        return None


Lags = Float[Array, "lag *batch"]


class Creep(ReprWithUnits):
    """Sum of first-order lags added to the command that acts at once; both have its unit.

    A steady command of 1 acts as 1 at once and as 1 + sum of the weights in the end.

    >>> import jaxbeam as jb, numpy as np
    >>> creep = jb.actuators.Creep(rates=[10.0, 1.0, 0.1], weights=[0.02, 0.02, 0.02])
    >>> print(creep.outputs(np.ones(4), period=10.0).round(4))  # before, and 10, 20, 30 s after
    [1.     1.0526 1.0573 1.059 ]
    """

    rates: Float[Number, " lag"] = number("1/s", "rates of the lags", POSITIVE)
    weights: Float[Number, " lag"] = number("1", "weights of the lags", NOT_NEGATIVE)

    @property
    def final_gain(self) -> Float[Array, ""]:
        """Command that acts in the end per steady command: the largest gain."""
        return 1 + xp.sum(self.weights)

    def after(
        self, lags: Lags, command: Float[Array, "*batch"], duration: Float[Array, ""]
    ) -> Lags:
        """States of the lags after a command held for a `duration` (s)."""
        left = self._column(xp.exp(-self.rates * duration), command)
        return command + (lags - command) * left

    def mean_factors(
        self, period: Float[Array, ""]
    ) -> tuple[Float[Array, ""], Float[Array, " lag"]]:
        """Factors of the held command, and of the lags at its start, in the mean output.

        The mean of a lag z over the `period` (s) is v + (z_0 - v) (1 - exp(-a T)) / (a T).
        """
        decay = self.rates * period
        kept = -xp.expm1(-decay) / decay
        return 1 + xp.sum(self.weights * (1 - kept)), self.weights * kept

    def outputs(self, commands, period: float) -> Float[np.ndarray, " time"]:
        """Commands that act at the start of each command, held for a period (s), from rest."""
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
