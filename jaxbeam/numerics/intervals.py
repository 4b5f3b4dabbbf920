"""Stretches of time, with which optimal control is carried backward along a varying plant.

Over a stretch the optimal state x and costate l = P x obey

    x(end) = drift x(start) - reach l(end),     l(start) = toll x(start) + drift' l(end),

with `reach` and `toll` symmetric and not negative. Two stretches joined are a stretch again:
joining is associative, and nothing in it grows, however stiff the plant. So they may be joined one
by one, or in parallel as a tree (Sarkka and Garcia-Fernandez, IEEE Trans. Automatic Control 68,
2023), or to themselves (see `riccati`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Square = Float[Array, "state state"]
Inputs = Float[Array, "state input"]
Commands = Float[Array, "input input"]


class Stretch(eqx.Module):
    """What a stretch of time does to optimal state and costate; see the module."""

    drift: Float[Array, "*batch state state"]
    reach: Float[Array, "*batch state state"]
    toll: Float[Array, "*batch state state"]

    def then(self, later: "Stretch") -> "Stretch":
        """This stretch followed by a later one."""
        back = transposed(self.drift)
        between = jnp.eye(self.drift.shape[-1]) + self.reach @ later.toll
        passed = jnp.linalg.solve(between, jnp.concatenate([self.drift, self.reach], axis=-1))
        drift, reach = jnp.split(passed, 2, axis=-1)
        return Stretch(
            drift=later.drift @ drift,
            reach=later.reach + symmetric(later.drift @ reach @ transposed(later.drift)),
            toll=self.toll + symmetric(back @ later.toll @ drift),
        )

    def before(self, cost: Square) -> Square:
        """P at its start for P at its end."""
        between = jnp.eye(cost.shape[-1]) + self.reach @ cost
        passed = jnp.linalg.solve(between, self.drift)
        return self.toll + symmetric(transposed(self.drift) @ cost @ passed)


def even_units(reach: Square, toll: Square) -> Float[Array, ""]:
    """The unit of the costate in which reach and toll are of like size; one if either is zero."""
    above, below = jnp.sum(reach**2), jnp.sum(toll**2)
    both = (above > 0) & (below > 0)
    ratio = jnp.where(both, above, 1.0) / jnp.where(both, below, 1.0)
    return jax.lax.stop_gradient(ratio**0.25)


def transposed(matrix: Float[Array, "*batch row column"]) -> Float[Array, "*batch column row"]:
    """The transpose of a matrix."""
    return jnp.swapaxes(matrix, -1, -2)


def symmetric(matrix: Float[Array, "*batch state state"]) -> Float[Array, "*batch state state"]:
    """The symmetric part of a matrix."""
    return (matrix + transposed(matrix)) / 2
