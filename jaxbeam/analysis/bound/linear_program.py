"""The linear program behind `bound`: the least peak, and calm commands that attain it.

The unknowns are the commands, their changes from hold to hold, their sizes, and the peak. Of the
rows that keep the deflection below the peak only those are taken that would be violated without
them: they are added until none is, so that a close look at the whole beam costs little. Many
commands attain the least peak, most of them restless where nothing is at stake; a trifle of a price
on changes and sizes makes one of the calm ones best, and the rows settle in few rounds.
"""

import numpy as np
import scipy  # whose parts are loaded when used: all of them take a third of a second
from jaxtyping import Float

from jaxbeam.analysis.bound.input_influence import InputInfluence

LP_TOLERANCE = 1e-9  # of the largest deflection without commands: how exactly a program is solved
VIOLATION_TOLERANCE = 1e-7  # of the same: rows that are violated by less are left out
ACTIVITY_PENALTY = (
    1e-6  # of the same: price of a change of command by its largest value, or of its average
)
MAX_ROUNDS = 100  # of adding rows; about five are usual
HIGHS_METHODS = ("highs", "highs-ipm")  # the simplex method now and then loses its way
SOLVED, INFEASIBLE = 0, 2  # by linprog


def least_peak(
    influence: InputInfluence,
    low: Float[np.ndarray, " actuator"],
    high: Float[np.ndarray, " actuator"],
    max_change: Float[np.ndarray, " actuator"],
) -> tuple[float, Float[np.ndarray, "hold actuator"], Float[np.ndarray, "instant place"]]:
    """The least peak (m), commands that attain it, and the multipliers of the deflections.

    Commands stay between `low` and `high` and change by no more than `max_change` from hold to hold,
    beginning at zero. None have a smaller peak; these have one that is larger by a
    hundred-thousandth at most.

    Raises ValueError if no commands meet the limits, RuntimeError if the solver fails.
    """
    program = _LinearProgram(influence, low, high, max_change)
    commands, peak = np.zeros(influence.response.shape[2:]), 0.0
    for _ in range(MAX_ROUNDS):
        if not program.add_violated_rows(commands, peak):
            break
        peak, commands, _ = program.solve(ACTIVITY_PENALTY)
    else:
        raise RuntimeError(
            f"the linear program for the bound did not settle in {MAX_ROUNDS} rounds"
        )
    # With fewer rows than there are the peak is no larger than the least one: a bound in any case.
    peak, _, multipliers = program.solve(0.0)
    # Programs are solved to rounding; the commands keep to their limits nevertheless.
    changes = np.clip(np.diff(commands, axis=0, prepend=0.0), -max_change, max_change)
    return (
        peak * program.deflection_scale,
        np.clip(np.cumsum(changes, axis=0), low, high),
        multipliers,
    )


class _LinearProgram:
    """The program in scaled unknowns, and the rows taken into it so far."""

    def __init__(self, influence, low, high, max_change):
        self.influence = influence
        self.shape = influence.response.shape[2:]
        self.deflection_scale = np.max(np.abs(influence.unforced @ influence.deflection_rows.T))
        self.command_scale = _command_scales(influence, low, high, self.deflection_scale)
        self.low, self.high, self.max_change = (
            part / self.command_scale for part in (low, high, max_change)
        )
        self.active_rows = np.zeros((3, 0), int)  # instant, place, sign of the deflection

    def add_violated_rows(self, commands, peak) -> bool:
        """Take in where along the beam some commands exceed a peak most, whenever they do."""
        deflection = self.influence.deflection(commands) / self.deflection_scale
        size = np.abs(deflection)
        padded = np.pad(size, ((0, 0), (1, 1)), constant_values=-1.0)
        highest = (size >= padded[:, :-2]) & (size > padded[:, 2:])
        time_index, position_index = np.nonzero(highest & (size > peak + VIOLATION_TOLERANCE))
        new = np.stack(
            [
                time_index,
                position_index,
                np.sign(deflection[time_index, position_index]).astype(int),
            ]
        )
        self.active_rows = np.concatenate([self.active_rows, new], axis=1)
        return time_index.size > 0

    def solve(self, activity_penalty: float):
        """Least peak plus a price of restless commands: peak, commands, multipliers.

        Raises ValueError if no commands meet the limits, RuntimeError if the solver fails.
        """
        holds, actuators = self.shape
        count = holds * actuators
        penalties = [0.0, activity_penalty, activity_penalty / holds, 1.0]
        cost = np.repeat(penalties, [count, count + actuators, count, 1])
        matrix, right = self._constraints()
        options = {
            "primal_feasibility_tolerance": LP_TOLERANCE,
            "dual_feasibility_tolerance": LP_TOLERANCE,
        }
        bounds = self._bounds()
        for method in HIGHS_METHODS:
            best = scipy.optimize.linprog(
                cost, matrix, right, bounds=bounds, method=method, options=options
            )
            if best.status in (SOLVED, INFEASIBLE):
                break
        if best.status == INFEASIBLE:
            raise ValueError(
                "no commands, starting from zero, stay within limits and rates of the actuators"
            )
        if best.status != SOLVED:
            raise RuntimeError(f"the linear program for the bound failed: {best.message}")
        multipliers = np.zeros((self.influence.times.size, self.influence.deflection_rows.shape[0]))
        when, where, sign = self.active_rows
        row_multipliers = best.ineqlin.marginals[right.size - sign.size :]
        np.add.at(multipliers, (when, where), -sign * row_multipliers)
        return best.x[-1], best.x[:count].reshape(self.shape) * self.command_scale, multipliers

    def _constraints(self):
        """Rows for changes and sizes of the commands, then for the deflections taken in so far."""
        sp = scipy.sparse
        holds, actuators = self.shape
        # Commands begin at zero and, for the sake of calm, end there.
        difference = sp.eye(holds + 1, holds) - sp.eye(holds + 1, holds, k=-1)
        difference, identity = sp.kron(difference, sp.eye(actuators)), sp.eye(holds * actuators)
        change = sp.eye(difference.shape[0])
        when, where, sign = self.active_rows
        rows = self.influence.deflection_rows[where] * sign[:, None] / self.deflection_scale
        response = (
            np.einsum("im,imka->ika", rows, self.influence.response[when]) * self.command_scale
        )
        free = np.sum(rows * self.influence.unforced[when], axis=1)
        peak_rows = sp.csr_array(response.reshape(sign.size, holds * actuators))
        blocks = [
            [difference, -change, None, None],
            [-difference, -change, None, None],
            [identity, None, -identity, None],
            [-identity, None, -identity, None],
            [peak_rows, None, None, -np.ones((sign.size, 1))],
        ]
        matrix = sp.block_array(blocks).tocsr()
        return matrix, np.concatenate([np.zeros(matrix.shape[0] - sign.size), -free])

    def _bounds(self):
        holds, actuators = self.shape
        unlimited = np.full(actuators, np.inf), np.full(holds * actuators, np.inf), [np.inf]
        high = np.concatenate(
            [np.tile(self.high, holds), np.tile(self.max_change, holds), *unlimited]
        )
        low = np.zeros(high.size)
        low[: holds * actuators] = np.tile(self.low, holds)
        return np.stack([low, high], axis=1)


def _command_scales(influence, low, high, deflection_scale):
    """What each command is measured in: its larger limit, or what bends the beam as loads do."""
    deflection_per_command = np.abs(influence.deflection_rows).max(axis=0) @ np.abs(influence.response).max(
        axis=(0, 2)
    )
    scales = np.where(
        deflection_per_command > 0,
        deflection_scale / np.where(deflection_per_command > 0, deflection_per_command, 1.0),
        1.0,
    )
    largest = np.maximum(np.abs(low), np.abs(high))
    return np.where(np.isfinite(largest) & (largest > 0), largest, scales)
