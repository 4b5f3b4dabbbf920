"""What a set of sensors can tell of a beam: modes that none of them sees, modes they mix up."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxbeam.case.fields import concrete
from jaxbeam.model.state_space import StateSpace

UNOBSERVABLE = 1e-9  # of what a sensor sees of the mode it sees best: less is nothing


class ConditioningWarning(UserWarning):
    """Sensors hardly tell some of the modes apart."""


def mode_count(system: StateSpace) -> int:
    """How many modes of the beam are among the states."""
    return sum(state.name.endswith("_rate") for state in system.states)


def deflection_mode_shapes(system: StateSpace) -> Float[Array, "sensor mode"]:
    """The mode shapes at the sensors of deflection, eq. (4.9) of the thesis."""
    return system.C[deflection_outputs(system), : mode_count(system)]


def deflection_outputs(system: StateSpace) -> np.ndarray:
    """Which outputs are deflections."""
    names = [output.name for output in system.outputs]
    return np.array([i for i, name in enumerate(names) if name.endswith("_deflection")], int)


def conditioning(system: StateSpace) -> Float[Array, ""]:
    """Largest over smallest singular value of the mode shapes at the sensors of deflection.

    So many times larger than those of the readings may the errors of the modal coordinates be,
    each relative to the whole, when eq. (4.8) of the thesis finds these from those. Infinite, or
    beyond 1e12, where sensors mix modes up. Differentiable, for choosing places of sensors.
    """
    values = jnp.linalg.svd(deflection_mode_shapes(system), compute_uv=False)
    return values[0] / values[-1]


def unobservable_mode(system: StateSpace) -> float | None:
    """Frequency in Hz of a mode that cannot be told from the outputs; None if all can.

    By Hautus' test on the states of the beam alone: no motion of the free beam at one frequency
    may leave all outputs zero.
    """
    modes = mode_count(system)
    A, C = concrete(system.A)[: 2 * modes, : 2 * modes], concrete(system.C)[:, : 2 * modes]
    stiffness = np.abs(A[modes:, :modes].diagonal())
    scale = np.concatenate([1 / np.sqrt(1 + stiffness), np.ones(modes)])
    A, C = A * scale / scale[:, None], C * scale
    C = C / np.maximum(np.linalg.norm(C, axis=1, keepdims=True), np.finfo(float).tiny)
    matrix_norm = np.linalg.norm(A, 2)
    for value in np.linalg.eigvals(A):
        pencil = np.concatenate([(A - value * np.eye(2 * modes)) / matrix_norm, C])
        if np.linalg.svd(pencil, compute_uv=False)[-1] < UNOBSERVABLE:
            return float(np.abs(value) / (2 * np.pi))
    return None


def observability_error(system: StateSpace) -> str | None:
    """What is wrong with sensors from which the state cannot be told, as "key needs ..."."""
    hertz = unobservable_mode(system)
    if hertz is None:
        return None
    return (
        f"kind needs sensors that see every mode: none of {len(system.outputs)} tells the one at"
        f" {hertz:.4g} Hz; move one off its nodes, add one, or design for fewer modes"
    )
