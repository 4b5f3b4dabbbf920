"""Envelopes of the deflection along the beam, and how far they exceed static loading."""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxbeam.case.case import Case
from jaxbeam.case.declared_checks import check_on_beam
from jaxbeam.integrator.integrate import integrate_peaks
from jaxbeam.integrator.step_matrices import signed_both_ways
from jaxbeam.model.statics import static_peak
from jaxbeam.runtime.compiling import compiled
from jaxbeam.simulation.integration_plan import TOLERANCE, integration_plan, sample_times
from jaxbeam.simulation.simulate import integration_setup


class Envelope(NamedTuple):
    """How far a beam goes down and up (m) at some places: nowhere above zero, nowhere below."""

    lowest: Float[Array, " place"]
    highest: Float[Array, " place"]


def envelope(case: Case, x, tolerance: float = TOLERANCE) -> Envelope:
    """Lowest and highest deflection (m) at positions x (m) during a run, between samples too.

    Found while integrating, without storing histories; free vibration and control are included.
    The beam begins at rest, so zero is always reached. `tolerance` is relative to the largest
    deflection. Raises ValueError for a faulty case or positions off the beam, RuntimeError if no
    time step meets the tolerance.
    """
    x = jnp.asarray(x, float)
    plan = integration_plan(case, tolerance=tolerance)
    check_on_beam("x", x, case.beam.length)
    return _compiled_envelope(case, dataclasses.replace(plan, error=0.0), sample_times(case), x)


@compiled
def _compiled_envelope(case, plan, times, x):
    discrete, loads, policy, *_ = integration_setup(case, plan, times, x)
    running_peaks, _ = integrate_peaks(
        signed_both_ways(discrete), loads, max_loads=plan.shapes.max_loads, policy=policy
    )
    highest, lowest = jnp.split(running_peaks.refined_peak()[0][:, 0], 2)
    return Envelope(-lowest, highest)


def amplification(case: Case, x, tolerance: float = TOLERANCE) -> Float[Array, " place"]:
    """Dynamic amplification at positions x (m): largest dynamic over largest static deflection.

    Static is the same traffic without inertia of beam and loads, by `static.static_peak`, which
    is exact; the dynamic deflection has the modes of the case, so a few modes make the ratio of a
    slow crossing fall a little short of one. Raises as `envelope`, and ValueError for a beam that
    can move as a rigid body.
    """
    lowest, highest = envelope(case, x, tolerance)
    return jnp.maximum(-lowest, highest) / static_peak(case, jnp.asarray(x, float))
