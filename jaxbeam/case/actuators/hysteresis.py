"""Hysteresis of an actuator: the Prandtl-Ishlinskii operator, a sum of play operators.

With plays p_i of thresholds r_i, which follow the command u where it leaves their dead band,

    p_i <- max(u - r_i, min(u + r_i, p_i)),     H[u] = sum of w_i p_i.

The first threshold is zero: that play is the command itself. The output does not depend on the
rate of the command, and its inverse is an operator of the same kind (Krejci and Kuhnen, IEE
Proceedings - Control Theory and Applications 148, 2001).
"""

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from jaxbeam.case.display.parts import ReprWithUnits
from jaxbeam.case.fields import INCREASING, concrete, is_concrete, number
from jaxbeam.runtime.arrays import Array, xp

Plays = Float[Array, "play *batch"]


class Hysteresis(ReprWithUnits):
    """Prandtl-Ishlinskii operator, from the command of an actuator to the command that acts.

    Both have the unit of the command. Its slope is the first weight where the command turns, and
    approaches the sum of the weights under a command that keeps rising. Plays start from zero.

    >>> import jaxbeam as jb
    >>> patch = jb.Patch(0.25, 0.35, moment_per_volt=8e-4)
    >>> hysteresis = jb.Hysteresis(thresholds=[0.0, 1.0], weights=[0.8, 0.4])
    >>> print(hysteresis.outputs([0.0, 5.0, 3.0, 0.0]))
    [0.  5.6 4.  0.4]
    """

    thresholds: Float[Array, " play"] = number(
        "unit of a command", "thresholds of the plays; the first is zero", INCREASING
    )
    weights: Float[Array, " play"] = number("1", "weights of the plays")

    def follow(self, plays: Plays, command: Float[Array, "*batch"]) -> Plays:
        """Plays after a command."""
        r = self.thresholds.reshape(-1, *[1] * xp.ndim(command))
        return xp.maximum(command - r, xp.minimum(command + r, plays))

    def output(self, plays: Plays) -> Float[Array, "*batch"]:
        """Command that acts."""
        return xp.tensordot(self.weights, plays, axes=1)

    def outputs(self, commands: ArrayLike) -> Float[np.ndarray, " time"]:
        """Commands that act for commands (time,) in turn, from rest."""
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
        """Operator that gives the command with which a wanted one acts.

        Its thresholds are the first outputs at those of this operator.
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
