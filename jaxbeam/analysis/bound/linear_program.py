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

from jaxbeam.analysis.bound.input_influence import Reach

EXACT = 1e-9  # of the largest deflection without commands: how exactly a program is solved
VIOLATED = 1e-7  # of the same: rows that are violated by less are left out
CALM = 1e-6  # of the same: price of a change of command by its largest value, or of its average
ROUNDS = 100  # of adding rows; about five are usual
METHODS = ("highs", "highs-ipm")  # the simplex method now and then loses its way
SOLVED, INFEASIBLE = 0, 2  # by linprog


def least_peak(
    found: Reach,
    low: Float[np.ndarray, " actuator"],
    high: Float[np.ndarray, " actuator"],
    change: Float[np.ndarray, " actuator"],
) -> tuple[float, Float[np.ndarray, "hold actuator"], Float[np.ndarray, "instant place"]]:
    """The least peak (m), commands that attain it, and the multipliers of the deflections.

    Commands stay between `low` and `high` and change by no more than `change` from hold to hold,
    beginning at zero. None have a smaller peak; these have one that is larger by a
    hundred-thousandth at most.

    Raises ValueError if no commands meet the limits, RuntimeError if the solver fails.
    """
    program = _Program(found, low, high, change)
    commands, peak = np.zeros(found.response.shape[2:]), 0.0
    for _ in range(ROUNDS):
        if not program.take(commands, peak):
            break
        peak, commands, _ = program.solve(CALM)
    else:
        raise RuntimeError(f"the linear program for the bound did not settle in {ROUNDS} rounds")
    # With fewer rows than there are the peak is no larger than the least one: a bound in any case.
    peak, _, weights = program.solve(0.0)
    # Programs are solved to rounding; the commands keep to their limits nevertheless.
    changes = np.clip(np.diff(commands, axis=0, prepend=0.0), -change, change)
    return peak * program.size, np.clip(np.cumsum(changes, axis=0), low, high), weights


class _Program:
    """The program in scaled unknowns, and the rows taken into it so far."""

    def __init__(self, found, low, high, change):
        self.found = found
        self.shape = found.response.shape[2:]
        self.size = np.max(np.abs(found.free @ found.rows.T))
        self.unit = _units(found, low, high, self.size)
        self.low, self.high, self.change = (part / self.unit for part in (low, high, change))
        self.taken = np.zeros((3, 0), int)  # instant, place, sign of the deflection

    def take(self, commands, peak) -> bool:
        """Take in where along the beam some commands exceed a peak most, whenever they do."""
        deflection = self.found.deflection(commands) / self.size
        size = np.abs(deflection)
        around = np.pad(size, ((0, 0), (1, 1)), constant_values=-1.0)
        highest = (size >= around[:, :-2]) & (size > around[:, 2:])
        when, where = np.nonzero(highest & (size > peak + VIOLATED))
        new = np.stack([when, where, np.sign(deflection[when, where]).astype(int)])
        self.taken = np.concatenate([self.taken, new], axis=1)
        return when.size > 0

    def solve(self, price: float):
        """Least peak plus a price of restless commands: peak, commands, multipliers.

        Raises ValueError if no commands meet the limits, RuntimeError if the solver fails.
        """
        holds, actuators = self.shape
        count = holds * actuators
        prices = [0.0, price, price / holds, 1.0]
        cost = np.repeat(prices, [count, count + actuators, count, 1])
        matrix, right = self._matrix()
        exact = {"primal_feasibility_tolerance": EXACT, "dual_feasibility_tolerance": EXACT}
        bounds = self._bounds()
        for method in METHODS:
            best = scipy.optimize.linprog(
                cost, matrix, right, bounds=bounds, method=method, options=exact
            )
            if best.status in (SOLVED, INFEASIBLE):
                break
        if best.status == INFEASIBLE:
            raise ValueError(
                "no commands, starting from zero, stay within limits and rates of the actuators"
            )
        if best.status != SOLVED:
            raise RuntimeError(f"the linear program for the bound failed: {best.message}")
        weights = np.zeros((self.found.instants.size, self.found.rows.shape[0]))
        when, where, sign = self.taken
        felt = best.ineqlin.marginals[right.size - sign.size :]
        np.add.at(weights, (when, where), -sign * felt)
        return best.x[-1], best.x[:count].reshape(self.shape) * self.unit, weights

    def _matrix(self):
        """Rows for changes and sizes of the commands, then for the deflections taken in so far."""
        sp = scipy.sparse
        holds, actuators = self.shape
        # Commands begin at zero and, for the sake of calm, end there.
        step = sp.eye(holds + 1, holds) - sp.eye(holds + 1, holds, k=-1)
        step, one = sp.kron(step, sp.eye(actuators)), sp.eye(holds * actuators)
        change = sp.eye(step.shape[0])
        when, where, sign = self.taken
        rows = self.found.rows[where] * sign[:, None] / self.size
        response = np.einsum("im,imka->ika", rows, self.found.response[when]) * self.unit
        free = np.sum(rows * self.found.free[when], axis=1)
        felt = sp.csr_array(response.reshape(sign.size, holds * actuators))
        blocks = [
            [step, -change, None, None],
            [-step, -change, None, None],
            [one, None, -one, None],
            [-one, None, -one, None],
            [felt, None, None, -np.ones((sign.size, 1))],
        ]
        matrix = sp.block_array(blocks).tocsr()
        return matrix, np.concatenate([np.zeros(matrix.shape[0] - sign.size), -free])

    def _bounds(self):
        holds, actuators = self.shape
        free = np.full(actuators, np.inf), np.full(holds * actuators, np.inf), [np.inf]
        high = np.concatenate([np.tile(self.high, holds), np.tile(self.change, holds), *free])
        low = np.zeros(high.size)
        low[: holds * actuators] = np.tile(self.low, holds)
        return np.stack([low, high], axis=1)


def _units(found, low, high, size):
    """What each command is measured in: its larger limit, or what bends the beam as loads do."""
    moved = np.abs(found.rows).max(axis=0) @ np.abs(found.response).max(axis=(0, 2))
    sized = np.where(moved > 0, size / np.where(moved > 0, moved, 1.0), 1.0)
    largest = np.maximum(np.abs(low), np.abs(high))
    return np.where(np.isfinite(largest) & (largest > 0), largest, sized)
