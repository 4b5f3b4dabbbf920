"""H-infinity control of a plant at samples: the law that keeps the worst gain below a level.

    x+ = A x + B u + E w,      y = C x + n,      z = (x' Q x + u' R u)^(1/2)

Disturbances w and noise n of bounded energy, n in units of the covariance N, are to make no more
than `level`^2 times their energy in z. It is a game in which they oppose the command; its values
are two Riccati equations, that of the state feedback, M, and that of the filter, S, and the largest
eigenvalue of S M stays below level^2 (Basar and Bernhard, H-infinity-Optimal Control and Related
Minimax Design Problems, 1995, chapters 3 and 6). The reading of a sample acts on its command. As
the level tends to infinity, the law tends to the LQG one.
"""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from jaxbeam.case.fields import concrete, is_concrete
from jaxbeam.numerics.matrices import InputMatrix, InputWeight, Square, symmetric_part
from jaxbeam.numerics.riccati import indefinite_dare
from jaxbeam.runtime.arrays import Array, any_jax, fori_loop, solve, stop_gradient, xp

HIGHEST_LEVEL, BISECTIONS = 1e9, 36  # from 1e9 to 1e-9, in logarithms
ROUNDING = 1e-9  # of an eigenvalue that may be zero, relative to the largest


class Game(NamedTuple):
    """Matrices of the plant and its costs; see the module."""

    A: Square
    B: InputMatrix
    C: Float[Array, "output state"]
    E: Float[Array, "state force"]
    Q: Square
    R: InputWeight
    N: Float[Array, "output output"]


class MinimaxLaw(NamedTuple):
    """Law u = K x + D y of the predicted state x, with x+ = F x + G y + B u."""

    F: Square
    G: Float[Array, "state output"]
    K: Float[Array, "actuator state"]
    D: Float[Array, "actuator output"]


def minimax_law(game: Game, level: Float[Array, ""]) -> MinimaxLaw:
    """Law that keeps the worst gain below a level; nan where there is none. Differentiable."""
    A, B, C, _, Q, R, N = game
    M, spread = values(game, level)
    informed = C.T @ solve(N, C)
    one = xp.eye(A.shape[0])
    feedback = solve(R, B.T @ M @ solve(one + _opposed(game, level) @ M, A))
    gain = solve(N, C @ spread).T  # of the readings in the worst state
    worst = solve(one + spread @ (informed - M / level**2), one)
    inward = A @ solve(one + spread @ (informed - Q / level**2), one)
    return MinimaxLaw(
        F=inward,
        G=inward @ gain,
        K=-feedback @ worst,
        D=-feedback @ worst @ gain,
    )


def values(game: Game, level: Float[Array, ""]) -> tuple[Square, Square]:
    """Value matrix M of the state feedback, and matrix of the filter, for a level.

    M = Q + A' M (1 + (B R^-1 B' - E E' / level^2) M)^-1 A, and with S in the place of M and C' of B
    the same of A', E E' and C' N^-1 C - Q / level^2.
    """
    informed = game.C.T @ solve(game.N, game.C)
    M = indefinite_dare(game.A, _opposed(game, level), game.Q)
    spread = indefinite_dare(game.A.T, informed - game.Q / level**2, game.E @ game.E.T)
    return M, spread


def is_attained(game: Game, level: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether some law keeps the worst gain below a level."""
    M, spread = values(game, level)
    finite = xp.all(xp.isfinite(M)) & xp.all(xp.isfinite(spread))
    M, spread = (xp.where(finite, part, xp.zeros_like(part)) for part in (M, spread))
    informed = game.C.T @ solve(game.N, game.C)
    root = _root(spread)
    one = xp.eye(root.shape[0])
    for matrix in (M, spread):
        eigenvalues = xp.linalg.eigvalsh(symmetric_part(matrix))
        finite = finite & (eigenvalues[0] >= -ROUNDING * xp.max(xp.abs(eigenvalues)))
    positive = (
        xp.eye(game.E.shape[1]) - game.E.T @ M @ game.E / level**2,
        one + root.T @ (informed - game.Q / level**2) @ root,
        one - root.T @ M @ root / level**2,
    )
    for matrix in positive:
        finite = finite & (xp.linalg.eigvalsh(symmetric_part(matrix))[0] > 0)
    return finite


def least_level(game: Game) -> Float[Array, ""]:
    """Least level that a law attains, within 1e-9 of it.

    Its derivative is that of the level at which the largest eigenvalue of S M is its square.
    Raises ValueError if there is none; under `jit` and `vmap` it is nan.
    """
    fixed = stop_gradient(game)
    start = xp.asarray(HIGHEST_LEVEL)

    def lower(bounds):
        attained, missed = bounds
        middle = xp.sqrt(attained * missed)
        good = is_attained(fixed, middle)
        return xp.where(good, middle, attained), xp.where(good, missed, middle)

    bounds = start, 1 / start
    bounds = fori_loop(0, BISECTIONS, lambda _, bounds: lower(bounds), bounds)
    level = xp.where(is_attained(fixed, start), bounds[0], xp.nan)
    if is_concrete(level) and not np.isfinite(concrete(level)):
        raise ValueError(
            "no law makes the loop stable: an unstable or undamped mode is not reached by the"
            " commands, or not seen by the sensors"
        )
    return level + _change(game, fixed, level) if any_jax(game) else level


def _change(game: Game, fixed: Game, level):
    """Zero, with the derivative of the level at which 1 - S M / level^2 is singular.

    With its null vectors l and r, l' d(matrix) r = 0.
    """

    def coupled(game, level):
        M, spread = values(game, level)
        return xp.eye(M.shape[0]) - spread @ M / level**2

    matrix, slope = jax.jvp(lambda x: coupled(fixed, x), (level,), (xp.ones_like(level),))
    singular = stop_gradient(matrix)
    left, right = (
        xp.linalg.eigh(part)[1][:, 0] for part in (singular @ singular.T, singular.T @ singular)
    )
    change = left @ (coupled(game, level) - singular) @ right
    return -change / stop_gradient(left @ slope @ right)


def _opposed(game: Game, level) -> Square:
    """B R^-1 B' - E E' / level^2."""
    return symmetric_part(game.B @ solve(game.R, game.B.T) - game.E @ game.E.T / level**2)


def _root(matrix: Square) -> Square:
    """Root S of a positive semidefinite matrix, S S' = matrix."""
    eigenvalues, vectors = xp.linalg.eigh(symmetric_part(matrix))
    return vectors * xp.sqrt(xp.maximum(eigenvalues, 0.0))
