"""What sampling takes from control: held commands reach fast modes less, some not at all.

A mode with poles a +- i omega cannot be controlled at periods k pi / omega: after each of them its
state has turned by half a turn, so all commands push it along one and the same line.
"""

import warnings

import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.case.fields import concrete
from jaxbeam.case.validation import check_case
from jaxbeam.model.state_space import StateSpace, state_space

MIN_REACHABILITY = (
    0.3  # of the reach of commands: less is worth a warning, so beyond 0.93 of the limit
)
UNCONTROLLABLE = 1e-9  # of the largest push that a mode could get: less is none


class SamplingWarning(UserWarning):
    """A controller samples so slowly that it hardly reaches a mode it is designed for."""


def sampling_limit(case: Case) -> Float[Array, " mode"]:
    """Sampling periods pi / omega in s at which control of a mode is lost, slowest mode first.

    Eq. (5.6) of the thesis: omega is the imaginary part of a pole of the case without its loads,
    suspensions included; a mode damped beyond oscillation has no limit and no entry. Control is
    lost at the multiples of the limit too, and poor near it and in between. Not for use inside
    `jit`. Raises ValueError for a faulty case.
    """
    check_case(case)
    return jnp.asarray(np.pi / _oscillatory_modes(state_space(case).unloaded)[0].imag)


def warn_slow_sampling(system: StateSpace, period: float, memory_time: float) -> None:
    """Warn (SamplingWarning) if commands held for a period (s) hardly reach a mode of a plant.

    `memory_time` (s) is as in `sampled_reachability`.
    """
    share, pole = sampled_reachability(system, period, memory_time)
    if share >= MIN_REACHABILITY:
        return
    warnings.warn(
        f"commands held for {period:.4g} s hardly reach the mode at {pole / (2 * np.pi):.4g} Hz,"
        f" whose sampling limit is pi / omega = {np.pi / pole:.4g} s: {share:.2g} of their reach"
        " is left; sample faster, or design for fewer modes",
        SamplingWarning,
        stacklevel=2,
    )


def sampled_reachability(
    system: StateSpace, period: float, memory_time: float
) -> tuple[float, float]:
    """Which share of the reach of commands is left when they are held, and the mode it is worst in.

    The reach of commands is the controllability Gramian of a mode: the states of it that commands
    of unit energy attain, with a memory that fades over a `memory_time` (s), which keeps that of
    undamped modes finite. The share is the least over both directions of a mode, so it is zero
    where the samples lose control of it; the mode is given by omega (1/s). Modes that do not
    oscillate or that no command reaches are left out; without others the share is 1. In the
    coordinates of the mode both Gramians are known in closed form.
    """
    poles, rows = _oscillatory_modes(system)
    modal_inputs = rows @ concrete(system.B)
    max_input = np.linalg.norm(rows, axis=1) * np.linalg.norm(concrete(system.B))
    controllable = np.linalg.norm(modal_inputs, axis=1) > UNCONTROLLABLE * max_input
    shares = [
        _mode_reachability(*at, period, memory_time)
        for at in zip(poles[controllable], modal_inputs[controllable], strict=True)
    ]
    if not shares:
        return 1.0, 0.0
    worst = int(np.argmin(shares))
    return shares[worst], float(poles[controllable][worst].imag)


def _mode_reachability(
    pole: complex, modal_input: np.ndarray, period: float, memory_time: float
) -> float:
    """The share that is left of the reach of a mode, and of its conjugate, with pushes l'B."""
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
    found = scipy.linalg.eig(concrete(system.A), left=True, right=False)
    poles, left_vectors = found[0], found[1]
    oscillatory = np.flatnonzero(poles.imag > 1e-6 * np.abs(poles))
    oscillatory = oscillatory[np.argsort(poles[oscillatory].imag)]
    return poles[oscillatory], left_vectors[:, oscillatory].conj().T
