"""Operators between commands and what acts: hysteresis, then creep; and their inverses.

Commands are held for a period. What acts in it is the mean over the period, which drifts by less
than a rate of the creep times the period from its ends.
"""

from jaxtyping import Float

from jaxbeam.case.actuators.hysteresis import Creep, Hysteresis
from jaxbeam.runtime.arrays import Array, xp
from jaxbeam.runtime.module import Module

State = Float[Array, "state batch"]
Command = Float[Array, " batch"]


class CommandOperator(Module):
    """Hysteresis, then creep, under commands held for a period (s): from a command to what acts.

    The state has the plays, the first of which is the command itself, and the lags at the start of
    the period.
    """

    hysteresis: Hysteresis
    creep: Creep | None
    period: Float[Array, ""]

    def start(self, batch_size: int) -> State:
        """State at rest."""
        lags = 0 if self.creep is None else self.creep.rates.shape[0]
        return xp.zeros((self.hysteresis.thresholds.shape[0] + lags, batch_size))

    def follow(self, state: State, command: Command) -> State:
        """State in the period of a command, after that of the last."""
        plays, lags = self._parts(state)
        followed = self.hysteresis.follow(plays, command)
        if self.creep is None:
            return followed
        lags = self.creep.after(lags, self.hysteresis.output(plays), self.period)
        return xp.concatenate([followed, lags])

    def output(self, state: State) -> Command:
        """What acts, its mean over the period."""
        plays, lags = self._parts(state)
        at_once = self.hysteresis.output(plays)
        if self.creep is None:
            return at_once
        of_command, of_lags = self.creep.shares(self.period)
        return of_command * at_once + xp.tensordot(of_lags, lags, axes=1)

    def inverse(self) -> "InverseOperator":
        """Operator that gives the command with which a wanted one acts."""
        return InverseOperator(self.hysteresis.inverse(), self.creep, self.period)

    def _parts(self, state):
        count = self.hysteresis.thresholds.shape[0]
        return state[:count], state[count:]


class InverseOperator(Module):
    """Inverse of a `CommandOperator`; `hysteresis` is the inverse of that of the operator.

    The lags follow from past commands, so that y = s v + sum of s_i z_i has the solution v, the
    command that is to act at once.
    """

    hysteresis: Hysteresis
    creep: Creep | None
    period: Float[Array, ""]

    def start(self, batch_size: int) -> State:
        """State at rest."""
        return CommandOperator(self.hysteresis, self.creep, self.period).start(batch_size)

    def follow(self, state: State, wanted: Command) -> State:
        """State in the period of a wanted command, after that of the last."""
        if self.creep is None:
            return self.hysteresis.follow(state, wanted)
        count = self.hysteresis.thresholds.shape[0]
        # The first threshold is zero: its play is the last command that acted at once.
        lags = self.creep.after(state[count:], state[0], self.period)
        of_command, of_lags = self.creep.shares(self.period)
        at_once = (wanted - xp.tensordot(of_lags, lags, axes=1)) / of_command
        return xp.concatenate([self.hysteresis.follow(state[:count], at_once), lags])

    def output(self, state: State) -> Command:
        """Command to be sent."""
        return self.hysteresis.output(state[: self.hysteresis.thresholds.shape[0]])


def command_operator(
    hysteresis: Hysteresis | None, creep: Creep | None, period: Float[Array, ""]
) -> CommandOperator | None:
    """Operator of an actuator; None where it has neither hysteresis nor creep."""
    if hysteresis is None and creep is None:
        return None
    if hysteresis is None:
        hysteresis = Hysteresis(xp.zeros(1), xp.ones(1))
    return CommandOperator(hysteresis, creep, period)
