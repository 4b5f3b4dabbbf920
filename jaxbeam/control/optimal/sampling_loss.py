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
from jaxbeam.case.fields import known
from jaxbeam.case.validation import check
from jaxbeam.model.state_space import StateSpace, state_space

KEPT = 0.3  # of the reach of commands: less is worth a warning, so beyond 0.93 of the limit
UNREACHED = 1e-9  # of the largest push that a mode could get: less is none


class SamplingWarning(UserWarning):
    """A controller samples so slowly that it hardly reaches a mode it is designed for."""


def sampling_limit(case: Case) -> Float[Array, " mode"]:
    """Sampling periods pi / omega in s at which control of a mode is lost, slowest mode first.

    Eq. (5.6) of the thesis: omega is the imaginary part of a pole of the case without its loads,
    suspensions included; a mode damped beyond oscillation has no limit and no entry. Control is
    lost at the multiples of the limit too, and poor near it and in between. Not for use inside
    `jit`. Raises ValueError for a faulty case.
    """
    check(case)
    return jnp.asarray(np.pi / _oscillations(state_space(case).unloaded)[0].imag)


def warn_if_slow(plant: StateSpace, period: float, horizon: float) -> None:
    """Warn (SamplingWarning) if commands held for a period (s) hardly reach a mode of a plant.

    `horizon` (s) is as in `reach_kept`.
    """
    share, pole = reach_kept(plant, period, horizon)
    if share >= KEPT:
        return
    warnings.warn(
        f"commands held for {period:.4g} s hardly reach the mode at {pole / (2 * np.pi):.4g} Hz,"
        f" whose sampling limit is pi / omega = {np.pi / pole:.4g} s: {share:.2g} of their reach"
        " is left; sample faster, or design for fewer modes",
        SamplingWarning,
        stacklevel=2,
    )


def reach_kept(plant: StateSpace, period: float, horizon: float) -> tuple[float, float]:
    """Which share of the reach of commands is left when they are held, and the mode it is worst in.

    The reach of commands is the controllability Gramian of a mode: the states of it that commands
    of unit energy attain, with a memory that fades over a `horizon` (s), which keeps that of
    undamped modes finite. The share is the least over both directions of a mode, so it is zero
    where the samples lose control of it; the mode is given by omega (1/s). Modes that do not
    oscillate or that no command reaches are left out; without others the share is 1. In the
    coordinates of the mode both Gramians are known in closed form.
    """
    poles, rows = _oscillations(plant)
    push = rows @ known(plant.B)
    most = np.linalg.norm(rows, axis=1) * np.linalg.norm(known(plant.B))
    reached = np.linalg.norm(push, axis=1) > UNREACHED * most
    shares = [_kept(*at, period, horizon) for at in zip(poles[reached], push[reached], strict=True)]
    if not shares:
        return 1.0, 0.0
    worst = int(np.argmin(shares))
    return shares[worst], float(poles[reached][worst].imag)


def _kept(pole: complex, push: np.ndarray, period: float, horizon: float) -> float:
    """The share that is left of the reach of a mode, and of its conjugate, with pushes l'B."""
    pole = pole - 0.5 / horizon
    pair, push = np.array([pole, np.conj(pole)]), np.stack([push, np.conj(push)])
    held = push * (np.expm1(pair * period) / pair)[:, None]
    sums = pair[:, None] + pair.conj()
    whole = push @ push.conj().T / -sums
    left = held @ held.conj().T / -np.expm1(sums * period) / period
    return float(max(scipy.linalg.eigvalsh(left, whole)[0], 0.0))


def _oscillations(plant: StateSpace) -> tuple[np.ndarray, np.ndarray]:
    """Oscillating poles (1/s, those with positive imaginary part) and their left eigenvectors."""
    found = scipy.linalg.eig(known(plant.A), left=True, right=False)
    poles, ways = found[0], found[1]
    chosen = np.flatnonzero(poles.imag > 1e-6 * np.abs(poles))
    chosen = chosen[np.argsort(poles[chosen].imag)]
    return poles[chosen], ways[:, chosen].conj().T
