"""Types of matrices of linear systems and quadratic costs."""

from jaxtyping import Float

from jaxbeam.runtime.arrays import Array

Square = Float[Array, "state state"]
InputMatrix = Float[Array, "state input"]
InputWeight = Float[Array, "input input"]


def symmetric_part(
    matrix: Float[Array, "*batch state state"],
) -> Float[Array, "*batch state state"]:
    """Symmetric part of a matrix, which removes rounding from one that is symmetric."""
    return (matrix + matrix.mT) / 2
