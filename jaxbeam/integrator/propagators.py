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

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.model.modal_model import Rig

NODES = 6  # Gauss nodes a step; the integrator is of order 12
DOUBLINGS = 7
TERMS = 14
LONGEST = 0.5 * 2**DOUBLINGS  # largest norm of A h for which the series is right to rounding

GAUSS = (np.polynomial.legendre.leggauss(NODES)[0] + 1) / 2
# Where in a step the deflection is looked at for its peak: the ends, and the nodes, of which the
# propagators are needed anyway. Curves through these wiggle less than those through equal points.
LOOKED = (0.0, *(float(node) for node in GAUSS), 1.0)


class Step(eqx.Module):
    """Propagators over steps of given lengths: at the Gauss nodes, and at the end.

    `drift_*` take the state at the start, `push_*` the inputs at the Gauss nodes; in the blocks of
    the rig.
    """

    drift_nodes: Float[Array, "*length node block side side"]
    push_nodes: Float[Array, "*length node force block side input"]
    drift_end: Float[Array, "*length block side side"]
    push_end: Float[Array, "*length force block side input"]


@functools.cache
def lagrange() -> np.ndarray:
    """Monomial coefficients (node, power) of the Lagrange polynomials through the Gauss nodes."""
    polynomials = []
    for k, node in enumerate(GAUSS):
        others = np.delete(GAUSS, k)
        polynomials.append(np.polynomial.polynomial.polyfromroots(others) / np.prod(node - others))
    return np.array(polynomials)


def at_ends() -> np.ndarray:
    """Weights (node, end) of the values at the Gauss nodes for those at start and end of a step."""
    coefficients = lagrange()
    return np.stack([coefficients[:, 0], coefficients.sum(axis=1)], axis=1)


def _multiply(a, b):
    """Product of matrices (row, column, ...), many at once; spelt out for those of single modes."""
    if a.shape[1] > 3:
        return jnp.einsum("ij...,jk...->ik...", a, b)
    return sum(a[:, i, None] * b[None, i] for i in range(a.shape[1]))


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
def propagators(rig: Rig, lengths: Float[Array, " *length"], driven: bool = False) -> Step:
    """Propagators of the rig over steps of the given lengths (s), zero included.

    Inputs are the forces on the modes, and after them, if the rig is `driven`, the commands.
    """
    balance = _balance(rig)
    blocks, side, _ = rig.state_matrix.shape
    each = rig.modes_per_block
    matrix = rig.state_matrix * balance[:, :, None] / balance[:, None, :]
    force = jnp.eye(side)[:, 1 : 2 * each : 2]
    if driven:
        force = jnp.concatenate([force, rig.command_matrix], axis=1)
    fractions = np.append(GAUSS, 1.0)
    spans = lengths[..., None] * fractions
    # Blocks and spans are the last axes, along which processors compute many at a time.
    x = jnp.moveaxis(matrix, 0, -1)[..., None] * spans.ravel() / 2**DOUBLINGS
    drift, pushes = _series(x, force)
    (drift, pushes), _ = jax.lax.scan(_double, (drift, pushes), length=DOUBLINGS)
    pushes = pushes * spans.ravel()
    drift, pushes = (part.reshape(*part.shape[:-1], *spans.shape) for part in (drift, pushes))
    powers = np.arange(NODES)
    weights = lagrange() * np.array([math.factorial(p) for p in powers])  # force, power
    weights = weights * fractions[:, None, None] ** powers  # fraction, force, power
    push = jnp.einsum("cfp,psmb...c->...cfbsm", weights, pushes)
    drift = jnp.einsum("stb...c->...cbst", drift)
    # Inputs act on speeds and actuators' own states, which the balance leaves as they are.
    push = push / balance[:, :, None]
    drift = drift * balance[:, None, :] / balance[:, :, None]
    return Step(
        drift_nodes=drift[..., :NODES, :, :, :],
        push_nodes=push[..., :NODES, :, :, :, :],
        drift_end=drift[..., NODES, :, :, :],
        push_end=push[..., NODES, :, :, :, :],
    )


def _series(x, force):
    """exp(x), and phi_1 ... phi_NODES of x times the force matrix (phi, ...), for small x."""
    side, inputs = force.shape
    rest = x.shape[2:]
    # Side by side, as they are summed alike; only what the terms are divided by differs.
    both = jnp.concatenate([jnp.eye(side), force], axis=1).reshape(side, -1, *(1,) * len(rest))
    both = jnp.broadcast_to(both, (side, side + inputs, *rest))
    ahead = np.repeat([0, NODES], [side, inputs]).reshape(-1, *(1,) * len(rest))

    def horner(sums, term):
        return both + _multiply(x, sums) / (term + ahead), None

    sums, _ = jax.lax.scan(horner, both, np.arange(TERMS, 0, -1.0))
    drift, top, force = sums[:, :side], sums[:, side:], both[:, side:]
    pushes = [top / math.factorial(NODES)]
    for p in range(NODES - 1, 0, -1):
        pushes.insert(0, force / math.factorial(p) + _multiply(x, pushes[0]))
    return drift, jnp.stack(pushes)


def _double(functions, _):
    """The same functions of twice the argument."""
    drift, pushes = functions
    ahead = jax.vmap(functools.partial(_multiply, drift))(pushes)
    # Spelt out: as a product over the first axis it would be copied to and fro.
    weights = _doubling().T.reshape(NODES, NODES, *(1,) * drift.ndim)
    doubled = ahead + sum(weight * push for weight, push in zip(weights, pushes, strict=True))
    halves = 0.5 ** np.arange(1, NODES + 1).reshape(NODES, *(1,) * drift.ndim)
    return (_multiply(drift, drift), doubled * halves), None


@functools.cache
def _doubling() -> np.ndarray:
    """Weights 1 / (p - l)! of phi_l in phi_p of the doubled argument."""
    rows = range(1, NODES + 1)
    return np.array([[1 / math.factorial(p - q) if q <= p else 0.0 for q in rows] for p in rows])
