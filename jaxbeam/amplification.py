"""Envelopes of the deflection along the beam, and how far they exceed static loading."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case import Case
from jaxbeam.checks import check
from jaxbeam.compiling import compiled
from jaxbeam.plan import TOLERANCE, form, run_extremes, suitable_step
from jaxbeam.static import static_peak


def envelope(case: Case, x, tolerance: float = TOLERANCE) -> Float[Array, " place"]:
    """Largest absolute deflection (m) at positions x (m) during a run, free vibration included.

    Found while integrating, without storing histories. `tolerance` is relative. Raises ValueError
    for a faulty case, RuntimeError if no time step meets the tolerance.
    """
    check(case)
    shape = form(case)
    step, _ = suitable_step(case, shape, tolerance)
    return _peaks(case, shape, jnp.asarray(step), jnp.asarray(x, float))


@compiled
def _peaks(case, shape, step, x):
    return run_extremes(case, shape, step, x).peak()[0][:, 0]


def amplification(case: Case, x, tolerance: float = TOLERANCE) -> Float[Array, " place"]:
    """Dynamic amplification at positions x (m): largest dynamic over largest static deflection.

    Static is the same traffic without inertia of beam and loads, by `static.static_peak`, which
    is exact; the dynamic deflection has the modes of the case, so a few modes make the ratio of a
    slow crossing fall a little short of one. Raises as `envelope`, and ValueError for a beam that
    can move as a rigid body.
    """
    return envelope(case, x, tolerance) / static_peak(case, jnp.asarray(x, float))
