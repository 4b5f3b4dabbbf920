"""Observability of the modes of a beam by a set of sensors, and conditioning of their shapes."""

import warnings

import numpy as np
from jaxtyping import Float

from jaxbeam.case.fields import concrete
from jaxbeam.model.state_space import StateSpace
from jaxbeam.runtime.arrays import Array, xp

UNOBSERVABLE = 1e-9  # relative to the most observable mode; below, a mode is unobservable


class ConditioningWarning(UserWarning):
    """Warning of ill-conditioned mode shapes at the sensors."""


class DetectabilityWarning(UserWarning):
    """Warning of a mode that no sensor observes, and which decays by itself."""


def mode_count(system: StateSpace) -> int:
    """Number of modes of the beam among the states."""
    return sum(state.name.endswith("_rate") for state in system.states)


def deflection_mode_shapes(system: StateSpace) -> Float[Array, "sensor mode"]:
    """Mode shapes at the sensors of deflection, eq. (4.9) of the thesis."""
    return system.C[deflection_outputs(system), : mode_count(system)]


def deflection_outputs(system: StateSpace) -> np.ndarray:
    """Indices of the outputs that are deflections."""
    names = [output.name for output in system.outputs]
    return np.array([i for i, name in enumerate(names) if name.endswith("_deflection")], int)


def conditioning(system: StateSpace) -> Float[Array, ""]:
    """Condition number (no unit) of the mode shapes at the sensors of deflection.

    Bound on the ratio of the relative errors of the modal coordinates by eq. (4.8) of the thesis to
    those of the readings. Infinite, or beyond 1e12, where the sensors do not distinguish the modes.
    Differentiable, for choosing positions of sensors.
    """
    values = xp.linalg.svd(deflection_mode_shapes(system), compute_uv=False)
    return values[0] / values[-1]


def unobservable_poles(system: StateSpace) -> list[complex]:
    """Poles (1/s) of the modes of the beam that no output observes, one of each pair.

    By Hautus' test on the states of the beam alone: no free motion of the beam at one frequency may
    leave all outputs zero.
    """
    modes = mode_count(system)
    A, C = concrete(system.A)[: 2 * modes, : 2 * modes], concrete(system.C)[:, : 2 * modes]
    stiffness = np.abs(A[modes:, :modes].diagonal())
    scale = np.concatenate([1 / np.sqrt(1 + stiffness), np.ones(modes)])
    A, C = A * scale / scale[:, None], C * scale
    C = C / np.maximum(np.linalg.norm(C, axis=1, keepdims=True), np.finfo(float).tiny)
    matrix_norm = np.linalg.norm(A, 2)
    found = []
    for value in np.linalg.eigvals(A):
        pencil = np.concatenate([(A - value * np.eye(2 * modes)) / matrix_norm, C])
        if value.imag >= 0 and np.linalg.svd(pencil, compute_uv=False)[-1] < UNOBSERVABLE:
            found.append(complex(value))
    return sorted(found, key=abs)


def observability_error(system: StateSpace) -> str | None:
    """Error of sensors that leave a mode unobservable, as "kind needs ...", or None."""
    poles = unobservable_poles(system)
    if not poles:
        return None
    return (
        f"kind needs sensors that observe every mode: none of {len(system.outputs)} observes"
        f" the one at {_hertz(poles[0])} Hz; move one off its nodes, add one, or design for fewer"
        " modes"
    )


def detectability_error(system: StateSpace) -> str | None:
    """Error of sensors that leave an undamped mode unobservable, as "kind needs ...", or None.

    The estimate of a damped mode that no sensor observes is that of the model alone, whose error
    decays by itself: that is a `DetectabilityWarning`.
    """
    poles = unobservable_poles(system)
    undamped = [pole for pole in poles if pole.real > -UNOBSERVABLE * abs(pole)]
    if undamped:
        return (
            "kind needs sensors that observe every mode without damping: none of"
            f" {len(system.outputs)} observes the one at {_hertz(undamped[0])} Hz; move one off its"
            " nodes, add one, or give it damping"
        )
    if poles:
        which = " and ".join(f"{_hertz(pole)} Hz" for pole in poles)
        warnings.warn(
            f"no sensor observes the mode{'s' if len(poles) > 1 else ''} at {which}: the estimate"
            " there is that of the model, which no reading corrects",
            DetectabilityWarning,
            stacklevel=2,
        )
    return None


def _hertz(pole: complex) -> str:
    """Frequency of a pole in Hz."""
    return f"{abs(pole) / (2 * np.pi):.4g}"
