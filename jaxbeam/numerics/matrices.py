"""Matrices of linear systems and quadratic costs: types, symmetric part, and exponential."""

import numpy as np
from jaxtyping import Float

from jaxbeam.runtime.arrays import Array, cond, scan, solve, stop_gradient, xp

Square = Float[Array, "state state"]
InputMatrix = Float[Array, "state input"]
InputWeight = Float[Array, "input input"]
MAX_NORM = 5.37  # of a matrix whose exponential is its Pade approximant (13, 13), in doubles
MAX_SQUARINGS = 40
PADE = np.array(
    [
        64764752532480000,
        32382376266240000,
        7771770303897600,
        1187353796428800,
        129060195264000,
        10559470521600,
        670442572800,
        33522128640,
        1323241920,
        40840800,
        960960,
        16380,
        182,
        1,
    ],
    float,
)  # coefficients of its numerator, from the constant on


def symmetric_part(
    matrix: Float[Array, "*batch state state"],
) -> Float[Array, "*batch state state"]:
    """Symmetric part of a matrix, which removes rounding from one that is symmetric."""
    return (matrix + matrix.mT) / 2


def expm(matrix: Square) -> Square:
    """Exponential of a matrix by scaling, its Pade approximant (13, 13), and squaring.

    Higham, SIAM J. Matrix Anal. Appl. 26 (2005). The scaling of JAX (0.10 to 0.12) leaves a norm of
    up to twice the bound of the approximant: errors of 1e-8 where it should be 1e-15. That of scipy
    takes 0.1 s to import.
    """
    norm_of_columns = stop_gradient(xp.max(xp.sum(xp.abs(matrix), axis=0)))
    squarings = xp.ceil(xp.log2(xp.maximum(norm_of_columns / MAX_NORM, 1.0)))
    scaled = matrix / 2**squarings
    second = scaled @ scaled
    fourth = second @ second
    powers = xp.stack([np.eye(len(matrix)), second, fourth, fourth @ second])

    def polynomial(terms):
        low = xp.tensordot(terms[:4], powers, 1)
        return low + powers[3] @ xp.tensordot(terms[4:], powers[1:4], 1)

    half_even, half_odd = polynomial(PADE[::2]), scaled @ polynomial(PADE[1::2])
    root = solve(half_even - half_odd, half_even + half_odd)

    def square(root, step):
        return cond(step < squarings, lambda r: r @ r, lambda r: r, root), None

    return scan(square, root, np.arange(MAX_SQUARINGS))[0]
