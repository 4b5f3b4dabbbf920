"""Runs with the loads of an oracle and prescribed time steps."""

import dataclasses

import numpy as np
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from tests.oracles.loads import Load


def load_of(load: Load):
    """Load of a case from that of an oracle."""
    kind = {"mass": jb.MovingMass, "force": jb.MovingForce}[load.kind]
    return kind(
        mass=load.mass,
        speed=load.speed,
        entry_time=load.entry_time,
        deceleration=load.deceleration,
    )


def plan_of(
    case: jb.Case, substeps: int = 12, even: bool = True, max_loads: int | None = None
) -> IntegrationPlan:
    """Integration plan with a given number of steps between samples, without a trial run."""
    shapes = static_shapes(case)
    shapes = dataclasses.replace(shapes, max_loads=max_loads or shapes.max_loads)
    return IntegrationPlan(shapes, substeps, lead_samples=0, equally_spaced=even, error=0.0)


def assert_close(found, expected, tolerance: float) -> None:
    """Agreement relative to the largest expected value."""
    expected = np.asarray(expected)
    assert_allclose(found, expected, rtol=0, atol=tolerance * np.max(np.abs(expected)))
