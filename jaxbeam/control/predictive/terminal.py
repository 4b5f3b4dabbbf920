"""What predictive control assumes after its horizon: a cost, and a set of states.

Dual-mode control (Rawlings, Mayne and Diehl, Model Predictive Control, 2nd edition, 2017, section
2.4): from the end of the horizon on a regulator acts, whose cost is known, from a set of states in
which it keeps all limits for ever. The set is the maximal output-admissible one (Gilbert and Tan,
IEEE Trans. Automatic Control 36, 1991): the rows E of the limits, of the next periods,

    E Phi^j z <= 1,  j = 0 ... T - 1,  Phi the closed loop,

of which those of all later periods follow if those of period T do.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.control.predictive.prediction import SampledPlant, incremental_model
from jaxbeam.numerics.riccati import dare, dlqr
from jaxbeam.runtime.arrays import Array, scan, xp

LP_ROUNDING = 1e-7  # of limits, within which a linear program counts a row as implied
UNSEEN = 1e-12  # of the largest cost of a mode: less is rounding, as costs fall with frequency
MAX_PERIODS = 2000  # of a terminal set that is searched for

Square = Float[Array, "state state"]
Rows = Float[Array, "row state"]


class Terminal(NamedTuple):
    """Cost z'P z of the end of the horizon, z = `map` (x(k+N-1), x(k+N), u(k+N-1)), and its limits.

    These are `rows` z <= 1. With a `weight` (m^2) they are soft: the greatest excess e costs weight
    (e + e^2), which is none where the limits can be kept, if the weight is large enough.
    """

    map: Float[Array, "terminal end"]
    cost: Float[Array, "terminal terminal"]
    rows: Float[Array, "row terminal"]
    weight: Float[Array, ""] | None


class TerminalRegulator(NamedTuple):
    """Regulator of the unloaded plant after the horizon: z+ = `loop` z, moves du = -`gain` z.

    The states z are those of the plant without those of a delay, then the commands of the last
    period; `cost` is P, and `limits` z <= 1 are the limits of the next period.
    """

    loop: Square
    gain: Float[Array, "actuator state"]
    cost: Square
    limits: Rows

    def rows(self, periods: int) -> Rows:
        """Rows of the set in which the limits are kept over a number of periods."""

        def advance(rows, _):
            return rows @ self.loop, rows

        _, rows = scan(advance, self.limits, None, length=periods)
        return rows.reshape(-1, self.loop.shape[0])


def terminal_regulator(
    sampled: SampledPlant,
    delayed: bool,
    C: Float[Array, "output state"],
    output_weight: Float[Array, " output"],
    move_weight: Float[Array, " actuator"],
    actuators: Sequence[Any],
    period: Float[Array, ""],
    hard_limit: Float[Array, " *output"] | None,
) -> TerminalRegulator:
    """Regulator that minimises the sum of weight y^2 + move_weight du^2 of an unloaded plant.

    `sampled` is the plant, with the last commands as further states if `delayed`; `C` are rows of
    its controlled deflections y. Limits, rate limits and `hard_limit` (m) must permit zero.
    """
    count, states = sampled.B.shape[1], sampled.A.shape[0]
    A, B, outputs = sampled.A, sampled.B, C
    if not delayed:
        A = xp.pad(A, ((0, count), (0, count)))
        B = xp.concatenate([B, xp.eye(count)])
        outputs = xp.pad(C, ((0, 0), (0, count)))
        states += count
    last_command = xp.eye(count, states, k=states - count)
    A = A + B @ last_command
    Q = outputs.T @ (output_weight[:, None] * outputs)
    gain, cost = dlqr(A, B, Q, xp.diag(move_weight))
    loop = A - B @ gain
    next_command, rows = last_command - gain, [xp.zeros((0, states))]
    for i, actuator in enumerate(actuators):
        limits, rate = actuator.command_limits(), actuator.command_rate_limit()
        if limits is not None:
            rows += [next_command[i : i + 1] / limits[1], next_command[i : i + 1] / limits[0]]
        if rate is not None:
            rows += [sign * gain[i : i + 1] / (rate * period) for sign in (1.0, -1.0)]
    if hard_limit is not None:
        within = outputs @ loop / xp.broadcast_to(hard_limit, (C.shape[0],))[:, None]
        rows += [within, -within]
    return TerminalRegulator(loop, gain, cost, xp.concatenate(rows))


def limits_error(actuators: Sequence[Any]) -> str | None:
    """Error of actuators whose limits leave no room about zero, as "terminal must ...", or None."""
    for i, actuator in enumerate(actuators):
        limits = actuator.command_limits()
        if limits is None or actuator.command_unit == "1" or not is_concrete(limits):
            continue
        low, high = concrete(limits)
        if not low < 0 < high:
            return (
                "terminal must be 'none': the regulator brings commands to zero, and the limits of"
                f" actuators.{i} are {low:g} and {high:g}"
            )
    return None


def periods_needed(regulator: TerminalRegulator, at_least: int = 1) -> int | None:
    """Periods, `at_least` or more, after which limits of all later ones follow; None if too many.

    By linear programs; the numbers must be known.
    """

    def enough(periods):
        rows = concrete(regulator.rows(periods + 1))
        count = regulator.limits.shape[0]
        return _implied(rows[:-count], rows[-count:])

    low, high = at_least - 1, at_least
    while not enough(high):
        if high >= MAX_PERIODS:
            return None
        low, high = high, 2 * high
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if enough(middle) else (middle, high)
    return high


def _implied(rows: Float[np.ndarray, "row state"], further: Float[np.ndarray, "new state"]) -> bool:
    """Whether `rows` z <= 1 imply `further` z <= 1."""
    from scipy.optimize import linprog  # late: it takes longer to import than most designs

    scale = np.max(np.abs(rows), axis=0, initial=0.0)
    scale = np.where(scale > 0, scale, 1.0)
    for row in further:
        best = linprog(-row / scale, rows / scale, np.ones(len(rows)), bounds=(None, None))
        if best.status != 0 or -best.fun > 1 + LP_ROUNDING:
            return False
    return True


def dual_mode_terminal(
    regulator: TerminalRegulator,
    periods: int,
    weight: Float[Array, ""] | None,
    states: int,
) -> Terminal:
    """Terminal cost and set of a regulator, for a prediction with a number of `states`.

    The first of them are those of the plant, the others, of vehicles and of a delay, are left out.
    The `weight` of a soft set is relative to the `limit_cost`.
    """
    size, count = regulator.loop.shape[0], regulator.gain.shape[0]
    plant = xp.eye(size - count, 2 * states + count, k=states)
    command = xp.eye(count, 2 * states + count, k=2 * states)
    end_map = xp.concatenate([plant, command])
    weight = None if weight is None else weight * limit_cost(regulator)
    return Terminal(end_map, regulator.cost, regulator.rows(periods), weight)


def unseen_modes(regulator: TerminalRegulator, modes: int) -> Int[np.ndarray, " mode"]:
    """Numbers, from 1, of modes whose coordinates have no cost but rounding; numbers are known.

    By them the cost of a limit has no scale (`limit_cost`). Coordinates are the first states.
    """
    costs = np.diag(concrete(regulator.cost))[:modes]
    return 1 + np.flatnonzero(costs <= UNSEEN * costs.max())


def limit_cost(regulator: TerminalRegulator) -> Float[Array, ""]:
    """Least cost z'P z (m^2) of a state from which the regulator meets a limit; 1 without limits.

    On a row l z = 1 it is 1 / (l P^-1 l').
    """
    if not regulator.limits.shape[0]:
        return xp.ones(())
    spread = xp.linalg.solve(regulator.cost, regulator.limits.T)
    return 1 / xp.max(xp.sum(regulator.limits.T * spread, axis=0))


def incremental_terminal(
    sampled: SampledPlant,
    C: Float[Array, "output state"],
    output_weight: Float[Array, " output"],
    move_weight: Float[Array, " actuator"],
    beam: int,
    vehicles: int,
) -> Terminal:
    """Terminal cost of the incremental model, eq. (7.31), whose last change of state persists.

    A prediction has the states of `vehicles` after `beam` ones; they have no cost of their own.
    """
    A, B, output_rows = incremental_model(sampled.A, sampled.B, C)
    P = dare(A, B, output_rows.T @ (output_weight[:, None] * output_rows), xp.diag(move_weight))
    states, count = sampled.B.shape
    own = np.delete(np.eye(states + vehicles), np.s_[beam : beam + vehicles], axis=0)
    none = np.zeros((states, count))
    difference = np.concatenate([-own, own, none], axis=1)
    deflections = xp.pad(C @ own, ((0, 0), (states + vehicles, count)))
    end_map = xp.concatenate([difference, deflections])
    return Terminal(end_map, P, xp.zeros((0, end_map.shape[0])), None)
