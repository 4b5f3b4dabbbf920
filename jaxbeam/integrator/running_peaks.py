"""The largest deflections and smallest contact forces of a run, kept without storing it."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxbeam.case.trajectory import NEVER
from jaxbeam.integrator.propagators import GAUSS, LOOKED
from jaxbeam.integrator.step_matrices import Path, Tables
from jaxbeam.numerics.peak_search import estimate_peak, max_with_ties, refine_peak

NEAR = 1.1  # a peak between samples is less than this above the highest of them


class Found(NamedTuple):
    """Results of runs: peaks (m) and when they are (s), contact forces (N) and their loss (s).

    NaN where a run failed, and for contact that is never lost.
    """

    peak_deflection: Float[Array, "*task lane sensor"]
    peak_time: Float[Array, "*task lane sensor"]
    lowest_contact_force: Float[Array, "*task lane load"]
    contact_lost_time: Float[Array, "*task lane load"]


class Extremes(eqx.Module):
    """What is kept of a run.

    `samples` are the deflections at the points looked at in the step with the largest `size` of
    deflection of each watched place, `start` (s) and `span` (s) that step. Contact forces are those
    with which a load presses on the beam; `lost` (s) is the first time it would have to pull.
    """

    score: Float[Array, "sensor lane"]
    samples: Float[Array, "point sensor lane"]
    start: Float[Array, "sensor lane"]
    span: Float[Array, "sensor lane"]
    lowest: Float[Array, "load lane"]
    lost: Float[Array, "load lane"]
    sound: Bool[Array, " lane"]
    size: Callable = eqx.field(static=True)

    def peak(self) -> tuple[Float[Array, "sensor lane"], Float[Array, "sensor lane"]]:
        """Largest size of deflection (m) of each watched place, and when (s); NaN if not sound."""
        value, place = refine_peak(self.samples, LOOKED, self.size)
        time = self.start + place * self.span
        return jnp.where(self.sound, value, jnp.nan), jnp.where(self.sound, time, jnp.nan)

    def found(self) -> Found:
        """All that is known at the end, with lanes first."""
        lost = jnp.where(self.lost < NEVER, self.lost, jnp.nan)
        return Found(*(part.T for part in (*self.peak(), self.lowest, lost)))


@jax.named_scope("extremes")
def fold(best: Extremes, tables: Tables, path: Path, states, forces, commands) -> Extremes:
    """Extremes of the run so far, from those up to a chunk of steps and the chunk itself."""
    steps, lanes = states.shape[0], states.shape[-1]
    start, span = path.start, path.span
    parts = (states, forces) if commands is None else (states, forces, commands)
    seen = tables.watch @ jnp.concatenate(parts, axis=1)
    samples = jax.lax.optimization_barrier(seen.reshape(steps, len(LOOKED), -1, lanes))

    def raised(best):
        score = jax.lax.optimization_barrier(
            jax.vmap(lambda step: estimate_peak(step, LOOKED, best.size))(samples)
        )
        best_score, top = max_with_ties(score)
        top = jnp.max(jnp.where(top, np.arange(steps)[:, None, None], 0), axis=0)
        better = best_score > best.score
        chosen = jnp.take_along_axis(samples, top[None, None], axis=0)[0]
        return Extremes(
            jnp.where(better, best_score, best.score),
            jnp.where(better, chosen, best.samples),
            jnp.where(better, start[top], best.start),
            jnp.where(better, span[top], best.span),
            best.lowest,
            best.lost,
            best.sound,
            best.size,
        )

    # Most chunks come nowhere near the peak so far, or press all along: they end here.
    largest = jnp.max(jnp.abs(samples), axis=(0, 1))
    best = jax.lax.cond(jnp.any(largest * NEAR > best.score), raised, lambda best: best, best)
    pressing = jnp.min(-forces.reshape(steps, -1, len(GAUSS), lanes), axis=2)
    # A load that is not on the beam, or has no slot, does not count.
    here = (path.slots[:, :, None] == np.arange(best.lowest.shape[0])) & path.active[..., None]
    least = jnp.where(here[..., None], pressing[:, :, None], jnp.inf)
    lowest = jnp.minimum(best.lowest, jnp.min(least, axis=(0, 1), initial=jnp.inf))

    def lost(first):
        pulls = -forces.reshape(steps, -1, 1, len(GAUSS), lanes) < 0
        times = (start[:, None] + span[:, None] * jnp.asarray(GAUSS, span.dtype))[
            :, None, None, :, None
        ]
        when = jnp.where(pulls & here[..., None, None], times, NEVER)
        return jnp.minimum(first, jnp.min(when, axis=(0, 1, 3), initial=NEVER))

    first = jax.lax.cond(jnp.any(lowest < 0), lost, lambda first: first, best.lost)
    sound = best.sound & jnp.all(jnp.isfinite(largest), axis=0)
    return eqx.tree_at(lambda b: (b.lowest, b.lost, b.sound), best, (lowest, first, sound))


def nothing_seen(places: int, loads: int, lanes: int, size: Callable) -> Extremes:
    """Extremes of a run that has not begun, by some size of deflection that is zero at rest."""
    nothing = jnp.zeros((places, lanes))
    return Extremes(
        nothing,
        jnp.zeros((len(LOOKED), places, lanes)),
        nothing,
        nothing,
        jnp.full((loads, lanes), jnp.inf),
        jnp.full((loads, lanes), NEVER),
        jnp.ones(lanes, bool),
        size,
    )
