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
InputMatrix = Float[Array, "state input"]
InputWeight = Float[Array, "input input"]


class Interval(eqx.Module):
    """What a stretch of time does to optimal state and costate; see the module."""

    transition: Float[Array, "*batch state state"]
    G: Float[Array, "*batch state state"]
    H: Float[Array, "*batch state state"]

    def compose(self, later: "Interval") -> "Interval":
        """This stretch followed by a later one."""
        transition_transposed = matrix_transpose(self.transition)
        coupling = jnp.eye(self.transition.shape[-1]) + self.G @ later.H
        solved = jnp.linalg.solve(coupling, jnp.concatenate([self.transition, self.G], axis=-1))
        transition, G = jnp.split(solved, 2, axis=-1)
        return Interval(
            transition=later.transition @ transition,
            G=later.G + symmetric_part(later.transition @ G @ matrix_transpose(later.transition)),
            H=self.H + symmetric_part(transition_transposed @ later.H @ transition),
        )

    def backward(self, cost: Square) -> Square:
        """P at its start for P at its end."""
        coupling = jnp.eye(cost.shape[-1]) + self.G @ cost
        solved = jnp.linalg.solve(coupling, self.transition)
        return self.H + symmetric_part(matrix_transpose(self.transition) @ cost @ solved)


def costate_unit(G: Square, H: Square) -> Float[Array, ""]:
    """The unit of the costate in which reach and toll are of like size; one if either is zero."""
    G_size, H_size = jnp.sum(G**2), jnp.sum(H**2)
    both = (G_size > 0) & (H_size > 0)
    ratio = jnp.where(both, G_size, 1.0) / jnp.where(both, H_size, 1.0)
    return jax.lax.stop_gradient(ratio**0.25)


def matrix_transpose(
    matrix: Float[Array, "*batch row column"],
) -> Float[Array, "*batch column row"]:
    """The transpose of a matrix."""
    return jnp.swapaxes(matrix, -1, -2)


def symmetric_part(
    matrix: Float[Array, "*batch state state"],
) -> Float[Array, "*batch state state"]:
    """The symmetric part of a matrix."""
    return (matrix + matrix_transpose(matrix)) / 2
