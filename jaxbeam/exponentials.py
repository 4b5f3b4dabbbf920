"""Exact propagation of a linear system over a step, with forces polynomial in time.

For z' = A z + B f with f(t) = sum_k f_k l_k(t / h), the l_k being the Lagrange polynomials
through Gauss nodes, the state at any fraction c of a step h is

    z(c h) = Phi_c z(0) + sum_k Theta_ck f_k

with Phi_c = exp(A c h) and Theta_ck a combination of the phi functions
phi_p(X) = int_0^1 e^{(1 - s) X} s^{p - 1} / (p - 1)! ds (Hochbruck and Ostermann, Acta Numerica
2010, section 2). They are summed as a Taylor series of a fraction of X and doubled a fixed number
of times, which holds for any damping, rigid-body modes and lags alike, and differentiates.
"""

import functools
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.rig import Rig

NODES = 6  # Gauss nodes a step; the integrator is of order 12
POINTS = 6  # equal intervals a step at whose ends the deflection is looked at for its peak
DOUBLINGS = 7
TERMS = 14
LONGEST = 0.5 * 2**DOUBLINGS  # largest norm of A h for which the series is right to rounding

GAUSS = (np.polynomial.legendre.leggauss(NODES)[0] + 1) / 2


class Step(eqx.Module):
    """Propagators over steps of given lengths: at the Gauss nodes, at the end, at equal points.

    `drift_*` take the state at the start, `push_*` the inputs at the Gauss nodes; in the blocks of
    the rig. `points` run from the start to the end of the step, both included.
    """

    drift_nodes: Float[Array, "*length node block side side"]
    push_nodes: Float[Array, "*length node force block side input"]
    drift_end: Float[Array, "*length block side side"]
    push_end: Float[Array, "*length force block side input"]
    drift_points: Float[Array, "*length point block side side"]
    push_points: Float[Array, "*length point force block side input"]


@functools.cache
def _lagrange() -> np.ndarray:
    """Monomial coefficients (node, power) of the Lagrange polynomials through the Gauss nodes."""
    polynomials = []
    for k, node in enumerate(GAUSS):
        others = np.delete(GAUSS, k)
        polynomials.append(np.polynomial.polynomial.polyfromroots(others) / np.prod(node - others))
    return np.array(polynomials)


def at_ends() -> np.ndarray:
    """Weights (node, end) of the values at the Gauss nodes for those at start and end of a step."""
    coefficients = _lagrange()
    return np.stack([coefficients[:, 0], coefficients.sum(axis=1)], axis=1)


def _multiply(a, b):
    """Products of matrices (side, side, many) and (..., side, column, many).

    Spelt out for the tiny blocks of single modes, many side by side.
    """
    side = a.shape[0]
    if side > 3:
        return jnp.einsum("ijn,...jcn->...icn", a, b)
    return sum(a[:, i, None] * b[..., i : i + 1, :, :] for i in range(side))


def norm(rig: Rig) -> Float[Array, ""]:
    """Norm of the balanced state matrix in 1/s: steps must be shorter than `LONGEST` over it."""
    balance = _balance(rig)
    matrix = rig.state_matrix * balance[:, :, None] / balance[:, None, :]
    return jax.lax.stop_gradient(jnp.max(jnp.sum(jnp.abs(matrix), axis=-1)))


def _balance(rig: Rig):
    """Scale of the states (block, side) that gives deflections and speeds of modes equal size."""
    blocks, side, _ = rig.state_matrix.shape
    each = rig.modes_per_block
    modes = np.arange(each)
    square = jnp.abs(rig.state_matrix[:, 2 * modes + 1, 2 * modes])
    scale = jnp.ones((blocks, side)).at[:, 2 * modes].set(jnp.sqrt(1.0 + square))
    return jax.lax.stop_gradient(scale)


@jax.named_scope("propagators")
def propagators(
    rig: Rig, lengths: Float[Array, " *length"], points: int = 0, driven: bool = False
) -> Step:
    """Propagators of the rig over steps of the given lengths (s), zero included.

    `points` is the number of equal intervals at whose ends the state is wanted within a step.
    Inputs are the forces on the modes, and after them, if the rig is `driven`, the commands.
    """
    balance = _balance(rig)
    blocks, side, _ = rig.state_matrix.shape
    matrix = rig.state_matrix * balance[:, :, None] / balance[:, None, :]
    force = jnp.eye(side)[:, 1 : 2 * rig.modes_per_block : 2]
    if driven:
        force = jnp.concatenate([force, rig.command_matrix], axis=1)
    fractions = np.concatenate([GAUSS, np.arange(points) / max(points, 1), [1.0]])
    spans = lengths.reshape(-1, 1) * fractions
    x = jnp.moveaxis(matrix, 0, -1)[:, :, None, None] * spans[..., None] / 2**DOUBLINGS
    small = _series(x.reshape(side, side, -1), force)
    ended: Any = jax.lax.scan(_double, small, length=DOUBLINGS)
    drift, pushes = ended[0]
    powers = np.arange(NODES)
    weights = _lagrange() * np.array([math.factorial(p) for p in powers])  # force, power
    weights = weights * fractions[:, None, None] ** powers  # fraction, force, power
    pushes = pushes.reshape(*pushes.shape[:-1], *spans.shape, blocks)
    push = jnp.einsum("cfp,psmlcb->clfbsm", weights, pushes)
    # Inputs act on speeds and actuators' own states, which the balance leaves as they are.
    push = push * spans.T[..., None, None, None, None] / balance[:, :, None]
    drift = drift.reshape(side, side, *spans.shape, blocks).transpose(3, 2, 4, 0, 1)
    drift = drift * balance[:, None, :] / balance[:, :, None]

    def back(part):
        return jnp.moveaxis(part.reshape(-1, *lengths.shape, *part.shape[2:]), 0, lengths.ndim)

    return Step(
        drift_nodes=back(drift[:NODES]),
        push_nodes=back(push[:NODES]),
        drift_end=drift[-1].reshape(*lengths.shape, *drift.shape[2:]),
        push_end=push[-1].reshape(*lengths.shape, *push.shape[2:]),
        drift_points=back(drift[NODES:]),
        push_points=back(push[NODES:]),
    )


def _series(x, force):
    """exp(x) (..., many), and phi_1 ... phi_NODES of x times the force matrix, for small x."""
    side = x.shape[0]
    identity = jnp.broadcast_to(jnp.eye(side)[:, :, None], x.shape)
    force = jnp.broadcast_to(force[:, :, None], (*force.shape, x.shape[-1]))

    def horner(sums, k):
        exponential, top = sums
        exponential = identity + _multiply(x, exponential) / (k + 1)
        top = force + _multiply(x, top) / (NODES + k + 1)
        return (exponential, top), None

    sums, _ = jax.lax.scan(horner, (identity, force), jnp.arange(TERMS - 1, -1, -1.0))
    pushes = [sums[1] / math.factorial(NODES)]
    for p in range(NODES - 1, 0, -1):
        pushes.insert(0, force / math.factorial(p) + _multiply(x, pushes[0]))
    return sums[0], jnp.stack(pushes)


def _double(functions, _):
    """The same functions of twice the argument."""
    drift, pushes = functions
    doubled = _multiply(drift, pushes) + jnp.tensordot(_doubling(), pushes, axes=1)
    halves = 0.5 ** np.arange(1, NODES + 1)
    return (_multiply(drift, drift), doubled * halves[:, None, None, None]), None


@functools.cache
def _doubling() -> np.ndarray:
    """Weights 1 / (p - l)! of phi_l in phi_p of the doubled argument."""
    rows = range(1, NODES + 1)
    return np.array([[1 / math.factorial(p - q) if q <= p else 0.0 for q in rows] for p in rows])
