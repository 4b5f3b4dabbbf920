"""Propagators: exact solution of a linear system over a step, with forces polynomial in time.

For z' = A z + B f with f(t) = sum_k f_k l_k(t / h), the l_k being the Lagrange polynomials
through Gauss nodes, the state at any fraction c of a step h is

    z(c h) = Phi_c z(0) + sum_k Theta_ck f_k

with Phi_c = exp(A c h) and Theta_ck a combination of the phi functions
phi_p(X) = int_0^1 e^{(1 - s) X} s^{p - 1} / (p - 1)! ds (Hochbruck and Ostermann, Acta Numerica
2010, section 2). They are Taylor series of X / 2^7, doubled seven times: valid for any damping,
rigid-body modes and lags of actuators, and differentiable.
"""

import functools
import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from jaxbeam.model.modal_model import ModalModel
from jaxbeam.numerics.matrices import MAX_UNROLLED_TERMS
from jaxbeam.numerics.polynomials import gauss_nodes, lagrange_coefficients
from jaxbeam.runtime.arrays import Array, Module, cond, scan, set_at, stop_gradient, vmap, xp

NODE_COUNT = 6  # Gauss nodes in a step; the integrator has order 12
DOUBLINGS = 7
TAYLOR_TERMS = 14
MANY_MATRICES = 256  # whose products XLA computes faster element by element
MAX_STEP_NORM = 0.5 * 2**DOUBLINGS  # largest norm of A h for which the series is exact to rounding

GAUSS_NODES = gauss_nodes(NODE_COUNT)
# Positions in a step at which the deflection is sampled for its peak: the ends and the Gauss nodes,
# for which propagators exist. Interpolants through these oscillate less than through equal points.
PEAK_NODES = (0.0, *(float(node) for node in GAUSS_NODES), 1.0)


class Propagators(Module):
    """Propagators over steps of given lengths, to the Gauss nodes and to the end of a step.

    `transition_*` act on the state at the start, `input_*` on the inputs at the Gauss nodes, in the
    blocks of the modal model.
    """

    transition_nodes: Float[Array, "*length node block side side"]
    input_nodes: Float[Array, "*length node force block side input"]
    transition_end: Float[Array, "*length block side side"]
    input_end: Float[Array, "*length force block side input"]


def end_weights() -> np.ndarray:
    """Weights (node, end) that extrapolate values at the Gauss nodes to the ends of a step."""
    coefficients = lagrange_coefficients(NODE_COUNT)
    return np.stack([coefficients[:, 0], coefficients.sum(axis=1)], axis=1)


def _multiply(a, b):
    """Product of matrices (row, column, ...), spelt out for small blocks, and smaller than many."""
    if a.shape[1] > (3 if math.prod(a.shape[2:]) < MANY_MATRICES else MAX_UNROLLED_TERMS):
        # Matrices last: NumPy then multiplies them by BLAS, twenty times as fast as by `einsum`.
        a, b = (xp.moveaxis(part, (0, 1), (-2, -1)) for part in (a, b))
        return xp.moveaxis(a @ b, (-2, -1), (0, 1))
    return sum(a[:, i, None] * b[None, i] for i in range(a.shape[1]))


def state_matrix_norm(model: ModalModel) -> Float[Array, ""]:
    """Norm of the scaled state matrix in 1/s; `MAX_STEP_NORM` over it bounds the step length."""
    scale = _state_scaling(model)
    matrix = model.state_matrix * scale[:, :, None] / scale[:, None, :]
    return stop_gradient(xp.max(xp.sum(xp.abs(matrix), axis=-1)))


def _state_scaling(model: ModalModel):
    """Scaling (block, side) of the states to equal size of displacements and rates of a mode."""
    blocks, side, _ = model.state_matrix.shape
    modes_per_block = model.modes_per_block
    modes = np.arange(modes_per_block)
    square = xp.abs(model.state_matrix[:, 2 * modes + 1, 2 * modes])
    scale = set_at(xp.ones((blocks, side)), np.s_[:, 2 * modes], xp.sqrt(1.0 + square))
    return stop_gradient(scale)


@jax.named_scope("propagators")
def propagators(
    model: ModalModel, lengths: Float[Array, " *length"], with_commands: bool = False
) -> Propagators:
    """Propagators of a modal model over steps of the given lengths (s), which may be zero.

    Inputs are the generalised forces on the modes, then, `with_commands`, the commands.
    """
    state_scale = _state_scaling(model)
    blocks, side, _ = model.state_matrix.shape
    modes_per_block = model.modes_per_block
    matrix = model.state_matrix * state_scale[:, :, None] / state_scale[:, None, :]
    input_matrix = xp.eye(side)[:, 1 : 2 * modes_per_block : 2]
    if with_commands:
        input_matrix = xp.concatenate([input_matrix, model.command_matrix], axis=1)
    fractions = np.append(GAUSS_NODES, 1.0)
    durations = lengths[..., None] * fractions
    # Blocks are the last axis but that of durations, along which operations vectorise.
    transition, phi_functions = phi_functions_of(
        xp.moveaxis(matrix, 0, -1), input_matrix[..., None], durations
    )
    inputs = xp.einsum("cfp,psmb...c->...cfbsm", force_weights(), phi_functions)
    transition = xp.einsum("stb...c->...cbst", transition)
    # Inputs act on rates and actuators' own states, which the scaling leaves unchanged.
    inputs = inputs / state_scale[:, :, None]
    transition = transition * state_scale[:, None, :] / state_scale[:, :, None]
    return Propagators(
        transition_nodes=transition[..., :NODE_COUNT, :, :, :],
        input_nodes=inputs[..., :NODE_COUNT, :, :, :, :],
        transition_end=transition[..., NODE_COUNT, :, :, :],
        input_end=inputs[..., NODE_COUNT, :, :, :, :],
    )


def phi_functions_of(
    matrix: Float[Array, "side side *system"],
    input_matrix: Float[Array, "side input *#system"],
    durations: Float[Array, "*duration"],
    few_doublings: bool = False,
) -> tuple[Float[Array, "side side *all"], Float[Array, "phi side input *all"]]:
    """exp(A t), and t phi_p(A t) B for p = 1 to 6, of systems over durations t (s).

    With `few_doublings` only as many as the largest norm of A t needs; a `vmap` takes all the same.
    """
    doublings: Any = DOUBLINGS
    if few_doublings:
        norm = xp.max(xp.sum(xp.abs(matrix), axis=1)) * xp.max(durations)
        doublings = xp.ceil(xp.log2(xp.maximum(2 * norm, 1.0))).astype(int)
        doublings = stop_gradient(xp.minimum(doublings, DOUBLINGS))
    x = matrix[..., None] * durations.ravel() / 2**doublings
    functions = _taylor_series(x, input_matrix[..., None])

    def double(functions, i):
        if not few_doublings:
            return _double_argument(functions, i)
        doubled = cond(i < doublings, lambda f: _double_argument(f, i)[0], lambda f: f, functions)
        return doubled, None

    (transition, phi_functions), _ = scan(double, functions, np.arange(DOUBLINGS))
    phi_functions = phi_functions * durations.ravel()
    parts = (transition, phi_functions)
    transition, phi_functions = (part.reshape(*part.shape[:-1], *durations.shape) for part in parts)
    return transition, phi_functions


def force_weights() -> Float[np.ndarray, "fraction force power"]:
    """Weights of the phi functions in the response to forces at the Gauss nodes.

    At the fractions of a step that are its Gauss nodes, then at its end.
    """
    fractions, powers = np.append(GAUSS_NODES, 1.0), np.arange(NODE_COUNT)
    factorials = np.array([math.factorial(p) for p in powers])
    return lagrange_coefficients(NODE_COUNT) * factorials * fractions[:, None, None] ** powers


def _taylor_series(x, input_matrix):
    """exp(x), and phi_1(x) ... phi_6(x) times the input matrix (phi, ...), for small x."""
    side, inputs = input_matrix.shape[:2]
    rest = x.shape[2:]
    # Both series at once: they differ only in the divisors of their terms.
    identity = xp.broadcast_to(xp.eye(side).reshape(side, side, *(1,) * len(rest)), x.shape)
    starting_terms = xp.concatenate(
        [identity, xp.broadcast_to(input_matrix, (side, inputs, *rest))], axis=1
    )
    divisor_offset = np.repeat([0, NODE_COUNT], [side, inputs]).reshape(-1, *(1,) * len(rest))

    def horner(sums, term):
        return starting_terms + _multiply(x, sums) / (term + divisor_offset), None

    sums, _ = scan(horner, starting_terms, np.arange(TAYLOR_TERMS, 0, -1.0))
    transition, highest_phi, input_matrix = sums[:, :side], sums[:, side:], starting_terms[:, side:]
    phi_functions = [highest_phi / math.factorial(NODE_COUNT)]
    for p in range(NODE_COUNT - 1, 0, -1):
        phi_functions.insert(0, input_matrix / math.factorial(p) + _multiply(x, phi_functions[0]))
    return transition, xp.stack(phi_functions)


def _double_argument(functions, _):
    """exp and phi functions of twice the argument."""
    transition, phi_functions = functions
    propagated = vmap(functools.partial(_multiply, transition))(phi_functions)
    others = _doubling_weights() @ phi_functions.reshape(NODE_COUNT, -1)
    doubled = propagated + others.reshape(phi_functions.shape)
    powers_of_half = 0.5 ** np.arange(1, NODE_COUNT + 1).reshape(
        NODE_COUNT, *(1,) * transition.ndim
    )
    return (_multiply(transition, transition), doubled * powers_of_half), None


@functools.cache
def _doubling_weights() -> np.ndarray:
    """Weights 1 / (p - l)! of phi_l in phi_p of the doubled argument."""
    rows = range(1, NODE_COUNT + 1)
    return np.array([[1 / math.factorial(p - q) if q <= p else 0.0 for q in rows] for p in rows])
