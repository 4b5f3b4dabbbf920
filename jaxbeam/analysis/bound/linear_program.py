"""Linear program of `bound`: least peak, and commands that attain it.

The unknowns are the commands, bounds on their changes and absolute values, and the peak. Rows that
keep the deflection below the peak are generated: those violated are added until none is, so that
many positions cost little. Many commands attain the least peak; a small penalty on changes and
absolute values selects smooth ones, and reduces the number of rounds.
"""

import numpy as np
import scipy  # loads its parts on first use; all of them take a third of a second
from jaxtyping import Float

from jaxbeam.analysis.bound.input_influence import InputInfluence

# Tolerances and the penalty are relative to the largest deflection without commands.
LP_TOLERANCE = 1e-9  # feasibility tolerance of the solver
VIOLATION_TOLERANCE = 1e-7  # rows violated by less are not added
ACTIVITY_PENALTY = 1e-6  # on a change of a command, or its mean absolute value, of its scale
FIRST_ROWS = 0.5  # deflection without commands above which rows are in the first round
MAX_ROUNDS = 100  # of adding rows; about five are usual
HIGHS_METHODS = ("highs", "highs-ipm")  # the simplex method fails on some programs
SOLVED, INFEASIBLE = 0, 2  # status of linprog


def least_peak(
    influence: InputInfluence,
    low: Float[np.ndarray, " actuator"],
    high: Float[np.ndarray, " actuator"],
    max_change: Float[np.ndarray, " actuator"],
) -> tuple[float, Float[np.ndarray, "hold actuator"], Float[np.ndarray, "time position"]]:
    """Least peak (m), commands that attain it to 1e-5, and multipliers of the deflections.

    Commands stay between `low` and `high` and change by at most `max_change` from hold to hold,
    starting from zero.

    Raises ValueError if no commands meet the limits, RuntimeError if the solver fails.
    """
    program = _LinearProgram(influence, low, high, max_change)
    commands, peak = np.zeros(influence.response.shape[2:]), FIRST_ROWS
    for _ in range(MAX_ROUNDS):
        if not program.add_violated_rows(commands, peak):
            break
        peak, commands, _ = program.solve(ACTIVITY_PENALTY)
    else:
        raise RuntimeError(
            f"the linear program of the bound has not converged in {MAX_ROUNDS} rounds"
        )
    # With a part of the rows the optimum is at most the least peak: a bound in any case.
    peak, _, multipliers = program.solve(0.0)
    # The solver meets limits to its tolerance; the commands meet them exactly.
    changes = np.clip(np.diff(commands, axis=0, prepend=0.0), -max_change, max_change)
    return (
        peak * program.deflection_scale,
        np.clip(np.cumsum(changes, axis=0), low, high),
        multipliers,
    )


class _LinearProgram:
    """Linear program in scaled unknowns, with the rows added so far."""

    def __init__(self, influence, low, high, max_change):
        self.influence = influence
        self.shape = influence.response.shape[2:]
        self.deflection_scale = np.max(np.abs(influence.unforced @ influence.deflection_rows.T))
        self.command_scale = _command_scales(influence, low, high, self.deflection_scale)
        self.low, self.high, self.max_change = (
            part / self.command_scale for part in (low, high, max_change)
        )
        # Rows so far: time index, position index, sign of the deflection.
        self.generated_rows = np.zeros((3, 0), int)

    def add_violated_rows(self, commands, peak) -> bool:
        """Add rows at local maxima along the beam where the deflection exceeds a peak.

        Returns whether there are any.
        """
        deflection = self.influence.deflection(commands) / self.deflection_scale
        size = np.abs(deflection)
        padded = np.pad(size, ((0, 0), (1, 1)), constant_values=-1.0)
        local_maxima = (size >= padded[:, :-2]) & (size > padded[:, 2:])
        time_index, position_index = np.nonzero(local_maxima & (size > peak + VIOLATION_TOLERANCE))
        new_rows = np.stack(
            [
                time_index,
                position_index,
                np.sign(deflection[time_index, position_index]).astype(int),
            ]
        )
        self.generated_rows = np.concatenate([self.generated_rows, new_rows], axis=1)
        return time_index.size > 0

    def solve(self, activity_penalty: float):
        """Scaled peak, commands and multipliers that minimise the peak plus activity penalties.

        Raises ValueError if no commands meet the limits, RuntimeError if the solver fails.
        """
        holds, actuators = self.shape
        count = holds * actuators
        penalties = [0.0, activity_penalty, activity_penalty / holds, 1.0]
        cost = np.repeat(penalties, [count, count + actuators, count, 1])
        matrix, right_side = self._constraints()
        options = {
            "primal_feasibility_tolerance": LP_TOLERANCE,
            "dual_feasibility_tolerance": LP_TOLERANCE,
        }
        bounds = self._bounds()
        for method in HIGHS_METHODS:
            solution = scipy.optimize.linprog(
                cost, matrix, right_side, bounds=bounds, method=method, options=options
            )
            if solution.status in (SOLVED, INFEASIBLE):
                break
        if solution.status == INFEASIBLE:
            raise ValueError(
                "no commands, starting from zero, meet limits and rates of the actuators"
            )
        if solution.status != SOLVED:
            raise RuntimeError(f"the linear program of the bound failed: {solution.message}")
        multipliers = np.zeros((self.influence.times.size, self.influence.deflection_rows.shape[0]))
        when, where, sign = self.generated_rows
        row_multipliers = solution.ineqlin.marginals[right_side.size - sign.size :]
        np.add.at(multipliers, (when, where), -sign * row_multipliers)
        return (
            solution.x[-1],
            solution.x[:count].reshape(self.shape) * self.command_scale,
            multipliers,
        )

    def _constraints(self):
        """Rows for changes and absolute values of commands, then for deflections; right side."""
        sp = scipy.sparse
        holds, actuators = self.shape
        # Commands start from zero; the penalty on changes includes the return to zero at the end.
        difference = sp.eye(holds + 1, holds) - sp.eye(holds + 1, holds, k=-1)
        difference, identity = sp.kron(difference, sp.eye(actuators)), sp.eye(holds * actuators)
        change = sp.eye(difference.shape[0])
        when, where, sign = self.generated_rows
        rows = self.influence.deflection_rows[where] * sign[:, None] / self.deflection_scale
        response = (
            np.einsum("im,imka->ika", rows, self.influence.response[when]) * self.command_scale
        )
        unforced = np.sum(rows * self.influence.unforced[when], axis=1)
        peak_rows = sp.csr_array(response.reshape(sign.size, holds * actuators))
        blocks = [
            [difference, -change, None, None],
            [-difference, -change, None, None],
            [identity, None, -identity, None],
            [-identity, None, -identity, None],
            [peak_rows, None, None, -np.ones((sign.size, 1))],
        ]
        matrix = sp.block_array(blocks).tocsr()
        return matrix, np.concatenate([np.zeros(matrix.shape[0] - sign.size), -unforced])

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
    """Scale of each command: its larger limit, or that which deflects the beam as the loads do."""
    largest_rows = np.abs(influence.deflection_rows).max(axis=0)
    deflection_per_command = largest_rows @ np.abs(influence.response).max(axis=(0, 2))
    scales = np.where(
        deflection_per_command > 0,
        deflection_scale / np.where(deflection_per_command > 0, deflection_per_command, 1.0),
        1.0,
    )
    largest = np.maximum(np.abs(low), np.abs(high))
    return np.where(np.isfinite(largest) & (largest > 0), largest, scales)
