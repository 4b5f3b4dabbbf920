"""How far a time-invariant loop is from instability, and what it can reach and see.

Gain, phase and delay margins of the loop broken at one command while the others stay closed;
Gramians and Hankel singular values of a state space.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Float

from jaxbeam.analysis.linearised_loop import LinearisedLoop
from jaxbeam.case.fields import concrete
from jaxbeam.model.state_space import StateSpace
from jaxbeam.numerics.discretisation import balance

POINTS_PER_POLE = 400  # frequencies around each pole
MAX_CONDITION = 1e12  # conditioning of eigenvectors beyond which they are too few
LOWEST_FREQUENCY = 1e-3  # lowest frequency looked at, relative to the lowest pole
MAX_DOUBLINGS = 60
POWER_TOLERANCE = 1e-9  # norm of a power of the state matrix that adds nothing any more


class Margins(NamedTuple):
    """Margins of a loop broken at one command; infinite (or zero, `lower_gain`) if there is none.

    The loop stays stable while its gain is multiplied by less than `gain` and more than
    `lower_gain`, its phase lags by less than `phase` (rad) more, or its delay grows by less than
    `delay` (s). `modulus_margin` is the least distance of the Nyquist curve from the critical point.
    """

    gain: float
    lower_gain: float
    phase: float
    delay: float
    modulus_margin: float


def margins(loop: LinearisedLoop, actuator: int = 0) -> Margins:
    """Margins at one command of a loop that is stable, from its frequency response L(i omega).

    u = K (s - A)^-1 B u: the critical point is L = K (s - A)^-1 B = 1; s is exp(i omega period)
    in a sampled loop. Raises ValueError if the loop is not stable as it is.
    """
    if np.any(loop.poles().real >= 0):
        raise ValueError("the loop is unstable as it is; margins belong to a stable one")
    A, B, K = (np.asarray(concrete(part)) for part in (loop.A, loop.B, loop.K))
    others = np.arange(B.shape[1]) != actuator
    A = A + B[:, others] @ K[others]
    column, row = B[:, actuator], K[actuator]
    values, transfer = _transfer_function(A, column, row)

    def response(omega):
        s = 1j * np.atleast_1d(omega)
        return transfer(s if loop.period is None else np.exp(s * loop.period))

    omega = _frequency_grid(values, loop.period)
    curve = response(omega)

    def crossings(function):
        signs = np.sign(function(curve))
        for i in np.flatnonzero(signs[:-1] * signs[1:] < 0):
            yield scipy.optimize.brentq(
                lambda w: function(response(w))[0], omega[i], omega[i + 1], rtol=1e-13
            )

    gains = [1 / response(w)[0].real for w in crossings(np.imag)]
    ends = (value for value in (curve[0], curve[-1]) if abs(value.imag) < 1e-9)
    gains += [1 / value.real for value in ends if value.real != 0]
    phases, delays = [np.inf], [np.inf]
    for w in crossings(lambda z: np.abs(z) - 1):
        # What lags by its own angle meets the critical point at angle zero.
        lag = np.angle(response(w)[0]) % (2 * np.pi)
        phases.append(min(lag, 2 * np.pi - lag))
        delays.append(lag / w)
    nearest = int(np.argmin(np.abs(1 - curve)))
    bracket = omega[max(nearest - 1, 0)], omega[min(nearest + 1, omega.size - 1)]
    least = scipy.optimize.minimize_scalar(
        lambda w: abs(1 - response(w)[0]), bounds=bracket, options={"xatol": 1e-9 * bracket[1]}
    )
    found = Margins(
        gain=min((g for g in gains if g > 1), default=np.inf),
        lower_gain=max((g for g in gains if 0 < g < 1), default=0.0),
        phase=min(phases),
        delay=min(delays),
        modulus_margin=min(least.fun, abs(1 - curve[nearest])),
    )
    return Margins(*map(float, found))


def _transfer_function(A, column, row):
    """The poles of row (s - A)^-1 column, and that as a function of many s (rad/s, or z)."""
    values, vectors = np.linalg.eig(A)
    if np.linalg.cond(vectors) < MAX_CONDITION:
        # In its eigenvectors: one division for each frequency and pole.
        residues = (row @ vectors) * np.linalg.solve(vectors, column.astype(complex))
        return values, lambda s: (residues / (s[:, None] - values)).sum(axis=1)
    # What waits for several periods has too few eigenvectors: by back substitution then.
    found = scipy.linalg.schur(A, output="complex")
    triangle, basis = np.asarray(found[0]), np.asarray(found[1])
    row, column = row @ basis, basis.conj().T @ column

    def transfer(s):
        found = np.zeros((column.size, s.size), complex)
        for i in reversed(range(column.size)):
            rest = column[i] + triangle[i, i + 1 :] @ found[i + 1 :]
            found[i] = rest / (s - triangle[i, i])
        return row @ found

    return np.diag(triangle), transfer


def _frequency_grid(poles, period) -> np.ndarray:
    """Frequencies (rad/s) that resolve every peak of a response with these poles."""
    if period is not None:
        poles = np.log(np.where(poles == 0, np.finfo(float).tiny, poles)) / period
    size = np.abs(poles[poles != 0])
    highest = 1e3 * size.max() if period is None else np.pi / period
    grid = [
        np.geomspace(min(LOWEST_FREQUENCY * size.min(), highest / 2), highest, 4 * POINTS_PER_POLE)
    ]
    for pole in poles:
        # Densest within its half-width.
        grid.append(pole.imag + abs(pole.real) * np.sinh(np.linspace(-6, 6, POINTS_PER_POLE)))
    omega = np.unique(np.concatenate(grid))
    return omega[(omega > 0) & (omega <= highest)]


class Gramians(NamedTuple):
    """Triangular factors of the Gramians of a stable state space, and what follows from them.

    The states that unit commands of any shape reach are Lc w with |w| <= 1; those that give
    outputs of unit energy are Lo'^-1 w. `hankel` are the singular values of the two together, in
    output per input, descending: directions with small ones are hardly reached or hardly seen.
    """

    controllability: Float[Array, "state state"]
    observability: Float[Array, "state state"]
    hankel: Float[Array, " state"]

    @property
    def reachable_size(self) -> Float[Array, " state"]:
        """The root of each state's entry in the Gramian of controllability."""
        return jnp.linalg.norm(self.controllability, axis=1)

    @property
    def observable_size(self) -> Float[Array, " state"]:
        """The root of each state's entry in the Gramian of observability."""
        return jnp.linalg.norm(self.observability, axis=1)


def gramians(system: StateSpace) -> Gramians:
    """Factors of the Gramians: A X + X A' + B B' = 0 with X = Lc Lc', and dually with C.

    The factors are found without forming the Gramians, whose small directions would drown in
    rounding (Hammarling, IMA Journal of Numerical Analysis 2, 1982, gives the reason; here by
    doubling with orthogonal factors). Raises ValueError if the system is not stable.
    """
    A, B, C = system.A, system.B, system.C
    scale = balance(A)
    A, B, C = A * scale / scale[:, None], B / scale[:, None], C * scale
    if system.period is None:
        # Cayley's transform keeps the Gramians.
        pole = jnp.max(jnp.sum(jnp.abs(A), axis=1))
        inverse = jnp.linalg.inv(pole * jnp.eye(A.shape[0]) - A)
        A, root = inverse @ (pole * jnp.eye(A.shape[0]) + A), jnp.sqrt(2 * pole)
        B, C = root * inverse @ B, root * C @ inverse
    controllability, observability = _gramian_factor(A, B), _gramian_factor(A.T, C.T)
    if not bool(jnp.all(jnp.isfinite(controllability)) & jnp.all(jnp.isfinite(observability))):
        raise ValueError("Gramians need a stable system; damp every mode, rigid ones too")
    hankel = jnp.linalg.svd(observability.T @ controllability, compute_uv=False)
    return Gramians(controllability * scale[:, None], observability / scale[:, None], hankel)


def _gramian_factor(A, B):
    """L with L L' = sum of A^k B B' A'^k, twice as many terms at a time; nan if it grows."""
    size = A.shape[0]
    first = _square_factor(B)
    factor = jnp.zeros((size, size)).at[:, : first.shape[1]].set(first)

    def double(_, state):
        factor, power = state
        return _square_factor(jnp.concatenate([factor, power @ factor], axis=1)), power @ power

    factor, power = jax.lax.fori_loop(0, MAX_DOUBLINGS, double, (factor, A))
    return jnp.where(jnp.max(jnp.abs(power)) < POWER_TOLERANCE, factor, jnp.nan)


def _square_factor(factor):
    """A square (or narrower) L with L L' = wide wide'."""
    return jnp.linalg.qr(factor.T, mode="r").T
