"""Quadratic program of predictive control: limits are added one after the other, hard or soft."""

from typing import NamedTuple

from jaxtyping import Bool, Float

from jaxbeam.numerics.optimisation.qp import solve_qp
from jaxbeam.runtime.arrays import Array, block_diag, solve, xp


class QuadraticProgram(NamedTuple):
    """Minimise 1/2 x'H x + f'x subject to M x <= gamma."""

    H: Float[Array, "variable variable"]
    f: Float[Array, " variable"]
    M: Float[Array, "row variable"]
    gamma: Float[Array, " row"]

    def within(
        self, rows: Float[Array, "limit variable"], sides: Float[Array, " limit"]
    ) -> "QuadraticProgram":
        """Program with further limits on its variables, or on the first of them."""
        rows = xp.pad(rows, ((0, 0), (0, self.f.shape[0] - rows.shape[1])))
        return self._replace(
            M=xp.concatenate([self.M, rows]), gamma=xp.concatenate([self.gamma, sides])
        )

    def softly_within(
        self,
        rows: Float[Array, "limit variable"],
        sides: Float[Array, " limit"],
        excess: Float[Array, "limit excess"],
        costs: Float[Array, " excess"],
    ) -> "QuadraticProgram":
        """Program with limits rows x - excess e <= sides, and further variables e of cost c e^2."""
        further = excess.shape[1]
        rows = xp.pad(rows, ((0, 0), (0, self.f.shape[0] - rows.shape[1])))
        return QuadraticProgram(
            block_diag(self.H, xp.diag(2 * costs)),
            xp.pad(self.f, (0, further)),
            xp.concatenate(
                [
                    xp.pad(self.M, ((0, 0), (0, further))),
                    xp.concatenate([rows, -excess], axis=1),
                ]
            ),
            xp.concatenate([self.gamma, sides]),
        )


def first_move(
    program: QuadraticProgram, move_maps: Float[Array, "horizon actuator variable"], solver: str
) -> tuple[Float[Array, " actuator"], Bool[Array, ""]]:
    """First move of the solution, and whether there is one."""
    if program.M.shape[0] == 0:
        return move_maps[0] @ -solve(program.H, program.f), xp.ones((), bool)
    solution = solve_qp(*program, solver)
    return move_maps[0] @ solution.x[: move_maps.shape[2]], solution.solved
