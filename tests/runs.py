"""Runs with the loads of an oracle, in time steps that are given."""

import dataclasses

import numpy as np
from numpy.testing import assert_allclose

import jaxbeam as jb
from jaxbeam.simulation.integration_plan import IntegrationPlan, static_shapes
from tests.oracles.loads import Load


def load_of(load: Load):
    """The load of an oracle's load."""
    kind = {"mass": jb.MovingMass, "force": jb.MovingForce}[load.kind]
    return kind(
        mass=load.mass,
        speed=load.speed,
        entry_time=load.entry_time,
        deceleration=load.deceleration,
    )


def plan_of(
    case: jb.Case, substeps: int = 12, even: bool = True, slots: int | None = None
) -> IntegrationPlan:
    """A plan with a given number of steps a sample, which spares the search for it."""
    shape = static_shapes(case)
    shape = dataclasses.replace(shape, max_loads=slots or shape.max_loads)
    return IntegrationPlan(shape, substeps, lead_samples=0, equally_spaced=even, error=0.0)


def assert_close(found, expected, tolerance: float) -> None:
    """Agreement relative to the largest expected value."""
    expected = np.asarray(expected)
    assert_allclose(found, expected, rtol=0, atol=tolerance * np.max(np.abs(expected)))
