"""A plant from one tick of a sampled controller to the next, with the noise that gathers.

The command of a tick begins a delay later: within each period, first the command before acts,
then the one that acts at its end.
"""

import functools
import math
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbeam.case.controller import AbstractController

DOUBLINGS = 14  # of a short part of a period, until it is the whole
TERMS = 10  # of the series for that part: it is right to rounding while its norm is below 0.05
ROUNDING = 1e-9  # of a period: a shorter delay beyond whole periods is none

Square = Float[Array, "state state"]
Number = Float[Array, ""]
# State matrix and input matrix at a time (s).
Plant = Callable[[Number], tuple[Float[Array, "..."], Float[Array, "..."]]]


class Transition(eqx.Module):
    """What a period does: x becomes drift x + before u_before + after u_now + noise."""

    drift: Square
    before: Float[Array, "state input"]
    after: Float[Array, "state input"]
    noise: Square

    def mean(self, state, before, now) -> Float[Array, " state"]:
        """The state at the end of the period, where there is no noise."""
        return self.drift @ state + self.before @ before + self.after @ now

    def covariance(self, covariance: Square) -> Square:
        """The covariance at the end of the period, for that at its start."""
        return self.drift @ covariance @ self.drift.T + self.noise

    def then(self, after: "Transition") -> "Transition":
        """This one and, of the same period, what comes after it."""
        return Transition(
            after.drift @ self.drift,
            after.drift @ self.before + after.before,
            after.drift @ self.after + after.after,
            after.covariance(self.noise),
        )


class Ticks(eqx.Module):
    """The period of a controller (s), and how far into it new commands begin; None: at once."""

    period: Number
    late: Number | None

    def transition(
        self,
        plant: Plant,
        intensity: Square,
        scale: Float[Array, " state"],
        t: Number | float = 0.0,
    ) -> Transition:
        """From the tick before t (s) to that at t, white noise of this intensity acting on x'.

        Exact for a plant that stays as it is; else by Magnus' method of order 4, with
        one exponential between any two changes of the command. In states over their `scale`, from
        `holds.balance`, numbers should be of like size.
        """
        parts, _, _ = self.parts(plant, intensity, scale, t)
        return functools.reduce(Transition.then, parts)

    def parts(
        self,
        plant: Plant,
        intensity: Square,
        scale: Float[Array, " state"],
        t: Number | float = 0.0,
        stops: Sequence[Number] = (),
    ) -> tuple[list[Transition], Float[Array, " part"], Bool[Array, " part"]]:
        """The same in parts, cut where the command changes and at some `stops` (s into the period).

        And where in the period each part ends (s), and whether the command before acts in it.
        """
        late = jnp.zeros(()) if self.late is None else self.late
        cuts = [*stops, *([] if self.late is None else [late])]
        ends = jnp.sort(jnp.stack([*cuts, self.period]))
        starts = jnp.concatenate([jnp.zeros(1), ends[:-1]])
        early = (ends <= late)[:, None, None]
        drifts, pushes, noises = jax.vmap(lambda *at: _stretch(plant, intensity, scale, *at))(
            t - self.period + starts, ends - starts
        )
        before, after = jnp.where(early, pushes, 0.0), jnp.where(early, 0.0, pushes)
        columns = zip(drifts, before, after, noises, strict=True)
        return [Transition(*column) for column in columns], ends, early[:, 0, 0]


def ticks(controller: AbstractController) -> Ticks:
    """The ticks of a controller that has a sampling period."""
    period, delay = controller.period, controller.delay
    if delay is None:
        return Ticks(period, None)
    whole = jax.lax.stop_gradient(jnp.floor(delay / period + ROUNDING))
    return Ticks(period, jnp.maximum(delay - whole * period, 0.0))


def _stretch(plant: Plant, intensity, scale, start, span):
    """Drift of the state, push of a held input and covariance of the noise over a span (s)."""
    middle, reach = start + span / 2, math.sqrt(3) / 6 * span
    nodes = jnp.stack([middle - reach, middle + reach])
    early, late = jax.vmap(lambda time: _matrix(plant, time, scale))(nodes)
    turn = late @ early - early @ late
    matrix = span / 2 * (early + late) + span * reach / 2 * turn
    states, outer = intensity.shape[0], scale * scale[:, None]
    noise = jnp.pad(intensity / outer, (0, matrix.shape[0] - states))
    bend = (late - early) @ noise
    noise = span * noise + span * reach / 2 * (bend + bend.T)
    flow, noise = whole_and_sum(matrix, noise)
    drift = flow[:states, :states] * scale[:, None] / scale
    return drift, flow[:states, states:] * scale[:, None], noise[:states, :states] * outer


def _matrix(plant: Plant, time, scale):
    """The plant with its inputs as further, constant states; in scaled states."""
    A, B = plant(time)
    top = jnp.concatenate([A * scale / scale[:, None], B / scale[:, None]], axis=1)
    return jnp.pad(top, ((0, B.shape[1]), (0, 0)))


def whole_and_sum(matrix: Square, noise: Square) -> tuple[Square, Square]:
    """exp(M) and the integral of exp(M s) N exp(M's) over s from 0 to 1.

    Summed as series of a small fraction of M, which is joined to itself: unlike the blocks of one
    larger exponential (Van Loan's), that holds however fast the plant decays.
    """
    part = matrix / 2**DOUBLINGS
    small = noise / 2**DOUBLINGS
    one = jnp.eye(matrix.shape[0])

    def horner(sums, k):
        flow, gathered = sums
        grown = part @ gathered
        return (one + part @ flow / k, small + (grown + grown.T) / (k + 1)), None

    def double(sums, _):
        flow, gathered = sums
        return (flow @ flow, gathered + flow @ gathered @ flow.T), None

    sums, _ = jax.lax.scan(horner, (one, small), np.arange(TERMS, 0.0, -1.0))
    return jax.lax.scan(double, sums, length=DOUBLINGS)[0]
