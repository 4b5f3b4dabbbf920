"""Loss of controllability by sampling: held commands act less on fast modes, on some not at all.

A mode with poles a +- i omega is uncontrollable at periods k pi / omega: in each of them its phase
advances by a multiple of pi, so that all commands move its state along one line.
"""

import warnings

import numpy as np
import scipy
from jaxtyping import Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check_case
from jaxbeam.model.linear_system import StateSpace
from jaxbeam.model.state_space import state_space
from jaxbeam.runtime.arrays import Array, xp

MIN_REACHABILITY = 0.3  # of the controllability Gramian; below, there is a warning
UNCONTROLLABLE = 1e-9  # of the largest possible modal input; below, a mode is uncontrollable


class SamplingWarning(UserWarning):
    """A mode of the design is hardly controllable at the sampling period."""


def sampling_limit(case: Case) -> Float[Array, " mode"]:
    """Sampling periods pi / omega (s) at which a mode is uncontrollable, slowest mode first.

    Eq. (5.6) of the thesis: omega is the imaginary part of a pole of the case without its loads,
    suspensions included; an overdamped mode has no limit and no entry. Controllability is lost at
    multiples of the limit too, and poor near it and in between. Not for use inside `jit`.

    Raises ValueError for an invalid case.

    >>> import jaxbeam as jb
    >>> case = jb.Case(
    ...     jb.Beam(
    ...         length=0.6, flexural_rigidity=11.68, mass_per_length=0.535, damping_ratio=0.03
    ...     ),
    ...     actuators=[jb.PointForce(0.3, limits=[-1.0, 1.0])],
    ...     sensors=[jb.Sensor(0.3)],
    ...     loads=[jb.MovingMass(mass=0.5, speed=2.0)],
    ... )
    >>> print(jb.sampling_limit(case).round(4))
    [0.0245 0.0061 0.0027]
    """
    check_case(case)
    return xp.asarray(np.pi / _oscillatory_modes(state_space(case).unloaded)[0].imag)


def warn_slow_sampling(system: StateSpace, period: float, memory_time: float) -> None:
    """Warn (SamplingWarning) if a mode of a plant is hardly controllable at a period (s).

    `memory_time` (s) is as in `sampled_reachability`.
    """
    share, pole = sampled_reachability(system, period, memory_time)
    if share >= MIN_REACHABILITY:
        return
    warnings.warn(
        f"the mode at {pole / (2 * np.pi):.4g} Hz is hardly controllable at a period of"
        f" {period:.4g} s: its sampling limit is pi / omega = {np.pi / pole:.4g} s, and the share"
        f" {share:.2g} of its controllability is left; sample faster, or design for fewer modes",
        SamplingWarning,
        stacklevel=2,
    )


def sampled_reachability(
    system: StateSpace, period: float, memory_time: float
) -> tuple[float, float]:
    """Smallest ratio of sampled to continuous controllability over the modes; omega of that mode.

    Controllability is the Gramian of a mode: the states that commands of unit energy attain, with
    forgetting over a `memory_time` (s), which keeps that of undamped modes finite. The ratio is the
    least over both directions of a mode, hence zero where sampling makes it uncontrollable; omega
    is in rad/s. Overdamped modes and uncontrollable ones are left out; without others the ratio is
    1 and omega 0. In modal coordinates both Gramians have a closed form.
    """
    poles, rows = _oscillatory_modes(system)
    modal_inputs = rows @ concrete(system.B)
    max_input = np.linalg.norm(rows, axis=1) * np.linalg.norm(concrete(system.B))
    controllable = np.linalg.norm(modal_inputs, axis=1) > UNCONTROLLABLE * max_input
    shares = [
        _mode_reachability(*mode, period, memory_time)
        for mode in zip(poles[controllable], modal_inputs[controllable], strict=True)
    ]
    if not shares:
        return 1.0, 0.0
    worst = int(np.argmin(shares))
    return shares[worst], float(poles[controllable][worst].imag)


def _mode_reachability(
    pole: complex, modal_input: np.ndarray, period: float, memory_time: float
) -> float:
    """Ratio of the Gramians of a mode and its conjugate, with the modal inputs l'B."""
    pole = pole - 0.5 / memory_time
    pair, modal_input = (
        np.array([pole, np.conj(pole)]),
        np.stack([modal_input, np.conj(modal_input)]),
    )
    sampled_input = modal_input * (np.expm1(pair * period) / pair)[:, None]
    sums = pair[:, None] + pair.conj()
    continuous_gramian = modal_input @ modal_input.conj().T / -sums
    sampled_gramian = sampled_input @ sampled_input.conj().T / -np.expm1(sums * period) / period
    return float(max(scipy.linalg.eigvalsh(sampled_gramian, continuous_gramian)[0], 0.0))


def _oscillatory_modes(system: StateSpace) -> tuple[np.ndarray, np.ndarray]:
    """Oscillating poles (1/s, those with positive imaginary part) and their left eigenvectors."""
    eigenpairs = scipy.linalg.eig(concrete(system.A), left=True, right=False)
    poles, left_vectors = eigenpairs[0], eigenpairs[1]
    oscillatory = np.flatnonzero(poles.imag > 1e-6 * np.abs(poles))
    oscillatory = oscillatory[np.argsort(poles[oscillatory].imag)]
    return poles[oscillatory], left_vectors[:, oscillatory].conj().T
